"""Makes a problem of measurements, predicts and whitens its residuals.

First the whitening and the problem itself with its states; then what makes one of a session: the
emitters' field, bins of references, blocks of time.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from anser_ros.arrays import AnyArray, Array, Booleans, ComplexArray, Integers
from anser_ros.diagnosis.engine import JointState, width_of
from anser_ros.effects.base import Apparatus, View
from anser_ros.effects.correction import Fields, reference_view, tool_view
from anser_ros.effects.effect import Remedy, Term
from anser_ros.errors import DiagnosisError
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import Dipoles, FieldModel
from anser_ros.parallel import in_order, slices, slices_of
from anser_ros.physics.dipole import field_basis, flux_basis
from anser_ros.settings import Accuracy

REFERENCE_CHANGE = 0.01
"""Relative error of the change that a reference sensor with the default survey errors sees."""
CHANGE_LENGTH_M = 0.03
"""Way over which what metal does to a reference changes by its own size, m: a third of the
distance, for metal some 10 cm away."""
FRAMES_AT_ONCE = 16
"""Frames that are whitened at once: a megabyte or two, which stay in the cache."""
FRAMES_A_THREAD = 8 * FRAMES_AT_ONCE
"""Frames that one thread whitens, a millisecond's work."""


def _survey_share(accuracy: Accuracy) -> float:
    """Relative error of a change, to first order: gain, axis and place in quadrature."""
    place = accuracy.reference_position_m / CHANGE_LENGTH_M
    return float(np.linalg.norm([accuracy.reference_gain, accuracy.reference_axis_rad, place]))


@dataclass(frozen=True)
class Spread:
    """Holds standard deviations that are expected when all is well."""

    # Noise of a phasor component, the model's own error included, T.
    flux_t: float = Accuracy.flux_noise_t
    # Of the instruments: the noise when all is well, optical jitter, the references' survey.
    accuracy: Accuracy = field(default_factory=Accuracy)

    @property
    def noise_t(self) -> float:
        """Return the part of ``flux_t`` that is noise when all is well, T."""
        return self.accuracy.flux_noise_t

    @property
    def reference_change(self) -> float:
        """Return the relative error of the change that a reference sees, by the survey's."""
        return REFERENCE_CHANGE * (_survey_share(self.accuracy) / _survey_share(Accuracy()))


def parts(values: ComplexArray) -> Array:
    """Return real, then imaginary parts of values (F, S, K, ...), flattened to (F, 2 S K, ...)."""
    flat = values.reshape(values.shape[0], values.shape[1] * values.shape[2], *values.shape[3:])
    return np.concatenate([flat.real, flat.imag], axis=1)


