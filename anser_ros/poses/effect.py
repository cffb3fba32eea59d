"""Defines what an effect of a tracker of poses looks like: one interface, one file for each
effect.

A tracked pose is predicted from the optical one in this order::

    clock -> optical track -> optical pose -> hand-eye -> tracked pose

and what the tracker's own map of space does (a distortion) is undone on the measured side. The
effects are those of `anser_ros.effects` seen through another observation: position and rotation
instead of fluxes. `Term`, records, priors and costs of parameters are the same.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.effect import Effect
from anser_ros.effects.term import Site, Term
from anser_ros.field.model import EffectRecord
from anser_ros.poses.path import OpticalPath
from anser_ros.poses.sequence import PoseSession

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PoseSetting:
    """Holds what effects may know of a session before they are fitted.

    Attributes
    ----------
    sensors : tuple of str
    start, duration : float
        Time of the first tracked pose, and from it to the last, s.
    centre, size : ndarray (3,), float
        Middle of the tracked positions and their rms distance from it, m, tracker's frame.
    """

    sensors: tuple[str, ...]
    start: float
    duration: float
    centre: Array
    size: float


@dataclass(frozen=True)
class PoseView:
    """Holds predicted poses of one sensor, n of them, with what derivatives need.

    Attributes
    ----------
    sensor : str
    time : ndarray, shape (n,)
        Stamps of the tracked poses, s.
    measured : ndarray, shape (n, 3)
        Tracked positions as they were reported, m, tracker's frame.
    measured_rotation : ndarray, shape (n, 3, 3)
        The rotations that were reported with them.
    optical, turn : ndarray, shapes (n, 3) and (n, 3, 3)
        The body in the optical frame at these times: place (m) and rotation.
    frame : ndarray, shape (3, 3)
        Rotation from the optical frame to the tracker's.
    lever : ndarray, shape (3,)
        The sensor in the body's frame, m.
    position, rotation : ndarray, shapes (n, 3) and (n, 3, 3)
        Predicted pose in the tracker's frame.
    velocity : ndarray, shape (n, 6)
        Of the predicted pose, m/s and rad/s, along the axes of the tracker's frame.
    """

    sensor: str
    time: Array
    measured: Array
    measured_rotation: Array
    optical: Array
    turn: Array
    frame: Array
    lever: Array
    position: Array
    rotation: Array
    velocity: Array


class Role(Enum):
    """Names what an effect is to the others, who ask for this and for no effect by its name."""

    PLAIN = 'plain'
    REGISTRATION = 'frame of the reference'
    """Where the reference's frame lies in the tracker's; in every fit, and no error."""
    MOUNT = 'frame of a sensor'
    """Where and how a sensor sits on the body; in every fit, and no error. Records
    both frames."""
    OFFSET = 'offset'
    """Moves the times of poses by a constant; every fit starts with it."""
    RATE = 'rate'
    """Moves the times of poses by a share of the time."""
    READING = 'reading'
    """Another convention than a stream states, by which it is read before anything is fitted."""
    SWAP = 'swap'
    """Sensors under each other's names, which are put back before anything is searched for."""
    FILTER = 'filter'
    """A low pass with a time constant: no slopes, tried at some of them when the rest is found."""
    SCALE = 'scale'
    """One scale of all positions, which is a part of a map."""
    MAP = 'map'
    """A map of the places, that a map of a higher degree contains."""

    @property
    def is_frame(self) -> bool:
        """Return whether it is one of the two unknown frames, which are no effects."""
        return self in (Role.REGISTRATION, Role.MOUNT)

    @property
    def is_clock(self) -> bool:
        """Return whether it moves times.

        Such an effect is found before a filter is judged, whose first order is a delay.
        """
        return self in (Role.OFFSET, Role.RATE)

    @property
    def moves_times(self) -> bool:
        """Return whether it is a clock or a filter, which is a delay to first order."""
        return self.is_clock or self is Role.FILTER


@dataclass(frozen=True)
class Frames:
    """Holds the two frames between the reference and one sensor.

    Attributes
    ----------
    rotation, translation : ndarray, shapes (3, 3) and (3,)
        From the optical frame to the tracker's; m.
    mount : ndarray, shape (3, 3)
        Rotation from the sensor's frame to the body's.
    lever : ndarray, shape (3,)
        The sensor in the body's frame, m.
    """

    rotation: Array
    translation: Array
    mount: Array
    lever: Array


PoseMap = Callable[[str, Array], tuple[Array, float]]
"""What a model adds to the position (3,), m, of a sensor of that name, and its variance, m^2."""


