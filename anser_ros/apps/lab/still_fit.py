"""Fits emitters of unknown geometry and all errors of a body that rests at few poses, jointly.

A channel's own gain and tilt touch only its own readings, so they are marginalised there: they
widen the covariance of those readings, and what is left is one generalised least-squares problem
in the dipoles' moments and the frames' poses and bends (`StillSystem`; Golub and Van Loan, Matrix
Computations, section 3.2). In Gauss-Newton steps, widths of populations follow the spread that is
found (expectation maximisation), and readings that fit badly lose weight (`StillFitter`). The
noise, the kinds of errors and the free dipoles in addition to the emitters are chosen by Laplace's
approximation of the log evidence.
"""

import functools
from collections.abc import Container, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from scipy.spatial import cKDTree

from anser_ros.apps.lab.still_model import POSE, Columns, StillModel, StillUnknowns
from anser_ros.arrays import Array, ComplexArray
from anser_ros.calibration.layouts import SPREAD, UNIT_Z, coaxial, fit_coaxial
from anser_ros.calibration.moments import FitFigures
from anser_ros.calibration.population import LEAST_EVIDENCE
from anser_ros.calibration.readings import DipoleSites, usable_weights
from anser_ros.errors import FitError
from anser_ros.field.measurements import Measurements
from anser_ros.physics.constants import DIPOLE_CONSTANT
from anser_ros.settings import Accuracy

FREEDOM = 4.0
"""Degrees of freedom of Student's t: a few wild readings lose weight, the others hardly any."""
SHARED = 100.0
"""How many times tighter errors' sum is held: what all frames share moves the field instead."""
AT_ONCE = 64
"""Places of a dipole that are judged at a time; each takes three columns for each part."""


def student_weight(size: Array, parts: int) -> Array:
    """Return what readings of so many parts count, by their squared residuals in sigmas."""
    return np.asarray((FREEDOM + parts) / (FREEDOM + size))


def figures_of(
    basis: Array, weights: Array, noise_t: float, freedom: float, alternations: int
) -> FitFigures:
    """Return how well a fit to rows of a basis (P, N) went, its condition worked out."""
    size = np.linalg.svd(basis / np.linalg.norm(basis, axis=0), compute_uv=False)
    return FitFigures(
        weights=(weights,),
        noise_t=noise_t,
        rank=int((size > size[0] * len(basis) * np.finfo(float).eps).sum()),
        freedom=freedom,
        condition=float(size[0] / max(size[-1], np.finfo(float).tiny)),
        alternations=alternations,
    )


@dataclass(frozen=True)
class StillWidths:
    """Holds standard deviations of everything before any data; zero fixes what it belongs to."""

    noise_t: float  # of a reading's component, T
    moments: Array  # (N,): A m^2
    frames: Array  # (6 + B,): of a frame's pose and bend, m and rad
    sensors: Array  # (G + 2,): of gains, and tilts in rad