@dataclass(frozen=True)
class Whitener:
    """Multiplies each frame by the inverse square root of its covariance."""

    weight: Array  # (F, n), inverse noise; 0 where a value must not count
    # (F, n, m), weighted directions along which a frame may move, a standard deviation long.
    basis: Array | None = None
    inner: Array | None = None  # (F, m, m), what is taken off between the two projections
    # What -2 log likelihood grows by with the directions beyond the pose's (their log det).
    penalty: float = 0.0

    @staticmethod
    def of(weight: Array, directions: Array, known: int = 0) -> 'Whitener':
        """Make it from weights (F, n) and directions (F, n, m), the first ``known`` a pose's."""
        basis = directions * weight[..., None]
        gram = basis.transpose(0, 2, 1) @ basis
        values, vectors = np.linalg.eigh(gram)
        values = np.maximum(values, 0.0)
        # (I + A A^T)^(-1/2) = I - A V diag(g) V^T A^T with g = (1 - 1/sqrt(1 + s^2)) / s^2.
        shrink = np.where(
            values > 1e-9, (1 - 1 / np.sqrt(1 + values)) / np.maximum(values, 1e-12), 0.5
        )
        inner = (vectors * shrink[:, None, :]) @ vectors.transpose(0, 2, 1)
        penalty = 0.0
        if basis.shape[2] > known:
            pose = np.eye(known) + gram[:, :known, :known]
            penalty = float(np.log1p(values).sum() - np.linalg.slogdet(pose)[1].sum())
        return Whitener(weight, basis, inner, penalty)

    def rows(self, frames: Integers) -> 'Whitener':
        """Return the whitener of some frames, chosen by index."""
        if self.basis is None or self.inner is None:
            return Whitener(self.weight[frames])
        return Whitener(self.weight[frames], self.basis[frames], self.inner[frames])

    def first(self, count: int) -> 'Whitener':
        """Return the whitener with only the first ``count`` directions."""
        if self.basis is None or count == self.basis.shape[2]:
            return self
        if count == 0:
            return Whitener(self.weight)
        weight = np.where(self.weight > 0, self.weight, 1.0)
        return Whitener.of(self.weight, self.basis[..., :count] / weight[..., None], count)

    def __call__(self, values: Array) -> Array:
        """Return values of shape (F, n) or (F, n, q), whitened."""
        out = (values[..., None] if values.ndim == 2 else values) * self.weight[..., None]
        in_order(lambda rows: self._project(out, rows), slices(len(out), FRAMES_AT_ONCE))
        return out.reshape(values.shape)

    def columns(self, groups: Sequence[ComplexArray | None], widths: Sequence[int]) -> Array:
        """Return groups of columns (F, S, K, q) side by side, whitened, shape (F, n, all q).

        ``widths``: q of each group; the columns of one that is missing are zero.
        """
        make = np.zeros if any(group is None for group in groups) else np.empty
        out, half = make((*self.weight.shape, sum(widths))), self.weight.shape[1] // 2
        ends = np.cumsum(widths).tolist()

        def work(mine: slice) -> None:
            for rows in slices_of(mine, FRAMES_AT_ONCE):
                weight = self.weight[rows, :, None]
                for group, end, width in zip(groups, ends, widths, strict=True):
                    if group is not None:
                        flat, own = group[rows].reshape(-1, half, width), slice(end - width, end)
                        np.multiply(flat.real, weight[:, :half], out=out[rows, :half, own])
                        np.multiply(flat.imag, weight[:, half:], out=out[rows, half:, own])
                self._project(out, rows)

        in_order(work, slices(len(out), FRAMES_A_THREAD))
        return out

    def _project(self, out: Array, rows: slice) -> None:
        """Take off what weighted values (F, n, q) of some frames have along the basis."""
        if self.basis is not None and self.inner is not None:
            basis = self.basis[rows]
            out[rows] -= basis @ (self.inner[rows] @ (basis.transpose(0, 2, 1) @ out[rows]))


@dataclass(frozen=True)
class References:
    """Holds reference readings as means over short bins, with their clean baseline."""

    readings: Measurements  # one frame a bin; ``valid`` where the bin has any reading
    count: Array  # (B, R), readings in each mean
    baseline: ComplexArray  # (R, K)


@dataclass(frozen=True)
class Problem:
    """Holds everything that a diagnosis starts from."""

    tools: tuple[Measurements, ...]  # frames with a pose only
    blocks: tuple[Integers, ...]  # (F,), number of the time block that each frame is in
    references: References | None
    reference_blocks: Integers  # (B,)
    fields: Fields
    apparatus: Apparatus
    spread: Spread
    good: tuple[Booleans, ...]  # (F, S), values that take part (valid, and no outliers)
    # (F, S), by how much a modelled flux may be off where the model's scan has gaps, T a
    # component.
    gaps_t: tuple[Array, ...]

    def frames(self, keep: Sequence[AnyArray], bins: AnyArray) -> 'Problem':
        """Return the frames of each tool, and the bins, that are named by index or mask."""
        references = self.references
        if references is not None:
            references = References(
                references.readings.frames(bins), references.count[bins], references.baseline
            )
        return replace(
            self,
            tools=tuple(tool.frames(rows) for tool, rows in zip(self.tools, keep, strict=True)),
            blocks=tuple(b[rows] for b, rows in zip(self.blocks, keep, strict=True)),
            good=tuple(g[rows] for g, rows in zip(self.good, keep, strict=True)),
            gaps_t=tuple(g[rows] for g, rows in zip(self.gaps_t, keep, strict=True)),
            references=references,
            reference_blocks=self.reference_blocks[bins],
        )

    def thinned(self, frames: int) -> 'Problem':
        """Return the problem with about so many frames of a tool, and all of the references."""
        most = max((tool.time.size for tool in self.tools), default=0)
        step = max(1, round(most / frames))
        keep = [np.arange(0, tool.time.size, step) for tool in self.tools]
        return self.frames(keep, np.arange(self.reference_blocks.size))

    def in_blocks(self, wanted: Integers, step: int = 1) -> 'Problem':
        """Return every ``step``-th frame of some blocks, with the bins of those blocks."""
        keep = [np.flatnonzero(np.isin(blocks, wanted))[::step] for blocks in self.blocks]
        return self.frames(keep, np.flatnonzero(np.isin(self.reference_blocks, wanted)))


