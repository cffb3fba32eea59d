"""Fits a drawn board, every coil of which is a little off, to whatever readings there are.

The drawing is the prior: a coil's place, tilt and strength have the spread of manufacturing,
and a layer of weak dipoles stands for leads and windings that the drawing lacks. Errors of the
sensors, of the plate that typed places belong to, and every frame's pose are unknown besides.
Poses are eliminated frame by frame, whatever their prior (typed to a tenth of a millimetre, or
unknown), and one linear-Gaussian problem remains (Tarantola, Inverse Problem Theory, section 3.2),
solved again at each estimate. The widths of populations are those that make the data most probable
(MacKay, Neural Computation 1992), with the stated width as `STATED` values more: few data leave
the field near the drawing, many make it free, and the covariance says which.

What no reading determines is the frame: field and poses may move together by six numbers, which
only the prior holds. They are stated apart (`FieldModel.shift_sigma_m`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.arrays import Array, ComplexArray, as_real
from anser_ros.calibration.courses import NONE, StrengthCourses, let_change
from anser_ros.calibration.layouts import Generator, Layout, grid, moments_of_field, place
from anser_ros.calibration.moments import (
    SMALLEST_NOISE_T,
    PoseTerms,
    PoseWhitener,
    Progress,
    moved,
    outlier_weights,
    pose_slopes,
)
from anser_ros.calibration.population import Likelihood, Posterior, solve
from anser_ros.calibration.readings import (
    DipoleSites,
    basis_rows,
    flux_slopes,
    fold_of_frames,
    thinned,
    usable_weights,
)
from anser_ros.calibration.sensor_parameters import SensorParameters
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import Dipoles, FieldModel
from anser_ros.field.nominal import GAIN, LOWEST_M, SHIFT_M, TILT_RAD
from anser_ros.physics.dipole import flux_basis
from anser_ros.physics.sensor import along_each_axis

REST = 5e-5
"""Standard deviation of a moment of the layer for what the drawing lacks, relative to a coil's:
leads half a millimetre apart, some centimetres long, enclose that share of the turns' area."""
REST_LAYER = Layout('layer', 8, 1.1, 0.0)
"""That layer: dipoles every 3 to 4 cm, closer than the distance to any sensor."""
REST_MODES = 24
"""Its combinations that are fitted; at `LOWEST_M` others make a thousandth."""
HEIGHTS_M = LOWEST_M * np.array([1.0, 1.5, 2.5, 4.0])
"""Heights over the board at which its field is looked at."""
COIL = {'shift': SHIFT_M, 'turn': TILT_RAD, 'strength': GAIN, 'shape': 1e-3}
"""Standard deviations of a coil's errors: m, rad, and relative."""
SENSORS = {'gains': 0.02, 'axes': 0.02, 'places': 5e-4}
"""The same of the sensors': relative, rad, m, those of coils wound and glued by hand."""
LEVEL = np.array([0.02] * 2 + [0.01] * 3)
"""The same of what all coils share, relative: strength (real, imaginary), as by a sensor's turns,
and shape of the windings, where a drawing counts half a track more or less on some sides."""
PLATE = np.array([1.5e-3] * 3 + [0.01] * 3 + [3e-4])
"""The same of a plate's place (m), turn (rad) and scale: laid by eye, drilled well."""
PLACE = np.array([1.5e-4] * 3 + [5e-3] * 3)
"""The same of a place on a plate (m, rad): a probe has some play in it."""
FREE = np.array([0.1] * 3 + [1.0] * 3)
"""The same of a pose that nothing states, m and rad."""
SCALE = 1.2e-3
"""The same of the scale that all coils' places share: what coils that are placed to 0.35 mm, each
by itself, make of it."""
STATED = 12.0
"""Values of a population that its stated width counts as when it is learnt."""
WIDEST = 3.0
"""Width of a population at most, relative to the stated one."""
STEPS, WIDTH_STEPS = 15, 10
"""Gauss-Newton steps at most, and steps of the widths within each."""
PLACING_STEPS = 5
"""The same where only the coils' places are asked for: more change held-out errors by 1e-4."""
SETTLING = 2
"""Steps before widths, noise and weights are learnt: first the board comes to where it is."""
SMALL = 0.05
"""Step, in standard deviations, that ends the iteration."""
FINE = 4e-5
"""Relative misfit of the dipoles that stand for a drawn coil: below the noise near the board."""
MOST_READINGS = 1000
"""Readings of coils that are used at most, of frames evenly spread: more change no pose."""
MOST_MODES = 64
"""Modes of the model's covariance: what more would add is below a hundredth of the noise."""
STEP = 1e-5
"""Step of the differences by a coil's place (m), turn (rad) and shape."""

