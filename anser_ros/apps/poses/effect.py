"""Defines what an effect of a tracker of poses looks like: one interface, one file for each.

A tracked pose is predicted from the optical one: clock, optical path, optical pose, hand-eye. What
the tracker's own map of space does (a distortion) is undone on the measured side.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cache
from typing import TYPE_CHECKING, Literal, TypedDict

import numpy as np

import anser_ros.apps.poses.effects as package
from anser_ros.apps.poses.sequence import OpticalPath, PoseSession
from anser_ros.arrays import Array
from anser_ros.effects.base import BaseEffect, BaseTerm
from anser_ros.effects.effect import effects_in, sigmas
from anser_ros.field.model import EffectRecord

if TYPE_CHECKING:
    from anser_ros.apps.poses.problem import PoseResiduals


SMOOTH = 'smooth'
"""The kind of a map of places that is determined by the points that it was learnt from."""


class PoseSite(TypedDict, total=False):
    """States where an effect acts, in the words of records and reports."""

    sensor: str  # name of a sensor; all of them where there is none
    degree: int  # of a map's polynomial
    lowest: int  # lowest degree in it
    is_equal: Literal[True]  # a map beside a scale, which has what is alike along all axes
    centre_m: list[float]  # where the polynomial's coordinates are zero, frame of the tracker
    size_m: float  # what they are divided by
    middle_s: float  # time at which a clock's offset is its offset
    two_sided: Literal[True]  # a filter that looks ahead as far as back


@dataclass(frozen=True)
class PoseSetting:
    """Holds what effects may know of a session before they are fitted."""

    sensors: tuple[str, ...]
    start: float  # time of the first tracked pose, s
    duration: float  # from it to the last, s
    centre: Array  # (3,), middle of the tracked positions, m, tracker's frame
    size: float  # their rms distance from it, m


@dataclass(frozen=True)
class PoseView:
    """Holds predicted poses of one sensor, n of them, with what derivatives need."""

    sensor: str
    time: Array  # (n,), stamps of the tracked poses, s
    measured: Array  # (n, 3), tracked positions as they were reported, m, tracker's frame
    measured_rotation: Array  # (n, 3, 3), reported with them
    optical: Array  # (n, 3), place of the body in the optical frame, m
    turn: Array  # (n, 3, 3), its rotation there
    frame: Array  # (3, 3), rotation from the optical frame to the tracker's
    lever: Array  # (3,), the sensor in the body's frame, m
    position: Array  # (n, 3), predicted, m, tracker's frame
    rotation: Array  # (n, 3, 3), predicted
    velocity: Array  # (n, 6), of the prediction, m/s and rad/s along the tracker's axes


class Role(Enum):
    """Names what an effect is to the others, who ask for this and for no effect by its name."""

    PLAIN = 'plain'
    REGISTRATION = 'frame of the reference'  # in the tracker's; in every fit, and no error
    MOUNT = 'frame of a sensor'  # on the body; in every fit, and no error; records both frames
    OFFSET = 'offset'  # moves the times of poses by a constant; every fit starts with it
    RATE = 'rate'  # moves the times of poses by a share of the time
    READING = 'reading'  # another convention than stated, undone before anything is fitted
    SWAP = 'swap'  # sensors under each other's names, undone before anything is searched for
    FILTER = 'filter'  # a low pass: has no slopes, and is tried when the rest is found
    SCALE = 'scale'  # one scale of all positions, which is a part of a map
    MAP = 'map'  # of the places; a map of a higher degree contains it

    @property
    def is_frame(self) -> bool:
        """Return whether it is one of the two unknown frames, which are no effects."""
        return self in (Role.REGISTRATION, Role.MOUNT)

    @property
    def is_clock(self) -> bool:
        """Return whether it moves times: found before a filter, whose first order is a delay."""
        return self in (Role.OFFSET, Role.RATE)


@dataclass(frozen=True)
class Frames:
    """Holds the two frames between the reference and one sensor."""

    rotation: Array  # (3, 3), from the optical frame to the tracker's
    translation: Array  # (3,), m
    mount: Array  # (3, 3), rotation from the sensor's frame to the body's
    lever: Array  # (3,), the sensor in the body's frame, m


PoseMap = Callable[[str, Array, Array], tuple[Array, float]]
"""What a model adds to the position (3,), m, of a sensor of that name with a rotation (3, 3), and
its variance a coordinate, m^2."""


@dataclass(frozen=True)
class PoseTerm(BaseTerm):
    """Holds an effect on the poses of one sensor, or of all, with values of its parameters."""

    effect: 'PoseEffect'
    site: PoseSite = field(default_factory=lambda: PoseSite())

    @property
    def role(self) -> Role:
        """Return what its effect is to the others."""
        return self.effect.role

    @property
    def sensor(self) -> str | None:
        """Return the only sensor that it is about; None where it is about all of them."""
        name = self.site.get('sensor')
        return None if name is None else str(name)

    @property
    def is_beside_scale(self) -> bool:
        """Return whether it is a map beside a scale, which has what is alike along all axes."""
        return 'is_equal' in self.site

    @property
    def middle_s(self) -> float:
        """Return the time at which a clock's offset is its offset, s."""
        return float(self.site.get('middle_s', 0.0))

    def acts_on(self, sensor: str) -> bool:
        """Return whether it is about a sensor."""
        return self.sensor in (None, sensor)


