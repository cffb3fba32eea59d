"""Turns values into what text files can hold: numbers, strings, lists and mappings, no arrays."""

from typing import Any

import numpy as np


def plain(value: Any) -> Any:
    """Return the value with arrays and tuples as lists, numpy's numbers as Python's, keys as
    strings.

    A complex number becomes the list of its real and imaginary part, because neither JSON nor
    YAML knows complex numbers.
    """
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, complex):
        return [value.real, value.imag]
    return value
