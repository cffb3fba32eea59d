"""Follows known metal through a recorded session, by its tools, and gives every frame the field
model with it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from anser_ros.apps.lab import metal_track
from anser_ros.apps.lab.metal_lattice import Coils, KnownMetal
from anser_ros.apps.lab.metal_learning import real_parts
from anser_ros.arrays import Array
from anser_ros.chain.frame import Answer, ChainFrame
from anser_ros.chain.model_half import poses_of, tool_readings
from anser_ros.errors import BagError, ModelFileError
from anser_ros.field.model import FieldModel
from anser_ros.physics.volume import TrackedVolume
from anser_ros.pose_states import MODEL_DOUBTFUL, Withheld
from anser_ros.refit.clouds import excitation_for
from anser_ros.refit.witness import ToolReading, coil_spread, linearised
from anser_ros.sessions.follower import FrameModels, RefitSummary
from anser_ros.sessions.nominal_board import stated_volume
from anser_ros.sessions.prepared import PreparedSession, settings_for
from anser_ros.sessions.session import tracking_noise
from anser_ros.stamps import NANO
from anser_ros.tracking.estimate import PoseEstimate, TrackerSettings
from anser_ros.tracking.tracker import Tracker

SPACING_M = 0.08
"""Of the places that are tried: about what a track finds back from."""
APART_M = 0.15
"""Distance of starts from each other, m: two that are nearer lead to the same place."""
AT_ONCE = 64
"""Places that are worked out at once."""
BEYOND_M = 0.4
"""How far beyond the places where it was learnt the metal is looked for, m: what was below the
emitters may be further below or beside them, and hardly stands over the patient."""


def places_around(volume: TrackedVolume, known: KnownMetal) -> Array:
    """Return places (P, 3), m, where known metal is looked for, all of it outside a volume."""
    ends = zip(known.low - BEYOND_M, known.high + BEYOND_M, strict=True)
    sides = [np.arange(a, b, SPACING_M) for a, b in ends]
    places = np.stack(np.meshgrid(*sides, indexing='ij'), -1).reshape(-1, 3)
    low, high = np.array(volume.low), np.array(volume.high)
    at = places[:, None] + known.lattice.points
    inside = np.asarray(((at > low) & (at < high)).all(axis=2)).any(axis=1)
    return np.asarray(places[~inside])


def likely_starts(
    scene: metal_track.Scene, reading: ToolReading, places: Array, most: int
) -> tuple[list[Array], float]:
    """Return poses (6,) of the metal that explain a tool's readings best, the best first, apart,
    and the logarithm of how much more likely the first makes the readings than no metal does.

    ``reading``: at a pose that is right to some centimetres. ``places`` (P, 3): to be tried, m.
    """
    sigma = coil_spread(len(reading.table), scene.tools)
    # What a pose that is off leaves beyond the first order would be taken for metal.
    reading = metal_track.posed(scene, scene.model, reading, 0.0 * sigma, np.diag(sigma**2))
    rows = linearised(reading, scene.model, scene.model.moments, scene.turn)
    own = real_parts(rows.own) * sigma
    pose = real_parts(rows.pose)
    spread = pose @ pose.T + own @ own.T
    spread[np.diag_indices(len(spread))] += scene.noise**2
    factor = np.linalg.cholesky(spread)
    left = solve_triangular(factor, real_parts(rows.left), lower=True)
    coils = Coils(rows.at, rows.axes, reading.table.length)
    found = []
    turns = np.broadcast_to(scene.known.turn, places.shape)
    for poses in np.array_split(
        np.concatenate([places, turns], axis=1), -(-len(places) // AT_ONCE)
    ):
        fluxes = scene.setting.fluxes(scene.known.lattice, poses, coils)
        flat = np.array([real_parts(flux.ravel()) for flux in fluxes]).T / scene.noise_t
        by = solve_triangular(factor, flat, lower=True)
        # The misfit makes a strong reading of the wrong place less certain than it looks.
        power = ((left[:, None] - by) ** 2).sum(axis=0)
        power /= 1.0 + scene.misfit**2 * (by**2).mean(axis=0)
        found += list(zip(power.tolist(), poses, strict=True))
    found.sort(key=lambda one: one[0])
    starts: list[Array] = []
    for _, at in found:
        if all(np.linalg.norm(at[:3] - other[:3]) > APART_M for other in starts):
            starts.append(at)
        if len(starts) == most:
            break
    return starts, 0.5 * (float(left @ left) - found[0][0])


CANDIDATES = 4
"""Tracks that are followed at once until one is chosen."""
TRIAL_S, SEARCH_AGAIN_S = 1.0, 1.0
"""How long they are followed, which is also the longest time without readings for which metal is
still known to be there, and how long a search that found nothing is not repeated."""
CERTAIN = 10.0
"""Log likelihood of the chosen one over that of no metal, or of metal `ELSEWHERE_M` away."""
ELSEWHERE_M = 0.04
"""Distance from which on two tracks are of different places, m."""
DOUBTFUL, HOPELESS = 3.0, 9.0
"""Squared misfit, over the expected one, at which no pose is given, and the track is given up."""
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

    state: metal_track.MetalState
    ratio: float = 1.0
    likelihood: float = 0.0


class KnownMetalFollower:
    """Follows the known metal of a scene by the tools alone, outside the tracked volume."""

    def __init__(self, scene: metal_track.Scene, volume: TrackedVolume) -> None:
        self.model, self._scene = scene.model, scene
        self._places = places_around(volume, scene.known)
        self._tracks: list[_Track] = []
        self._chosen: _Track | None = None
        self._since_ns = self._last_ns = self._searched_ns = 0
        self._step_s, self._near = 0.04, np.zeros((0, 3))

    @property
    def is_followed(self) -> bool:
        """Return whether the metal's place is known."""
        return self._chosen is not None

    def at(self, stamp_ns: int) -> tuple[FieldModel, Withheld | None]:
        """Return the field model for a frame, and why it is none to give poses by."""
        seconds = self._seconds_to(stamp_ns)
        if self._chosen is None:
            return self.model, None
        state = metal_track.predicted(self._chosen.state, seconds)
        growth = max(self._chosen.ratio, 1.0)
        model, placed = metal_track.field_of(self._scene, state, self._near, MODES, growth)
        reason, known = '', self._scene.known
        driven = placed.strongest_t() / known.strongest_t
        nearest = placed.nearest_m(Coils(self._near, np.zeros_like(self._near), None))
        if driven > STRONGER:
            reason = f'{known.name} is driven {driven:.1f} times as strongly as it was learnt'
        elif nearest < NEARER * known.nearest_m:
            where = f'{nearest * 1e3:.0f} mm from {known.name}'
            reason = f'a coil is {where}, nearer than it was learnt'
        elif self._chosen.ratio > DOUBTFUL:
            times = math.sqrt(self._chosen.ratio)
            reason = f'{known.name} leaves {times:.1f} times as much of the readings as expected'
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
        self._near = metal_track.near_points(readings) if near is None else near

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
        starts, gain = likely_starts(self._scene, largest, self._places, CANDIDATES)
        if gain < CERTAIN:
            return
        self._tracks = [_Track(self._scene.start(start)) for start in starts]
        for track in self._tracks:
            self._advance(track, 0.0, readings)

    def _advance(self, track: _Track, seconds: float, readings: Sequence[ToolReading]) -> None:
        state = metal_track.predicted(track.state, seconds) if seconds > 0.0 else track.state
        keep = math.exp(-self._step_s / MISFIT_MEMORY_S)
        for reading in readings:
            outcome = metal_track.updated(self._scene, state, reading, self._step_s)
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


