"""Finds what is wrong with a scan's own sensors, clock and optics, together with the field.

Every step solves for the field and all parameters at once, with the poses marginalised
(`joint_system`), and then weights the parameters with the widths of their populations
(`population`). The noise of the fluxes and the jitter of the poses are estimated from the
residuals, and frames that no step explains are left out (`disturbances`). At last every session
gets its own parameters: values that two sessions give for a sensor must agree (`contradictions`).

Values that the data cannot determine follow a rule. A gain that all sensors share is attributed to
the emitters: the mean of the gains is one. A shift that all sensors of a body share is its lever
arm: the mean of their places is zero. The frame is the optical tracker's, and so is that of the
body: a rotation that all axes share is part of their tilts. If a scan does not turn the tool, a
shift of all sensors is one of the field, which the drawing fixes.
"""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np

from anser_ros.arrays import Array, Booleans, ComplexArray, Integers, as_real
from anser_ros.calibration.disturbances import glitches, outside, spans_of, unsteady_tool
from anser_ros.calibration.joint_system import (
    LEAST_MOST_MODES,
    MODES_WORK,
    MOST_MODES,
    POSES_A_MODE,
    Eliminated,
    FieldModes,
    JointSystem,
    Linear,
    linearise,
    open_directions,
    tied_parts,
)
from anser_ros.calibration.layout_fit import (
    RICH_DAMPING,
    ScaledNominal,
    free_bases,
    rich_layout,
    richest,
)
from anser_ros.calibration.layouts import Generator, place
from anser_ros.calibration.moments import (
    SMALLEST_NOISE_T,
    MomentFitter,
    PoseWhitener,
    Progress,
    most_probable_step,
    moved,
    outlier_weights,
)
from anser_ros.calibration.population import (
    Likelihood,
    OpticalNoise,
    Population,
    Posterior,
    alike_sigma_m,
    estimate_noise,
    interpolation_share,
    solve,
    width_by_evidence,
)
from anser_ros.calibration.readings import (
    DipoleSites,
    basis_rows,
    frame_blocks,
    usable_weights,
    with_pose,
)
from anser_ros.calibration.sensor_parameters import (
    CLOCKS,
    EACH,
    PRIOR,
    SHARED_SHIFT,
    STANDS,
    SURVEYED_M,
    USEFUL,
    BodyErrors,
    SensorParameters,
)
from anser_ros.field.measurements import Measurements
from anser_ros.settings import Accuracy

CERTAIN = 6.0
"""Standard deviations between two sessions from which on they contradict each other."""
NOTICEABLE = 0.5
"""Share of the useful size of a parameter (`USEFUL`) below which a difference is not reported."""


@dataclass(frozen=True)
class Contradiction:
    """Names a sensor, or body, of which two sessions say different things."""

    kind: str  # of `sensor_parameters.KINDS`
    place: str  # name of the sensor, or of the body
    # size, sigma: difference and its standard deviation, in the parameter's unit
    size: float
    sigma: float
    sessions: tuple[int, int]  # which of the measurements


def contradictions(
    parts: Sequence[Measurements],
    kinds: Sequence[str],
    sums: Callable[..., Eliminated],
    tones_hz: Sequence[float] = (),
) -> tuple[Contradiction, ...]:
    """Return of what two sessions say different things, the worst pair of each once.

    ``parts``: one a body and session, corrected by the joint estimate. ``sums``: given parameters
    and measurements, what these say about the parameters, with the field unknown.
    """
    bodies = [part.body for part in parts]
    if len(set(bodies)) == len(bodies):
        return ()
    apart = [replace(part, body=str(i)) for i, part in enumerate(parts)]
    parameters = SensorParameters(apart, [k for k in kinds if k not in CLOCKS], tones_hz)
    rest = sums(parameters, apart)
    inflation = max(1.0, rest.inflation)
    information = rest.information / inflation + parameters.rule()
    width = parameters.prior_width()
    posterior = solve(Likelihood(information, rest.gradient / inflation), width)
    change, covariance = posterior.values, posterior.covariance
    worst: dict[tuple[str, str], Contradiction] = {}
    same = [(i, j) for i, j in combinations(range(len(bodies)), 2) if bodies[i] == bodies[j]]
    for (i, j), kind in product(same, (k for k in parameters.kinds if k not in STANDS)):
        for name, one, other in _pairs(parameters, kind, i, j):
            difference = change[one] - change[other]
            variance = covariance[one, one] + covariance[other, other]
            variance = variance - 2.0 * covariance[one, other]
            sigma = float(np.sqrt(variance[int(np.argmax(np.abs(difference)))]))
            size = float(np.linalg.norm(difference))
            found = Contradiction(kind, name or bodies[i], size, sigma, (i, j))
            known = worst.get((kind, found.place))
            if size < max(NOTICEABLE * USEFUL[kind], CERTAIN * sigma):
                continue
            if known is None or size / sigma > known.size / known.sigma:
                worst[kind, found.place] = found
    return tuple(worst.values())


