"""Playback of scenes while they arrive."""
