"""Describes what effects need to know of a session to list the sites where they may act."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.field.dipoles import Dipoles
from anser_ros.physics.sensor import SensorTable, clusters_of

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Apparatus:
    """Holds tools, references, emitters and the space that they take up."""

    tools: tuple[SensorTable, ...]  # One table for each tool body
    references: SensorTable | None  # The sensors that are fixed in fg
    emitters: int  # Number of emitters, K
    omega: Array  # (K,), angular drive frequencies, rad/s
    duration: float  # Length of the session, s
    illumination: Dipoles  # The emitters' own field, good also beside and below the board
    # (2, 3), lower and upper corner of the box in which tool sensors were during this session, m,
    # frame fg: what the data can tell about, not where tools may be (that is
    # `physics.volume.TrackedVolume`)
    visited_box: Array
    board: Array  # (2, 3), lower and upper corner of the field generator, m, frame fg

    @property
    def tool_channels(self) -> tuple[int, ...]:
        """Return the channels of all tool sensors, in the tables' order."""
        return tuple(int(c) for table in self.tools for c in table.channel)

    @property
    def channels(self) -> tuple[int, ...]:
        """Return channels of all sensors, those of the tools first."""
        extra = () if self.references is None else self.references.channel
        return self.tool_channels + tuple(int(c) for c in extra)

    def clusters(self) -> list[tuple[int, ...]]:
        """Return the channels of tool sensors that share one centre, two or more of them."""
        return [
            tuple(table.channel[rows].tolist())
            for table in self.tools
            for rows in clusters_of(table)
            if rows.size > 1
        ]
