"""What the camera sees of a simulated street."""
