"""The command `worldstate`."""
