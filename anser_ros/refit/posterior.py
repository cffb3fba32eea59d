"""Evidence of the hypotheses, and the field's change with its uncertainty, from the references.

Every cloud's hypothesis is a Gaussian of the readings, ``y ~ N(0, a C + s^2 N)``: metal of a total
strength ``a`` as the cloud has it, the survey's errors in proportion, and noise. In the
eigenvectors of C (whitened by N) all of it is diagonal, so the evidence of any strength costs a
sum, and the strength is integrated over a grid instead of being chosen (MacKay, Neural Computation
4 (1992) 415). In-phase and quadrature parts share the geometry and have a strength each.
Hypothesis 0 is that nothing has changed.

N is white noise plus the drift of the emitters: a coil whose current reading is a little off shows
in all references in proportion to their baseline, which is nothing that metal does.

Readings are in units of the nominal noise throughout this module.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from anser_ros.refit.kernels import fill_evidence, fill_left_out, fill_products
from anser_ros.refit.prior import CloudPrior

Array = NDArray[np.float64]
Single = NDArray[np.float32]

STRENGTHS = 10.0 ** np.arange(-2.0, 11.0, 0.5)
"""Variances of a reading, in noise variances, that the evidence is summed over."""


@dataclass(frozen=True)
class FrameEvidence:
    """The evidence of one frame for the hypotheses.

    Attributes
    ----------
    projected : ndarray, shape (H, n, 2)
        Whitened readings in each hypothesis' eigenvectors; real, imaginary.
    log_evidence : ndarray, shape (H,)
    curve : ndarray, shape (H, A, 2)
        Logarithm of the likelihood of each strength, real and imaginary part.
    strength : ndarray, shape (H, 2, A)
        Probability of each strength.
    noise : float
        Noise in units of the nominal one.
    """

    projected: Single
    log_evidence: Array
    curve: Array
    strength: Array
    noise: float


MOST = len(STRENGTHS) - 1
"""Index of the largest strength."""
MOST_TABLES, MOST_BLOCKS = 12, 128
"""Noise levels and coil blocks that are kept ready."""


@dataclass(frozen=True)
class ErrorLevel:
    """The noise with the indices of the strengths of the real and the imaginary part."""

    noise: float
    strengths: tuple[int, int]


def _make_room(table: dict[Any, Any], most: int) -> None:
    """Drop the oldest entry of a table that is full."""
    if len(table) >= most:
        del table[next(iter(table))]


def log_sum(values: Array) -> float:
    """Return the logarithm of the sum of exponentials."""
    top = float(values.max())
    return top + float(np.log(np.exp(values - top).sum()))


def _over_strengths(curve: Array) -> tuple[Array, Array]:
    """Return log evidence (H,) and strength probabilities (H, 2, A) of the curves (H, A, 2)."""
    top = curve.max(axis=1, keepdims=True)
    weight = np.exp(curve - top)
    total = weight.sum(axis=1, keepdims=True)
    evidence = (top + np.log(total / len(STRENGTHS)))[:, 0].sum(axis=1)
    return evidence, (weight / total).swapaxes(1, 2)


class Bank:
    """All hypotheses for the references that are in use.

    Parameters
    ----------
    priors : sequence of CloudPrior
    rows : ndarray of int, shape (n,)
        Readings in use, as rows of the priors' covariance; all K of a coil or none.
    drift : ndarray, shape (all readings, K)
        Reading that one deviation of each emitter's drift makes, in noise units.
    noise : ndarray, shape (all readings,), optional
        Noise of each reading over the others' (1 where not given).
    slots : int
        Hypotheses more that can be put in later, one after the other in the same place.
    among : int
        How many hypotheses those in the slots are chosen from: each is as much less likely.
    """

    def __init__(
        self,
        priors: Sequence[CloudPrior],
        rows: NDArray[np.int64],
        drift: Array,
        noise: Array | None = None,
        slots: int = 0,
        among: int = 0,
    ) -> None:
        self.priors: list[CloudPrior | None] = [*priors, *[None] * slots]
        self.rows, self.width = rows, drift.shape[1]
        self._all_drift = drift
        self.drift = drift[rows]
        self._all_noise = np.ones(len(drift)) if noise is None else noise
        self._row_noise = self._all_noise[rows]
        self.whitening = _whitening(self.drift, self._row_noise)
        count, n = 1 + len(self.priors), len(rows)
        self.spectra, self.bases = np.zeros((count, n)), np.zeros((count, n, n))
        self._analysis = np.zeros((count * n, n), dtype=np.float32)
        self._drift_seen = np.zeros((count, self.width, n))
        self._prior = np.full(count, -np.inf)
        self._chosen = -float(np.log(max(among / max(slots, 1), 1.0)))
        self.is_slot = np.arange(count) >= count - slots
        self._set(0, self.whitening)
        for hypothesis, prior in enumerate(priors, start=1):
            self._decompose(hypothesis, prior)
        self._synthesis: dict[int, Single] = {}
        self._blocks: dict[tuple[float, int, int], Array] = {}
        self._tables: dict[float, tuple[Single, Array]] = {}

    def _set(self, hypothesis: int, basis: Array) -> None:
        n = len(self.rows)
        self.bases[hypothesis] = basis
        self._analysis[hypothesis * n : (hypothesis + 1) * n] = basis.T
        self._drift_seen[hypothesis] = self.drift.T @ basis
        self._prior[hypothesis] = self._chosen if self.is_slot[hypothesis] else 0.0
        self._name()

    def _decompose(self, hypothesis: int, prior: CloudPrior) -> None:
        block = prior.covariance[np.ix_(self.rows, self.rows)]
        values, vectors = eigh(self.whitening.T @ block @ self.whitening, driver='evd')
        self.spectra[hypothesis] = np.maximum(values, 0.0)
        self._set(hypothesis, self.whitening @ vectors)

    def vacate(self, hypothesis: int) -> None:
        """Empty a slot of the bank."""
        self.priors[hypothesis - 1] = None
        self._prior[hypothesis] = -np.inf
        self._name()

    def occupy(self, hypothesis: int, prior: CloudPrior) -> None:
        """Put a prior into a slot in place of the former one."""
        self.priors[hypothesis - 1] = prior
        self._decompose(hypothesis, prior)
        self._synthesis.pop(hypothesis, None)
        self._tables.clear()
        for key in [key for key in self._blocks if key[1] == hypothesis]:
            del self._blocks[key]

    def _name(self) -> None:
        """Fill the tables of each hypothesis."""
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
            variance = STRENGTHS[None, :, None] * self.spectra[:, None, :] + noise**2
            _make_room(self._tables, MOST_TABLES)
            log_det = np.log(variance).sum(axis=2)
            self._tables[noise] = ((1.0 / variance).astype(np.float32), log_det)
        return self._tables[noise]

    def evaluate(self, readings: Array, noise: float) -> FrameEvidence:
        """Return the evidence of every hypothesis.

        Parameters
        ----------
        readings : ndarray, shape (n, 2)
            Change since the baseline, real and imaginary part, in nominal noise deviations.
        noise : float
            Noise in units of the nominal one.
        """
        precision, log_det = self.precision(noise)
        count, n = self.spectra.shape
        projected = np.empty((count, n, 2), dtype=np.float32)
        curve, evidence = np.empty((count, len(STRENGTHS), 2)), np.empty(count)
        strength = np.empty((count, 2, len(STRENGTHS)))
        fill_evidence(
            self._analysis, _rows(readings), precision, log_det, np.isfinite(self._prior),
            projected, curve, strength, evidence,
        )  # fmt: skip
        evidence += self._prior
        return FrameEvidence(projected, evidence, curve, strength, noise)

    def coefficients(self, seen: FrameEvidence, hypothesis: int) -> Array:
        """Return the coordinates (n, 2) of the posterior mean in a hypothesis' eigenvectors."""
        precision, _ = self.precision(seen.noise)
        shrink = (seen.strength[hypothesis] * STRENGTHS) @ precision[hypothesis]
        return np.asarray(seen.projected[hypothesis] * shrink.T)

    def _to_moments(self, hypothesis: int) -> Single:
        if hypothesis not in self._synthesis:
            transfer = self.prior(hypothesis).transfer[:, self.rows]
            self._synthesis[hypothesis] = (transfer @ self.bases[hypothesis]).astype(np.float32)
        return self._synthesis[hypothesis]

    def moments(self, seen: FrameEvidence, hypothesis: int) -> NDArray[np.complex128]:
        """Return the posterior mean of the layer's moments (N, K) in units of the noise."""
        synthesis = self._to_moments(hypothesis)
        out = np.empty((len(synthesis), 2))
        fill_products(synthesis, _rows(self.coefficients(seen, hypothesis)), out)
        return out.view(np.complex128).reshape(-1, self.width)

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

    def left_out(self, seen: FrameEvidence, hypothesis: int) -> tuple[Array, Array]:
        """Return how far each coil's readings are from what all others predict.

        Returns
        -------
        chi2 : ndarray, shape (S,)
            Squared distance in units of the prediction's covariance; 2 K degrees of freedom.
        residual : ndarray, shape (S, K, 2)
            Measured minus predicted, in noise units.
        """
        precision, _ = self.precision(seen.noise)
        n, (real, imaginary) = len(self.rows), seen.strength[hypothesis].argmax(axis=1).tolist()
        chi2 = np.empty(n // self.width)
        residual = np.empty((len(chi2), self.width, 2))
        fill_left_out(
            self._analysis[hypothesis * n : (hypothesis + 1) * n], seen.projected[hypothesis],
            precision[hypothesis, real], precision[hypothesis, imaginary],
            self._block(seen.noise, hypothesis, real),
            self._block(seen.noise, hypothesis, imaginary), chi2, residual,
        )  # fmt: skip
        return chi2, residual

    def _block(self, noise: float, hypothesis: int, strength: int) -> Array:
        """Return the covariance of each coil's readings given all others, (S, K, K)."""
        key = (noise, hypothesis, strength)
        if key not in self._blocks:
            precision, _ = self.precision(noise)
            _make_room(self._blocks, MOST_BLOCKS)
            rows = self.bases[hypothesis].reshape(-1, self.width, len(self.rows))
            blocks = (rows * precision[hypothesis, strength]) @ rows.swapaxes(1, 2)
            self._blocks[key] = np.linalg.inv(blocks)
        return self._blocks[key]

    def without(self, seen: FrameEvidence, coils: NDArray[np.int64]) -> tuple[Array, Array]:
        """Return the evidence from the other coils alone, and the coils' errors by it.

        By the rules of the conditional normal distribution no matrix is decomposed again.

        Parameters
        ----------
        coils : ndarray of int, shape (Q,)
            Numbers of the coils among those in use.

        Returns
        -------
        log_evidence : ndarray, shape (H,)
        residual : ndarray, shape (Q, K, 2)
            Measured minus predicted under the most likely hypothesis, in noise units.
        """
        precision, _ = self.precision(seen.noise)
        rows = (coils[:, None] * self.width + np.arange(self.width)).ravel()
        curve, residuals = np.empty_like(seen.curve), []
        for h, basis in enumerate(self.bases[:, rows]):
            if not np.isfinite(self._prior[h]):
                curve[h] = 0.0
                residuals.append(np.zeros((len(rows), 2)))
                continue
            weighted = precision[h][:, None, :] * basis
            block = weighted @ basis.T
            q = weighted @ seen.projected[h]
            r = np.linalg.solve(block, q)
            log_det = np.linalg.slogdet(block)[1]
            curve[h] = seen.curve[h] + 0.5 * (q * r).sum(axis=1) - 0.5 * log_det[:, None]
            best = curve[h].argmax(axis=0)
            residuals.append(r[best, :, [0, 1]].T)
        evidence, _ = _over_strengths(curve)
        evidence += self._prior
        return evidence, residuals[int(evidence.argmax())].reshape(len(coils), self.width, 2)

    def distance(
        self,
        seen: FrameEvidence,
        hypothesis: int,
        rows: NDArray[np.int64],
        readings: Array,
        noise: float,
    ) -> float:
        """Return how far readings of an excluded coil are from what those in use predict.

        Parameters
        ----------
        rows : ndarray of int, shape (K,)
            Rows of the priors' covariance.
        readings : ndarray, shape (K, 2)
        noise : float
            Of these readings, which are not averaged, in units of the nominal one.

        Returns
        -------
        float
            Squared distance in units of the prediction's covariance; 2 K degrees of freedom.
        """
        precision, _ = self.precision(seen.noise)
        basis, variance = self.bases[hypothesis], seen.noise**2
        ahead = self._all_drift[rows]
        shared = variance * (ahead @ self.drift.T)
        own = np.diag((noise * self._all_noise[rows]) ** 2) + variance * (ahead @ ahead.T)
        total = 0.0
        for part in range(2):
            strength = int(seen.strength[hypothesis, part].argmax())
            cross, block = shared, own
            if hypothesis > 0:
                prior = self.prior(hypothesis).covariance
                cross = cross + STRENGTHS[strength] * prior[np.ix_(rows, self.rows)]
                block = block + STRENGTHS[strength] * prior[np.ix_(rows, rows)]
            seen_by = cross @ basis
            weighted = seen_by * precision[hypothesis, strength]
            r = readings[:, part] - weighted @ seen.projected[hypothesis, :, part]
            total += float(r @ np.linalg.solve(block - weighted @ seen_by.T, r))
        return total

    def error_level(self, seen: FrameEvidence, hypothesis: int) -> ErrorLevel:
        """Return the noise and strengths, rounded up, for which an uncertainty is computed."""
        noise = 2.0 ** float(np.ceil(np.log2(seen.noise) - 0.1))
        real, imaginary = (int(part.argmax()) for part in seen.strength[hypothesis])
        strengths = min(real + real % 2, MOST), min(imaginary + imaginary % 2, MOST)
        return ErrorLevel(noise, strengths)

    def error_draws(self, hypothesis: int, noise: float, strength: int, part: int) -> Array:
        """Return draws (N K, D) of the posterior's error of the layer's moments in noise units.

        A draw from the prior minus the posterior mean of its own noisy readings is a draw of the
        posterior's error (Matheron's rule; Wilson et al., JMLR 22 (2021) 105).
        """
        precision, _ = self.precision(noise)
        prior, root = self.prior(hypothesis), np.sqrt(STRENGTHS[strength])
        count = prior.draw_readings.shape[1]
        drawn = noise * _noise_draws(count, self.drift, self._row_noise, part)
        readings = root * prior.draw_readings[self.rows] + drawn
        gain = (STRENGTHS[strength] * precision[hypothesis, strength])[:, None]
        weights = gain * (self.bases[hypothesis].T @ readings)
        return np.asarray(root * prior.draw_moments - self._to_moments(hypothesis) @ weights)


def _rows(columns: Array) -> Single:
    """Return two columns (n, 2) as rows (2, n) for the kernels."""
    return np.ascontiguousarray(columns.T, dtype=np.float32)


def _whitening(drift: Array, noise: Array) -> Array:
    """Return a matrix W with ``W^T (diag(noise)^2 + drift drift^T) W = 1``.

    The columns of ``drift`` are one emitter's readings each, so they are orthogonal.
    """
    scaled = drift / noise[:, None]
    out = np.eye(len(drift))
    norm = np.linalg.norm(scaled, axis=0)
    for column in np.flatnonzero(norm > 0.0):
        unit = scaled[:, column] / norm[column]
        out -= np.outer(unit, unit) * (1.0 - 1.0 / np.sqrt(1.0 + norm[column] ** 2))
    return np.asarray(out / noise[:, None])


def _noise_draws(count: int, drift: Array, noise: Array, part: int) -> Array:
    """Return repeatable draws of the readings' noise and drift, (n, D)."""
    rng = np.random.default_rng(1 + part)
    white = noise[:, None] * rng.standard_normal((len(drift), count))
    return np.asarray(white + drift @ rng.standard_normal((drift.shape[1], count)))
