"""Fits emitters without a drawing and all errors of a body that rests at few poses, jointly.

Gauss-Newton steps, in which widths of populations follow the spread that is found (expectation
maximisation), and readings that fit badly lose weight. The noise, the kinds of errors and the free
dipoles in addition to the emitters are chosen by the log evidence.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from anser_ros.calibration.coaxial import SPREAD, coaxial, fit_coaxial
from anser_ros.calibration.dipole_sites import DipoleSites
from anser_ros.calibration.layouts import UNIT_Z
from anser_ros.calibration.population import LEAST_EVIDENCE
from anser_ros.calibration.readings import usable_weights
from anser_ros.calibration.still_model import POSE, StillModel, StillUnknowns
from anser_ros.calibration.still_system import AT_ONCE, StillSystem, StillWidths
from anser_ros.errors import FitError
from anser_ros.field.measurements import Measurements
from anser_ros.physics.constants import DIPOLE_CONSTANT
from anser_ros.settings import Accuracy

Array = NDArray[np.float64]

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
"""Log evidence that a free dipole must add: many places were tried, of which the best is always
better than none."""
MOST_FREE_DIPOLES = 6
"""Free dipoles in addition to the emitters at most; each further one costs a search."""
REACH = 0.7
"""How far beyond the sensors they are looked for, as a fraction of the sensors' extent."""
GRID = 0.25
"""Distance of neighbouring places, as the same fraction; the best is then refined."""
HALVINGS = 3
"""Refinements of a place, each by half the distance."""
LEAST_CLEARANCE = 0.05
"""Least distance of a dipole from every sensor, as a fraction of the sensors' extent: a nearer one
is felt by one sensor alone, and is that sensor's."""
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


class StillFitter:
    """Fits the frames of one body.

    ``centres`` (K, 3): rough places of the emitters, m, frame fg. ``kinds``: what to look for
    besides errors of the poses: ``gains``, ``axes``, ``bend``.
    """

    def __init__(
        self, measurements: Measurements, centres: Array, kinds: Sequence[str], accuracy: Accuracy
    ) -> None:
        self.measurements, self.accuracy = measurements, accuracy
        self.model = StillModel(measurements, StillModel.has_quadrature(measurements))
        self.kinds = tuple(k for k in kinds if k != 'bend' or self.model.bend is not None)
        self.points = measurements.placed()[0][measurements.usable]
        self.tree = cKDTree(self.points)
        self.extent = float(np.ptp(self.points, axis=0).max())
        self.flux_rms = float(np.sqrt(np.mean(self.model.reading[measurements.usable] ** 2)))
        if not self.flux_rms > 0.0:
            raise FitError(f'{measurements.body}: all fluxes are zero')
        self.around, self.around_width = self._around(centres)

    def _around(self, centres: Array) -> tuple[DipoleSites, Array]:
        """Return dipoles about each emitter, and how large their moments may be.

        One dipole finds an emitter's place. Six more about it, at a distance that is small
        compared with that of the sensors, make the multipoles of its size. All serve all emitters,
        as the iron of one carries the fields of the others.
        """
        start = coaxial(centres, np.tile(UNIT_Z, (len(centres), 1)), 1, np.ones(len(centres)))
        weights = [usable_weights(self.measurements)]
        found = fit_coaxial([self.measurements], weights, start, 1).positions
        away = np.asarray(self.tree.query(found)[0])
        step = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
        places = found[:, None] + SPREAD * away[:, None, None] * step
        width = self.flux_rms * away**3 / DIPOLE_CONSTANT
        return DipoleSites.of_any_direction(places.reshape(-1, 3)), np.repeat(width, 3 * len(step))

    def fit(self) -> StillFit:
        """Return the fit with the noise, the kinds and the dipoles that the readings ask for."""
        widths = self._start(self.accuracy.flux_noise_t, ())
        best = self._best_noise(self._solve(self.around, 0, widths))
        evidence = dict[str, float]()
        while left := [kind for kind in self.kinds if kind not in evidence]:
            tried = {}
            for kind in left:
                widths = self._start(best.widths.noise_t, (*evidence, kind))
                tried[kind] = self._best_noise(self._solve(self.around, 0, widths))
            kind = max(left, key=lambda name: tried[name].log_evidence)
            gain = tried[kind].log_evidence - best.log_evidence
            if gain < LEAST_EVIDENCE:
                break
            best, evidence[kind] = tried[kind], float(gain)
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
        return replace(self._best_noise(best), evidence=evidence)

    def evidence_of_poses(self, fit: StillFit) -> float:
        """Return the log evidence that the errors of the stated poses add to a fit."""
        frames = fit.widths.frames.copy()
        frames[:POSE] = 0.0
        held = self._solve(fit.sites, fit.beside, replace(fit.widths, frames=frames))
        return fit.log_evidence - self._best_noise(held).log_evidence

    def _start(self, noise_t: float, kinds: Sequence[str]) -> StillWidths:
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
                weights = system.student_weights(model.usable)
            if 2 <= step < STILL_STEPS - 2:
                widths = self._learnt(system, beside)
        determined = 1.0 - system.moment_variance / widths.moments[:, None] ** 2
        return StillFit(
            model, sites, beside, now, np.sqrt(system.sensor_variance),
            np.sqrt(system.frame_variance), widths, weights,
            float(determined.sum(axis=0).mean()), system.log_evidence(model.usable), {},
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

    def _system(self, fit: StillFit) -> StillSystem:
        fixed = np.zeros(0)
        return StillSystem(self.model, fit.unknowns, fit.sites, fit.widths, fit.weights, fixed)

    def _place_beside(self, fit: StillFit) -> tuple[Array, float] | None:
        """Where one more dipole makes the readings most probable, and its expected moment."""
        step, margin = GRID * self.extent, REACH * self.extent
        axes = [
            np.arange(low - margin, high + margin + step / 2.0, step)
            for low, high in zip(self.points.min(axis=0), self.points.max(axis=0), strict=True)
        ]
        places = np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 3)
        return self._refined(self._system(fit), fit, places, step)

    def _refined(
        self, system: StillSystem, fit: StillFit, places: Array, step: float
    ) -> tuple[Array, float] | None:
        """The best of some places, then of ever nearer ones about it; None where none is clear."""
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
