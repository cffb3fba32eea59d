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

from anser_ros.apps.lab.still_fit import DIPOLE_PAYS, FREEDOM, LEAST_CLEARANCE, student_weight
from anser_ros.arrays import Array, Booleans
from anser_ros.calibration.readings import DipoleSites
from anser_ros.errors import FitError
from anser_ros.physics.sensor import PlacedPoints

KINDS = ('places', 'axes', 'gains')
"""Kinds of sensors' errors whose widths are found where they are asked for: m, rad, relative."""
START = {'places': 1e-3, 'axes': 0.03, 'gains': 0.03}
"""Their widths at the start; far too wide ones cost a few trials."""
WIDTH_STEP = 2.0
"""Factor by which a width is varied: the likelihood is flat within it."""
LEAST_WIDTH = 1e-3
"""Share of its start below which a width is nothing at all."""
FIRST_GAIN = 0.1
"""Relative error of readings before there is a field to tell what errors of sensors would do."""
REACH = 0.1
"""How far beyond the sensors' box sources are looked for, as a fraction of its longest side."""
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
    """Holds what S sensors read of K sources, from one place."""

    points: PlacedPoints  # of the sensors
    flux: Array  # (S, K, C): the C real parts of each source's flux, T
    noise_t: Array  # (S,): noise of a part, T
    used: Booleans  # (S,)


@dataclass(frozen=True)
class LocatedSource:
    """Holds a source: D places (D, 3), m, the first its own, and moments (3D, C), A m^2."""

    places: Array
    moments: Array

    @property
    def sites(self) -> DipoleSites:
        """Return three dipoles at each place."""
        return DipoleSites.of_any_direction(self.places)

    def basis(self, points: PlacedPoints) -> Array:
        """Return the readings (S, 3D) of each dipole, T/(A m^2)."""
        return points.basis(self.sites.positions, self.sites.directions)

    def sigma(self, points: PlacedPoints, noise_t: Array, widths: dict[str, float]) -> Array:
        """Return how far readings (S, C) may be off by noise and errors of the sensors, T."""
        sites = self.sites
        shift, turn = points.slopes(sites.positions, sites.directions, self.moments)
        flux = self.basis(points) @ self.moments
        of = {'places': shift, 'axes': turn, 'gains': flux[:, None, :]}
        variance = np.broadcast_to(noise_t[:, None] ** 2, flux.shape).copy()
        variance += sum(width**2 * (of[kind] ** 2).sum(axis=1) for kind, width in widths.items())
        return np.asarray(np.sqrt(variance))


@dataclass(frozen=True)
class SourcesFit:
    """Holds what a fit found."""

    sources: tuple[LocatedSource, ...]  # one an emitter
    sign_evidence: Array  # (S,): log likelihood of a sensor's being the wrong way round
    widths: dict[str, float]  # of the sensors' errors, of `KINDS`
    # predicted, sigma (S, K, C): readings of sound sensors, and how far a reading may be off, T
    predicted: Array
    sigma: Array
    # (K,): standard deviation of each source's place, root of the sum over three axes, m
    place_sigma_m: Array


def student_losses(left: Array, sigma: Array) -> Array:
    """Return the negative log density (S, K) of residuals (S, K, C), up to a constant."""
    parts = left.shape[-1]
    size = ((left / sigma) ** 2).sum(axis=-1)
    bell = 0.5 * (FREEDOM + parts) * np.log1p(size / FREEDOM)
    return np.asarray(bell + np.log(sigma).sum(axis=-1))


