"""Name what a cached file depends on."""

import hashlib
import json


def origin_of(made_of: object) -> str:
    """Return 32 characters that change whenever anything of JSON-able values does.

    Examples
    --------
    >>> origin_of({"seed": 1}) == origin_of({"seed": 1}), origin_of({"seed": 1}) == origin_of({"seed": 2})
    (True, False)
    """
    # 128 bits: two of a million files get the same name with a probability of 1e-27.
    return hashlib.sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()[:32]
