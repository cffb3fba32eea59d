"""Finds sources of unknown place from the readings of many sensors at one place, jointly.

Each emitter is a dipole of any direction, found anywhere in the tracked volume; where the
likelihood asks for it, further dipoles are its stray field, such as that of its lead. All sensors
may be off in place, direction and gain by a little: that widens what each may read, by its own
slopes, and the widths are those of the largest likelihood. Readings are Student's t, so that some
wild ones do not decide. A sensor may be the wrong way round; its readings of all emitters say so
together.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.dipole_sites import DipoleSites
from anser_ros.calibration.still_fit import DIPOLE_PAYS, LEAST_CLEARANCE
from anser_ros.calibration.still_system import FREEDOM, student_weight
from anser_ros.errors import FitError
from anser_ros.physics.windings import PlacedPoints

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

KINDS = ('places', 'axes', 'gains')
"""Kinds of sensors' errors whose widths are found where they are asked for: m, rad, relative.
Whenever any is, which way round each sensor is, is found as well."""
START = {'places': 1e-3, 'axes': 0.03, 'gains': 0.03}
"""Their widths at the start; far too wide ones cost a few trials."""
WIDTH_STEP = 2.0
"""Factor by which a width is varied: the likelihood is flat within it."""
LEAST_WIDTH = 1e-3
"""Share of its start below which a width is nothing at all."""
FIRST_GAIN = 0.1
"""Relative error of readings before there is a field to tell what errors of sensors would do."""
ALONG = 16
"""Places of a grid along the longest side of the volume, at which sources are looked for."""
STARTS = 3
"""Best places of the grid from which a source is refined."""
STRAY = 0.1
"""Expected moment of a dipole of the stray field, relative to the source's own."""
MOST_STRAY = 6
"""Dipoles of a stray field at most."""
IN_VAIN = 2
"""Further dipoles that may fail to pay before no more are tried: two may do what one does not."""
CLEAR_SIGN = 10.0
"""Log likelihood of a sensor's sign over the other from which on it takes part: a sensor of a
wrong sign would bend the field until it fits."""
SOURCE_STEPS = 6
"""Gauss-Newton steps between two looks at what else is off."""
SOURCE_ROUNDS = 3
"""Rounds of places, signs, widths and stray fields."""
HELD_M = 0.02
"""How far a step may move a dipole, one standard deviation, m: the slopes hold about so far."""


@dataclass(frozen=True)
class SourceReadings:
    """Holds what S sensors read of K sources, from one place.

    Attributes
    ----------
    points : PlacedPoints
        Of the sensors.
    flux : ndarray, shape (S, K, C)
        The C real parts of each source's flux, T.
    noise_t : ndarray, shape (S,)
        Noise of a part, T.
    used : ndarray of bool, shape (S,)
    """

    points: PlacedPoints
    flux: Array
    noise_t: Array
    used: Mask


@dataclass(frozen=True)
class LocatedSource:
    """Holds a source: D places (D, 3), m, the first its own, and moments (3D, C), A m^2."""

    places: Array
    moments: Array

    @property
    def sites(self) -> DipoleSites:
        """Return three dipoles at each place."""
        return DipoleSites.of_any_direction(self.places)


@dataclass(frozen=True)
class SourcesFit:
    """Holds what a fit found.

    Attributes
    ----------
    sources : tuple of LocatedSource
        One an emitter.
    sign : ndarray, shape (S,)
        -1 for a sensor the wrong way round.
    sign_evidence : ndarray, shape (S,)
        Log likelihood of its being so over its not being so.
    widths : dict of str to float
        Of the sensors' errors, of `KINDS`.
    predicted, sigma : ndarray, shape (S, K, C)
        Readings of sound sensors, and how far a reading may be off, T.
    place_sigma_m : ndarray, shape (K,)
        Standard deviation of each source's place, root of the sum over three axes, m.
    """

    sources: tuple[LocatedSource, ...]
    sign: Array
    sign_evidence: Array
    widths: dict[str, float]
    predicted: Array
    sigma: Array
    place_sigma_m: Array


def student_losses(left: Array, sigma: Array) -> Array:
    """Return the negative log density (S, K) of residuals (S, K, C), up to a constant."""
    parts = left.shape[-1]
    size = ((left / sigma) ** 2).sum(axis=-1)
    bell = 0.5 * (FREEDOM + parts) * np.log1p(size / FREEDOM)
    return np.asarray(bell + np.log(sigma).sum(axis=-1))


