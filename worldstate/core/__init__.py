"""The world-state filter: predict, update, memory and snapshots."""