@dataclass(frozen=True)
class Part:
    """Holds one body's prediction, residual and whitener at one state."""

    view: View
    residual: Array
    whitener: Whitener
    white: Array
    blocks: Integers

    @property
    def count(self) -> int:
        """Return the number of values that have a weight."""
        return int(np.count_nonzero(self.whitener.weight))

    def rms(self, axis: int) -> Array:
        """Return the root mean square of what counts of each frame (axis 1) or value (0)."""
        good = self.whitener.weight > 0
        power = (self.white**2 * good).sum(axis=axis) / np.maximum(good.sum(axis=axis), 1)
        return np.asarray(np.sqrt(power))

    def power(self) -> dict[int, Array]:
        """Return the mean square of each channel's residuals, by emitter, (K,)."""
        power = (self.rms(0) ** 2).reshape(2, *self.view.flux.shape[1:]).mean(axis=0)
        return dict(zip(self.view.sensors.channel.tolist(), power, strict=True))

    def frames(self, rows: Integers) -> 'Part':
        """Return the part of some frames, chosen by index."""
        return Part(
            self.view.frames(rows), self.residual[rows], self.whitener.rows(rows),
            self.white[rows], self.blocks[rows],
        )  # fmt: skip


@dataclass(frozen=True)
class State(JointState[Term, Part]):
    """Holds a problem of fluxes with a list of active effects."""

    problem: Problem

    @property
    def penalty(self) -> float:
        """Return what the freedom that fluctuating effects leave to each frame costs."""
        return float(sum(part.whitener.penalty for part in self.parts))

    def moved(self, terms: Sequence[Term]) -> 'State':
        """Return the state of the same problem with other terms."""
        return evaluate(self.problem, terms)

    def design(self, term: Term, probe: bool = False) -> list[Array | None]:
        """Return whitened columns of a term, one array (F, n, q) a part, None for no columns."""
        return self.designs([term], probe)

    def designs(self, terms: Sequence[Term], probe: bool = False) -> list[Array | None]:
        """Return whitened columns of terms side by side, one array (F, n, q) a part, or None."""
        raw = [
            [(t.effect.probe if probe else t.effect.columns)(t, part.view) for t in terms]
            for part in self.parts
        ]
        widths = [width_of(group) for group in zip(*raw, strict=True)]
        return [
            part.whitener.columns(own, widths) if any(r is not None for r in own) else None
            for part, own in zip(self.parts, raw, strict=True)
        ]


def evaluate(problem: Problem, terms: Sequence[Term]) -> State:
    """Predict all readings with some active effects, and whiten what they differ by."""
    found = []
    for tool, blocks, good, gaps_t in zip(
        problem.tools, problem.blocks, problem.good, problem.gaps_t, strict=True
    ):
        if tool.time.size == 0:
            continue
        view = tool_view(tool, terms, problem.fields)
        residual = parts(np.where(good[..., None], tool.flux - view.flux, 0.0))
        weight = good / np.hypot(problem.spread.flux_t, gaps_t)
        weight = np.tile(np.repeat(weight, tool.flux.shape[2], axis=1), 2)
        columns = np.moveaxis(np.concatenate([view.d_position, view.d_turn], axis=2), 2, -1)
        pose = parts(columns) * problem.spread.accuracy.pose_jitter
        whitener = Whitener.of(weight, _with_free(pose, terms, view), pose.shape[2])
        found.append(Part(view, residual, whitener, whitener(residual), blocks))
    if problem.references is not None and problem.references.readings.time.size:
        found.append(_reference_part(problem, problem.references, terms))
    return State(problem, tuple(terms), tuple(found))


