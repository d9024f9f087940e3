"""Live sensors: microphones, cameras and detectors, with latency and cost."""