class StillSystem:
    """One linear system about an estimate ``now``, with its solution.

    ``place_width`` (J,): how far the last J dipoles of free direction may be from where they are,
    m. ``moving``: whether places and the frames' errors are solved for; at first there is no field
    to tell them by.

    Found are the ``solution``, ``steps`` (J, 3), m, of the free dipoles, ``sensor_variance``
    (S, G + 2), ``moment_variance`` (N, C), ``frame_variance`` (F, 6 + B), and the ``residual``
    (F, S, C), T, of the linear model.
    """

    def __init__(
        self, model: StillModel, now: StillUnknowns, sites: DipoleSites, widths: StillWidths,
        weights: Array, place_width: Array, moving: bool = True,
    ) -> None:  # fmt: skip
        self.model, self.now, self.widths = model, now, widths
        self.place_width = place_width if moving else place_width[:0]
        columns = model.columns(now, sites, len(self.place_width))
        self.free = (widths.frames > 0.0) & moving
        self.frames, self.sensors = weights.shape
        self._whiten(columns, weights)
        plain = self._shared(columns)
        self.shared = self.inverse_root @ plain
        white = self.shared.reshape(-1, self.shared.shape[2])
        target = (self.inverse_root @ columns.target[..., None]).ravel()
        self.prior = self._prior()
        self.factor = np.linalg.cholesky(white.T @ white + self.prior)
        # What the unknowns can explain of whitened rows v is reach @ (reach.T @ v).
        self.reach = scipy.linalg.solve_triangular(self.factor, white.T, lower=True).T
        self.white_residual = target - self.reach @ (self.reach.T @ target)
        self.values = np.linalg.solve(self.factor.T, self.reach.T @ target)
        self._share_out(columns, columns.target - plain @ self.values)

    def _whiten(self, columns: Columns, weights: Array) -> None:
        parts = self.model.parts
        self.seen = np.tile(weights.T > 0.0, (1, parts))
        root = np.tile(np.sqrt(weights).T, (1, parts)) / self.widths.noise_t
        self.root = np.where(self.seen, root, 0.0)
        # In units of the noise every covariance is the unit matrix and what a sensor adds.
        self.spread = columns.own * self.widths.sensors * self.root[:, :, None]
        covariance = self.spread @ self.spread.transpose(0, 2, 1)
        covariance[:, np.arange(root.shape[1]), np.arange(root.shape[1])] += 1.0
        lower = np.linalg.cholesky(covariance)
        self.log_covariance = 2.0 * float(np.log(np.diagonal(lower, axis1=1, axis2=2)).sum())
        self.unit_root = np.linalg.inv(lower)
        self.inverse_root = self.unit_root * self.root[:, None, :]

    def _shared(self, columns: Columns) -> Array:
        """Columns of moments, part by part, and of the frames' errors: (S, R, Q)."""
        parts, dipoles, count = self.model.parts, columns.basis.shape[2], int(self.free.sum())
        out = np.zeros((self.sensors, parts, self.frames, parts * dipoles + self.frames * count))
        for part in range(parts):
            out[:, part, :, part * dipoles : (part + 1) * dipoles] = columns.basis
        for frame in range(self.frames):
            first = parts * dipoles + frame * count
            out[:, :, frame, first : first + count] = columns.frames[:, :, frame][..., self.free]
        flat = out.reshape(self.sensors, parts * self.frames, -1)
        return np.concatenate([flat, columns.places], axis=2)

    def _prior(self) -> Array:
        widths, free = self.widths, self.widths.frames[self.free]
        moments = np.tile(widths.moments**-2.0, self.model.parts)
        places = np.repeat(self.place_width**-2.0, 3)
        out = np.diag(np.concatenate([moments, np.tile(free**-2.0, self.frames), places]))
        for k, width in enumerate(free):
            same = len(moments) + k + len(free) * np.arange(self.frames)
            out[np.ix_(same, same)] += (SHARED / width) ** 2
        return out

    def _share_out(self, columns: Columns, rest: Array) -> None:
        """Give each sensor its own of what is left (S, R), and order the values as unknowns."""
        parts, dipoles = self.model.parts, columns.basis.shape[2]
        # Its columns span the covariance of the shared unknowns.
        spread = np.linalg.inv(self.factor).T
        variance = (spread**2).sum(axis=1)
        last = parts * dipoles + self.frames * int(self.free.sum())
        moments, frames, steps = np.split(self.values, [parts * dipoles, last])
        self.steps = steps.reshape(-1, 3)
        self.moment_variance = variance[: parts * dipoles].reshape(parts, dipoles).T
        every = np.zeros((2, *self.now.frames.shape))
        every[0][:, self.free] = frames.reshape(self.frames, -1)
        every[1][:, self.free] = variance[parts * dipoles : last].reshape(self.frames, -1)
        self.frame_variance = every[1]
        width = self.widths.sensors
        half = self.unit_root @ self.spread
        white = (self.inverse_root @ rest[..., None])[..., 0]
        own = width * np.einsum('sra,sr->sa', half, white)
        alone = np.maximum(width**2 * (1.0 - (half**2).sum(axis=1)), 0.0)
        # What is uncertain of the shared unknowns is taken for a sensor's own, or is not.
        passed = (half * width).transpose(0, 2, 1) @ self.shared @ spread
        self.sensor_variance = alone + (passed**2).sum(axis=2)
        self.solution = StillUnknowns(moments.reshape(parts, dipoles).T, every[0], own)
        left = rest - np.einsum('sra,sa->sr', columns.own, own)
        self.residual = left.reshape(self.sensors, parts, self.frames).transpose(2, 0, 1)

    def student_weights(self) -> Array:
        """Return weights (F, S) of the readings by what is left of them; 0 where unusable."""
        parts = self.model.parts
        size = (self.residual**2).sum(axis=2) / self.widths.noise_t**2
        return np.where(self.model.usable, student_weight(size, parts), 0.0)

    def log_evidence(self) -> float:
        """Return Laplace's approximation of the log evidence, up to a constant of the readings."""
        parts, noise = self.model.parts, self.widths.noise_t
        size = (self.residual**2).sum(axis=2)[self.model.usable] / noise**2
        fit = -0.5 * (FREEDOM + parts) * float(np.log1p(size / FREEDOM).sum())
        fit -= parts * size.size * np.log(noise)
        penalty = float(self.values @ self.prior @ self.values)
        used = self.widths.sensors > 0.0
        own = self.solution.sensors[:, used] / self.widths.sensors[used]
        volume = float(np.linalg.slogdet(self.prior)[1])
        volume -= 2.0 * float(np.log(np.diag(self.factor)).sum()) + self.log_covariance
        return float(fit - 0.5 * (penalty + float((own**2).sum())) + 0.5 * volume)

    def gains(self, basis: Array, widths: Array) -> Array:
        """Return the log evidence that a dipole of free direction adds at each of P places.

        ``basis`` (S, F, 3P): flux of its three components in each channel, T/(A m^2). ``widths``
        (W, P): expected sizes of its moment to try, A m^2.
        """
        parts, places = self.model.parts, basis.shape[2] // 3
        flat = np.empty((places, parts * 3, self.sensors * self.root.shape[1]))
        for part in range(parts):
            own = slice(part * self.frames, (part + 1) * self.frames)
            white = (self.inverse_root[:, :, own] @ basis).reshape(flat.shape[2], places, 3)
            flat[:, 3 * part : 3 * part + 3] = white.transpose(1, 2, 0)
        shadow = flat @ self.reach
        pull = flat @ self.white_residual
        normal = flat @ flat.transpose(0, 2, 1) - shadow @ shadow.transpose(0, 2, 1)
        size = widths[:, :, None, None]
        inner = np.eye(3 * parts) + normal[None] * size**2
        step = np.linalg.solve(inner, (pull[None] * widths[:, :, None])[..., None])[..., 0]
        explained = 0.5 * (pull[None] * widths[:, :, None] * step).sum(axis=2)
        return np.asarray(explained - 0.5 * np.linalg.slogdet(inner)[1])