def _pairs(
    parameters: SensorParameters, kind: str, i: int, j: int
) -> list[tuple[str, Integers, Integers]]:
    """Each sensor's name (none for a body's own) with its rows for two of the measurements."""
    slices = [parameters.slices[kind, str(index)] for index in (i, j)]
    one, other = (np.arange(s.start, s.stop) for s in slices)
    if kind not in EACH:
        return [('', one, other)]
    each = EACH[kind]
    return list(
        zip(parameters.tables[i].name, one.reshape(-1, each), other.reshape(-1, each), strict=True)
    )


@dataclass(frozen=True)
class SensorFit:
    """Holds what a scan says of its own sensors, clock and optics."""

    parameters: SensorParameters  # what was asked for
    posterior: Posterior  # values, prior widths and covariance of all parameters
    left_out: tuple[str, ...]  # kinds that the data do not support
    evidence: dict[str, float]  # gain of the log probability by each other kind
    noise_t: float  # noise of a phasor component, with what the field's model misses, T
    optical: OpticalNoise  # jitter of the optical poses
    # parameters of channels that stand outside their population
    alone: dict[str, Integers]
    # kept, steady: frames of each of the measurements whose pose and field are good, and those in
    # which nothing moved
    kept: tuple[Booleans, ...]
    steady: tuple[Booleans, ...]
    reflected: float  # share of the frames whose pose is not where the fluxes put it
    # kinds that the scan does not determine, with the standard deviation that it leaves; these are
    # as the setup says, or as their prior makes them
    undetermined: dict[str, float]
    # standard deviation along each axis, m, of a shift that the whole field shares: of the lever
    # arm, and of the mean of all optical poses
    shift_sigma_m: float = 0.0
    # of which parameters two sessions say different things
    contradictions: tuple[Contradiction, ...] = ()
    open_arm_m: float = 0.0  # of the lever arm in that shift, where the scan does not determine it

    def errors_of(self, body: str, session: str = '') -> BodyErrors:
        """Return the errors of a body's sensors in a session."""
        return self.parameters.errors_of(body, self.posterior.values, session)


COARSE_ROWS = 5000
"""Readings of the first steps, which only bring field and parameters near where they belong."""
MOST_ROWS = 22_000
"""Readings of the last steps; more are thinned. Their time grows in proportion."""
COARSE_MODES = 120
"""Modes of the field, the strongest, that the first steps solve for; their time grows with the
third power of it."""
COARSE_STEPS = 6
"""First steps at most, with `COARSE_ROWS`; `SMALL_STEP` ends them earlier."""
FINE_STEPS = 6
"""Last steps at most, with `MOST_ROWS`: they start where few readings led to."""
SMALL_STEP = 0.1
"""Step, in standard deviations, below which another one is not worth its time; and the relative
change of the fluxes' weight (as a standard deviation) below which the weight has settled."""
LOOSE = OpticalNoise(1e-3, 1e-2)
"""Jitter of the first step: poses are off by that much before clock and lever arm are known."""
FREE_POSE = np.repeat([1.0 / 0.02**2, 1.0 / 0.1**2], 3)
"""Precision of a pose that is to follow the fluxes, 1/m^2 and 1/rad^2."""
FIELD_WIDTH = 0.3
"""Prior width of the field's deviation from the drawing, relative to the flux, to begin with.
Smaller holds the first steps to a poor drawing; larger lets it take up what is the sensors'."""
WIDTH_ALONE = 100.0
"""The same without a drawing. It is not learnt: a learnt width shrinks the fine modes, and a shift
of all sensors makes up for it. This wide, the prior only holds what no reading determines."""
LEAST_FIELD_WIDTH = 1e-3
"""Least such width: no board is made more exactly than that."""
FEWEST_READINGS = 7.0
"""Readings for each mode of the field from which on sensors are looked at although there are fewer
poses than modes. Nine coils on 75 poses, 6 a mode, had a clock 7 ms off with no doubt about it."""
CLEAR_MODE = 1e-6
"""Size of a mode, relative to the largest, from which on it counts there."""
FIT_NOISE = 10.0
"""Noise of the first step as a multiple of the fluxes' own."""


