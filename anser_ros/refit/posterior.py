"""Keeps the bank of hypotheses: their evidence, the field's change under each of them, and its
uncertainty.

Every cloud's hypothesis is a Gaussian of the readings, ``y ~ N(0, a C + s^2 N)``: metal of a total
strength ``a`` distributed as in the cloud, the survey's errors in proportion, and noise. In the
eigenvectors of C (whitened by N) all of it is diagonal, so the evidence of any strength costs a
sum, and the strength is integrated over a grid instead of being chosen (MacKay, Neural Computation
4 (1992) 415). In-phase and quadrature parts share the geometry and have a strength each.
Hypothesis 0 is that nothing has changed. One pass over the readings of a frame gives the evidence
of all. A *slot* is an empty place for a compact body (`refit.hypotheses`).

N is white noise plus the drift of the emitters: an error of an emitter's measured current changes
all references in proportion to their baseline, which metal does not.

A *mode* is one direction in which the refitted model may be wrong: a set of moments whose field
has the size of one standard deviation. Modes are independent of each other. They are the principal
directions of random draws of the posterior's error; one number states the remainder.

Readings are in units of the nominal noise throughout this module.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from anser_ros.arrays import Array, ComplexArray, Integers, Single
from anser_ros.refit.kernels import fill_evidence, fill_products
from anser_ros.refit.prior import CloudPrior

STRENGTHS = 10.0 ** np.arange(-2.0, 11.0, 0.5)
"""Variances of a reading, in noise variances, that the evidence is summed over."""


@dataclass(frozen=True)
class FrameEvidence:
    """Holds the evidence of one frame for H hypotheses, at a noise in units of the nominal one."""

    # (H, n, 2), whitened readings in each hypothesis' eigenvectors; real, imaginary
    projected: Single
    log_evidence: Array  # (H,)
    # (H, 2, A), logarithm of the likelihood of each strength, of the real and imaginary part
    curve: Array
    strength: Array  # (H, 2, A), probability of each strength
    noise: float
    best: int  # the most likely hypothesis
    weighted: Array  # (2, n), readings by their inverse covariance under it, at its top strengths


def log_sum(values: Array) -> float:
    """Return the logarithm of the sum of exponentials."""
    top = float(values.max())
    return top + float(np.log(np.exp(values - top).sum()))


def median(values: Array) -> float:
    """Return the median of a few values, in a tenth of the time that numpy takes."""
    ordered = sorted(values.tolist())
    middle = len(ordered) // 2
    return float(0.5 * (ordered[middle] + ordered[-1 - middle]))


MOST_TABLES, MOST_BLOCKS = 12, 128
"""Noise levels and coil blocks that are kept ready."""


def make_room(table: dict[Any, Any], most: int) -> None:
    """Drop the oldest entry of a table that is full."""
    if len(table) >= most:
        del table[next(iter(table))]


@dataclass(frozen=True)
class Eigenbasis:
    """States what a prior's covariance is made of, for the n readings in use.

    Its eigenvalues (n,) and eigenvectors (n, n), in columns, of whitened readings, and the map (N
    K, n) from coordinates in these to the layer's moments.
    """

    prior: CloudPrior
    values: Array
    basis: Array
    synthesis: Single


class Bank:
    """Holds all hypotheses for the references that are in use.

    ``rows`` (n,) are the readings in use as rows of the priors' covariance, all K (``width``) of
    a coil or none; ``drift`` (all readings, K) is what one deviation of each emitter's drift
    makes of them, in noise units. The hypotheses of ``slots`` are put in later; these are chosen
    ``among`` so many, and each is as much less likely.

    ``bases`` (H, n, n) are each hypothesis' eigenvectors in columns, ``analysis`` (H n, n) the
    same in rows, ``spectra`` (H, n) the eigenvalues. ``log_prior`` (H,) is the logarithm of the
    probability before data, minus infinity for an empty slot.
    """

    def __init__(
        self,
        priors: Sequence[CloudPrior],
        rows: Integers,
        drift: Array,
        slots: int = 0,
        among: int = 0,
    ) -> None:
        self.priors: list[CloudPrior | None] = [*priors, *[None] * slots]
        self.rows, self.width = rows, drift.shape[1]
        self.all_drift = drift
        self.drift = drift[rows]
        self.whitening = _whitening(self.drift)
        count, n = 1 + len(self.priors), len(rows)
        self.spectra, self.bases = np.zeros((count, n)), np.zeros((count, n, n))
        self.analysis = np.zeros((count * n, n), dtype=np.float32)
        self._drift_seen = np.zeros((count, self.width, n))
        self.log_prior = np.full(count, -np.inf)
        self._chosen = -float(np.log(max(among / max(slots, 1), 1.0)))
        self.is_slot = np.arange(count) >= count - slots
        self._set(0, self.whitening)
        for hypothesis, prior in enumerate(priors, start=1):
            values, basis = self._decomposed(prior)
            self.spectra[hypothesis] = values
            self._set(hypothesis, basis)
        self._synthesis: dict[int, Single] = {}
        self._blocks: dict[tuple[float, int, int], Array] = {}
        self._tables: dict[float, tuple[Single, Array, set[int]]] = {}

    def _set(self, hypothesis: int, basis: Array) -> None:
        n = len(self.rows)
        self.bases[hypothesis] = basis
        self.analysis[hypothesis * n : (hypothesis + 1) * n] = basis.T
        self._drift_seen[hypothesis] = self.drift.T @ basis
        self.log_prior[hypothesis] = self._chosen if self.is_slot[hypothesis] else 0.0
        self._name()

    def _decomposed(self, prior: CloudPrior) -> tuple[Array, Array]:
        block = prior.covariance[np.ix_(self.rows, self.rows)]
        # numpy's releases the interpreter's lock, scipy's would stop the frames for 10 ms or more.
        values, vectors = np.linalg.eigh(self.whitening.T @ block @ self.whitening)
        return np.maximum(values, 0.0), self.whitening @ vectors

    def vacate(self, hypothesis: int) -> None:
        """Empty a slot of the bank."""
        self.priors[hypothesis - 1] = None
        self.log_prior[hypothesis] = -np.inf
        self._name()

    def eigenbasis(self, prior: CloudPrior) -> Eigenbasis:
        """Return what `replace_prior` needs; slow, but without side effects, for any thread."""
        values, basis = self._decomposed(prior)
        return Eigenbasis(prior, values, basis, self._to_moments(prior, basis))

    def replace_prior(self, hypothesis: int, eigenbasis: Eigenbasis) -> None:
        """Put a prior into a slot in place of the former one."""
        self.priors[hypothesis - 1] = eigenbasis.prior
        self.spectra[hypothesis] = eigenbasis.values
        self._set(hypothesis, eigenbasis.basis)
        self._synthesis[hypothesis] = eigenbasis.synthesis
        for *_, replaced in self._tables.values():
            replaced.add(hypothesis)
        for key in [key for key in self._blocks if key[1] == hypothesis]:
            del self._blocks[key]

    def posterior(self, hypothesis: int) -> Eigenbasis:
        """Return a hypothesis as it is now, other than 0, whatever becomes of a slot."""
        basis = self.bases[hypothesis]
        return Eigenbasis(
            self.prior(hypothesis), self.spectra[hypothesis].copy(),
            basis.copy() if self.is_slot[hypothesis] else basis, self.to_moments(hypothesis),
        )  # fmt: skip

    def _name(self) -> None:
        """Name the hypotheses again after one of them has changed."""
        slots = (f'slot {i}' if p is None else p.name for i, p in enumerate(self.priors))
        self.names: tuple[str, ...] = ('nothing', *slots)

    def prior(self, hypothesis: int) -> CloudPrior:
        """Return the prior of a hypothesis other than 0 and empty slots."""
        prior = self.priors[hypothesis - 1]
        assert prior is not None
        return prior

    def precision(self, noise: float) -> tuple[Single, Array]:
        """Return inverse variances (H, A, n) and log determinants (H, A) at a noise level."""
        if noise not in self._tables:
            make_room(self._tables, MOST_TABLES)
            self._tables[noise] = *_precision(self.spectra, noise), set()
        inverse, log_det, replaced = self._tables[noise]
        while replaced:  # since this level was last seen
            h = replaced.pop()
            (inverse[h],), (log_det[h],) = _precision(self.spectra[h : h + 1], noise)
        return inverse, log_det

    def evaluate(self, readings: Array, noise: float) -> FrameEvidence:
        """Return the evidence of every hypothesis.

        ``readings`` (n, 2): change since the baseline, real and imaginary part, in nominal noise
        deviations. ``noise``: noise in units of the nominal one.
        """
        precision, log_det = self.precision(noise)
        count, n = self.spectra.shape
        projected = np.zeros((count, n, 2), dtype=np.float32)
        curve, strength = np.zeros((2, count, 2, len(STRENGTHS)))
        evidence, weighted = np.zeros(count), np.zeros((2, n))
        best = fill_evidence(
            self.analysis, _rows(readings), precision, log_det, self.log_prior, projected, curve,
            strength, evidence, weighted,
        )  # fmt: skip
        return FrameEvidence(projected, evidence, curve, strength, noise, best, weighted)

    def coefficients(self, seen: FrameEvidence, hypothesis: int) -> Array:
        """Return the coordinates (n, 2) of the posterior mean in a hypothesis' eigenvectors."""
        precision, _ = self.precision(seen.noise)
        shrink = (seen.strength[hypothesis] * STRENGTHS) @ precision[hypothesis]
        return np.asarray(seen.projected[hypothesis] * shrink.T)

    def to_moments(self, hypothesis: int) -> Single:
        """Return the map (N K, n) from coordinates in the eigenvectors to the layer's moments."""
        if hypothesis not in self._synthesis:
            prior, basis = self.prior(hypothesis), self.bases[hypothesis]
            self._synthesis[hypothesis] = self._to_moments(prior, basis)
        return self._synthesis[hypothesis]

    def make_ready(self) -> None:
        """Work out what `to_moments` would in the frame that first needs it; any thread may."""
        for hypothesis, prior in enumerate(self.priors, start=1):
            if prior is not None and not self.is_slot[hypothesis]:
                self.to_moments(hypothesis)

    def _to_moments(self, prior: CloudPrior, basis: Array) -> Single:
        return np.asarray(prior.transfer[:, self.rows] @ basis, dtype=np.float32)

    def moments(self, seen: FrameEvidence, hypothesis: int) -> ComplexArray:
        """Return the posterior mean of the layer's moments (N, K) in units of the noise."""
        synthesis = self.to_moments(hypothesis)
        out = np.empty((len(synthesis), 2), dtype=np.float32)
        fill_products(synthesis, _rows(self.coefficients(seen, hypothesis)), out)
        return out.astype(np.float64).view(np.complex128).reshape(-1, self.width)

    def drifts(self, seen: FrameEvidence, hypothesis: int) -> tuple[Array, Array]:
        """Return mean (K, 2) and variance (K, 2) of the emitters' drift in prior deviations."""
        precision, _ = self.precision(seen.noise)
        scale, along = seen.noise**2, self._drift_seen[hypothesis]
        inverse = (seen.strength[hypothesis] @ precision[hypothesis]).T
        mean = scale * (along @ (seen.projected[hypothesis] * inverse))
        return mean, scale * (1.0 - scale * (along**2 @ inverse))

    def sources(self, seen: FrameEvidence, hypothesis: int) -> Array:
        """Return the mean polarisability (M, 2) of a cloud's sources in units of the noise."""
        weights = self.bases[hypothesis] @ self.coefficients(seen, hypothesis)
        return np.asarray(self.prior(hypothesis).coupling[self.rows].T @ weights)

    def coil_covariances(self, noise: float, hypothesis: int, strength: int) -> Array:
        """Return the covariance of each coil's readings given all others, (S, K, K)."""
        key = (noise, hypothesis, strength)
        if key not in self._blocks:
            precision, _ = self.precision(noise)
            make_room(self._blocks, MOST_BLOCKS)
            rows = self.bases[hypothesis].reshape(-1, self.width, len(self.rows))
            blocks = (rows * precision[hypothesis, strength]) @ rows.swapaxes(1, 2)
            self._blocks[key] = np.linalg.inv(blocks)
        return self._blocks[key]