STILL_STEPS = 10
"""Gauss-Newton steps of a fit; widths follow in all but the first and last two."""
START = {'gains': 0.03, 'axes': 0.05}
"""Widths of the populations at the start; the fit finds their own."""
LEAST_WIDTH = 1e-9
"""Least width that is found: nothing at all."""
NOISE_STEP = 2.0
"""Factor by which the noise is varied: the evidence is flat within it."""
MOST_NOISE_STEPS = 20
"""Variations of the noise at most: from any that may be stated to any that is real."""
DIPOLE_PAYS = 20.0
"""Log evidence that a free dipole must add: the best of many places always adds some."""
MOST_FREE_DIPOLES = 6
"""Free dipoles in addition to the emitters at most; each further one costs a search."""
REACH = 0.7
"""How far beyond the sensors they are looked for, as a fraction of the sensors' extent."""
GRID = 0.25
"""Distance of neighbouring places, as the same fraction; the best is then refined."""
HALVINGS = 3
"""Refinements of a place, each by half the distance."""
LEAST_CLEARANCE = 0.05
"""Least distance of a dipole from sensors, in their extent: a nearer one is one sensor's error."""
SIZES = (1e-3, 1e-2, 1e-1, 1.0)
"""Expected sizes of a free dipole's field at the nearest sensor, relative to the fluxes."""


