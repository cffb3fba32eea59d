"""Holds units of length, and recognises those used by mistake by how large the numbers are."""

import math
from collections.abc import Mapping

LENGTH_M = {'m': 1.0, 'cm': 1e-2, 'mm': 1e-3, 'inch': 0.0254}
"""Metres in a unit of length."""
LENGTH_UNITS: Mapping[str, float] = {'millimetres': 1e3, 'centimetres': 1e2, 'inches': 1 / 0.0254}
"""Units of length that stand where metres belong: how many there are in a metre."""
FLUX_UNITS: Mapping[str, float] = {
    'nanotesla': 1e9, 'microtesla': 1e6, 'gauss': 1e4, 'millitesla': 1e3,
}  # fmt: skip
"""Units of flux density that stand where teslas belong: how many there are in a tesla."""
CLOSE = 3.0
"""Factor within which a ratio is that of a unit. The units are farther apart than its square, but
for inches and centimetres, of which the nearer one is named."""


def unit_words(ratio: float, units: Mapping[str, float]) -> str:
    """Return the unit whose size a ratio, of what was written to what is expected, is nearest to.

    It is empty where none is near. Units are given as how many there are in the SI unit.
    """
    if not 0.0 < ratio < math.inf:
        return ''
    apart = {name: abs(math.log(ratio / size)) for name, size in units.items()}
    nearest = min(apart, key=lambda name: apart[name])
    return nearest if apart[nearest] < math.log(CLOSE) else ''