KINDS = {
    'shift': slice(0, 3),
    'turn': slice(3, 6),
    'strength': slice(6, 8),
    'shape': slice(8, 11),
    'rest': slice(11, None),
}
"""Where the parameters of these kinds stand among a coil's own."""
OWN = 11
"""Parameters of a coil, before those of the kind `rest`."""
SHAPES = np.array([[[1.0, 0.0], [0.0, 1.0]], [[1.0, 0.0], [0.0, -1.0]], [[0.0, 1.0], [1.0, 0.0]]])
"""Changes of a flat coil's shape by one unit, in its own frame: larger, longer in x than in y, and
longer along one diagonal than the other. What artwork lacks of its turns is one of them."""


def _turned(vectors: Array) -> Array:
    return np.asarray(Rotation.from_rotvec(vectors).as_matrix())


def _carried(places: Array, middle: Array) -> Array:
    """Shifts (P, 3, 6) of places by a motion (m, rad) about a middle."""
    turns = [np.cross(unit, places - middle) for unit in np.eye(3)]
    return np.concatenate(
        [np.broadcast_to(np.eye(3), (len(places), 3, 3)), np.stack(turns, axis=2)], axis=2
    )


class Drawing:
    """A board's drawing as N dipoles, coil by coil, and L more for what it lacks.

    The errors of its K coils are a table (K, `OWN` + ``modes``): shift (m), turn (rad) about the
    centre, complex strength less one, `SHAPES`, and amplitudes of combinations of the L dipoles,
    which are left out with them where ``modes`` is zero.
    """

    def __init__(self, generator: Generator, modes: int) -> None:
        assert generator.nominal is not None
        self.nominal, self.centres = generator.nominal, generator.centres
        self.owner = np.argmax(np.abs(self.nominal.moments), axis=1)
        self.arms = self.nominal.positions - self.centres[self.owner]
        frames = _turned(np.outer(np.deg2rad(generator.turns_deg), [0.0, 0.0, 1.0]))[:, :2, :2]
        ways = np.einsum('kij,sjl,kml->ksim', frames, SHAPES, frames)[self.owner]
        self.shapes = np.zeros((len(self.arms), 3, len(SHAPES)))
        self.shapes[:, :2] = np.einsum('nsij,nj->nis', ways, self.arms[:, :2])
        layer = place(REST_LAYER, generator)
        square = grid(9, 1.6 * generator.half_extent)
        flat = generator.middle + np.column_stack([square, np.zeros(len(square))])
        self.places = (flat + HEIGHTS_M[:, None, None] * [0.0, 0.0, 1.0]).reshape(-1, 3)
        self.lattice = along_each_axis(self.places)
        made = flux_basis(*self.lattice, None, layer.positions, layer.directions)
        size = float(np.abs(self.nominal.moments.sum(axis=0)).mean())
        used = slice(len(layer) if modes else 0)
        self.layer = DipoleSites(layer.positions[used], layer.directions[used])
        self.rest = size * np.linalg.svd(made, full_matrices=False)[2][:modes].T[used]

    def dipoles(self, errors: Array) -> Dipoles:
        """Return the dipoles (N + L) of a board with such errors."""
        turns, own = _turned(errors[:, 3:6])[self.owner], self.centres[self.owner]
        arms = self.arms + np.einsum('nis,ns->ni', self.shapes, errors[self.owner, KINDS['shape']])
        arms = np.einsum('nij,nj->ni', turns, arms)
        along = np.einsum('nij,nj->ni', turns, self.nominal.directions)
        moments = np.concatenate([self.nominal.moments, self.rest @ errors[:, KINDS['rest']].T])
        return Dipoles(
            np.concatenate([own + errors[self.owner, :3] + arms, self.layer.positions]),
            np.concatenate([along, self.layer.directions]),
            moments * (1.0 + errors[:, 6] + 1j * errors[:, 7]),
        )

    def columns(self, errors: Array) -> ComplexArray:
        """Return the moments (K, N + L, Q) of the same dipoles by each coil's Q own errors."""
        here, out = self.dipoles(errors), []
        sites = DipoleSites(here.positions, here.directions)
        rest = np.concatenate([np.zeros((len(self.owner), self.rest.shape[1])), self.rest])
        for k in range(len(errors)):
            pairs = []
            for j in (*range(6), *range(8, 11)):
                step = np.zeros_like(errors)
                step[k, j] = STEP
                ahead, behind = (
                    self.dipoles(errors + sign * step).flux(*self.lattice, None)[:, k]
                    for sign in (1.0, -1.0)
                )
                pairs.append((ahead - behind) / (2.0 * STEP))
            found = moments_of_field(*self.lattice, as_real(np.stack(pairs, axis=1)), sites)
            own, strength = here.moments[:, k, None], 1.0 + errors[k, 6] + 1j * errors[k, 7]
            by_strength = own / strength
            parts = [found[:, :6], by_strength, 1j * by_strength, found[:, 6:], strength * rest]
            out.append(np.concatenate(parts, axis=1))
        return np.stack(out)


