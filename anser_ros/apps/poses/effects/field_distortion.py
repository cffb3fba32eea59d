"""The tracker's map of space is bent: by the place or a sensor's direction."""

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

EVEN_MEAN = np.array([1, 0, 0, 1, 0]) / 3
"""Mean of the products xx, xy, xz, yy and yz of a direction's coordinates; zz is the others'."""


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
        return PoseTerm(self, site, np.zeros(self._size(site)))

    def _basis(self, site: PoseSite, position: Array, rotation: Array) -> Array:
        """What each vector of theta is multiplied by for poses (n, 3), (n, 3, 3): (n, m)."""
        centre = np.asarray(site['centre_m'])
        return monomials(position, centre, site['size_m'], site['degree'], _lowest(site))

    def _size(self, site: PoseSite) -> int:
        """The number of parameters."""
        return 3 * len(self._basis(site, np.zeros((1, 3)), np.zeros((1, 3, 3)))[0])

    def beside_scale(self, term: PoseTerm, is_scaled: bool = True) -> PoseTerm:
        """Return a map of all sensors, beside a scale less the mean of its strains."""
        site: PoseSite = {**term.site, 'is_equal': True}
        if not is_scaled:
            del site['is_equal']
        is_whole = term.sensor is None and 'degree' in term.site
        return replace(term, site=site) if is_whole else term

    def is_scale(self, term: PoseTerm) -> bool:
        return term.site.get('degree') == 0

    def covers(self, term: PoseTerm, candidate: PoseTerm) -> bool:
        """Return whether the map contains what a scale, or a map of a lower degree, is."""
        own, site = term.site, candidate.site
        is_part = candidate.effect.name == self.name
        if not (is_part or (candidate.role is Role.SCALE and 'is_equal' not in own)):
            return False
        if term.sensor not in (None, candidate.sensor):
            return False
        has_lowest = own.get('lowest', 1) <= site.get('lowest', 1)
        return bool(has_lowest and own.get('degree', 0) >= site.get('degree', 0 if is_part else 1))

    def _derivative(self, term: PoseTerm, position: Array, rotation: Array) -> Array:
        """What each parameter moves poses (n, 3), (n, 3, 3) by, shape (n, 3, q), m."""
        if term.site.get('degree') == 0:
            away = (position - np.asarray(term.site['centre_m']))[:, :, None] / term.site['size_m']
            shift = np.broadcast_to(np.eye(3), (len(position), 3, 3))
            return UNIT_M * np.concatenate([away, shift], axis=2)
        basis = self._basis(term.site, position, rotation)
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
        out[:, :3] = -self._derivative(term, view.measured, view.measured_rotation)
        return out

    def mapping(self, record: EffectRecord) -> PoseMap:
        """Return what is added to positions, and its variance, by independent sigmas."""
        if record.parameters.get('kind') == SMOOTH:
            smooth = _smooth_map(record)
            return lambda sensor, position, rotation: (smooth(position[None])[0], 0.0)
        term = self.term(record)
        sigmas_mm = np.asarray(record.uncertainty.get('coefficients_mm', 0.0), dtype=np.float64)
        variances = np.broadcast_to(sigmas_mm, term.theta.shape) ** 2

        def added(sensor: str, position: Array, rotation: Array) -> tuple[Array, float]:
            if not term.acts_on(sensor):
                return np.zeros(3), 0.0
            moved = self._derivative(term, position[None], rotation[None])[0]
            return moved @ term.theta, float(np.mean(moved**2 @ variances))

        return added

    def corrected(self, term: PoseTerm, sensor: str, position: Array, rotation: Array) -> Array:
        if not term.acts_on(sensor):
            return position
        return position + self._derivative(term, position, rotation) @ term.theta

    def record(self, term: PoseTerm, covariance: Array) -> EffectRecord:
        """Record the map; `seen_at` states how far it moves the poses of a session."""
        values: dict[str, object] = {**term.site, 'coefficients_mm': term.theta.tolist()}
        if (degree := term.site.get('degree')) is not None:
            # A shift strains nothing.
            bent = (
                _without_turn(term)[3 * (_lowest(term.site) == 0) :] if degree else term.theta[:1]
            )
            strain = UNIT_M * float(np.linalg.norm(bent)) / (np.sqrt(3) if degree else 1.0)
            values |= {'kind': KINDS[degree], 'strain': strain / term.site['size_m']}
        return EffectRecord(self.name, values, {'coefficients_mm': sigmas(covariance).tolist()})

    def seen_at(
        self, record: EffectRecord, term: PoseTerm, covariance: Array, views: Sequence[PoseView]
    ) -> EffectRecord:
        """Return the record with how far the map moves the poses of a session, m rms.

        What it has of a rigid motion is a registration's, and moves nothing.
        """
        own = [v for v in views if term.acts_on(v.sensor)]
        place = np.concatenate([v.measured for v in own])
        moved = self._derivative(term, place, np.concatenate([v.measured_rotation for v in own]))
        rigid = self._rigid(own, place - place.mean(axis=0))
        basis, _ = np.linalg.qr(rigid.reshape(3 * len(place), -1))
        bent = moved.reshape(-1, term.theta.size)
        bent = bent - basis @ (basis.T @ bent)
        size = bent @ term.theta
        rms = float(np.sqrt(size @ size / len(place)))
        told = float(size @ size) / max(float(np.sum((moved @ term.theta) ** 2)), 1e-18)
        slope = (size @ bent) / (len(place) * max(rms, 1e-12))
        sigma = float(np.sqrt(slope @ covariance @ slope))
        values = {**record.parameters, 'rms_m': rms, **_apart(term, views)}
        values |= {'told_share': told} if self.is_stiff else {}
        return replace(
            record, parameters=values, uncertainty={**record.uncertainty, 'rms_m': sigma}
        )

    def _rigid(self, views: Sequence[PoseView], away: Array) -> Array:
        """Columns (n, 3, q) of what is no bend, at places (n, 3) from their middle, m."""
        turns = [np.cross(axis, away)[:, :, None] for axis in np.eye(3)]
        return np.concatenate([np.tile(np.eye(3), (len(away), 1, 1)), *turns], axis=2)

    def term(self, record: EffectRecord) -> PoseTerm:
        keys = ('sensor', 'degree', 'lowest', 'is_equal', 'centre_m', 'size_m')
        site = cast(PoseSite, {k: record.parameters[k] for k in keys if k in record.parameters})
        theta = np.asarray(record.needed('coefficients_mm'), dtype=np.float64)
        count = 4 if site.get('degree') == 0 else self._size(site)
        if theta.size != count:
            raise ModelFileError(
                f'{self.name}: {theta.size} coefficients_mm, such a map has {count}'
            )
        return PoseTerm(self, site, theta)


