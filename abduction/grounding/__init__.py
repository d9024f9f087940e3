"""The classifier's scores weighed with physics, "Evidence of Absence", eq. (5)."""