def _precision(spectra: Array, noise: float) -> tuple[Single, Array]:
    """Return inverse variances (H, A, n) and log determinants (H, A) of spectra (H, n)."""
    variance = STRENGTHS[:, None] * spectra[:, None] + noise**2
    return (1.0 / variance).astype(np.float32), np.log(variance).sum(axis=2)


def _rows(columns: Array) -> Single:
    """Return two columns (n, 2) as rows (2, n) for the kernels."""
    return np.ascontiguousarray(columns.T, dtype=np.float32)


def _whitening(drift: Array) -> Array:
    """Return W with ``W^T (1 + drift drift^T) W = 1``; the columns of ``drift`` are orthogonal."""
    out = np.eye(len(drift))
    norm = np.linalg.norm(drift, axis=0)
    for column in np.flatnonzero(norm > 0.0):
        unit = drift[:, column] / norm[column]
        out -= np.outer(unit, unit) * (1.0 - 1.0 / np.sqrt(1.0 + norm[column] ** 2))
    return out


@dataclass(frozen=True)
class ErrorLevel:
    """Holds the noise with the indices of the strengths of the real and the imaginary part."""

    noise: float
    strengths: tuple[int, int]

    def growth(self, other: 'ErrorLevel') -> float:
        """Return by how much an error may be larger at another level, at least 1."""
        steps = [STRENGTHS[b] / STRENGTHS[a]
                 for a, b in zip(self.strengths, other.strengths, strict=True)]  # fmt: skip
        return max(1.0, other.noise / self.noise, math.sqrt(max(steps)))


