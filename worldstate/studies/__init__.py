"""The paper's evaluation and our own experiments; imported by nothing but their commands."""
