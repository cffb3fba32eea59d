"""Finds faults of reference coils, each judged by what the others predict for it.

A reference that is dead, moved, saturated or unplugged changes alone; metal changes many readings
at once, in the proportions that the emitters' fields have at one place. So "coil s is at fault" is
one more hypothesis, with readings of any size, while the others alone determine the metal, and its
odds against "all is well" come from the same evidence. All of it follows from the decompositions
that a `Bank` holds, by the rules of the conditional normal distribution. A coil that is left out
is watched, and returns when it has agreed with the others for a while.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from anser_ros.arrays import Array, Booleans, ComplexArray, Integers
from anser_ros.integrity.pose_checks import STREAM_GAP_S
from anser_ros.refit.kernels import fill_without
from anser_ros.refit.posterior import STRENGTHS, Bank, FrameEvidence, log_sum, median
from anser_ros.stamps import NANO

RISE, REACH = 0.5, 1000.0
"""Rise of a log likelihood from one strength to the next below which its top has been reached, and
how far behind the best a hypothesis may be to be worked out so: a verdict turns on a hundred."""


def left_out(bank: Bank, seen: FrameEvidence) -> tuple[Array, Array]:
    """Return how far each coil's readings are from what all others predict, most likely.

    First the squared distances (S,) in units of the prediction's covariance, of 2 K degrees of
    freedom; then measured minus predicted (S, K, 2), in noise units.
    """
    weighted = seen.weighted.reshape(2, -1, bank.width)
    residual = np.empty((*weighted.shape[1:], 2))
    for part, top in enumerate(seen.strength[seen.best].argmax(axis=1).tolist()):
        blocks = bank.coil_covariances(seen.noise, seen.best, top)
        residual[..., part] = np.einsum('skl,sl->sk', blocks, weighted[part])
    return np.einsum('psk,skp->s', weighted, residual), residual


def evidence_without(
    bank: Bank, seen: FrameEvidence, coils: Integers
) -> tuple[Array, list[Array]]:
    """Return the evidence without the first of some coils, the first two, and so on to all Q.

    By the rules of the conditional normal distribution no matrix is decomposed again. The change
    of the evidence is taken from the likelihood of the most likely strengths. ``coils`` (Q,) are
    numbers among the coils in use. The results are logarithms (Q, H) of the evidence, and Q
    residuals, (1 K, 2) to (Q K, 2): measured minus predicted under the most likely hypothesis, in
    noise units.
    """
    precision, _ = bank.precision(seen.noise)
    shape = len(bank.bases), len(coils)
    gain, strength = np.zeros(shape), np.zeros((*shape, 2), dtype=np.int64)
    fill_without(
        bank.bases, coils, bank.width, seen.projected, precision, seen.curve, seen.log_evidence,
        (RISE, REACH), np.full(len(coils), -math.inf), np.zeros(seen.curve.shape[::2], np.bool_),
        gain, strength,
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
    bank: Bank, seen: FrameEvidence, rows: Integers, readings: Array, noise: float
) -> float:
    """Return how far readings of an excluded coil are from what those in use predict.

    The squared distance in units of the prediction's covariance, of 2 K degrees of freedom.
    ``rows`` (K,) are the coil's rows of the priors' covariance; its ``readings`` (K, 2) are not
    averaged, so their ``noise`` is not that of the evidence.
    """
    precision, hypothesis = bank.precision(seen.noise)[0], seen.best
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


OK = 'ok'
FLAGGED = 'flagged'
NOT_FINITE = 'not finite'
MISSING = 'missing'
NO_BASELINE = 'no baseline'
SILENT = 'silent'
ABSURD = 'absurd'
DISAGREES = 'disagrees'
STUCK = 'stuck'
RECOVERING = 'recovering'

FAULT_SCALES = 10.0 ** np.arange(0.0, 6.1, 0.5)
"""Sizes of a faulty reading's error, in noise deviations, all as likely."""
SUSPECT_CHI2 = 2.8
"""Left-out chi-square per degree of freedom from which on a fault is considered."""
FAULT_ODDS = 100.0
"""Logarithm of the odds that a coil is at fault from which on it is left out. Metal that the
clouds describe badly reaches 70 in recordings; faults that matter begin at 100."""
SEEN = 10.0
"""Log odds, by the other coils alone, from which on a compact body counts as seen by them."""
AGREEMENT_CHI2 = 2.5
"""Left-out chi-square per degree of freedom below which an excluded coil agrees again."""
RETRY_FRAMES = 25
"""Frames after which an excluded coil is looked at again."""
HOLD_S = 0.5
"""Agreement, s, that readmits an excluded coil where that is sooner than its number of frames."""
FEWEST_HELD = 12
"""Fewest frames of agreement, unless fewer are stated: half-passing noise does it once in 4000."""
OUTSTANDING = 8.0
"""A change this many times the median coil's is looked at as a possible fault."""
MOST_AT_ONCE = 4
"""Coils that may fail together and be found. Metal that is near makes more of them stand out."""