FOLLOWED, SEARCHED = 'followed', 'not_found'
"""States in the summary."""


class KnownMetalModels(FrameModels):
    """Gives each frame of a session the field with known metal where its tools say that it is.

    The ``summary`` counts the frames in which the metal was followed. Raises `BagError` when the
    session has no tool fluxes; `ModelFileError` when the metal was learnt at other frequencies
    than the emitters'.
    """

    def __init__(self, prepared: PreparedSession, known: KnownMetal) -> None:
        session = prepared.session
        if not session.tools:
            raise BagError(f'{session.path}: known metal is followed by tools, there are none')
        mean_hz = float(np.exp(np.log(prepared.model.frequencies_hz).mean()))
        if not 0.5 < mean_hz / known.lattice.frequency_hz < 2.0:
            raise ModelFileError(
                f'{known.name} was learnt at {known.lattice.frequency_hz:.0f} Hz, the emitters '
                f'have {mean_hz:.0f} Hz'
            )
        excitation, _ = excitation_for(
            prepared.model, prepared.nominal.field, stated_volume(session.setup)
        )
        self._correction = prepared.correction
        scene = metal_track.Scene(
            known, prepared.model, excitation, self._correction.sensors(),
            session.setup.refit.tools, tracking_noise(session.setup),
        )  # fmt: skip
        self._follower = KnownMetalFollower(scene, prepared.volume)
        # Where a pose is withheld, a tracker that withholds none shows where the tool is, nearly.
        settings = settings_for(session.setup, TrackerSettings(gate=math.inf))
        self._rough = Tracker(
            prepared.model, prepared.sensors, replace(settings, volume=prepared.volume)
        )
        self._stamp_ns = 0
        self.summary = RefitSummary()

    def step(self, frame: ChainFrame) -> Answer:
        """Return what a frame is tracked with."""
        self._stamp_ns = frame.stamp_ns
        model, withheld = self._follower.at(frame.stamp_ns)
        self.summary.states[FOLLOWED if self._follower.is_followed else SEARCHED] += 1
        if model is not self._rough.model:
            self._rough = self._rough.with_model(model)
        return Answer(frame.stamp_ns, model, withheld=withheld)

    def witnessed(self, frame: ChainFrame, found: Sequence[PoseEstimate]) -> None:
        """Take in what a frame's tools read, at poses near theirs."""
        if (tools := frame.tools) is None:
            return
        rough = self._rough.update(self._stamp_ns, tools.channels, tools.flux, tools.flags)
        poses = poses_of((*rough, *found))
        at = [one.position for one in rough if np.isfinite(one.position).all()]
        self._follower.take(
            self._stamp_ns,
            tool_readings(self._correction, tools, poses),
            np.array(at) if at else None,
        )
