"""Effects put into recorded arrays, exactly: what a diagnosis must find, or must not name.

An injection changes the readings and the optical track of a `Subject`, and says what it did.
Those in `LISTED` are of the table in `docs/interfaces.md`; those in `UNLISTED` are of no table,
with the new names that would describe them rightly, if any.
"""

from collections.abc import Mapping

import injection_listed  # noqa: F401  its import fills the list
import injection_unlisted  # noqa: F401
from injection_subject import EMITTER, LISTED, SIZES, TRACK, UNLISTED, Injection, Subject, Truth

__all__ = [
    'CATALOGUE', 'EMITTER', 'LISTED', 'SIZES', 'TOLERANCE', 'TRACK', 'UNLISTED', 'Injection',
    'Subject', 'Truth',
]  # fmt: skip

CATALOGUE = (
    'sensor_gain', 'sensor_axis', 'sensor_polarity', 'sensor_size', 'lever_arm', 'registration',
    'time_offset', 'channel_crosstalk', 'coil_crosstalk', 'coil_drift', 'coil_moved', 'pickup',
    'saturation', 'phase_delay', 'static_metal', 'conductive_plate', 'moving_metal',
    'excess_noise', 'outliers',
)  # fmt: skip
"""The listed names."""
TOLERANCE: Mapping[str, float] = {
    'gain': 1e-3, 'offset_s': 5e-4, 'offset_m': 1e-4, 'rotation_deg': 0.05,
    'translation_m': 1e-4, 'amount': 1e-3, 'full_scale_t': 0.1,
}  # fmt: skip
"""Largest allowed error of a component; of the full scale, its share."""