@dataclass(frozen=True)
class PosteriorModes:
    """Holds the error of a hypothesis' posterior in units of the noise.

    It is a sum of moments (R, N, K) of the hypothesis' layer with independent normal factors. What
    they leave has the standard deviation ``rest`` of a phasor component in the middle of the
    volume: without it a pose would trust the directions that no mode points in.
    """

    moments: ComplexArray
    rest: float


def error_level(seen: FrameEvidence, hypothesis: int) -> ErrorLevel:
    """Return the noise and strengths, rounded up, for which an uncertainty is computed."""
    noise = 2.0 ** math.ceil(math.log2(seen.noise) - 0.1)
    real, imaginary = (int(part.argmax()) for part in seen.strength[hypothesis])
    most = len(STRENGTHS) - 1
    return ErrorLevel(noise, (min(real + real % 2, most), min(imaginary + imaginary % 2, most)))


def error_draws(
    bank: Bank, posterior: Eigenbasis, noise: float, strength: int, part: int
) -> Array:
    """Return draws (N K, D) of the posterior's error of the layer's moments in noise units.

    A draw from the prior minus the posterior mean of its own noisy readings is a draw of the
    posterior's error (Matheron's rule; Wilson et al., JMLR 22 (2021) 105).
    """
    prior, power = posterior.prior, STRENGTHS[strength]
    count = prior.draw_readings.shape[1]
    # Repeatable draws of the readings' noise and drift.
    rng = np.random.default_rng(1 + part)
    drawn = rng.standard_normal((len(bank.drift), count))
    drawn += bank.drift @ rng.standard_normal((bank.width, count))
    readings = np.sqrt(power) * prior.draw_readings[bank.rows] + noise * drawn
    gain = power / (power * posterior.values + noise**2)
    weights = (gain[:, None] * (posterior.basis.T @ readings)).astype(np.float32)
    return np.asarray(np.sqrt(power) * prior.draw_moments - posterior.synthesis @ weights)


