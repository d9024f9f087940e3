"""The filter: predict and update of the whole world-state, its memory and its snapshots."""