@dataclass
class _Part:
    """Frames of one body of one fold."""

    stated: Measurements  # at the poses that are stated, or to start from
    fold: int
    is_typed: bool  # whether their poses are stated
    offset: Array  # (F, 6): of the poses from those stated on the plate
    weights: Array  # (F, S)
    now: Measurements  # corrected by the present estimate
    # their residuals, and fluxes with the derivatives by coils' places and axes, at that estimate
    terms: PoseTerms = field(init=False)
    made: tuple[ComplexArray, ComplexArray, ComplexArray] = field(init=False)


@dataclass(frozen=True)
class _Sums:
    """What frames say of all P parameters, and what the step of their poses takes."""

    normal: Array  # (P, P)
    gradient: Array  # (P,)
    answer: Array  # (F, 6, P): by how much poses give way
    step: Array  # (F, 6): of the poses alone
    variance: Array  # (F, 6)
    freedom: float  # pose parameters that the readings determine


@dataclass(frozen=True)
class DrawnFit:
    """Holds a fitted board with what is known of it."""

    model: FieldModel  # without corrections of sensors; its modes are what is open but the frame
    errors: Array  # (K, Q): of the coils, and their standard deviations
    sigma: Array
    changes: Array  # (K,), by how much coils became stronger while they were read, relative
    # (6,), m and rad: of a motion of all coils as one, about the middle of the drawing's places
    frame_sigma: Array
    plate: Array  # (7,): place (m), turn (rad) and scale of the typed places
    sensors: SensorParameters
    posterior: Posterior  # of the sensors' parameters
    evidence: dict[str, float]  # gain of the log probability by each of their kinds
    noise_t: float
    jitter: Array  # (6,): of typed poses
    parts: tuple[_Part, ...]
    # of each part what a fit without its fold leaves, at the poses of the fit to all
    held_out: tuple[PoseTerms, ...]
    freedom: float  # parameters that the readings determine
    steps: int


