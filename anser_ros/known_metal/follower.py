"""Gives the field model of every frame by what tools say of known metal."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.field.model import FieldModel
from anser_ros.known_metal.known import KnownMetal
from anser_ros.known_metal.lattice import Coils
from anser_ros.known_metal.start import likely_starts, places_around
from anser_ros.known_metal.track import (
    MetalState,
    Scene,
    field_of,
    near_points,
    predicted,
    updated,
)
from anser_ros.physics.sensor import SensorTable
from anser_ros.physics.volume import TrackedVolume
from anser_ros.pose_states import MODEL_DOUBTFUL, Withheld
from anser_ros.refit.excitation import Excitation
from anser_ros.refit.tool_readings import ToolReading
from anser_ros.settings import ToolSettings
from anser_ros.stamps import NANO

Array = NDArray[np.float64]

CANDIDATES = 4
"""Tracks that are followed at once until one is chosen."""
TRIAL_S, SEARCH_AGAIN_S = 1.0, 1.0
"""How long they are followed, which is also the longest time without readings for which metal is
still known to be there, and how long a search that found nothing is not repeated."""
CERTAIN = 10.0
"""Logarithm of how much more likely the chosen one must make the readings than no metal, or metal
`ELSEWHERE_M` away."""
ELSEWHERE_M = 0.04
"""Distance from which on two tracks are of different places, m."""
DOUBTFUL, HOPELESS = 3.0, 9.0
"""Squared misfit, over what is expected, from which on no pose is given, and the track is given
up."""
MISFIT_MEMORY_S = 0.5
"""Time over which the misfit is averaged."""
STRONGER, NEARER = 1.25, 0.8
"""How strongly the metal may be driven, and how near coils may be to it, over the most when it was
learnt: nothing has shown what a lattice says of nearer places."""
MODES = 24
"""Modes of the field's uncertainty."""


@dataclass
class _Track:
    """A state, the mean misfit, and the logarithm of its likelihood so far."""

    state: MetalState
    ratio: float = 1.0
    likelihood: float = 0.0


class KnownMetalFollower:
    """Follows known metal by the tools alone.

    ``sensors`` are those of the rigid tools, ``noise_t`` is that of a phasor component of their
    readings, T.
    """

    def __init__(
        self,
        known: KnownMetal,
        model: FieldModel,
        excitation: Excitation,
        sensors: SensorTable,
        tools: ToolSettings,
        volume: TrackedVolume,
        noise_t: float,
    ) -> None:
        self.model = model
        self._scene = Scene(known, model, excitation, sensors, tools, noise_t)
        self._tools, self._known = tools, known
        self._places = places_around(volume, known)
        self._tracks: list[_Track] = []
        self._chosen: _Track | None = None
        self._since_ns = self._last_ns = self._searched_ns = 0
        self._step_s, self._near = 0.04, np.zeros((0, 3))

    @property
    def is_followed(self) -> bool:
        """Return whether the metal's place is known."""
        return self._chosen is not None

    @property
    def place(self) -> Array | None:
        """Return where the metal's middle is, m, shape (3,); None while that is not known."""
        return None if self._chosen is None else self._chosen.state.pose[:3]

    def at(self, stamp_ns: int) -> tuple[FieldModel, Withheld | None]:
        """Return the field model for a frame, and why it is none to give poses by."""
        seconds = self._seconds_to(stamp_ns)
        if self._chosen is None:
            return self.model, None
        state = predicted(self._chosen.state, seconds)
        growth = max(self._chosen.ratio, 1.0)
        model, placed = field_of(self._scene, state, self._near, MODES, growth)
        reason = ''
        if self._chosen.ratio > DOUBTFUL:
            reason = (
                f'{self._known.name} leaves {math.sqrt(self._chosen.ratio):.1f} times as much of '
                f'the readings as expected'
            )
        driven = placed.strongest_t() / self._known.strongest_t
        nearest = placed.nearest_m(Coils(self._near, np.zeros_like(self._near), None))
        if driven > STRONGER:
            reason = (
                f'{self._known.name} is driven {driven:.1f} times as strongly as it was learnt'
            )
        elif nearest < NEARER * self._known.nearest_m:
            reason = (
                f'a coil is {nearest * 1e3:.0f} mm from {self._known.name}, nearer than it was '
                f'learnt'
            )
        return model, Withheld(MODEL_DOUBTFUL, reason) if reason else None

    def take(
        self, stamp_ns: int, readings: Sequence[ToolReading], near: Array | None = None
    ) -> None:
        """Take in what rigid tools read in a frame, at poses that are near theirs.

        ``near`` (P, 3): where all coils are, m, those of no rigid tool among them; by default
        those that read.
        """
        seconds = self._seconds_to(stamp_ns)
        if not readings:
            return
        self._last_ns = stamp_ns
        if 0.0 < seconds < TRIAL_S:
            self._step_s = seconds
        if self._chosen is not None:
            self._advance(self._chosen, seconds, readings)
            if self._chosen.ratio > HOPELESS:
                self._forget()
        elif self._tracks:
            for track in self._tracks:
                self._advance(track, seconds, readings)
            if (stamp_ns - self._since_ns) * NANO > TRIAL_S:
                self._choose()
        elif (stamp_ns - self._searched_ns) * NANO > SEARCH_AGAIN_S:
            self._search(stamp_ns, readings)
        self._near = near_points(readings) if near is None else near

    def _seconds_to(self, stamp_ns: int) -> float:
        """Return the time since the last readings, and forget the metal where it is too long."""
        seconds = (stamp_ns - self._last_ns) * NANO
        if not 0.0 <= seconds < TRIAL_S:
            self._forget()
        return seconds

    def _forget(self) -> None:
        self._tracks, self._chosen, self._searched_ns = [], None, 0

    def _search(self, stamp_ns: int, readings: Sequence[ToolReading]) -> None:
        """Begin tracks where metal would explain the readings of the largest tool best."""
        self._searched_ns = self._since_ns = stamp_ns
        largest = max(readings, key=lambda reading: len(reading.table))
        starts, gain = likely_starts(self._scene, self._tools, largest, self._places, CANDIDATES)
        if gain < CERTAIN:
            return
        self._tracks = [_Track(self._scene.start(start)) for start in starts]
        for track in self._tracks:
            self._advance(track, 0.0, readings)

    def _advance(self, track: _Track, seconds: float, readings: Sequence[ToolReading]) -> None:
        state = predicted(track.state, seconds) if seconds > 0.0 else track.state
        keep = math.exp(-self._step_s / MISFIT_MEMORY_S)
        for reading in readings:
            outcome = updated(self._scene, state, reading, self._step_s)
            state = outcome.state
            track.likelihood += outcome.log_likelihood
            track.ratio = keep * track.ratio + (1.0 - keep) * outcome.ratio
        track.state = state

    def _choose(self) -> None:
        """Keep the best track, if no other place explains the readings as well."""
        best, *others = sorted(self._tracks, key=lambda track: -track.likelihood)
        self._tracks = []
        rival = any(
            track.likelihood > best.likelihood - CERTAIN
            and np.linalg.norm(track.state.pose[:3] - best.state.pose[:3]) > ELSEWHERE_M
            for track in others
        )
        if not rival and best.ratio < DOUBTFUL:
            self._chosen = best
