"""Figures of merit for studies: GOSPA, track measures, bootstrap draws, folds."""