class DrawnFitter:
    """Fits a drawn board and the errors of sensors, plate and poses.

    ``measurements``: all frames with a pose, stated or to start from, as ``typed`` says of each.
    ``modes``: of what the drawing lacks.
    """

    def __init__(
        self,
        measurements: Sequence[Measurements],
        typed: Sequence[bool],
        generator: Generator,
        kinds: Sequence[str],
        noise_t: float,
        modes: int = REST_MODES,
    ) -> None:
        self.drawing, self.noise_t, self.jitter = Drawing(generator, modes), noise_t, PLACE
        # A single coil's place and gain are the plate's and the board's.
        one = all(len(m.sensors) == 1 for m in measurements)
        kept = [kind for kind in kinds if kind in SENSORS and (kind == 'axes' or not one)]
        tones = generator.frequencies_hz
        self.sensors = SensorParameters(measurements, kept, tones, is_free=False)
        self.parts = list(_parts(measurements, typed))
        self.middle = np.mean(np.concatenate([p.stated.position for p in self.parts]), axis=0)
        self.count, self.each = len(generator.centres), OWN + modes
        self.courses = StrengthCourses(measurements)
        own, changing = self.each * self.count, self.count * self.courses.count
        ends = np.cumsum([own, changing, LEVEL.size, 7, len(self.sensors)]).tolist()
        self.own, self.changing, self.level, self.plate, self.sensed = (
            slice(*pair) for pair in zip([0, *ends[:4]], ends, strict=True)
        )
        self.values, self.width, self.scale = (np.zeros(ends[4]) for _ in range(3))
        self.width[self.level], self.width[self.plate] = LEVEL, PLATE
        table = np.arange(self.each * self.count).reshape(self.count, self.each)
        arms = generator.centres - generator.middle
        self.scale[table[:, :3].ravel()] = arms.ravel() / (arms**2).sum()
        self.rest, start = table[:, KINDS['rest']].ravel(), self.sensed.start
        self.width[self.rest], self.width[self.changing] = REST, NONE
        self.groups = [(table[:, KINDS[kind]].ravel(), width) for kind, width in COIL.items()]
        self.groups += [(start + rows, SENSORS[kind]) for kind, rows in self.sensors.groups()]
        for rows, width in self.groups:
            self.width[rows] = width

    def fit(self, progress: Progress | None = None) -> DrawnFit:
        """Take steps until they are small."""
        self.groups.append((self.rest, REST))
        steps = self._settle(STEPS, progress)
        return self._result([self._sums(part) for part in self.parts], steps)

    def _settle(self, most: int, progress: Progress | None = None) -> int:
        """Take steps until they are small, ``most`` of them; how many they were."""
        self._place(self.values)
        self._weigh(0.0, is_learning=False)
        for step in range(most):
            if progress is not None:
                progress('board, sensors and poses', step / most)
            sums = [self._sums(part) for part in self.parts]
            if self._step(sums, step >= SETTLING) < SMALL and step > SETTLING:
                return step + 1
        return most

    def coils(self) -> Dipoles:
        """Return the dipoles (N) of the drawn coils, in the frame of the typed places.

        What the drawing lacks is left to moments of their own that they get.
        """
        self._settle(PLACING_STEPS)
        shift, turn, scale = np.split(self.values[self.plate], [3, 6])
        back, own = _turned(turn), slice(len(self.drawing.owner))
        places = (self.dipoles.positions[own] - self.middle - shift) @ back / (1.0 + scale)
        return Dipoles(
            self.middle + places, self.dipoles.directions[own] @ back, self.dipoles.moments[own]
        )

    def planned(self) -> FieldModel:
        """Return the drawing with what readings at these poses leave open, by stated widths."""
        self._place(self.values)
        likelihood = self._likelihood([self._sums(part) for part in self.parts])
        return self._model(solve(likelihood, self.width).covariance)[0]

    def errors(self, values: Array) -> Array:
        """Return the coils' errors (K, Q) with what they share."""
        errors = values[self.own].reshape(self.count, -1).copy()
        (real, imaginary), shape = np.split(values[self.level], [2])
        strength = (1.0 + errors[:, 6] + 1j * errors[:, 7]) * (1.0 + real + 1j * imaginary)
        errors[:, 6], errors[:, 7] = strength.real - 1.0, strength.imag
        errors[:, KINDS['shape']] += shape
        return errors

    def _place(self, values: Array) -> None:
        """Bring board, sensors and poses to some values."""
        self.board = self.errors(values)
        self.changes = values[self.changing].reshape(self.count, -1)
        self.dipoles = self.drawing.dipoles(self.board)
        shift, turn, scale = np.split(values[self.plate], [3, 6])
        rotation = _turned(turn)
        sites = DipoleSites(self.dipoles.positions, self.dipoles.directions)
        for part in self.parts:
            there = part.stated
            if part.is_typed:
                arms = (1.0 + scale) * (there.position - self.middle) @ rotation.T
                there = replace(
                    there, position=self.middle + shift + arms, rotation=rotation @ there.rotation
                )
            errors = self.sensors.errors_of(there.body, values[self.sensed])
            now = moved(errors.apply(there), part.offset)
            strengths = self.courses.strengths(now, self.changes)
            part.now = now = replace(now, flux=now.flux / strengths[:, None])
            part.made = flux_slopes(now, sites, self.dipoles.moments)
            slope = pose_slopes(*now.placed(), now.position, *part.made[1:])
            part.terms = PoseTerms(as_real(now.flux) - as_real(part.made[0]), slope)

    def _sums(self, part: _Part) -> _Sums:
        size, terms = self.values.size, part.terms
        jitter = self.jitter if part.is_typed else FREE
        white = PoseWhitener(terms.slope, part.weights, self.noise_t, jitter**-2.0)
        by_shape = self._by_shape(part.now, part.made[0])
        shared = self._shared(part, by_shape)
        root, (frames, sensors) = np.sqrt(part.weights) / self.noise_t, part.weights.shape
        slope = white.slope.reshape(frames, 6, sensors, -1)
        normal, gradient = np.zeros((size, size)), np.zeros(size)
        mixed = np.zeros((frames, 6, size))
        for k, own in enumerate(self._of_coils(part, by_shape)):
            pair = slice(2 * k, 2 * k + 2)
            rows = np.concatenate([own, shared[:, :, pair]], axis=3) * root[:, :, None, None]
            rows = rows.reshape(frames, 2 * sensors, -1)
            changes = self.changing.start + self.courses.count * (k + np.arange(2))
            own_rows = slice(self.each * k, self.each * (k + 1))
            at = np.r_[own_rows, slice(*changes), self.level.start : size]
            flat = rows.reshape(-1, at.size)
            normal[np.ix_(at, at)] += flat.T @ flat
            gradient[at] += flat.T @ (terms.residual[:, :, pair] * root[:, :, None]).ravel()
            mixed[:, :, at] += slope[..., pair].reshape(frames, 6, -1) @ rows
        answer = white.inverse @ mixed
        step = white.step(terms.residual, part.offset)
        flat_mixed = mixed.reshape(-1, size)
        normal -= flat_mixed.T @ answer.reshape(-1, size)
        gradient -= flat_mixed.T @ step.ravel()
        variance = np.diagonal(white.inverse, axis1=1, axis2=2)
        return _Sums((normal + normal.T) / 2.0, gradient, answer, step, variance, white.freedom)

    def _by_shape(self, now: Measurements, flux: ComplexArray) -> ComplexArray:
        """Derivatives (F, S, K, 3) of fluxes by the shape of the windings."""
        points, axes = (of_all.reshape(-1, 3) for of_all in now.placed())
        lengths, out = np.tile(now.sensors.length, len(now.time)), []
        for unit in np.eye(self.each)[KINDS['shape']]:
            made = self.drawing.dipoles(self.board + STEP * unit).flux(points, axes, lengths)
            out.append((made.reshape(flux.shape) - flux) / STEP)
        return np.stack(out, axis=-1)

    def _shared(self, part: _Part, by_shape: ComplexArray) -> Array:
        """Derivatives (F, S, 2K, .) by what all coils share: level, plate and sensors."""
        now, flux = part.now, part.made[0]
        whole = (flux, 1j * flux, *np.moveaxis(by_shape, -1, 0))
        level = np.stack([as_real(one) for one in whole], axis=-1)
        ways = np.zeros((len(now.time), 6, 7))
        if part.is_typed:
            ways[:, :3, :6] = _carried(now.position, self.middle)
            ways[:, 3:, 3:6] = np.eye(3)
            ways[:, :3, 6] = now.position - self.middle
        plate = np.einsum('fsci,fij->fscj', part.terms.slope, ways, optimize=True)
        still = np.zeros((len(now.time), 6))
        by_sensors = as_real(self.sensors.derivatives(now, *part.made, still))
        return np.concatenate([level, plate, by_sensors.transpose(0, 1, 3, 2)], axis=3)

    def _of_coils(self, part: _Part, by_shape: ComplexArray) -> Iterator[Array]:
        """Yield the derivatives (F, S, 2, .) of each coil's fluxes by its errors and changes."""
        now, (flux, by_place, by_axis) = part.now, part.made
        (points, axes), ways = now.placed(), self.courses.of(now)
        rest = (basis_rows(now, self.drawing.layer) @ self.drawing.rest).reshape(
            *flux.shape[:2], -1
        )
        for k, errors in enumerate(self.board):
            arms = points - self.drawing.centres[k] - errors[:3]
            turn = np.cross(arms, by_place[..., k]) + np.cross(axes, by_axis[..., k])
            strength = 1.0 + errors[6] + 1j * errors[7]
            own = flux[..., k, None] / strength
            shape = by_shape[..., k, :]
            late = flux[..., k, None] * ways[:, None]
            each = [-by_place[..., k], -turn, own, 1j * own, shape, strength * rest]
            whole = np.concatenate([*each, late, 1j * late], axis=-1)
            yield np.stack([whole.real, whole.imag], axis=2)

    def _likelihood(self, sums: Sequence[_Sums]) -> Likelihood:
        normal = np.sum([one.normal for one in sums], axis=0)
        gradient = np.sum([one.gradient for one in sums], axis=0)
        # Of the scale, whose most probable value is none: it is no part of the natural values.
        prior = np.outer(self.scale, self.scale) / SCALE**2
        return Likelihood(normal + prior, gradient + normal @ self.values)

    def _step(self, sums: Sequence[_Sums], is_learning: bool) -> float:
        """Take a step; return its size in standard deviations."""
        likelihood = self._likelihood(sums)
        found = solve(likelihood, self.width)
        for _ in range(WIDTH_STEPS if is_learning else 0):
            for rows, stated in self.groups:
                ratio = np.diag(found.covariance)[rows] / self.width[rows] ** 2
                self.width[rows] = _learnt(found.values[rows], ratio, stated)
            found = solve(likelihood, self.width)
        if is_learning:
            changes = np.arange(self.changing.start, self.changing.stop)
            found = let_change(likelihood, found, list(changes.reshape(2 * self.count, -1)))
            self.width = found.width
        change, self.values = found.values - self.values, found.values
        for part, one in zip(self.parts, sums, strict=True):
            part.offset = part.offset + one.step - one.answer @ change
        if is_learning:
            self._learn_jitter(sums)
        self._place(self.values)
        used = float((found.covariance * likelihood.information).sum())
        self._weigh(used + sum(one.freedom for one in sums), is_learning)
        return float((np.abs(change) / np.maximum(found.sigma, 1e-15)).max())

    def _learn_jitter(self, sums: Sequence[_Sums]) -> None:
        typed = [(p, one) for p, one in zip(self.parts, sums, strict=True) if p.is_typed]
        if typed:
            offset = np.concatenate([part.offset for part, _ in typed])
            ratio = np.concatenate([one.variance for _, one in typed]) / self.jitter**2
            new = [
                _learnt(offset[:, own], ratio[:, own], float(PLACE[own][0]))
                for own in (slice(0, 3), slice(3, 6))
            ]
            self.jitter = np.repeat(new, 3)

    def _weigh(self, used: float, is_learning: bool) -> None:
        """Weigh the readings, and estimate the noise, less ``used`` degrees of freedom."""
        power = count = 0.0
        for part in self.parts:
            left = part.terms.residual
            if is_learning:
                part.weights = outlier_weights(left, usable_weights(part.now))
            power += float((part.weights[:, :, None] * left**2).sum())
            count += float(part.weights.sum()) * left.shape[2]
        self.noise_t = max(
            float(np.sqrt(power / max(count - used, 0.05 * count))), SMALLEST_NOISE_T
        )

    def _result(self, sums: Sequence[_Sums], steps: int) -> DrawnFit:
        likelihood = self._likelihood(sums)
        found, held_out = solve(likelihood, self.width), []
        for part in self.parts:
            rest = [s for s, p in zip(sums, self.parts, strict=True) if p.fold != part.fold]
            self._place(solve(self._likelihood(rest), self.width).values)
            held_out.append(part.terms)
        # A gain that all sensors share is the board's.
        gains, common = self.sensors.by_rule(found.values[self.sensed])
        level = (1.0 + found.values[self.level][:2] @ [1.0, 1j]) * common
        self.values = found.values.copy()
        self.values[self.sensed] = gains
        self.values[self.level][:2] = level.real - 1.0, level.imag
        self._place(self.values)
        model, frame_sigma = self._model(found.covariance)
        sensed = replace(
            found, values=gains, width=self.width[self.sensed],
            covariance=found.covariance[self.sensed, self.sensed],
        )  # fmt: skip
        evidence = {}
        for kind in self.sensors.kinds:
            without = self.width.copy()
            without[self.sensed.start + self.sensors.rows(kind)] = NONE
            evidence[kind] = found.evidence - solve(likelihood, without).evidence
        each = [self.courses.strengths(part.now, self.changes) for part in self.parts]
        last = np.argmax(np.concatenate([part.now.time for part in self.parts]))
        return DrawnFit(
            model, self.board, found.sigma[self.own].reshape(self.count, -1),
            np.concatenate(each)[last].real - 1.0, frame_sigma, found.values[self.plate],
            self.sensors, sensed, evidence, self.noise_t, self.jitter, tuple(self.parts),
            tuple(held_out),
            float((found.covariance * likelihood.information).sum()), steps,
        )  # fmt: skip

    def _model(self, covariance: Array) -> tuple[FieldModel, Array]:
        """The field's model with its modes, and the frame's part (6,) of what is open.

        The frame's motion is that which makes the field over the board most like a given one.
        """
        # The product of strength and gains is known, though neither is by itself.
        known, first = np.eye(len(covariance)), self.sensed.start + self.sensors.rows('gains')
        for phase, rows in enumerate(first.reshape(-1, 2).T):
            known[self.level.start + phase, rows] = 1.0 / max(len(rows), 1)
        covariance = known @ covariance @ known.T
        drawing, here, each, size = self.drawing, self.dipoles, self.each, self.own.stop
        columns = drawing.columns(self.board)
        basis = flux_basis(*drawing.lattice, None, here.positions, here.directions)
        lift = np.zeros((size, len(covariance)))
        lift[:, :size] = np.eye(size)
        for j in range(LEVEL.size):
            lift[6 + j : size : each, self.level.start + j] = 1.0
        motion = np.zeros((self.count, each, 6))
        motion[:, :3] = _carried(drawing.centres + self.board[:, :3], self.middle)
        motion[:, 3:6, 3:] = np.eye(3)
        weight = 1.0 / np.linalg.norm(basis @ here.moments, axis=1)[:, None]
        made = [weight * (basis @ of_coil) for of_coil in columns]
        moving = np.concatenate([m @ v for m, v in zip(made, motion, strict=True)])
        whole = np.zeros((len(moving), size), complex)
        for k, block in enumerate(made):
            rows = slice(k * len(block), (k + 1) * len(block))
            whole[rows, each * k : each * (k + 1)] = block
        to_motion = np.linalg.lstsq(as_rows(moving), as_rows(whole), rcond=None)[0]
        open_all = lift @ covariance @ lift.T
        frame = to_motion @ open_all @ to_motion.T
        still = np.eye(size) - motion.reshape(size, 6) @ to_motion
        modes = self._modes(still @ open_all @ still.T, columns, as_rows(whole))
        arms = _carried(drawing.places, self.middle)
        shift = np.sqrt(np.einsum('pij,jk,pik->', arms, frame, arms) / (3.0 * len(arms)))
        nominal = drawing.nominal
        model = FieldModel(
            here.positions, here.directions, here.moments, nominal.emitters,
            nominal.frequencies_hz, modes=modes, shift_sigma_m=float(shift),
        )  # fmt: skip
        return model, np.sqrt(np.diag(frame))

    def _modes(self, covariance: Array, columns: ComplexArray, flux: Array) -> ComplexArray:
        """The strongest modes (R, N + L, K) of what is open of the field."""
        values, vectors = np.linalg.eigh((covariance + covariance.T) / 2.0)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        _, turn = np.linalg.eigh((flux @ root).T @ (flux @ root))
        best = (root @ turn[:, ::-1][:, :MOST_MODES]).reshape(self.count, self.each, -1)
        return np.ascontiguousarray((columns @ best).transpose(2, 1, 0))


