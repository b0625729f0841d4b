"""The player's window: input, panels, filming, settings."""
