"""The sound of a clip: decoding it, and playing it in step with the pictures."""
