"""Compares each reference coil's readings with what the other coils predict for it.

All of it follows from the decompositions that a `Bank` holds, by the rules of the conditional
normal distribution; no matrix of the size of all readings is decomposed again.
"""

import numpy as np
from numpy.typing import NDArray

from anser_ros.refit.evidence import STRENGTHS, FrameEvidence
from anser_ros.refit.kernels import fill_left_out, fill_without
from anser_ros.refit.posterior import Bank

Array = NDArray[np.float64]

RISE, REACH = 0.5, 1000.0
"""Rise of a log likelihood from one strength to the next below which its top has been reached, and
how far behind the best a hypothesis may be to be worked out so: a verdict turns on a hundred."""


def left_out(bank: Bank, seen: FrameEvidence, hypothesis: int) -> tuple[Array, Array]:
    """Return how far each coil's readings are from what all others predict.

    First the squared distances (S,) in units of the prediction's covariance, of 2 K degrees of
    freedom; then measured minus predicted (S, K, 2), in noise units.
    """
    precision, _ = bank.precision(seen.noise)
    n, (real, imaginary) = len(bank.rows), seen.strength[hypothesis].argmax(axis=1).tolist()
    chi2 = np.empty(n // bank.width)
    residual = np.empty((len(chi2), bank.width, 2))
    fill_left_out(
        bank.analysis[hypothesis * n : (hypothesis + 1) * n], seen.projected[hypothesis],
        precision[hypothesis, real], precision[hypothesis, imaginary],
        bank.coil_covariances(seen.noise, hypothesis, real),
        bank.coil_covariances(seen.noise, hypothesis, imaginary), chi2, residual,
    )  # fmt: skip
    return chi2, residual


def evidence_without(
    bank: Bank, seen: FrameEvidence, coils: NDArray[np.int64]
) -> tuple[Array, list[Array]]:
    """Return the evidence without the first of some coils, the first two, and so on to all Q.

    By the rules of the conditional normal distribution no matrix is decomposed again. The change
    of the evidence is taken from the likelihood of the most likely strengths. ``coils`` (Q,) are
    numbers among the coils in use.

    Returns
    -------
    log_evidence : ndarray, shape (Q, H)
    residuals : list of Q ndarrays, of shapes (1 K, 2) to (Q K, 2)
        Measured minus predicted under the most likely hypothesis, in noise units.
    """
    precision, _ = bank.precision(seen.noise)
    shape = len(bank.bases), len(coils)
    gain, strength = np.empty(shape), np.zeros((*shape, 2), dtype=np.int64)
    fill_without(
        bank.bases, coils, bank.width, seen.projected, precision, seen.curve, seen.log_evidence,
        (RISE, REACH), gain, strength,
    )  # fmt: skip
    evidence, residuals = (seen.log_evidence[:, None] + gain).T, []
    rows = (coils[:, None] * bank.width + np.arange(bank.width)).ravel()
    for q, best in enumerate(evidence.argmax(axis=1).tolist()):
        basis = bank.bases[best, rows[: (q + 1) * bank.width]]
        residual = np.empty((len(basis), 2))
        for part in range(2):
            weighted = basis * precision[best, strength[best, q, part]]
            seen_by = weighted @ seen.projected[best, :, part]
            residual[:, part] = np.linalg.solve(weighted @ basis.T, seen_by)
        residuals.append(residual)
    return evidence, residuals


def distance_of(
    bank: Bank,
    seen: FrameEvidence,
    hypothesis: int,
    rows: NDArray[np.int64],
    readings: Array,
    noise: float,
) -> float:
    """Return how far readings of an excluded coil are from what those in use predict.

    The squared distance in units of the prediction's covariance, of 2 K degrees of freedom.
    ``rows`` (K,) are the coil's rows of the priors' covariance; its ``readings`` (K, 2) are not
    averaged, so their ``noise`` is not that of the evidence.
    """
    precision, _ = bank.precision(seen.noise)
    basis, variance = bank.bases[hypothesis], seen.noise**2
    ahead = bank.all_drift[rows]
    shared = variance * (ahead @ bank.drift.T)
    own = noise**2 * np.eye(len(rows)) + variance * (ahead @ ahead.T)
    total = 0.0
    for part in range(2):
        strength = int(seen.strength[hypothesis, part].argmax())
        cross, block = shared, own
        if hypothesis > 0:
            prior = bank.prior(hypothesis).covariance
            cross = cross + STRENGTHS[strength] * prior[np.ix_(rows, bank.rows)]
            block = block + STRENGTHS[strength] * prior[np.ix_(rows, rows)]
        seen_by = cross @ basis
        weighted = seen_by * precision[hypothesis, strength]
        r = readings[:, part] - weighted @ seen.projected[hypothesis, :, part]
        total += float(r @ np.linalg.solve(block - weighted @ seen_by.T, r))
    return total