class ReferenceHealth(NamedTuple):
    """States how one reference coil is in one frame."""

    name: str
    state: str  # `OK`, or why it was left out, by the names above
    # root mean square of measured minus predicted by all others, T a component; NaN where the coil
    # has no reading
    residual_t: float
    distance: float  # the same in units of its expected size; about 1 for a healthy coil


def judge_references(
    names: Sequence[str], reasons: Sequence[str], used: Booleans, chi2: Array,
    residual: Array, flux_noise_t: float,
) -> tuple[ReferenceHealth, ...]:  # fmt: skip
    """Return the health of every reference in one frame.

    ``chi2`` (U,) and ``residual`` (U, K, 2) are those of `left_out` for the coils that
    are ``used`` (S,), empty where they were not compared; ``flux_noise_t`` is the residuals' unit.
    """
    size, apart = np.full(len(used), np.nan), np.full(len(used), np.nan)
    if len(chi2):
        size[used] = np.sqrt((residual**2).mean(axis=(1, 2))) * flux_noise_t
        apart[used] = np.sqrt(chi2 / (2 * residual.shape[1]))
    return tuple(map(ReferenceHealth, names, reasons, size.tolist(), apart.tolist()))


def fault_odds(bank: Bank, seen: FrameEvidence, coils: Integers) -> list[float]:
    """Return the log odds that the first of some coils in use is at fault, the first two, and on.

    Each coil is then at fault in a different way.
    """
    odds: list[float] = []
    for others, residual in zip(*evidence_without(bank, seen, coils), strict=True):
        broad = 0.0
        for own in residual.reshape(-1, bank.width, 2):
            size = float((own**2).sum())
            likelihood = -0.5 * size / FAULT_SCALES**2 - own.size * np.log(FAULT_SCALES)
            broad += log_sum(likelihood) - float(np.log(len(FAULT_SCALES)))
        # A body that only these coils see is no better an explanation than their fault.
        unseen = bank.is_slot & (others < others[0] + SEEN)
        well = np.where(unseen, -np.inf, seen.log_evidence)
        odds.append(float(log_sum(others) + broad - log_sum(well)))
    return odds


def find_faults(bank: Bank, seen: FrameEvidence, suspects: list[Integers]) -> Integers:
    """Return the suspects that are most probably at fault, or none.

    Of each array of suspects the first one may be at fault, the first two, and so on.
    """
    best, margin = np.empty(0, dtype=np.int64), 0.0
    for coils in suspects:
        for count, odds in enumerate(fault_odds(bank, seen, coils), start=1):
            if odds - FAULT_ODDS * count > margin:
                best, margin = coils[:count], odds - FAULT_ODDS * count
    return best


