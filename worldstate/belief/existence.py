"""Bernoulli existence of an entity that vision has: what looks, found or empty, and time do to it."""

import math


def after_empty_look(existence: float, miss_rate: float) -> float:
    r"""Return the existence after a look that did not find the entity.

    .. math:: r \leftarrow \frac{r (1 - p_D)}{1 - r\, p_D}, \qquad 1 - p_D = \beta.

    Examples
    --------
    >>> round(after_empty_look(0.788, 0.1), 3)
    0.271
    """
    missed = existence * miss_rate
    return missed / (missed + 1.0 - existence) if existence < 1.0 else 1.0


def after_sighting(existence: float, miss_rate: float, clutter_rate: float) -> float:
    r"""Return the existence after a look that found something in its place.

    .. math:: r \leftarrow \frac{r\, p_D}{r\, p_D + (1 - r)\, c}

    Examples
    --------
    >>> round(after_sighting(0.5, 0.04, 0.01), 3)
    0.99
    """
    found = existence * (1.0 - miss_rate * (1.0 - clutter_rate))
    return found / (found + (1.0 - existence) * clutter_rate)


def after_time(existence: float, step_s: float, mean_life_s: float) -> float:
    """Return the existence after a time in which nobody looked.

    Examples
    --------
    >>> round(after_time(0.9, 10.0, 10.0), 3)
    0.331
    """
    return existence * math.exp(-step_s / mean_life_s)
