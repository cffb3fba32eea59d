"""Assembles the refitted model, calibrated dipoles with a layer's moments and their
uncertainty, and the result of a frame.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from anser_ros.arrays import Array, ComplexArray
from anser_ros.field.model import FieldModel
from anser_ros.pose_states import OTHER_PLACE, REFERENCES_DOUBTFUL, REFERENCES_LOST
from anser_ros.refit import health, posterior
from anser_ros.refit.hypotheses import BackgroundTask
from anser_ros.refit.layer import Layer, component_rows
from anser_ros.refit.witness import FIRST_SAMPLE_STEP, Witness

NEGLIGIBLE = 0.01
"""Hypotheses less probable than this take no part in the mean."""
INFLATION_STEP = 1.2
"""Ratio of neighbouring factors by which modes are inflated: in steps, many frames share them."""
Uncertainty = tuple[ComplexArray | None, float]
"""Modes and flux error of a model."""

MOST_MODES = 16
"""Models' sets of modes that are kept, 0.5 MB each; the oldest is dropped."""
MOST_ERRORS = 64
"""Hypotheses' errors that are kept, 0.3 MB each: metal on its way to and fro asks for 50 again and
again, of 7 ms each, and with 16 each was worked out three times in 40 s."""
LEAST_COMMON, COMMON_STEP = 5e-4, 1.5
"""Change that all emitters have in common from which on it may be the references' own gain: what
is less leaves a coil 0.1 m above the board a residual of twice the noise; and the ratio of
neighbouring steps in which it counts."""
KEEP_FRAMES = 25
"""Frames for which an inflation is kept at least before it may fall."""
RIVAL = 0.05
"""Probability from which on a second hypothesis adds what it disagrees about."""


