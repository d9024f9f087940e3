"""Training of signature models on labelled feature windows."""