def _with_free(known: Array, terms: Sequence[Term], view: View) -> Array:
    """Directions (F, n, m) that are known, and those that fluctuating effects leave open."""
    found = [term.effect.directions(term, view) for term in terms]
    return np.concatenate([known, *(parts(d) for d in found if d is not None)], axis=2)


def _reference_part(problem: Problem, references: References, terms: Sequence[Term]) -> Part:
    readings, good = references.readings, references.readings.valid

    def predicted(some: Sequence[Term]) -> View:
        return reference_view(readings, references.baseline, some, problem.fields)

    view = predicted(terms)
    residual = parts(np.where(good[..., None], readings.flux - view.flux, 0.0))
    # A survey error is the same in every bin: shared among B bins it must count B times as much.
    unchanged = predicted([term for term in terms if term.effect.remedy is not Remedy.FIELD])
    change = np.where(good[..., None], readings.flux - unchanged.flux, 0.0)
    size = np.sqrt(np.mean(np.abs(change) ** 2, axis=2, keepdims=True) / 2)
    noise = problem.spread.flux_t / np.sqrt(np.maximum(references.count, 1))
    together = np.sqrt(readings.time.size)
    survey = problem.spread.reference_change * size * together
    gradient = np.zeros_like(view.flux.real)
    for term in terms:
        if term.effect.gradient_error:
            shifted = np.abs(predicted([term]).flux - references.baseline)
            gradient += term.effect.gradient_error * shifted * together
    spread = np.sqrt(noise[..., None] ** 2 + survey**2 + gradient**2)
    weight = np.where(good[..., None], 1 / spread, 0.0).reshape(good.shape[0], -1)
    weight = np.tile(weight, 2)
    free = _with_free(np.zeros((*weight.shape, 0)), terms, view)
    whitener = Whitener.of(weight, free) if free.shape[2] else Whitener(weight)
    return Part(view, residual, whitener, whitener(residual), problem.reference_blocks)


def tool_parts(state: State) -> list[Part]:
    """Return the parts of a state that are tools, not references."""
    return [part for part in state.parts if not part.view.is_reference]


def tools_misfit(state: State) -> float:
    """Return the mean square of the tools' whitened residuals."""
    tools = tool_parts(state)
    squares = sum(float(np.sum(part.white**2)) for part in tools)
    return squares / max(sum(part.count for part in tools), 1)


def rms(state: State) -> float:
    """Return the residual of the tools with the jitter taken out, T a phasor component.

    All readings count alike, also where the model's scan has gaps.
    """
    problem = state.problem
    if any(gaps_t.any() for gaps_t in problem.gaps_t):
        alike = replace(problem, gaps_t=tuple(np.zeros_like(g) for g in problem.gaps_t))
        state = evaluate(alike, state.terms)
    return float(np.sqrt(tools_misfit(state))) * problem.spread.flux_t


def expected_rms(state: State) -> float:
    """Return what that residual should be: noise, and what the model may be wrong by."""
    problem = state.problem
    pairs = zip(problem.gaps_t, problem.good, strict=True)
    gaps_t = np.concatenate([gaps_t[good] for gaps_t, good in pairs])
    power = float(np.mean(gaps_t**2)) if gaps_t.size else 0.0
    return float(np.hypot(problem.spread.flux_t, np.sqrt(power)))


VOLUME_ERROR = 1e-3
"""Relative error that the fit allows the model in the volume, a quarter of a reference's."""
LEAST_ERROR = 1e-5
"""Relative error that references have at least, so that exact ones do not divide by zero."""
DRAWING_ERROR = 0.05
"""Prior spread of the sheet's moments about the drawn ones, as a share of their rms: a coil's
moment is off by 2 % (`field.nominal.GAIN`), and half a millimetre moves a few percent of it."""


def board_box(model: FieldModel) -> Array:
    """Return the two corners of the model's dipoles that carry the field, shape (2, 3), m."""
    strength = np.abs(model.moments).max(axis=1)
    used = model.positions[strength > 1e-3 * strength.max()]
    return np.stack([used.min(axis=0), used.max(axis=0)])


