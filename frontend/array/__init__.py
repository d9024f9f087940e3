"""Positions of the microphones, and the steering vectors that follow from them."""
