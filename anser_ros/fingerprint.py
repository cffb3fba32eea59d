"""Gives contents short names: equal contents have one name, on every machine, in every file."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

DIGITS = 8
"""Hexadecimal digits of a fingerprint: it has to fit a uint32 on the wire."""
MANTISSA_BITS = 40
"""Bits to which numbers are rounded, one part in 10^12: no text or sum changes them by more."""


@dataclass(frozen=True)
class Identity:
    """Holds fingerprints of a setup's emitters, and of the sensors on each body, ``fg`` too."""

    board: str
    bodies: Mapping[str, str] = field(default_factory=dict)


def fingerprint_of(content: Any) -> str:
    """Return the fingerprint of plain data and arrays, `DIGITS` hexadecimal digits.

    Keys' order and the kind of a number do not matter; an array is its shape and values.
    """
    digest = hashlib.sha256()
    _add(digest, content)
    return digest.hexdigest()[:DIGITS]


def _add(digest: Any, content: Any) -> None:
    if isinstance(content, Mapping):
        digest.update(b'{')
        for key in sorted(content, key=str):
            _add(digest, str(key))
            _add(digest, content[key])
        digest.update(b'}')
    elif isinstance(content, list | tuple):
        digest.update(b'[')
        for item in content:
            _add(digest, item)
        digest.update(b']')
    elif isinstance(content, np.ndarray):
        digest.update(f'array{content.shape}'.encode())
        parts = (content.real, content.imag) if np.iscomplexobj(content) else (content,)
        for part in parts:
            digest.update(_rounded(part).tobytes())
    elif isinstance(content, int | float | np.number) and not isinstance(content, bool):
        digest.update(b'n' + _rounded(np.array(content)).tobytes())
    else:
        digest.update(f'{type(content).__name__}:{content};'.encode())


def _rounded(values: Any) -> 'np.ndarray[Any, np.dtype[np.float64]]':
    """Return little-endian numbers of `MANTISSA_BITS` bits; zero has no sign."""
    mantissa, exponent = np.frexp(np.asarray(values, dtype=np.float64))
    step = 2.0**MANTISSA_BITS
    return np.asarray(np.ldexp(np.rint(mantissa * step) / step, exponent) + 0.0, dtype='<f8')