def fit_illumination(
    model: FieldModel,
    drawn: FieldModel | None,
    points: Array,
    references: References | None,
    gain_error: float,
) -> Dipoles:
    """Return a sheet of dipoles that is good in the volume, at the references and below the board.

    ``model``: trusted at ``points`` (P, 3), m, in the volume; ``drawn``: the nominal model of the
    setup's geometry, without which the model itself is all that there is; ``gain_error``: relative
    error of the references' gains.
    """
    if drawn is None:
        return model.dipoles
    place, direction = drawn.positions, drawn.directions
    basis = field_basis(points, place, direction).transpose(0, 2, 1).reshape(-1, len(place))
    wanted = model.dipoles.field(points)
    wanted = wanted.reshape(-1, wanted.shape[2])
    # Complex gain of each emitter that brings the drawn field nearest to the wanted one.
    near = basis @ drawn.moments
    power = np.sum(np.abs(near) ** 2, axis=0)
    gain = np.sum(near.conj() * wanted, axis=0) / np.where(power > 0, power, 1.0)
    start = drawn.moments * gain
    scale = VOLUME_ERROR * np.sqrt(np.mean(np.abs(wanted) ** 2))
    rows, values = [basis / scale], [(wanted - basis @ start) / scale]
    if references is not None:
        s, clean = references.readings.sensors, references.baseline
        sheet = flux_basis(s.position, s.axis, s.length, place, direction)
        weight = max(gain_error, LEAST_ERROR) * np.sqrt(np.mean(np.abs(clean) ** 2))
        rows.append(sheet / weight)
        values.append((clean - sheet @ start) / weight)
    spread = DRAWING_ERROR * np.sqrt(np.mean(np.abs(start) ** 2))
    matrix, target = np.concatenate(rows) * spread, np.concatenate(values)
    normal = matrix.T @ matrix + np.eye(len(place))
    change = np.linalg.solve(normal, matrix.T @ target) * spread
    return Dipoles(place, direction, start + change)


BLOCKS = 25
"""Blocks of time in a session: longer than what is alike from frame to frame, and enough of them
to hold some out and still have every pose in the rest."""
TEST_EVERY = 5
"""One block of five never takes part in choosing or fitting."""
BINS_PER_BLOCK = 2
"""Means of the references in each block of time: they don't move, so more add nothing."""
FEWEST_POSED_FRAMES = 30
"""Frames with an optical pose that a diagnosis needs, about one in each block."""
POINTS = 250
"""Places in the volume, about, at which the emitters' own field is fitted to the model."""
MARGIN_S = 0.15
"""Time (s) by which fluxes may lie outside the optical track: a time offset may bring them in."""


