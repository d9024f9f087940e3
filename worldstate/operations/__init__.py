"""What users do with recordings of their own: train, calibrate, inspect, draw."""
