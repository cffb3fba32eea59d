"""The tracker's map of space is bent: a smooth function of the tracked place, for a sensor."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import combinations_with_replacement
from typing import cast

import numpy as np

from anser_ros.apps.poses.effect import (
    SMOOTH,
    PoseEffect,
    PoseMap,
    PoseSetting,
    PoseSite,
    PoseTerm,
    PoseView,
    Role,
)
from anser_ros.arrays import Array, Integers
from anser_ros.calibration.error_map import PositionMap, Shape
from anser_ros.effects.base import Remedy
from anser_ros.effects.effect import sigmas
from anser_ros.errors import ModelFileError
from anser_ros.field.model import EffectRecord

KINDS = {0: 'scale', 1: 'linear', 2: 'quadratic', 3: 'cubic'}
"""Degrees of the polynomials of position that are tried; of degree zero is a space that shrinks or
grows alike in all directions about a point of its own, which takes four numbers."""
UNIT_M = 1e-3
"""Unit of theta, m: a coefficient is what it moves a pose at the rms distance from the middle."""


def _smooth_map(record: EffectRecord) -> PositionMap:
    """The map of a record: what is added to tracked positions."""
    places, errors = (
        np.asarray(record.needed(key), dtype=np.float64).reshape(-1, 3)
        for key in ('places_m', 'errors_m')
    )
    trend, length, noise = (record.needed(key) for key in ('trend', 'length_m', 'noise'))
    return PositionMap(places, errors, Shape(int(trend), float(length), float(noise)))


def monomials(position: Array, centre: Array, size: float, degree: int, lowest: int = 1) -> Array:
    """Return products of coordinates of positions (n, 3) about a centre, from ``lowest`` on."""
    scaled = (position - centre) / size
    columns = [np.prod(scaled[:, _factors(order)], axis=2) for order in range(lowest, degree + 1)]
    return np.concatenate(columns, axis=1)


@cache
def _factors(order: int) -> Integers:
    """Coordinates that are multiplied for each monomial of an order, shape (m, order)."""
    return np.array(list(combinations_with_replacement(range(3), order)), dtype=np.int64)


def _lowest(site: PoseSite) -> int:
    """The lowest degree of a map's monomials.

    What shifts all sensors alike is the registration's. What shifts one is its map's: left out, it
    would move the frames, and with them the lever arms of the others.
    """
    return int(site.get('lowest', 0 if 'sensor' in site else 1))


def _count(site: PoseSite) -> int:
    """The number of a map's monomials."""
    basis = monomials(np.zeros((1, 3)), np.zeros(3), 1.0, site['degree'], _lowest(site))
    return int(basis.shape[1])


def _without_turn(term: PoseTerm) -> Array:
    """Return a map's coefficients without the turn in their linear part.

    A turn bends nothing: it is a registration of places that differs from that of rotations. A
    body that turns about one axis hardly distinguishes them.
    """
    bent = term.theta.reshape(-1, 3).copy()
    linear = slice(1 - _lowest(term.site), 4 - _lowest(term.site))
    if _lowest(term.site) <= 1:
        bent[linear] = 0.5 * (bent[linear] + bent[linear].T)
    return bent.ravel()


def _apart(term: PoseTerm, views: Sequence[PoseView]) -> dict[str, float]:
    """How far a map's only sensor is from the field generator, m, and how its z axis is tilted,
    deg, and the same of the others, which have no such map.
    """
    found = {}
    for key in ('own', 'others') if term.sensor and len(views) > 1 else ():
        chosen = [v for v in views if term.acts_on(v.sensor) == (key == 'own')]
        far = np.linalg.norm(np.concatenate([v.measured for v in chosen]), axis=1)
        upright = np.median(np.concatenate([v.measured_rotation[:, 2, 2] for v in chosen]))
        found[f'distance_{key}_m'] = float(np.median(far))
        found[f'tilt_{key}_deg'] = float(np.rad2deg(np.arccos(upright)))
    return found


