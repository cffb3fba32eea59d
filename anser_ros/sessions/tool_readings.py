"""Makes of a frame's fluxes, and of the poses found for its bodies, what tools read where."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.correction import Correction
from anser_ros.frames.faults import GOOD, reading_codes
from anser_ros.refit.tool_readings import ToolReading

Pose = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Position (3,), m, and rotation (3, 3) of a body in frame fg."""


def tool_readings(
    correction: Correction,
    channels: NDArray[np.int64],
    flux: NDArray[np.complex128],
    flags: NDArray[np.int64],
    poses: Mapping[str, Pose],
) -> list[ToolReading]:
    """Return what the usable coils of each body with a pose read.

    ``flux`` (S, K), T, is as measured; the correction is that of the tools' sensors, by the
    effects of the model. Bodies without a coil in the frame are left out.
    """
    if correction.changes_flux:
        # The time matters to a recorded drift alone, which references follow where there are any.
        flux = correction.flux(0.0, channels, flux)
    row_of = {channel: row for row, channel in enumerate(channels.tolist())}
    usable = reading_codes(flux, flags) == GOOD
    sensors, readings = correction.sensors(), []
    for body, (position, rotation) in poses.items():
        table = sensors.of_body(body)
        rows = [row_of.get(channel, -1) for channel in table.channel.tolist()]
        kept = [i for i, row in enumerate(rows) if row >= 0 and usable[row]]
        if kept:
            taken = flux[[rows[i] for i in kept]]
            readings.append(ToolReading(table.select(kept), taken, position, rotation))
    return readings
