"""Figures of merit that only studies use: GOSPA, track measures, bootstrap draws, folds."""