class Assembly:
    """Assembles refitted models from the calibrated model and the hypotheses' layers.

    ``phase`` (K,) is that of the emitters' own field, ``unit`` the T of a noise unit.
    """

    def __init__(self, model: FieldModel, phase: ComplexArray, unit: float, n_modes: int) -> None:
        self.base, self._scale, self._n_modes = model, phase * unit, n_modes
        self._modes: dict[tuple[object, ...], posterior.PosteriorModes] = {}
        self._coming: dict[tuple[object, ...], BackgroundTask[posterior.PosteriorModes]] = {}
        self._last: _ErrorBefore | None = None
        self._interim: tuple[object, Uncertainty] | None = None
        self._whole: dict[tuple[object, ...], tuple[int, Uncertainty]] = {}
        self._count = 0
        self._place: _Dipoles | None = None

    def forget(self) -> None:
        """Forget the last error: the next frame is of another time."""
        self._last = self._interim = None

    def model(
        self, stamp_ns: int, bank: posterior.Bank, seen: posterior.FrameEvidence, weights: Array,
        drift: ComplexArray, typical: float, witness: Witness | None = None,
    ) -> FieldModel:  # fmt: skip
        """Return the refitted model of one frame.

        ``weights`` (H,) are the hypotheses' probabilities, ``drift`` (K,) the relative change of
        the emitters' strength; ``typical`` is the left-out chi-square per degree of freedom of
        the typical coil. A ``witness`` knows the hypotheses' errors from tools.
        """
        active = [h for h, w in enumerate(weights.tolist()) if h > 0 and w > NEGLIGIBLE]
        place = self._dipoles_of([bank.prior(h).layer for h in active])
        moments, scale = np.zeros((len(place.positions), len(drift)), dtype=complex), self._scale
        np.multiply(self.base.moments, 1.0 + drift, out=moments[: len(self.base.moments)])
        parts = {h: bank.moments(seen, h) * scale for h in active}
        if witness is not None:
            parts |= {h: part + witness.moments(bank, h) * scale for h, part in parts.items()}
        change = _Change(stamp_ns, bank, seen, weights, parts, scale, place, _common(drift))
        for h, part in parts.items():
            moments[change.rows(h)] += weights[h] * part
        modes, rest = self._uncertainty(change, typical, witness)
        return replace(
            self.base, positions=place.positions, directions=place.directions, moments=moments,
            modes=modes, flux_error_t=rest,
        )  # fmt: skip

    def _dipoles_of(self, given: list[Layer]) -> '_Dipoles':
        """Return the dipoles with some layers, in the same arrays while the layers stay."""
        layers = {layer.name: layer for layer in given}
        if self._place is not None and [*self._place.rows] == [*layers]:
            return self._place
        positions, directions = [self.base.positions], [self.base.directions]
        rows: dict[str, slice] = {}
        size = len(self.base.positions)
        for name, layer in layers.items():
            rows[name] = slice(size, size + len(layer.positions))
            positions.append(layer.positions)
            directions.append(layer.directions)
            size = rows[name].stop
        self._place = _Dipoles(np.concatenate(positions), np.concatenate(directions), rows)
        return self._place

    def _uncertainty(
        self, change: '_Change', typical: float, witness: Witness | None
    ) -> Uncertainty:
        """Return all modes and the remaining error, unchanged for a while to spare receivers."""
        bank, weights, n_modes = change.bank, change.weights, self._n_modes
        ranked = sorted(change.parts, key=lambda h: -float(weights[h]))
        if not ranked:
            alone = (change.common,)
            if alone not in self._whole:
                none = np.zeros((0, *change.shape), dtype=complex)
                self._whole[alone] = 0, self._with_base(change, none, 0.0)
            return self._whole[alone][1]
        best = ranked[0]
        rival = next((h for h in ranked[1:] if float(weights[h]) > RIVAL), None)
        steps = max(0, round(np.log(max(typical, 1.0)) / (2.0 * np.log(INFLATION_STEP))))
        level = posterior.error_level(change.seen, best)
        names = tuple(bank.prior(h).name for h in ranked[:1] + ([] if rival is None else [rival]))
        key = (bank.rows.tobytes(), names, level, steps, change.common, *change.place.rows)
        self._count += 1
        kept = self._whole.get(key)
        if witness is None and kept is not None and self._count - kept[0] < KEEP_FRAMES:
            return kept[1]
        inflation = INFLATION_STEP**steps
        errors = (
            self._error(change, best, level, n_modes - 1)
            if witness is None
            else witness.modes(bank, best, n_modes - 1)
        )
        if errors is None:
            if self._interim is None or self._interim[0] != key:
                own, rest = self._until_known(change, best, level, n_modes)
                own = own * inflation
                self._interim = key, self._with_base(change, own, rest * inflation)
            return self._interim[1]
        own, rest = change.modes(errors, best, n_modes)
        own, rest = own * inflation, rest * inflation
        if rival is not None:
            own[-1] += np.sqrt(weights[best] * weights[rival]) * change.between(best, rival)
        whole = self._with_base(change, own, rest)
        if witness is None:
            self._last = _ErrorBefore(bank.rows.tobytes(), best, names[0], level, errors)
            self._interim = None
            posterior.make_room(self._whole, MOST_MODES)
            self._whole[key] = (self._count, whole)
        return whole

    def _with_base(self, change: '_Change', own: ComplexArray, rest: float) -> Uncertainty:
        """Join the error of the change with that of the calibrated model, and a common gain."""
        base = self.base.modes
        if change.common:
            shared = change.common * self.base.moments[None]
            base = shared if base is None else np.concatenate([base, shared])
        if base is not None:  # with rows of zeros for the dipoles that were added
            padded = np.zeros((len(base), *own.shape[1:]), dtype=complex)
            padded[:, : base.shape[1]] = base
            own = np.concatenate([padded, own])
        return own if len(own) else None, float(np.hypot(self.base.flux_error_t, rest))

    def _error(
        self, change: '_Change', hypothesis: int, level: posterior.ErrorLevel, count: int
    ) -> posterior.PosteriorModes | None:
        """Return the error of a hypothesis in units of the noise; None until it is known."""
        bank = change.bank
        key = (bank.rows.tobytes(), bank.prior(hypothesis).name, level, count)
        if key in self._modes:
            return self._modes[key]
        if key not in self._coming:
            posterior.make_room(self._coming, MOST_MODES)
            work = partial(posterior.error_modes, bank, bank.posterior(hypothesis), level, count)
            self._coming[key] = BackgroundTask(work, change.stamp_ns)
        if not self._coming[key].is_due(change.stamp_ns):
            return None
        posterior.make_room(self._modes, MOST_ERRORS)
        self._modes[key] = self._coming.pop(key).result()
        return self._modes[key]

    def _until_known(
        self, change: '_Change', best: int, level: posterior.ErrorLevel, n_modes: int
    ) -> tuple[ComplexArray, float]:
        """Return an error for as long as that of the best hypothesis is being worked out.

        It is that of the one before, as large as the strength may be now, and the whole difference
        between the two, in any direction; without one before, all of the change.
        """
        last = self._last
        if last is None or not last.holds(change):
            own, rest = np.zeros((n_modes, *change.shape), dtype=complex), 0.0
            own[-1] = change.between(best)
        else:
            own, rest = change.modes(last.errors, last.hypothesis, n_modes)
            if last.hypothesis == best:
                growth = last.level.growth(level)
                return own * growth, rest * growth
            own[-1] += change.between(best, last.hypothesis)
        return own, float(np.hypot(rest, change.size(best, own[-1])))


