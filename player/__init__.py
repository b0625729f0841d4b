"""The player: drawing, streaming and the window."""