@dataclass(frozen=True)
class _OneEmitter:
    """Readings of one emitter, of sensors turned the right way round, and what they may be off by.

    Without ``widths``, before there is a field, that is a share of each reading.
    """

    points: PlacedPoints
    flux: Array  # (S, C), T
    noise_t: Array
    used: Booleans
    widths: dict[str, float] | None

    def left(self, source: LocatedSource) -> Array:
        """Residuals (S, C), T."""
        return np.asarray(self.flux - source.basis(self.points) @ source.moments)

    def spread(self, source: LocatedSource) -> Array:
        """How far readings may be off, (S, C), T."""
        if self.widths is not None:
            return source.sigma(self.points, self.noise_t, self.widths)
        return self.rough()

    def rough(self) -> Array:
        """The same before there is a field."""
        rough = np.hypot(self.noise_t[:, None], FIRST_GAIN * np.abs(self.flux))
        return np.maximum(rough, 1e-300)

    def root(self, left: Array, sigma: Array) -> Array:
        """Factors (S, C) that make residuals white, with Student's weights; 0 for the unused."""
        size = ((left / sigma) ** 2).sum(axis=1)
        root = np.sqrt(student_weight(size, left.shape[1]))[:, None] / sigma
        return np.where(self.used[:, None], root, 0.0)

    def loss(self, source: LocatedSource) -> float:
        """The negative log likelihood of a source, up to a constant."""
        losses = student_losses(self.left(source), self.spread(source))
        return float(losses[self.used].sum())

    def refined(self, source: LocatedSource) -> LocatedSource:
        """The source after steps, unless they made it less likely."""
        moved = self.stepped(source)
        return moved if self.loss(moved) < self.loss(source) else source

    def stepped(self, source: LocatedSource) -> LocatedSource:
        """The source after Gauss-Newton steps of places and moments."""
        for step in range(SOURCE_STEPS):
            source, _ = self.step(source, moving=step > 0)
        return source

    def step(self, source: LocatedSource, *, moving: bool) -> tuple[LocatedSource, Array]:
        """One step, and the covariance of the places (3D, 3D) that it has."""
        basis, count, parts = source.basis(self.points), len(source.places), self.flux.shape[1]
        is_known = bool(source.moments.any())
        sigma = self.spread(source) if is_known else self.rough()
        left = self.flux - basis @ source.moments if is_known else np.zeros_like(self.flux)
        root = self.root(left, sigma)
        matrix = np.zeros((len(self.flux), parts, 3 * count * (1 + parts)))
        if moving:
            matrix[:, :, : 3 * count] = self._by_places(source)
        for c in range(parts):
            first = 3 * count * (1 + c)
            matrix[:, c, first : first + 3 * count] = basis
        white = (matrix * root[:, :, None]).reshape(-1, matrix.shape[2])
        target = (self.flux * root).ravel()
        strength = float(np.linalg.norm(source.moments[:3]))
        stray = 0.0 if strength == 0.0 else (STRAY * strength) ** -2.0
        of_moments = np.tile(np.repeat([0.0, stray], [3, 3 * count - 3]), parts)
        prior = np.concatenate([np.full(3 * count, HELD_M**-2.0), of_moments])
        normal = white.T @ white + np.diag(prior)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
        inverse = np.linalg.pinv(normal * np.outer(scale, scale), hermitian=True)
        solved = scale * (inverse @ (scale * (white.T @ target)))
        places = source.places + (solved[: 3 * count].reshape(-1, 3) if moving else 0.0)
        moments = solved[3 * count :].reshape(parts, -1).T
        covariance = (inverse * np.outer(scale, scale))[: 3 * count, : 3 * count]
        return LocatedSource(places, moments), covariance

    def _by_places(self, source: LocatedSource) -> Array:
        """Derivatives (S, C, 3D), T/m, by the dipoles' places."""
        sites, (count, parts) = source.sites, (len(source.places), self.flux.shape[1])
        apart = np.zeros((count, 3, count, parts))
        apart[np.arange(count), :, np.arange(count)] = source.moments.reshape(count, 3, parts)
        shift = self.points.shifts(
            sites.positions, sites.directions, apart.reshape(3 * count, -1)
        ).reshape(len(self.flux), 3, count, parts)
        return np.asarray(-shift.transpose(0, 3, 2, 1).reshape(len(self.flux), parts, -1))


