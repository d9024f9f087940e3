"""The full chain on real recordings of street corners: OVAD's static test set in its own file layout."""
