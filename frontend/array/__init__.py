"""Where the microphones are, and the steering vectors that follow from it."""
