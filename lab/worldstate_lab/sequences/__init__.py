"""Real recordings of a corner, heard from end to end: OVAD's static test set in a layout of its own."""
