"""Agreement of reference coils: each one's readings against what the other coils predict for it.

All of it follows from the decompositions that a `Bank` holds, by the rules of the conditional
normal distribution; no matrix of the size of all readings is decomposed again.
"""

import numpy as np
from numpy.typing import NDArray

from anser_ros.refit.evidence import STRENGTHS, FrameEvidence, over_strengths
from anser_ros.refit.kernels import fill_left_out
from anser_ros.refit.posterior import Bank

Array = NDArray[np.float64]


def left_out(bank: Bank, seen: FrameEvidence, hypothesis: int) -> tuple[Array, Array]:
    """Return how far each coil's readings are from what all others predict.

    Returns
    -------
    chi2 : ndarray, shape (S,)
        Squared distance in units of the prediction's covariance; 2 K degrees of freedom.
    residual : ndarray, shape (S, K, 2)
        Measured minus predicted, in noise units.
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
) -> tuple[Array, Array]:
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
    precision, _ = bank.precision(seen.noise)
    rows = (coils[:, None] * bank.width + np.arange(bank.width)).ravel()
    curve, residuals = np.empty_like(seen.curve), []
    for h, basis in enumerate(bank.bases[:, rows]):
        if not np.isfinite(bank.log_prior[h]):
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
    evidence, _ = over_strengths(curve)
    evidence += bank.log_prior
    return evidence, residuals[int(evidence.argmax())].reshape(len(coils), bank.width, 2)


def distance_of(
    bank: Bank,
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
    precision, _ = bank.precision(seen.noise)
    basis, variance = bank.bases[hypothesis], seen.noise**2
    ahead = bank.all_drift[rows]
    shared = variance * (ahead @ bank.drift.T)
    own = np.diag((noise * bank.all_noise[rows]) ** 2) + variance * (ahead @ ahead.T)
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
