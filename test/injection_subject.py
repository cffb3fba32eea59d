"""What effects are put into: a session's arrays, and the two lists of what can be put in."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from anser_ros.diagnosis.problem import Problem, Spread, build_problem
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import Dipoles, FieldModel
from anser_ros.physics.pose_track import PoseTrack

NOISE_T = 60e-12
JITTER_M, JITTER_RAD = 0.07e-3, 0.4e-3
SIZES = {'small': 0.3, 'medium': 1.0, 'large': 3.0}
TRACK, TABLE, FIELD, EMITTER, CHANNEL, OFFSET, READING = range(7)
Truth = dict[str, dict[str, Any]]


@dataclass
class Subject:
    """A session's arrays, and what its fields are."""

    tool: Measurements
    reference: Measurements
    baseline: np.ndarray
    model: FieldModel
    drawn: FieldModel | None
    illumination: Dipoles

    def __post_init__(self) -> None:
        # Where the sensors truly are, whatever becomes of the optical track.
        self.rotation = self.tool.rotation
        self.centres, self.axes = self.tool.placed()
        self.field = self.model.dipoles
        self.omega = 2 * np.pi * np.asarray(self.model.frequencies_hz)
        self.time = self.tool.time
        self.clean = self.read(self.centres, self.axes)

    @property
    def sensors(self) -> int:
        """Number of the tool's channels."""
        return len(self.tool.sensors)

    @property
    def emitters(self) -> int:
        """Number of emitters."""
        return int(self.omega.size)

    def clusters(self) -> list[list[int]]:
        """Rows of the tool's sensors that share a centre."""
        place = self.tool.sensors.position
        near = np.linalg.norm(place[:, None] - place[None], axis=2) < 2e-3
        return [list(rows) for rows in {tuple(np.flatnonzero(row)) for row in near}]

    def read(self, centres: np.ndarray, axes: np.ndarray, length: float = 0.0) -> np.ndarray:
        """The model's flux at centres and axes of shape (F, ..., 3)."""
        flat = centres.reshape(-1, 3)
        lengths = np.full(len(flat), length) if length else None
        return self.field.flux(flat, axes.reshape(-1, 3), lengths).reshape(*centres.shape[:-1], -1)

    def flux(self, values: np.ndarray) -> None:
        """Give the tool other readings."""
        self.tool = replace(self.tool, flux=values)

    def references(self, values: np.ndarray) -> None:
        """Give the references other readings."""
        self.reference = replace(self.reference, flux=values)

    def channel(self, row: int | list[int] | np.ndarray, values: np.ndarray) -> None:
        """Give one or more channels of the tool other readings."""
        flux = self.tool.flux.copy()
        flux[:, row] = values
        self.flux(flux)

    def reference_channel(self, row: int, values: np.ndarray) -> None:
        """Give one reference other readings."""
        flux = self.reference.flux.copy()
        flux[:, row] = values
        self.references(flux)

    def emitter(self, coil: int, factor: np.ndarray) -> None:
        """Multiply one emitter's phasors by a factor for each frame, shape (F,)."""
        for body in ('tool', 'reference'):
            readings = getattr(self, body)
            flux = readings.flux.copy()
            own = np.interp(readings.time, self.time, factor)
            flux[:, :, coil] *= own[:, None]
            setattr(self, body, replace(readings, flux=flux))

    def mixed(self, matrix: np.ndarray) -> None:
        """Mix the emitters' phasors, row the tone that is read."""
        self.flux(self.tool.flux @ matrix.T)
        self.references(self.reference.flux @ matrix.T)

    def track(self, track: PoseTrack) -> None:
        """Give the tool another optical track."""
        position, rotation, valid = track.at(self.time, 0.25)
        self.tool = replace(
            self.tool, track=track, position=position, rotation=rotation, has_pose=valid
        )

    def problem(self) -> Problem:
        """Set up the diagnosis, as a session of these arrays would."""
        expected = float(np.hypot(NOISE_T, self.model.flux_error_t))
        return build_problem(
            (self.tool,), self.reference, self.baseline, self.model, self.drawn, Spread(expected)
        )


@dataclass(frozen=True)
class Injection:
    """One effect that can be put in."""

    name: str
    # Changes a subject, with a random generator and a relative size; returns the truth.
    put: Callable[[Subject, np.random.Generator, float], Truth]
    stage: int
    allowed: tuple[str, ...] = ()  # names beside the listed ones that describe it rightly


LISTED: dict[str, Injection] = {}
UNLISTED: dict[str, Injection] = {}


def listed(stage: int) -> Callable[..., Any]:
    def add(put: Any) -> Any:
        LISTED[put.__name__] = Injection(put.__name__, put, stage)
        return put

    return add


def unlisted(stage: int, *allowed: str) -> Callable[..., Any]:
    def add(put: Any) -> Any:
        name = put.__name__
        UNLISTED[name] = Injection(name, lambda *given: put(*given) or {}, stage, allowed)
        return put

    return add


def signed(rng: np.random.Generator, low: float, high: float) -> float:
    """Log-uniform size of either sign."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))) * rng.choice([-1, 1]))


def a_direction(rng: np.random.Generator) -> np.ndarray:
    way = rng.normal(size=3)
    return way / np.linalg.norm(way)


def a_moment(s: Subject, rng: np.random.Generator) -> float:
    """Some time well inside the session, s."""
    return float(s.time[0] + rng.uniform(0.2, 0.8) * (s.time[-1] - s.time[0]))


def a_channel(s: Subject, rng: np.random.Generator) -> tuple[int, int]:
    row = int(rng.integers(s.sensors))
    return row, int(s.tool.sensors.channel[row])


def turn_axes(s: Subject, rows: list[int], turn: np.ndarray) -> None:
    """Turn the axes of some rows in the body; ``turn`` is (3, 3) or (F, 3, 3)."""
    flux = s.tool.flux.copy()
    for row in rows:
        axes = s.rotation @ turn @ s.tool.sensors.axis[row]
        flux[:, row] += s.read(s.centres[:, row], axes) - s.clean[:, row]
    s.flux(flux)


def move_coils(s: Subject, rows: list[int], offset: np.ndarray) -> None:
    """Move some rows in the body, by (3,) or (F, 3)."""
    flux = s.tool.flux.copy()
    shift = np.einsum('fij,fj->fi', s.rotation, np.broadcast_to(offset, (s.time.size, 3)))
    for row in rows:
        flux[:, row] += s.read(s.centres[:, row] + shift, s.axes[:, row]) - s.clean[:, row]
    s.flux(flux)


def complex_normal(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    return rng.normal(size=shape) + 1j * rng.normal(size=shape)
