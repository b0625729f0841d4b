"""Changes of finished scenes that need no training: their place, their time, and what of them is kept."""
