"""Camera images and detections of a simulated street."""