class FieldDistortion(PoseEffect):
    """Theta is a vector (mm) a monomial: what is added to the tracked position."""

    name = 'field_distortion'
    summary = "the tracker's map of space is bent: metal at rest, or its field model"
    advice = 'Take metal out of the volume and from the field generator, or apply the map.'
    units = {'rms_m': 'm'}
    plausible = {'strain': (0.0, 0.2)}
    remedy = Remedy.SENSORS
    blocks_in_space = True
    role = Role.MAP
    typical = 5.0  # mm at the rms distance

    def sites(self, setting: PoseSetting) -> Sequence[PoseTerm]:
        alone = setting.sensors if len(setting.sensors) > 1 else ()
        # One scale of all sensors is the reference's as well as the tracker's.
        return [
            self.at(setting, degree, s)
            for degree in KINDS
            for s in (None, *alone)
            if degree > 0 or s is not None
        ]

    def at(self, setting: PoseSetting, degree: int, sensor: str | None) -> PoseTerm:
        """Return the effect of a degree on one sensor, or on all."""
        own: PoseSite = {} if sensor is None else {'sensor': sensor}
        site: PoseSite = {
            **own, 'degree': degree, 'centre_m': setting.centre.tolist(), 'size_m': setting.size,
        }  # fmt: skip
        if degree == 0:
            return PoseTerm(self, site, np.zeros(4))
        return PoseTerm(self, site, np.zeros(3 * _count(site)))

    def beside_scale(self, term: PoseTerm) -> PoseTerm:
        """Return a map of all sensors that stretches space by as much as it shrinks it."""
        return term if term.sensor else replace(term, site={**term.site, 'is_equal': True})

    def is_scale(self, term: PoseTerm) -> bool:
        return int(term.site['degree']) == 0

    def covers(self, term: PoseTerm, candidate: PoseTerm) -> bool:
        """Return whether the map contains what a scale, or a map of a lower degree, is."""
        own, site = term.site, candidate.site
        is_part = candidate.role is Role.MAP
        if not (is_part or (candidate.role is Role.SCALE and 'is_equal' not in own)):
            return False
        if term.sensor not in (None, candidate.sensor):
            return False
        has_lowest = own.get('lowest', 1) <= site.get('lowest', 1)
        return bool(has_lowest and own['degree'] >= site.get('degree', 1))

    def _derivative(self, term: PoseTerm, position: Array) -> Array:
        """What each parameter moves positions (n, 3) by, shape (n, 3, q), m."""
        centre, size = np.asarray(term.site['centre_m']), term.site['size_m']
        degree = term.site['degree']
        if degree == 0:
            away = ((position - centre) / size)[:, :, None]
            shift = np.broadcast_to(np.eye(3), (len(position), 3, 3))
            return UNIT_M * np.concatenate([away, shift], axis=2)
        basis = monomials(position, centre, size, degree, _lowest(term.site))
        out = np.zeros((len(position), 3, term.theta.size))
        for axis in range(3):
            out[:, axis, axis::3] = UNIT_M * basis
        if 'is_equal' in term.site:
            out[:, :, :9:4] -= out[:, :, :9:4].mean(axis=2, keepdims=True)
        return out

    def slopes(self, term: PoseTerm, view: PoseView) -> Array | None:
        """Return minus what it adds to the tracked positions."""
        if not term.acts_on(view.sensor):
            return None
        out = np.zeros((view.time.size, 6, term.theta.size))
        out[:, :3] = -self._derivative(term, view.measured)
        return out

    def shift(self, term: PoseTerm, position: Array) -> Array:
        """Return what is added to tracked positions (n, 3), m."""
        return self._derivative(term, position) @ term.theta

    def mapping(self, record: EffectRecord) -> PoseMap:
        """Return what is added to a sensor's position (3,), m, and its variance a coordinate, m^2.

        The parameters' standard deviations are taken as independent.
        """
        if record.parameters.get('kind') == SMOOTH:
            smooth = _smooth_map(record)
            return lambda sensor, position: (smooth(position[None])[0], 0.0)
        term = self.term(record)
        sigmas_mm = np.asarray(record.uncertainty.get('coefficients_mm', 0.0), dtype=np.float64)
        variances = np.broadcast_to(sigmas_mm, term.theta.shape) ** 2

        def added(sensor: str, position: Array) -> tuple[Array, float]:
            if not term.acts_on(sensor):
                return np.zeros(3), 0.0
            moved = self._derivative(term, position[None])[0]
            return moved @ term.theta, float(np.mean(moved**2 @ variances))

        return added

    def corrected(self, term: PoseTerm, sensor: str, position: Array) -> Array:
        return position + self.shift(term, position) if term.acts_on(sensor) else position

    def record(self, term: PoseTerm, covariance: Array) -> EffectRecord:
        """Record the map, and how far it moves poses at their rms distance.

        `seen_at` states how far it moves those of a session.
        """
        degree = term.site['degree']
        bent = _without_turn(term) if degree else term.theta
        # A scale's first number moves all three coordinates, as its shift does together.
        rms = UNIT_M * float(np.linalg.norm(bent)) / (np.sqrt(3) if degree else 1.0)
        # A shift strains nothing.
        stretched = bent[3 * (_lowest(term.site) == 0) :] if degree else bent[:1]
        strain = UNIT_M * float(np.linalg.norm(stretched)) / (np.sqrt(3) if degree else 1.0)
        strain /= term.site['size_m']
        spread = UNIT_M * float(np.sqrt(np.mean(sigmas(covariance) ** 2)))
        return EffectRecord(
            self.name,
            {
                **term.site, 'kind': KINDS[degree], 'rms_m': rms,
                'strain': strain,
                'coefficients_mm': term.theta.tolist(),
            },
            {'rms_m': spread, 'coefficients_mm': sigmas(covariance).tolist()},
        )  # fmt: skip

    def seen_at(
        self, record: EffectRecord, term: PoseTerm, covariance: Array, views: Sequence[PoseView]
    ) -> EffectRecord:
        """Return the record with how far the map moves the poses of a session, m rms.

        What it has of a rigid motion is a registration's, and moves nothing.
        """
        place = np.concatenate([v.measured for v in views if term.acts_on(v.sensor)])
        moved = self._derivative(term, place)
        rigid = np.zeros((len(place), 3, 6))
        rigid[:, :, :3] = np.eye(3)
        away = (place - place.mean(axis=0)) / term.site['size_m']
        for axis in range(3):
            rigid[:, :, 3 + axis] = np.cross(np.eye(3)[axis], away)
        basis, _ = np.linalg.qr(rigid.reshape(-1, 6))
        bent = moved.reshape(-1, term.theta.size)
        bent = bent - basis @ (basis.T @ bent)
        size = bent @ term.theta
        rms = float(np.sqrt(size @ size / len(place)))
        slope = (size @ bent) / (len(place) * max(rms, 1e-12))
        sigma = float(np.sqrt(slope @ covariance @ slope))
        values = {**record.parameters, 'rms_m': rms, **_apart(term, views)}
        return replace(
            record, parameters=values, uncertainty={**record.uncertainty, 'rms_m': sigma}
        )

    def term(self, record: EffectRecord) -> PoseTerm:
        keys = ('sensor', 'degree', 'lowest', 'is_equal', 'centre_m', 'size_m')
        site = cast(PoseSite, {k: record.parameters[k] for k in keys if k in record.parameters})
        theta = np.asarray(record.needed('coefficients_mm'), dtype=np.float64)
        count = 3 * _count(site) if site['degree'] else 4
        if theta.size != count:
            raise ModelFileError(
                f'{self.name}: {theta.size} coefficients_mm, such a map has {count}'
            )
        return PoseTerm(self, site, theta)


EFFECTS = (FieldDistortion(),)
