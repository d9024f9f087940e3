"""Signals of sounds other than engines and tyres, synthesised from their physics."""
