"""The paper's evaluation as one protocol: every method receives the same trials and returns the same type."""
