"""Uses tools as witnesses of metal: contradictions of coils settle what references leave open.

The readings of a tool's coils are compared at the pose that was found for it. The pose is free, so
the directions in which a translation or rotation of the tool would change them carry no
information (`ToolRows.pose`). The errors of the coils themselves (gain, place and axis) are the
same in every frame, and `CoilErrors` estimates them from the part that no metal explains: a wrong
gain must not be taken for metal.

The references determine a hypothesis' metal with a known error (`refit.posterior`). A tool that
moves through the field senses this error: a pose takes six numbers of the readings of its coils,
and all others remain. They enter a Kalman filter over the coordinates of the error
(`refit.prior.reduced`), one filter per hypothesis, after the poses of their frame have been given:
the next frame's poses are then independent of them, and nothing is counted twice.

Metal moves slowly, and so does the error of its estimate. So the error is a stationary process
with a memory of `MEMORY_S`; the references of every frame bound its size again.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from anser_ros.arrays import Array, ComplexArray
from anser_ros.field.model import FieldModel
from anser_ros.physics.dipole import flux_basis, flux_jacobian
from anser_ros.physics.rotations import tangents
from anser_ros.physics.sensor import SensorTable
from anser_ros.refit.layer import component_rows
from anser_ros.refit.posterior import STRENGTHS, Bank, FrameEvidence, PosteriorModes
from anser_ros.refit.prior import CloudPrior, ReducedPrior
from anser_ros.refit.tables import RefitTables
from anser_ros.settings import ToolSettings
from anser_ros.stamps import NANO

Floats = NDArray[np.floating[Any]]

FREE_M, FREE_RAD = 0.02, 0.2
"""Error of the pose at which a tool's readings are compared: any that matters."""
NEAR_M = 0.01
"""How far around the coils the field's uncertainty is worked out, m."""
_AROUND = np.array([[0, 0, 0], [1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
"""A coil's own place and the corners of a tetrahedron around it, in units of `NEAR_M`."""
KEPT = 0.03
"""Share of a tool's stated errors that is never learnt away."""
SHARE = 0.1
"""Weight of a frame by which a tool's errors are learnt: the model's own repeat in the next."""


def surroundings(points: Array) -> Array:
    """Return coils' places (P, 3), m, and four around each, (5 P, 3): where modes are chosen."""
    return np.asarray((points[:, None] + NEAR_M * _AROUND).reshape(-1, 3))


@dataclass(frozen=True)
class ToolReading:
    """Holds what the S coils of one rigid tool read at a pose that was found for it.

    ``flux`` (S, K) is in T; position (3,), m, and rotation (3, 3) are those of the tool in fg.
    """

    table: SensorTable
    flux: ComplexArray
    position: Array
    rotation: Array


class CoilErrors:
    """Holds what is wrong with a tool's coils: gain, place and axis of each, learnt without metal.

    ``table``: the S coils. ``tools``: how well they are known before.
    """

    def __init__(self, table: SensorTable, tools: ToolSettings) -> None:
        gain, place = tools.tool_coil_gain, tools.tool_coil_position_m
        own = [gain] * 2 + [place] * 3 + [tools.tool_coil_axis_rad] * 2  # as `ToolRows.own`
        self._prior = np.maximum(np.tile(own, len(table)), 1e-9)
        self._precision = np.diag(self._prior**-2.0)
        self._pull = np.zeros(len(self._prior))
        self._solved: tuple[Array, Array] | None = None

    @property
    def posterior(self) -> tuple[Array, Array]:
        """Return mean (7 S,) and covariance of gain (re, im), place (3, m) and axis (2, rad)."""
        if self._solved is None:
            covariance: Array = np.asarray(np.linalg.inv(self._precision))
            mean = covariance @ self._pull
            covariance[np.diag_indices_from(covariance)] += (KEPT * self._prior) ** 2
            self._solved = mean, covariance
        return self._solved

    def learn(self, white: Array, values: Array) -> None:
        """Take in whitened readings (n,) that errors make by the matrix ``white`` (n, 7 S)."""
        self._precision += SHARE * white.T @ white
        self._pull += SHARE * white.T @ values
        self._solved = None


@dataclass(frozen=True)
class ToolRows:
    """Holds a tool's readings linearised at a pose, in noise units turned to the emitters' phases.

    The coils have places and axes (S, 3) in fg; ``left`` (S K,) is what they read beyond the
    model, ``pose`` (S K, 6) the effect of a large step or turn of the tool, and ``own`` (S K, 7 S)
    that of the errors of the coils, in the order of `CoilErrors`.
    """

    at: Array
    axes: Array
    left: ComplexArray
    pose: ComplexArray
    own: ComplexArray


def linearised(
    reading: ToolReading, model: FieldModel, moments: ComplexArray, turn: ComplexArray
) -> ToolRows:
    """Return a tool's readings beside those of a model's dipoles with some moments (N, K).

    ``turn`` (K,) takes fluxes to noise units and to the emitters' phases.
    """
    table = reading.table
    at, axes = table.placed(reading.position, reading.rotation)
    flux, d_at, d_axis = flux_jacobian(
        at, axes, table.length, model.positions, model.directions, moments
    )
    by_place, by_axis = d_at * turn, d_axis * turn
    count, k = flux.shape
    arm = at - reading.position
    pose = np.empty((count, k, 6), dtype=complex)
    for i, unit in enumerate(np.eye(3)):
        pose[:, :, i] = FREE_M * by_place[:, i]
        turned = np.einsum('sj,sjk->sk', np.cross(unit, arm), by_place)
        turned += np.einsum('sj,sjk->sk', np.cross(unit, axes), by_axis)
        pose[:, :, 3 + i] = FREE_RAD * turned
    own = np.zeros((count, k, count, 7), dtype=complex)
    across = np.einsum('ij,saj->sai', reading.rotation, tangents(table.axis))
    for s in range(count):
        own[s, :, s, 0], own[s, :, s, 1] = flux[s] * turn, 1j * flux[s] * turn
        own[s, :, s, 2:5] = (reading.rotation.T @ by_place[s]).T
        own[s, :, s, 5:7] = (across[s] @ by_axis[s]).T
    left = ((reading.flux - flux) * turn).ravel()
    return ToolRows(at, axes, left, pose.reshape(-1, 6), own.reshape(count * k, -1))


MEMORY_S = 2.0
"""Time over which the references' error stays the same: 0.5 s is a tenth worse, 5 s no better."""
ODD = 1.5
"""Squared misfit of a tool's readings, over the expected one, from which they count less."""
CONTRADICTION_S = 0.5
"""Time over which an odd misfit stays the same: its correlation falls to 1/e in 0.4 to 0.6 s."""
LEAST_PROBABILITY = 1e-3
"""Probability from which on a hypothesis has a filter; others hardly change the mean."""
ELSEWHERE = 0.1
"""Weight of the whole volume beside the surroundings of the tools, where modes are chosen."""
FIRST_SAMPLE_STEP = 30
"""Every so many of a layer's samples stand for the volume before a tool was seen: thirty."""


@dataclass
class _Filter:
    """The error of the references' posterior: mean (D, 2), covariance (2, D, D)."""

    mean: Array
    covariance: Array
    prior: Array


class _Errors(NamedTuple):
    """What changes one part of a tool's readings beside the metal: covariances (n, n).

    ``white`` is noise, another one in every frame; ``own`` is by the errors of the coils, and
    ``pose`` by a step or turn of the tool. ``lasting`` and ``repeated`` are the frames in which
    the errors of the coils, and a contradiction, stay the same.
    """

    white: Array
    own: Array
    pose: Array
    lasting: float
    repeated: float

    def weighed(self, metal: Array, off: Array) -> tuple[tuple[Array, bool], float]:
        """Return the factor of the covariance of readings, and the log likelihood of their misfit.

        What is the same in many frames counts once in all of them. Of the coils' errors this is
        known; a contradiction shows itself by a misfit (n,) that one frame's errors and the
        ``metal`` (n, n) do not explain. That there is one is no news in each frame either.
        """
        known = self.pose + metal
        chol = cho_factor(self.white + self.lasting * self.own + known, lower=True)
        half_log_det = _half_log_det(chol)
        once = cho_factor(self.white + self.own + known, lower=True)
        odd = float(off @ cho_solve(once, off)) / len(off)
        if odd > ODD:
            more = self.repeated * (odd - 1.0)
            white, own = (1.0 + more) * self.white, (self.lasting + more) * self.own
            chol = cho_factor(white + own + known, lower=True)
            half_log_det += (_half_log_det(chol) - half_log_det) / self.repeated
        return chol, -0.5 * float(off @ cho_solve(chol, off)) - half_log_det


class Witness:
    """Holds the filters of all hypotheses that count.

    ``flux_noise_t`` is the noise of a phasor component of the tools' readings, T.
    """

    def __init__(
        self, tables: RefitTables, model: FieldModel, tools: ToolSettings, flux_noise_t: float
    ) -> None:
        self._tables, self._model, self._tools = tables, model, tools
        self._noise = math.hypot(flux_noise_t, model.flux_error_t)
        self._turn = tables.excitation.phase.conj() / tables.settings.accuracy.flux_noise_t
        self._reduced: dict[str, ReducedPrior] = {}
        self._tool_errors: dict[tuple[str, ...], CoilErrors] = {}
        self.forget()

    def forget(self) -> None:
        """Forget all that was seen."""
        self._filters: dict[str, _Filter] = {}
        self._last_ns, self._step_s = 0, 0.04
        self._near: Array | None = None
        self._frame: tuple[Bank, FrameEvidence, ComplexArray] | None = None

    def make_ready(self) -> None:
        """Work out the coordinates of all clouds, a tenth of a second each, before they count."""
        for prior in self._tables.priors:
            self._reduced_of(prior)

    def _reduced_of(self, prior: CloudPrior) -> ReducedPrior:
        if prior.name not in self._reduced:
            self._reduced[prior.name] = self._tables.reduced(prior)
        return self._reduced[prior.name]

    def predict(
        self, stamp_ns: int, bank: Bank, seen: FrameEvidence, weights: Array, drift: ComplexArray
    ) -> None:
        """Take in what the references of a frame say."""
        age = max(stamp_ns - self._last_ns, 0) * NANO
        self._last_ns = stamp_ns
        if 0.0 < age < MEMORY_S:
            self._step_s = age
        keep = math.exp(-age / MEMORY_S)
        self._frame = bank, seen, drift
        self._best = bank.names[1 + int(weights[1:].argmax())]
        filters = {}
        for h in np.flatnonzero(weights > LEAST_PROBABILITY).tolist():
            if h == 0:
                continue
            name = bank.prior(h).name
            prior = self._posterior(bank, seen, h)
            before = self._filters.get(name)
            if before is None:
                filters[name] = _Filter(np.zeros((prior.shape[1], 2)), prior.copy(), prior)
                continue
            growth = [
                max(float(np.trace(now) / np.trace(old)), 1e-3)
                for now, old in zip(prior, before.prior, strict=True)
            ]
            scaled = before.covariance * np.array(growth)[:, None, None]
            covariance = keep**2 * scaled + (1.0 - keep**2) * prior
            filters[name] = _Filter(keep * before.mean, covariance, prior)
        self._filters = filters

    def _posterior(self, bank: Bank, seen: FrameEvidence, h: int) -> Array:
        """Return the covariance (2, D, D) that the references of a frame leave."""
        reduced = self._reduced_of(bank.prior(h))
        across = reduced.cross[:, bank.rows] @ bank.bases[h]
        out = np.empty((2, len(across), len(across)))
        for part in range(2):
            a = float(STRENGTHS[int(seen.strength[h, part].argmax())])
            gain = a * a / (a * bank.spectra[h] + seen.noise**2)
            out[part] = a * np.eye(len(across)) - (across * gain) @ across.T
            out[part][np.diag_indices(len(across))] += 1e-9 * a
        return out

    def moments(self, bank: Bank, h: int) -> ComplexArray:
        """Return what the tools add to a hypothesis' moments (N, K), in units of the noise."""
        state = self._filters[bank.prior(h).name]
        reduced = self._reduced_of(bank.prior(h))
        flat = reduced.basis.reshape(-1, len(state.mean)) @ state.mean
        return np.asarray((flat @ np.array([1.0, 1.0j])).reshape(len(reduced.basis), -1))

    def modes(self, bank: Bank, h: int, count: int) -> PosteriorModes:
        """Return the principal modes of a hypothesis' error after the tools' readings.

        They are those with the largest effect at the tools' last places, and the remainder is
        stated for these places.
        """
        state = self._filters[bank.prior(h).name]
        reduced = self._reduced_of(bank.prior(h))
        d, k = len(state.mean), bank.width
        layer = bank.prior(h).layer
        points = layer.points[::FIRST_SAMPLE_STEP] if self._near is None else self._near
        weight = points[:, 2]
        rows = component_rows(points, layer.positions, layer.directions)
        rows = rows * np.repeat(weight / weight.mean(), 3)[:, None]
        field = (rows @ reduced.basis.astype(float)).reshape(-1, d)
        gram = field.T @ field
        # What is felt elsewhere counts as well, a little: the tool moves on, others come.
        gram += np.diag(ELSEWHERE * np.trace(gram) / (reduced.felt**2).sum() * reduced.felt**2)
        root = np.linalg.cholesky(gram)
        values, vectors = [], []
        for part in range(2):
            w, v = np.linalg.eigh(root.T @ state.covariance[part] @ root)
            values.append(np.maximum(w[::-1][:count], 0.0))
            vectors.append(solve_triangular(root.T, v[:, ::-1][:, :count]))
        value, part_of = np.concatenate(values), np.repeat([0, 1], len(values[0]))
        best = np.argsort(-value)[:count]
        columns = np.concatenate(vectors, axis=1)[:, best] * np.sqrt(value[best])
        moments = reduced.basis.reshape(-1, d) @ columns * np.where(part_of[best] == 0, 1.0, 1j)
        left = 0.0
        for part in range(2):
            mine = columns[:, part_of[best] == part]
            left += float((field @ (state.covariance[part] - mine @ mine.T) * field).sum())
        rest = math.sqrt(max(left, 0.0) / (2.0 * len(field)))
        shape = len(layer.positions), k, len(best)
        return PosteriorModes(
            np.ascontiguousarray(moments.reshape(shape).transpose(2, 0, 1)), rest
        )

    def learn(self, readings: Sequence[ToolReading]) -> None:
        """Take in what tools read while there is no metal: whatever is odd is theirs."""
        for reading in readings:
            rows = linearised(reading, self._model, self._model.moments, self._turn)
            errors = self._errors(reading.table)
            for part in (np.real, np.imag):
                pose, own, left = part(rows.pose), part(rows.own), part(rows.left)
                factor = np.linalg.cholesky(self._noise_of(len(left)) + pose @ pose.T)
                errors.learn(*_whitened(factor, own, left))

    def update(self, readings: Sequence[ToolReading]) -> dict[str, float]:
        """Take in what tools read in the frame of the last references.

        Returns the logarithm of the readings' likelihood by the names of the hypotheses that have
        a filter, and where nothing has changed.
        """
        if self._frame is None or not readings:
            return {}
        bank, _, drift = self._frame
        moments = self._model.moments * (1.0 + drift)
        evidence = dict.fromkeys((bank.names[0], *self._filters), 0.0)
        near = []
        for reading in readings:
            rows = linearised(reading, self._model, moments, self._turn)
            self._take(reading, rows, evidence)
            near.append(surroundings(rows.at))
        self._near = np.concatenate(near)
        return evidence

    def _take(self, reading: ToolReading, rows: ToolRows, evidence: dict[str, float]) -> None:
        """Update the filters with what one tool reads, and add to the evidence by names."""
        assert self._frame is not None
        bank, seen, _ = self._frame
        # What stays wrong for as long as the memory lasts may count once in it, not every frame;
        # what stays so for a shorter time counts as often as its correlation in time allows.
        lasting = 1.0 + MEMORY_S / self._step_s
        repeated = 1.0 + 2.0 * CONTRADICTION_S / self._step_s
        learnt = self._errors(reading.table)
        mean, covariance = learnt.posterior
        white = self._noise_of(len(rows.left))
        owns = [rows.own.real, rows.own.imag]
        errors = [
            _Errors(white, own @ covariance @ own.T, pose @ pose.T, lasting, repeated)
            for own, pose in zip(owns, (rows.pose.real, rows.pose.imag), strict=True)
        ]
        left = (rows.left.real, rows.left.imag)
        for error, own, values in zip(errors, owns, left, strict=True):
            nothing = np.zeros_like(white)
            evidence[bank.names[0]] += error.weighed(nothing, values - own @ mean)[1]
        known = []
        for name, state in self._filters.items():
            h = bank.names.index(name)
            layer, length = bank.prior(h).layer, reading.table.length
            basis = flux_basis(rows.at, rows.axes, length, layer.positions, layer.directions)
            rest = rows.left - (basis @ bank.moments(seen, h)).ravel()
            design = basis @ self._reduced_of(bank.prior(h)).basis.astype(np.float64)
            design = design.reshape(rest.size, len(state.mean))
            for i, (values, own) in enumerate(zip((rest.real, rest.imag), owns, strict=True)):
                if name == self._best:
                    open_metal = lasting * design @ state.covariance[i] @ design.T
                    factor = np.linalg.cholesky(white + open_metal + errors[i].pose)
                    off = np.asarray(values - design @ state.mean[:, i])
                    known.append(_whitened(factor, own, off))
                evidence[name] += _kalman(state, i, errors[i], design, values - own @ mean)
        for rows_of_errors, values in known:
            learnt.learn(rows_of_errors, values)

    def _errors(self, table: SensorTable) -> CoilErrors:
        if table.name not in self._tool_errors:
            self._tool_errors[table.name] = CoilErrors(table, self._tools)
        return self._tool_errors[table.name]

    def _noise_of(self, count: int) -> Array:
        nominal = self._tables.settings.accuracy.flux_noise_t
        return np.asarray((self._noise / nominal) ** 2 * np.eye(count))


def _whitened(factor: Floats, rows: Floats, values: Floats) -> tuple[Array, Array]:
    """Return rows (n, m) and values (n,) whose noise has the Cholesky factor given, made white."""
    white = solve_triangular(factor, np.column_stack([rows, values]), lower=True)
    return white[:, :-1], white[:, -1]


def _half_log_det(chol: tuple[Array, bool]) -> float:
    return float(np.log(np.diagonal(chol[0])).sum())


def _kalman(state: _Filter, part: int, errors: _Errors, rows: Array, values: Array) -> float:
    """Update one part of a filter with readings; return their log likelihood."""
    mean, covariance = state.mean[:, part], state.covariance[part]
    cross = covariance @ rows.T
    off = values - rows @ mean
    chol, likelihood = errors.weighed(rows @ cross, off)
    state.mean[:, part] = mean + cross @ cho_solve(chol, off)
    state.covariance[part] = covariance - cross @ cho_solve(chol, cross.T)
    return likelihood