class PoseEffect(BaseEffect[PoseTerm]):
    """Changes nothing; it is the base of the effects on poses."""

    role = Role.PLAIN
    advice = ''
    """What somebody at the tracker can do about it, in a sentence."""
    blocks_in_space = False
    """Whether blocks of space and not of time decide on it."""
    needs_levers = False
    """Whether it is seen only where the motion determines a lever arm: one that is not known,
    times turns that go with place or velocity, makes what looks like it."""
    is_stiff = False
    """Whether it is a map that follows hardly anything else, so that less of it is named."""
    makes_jitter = False
    """Whether poses that jitter more than before are explained by it."""

    @property
    def words(self) -> dict[str, object]:
        """Return what it is and what to do, for the evidence of its records."""
        return {'summary': self.summary, 'advice': self.advice}

    def sites(self, setting: PoseSetting) -> Sequence[PoseTerm]:
        """Return the effect at every site where it may sit, with parameters of zero."""
        return ()

    def slopes(self, term: PoseTerm, view: PoseView) -> Array | None:
        """Return slopes (n, 6, q) of predicted less measured pose; None where it does nothing.

        Rows are m and rad along the axes of the tracker's frame.
        """
        return None

    def clock(self, term: PoseTerm, sensor: str, time: Array) -> Array:
        """Return the times on the optical clock, s, at which a sensor's poses apply."""
        return time

    def at_frame(self, site: PoseSite, place: Array, turn: Array) -> PoseTerm:
        """Return a frame at a place (3,), m, with a rotation (3, 3)."""
        raise NotImplementedError

    def framed(self, term: PoseTerm, sensor: str, frames: Frames) -> Frames:
        """Return the frames of a sensor with the one that the term holds."""
        return frames

    def moved(self, before: PoseTerm, after: PoseTerm, middle: Array) -> EffectRecord:
        """Return the record of a changed frame; ``middle`` (3,), m: the body's optical place."""
        raise NotImplementedError

    def filter(self, term: PoseTerm, path: OpticalPath) -> OpticalPath:
        """Return the body's path as a tracker that filters sees it."""
        return path

    def seen(self, term: PoseTerm, position: Array) -> Array:
        """Return optical positions (n, 3) at the tracker's scale, m."""
        return position

    def corrected(self, term: PoseTerm, sensor: str, position: Array, rotation: Array) -> Array:
        """Return tracked positions (n, 3), m, with rotations (n, 3, 3), without the effect."""
        return position

    def seen_at(
        self, record: EffectRecord, term: PoseTerm, covariance: Array, views: Sequence[PoseView]
    ) -> EffectRecord:
        """Return the record of a fitted term with what it amounts to at the poses of a session."""
        return record

    def observed(self, residuals: 'PoseResiduals') -> Sequence[EffectRecord]:
        """Return what is seen of the effect without a fit; nothing where parameters are fitted."""
        return ()

    def frozen(self, session: PoseSession) -> Sequence[EffectRecord]:
        """Return streams that have stopped while others go on, each with its ``since_s``."""
        return ()

    def more_jitter(self, factor: float) -> Sequence[EffectRecord]:
        """Return what is reported where poses jitter so many times as when a watch began."""
        return ()

    def mapping(self, record: EffectRecord) -> PoseMap | None:
        """Return the map of a record, which a corrector applies; None for other effects."""
        return None

    def beside_scale(self, term: PoseTerm, is_scaled: bool = True) -> PoseTerm:
        """Return what is left of a term beside one scale of all sensors, or without that."""
        return term

    def is_scale(self, term: PoseTerm) -> bool:
        """Return whether a term is one scale, of a sensor or of all."""
        return False

    def rival(self, term: PoseTerm) -> PoseTerm:
        """Return a filter's smoothing without its delay: what a noisy reference asks for."""
        return term


class NumberEffect(PoseEffect):
    """Changes poses by one number, theta, which a record holds as ``base + factor * theta``."""

    key = ''
    base, factor = 0.0, 1.0

    def record(self, term: PoseTerm, covariance: Array) -> EffectRecord:
        """Return the number and its standard deviation, and the term's site."""
        sigma = self.factor * float(sigmas(covariance)[0])
        value = self.base + self.factor * float(term.theta[0])
        return EffectRecord(self.name, {**term.site, self.key: value}, {self.key: sigma})


def frames_of(terms: Sequence[PoseTerm], sensor: str) -> Frames:
    """Return the frames of a sensor that some terms hold; the identity where they hold none."""
    frames = Frames(np.eye(3), np.zeros(3), np.eye(3), np.zeros(3))
    for term in terms:
        frames = term.effect.framed(term, sensor, frames)
    return frames


@cache
def pose_effects() -> dict[str, PoseEffect]:
    """Return every effect on poses by its name, in alphabetical order."""
    return effects_in(package)


@cache
def effect_with(role: Role) -> PoseEffect:
    """Return the effect that has a role."""
    return next(effect for effect in pose_effects().values() if effect.role is role)


def effect_of_record(record: EffectRecord) -> PoseEffect:
    """Return the effect of a record; one that changes nothing where none has its name."""
    return pose_effects().get(record.name, PoseEffect())