class OrientationError(FieldDistortion):
    """Theta is a vector (mm) for each even function of second order of a sensor's z axis.

    Odd functions are not distinguished from a lever arm, and a constant is the registration's.
    """

    name = 'orientation_error'
    summary = "the tracker's positions err with the direction of a sensor's axis"
    advice = 'Hold sensors in one direction to the field generator, or apply the correction.'
    is_stiff = True

    def sites(self, setting: PoseSetting) -> Sequence[PoseTerm]:
        alone = [PoseSite(sensor=name) for name in setting.sensors if len(setting.sensors) > 1]
        return [PoseTerm(self, site, np.zeros(self._size(site))) for site in (PoseSite(), *alone)]

    def _basis(self, site: PoseSite, position: Array, rotation: Array) -> Array:
        return monomials(rotation[:, :, 2], np.zeros(3), 1.0, 2, 2)[:, :5] - EVEN_MEAN

    def _rigid(self, views: Sequence[PoseView], away: Array) -> Array:
        """The same with the lever arm of each sensor."""
        ends = np.cumsum([0, *(v.time.size for v in views)])
        levers = np.zeros((len(away), 3, 3 * len(views)))
        for k, view in enumerate(views):
            levers[ends[k] : ends[k + 1], :, 3 * k : 3 * k + 3] = view.frame @ view.turn
        return np.concatenate([super()._rigid(views, away), levers], axis=2)


EFFECTS = (FieldDistortion(), OrientationError())
