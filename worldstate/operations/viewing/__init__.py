"""Figures of a run from its snapshots alone: over time, from above, moving."""
