"""The classifier's scores combined with physical likelihoods, "Evidence of Absence", eq. (5)."""