class ReferenceWatch:
    """Keeps account of which coils are ``excluded`` (S,), for what ``reason``, and how long.

    A coil must be readable and agree for ``hold_frames`` before it is used again, at low rates for
    fewer, see `HOLD_S`.
    """

    def __init__(self, count: int, hold_frames: int) -> None:
        self.count, self.hold_frames = count, hold_frames
        self.excluded = np.zeros(count, dtype=bool)
        self.reason = [OK] * count
        self._good = np.zeros(count, dtype=np.int64)
        self._before: tuple[Booleans, list[str], Integers] | None = None
        self._dismissed = 0.0, 0
        self._since = self._last_ns = 0
        self._gap_s = math.inf

    def note(self, readable: Booleans, reasons: list[str], least: int, stamp_ns: int) -> None:
        """Exclude unreadable coils, whose waiting time starts again with every such frame.

        If fewer than `least` can be read, samples were lost and no coil is at fault: the next
        frame continues as before.
        """
        # The time between frames; one that was lost, or points one by one, do not count.
        gap_s = (stamp_ns - self._last_ns) * NANO
        self._last_ns = stamp_ns
        if 0.0 < gap_s <= STREAM_GAP_S:
            self._gap_s = min(gap_s, 1.1 * self._gap_s)
        if self._before is not None:
            self.excluded, self.reason, self._good = self._before
            self._before = None
        count = np.count_nonzero(readable)
        if count < least:
            self._before = self.excluded.copy(), self.reason.copy(), self._good.copy()
        for coil in np.flatnonzero(~readable) if count < self.count else ():
            self.excluded[coil], self.reason[coil], self._good[coil] = True, reasons[coil], 0

    @property
    def hold(self) -> int:
        """Return the frames that a coil has to agree for at the present rate."""
        if not math.isfinite(self._gap_s):
            return self.hold_frames
        return min(self.hold_frames, max(FEWEST_HELD, math.ceil(HOLD_S / self._gap_s)))

    def exclude(self, coil: int) -> None:
        """Exclude a coil that disagrees with the others."""
        self.excluded[coil], self.reason[coil], self._good[coil] = True, DISAGREES, 0

    def recover(self, coil: int) -> None:
        """Take a coil for good again whose readings have jumped back; it waits as others do."""
        if self.excluded[coil] and self.reason[coil] == DISAGREES:
            self.reason[coil], self._good[coil] = RECOVERING, 0

    def without_excluded(self, flux: ComplexArray) -> ComplexArray:
        """Return fluxes (S, K) with NaN for excluded coils; the same array if there are none."""
        out = self.excluded
        return np.where(out[:, None], np.nan, flux) if out.any() else flux

    @property
    def used(self) -> int:
        """Return the number of coils in use."""
        return self.count - int(np.count_nonzero(self.excluded))

    @property
    def is_outvoted(self) -> bool:
        """Return whether more coils disagree than are in use, so that either may be wrong."""
        return self.reason.count(DISAGREES) > self.used

    def agreed(self, coil: int, agrees: bool) -> None:
        """Count a frame in which an excluded coil was compared."""
        self._good[coil] = self._good[coil] + 1 if agrees else 0

    def readmit(self) -> None:
        """Use the coils again that have had enough good frames; called once a frame.

        Each change of the coils in use costs more than a frame's time, so they wait for those that
        are on their way back too, for as long again at most.
        """
        ready = self.excluded & (self._good >= self.hold)
        awaited = self.excluded & (self._good > 0) & ~ready
        if awaited.any() and self._good.max() < 2 * self.hold:
            return
        for coil in np.flatnonzero(ready):
            self.excluded[coil], self.reason[coil], self._good[coil] = False, OK, 0

    def wait(self, readable: Booleans) -> None:
        """Count a frame with too few coils to compare; coils once unreadable return in time."""
        for coil in np.flatnonzero(self.excluded & readable):
            self.agreed(int(coil), self.reason[coil] != DISAGREES)
        self.readmit()

    def suspects(self, chi2: Array, power: Array, freedom: int) -> list[Integers]:
        """Return the coils in use whose fault is worth computing, often none; for `find_faults`.

        Coils that are far from what the others predict are suspected one by one; several that are
        wrong at once hide each other, so those whose readings stand out are suspected together. A
        suspicion that was just dismissed is tested again when it has grown, or after a while.

        ``chi2`` (S,) is each coil's left-out chi-square, ``power`` (S,) its squared change in
        noise units, of ``freedom`` readings.
        """
        self._since += 1
        level = OUTSTANDING**2 * max(median(power), freedom)
        if chi2.max() <= SUSPECT_CHI2 * freedom and power.max() <= level:
            return []
        order = np.argsort(-chi2)[:3]
        sets = [order[i : i + 1] for i in range(len(order))]
        sets = [s for s in sets if chi2[s[0]] > max(SUSPECT_CHI2 * freedom, 0.5 * chi2[order[0]])]
        by_power = np.argsort(-power)
        out = by_power[: MOST_AT_ONCE + 1]
        out = out[power[out] > level]
        if 0 < len(out) <= min(MOST_AT_ONCE, len(power) // 3):
            sets.append(out)
        if not sets:
            return []
        alarm = (float(chi2[order[0]]) / freedom, len(out))
        worse = alarm[0] > 1.3 * self._dismissed[0] or alarm[1] > self._dismissed[1]
        if not worse and self._since < RETRY_FRAMES:
            return []
        self._since = 0
        self._dismissed = alarm
        return sets
