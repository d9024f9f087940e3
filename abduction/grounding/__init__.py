"""The classifier's scores weighed with physics, eq. (1) of the paper."""