class SourcesFitter:
    """Fits all sources of the readings.

    Parameters
    ----------
    readings : SourceReadings
    volume : tuple of ndarray, shape (3,)
        Lowest and highest corner of where sources may be, m, frame fg.
    kinds : sequence of str
        What sensors may be off in, of `KINDS`, and ``polarity``.
    """

    def __init__(
        self, readings: SourceReadings, volume: tuple[Array, Array], kinds: Sequence[str]
    ) -> None:
        self.readings, self.turns = readings, 'polarity' in kinds
        self.used = readings.used
        self.kinds = tuple(kind for kind in KINDS if kind in kinds)
        self.grid = self._grid(volume)
        sites = DipoleSites.of_any_direction(self.grid)
        rows = readings.points.basis(sites.positions, sites.directions)
        self.grid_rows = rows.reshape(len(rows), -1, 3).transpose(1, 0, 2)

    def _grid(self, volume: tuple[Array, Array]) -> Array:
        low, high = volume
        step = float((high - low).max()) / ALONG
        axes = [np.arange(a + step / 2.0, b, step) for a, b in zip(low, high, strict=True)]
        places = np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 3)
        points = self.readings.points.points
        away = np.linalg.norm(points[None] - places[:, None], axis=2).min(axis=1)
        clear = away > LEAST_CLEARANCE * float(np.ptp(points, axis=0).max())
        if not clear.any():
            raise FitError('the tracked volume has no place that is clear of the sensors')
        return np.asarray(places[clear])

    def fit(self) -> SourcesFit:
        """Return the sources, and what is off of the sensors, of the largest likelihood."""
        count = self.readings.flux.shape[1]
        sign, widths = np.ones(len(self.readings.flux)), {kind: START[kind] for kind in self.kinds}
        sources = [self._first(k) for k in range(count)]
        for _ in range(SOURCE_ROUNDS):
            sources = [self._refined(k, one, sign, widths) for k, one in enumerate(sources)]
            sign = self._signs(sources, widths)
            widths = self._best_widths(sources, sign, widths)
            bare = [LocatedSource(one.places[:1], one.moments[:3]) for one in sources]
            sources = [self._grown(k, one, sign, widths) for k, one in enumerate(bare)]
        return self._result(sources, widths)

    def predicted(self, sources: Sequence[LocatedSource]) -> Array:
        """Return the readings of sound sensors, shape (S, K, C), T."""
        return np.stack([self._basis(one) @ one.moments for one in sources], axis=1)

    def sigma(self, sources: Sequence[LocatedSource], widths: dict[str, float]) -> Array:
        """Return how far readings may be off, shape (S, K, C), T."""
        return np.stack([self._sigma(one, widths) for one in sources], axis=1)

    def _basis(self, source: LocatedSource) -> Array:
        return self.readings.points.basis(source.sites.positions, source.sites.directions)

    def _sigma(self, source: LocatedSource, widths: dict[str, float]) -> Array:
        sites = source.sites
        shift, turn = self.readings.points.slopes(
            sites.positions, sites.directions, source.moments
        )
        flux = self._basis(source) @ source.moments
        of = {'places': shift, 'axes': turn, 'gains': flux[:, None, :]}
        variance = np.broadcast_to(self.readings.noise_t[:, None] ** 2, flux.shape).copy()
        variance += sum(width**2 * (of[kind] ** 2).sum(axis=1) for kind, width in widths.items())
        return np.asarray(np.sqrt(variance))

    def _first(self, k: int) -> LocatedSource:
        """Where on the grid one dipole explains an emitter's readings best, refined."""
        flux, used = self.readings.flux[:, k], self.used
        rough = np.hypot(self.readings.noise_t[:, None], FIRST_GAIN * np.abs(flux))
        rough = np.where(used[:, None], np.maximum(rough, 1e-300), np.inf)
        rows, weight = self.grid_rows, np.ones((len(self.grid), len(flux)))
        left = np.zeros(0)
        for _ in range(SOURCE_STEPS):
            sums = [_solved(rows, weight, flux[:, c], rough[:, c]) for c in range(flux.shape[1])]
            left = np.stack(sums, axis=2)
            size = (left**2).sum(axis=2)
            weight = student_weight(size, flux.shape[1])
        losses, found = np.log1p((left**2).sum(axis=2) / FREEDOM).sum(axis=1), []
        for best in np.argsort(losses)[:STARTS]:
            start = LocatedSource(self.grid[best][None], np.zeros((3, flux.shape[1])))
            source = self._stepped(k, start, np.ones(len(flux)), None)
            found.append((self._loss(k, source, np.ones(len(flux)), None), source))
        return min(found, key=lambda pair: pair[0])[1]

    def _spread(self, k: int, source: LocatedSource, widths: dict[str, float] | None) -> Array:
        """How far readings of one emitter may be off (S, C); by a share of them at first."""
        if widths is None:
            rough = FIRST_GAIN * np.abs(self.readings.flux[:, k])
            return np.maximum(np.hypot(self.readings.noise_t[:, None], rough), 1e-300)
        return self._sigma(source, widths)

    def _root(self, left: Array, sigma: Array) -> Array:
        """Factors (S, C) that make residuals white, with Student's weights; 0 for the unused."""
        size = ((left / sigma) ** 2).sum(axis=1)
        root = np.sqrt(student_weight(size, left.shape[1]))[:, None] / sigma
        return np.where(self.used[:, None], root, 0.0)

    def _loss(
        self, k: int, source: LocatedSource, sign: Array, widths: dict[str, float] | None
    ) -> float:
        left = self.readings.flux[:, k] * sign[:, None] - self._basis(source) @ source.moments
        sigma = self._spread(k, source, widths)
        return float(student_losses(left, sigma)[self.used].sum())

    def _stepped(
        self, k: int, source: LocatedSource, sign: Array, widths: dict[str, float] | None
    ) -> LocatedSource:
        """Gauss-Newton steps of places and moments."""
        for step in range(SOURCE_STEPS):
            source, _ = self._step(k, source, sign, widths, moving=step > 0)
        return source

    def _step(
        self,
        k: int,
        source: LocatedSource,
        sign: Array,
        widths: dict[str, float] | None,
        *,
        moving: bool,
    ) -> tuple[LocatedSource, Array]:
        """One step, and the covariance of the places (3D, 3D) that it has."""
        flux = self.readings.flux[:, k] * sign[:, None]
        basis, count, parts = self._basis(source), len(source.places), flux.shape[1]
        known = bool(source.moments.any())
        sigma = self._spread(k, source, widths if known else None)
        left = flux - basis @ source.moments if known else np.zeros_like(flux)
        root = self._root(left, sigma)
        slopes = np.zeros((len(flux), parts, 3 * count))
        if moving:
            sites, apart = source.sites, np.zeros((count, 3, count, parts))
            apart[np.arange(count), :, np.arange(count)] = source.moments.reshape(count, 3, parts)
            shift = self.readings.points.shifts(
                sites.positions, sites.directions, apart.reshape(3 * count, -1)
            ).reshape(len(flux), 3, count, parts)
            slopes[:] = -shift.transpose(0, 3, 2, 1).reshape(len(flux), parts, -1)
        matrix = np.zeros((len(flux), parts, 3 * count * (1 + parts)))
        matrix[:, :, : 3 * count] = slopes
        for c in range(parts):
            first = 3 * count * (1 + c)
            matrix[:, c, first : first + 3 * count] = basis
        white = (matrix * root[:, :, None]).reshape(-1, matrix.shape[2])
        target = (flux * root).ravel()
        strength = float(np.linalg.norm(source.moments[:3]))
        stray = 0.0 if strength == 0.0 else (STRAY * strength) ** -2.0
        prior = np.concatenate(
            [
                np.full(3 * count, HELD_M**-2.0),
                np.tile(np.repeat([0.0, stray], [3, 3 * count - 3]), parts),
            ]
        )
        normal = white.T @ white + np.diag(prior)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
        inverse = np.linalg.pinv(normal * np.outer(scale, scale), hermitian=True)
        solved = scale * (inverse @ (scale * (white.T @ target)))
        places = source.places + (solved[: 3 * count].reshape(-1, 3) if moving else 0.0)
        moments = solved[3 * count :].reshape(parts, -1).T
        covariance = (inverse * np.outer(scale, scale))[: 3 * count, : 3 * count]
        return LocatedSource(places, moments), covariance

    def _refined(
        self, k: int, source: LocatedSource, sign: Array, widths: dict[str, float]
    ) -> LocatedSource:
        """The source after steps, unless they made it less likely."""
        moved = self._stepped(k, source, sign, widths)
        better = self._loss(k, moved, sign, widths) < self._loss(k, source, sign, widths)
        return moved if better else source

    def _signs(self, sources: Sequence[LocatedSource], widths: dict[str, float]) -> Array:
        """Which way round each sensor is; those that do not tell clearly take no part."""
        if not self.turns:
            return np.ones(len(self.readings.flux))
        evidence = self._sign_evidence(self.predicted(sources), self.sigma(sources, widths))
        self.used = self.readings.used & (np.abs(evidence) > CLEAR_SIGN)
        return np.where(evidence > 0.0, -1.0, 1.0)

    def _sign_evidence(self, predicted: Array, sigma: Array) -> Array:
        flux = self.readings.flux
        losses = [student_losses(sign * flux - predicted, sigma) for sign in (1.0, -1.0)]
        return np.asarray((losses[0] - losses[1]).sum(axis=1))

    def _total(
        self, sources: Sequence[LocatedSource], sign: Array, widths: dict[str, float]
    ) -> float:
        return sum(self._loss(k, one, sign, widths) for k, one in enumerate(sources))

    def _best_widths(
        self, sources: Sequence[LocatedSource], sign: Array, widths: dict[str, float]
    ) -> dict[str, float]:
        """Vary one width after the other as long as the readings become more likely."""
        best = self._total(sources, sign, widths)
        improved = True
        while improved:
            improved = False
            for kind in self.kinds:
                for factor in (1.0 / WIDTH_STEP, WIDTH_STEP):
                    other = {**widths, kind: factor * widths[kind]}
                    if other[kind] < LEAST_WIDTH * START[kind]:
                        continue
                    loss = self._total(sources, sign, other)
                    if loss < best:
                        best, widths, improved = loss, other, True
                        break
        return widths

    def _grown(
        self, k: int, source: LocatedSource, sign: Array, widths: dict[str, float]
    ) -> LocatedSource:
        """The source with as many dipoles of a stray field as pay."""
        source = self._stepped(k, source, sign, widths)
        best = (self._loss(k, source, sign, widths), source)
        for count in range(1, MOST_STRAY + 1):
            if count - len(best[1].places) >= IN_VAIN:
                break
            place = self._asked_for(k, source, sign, widths)
            more = np.zeros((3, source.moments.shape[1]))
            source = LocatedSource(
                np.vstack([source.places, place]), np.concatenate([source.moments, more])
            )
            source = self._stepped(k, source, sign, widths)
            loss = self._loss(k, source, sign, widths) + DIPOLE_PAYS * count
            if loss < best[0]:
                best = (loss, source)
        return best[1]

    def _asked_for(
        self, k: int, source: LocatedSource, sign: Array, widths: dict[str, float]
    ) -> Array:
        """The place of the grid where one more dipole explains most of what is left."""
        left = self.readings.flux[:, k] * sign[:, None] - self._basis(source) @ source.moments
        root = self._root(left, self._spread(k, source, widths))
        strength = (STRAY * float(np.linalg.norm(source.moments[:3]))) ** -2.0
        gains = np.zeros(len(self.grid))
        for c in range(left.shape[1]):
            rows = self.grid_rows * root[None, :, c, None]
            normal = rows.transpose(0, 2, 1) @ rows + strength * np.eye(3)
            pull = rows.transpose(0, 2, 1) @ (left[:, c] * root[:, c])
            gains += (pull * np.linalg.solve(normal, pull[..., None])[..., 0]).sum(axis=1)
        return np.asarray(self.grid[int(np.argmax(gains))])

    def _result(self, sources: Sequence[LocatedSource], widths: dict[str, float]) -> SourcesFit:
        sign = self._signs(sources, widths)
        sources = [self._refined(k, one, sign, widths) for k, one in enumerate(sources)]
        predicted, sigma = self.predicted(sources), self.sigma(sources, widths)
        evidence = self._sign_evidence(predicted, sigma)
        spread = [
            self._step(k, one, sign, widths, moving=True)[1][:3, :3]
            for k, one in enumerate(sources)
        ]
        return SourcesFit(
            tuple(sources), sign, evidence, widths, predicted, sigma,
            np.sqrt([np.trace(own) for own in spread]),
        )  # fmt: skip


def _solved(rows: Array, weight: Array, flux: Array, sigma: Array) -> Array:
    """Residuals (G, S), in sigmas, of weighted fits of three columns (G, S, 3) to fluxes (S,)."""
    scaled, target = rows / sigma[None, :, None], flux / sigma
    heavy = scaled * weight[:, :, None]
    normal = heavy.transpose(0, 2, 1) @ scaled
    normal = normal + 1e-12 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    moments = np.linalg.solve(normal, (heavy.transpose(0, 2, 1) @ target)[..., None])
    return np.asarray(target - (scaled @ moments)[..., 0])
