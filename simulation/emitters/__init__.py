"""Signals of sounds that are no engine and no tyre, synthesised from their physics."""