def _common(drift: ComplexArray) -> float:
    """Return the change that emitters' strengths have in common by their ``drift`` (K,), in steps.

    References do not say whether emitters fell, or their own gain did, which moves no tool.
    """
    size = abs(float(np.median(drift.real))) / LEAST_COMMON
    steps = math.ceil(math.log(max(size, 1.0)) / math.log(COMMON_STEP))
    return LEAST_COMMON * COMMON_STEP**steps if size > 1.0 else 0.0


class _Dipoles(NamedTuple):
    """The dipoles (N, 3) of a model with some layers, and the rows of each layer by its name."""

    positions: Array
    directions: Array
    rows: dict[str, slice]


@dataclass(frozen=True)
class _Change:
    """One frame's hypotheses and what each of them adds to the calibrated model, A m^2."""

    stamp_ns: int
    bank: posterior.Bank
    seen: posterior.FrameEvidence
    weights: Array
    parts: dict[int, ComplexArray]
    scale: ComplexArray
    place: _Dipoles
    common: float  # change of all emitters that may be the references' own gain

    @property
    def shape(self) -> tuple[int, int]:
        """Dipoles N and emitters K of the model."""
        return len(self.place.positions), len(self.scale)

    def rows(self, hypothesis: int) -> slice:
        """Return the rows of the dipoles of a hypothesis' layer."""
        return self.place.rows[self.bank.prior(hypothesis).layer.name]

    def modes(
        self, errors: posterior.PosteriorModes, hypothesis: int, n_modes: int
    ) -> tuple[ComplexArray, float]:
        """Return a hypothesis' error as modes (R, N, K) of the model, and what they leave, T."""
        own = np.zeros((n_modes, *self.shape), dtype=complex)
        own[: len(errors.moments), self.rows(hypothesis)] = errors.moments * self.scale
        return own, errors.rest * float(np.abs(self.scale[0]))

    def between(self, hypothesis: int, other: int | None = None) -> ComplexArray:
        """Return what two hypotheses, or one and that of no change, disagree about, (N, K)."""
        out = np.zeros(self.shape, dtype=complex)
        out[self.rows(hypothesis)] += self._part(hypothesis)
        if other is not None:
            out[self.rows(other)] -= self._part(other)
        return out

    def size(self, hypothesis: int, moments: ComplexArray) -> float:
        """Return the rms of a component of the field of moments (N, K) in the volume, T."""
        points = self.bank.prior(hypothesis).layer.points[::FIRST_SAMPLE_STEP]
        field = component_rows(points, self.place.positions, self.place.directions) @ moments
        return float(np.sqrt(np.mean(np.abs(field) ** 2) / 2.0))

    def _part(self, hypothesis: int) -> ComplexArray:
        if hypothesis in self.parts:
            return self.parts[hypothesis]
        return self.bank.moments(self.seen, hypothesis) * self.scale


