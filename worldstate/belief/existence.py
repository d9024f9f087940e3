"""Bernoulli existence updates for detection and missed detection."""


def after_empty_look(existence: float, miss_rate: float) -> float:
    r"""Return the existence after a missed detection.

    .. math:: r \leftarrow \frac{r \beta}{r \beta + 1 - r} = \frac{r (1 - p_D)}{1 - r\, p_D},
        \qquad p_D = 1 - \beta
    """
    # At r = 1 and beta = 0 the ratio is 0/0; what certainly exists stays.
    missed = existence * miss_rate
    return missed / (missed + 1.0 - existence) if existence < 1.0 else 1.0


def after_sighting(existence: float, miss_rate: float, clutter_rate: float) -> float:
    r"""Return the existence after a detection.

    .. math:: r \leftarrow \frac{r\, (1 - \beta (1 - c))}{r\, (1 - \beta (1 - c)) + (1 - r)\, c}
    """
    # A look finds something where the entity is detected or, if it is missed, where there is clutter.
    found = existence * (1.0 - miss_rate * (1.0 - clutter_rate))
    return found / (found + (1.0 - existence) * clutter_rate)