def error_modes(
    bank: Bank, posterior: Eigenbasis, level: ErrorLevel, count: int
) -> PosteriorModes:
    """Return the principal modes of a posterior's error, weighted by its effect on poses.

    The posterior is one of `Bank.posterior`, the level one of `error_level`; ``count`` modes are
    kept. It takes long and changes nothing, so any thread may do it.
    """
    layer = posterior.prior.layer
    size, width = len(layer.positions), bank.width
    draws, powers, directions = [], [], []
    for part in range(2):
        error = error_draws(bank, posterior, level.noise, level.strengths[part], part)
        felt = (layer.metric @ error.reshape(size, -1)).reshape(error.shape)
        power, direction = np.linalg.eigh(felt.T @ felt)
        draws.append(error)
        powers.append(power)
        directions.append(direction / np.sqrt(len(power)))
    # The real and the imaginary part are independent: each mode is of one of them.
    half = len(powers[0])
    largest = np.argsort(-np.concatenate(powers), kind='stable')[:count]
    moments = np.zeros((len(largest), size, width), dtype=complex)
    left = np.zeros((len(layer.middle), width))
    for part, unit in enumerate((1.0, 1j)):
        ranks = np.flatnonzero(largest // half == part)
        modes = draws[part] @ directions[part][:, largest[ranks] % half]
        moments[ranks] = unit * modes.T.reshape(-1, size, width)
        # What all directions together make of the field, less what the modes do.
        left += _power_of(layer.middle, draws[part], width) / half
        left -= _power_of(layer.middle, modes, width)
    return PosteriorModes(moments, float(np.sqrt(np.median(np.maximum(left, 0.0)) / 2.0)))


def _power_of(middle: Array, moments: Array, width: int) -> Array:
    """Return the power (Q, K) of the field of moments (N K, D), summed over the last axis."""
    field = middle @ moments.reshape(middle.shape[1], -1)
    return np.asarray((field.reshape(len(middle), width, -1) ** 2).sum(axis=2))