def test_blocks() -> Integers:
    """Return the numbers of the blocks that are held out to the end."""
    return np.arange(TEST_EVERY // 2, BLOCKS, TEST_EVERY)


def train_blocks() -> Integers:
    """Return the numbers of the blocks that effects are chosen and fitted on."""
    return np.setdiff1d(np.arange(BLOCKS), test_blocks())


def build_problem(
    tools: Sequence[Measurements],
    reference: Measurements | None,
    baseline: ComplexArray | None,
    model: FieldModel,
    drawn: FieldModel | None,
    spread: Spread,
) -> Problem:
    """Set up the diagnosis of a session.

    ``tools``: bodies without an optical pose are left out; ``baseline`` (R, K): clean readings of
    the reference sensors (NaN where there are none); without them the references say nothing;
    ``drawn``: the nominal model of the setup, if its kind of emitter has one. Raises
    `DiagnosisError` when a sensor is a sum of windings, fewer than 30 frames have fluxes and a
    pose, or all poses are the same.
    """
    for tool in tools:
        if not tool.sensors.is_single.all():
            name = tool.sensors.name[int(np.argmin(tool.sensors.is_single))]
            raise DiagnosisError(f'{name} has windings: a diagnosis takes single coils only')
    posed = tuple(t for t in (_with_pose(tool) for tool in tools) if t.time.size)
    count = sum(tool.time.size for tool in posed)
    if count < FEWEST_POSED_FRAMES:
        raise DiagnosisError(
            f'a diagnosis needs at least {FEWEST_POSED_FRAMES} frames with an optical pose, '
            f'got {count}'
        )
    if not any(
        np.ptp(t.position, axis=0).any() or np.ptp(t.rotation, axis=0).any() for t in posed
    ):
        raise DiagnosisError(
            f'all {count} optical poses are the same: a diagnosis needs a tool that moves'
        )
    start, end = min(tool.time[0] for tool in posed), max(tool.time[-1] for tool in posed)
    edges = np.linspace(start, end + 1e-9, BLOCKS + 1)
    references, reference_blocks = None, np.zeros(0, dtype=np.int64)
    if reference is not None and baseline is not None:
        references = _binned(reference, baseline, edges)
    if references is not None:
        reference_blocks = _numbers(references.readings.time, edges)
    centres = np.concatenate([tool.placed()[0].reshape(-1, 3) for tool in posed])
    some = centres[:: max(1, centres.shape[0] // POINTS)]
    gain_error = spread.accuracy.reference_gain
    illumination = fit_illumination(model, drawn, some, references, gain_error)
    omega = 2 * np.pi * np.asarray(model.frequencies_hz)
    fields = Fields(model.dipoles, illumination, omega)
    apparatus = Apparatus(
        tools=tuple(tool.sensors for tool in posed), emitters=omega.size, omega=omega,
        references=None if references is None else references.readings.sensors,
        duration=float(end - start), illumination=illumination, board=board_box(drawn or model),
        visited_box=np.stack([centres.min(axis=0), centres.max(axis=0)]),
    )  # fmt: skip
    return Problem(
        tools=posed, blocks=tuple(_numbers(tool.time, edges) for tool in posed),
        references=references, reference_blocks=reference_blocks, fields=fields,
        apparatus=apparatus, spread=spread, good=tuple(tool.valid.copy() for tool in posed),
        gaps_t=tuple(model.error_t(*t.placed(), t.sensors.length) for t in posed),
    )  # fmt: skip


def _numbers(time: Array, edges: Array) -> Integers:
    return np.clip(np.searchsorted(edges, time, side='right') - 1, 0, BLOCKS - 1)


def _with_pose(tool: Measurements) -> Measurements:
    keep = tool.has_pose & tool.valid.any(axis=1)
    if tool.track is not None and tool.track.time.size > 1:
        track = tool.track
        keep &= (tool.time >= track.time[0] - MARGIN_S) & (tool.time <= track.time[-1] + MARGIN_S)
    return tool.frames(np.flatnonzero(keep))


def _binned(reference: Measurements, baseline: ComplexArray, edges: Array) -> References | None:
    """Means over equal bins of time, two a block."""
    known = np.isfinite(baseline).all(axis=1) & reference.valid.any(axis=0)
    if not known.any():
        return None
    readings = reference.sensors_only(np.flatnonzero(known))
    fine = np.interp(
        np.linspace(0, BLOCKS, BINS_PER_BLOCK * BLOCKS + 1), np.arange(BLOCKS + 1), edges
    )
    inside = (readings.time >= fine[0]) & (readings.time < fine[-1])
    readings = readings.frames(np.flatnonzero(inside))
    number = np.searchsorted(fine, readings.time, side='right') - 1
    if number.size == 0:
        return None
    flux, count, time = [], [], []
    for bin_number in np.unique(number):
        rows = number == bin_number
        good = readings.valid[rows]
        n = good.sum(axis=0)
        total = np.where(good[..., None], readings.flux[rows], 0.0).sum(axis=0)
        flux.append(total / np.maximum(n, 1)[:, None])
        count.append(n)
        time.append(float(readings.time[rows].mean()))
    counts, n_bins = np.array(count), len(time)
    binned = Measurements(
        body=readings.body, sensors=readings.sensors, time=np.array(time), flux=np.array(flux),
        valid=counts > 0, flags=np.zeros(counts.shape, dtype=np.int64),
        position=np.zeros((n_bins, 3)), rotation=np.broadcast_to(np.eye(3), (n_bins, 3, 3)),
        has_pose=np.ones(n_bins, dtype=bool),
    )  # fmt: skip
    return References(binned, counts.astype(np.float64), baseline[known])