@dataclass(frozen=True)
class _ErrorBefore:
    """The last error that was given, and of which hypothesis it is."""

    coils: bytes
    hypothesis: int
    name: str
    level: posterior.ErrorLevel
    errors: posterior.PosteriorModes

    def holds(self, change: _Change) -> bool:
        """Return whether the hypothesis is still there, and the model has its dipoles."""
        bank = change.bank
        return (
            self.coils == bank.rows.tobytes()
            and bank.names[self.hypothesis] == self.name
            and bank.prior(self.hypothesis).layer.name in change.place.rows
        )


FROZEN = 'frozen'
REFIT = 'refit'
FEW_REFERENCES = 'few_references'
POOR_FIT = 'poor_fit'
STATES = (FROZEN, REFIT, FEW_REFERENCES, POOR_FIT, REFERENCES_DOUBTFUL, OTHER_PLACE)
"""Nothing changed; followed; too few references; unexplained; most references jumped; all of them
moved as one."""

POOR = 4.0
"""Typical left-out distance from which on the state is `POOR_FIT`."""

WITHHELD = {
    FEW_REFERENCES: REFERENCES_LOST,
    POOR_FIT: REFERENCES_DOUBTFUL,
    REFERENCES_DOUBTFUL: REFERENCES_DOUBTFUL,
    OTHER_PLACE: OTHER_PLACE,
}
"""State that trackers receive in states whose model is none to give poses by."""


@dataclass(frozen=True)
class Metal:
    """Describes the sources of the change, as the most likely cloud has them."""

    positions: Array  # (M, 3), m, frame fg
    polarisability: ComplexArray  # (M,), complex, a m^2 / T
    volumes: Array  # (M,), volume that each source stands for, m^3
    # (3,), mean of the space, weighted by the squared magnitude of the polarisability's density:
    # it leans towards the part of the metal that the emitters reach best
    centroid: Array


def locate_metal(
    bank: posterior.Bank, seen: posterior.FrameEvidence, weights: Array, flux_noise_t: float
) -> Metal | None:
    """Return the sources under the most probable hypothesis with metal; None when all are zero.

    ``weights`` (H,): probability of each hypothesis; the first, that nothing has changed, is
    passed over. ``flux_noise_t``: nominal noise, T.
    """
    best = 1 + int(weights[1:].argmax())
    values = bank.sources(seen, best) * flux_noise_t
    polarisability = values[:, 0] + 1j * values[:, 1]
    cloud = bank.prior(best).cloud
    power = np.abs(polarisability) ** 2 / cloud.volumes
    if not power.sum() > 0.0:
        return None
    centroid = (cloud.positions * power[:, None]).sum(axis=0) / power.sum()
    return Metal(cloud.positions, polarisability, cloud.volumes, centroid)


@dataclass(frozen=True)
class RefitResult:
    """Holds the result of one frame; ``judge`` and ``find`` work out `references` and `metal`."""

    stamp_ns: int
    model: FieldModel  # the active model; the calibrated one itself while nothing has changed
    state: str  # one of `STATES`, and the `reason` why
    judge: Callable[[], tuple[health.ReferenceHealth, ...]] = field(repr=False)
    log_odds: float  # natural logarithm of the odds that something has changed
    weights: dict[str, float]  # probability of every cloud, and of ``nothing``
    noise_t: float  # measured noise of the references' phasor components, T
    # (K,), complex, relative change of each emitter's strength; where nothing else changes, zero
    # unless it is significant
    drift: ComplexArray
    reason: str = ''
    find: Callable[[], Metal | None] | None = field(default=None, repr=False)

    @property
    def withheld(self) -> str:
        """Return the state for which poses are withheld; empty where the model may be used."""
        return WITHHELD.get(self.state, '')

    @property
    def is_answer(self) -> bool:
        """Return whether the references gave this frame's model; else it is the last resort."""
        return not self.withheld

    @cached_property
    def references(self) -> tuple[health.ReferenceHealth, ...]:
        """Return the health of every reference, computed when first asked for."""
        return self.judge()

    @property
    def left_out(self) -> tuple[str, ...]:
        """Return the names of the references that took no part."""
        return tuple(r.name for r in self.references if r.state != health.OK)

    @cached_property
    def metal(self) -> Metal | None:
        """Return the sources found, computed when first asked for; None without a change."""
        return self.find() if self.find is not None else None