class SourcesFitter:
    """Fits all sources of the readings, and errors of the sensors of these `KINDS`.

    Where any are looked for, a sensor may be the wrong way round, too.
    """

    def __init__(self, readings: SourceReadings, kinds: Sequence[str]) -> None:
        self.readings, self.kinds = readings, kinds
        self.used = readings.used
        self.sign = np.ones(len(readings.flux))
        self.widths = {kind: START[kind] for kind in kinds}
        self.grid = self._grid()
        sites = DipoleSites.of_any_direction(self.grid)
        rows = readings.points.basis(sites.positions, sites.directions)
        self.grid_rows = rows.reshape(len(rows), -1, 3).transpose(1, 0, 2)

    def _grid(self) -> Array:
        """Places (G, 3), m, around the sensors but not near one, at which sources may be."""
        points = self.readings.points.points
        low, high = points.min(axis=0), points.max(axis=0)
        margin = REACH * float((high - low).max())
        low, high = low - margin, high + margin
        step = float((high - low).max()) / ALONG
        axes = [np.arange(a + step / 2.0, b, step) for a, b in zip(low, high, strict=True)]
        places = np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 3)
        away = np.linalg.norm(points[None] - places[:, None], axis=2).min(axis=1)
        clear = away > LEAST_CLEARANCE * float(np.ptp(points, axis=0).max())
        if not clear.any():
            raise FitError('the tracked volume has no place that is clear of the sensors')
        return np.asarray(places[clear])

    def fit(self) -> SourcesFit:
        """Return the sources, and what is off of the sensors, of the largest likelihood."""
        sources = [self._first(k) for k in range(self.readings.flux.shape[1])]
        for _ in range(SOURCE_ROUNDS):
            sources = [one.refined(source) for one, source in self._each(sources)]
            self._learn_signs(sources)
            self._learn_widths(sources)
            bare = [LocatedSource(one.places[:1], one.moments[:3]) for one in sources]
            sources = [self._grown(one, source) for one, source in self._each(bare)]
        return self._result(sources)

    def _each(
        self, sources: Sequence[LocatedSource], widths: dict[str, float] | None = None
    ) -> list[tuple[_OneEmitter, LocatedSource]]:
        """Each emitter's readings, as the sensors are known now, with its source."""
        known = self.widths if widths is None else widths
        return [(self._one(k, known), source) for k, source in enumerate(sources)]

    def _one(self, k: int, widths: dict[str, float] | None) -> _OneEmitter:
        readings = self.readings
        flux = readings.flux[:, k] * self.sign[:, None]
        return _OneEmitter(readings.points, flux, readings.noise_t, self.used, widths)

    def _predicted(self, sources: Sequence[LocatedSource]) -> tuple[Array, Array]:
        """Readings of sound sensors, and how far they may be off, (S, K, C), T."""
        points, noise_t = self.readings.points, self.readings.noise_t
        predicted = [one.basis(points) @ one.moments for one in sources]
        sigma = [one.sigma(points, noise_t, self.widths) for one in sources]
        return np.stack(predicted, axis=1), np.stack(sigma, axis=1)

    def _first(self, k: int) -> LocatedSource:
        """Where on the grid one dipole explains an emitter's readings best, refined."""
        one = self._one(k, None)
        flux, rows = one.flux, self.grid_rows
        rough = np.where(self.used[:, None], one.rough(), np.inf)
        weight, left = np.ones((len(self.grid), len(flux))), np.zeros(0)
        for _ in range(SOURCE_STEPS):
            sums = [_solved(rows, weight, flux[:, c], rough[:, c]) for c in range(flux.shape[1])]
            left = np.stack(sums, axis=2)
            weight = student_weight((left**2).sum(axis=2), flux.shape[1])
        losses, found = np.log1p((left**2).sum(axis=2) / FREEDOM).sum(axis=1), []
        for best in np.argsort(losses)[:STARTS]:
            start = LocatedSource(self.grid[best][None], np.zeros((3, flux.shape[1])))
            found.append(one.stepped(start))
        return min(found, key=one.loss)

    def _learn_signs(self, sources: Sequence[LocatedSource]) -> None:
        """Find which way round each sensor is; those that do not tell clearly take no part."""
        if not self.kinds:
            return
        evidence = self._sign_evidence(*self._predicted(sources))
        self.used = self.readings.used & (np.abs(evidence) > CLEAR_SIGN)
        self.sign = np.where(evidence > 0.0, -1.0, 1.0)

    def _sign_evidence(self, predicted: Array, sigma: Array) -> Array:
        flux = self.readings.flux
        losses = [student_losses(sign * flux - predicted, sigma) for sign in (1.0, -1.0)]
        return np.asarray((losses[0] - losses[1]).sum(axis=1))

    def _learn_widths(self, sources: Sequence[LocatedSource]) -> None:
        """Vary one width after the other as long as the readings become more likely."""

        def loss(widths: dict[str, float]) -> float:
            return sum(one.loss(source) for one, source in self._each(sources, widths))

        best, improved = loss(self.widths), True
        while improved:
            improved = False
            for kind in self.kinds:
                for factor in (1.0 / WIDTH_STEP, WIDTH_STEP):
                    other = {**self.widths, kind: factor * self.widths[kind]}
                    if other[kind] < LEAST_WIDTH * START[kind]:
                        continue
                    if (now := loss(other)) < best:
                        best, self.widths, improved = now, other, True
                        break

    def _grown(self, one: _OneEmitter, source: LocatedSource) -> LocatedSource:
        """The source with as many dipoles of a stray field as pay."""
        source = one.stepped(source)
        best = (one.loss(source), source)
        for count in range(1, MOST_STRAY + 1):
            if count - len(best[1].places) >= IN_VAIN:
                break
            place = self._asked_for(one, source)
            more = np.zeros((3, source.moments.shape[1]))
            source = LocatedSource(
                np.vstack([source.places, place]), np.concatenate([source.moments, more])
            )
            source = one.stepped(source)
            loss = one.loss(source) + DIPOLE_PAYS * count
            if loss < best[0]:
                best = (loss, source)
        return best[1]

    def _asked_for(self, one: _OneEmitter, source: LocatedSource) -> Array:
        """The place of the grid where one more dipole explains most of what is left."""
        left = one.left(source)
        root = one.root(left, one.spread(source))
        strength = (STRAY * float(np.linalg.norm(source.moments[:3]))) ** -2.0
        gains = np.zeros(len(self.grid))
        for c in range(left.shape[1]):
            rows = self.grid_rows * root[None, :, c, None]
            normal = rows.transpose(0, 2, 1) @ rows + strength * np.eye(3)
            pull = rows.transpose(0, 2, 1) @ (left[:, c] * root[:, c])
            gains += (pull * np.linalg.solve(normal, pull[..., None])[..., 0]).sum(axis=1)
        return np.asarray(self.grid[int(np.argmax(gains))])

    def _result(self, sources: Sequence[LocatedSource]) -> SourcesFit:
        self._learn_signs(sources)
        sources = [one.refined(source) for one, source in self._each(sources)]
        predicted, sigma = self._predicted(sources)
        spread = [one.step(source, moving=True)[1][:3, :3] for one, source in self._each(sources)]
        return SourcesFit(
            tuple(sources), self._sign_evidence(predicted, sigma), self.widths,
            predicted, sigma, np.sqrt([np.trace(own) for own in spread]),
        )  # fmt: skip


def _solved(rows: Array, weight: Array, flux: Array, sigma: Array) -> Array:
    """Residuals (G, S), in sigmas, of weighted fits of three columns (G, S, 3) to fluxes (S,)."""
    scaled, target = rows / sigma[None, :, None], flux / sigma
    heavy = scaled * weight[:, :, None]
    normal = heavy.transpose(0, 2, 1) @ scaled
    normal = normal + 1e-12 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    moments = np.linalg.solve(normal, (heavy.transpose(0, 2, 1) @ target)[..., None])
    return np.asarray(target - (scaled @ moments)[..., 0])