class PoseEffect(Effect[Term]):
    """Changes nothing; it is the base of the effects on poses."""

    role = Role.PLAIN
    advice = ''
    """What somebody at the tracker can do about it, in a sentence."""
    blocks_in_space = False
    """Whether blocks of space and not of time decide on it."""
    needs_levers = False
    """Whether it is seen only where the motion determines a lever arm: one that is not known,
    times turns that go with place or velocity, makes what looks like it."""
    makes_jitter = False
    """Whether poses that jitter more than before are explained by it."""

    def sites(self, setting: PoseSetting) -> Sequence[Term]:
        """Return the effect at every site where it may sit, with parameters of zero."""
        return ()

    def slopes(self, term: Term, view: PoseView) -> Array | None:
        """Return the derivative of predicted less measured pose by the parameters, shape (n, 6,
        q).

        Rows are m and rad along the axes of the tracker's frame; None where it does nothing.
        """
        return None

    def clock(self, term: Term, sensor: str, time: Array) -> Array:
        """Return the times on the optical clock, s, at which a sensor's poses apply."""
        return time

    def at_frame(self, site: Site, place: Array, turn: Array) -> Term:
        """Return a frame at a place (3,), m, with a rotation (3, 3)."""
        raise NotImplementedError

    def framed(self, term: Term, sensor: str, frames: Frames) -> Frames:
        """Return the frames of a sensor with the one that the term holds."""
        return frames

    def moved(self, before: Term, after: Term, middle: Array) -> EffectRecord:
        """Return the record of a frame that has changed; ``middle`` (3,) is where the body is, m,
        optical frame.
        """
        raise NotImplementedError

    def filter(self, term: Term, path: OpticalPath) -> OpticalPath:
        """Return the body's path as a tracker that filters sees it."""
        return path

    def seen(self, term: Term, position: Array) -> Array:
        """Return optical positions (n, 3) at the tracker's scale, m."""
        return position

    def corrected(
        self, term: Term, sensor: str, position: Array, rotation: Array
    ) -> tuple[Array, Array]:
        """Return tracked poses, (n, 3) m and (n, 3, 3), without what the effect does to them."""
        return position, rotation

    def seen_at(
        self, record: EffectRecord, term: Term, covariance: Array, views: Sequence[PoseView]
    ) -> EffectRecord:
        """Return the record of a fitted term with what it amounts to at the poses of a session."""
        return record

    def observed(self, residuals: 'PoseResiduals') -> Sequence[EffectRecord]:
        """Return what is seen of the effect without a fit; nothing where parameters are fitted."""
        return ()

    def frozen(self, session: PoseSession) -> Sequence[EffectRecord]:
        """Return streams that have stopped while others go on, each with its ``since_s``."""
        return ()

    def noisier(self, factor: float) -> Sequence[EffectRecord]:
        """Return what is said where poses jitter so many times as much as when a watch began."""
        return ()

    def mapping(self, record: EffectRecord) -> PoseMap | None:
        """Return the map of a record, which a corrector applies; None for other effects."""
        return None

    def beside_scale(self, term: Term) -> Term | None:
        """Return what is left of a term beside one scale of all sensors; None where nothing is."""
        return term

    def whole(self, term: Term) -> Term | None:
        """Return a map with what it lacks beside a scale, with parameters of zero; None for a
        term that lacks nothing.
        """
        return None

    def is_scale(self, term: Term) -> bool:
        """Return whether a term is one scale, of a sensor or of all."""
        return False

    def rival(self, term: Term) -> Term:
        """Return a filter's smoothing without its delay: what a noisy reference asks for."""
        return term

    def sensor_of(self, term: Term) -> str | None:
        """Return the only sensor that a term is about; None where it is about all of them."""
        name = term.site.get('sensor')
        return None if name is None else str(name)

    def acts_on(self, term: Term, sensor: str) -> bool:
        """Return whether a term is about a sensor."""
        return self.sensor_of(term) in (None, sensor)


@dataclass(frozen=True)
class Sensing:
    """Holds what one sensor shows once the frames and effects are fitted.

    Attributes
    ----------
    view : PoseView
    residual : ndarray, shape (n, 6)
        Measured less predicted, m and rad, tracker's frame.
    used : ndarray of bool, shape (n,)
        Poses that have a reference and do not stand out.
    out : ndarray of bool, shape (n,)
        Poses that have a reference and stand out.
    position_m, orientation_rad, stamp_s : float
        The noise that is left, a coordinate, and of the stamps.
    stamp_gain : float
        Minus twice the log likelihood that an error of the stamps takes off.
    """

    view: PoseView
    residual: Array
    used: NDArray[np.bool_]
    out: NDArray[np.bool_]
    position_m: float
    orientation_rad: float
    stamp_s: float
    stamp_gain: float


@dataclass(frozen=True)
class PoseResiduals:
    """Holds a session and what its fit leaves, where effects without a parameter to fit are seen.

    Attributes
    ----------
    session : PoseSession
    setting : PoseSetting
    sensors : tuple of Sensing
    blocks : tuple of ndarray of int, one per sensor
        Block of time of each pose.
    """

    session: PoseSession
    setting: PoseSetting
    sensors: tuple[Sensing, ...]
    blocks: tuple[NDArray[np.int64], ...]


def effect_of(term: Term) -> PoseEffect:
    """Return the effect that a term of poses belongs to."""
    assert isinstance(term.effect, PoseEffect)
    return term.effect


def frames_of(terms: Sequence[Term], sensor: str) -> Frames:
    """Return the frames of a sensor that some terms hold; the identity where they hold none."""
    frames = Frames(np.eye(3), np.zeros(3), np.eye(3), np.zeros(3))
    for term in terms:
        frames = effect_of(term).framed(term, sensor, frames)
    return frames


def is_of(term: Term, role: Role) -> bool:
    """Return whether the effect of a term has a role."""
    return effect_of(term).role is role