@dataclass
class _Tool:
    """One body's frames with a pose, with their present weights."""

    measured: Measurements  # as recorded
    known: Booleans  # (F,): frames that nothing speaks against beforehand
    steady: Booleans  # (F,): those of them in which the tool saw nothing move either
    weights: Array  # (F, S): of the readings, in [0, 1]


class SensorFitter:
    """Estimates the parameters; sessions with the same body share them.

    ``steady``: frames of each of the measurements in which the references saw nothing move.
    """

    def __init__(
        self,
        measurements: Sequence[Measurements],
        kinds: Sequence[str],
        generator: Generator,
        accuracy: Accuracy,
        progress: Progress | None = None,
        steady: Sequence[Booleans] | None = None,
        surveyed_m: float = SURVEYED_M,
    ) -> None:
        self.measured, self.surveyed_m = list(measurements), surveyed_m
        every = [np.ones(len(m.time), dtype=bool) for m in measurements]
        self.steady = every if steady is None else list(steady)
        self.generator, self.accuracy, self.nominal = generator, accuracy, generator.nominal
        self.progress = progress
        self.parameters = SensorParameters(measurements, kinds, generator.frequencies_hz)
        self.population = Population(self.parameters)
        self.values, self.field = np.zeros(len(self.parameters)), np.zeros((0, 0))
        self.likelihood: Likelihood
        self.posterior: Posterior
        self.noise_t = FIT_NOISE * accuracy.flux_noise_t
        self.optical = LOOSE
        self.field_width = WIDTH_ALONE if generator.nominal is None else FIELD_WIDTH
        self.inflation = 1.0
        self.alike_m = 0.0  # m along each axis by which poses at one place are off together

    def fit(self) -> SensorFit:
        """Find field and parameters, first with few frames and then with all."""
        thin = [tool.measured for tool in self._tools(COARSE_ROWS)]
        layer = place(rich_layout(thin, self.generator), self.generator)
        begun = [copy(self)._begun(layer)]
        if begun[0].parameters is self.parameters:  # else there are too few readings for any
            begun += [copy(self)._begun(s) for s in free_bases(thin, self.generator)[:1]]
        return richest(begun, [one.noise_t for one in begun])._ended()

    def _begun(self, sites: DipoleSites) -> 'SensorFitter':
        """Bring field and parameters near where they belong, with few frames."""
        tools = self._tools(COARSE_ROWS)
        self._start(tools, sites)
        self._fix_if_too_few(tools)
        self.solved = min(COARSE_MODES, self.modes.size.size)
        for step in range(COARSE_STEPS):
            self._report(step)
            size = self._step(tools, inspect=step > 0)
            if step > 2 and size < 10.0 * SMALL_STEP:
                break
        return self

    def _ended(self) -> SensorFit:
        tools, self.solved = self._tools(MOST_ROWS), self.modes.size.size
        for step in range(FINE_STEPS):
            self._report(COARSE_STEPS + 3 * step)
            # Metal is looked for once field and sensors fit: where neither is known yet, both look
            # as if something moved, and what is left out is not learnt.
            before = self.inflation
            size = self._step(tools, inspect=True, watch=step > 0)
            if self.population.stand_alone(self.posterior):
                continue
            settled = abs(self.inflation / before - 1.0) < 2.0 * SMALL_STEP
            if size < SMALL_STEP and settled:
                break
        return self._result(tools)

    def _fix_if_too_few(self, tools: Sequence[_Tool]) -> None:
        """Estimate nothing where too few readings make errors of any size seem certain."""
        poses = sum(len(tool.weights) for tool in tools)
        modes = int((self.modes.size > CLEAR_MODE).sum())
        readings = sum(int(m.usable.sum()) for m in self.measured)
        path = any(m.is_followed for m in self.measured)  # its neighbouring poses are alike
        if path and poses < modes and readings < FEWEST_READINGS * modes:
            self.parameters = self.parameters.fixed()
            self.population = Population(self.parameters)
            self.values = np.zeros(0)

    def _result(self, tools: Sequence[_Tool]) -> SensorFit:
        """Choose the kinds of errors that the readings support, and judge all frames."""
        whole = self.posterior
        posterior, left_out, evidence = self.population.chosen(self.likelihood)
        if 'gains' in evidence:
            posterior = self.population.with_common_gains(self.likelihood, posterior)
            values, common = self.parameters.by_rule(posterior.values)
            posterior, self.field = replace(posterior, values=values), self.field * common
        self.values = posterior.values
        steady = tuple(
            known & outside(m.time, spans_of(tool.measured.time, ~tool.steady))
            for m, known, tool in zip(self.measured, self.steady, tools, strict=True)
        )
        kept, reflected = self._all_frames(steady)
        mean = self.optical.mean_sigma_m(sum(int(mask.sum()) for mask in kept))
        shift = self.population.shift_sigma_m(self.likelihood, whole, self.surveyed_m)
        undetermined = self._undetermined()
        return SensorFit(
            self.parameters, posterior, left_out, evidence, self.noise_t, self.optical,
            self.population.alone, kept, steady, reflected, undetermined,
            float(np.hypot(np.hypot(mean, shift), self.alike_m)),
            self._contradictions(tools, tuple(evidence)),
            shift if SHARED_SHIFT in undetermined else 0.0,
        )  # fmt: skip

    def _sums(
        self, tools: Sequence[_Tool], parameters: SensorParameters, linear: Sequence[Linear]
    ) -> Eliminated:
        """What the tools say about some parameters, with the field unknown."""
        modes = self.modes.strongest(self.solved)
        noise_t = float(np.sqrt(self.inflation)) * self.noise_t
        along = [
            open_directions(
                at, tool.weights, noise_t, self.optical.jitter, interpolation_share(at.part)
            )
            for tool, at in zip(tools, linear, strict=True)
        ]
        system = JointSystem(parameters, modes, tied_parts(along))
        for tool, at, directions in zip(tools, linear, along, strict=True):
            system.add(at, tool.weights, noise_t, directions)
        precision = 1.0 / (self.field_width * self.flux_rms * modes.size) ** 2
        return system.eliminate(precision, (self.middle - self.field)[: self.solved])

    def _contradictions(
        self, tools: Sequence[_Tool], kinds: Sequence[str]
    ) -> tuple[Contradiction, ...]:
        def sums(parameters: SensorParameters, parts: Sequence[Measurements]) -> Eliminated:
            linear = [linearise(part, self.modes, self.field) for part in parts]
            return self._sums(tools, parameters, linear)

        parts, tones_hz = [self._corrected(tool) for tool in tools], self.parameters.tones_hz
        return contradictions(parts, kinds, sums, tones_hz)

    def _undetermined(self) -> dict[str, float]:
        """Kinds that the scan does not determine, those among them that were not even tried."""
        asked, tried = self.parameters.asked, self.parameters.kinds
        wide = {kind: PRIOR[kind] for kind in asked if kind not in tried}
        return {**self.population.undetermined(self.likelihood), **wide}

    def _report(self, done: int) -> None:
        if self.progress is not None:
            self.progress('sensors and clock', done / (COARSE_STEPS + 3 * FINE_STEPS))

    def _tools(self, most_rows: int) -> list[_Tool]:
        """The frames of a stage, thinned evenly; those without a pose or a reading are left."""
        total = sum(m.flux.shape[0] * m.flux.shape[1] for m in self.measured)
        step, out = max(1, -(-total // most_rows)), []
        for whole, known in zip(self.measured, self.steady, strict=True):
            rows = np.arange(0, len(whole.time), step)
            rows = rows[np.asarray(whole.usable.any(axis=1))[rows]]
            thin = with_pose(whole.frames(rows))
            mask = np.asarray(known[rows], dtype=bool)
            out.append(_Tool(thin, mask, mask, usable_weights(thin)))
        return out

    def _start(self, tools: Sequence[_Tool], sites: DipoleSites) -> None:
        """Set up the field's modes, and its first amplitudes as a plain fit has them."""
        measured = [tool.measured for tool in tools]
        total = sum(m.flux.shape[0] * m.flux.shape[1] for m in self.measured)
        share = min(1.0, MOST_ROWS / max(total, 1))
        frames = max(share * sum(len(m.time) for m in self.measured), 1.0)
        most = min(np.sqrt(MODES_WORK / frames), frames / POSES_A_MODE)
        most = int(np.clip(most, LEAST_MOST_MODES, MOST_MODES))
        self.modes = FieldModes.of(measured, sites, most)
        moments, _ = MomentFitter(measured, sites, RICH_DAMPING, self.accuracy).solve(exact=False)
        if self.nominal is None:
            self.field = self._amplitudes(measured, moments)
            self.middle = np.zeros_like(self.field)
        else:
            drawn = ScaledNominal(self.nominal, measured).moments(sites)
            self.field = self.middle = self._amplitudes(measured, drawn)

    def _amplitudes(self, measured: Sequence[Measurements], moments: ComplexArray) -> Array:
        """Amplitudes (M, 2K) of the modes that make the flux of moments best."""
        out, count = np.zeros((self.modes.size.size, 2 * moments.shape[1])), 0
        for m in measured:
            for block in frame_blocks(len(m.time), len(m.sensors)):
                rows = basis_rows(m.frames(block), self.modes.sites)[m.usable[block].ravel()]
                out += (rows @ self.modes.vectors).T @ (rows @ as_real(moments))
                count += len(rows)
        return out / max(count, 1)

    def _corrected(self, tool: _Tool) -> Measurements:
        """A tool's frames by the present estimate; those without a pose lose their weight."""
        measured = tool.measured
        errors = self.parameters.errors_of(measured.body, self.values, measured.session)
        out = errors.apply(measured)
        lost: Booleans = np.asarray(~np.isfinite(out.position).all(axis=1))
        if lost.any():
            tool.weights[lost] = 0.0
            out = replace(
                out,
                position=np.where(lost[:, None], tool.measured.position, out.position),
                rotation=np.where(lost[:, None, None], tool.measured.rotation, out.rotation),
            )
        return out

    def _step(self, tools: Sequence[_Tool], inspect: bool, watch: bool = False) -> float:
        """Take one step of field and parameters; return its size in standard deviations."""
        linear = [linearise(self._corrected(tool), self.modes, self.field) for tool in tools]
        if inspect:
            pairs = zip(linear, tools, strict=True)
            linear = [self._about_probable_poses(at, tool) for at, tool in pairs]
            self._inspect(tools, linear, watch)
        rest = self._sums(tools, self.parameters, linear)
        # Errors of the field's model are alike in neighbouring frames: the scatter of whole
        # stretches tells how much less the data say than independent readings would. It has to be
        # known where they are weighed against the optical poses: else what the model misses is
        # made good by a shift of the field and of the tool, which no single frame contradicts.
        # The next step uses it: what the jitter of the poses limits would not scale with it.
        readings = sum(float(tool.weights.sum()) for tool in tools) * self.field.shape[1]
        kinds = [rows for _, rows in self.population.groups]
        information, natural = rest.likelihood(self.values, kinds)
        self.likelihood = Likelihood(
            information + self.parameters.rule(), natural, readings / self.inflation
        )
        self.inflation = max(1.0, rest.inflation * self.inflation) if inspect else 1.0
        # Nothing is held here: while a clock is off, poses look too bad to tell it.
        self.posterior = self.population.fit(self.likelihood)
        step = self.posterior.values - self.values
        self.values, self.field = self.posterior.values, self.field.copy()
        self.field[: self.solved] += rest.field_step(step, self.solved)
        if self.nominal is not None:
            self._learn_field_width(rest.field_variance)
        sigma = np.sqrt(np.maximum(np.diag(self.posterior.covariance), 1e-300))
        return float(np.abs(step / sigma).max(initial=0.0))

    def _about_probable_poses(self, at: Linear, tool: _Tool) -> Linear:
        """Return readings linearised where the fluxes put the poses, in steps from measured ones.

        At 0.3 mm of jitter the field's second order is as large as the fluxes' noise.
        """
        step, _ = self._pose_steps(at, tool.weights)
        near = linearise(moved(at.part, step), self.modes, self.field)
        back = np.einsum('fsci,fi->fsc', near.slope, step)
        return replace(near, residual=near.residual + back)

    def _learn_field_width(self, variance: Array) -> None:
        """Set the field's prior width to what makes its amplitudes most probable."""
        scale = (self.flux_rms * self.modes.size)[: self.solved, None]
        square = ((self.field - self.middle)[: self.solved] / scale) ** 2
        ratio = variance / (self.field_width * scale) ** 2
        self.field_width = max(width_by_evidence(square, ratio, 1.0)[0], LEAST_FIELD_WIDTH)

    @property
    def flux_rms(self) -> float:
        """Return the root mean square of a flux phasor's component, T."""
        power = [np.mean(np.abs(m.flux[m.usable]) ** 2) / 2.0 for m in self.measured]
        return float(np.sqrt(np.mean(power)))

    def _inspect(self, tools: Sequence[_Tool], linear: Sequence[Linear], watch: bool) -> None:
        """Weigh readings and frames, and estimate noise and jitter from what is left."""
        steps, variances, shares, kept, power, count = [], [], [], [], 0.0, 0.0
        for tool, at in zip(tools, linear, strict=True):
            usable = usable_weights(tool.measured)
            seen = usable.any(axis=1)
            bad, left = self._wrong_poses(at, usable, seen & tool.known)
            size = (left**2).mean(axis=2)
            frame_power = (size * usable).sum(axis=1) / np.maximum(usable.sum(axis=1), 1.0)
            good = seen & tool.known & ~bad
            tool.steady = tool.known
            # Poses that are seconds apart show each place once: what is missed there is no motion.
            if watch and tool.measured.is_followed:
                moving = unsteady_tool(at.part.time, at.part.position, frame_power, good)
                tool.steady = tool.known & ~moving
            sound = tool.steady & ~bad
            tool.weights = outlier_weights(left, usable * sound[:, None])
            power += float((tool.weights * size).sum()) * left.shape[2]
            spent = min(6.0 / (usable.sum(axis=1).mean() * left.shape[2]), 0.9)
            count += float(tool.weights.sum()) * left.shape[2] * (1.0 - spent)
            step, variance = self._pose_steps(at, tool.weights)
            steps.append(step)
            variances.append(variance)
            shares.append(interpolation_share(at.part))
            kept.append(sound & seen)
        free = self.solved * self.field.shape[1]
        self.noise_t = max(np.sqrt(power / max(count - free, 0.2 * count)), SMALLEST_NOISE_T)
        self.optical = estimate_noise(steps, variances, shares, kept, self.optical)
        self.alike_m = alike_sigma_m([at.part for at in linear], steps, kept)

    def _wrong_poses(self, at: Linear, weights: Array, judged: Booleans) -> tuple[Booleans, Array]:
        """Frames whose poses are far from where the fluxes put them, and what no pose explains."""
        step, left = most_probable_step(at, weights, self.noise_t, FREE_POSE)
        scaled = step / np.sqrt(interpolation_share(at.part))[:, None]
        return glitches(scaled, judged, self.accuracy.pose_jitter), left

    def _pose_steps(self, at: Linear, weights: Array) -> tuple[Array, Array]:
        """Most probable steps (F, 6) of the poses and their variances."""
        prior = 1.0 / (self.optical.jitter**2 * interpolation_share(at.part)[:, None])
        white = PoseWhitener(at.slope, weights, self.noise_t, prior)
        return white.step(at.residual), np.diagonal(white.inverse, axis1=1, axis2=2)

    def _all_frames(self, steady: Sequence[Booleans]) -> tuple[tuple[Booleans, ...], float]:
        """Which of all frames are good, and the share of those whose pose is not."""
        out, bad, seen = [], 0, 0
        for whole, mask in zip(self.measured, steady, strict=True):
            kept = mask.copy()
            rows = np.flatnonzero(kept & whole.usable.any(axis=1))
            for block in frame_blocks(rows.size, len(whole.sensors), MOST_ROWS):
                posed = with_pose(whole.frames(rows[block]))
                every = np.ones(len(posed.time), dtype=bool)
                part = _Tool(posed, every, every, usable_weights(posed))
                at = linearise(self._corrected(part), self.modes, self.field)
                wrong, _ = self._wrong_poses(at, part.weights, every)
                kept[rows[block][wrong]] = False
                bad, seen = bad + int(wrong.sum()), seen + len(wrong)
            out.append(kept)
        return tuple(out), bad / max(seen, 1)
