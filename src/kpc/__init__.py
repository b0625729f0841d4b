"""KPC: 4D scenes in one small file."""
