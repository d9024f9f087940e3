"""From the statistic to an advisory: thresholds, sustained rule, calibrated risk."""