@dataclass(frozen=True)
class StillFit:
    """Holds what a joint fit found."""

    model: StillModel  # of the frames that were fitted
    # N dipoles: seven places an emitter, then the free ones, three directions each
    sites: DipoleSites
    beside: int  # number of free places
    unknowns: StillUnknowns  # moments, errors of the frames and of the sensors
    sensor_sigma: Array  # (S, G + 2): standard deviation of the sensors' own
    frame_sigma: Array  # (F, 6 + B): standard deviation of the frames' own, m and rad
    widths: StillWidths  # noise, and widths as found
    weights: Array  # (F, S): of the readings
    freedom: float  # how many of the moments of each part the readings determine
    log_evidence: float
    evidence: dict[str, float]  # log evidence that each kind of error added to those before it

    @property
    def moments(self) -> ComplexArray:
        """Return the moments (N, K), A m^2."""
        return self.model.phasors(self.unknowns.moments)


class StillFitter:
    """Fits the frames of one body; keeps what it found for fits that look for other kinds.

    ``centres`` (K, 3): rough places of the emitters, m, frame fg.
    """

    def __init__(self, measurements: Measurements, centres: Array, accuracy: Accuracy) -> None:
        self.measurements, self.accuracy = measurements, accuracy
        is_complex = bool((measurements.flux[measurements.usable].imag != 0.0).any())
        self.model = StillModel(measurements, is_complex)
        self.points = measurements.placed()[0][measurements.usable]
        self.tree = cKDTree(self.points)
        self.extent = float(np.ptp(self.points, axis=0).max())
        self.flux_rms = float(np.sqrt(np.mean(self.model.reading[measurements.usable] ** 2)))
        if not self.flux_rms > 0.0:
            raise FitError(f'{measurements.body}: all fluxes are zero')
        self.around, self.around_width = self._around(centres)
        self.alone = functools.cache(self._alone)
        self.with_beside = functools.cache(self._with_beside)

    def _around(self, centres: Array) -> tuple[DipoleSites, Array]:
        """Dipoles about each emitter, and how large their moments may be.

        Six about the one that finds its place make the multipoles of its size. All serve all
        emitters, as the iron of one carries the fields of the others.
        """
        start = coaxial(centres, np.tile(UNIT_Z, (len(centres), 1)), 1, np.ones(len(centres)))
        weights = [usable_weights(self.measurements)]
        found = fit_coaxial([self.measurements], weights, start, 1).positions
        away = np.asarray(self.tree.query(found)[0])
        step = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
        places = found[:, None] + SPREAD * away[:, None, None] * step
        width = self.flux_rms * away**3 / DIPOLE_CONSTANT
        return DipoleSites.of_any_direction(places.reshape(-1, 3)), np.repeat(width, 3 * len(step))

    def fit(self, kinds: Sequence[str]) -> StillFit:
        """Return the fit with the noise, the kinds and the dipoles that the readings ask for.

        ``kinds``: what to look for besides errors of the poses: ``gains``, ``axes``, ``bend``.
        """
        kinds = [kind for kind in kinds if kind != 'bend' or self.model.bend is not None]
        start = self.accuracy.flux_noise_t, frozenset[str]()
        evidence = dict[str, float]()
        while left := [kind for kind in kinds if kind not in evidence]:
            best = self.alone(*start)
            starts = {k: (best.widths.noise_t, frozenset((*evidence, k))) for k in left}
            tried = {kind: self.alone(*starts[kind]).log_evidence for kind in left}
            kind = max(left, key=lambda name: tried[name])
            gain = tried[kind] - best.log_evidence
            if gain < LEAST_EVIDENCE:
                break
            start, evidence[kind] = starts[kind], float(gain)
        return replace(self.with_beside(*start), evidence=evidence)

    def _alone(self, noise_t: float, kinds: frozenset[str]) -> StillFit:
        """The fit with the emitters' dipoles alone, of the best noise about this one."""
        return self._best_noise(self._solve(self.around, 0, self._start(noise_t, kinds)))

    def _with_beside(self, noise_t: float, kinds: frozenset[str]) -> StillFit:
        """The same with as many dipoles beside the emitters as pay."""
        best = self.alone(noise_t, kinds)
        while best.beside < MOST_FREE_DIPOLES:
            found = self._place_beside(best)
            if found is None:
                break
            place, width = found
            sites = best.sites.joined(DipoleSites.of_any_direction(place[None]))
            widths = replace(best.widths, moments=np.append(best.widths.moments, [width] * 3))
            more = self._solve(sites, best.beside + 1, widths)
            if more.log_evidence < best.log_evidence + DIPOLE_PAYS:
                break
            best = more
        return self._best_noise(best)

    def evidence_of_poses(self, fit: StillFit) -> float:
        """Return the log evidence that the errors of the stated poses add to a fit."""
        frames = fit.widths.frames.copy()
        frames[:POSE] = 0.0
        held = self._solve(fit.sites, fit.beside, replace(fit.widths, frames=frames))
        return fit.log_evidence - self._best_noise(held).log_evidence

    def _start(self, noise_t: float, kinds: Container[str]) -> StillWidths:
        jitter = self.accuracy.pose_jitter
        bend = jitter[0] if 'bend' in kinds else 0.0
        gain, tilt = (START[kind] if kind in kinds else 0.0 for kind in ('gains', 'axes'))
        return StillWidths(
            noise_t,
            self.around_width,
            np.concatenate([jitter, np.full(self.model.bends, bend)]),
            np.repeat([gain, tilt], [self.model.gains, 2]),
        )

    def _solve(self, sites: DipoleSites, beside: int, widths: StillWidths) -> StillFit:
        model = self.model
        now = model.nothing(len(sites))
        weights = model.usable.astype(np.float64)
        place_width = np.full(beside, GRID * self.extent)
        for step in range(STILL_STEPS):
            system = StillSystem(model, now, sites, widths, weights, place_width, moving=step > 0)
            now = system.solution
            sites = self._moved(sites, system.steps)
            if step < STILL_STEPS - 1:
                weights = system.student_weights()
            if 2 <= step < STILL_STEPS - 2:
                widths = self._learnt(system, beside)
        determined = 1.0 - system.moment_variance / widths.moments[:, None] ** 2
        return StillFit(
            model, sites, beside, now, np.sqrt(system.sensor_variance),
            np.sqrt(system.frame_variance), widths, weights,
            float(determined.sum(axis=0).mean()), system.log_evidence(), {},
        )  # fmt: skip

    def _moved(self, sites: DipoleSites, steps: Array) -> DipoleSites:
        """Free dipoles after steps (J, 3), which are cut where they would come near a sensor."""
        if not len(steps):
            return sites
        places = sites.positions[-3 * len(steps) :: 3]
        away = np.asarray(self.tree.query(places)[0]) - LEAST_CLEARANCE * self.extent
        most = np.maximum(away, 0.0) / 2.0
        size = np.maximum(np.linalg.norm(steps, axis=1), 1e-12)
        moved = places + steps * np.minimum(1.0, most / size)[:, None]
        around = DipoleSites(
            sites.positions[: -3 * len(steps)], sites.directions[: -3 * len(steps)]
        )
        return around.joined(DipoleSites.of_any_direction(moved))

    def _learnt(self, system: StillSystem, beside: int) -> StillWidths:
        """Widths of the populations as their values spread, each kind's and each free dipole's."""
        widths, found = system.widths, system.solution
        square = found.sensors**2 + system.sensor_variance
        gains, tilts = square[:, : self.model.gains], square[:, self.model.gains :]
        sensors = np.sqrt([*gains.mean(axis=0), tilts.mean(), tilts.mean()])
        frames = widths.frames.copy()
        if self.model.bends and frames[POSE] > 0.0:
            power = (found.frames**2 + system.frame_variance)[:, POSE:]
            # The frames' sum is held, so that one of them is no value of its own.
            frames[POSE:] = np.sqrt(power.mean() * len(power) / (len(power) - 1))
        moments = widths.moments.copy()
        if beside:
            power = (found.moments**2 + system.moment_variance)[-3 * beside :]
            each = power.reshape(beside, -1).mean(axis=1)
            moments[-3 * beside :] = np.repeat(np.sqrt(each), 3)
        return replace(
            widths,
            moments=moments,
            frames=frames,
            sensors=np.where(widths.sensors > 0.0, np.maximum(sensors, LEAST_WIDTH), 0.0),
        )

    def _best_noise(self, fit: StillFit) -> StillFit:
        """Halve or double the noise as long as that makes the readings more probable."""
        for factor in (1.0 / NOISE_STEP, NOISE_STEP):
            start = fit
            for _ in range(MOST_NOISE_STEPS):
                widths = replace(fit.widths, noise_t=factor * fit.widths.noise_t)
                other = self._solve(fit.sites, fit.beside, widths)
                if other.log_evidence <= fit.log_evidence:
                    break
                fit = other
            if fit is not start:
                break
        return fit

    def _place_beside(self, fit: StillFit) -> tuple[Array, float] | None:
        """Where one more dipole makes the readings most probable, and its expected moment.

        The best place of a grid is refined among ever nearer ones; None where none is clear.
        """
        step, margin = GRID * self.extent, REACH * self.extent
        axes = [
            np.arange(low - margin, high + margin + step / 2.0, step)
            for low, high in zip(self.points.min(axis=0), self.points.max(axis=0), strict=True)
        ]
        places = np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 3)
        system = StillSystem(
            self.model, fit.unknowns, fit.sites, fit.widths, fit.weights, np.zeros(0)
        )
        best, found = -np.inf, None
        around = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing='ij'), -1).reshape(-1, 3)
        for _ in range(1 + HALVINGS):
            away = np.asarray(self.tree.query(places)[0])
            clear = away > LEAST_CLEARANCE * self.extent
            if clear.any():
                places, away = places[clear], away[clear]
                sizes = np.outer(SIZES, self.flux_rms * away**3 / DIPOLE_CONSTANT)
                gains = self._gains(system, fit, places, sizes)
                row, column = np.unravel_index(int(np.argmax(gains)), gains.shape)
                if gains[row, column] >= best:
                    best, found = gains[row, column], (places[column], float(sizes[row, column]))
            if found is None:
                return None
            step /= 2.0
            places = found[0] + step * around
        return found

    def _gains(self, system: StillSystem, fit: StillFit, places: Array, sizes: Array) -> Array:
        found = []
        for first in range(0, len(places), AT_ONCE):
            own = slice(first, first + AT_ONCE)
            rows = self.model.rows(fit.unknowns, DipoleSites.of_any_direction(places[own]))
            basis = rows.transpose(1, 0, 2) * (1.0 + fit.unknowns.sensors[:, :1, None])
            found.append(system.gains(np.ascontiguousarray(basis), sizes[:, own]))
        return np.concatenate(found, axis=1)