def as_rows(values: ComplexArray) -> Array:
    """Return complex rows (M, P) as twice as many real ones."""
    return np.concatenate([values.real, values.imag])


def _learnt(values: Array, ratio: Array, stated: float) -> float:
    """Width of a population by its values, and by what is stated of it."""
    if not values.size:
        return stated
    freedom = values.size - float(ratio.sum())
    square = float((values**2).sum()) + STATED * stated**2
    return min(float(np.sqrt(square / (freedom + STATED))), WIDEST * stated)


def is_of_coils(nominal: FieldModel) -> bool:
    """Return whether each of a model's dipoles is of one emitter, and each emitter has some."""
    used = nominal.moments != 0.0
    return bool((used.sum(axis=1) == 1).all() and used.any(axis=0).all())


def drawn_where_read(measurements: Sequence[Measurements], generator: Generator) -> Dipoles:
    """Return the dipoles (N) of a drawing's coils where readings with a pose put them."""
    some = thinned(measurements, MOST_READINGS)
    return DrawnFitter(some, [True] * len(some), generator, (), 0.0, modes=0).coils()


def _parts(measurements: Sequence[Measurements], typed: Sequence[bool]) -> Iterator[_Part]:
    """The frames, those of each fold apart."""
    folds = fold_of_frames([m.position for m in measurements])
    for whole, fold, stated in zip(measurements, folds, typed, strict=True):
        for one in np.unique(fold).tolist():
            m = whole.frames(fold == one)
            yield _Part(m, one, stated, np.zeros((len(m.time), 6)), usable_weights(m), m)
