"""Propagation of sound from every source to every microphone."""
