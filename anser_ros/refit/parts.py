"""Finds the part of the references that has moved as one, beside metal or without.

Which coils belong to it is not known before, and a part may be most of them. The evidence that
some coils have moved as one is that of `refit.moved`; whether it grows with a coil more or less
follows from the products of the columns of two coils, which a hypothesis decides. So the part
grows and shrinks until no coil is missing and none too many.
"""

from typing import NamedTuple

import numpy as np

from anser_ros.arrays import Array, Booleans, Integers
from anser_ros.refit.health import MOST_AT_ONCE
from anser_ros.refit.posterior import Bank, FrameEvidence, log_sum, make_room

MOST_CHANGES = 6
"""Changes of a part in one look, each the evidence of as many parts as there are coils; the next
look goes on where one ends, so that more would cost time only."""
MOST_KEPT = 16
"""Hypotheses whose products are kept, 0.3 MB each."""


class MovedPart(NamedTuple):
    """States the log evidence that some coils have moved as one, by how much (6,), and the sigma
    of that (6,); in the units of the columns that were given.
    """

    log_evidence: float
    coils: Integers
    motion: Array
    sigma: Array


NO_PART = MovedPart(-np.inf, np.empty(0, np.int64), np.zeros(6), np.zeros(6))
"""No coils, which have not moved: of no evidence, so that any part is more probable."""


class MovedParts:
    """Remembers from one look to the next which coils were thought to have moved."""

    def __init__(self) -> None:
        self._known: dict[tuple[object, ...], tuple[Array, Array]] = {}
        self.forget()

    def forget(self) -> None:
        """Believe again that all coils move, if any."""
        self._members: dict[tuple[bool, bytes], Booleans] = {}

    def look(self, bank: Bank, seen: FrameEvidence, columns: Array) -> MovedPart:
        """Return the most probable part of the coils in use, where something has changed.

        ``columns`` (all readings, 6) are what a motion of all makes of the readings.
        """
        best, numbers = NO_PART, bank.rows[:: bank.width] // bank.width
        coils = bank.rows.tobytes()
        self._members = {k: v for k, v in self._members.items() if k[1] == coils}
        for hypothesis in (0, seen.best):
            curve = seen.curve[hypothesis, 0]
            # Of every other strength, whose products are kept more often.
            top = 2 * int(curve[::2].argmax()) if hypothesis else 0
            sides, products = self._products_of(bank, hypothesis, seen.noise, top, columns)
            weighted = bank.precision(seen.noise)[0][hypothesis, top]
            weighted = np.sqrt(weighted) * seen.projected[hypothesis, :, 0]
            scores = (weighted @ sides).reshape(-1, 6)
            key = hypothesis > 0, coils
            start = self._members.get(key, np.ones(len(numbers), dtype=bool))
            members, gained = _grown(start, scores, products)
            self._members[key] = members
            base = float(curve[top]) - log_sum(curve) if hypothesis else 0.0
            log_evidence = float(seen.log_evidence[hypothesis]) + base + gained
            if log_evidence > best.log_evidence and members.sum() > MOST_AT_ONCE:
                inside = np.eye(6) + products[members][:, members].sum(axis=(0, 1))
                covariance = np.linalg.inv(inside)
                motion = covariance @ scores[members].sum(axis=0)
                sigma = np.sqrt(np.diag(covariance))
                best = MovedPart(log_evidence, numbers[members], motion, sigma)
        return best

    def _products_of(
        self, bank: Bank, hypothesis: int, noise: float, top: int, columns: Array
    ) -> tuple[Array, Array]:
        """Return the coils' columns in a hypothesis' whitened eigenvectors (n, 6 S), and the
        products ``X_s^T P X_t`` (S, S, 6, 6) of those of two coils.
        """
        key = bank.rows.tobytes(), bank.names[hypothesis], noise, top
        if key not in self._known:
            make_room(self._known, MOST_KEPT)
            n, width = len(bank.rows), bank.width
            basis = bank.bases[hypothesis].reshape(-1, width, n)
            own = columns[bank.rows].reshape(-1, width, 6)
            inside = np.einsum('skn,ski->nsi', basis, own, optimize=True)
            deviation = np.sqrt(bank.precision(noise)[0][hypothesis, top])
            sides = deviation[:, None] * inside.reshape(n, -1)
            products = (sides.T @ sides).reshape(len(own), 6, len(own), 6).transpose(0, 2, 1, 3)
            self._known[key] = sides, np.ascontiguousarray(products)
        return self._known[key]


def _evidence(inside: Array, score: Array) -> Array:
    """Return ``1/2 b^T (1 + M)^-1 b - 1/2 log |1 + M|`` of M (..., 6, 6) and b (..., 6)."""
    inside = inside + np.eye(6)
    solved = np.linalg.solve(inside, score[..., None])[..., 0]
    return np.asarray(0.5 * (score * solved).sum(axis=-1) - 0.5 * np.linalg.slogdet(inside)[1])


def _grown(members: Booleans, scores: Array, products: Array) -> tuple[Booleans, float]:
    """Return the part to which some members grow or shrink, and its evidence.

    All coils change sides by which the evidence would grow; if that is no better, the best one.
    """
    own = np.einsum('ssij->sij', products)
    evidence = -np.inf
    for _ in range(MOST_CHANGES):
        score, rows = scores[members].sum(axis=0), products[:, members].sum(axis=1)
        inside = rows[members].sum(axis=0)
        evidence = float(_evidence(inside, score))
        sign = np.where(members, -1.0, 1.0)
        cross = sign[:, None, None] * (rows + rows.swapaxes(1, 2)) + own
        gained = _evidence(inside + cross, score + sign[:, None] * scores) - evidence
        if gained.max() <= 0.0:
            break
        trial = members ^ (gained > 0.0)
        of_trial = products[trial][:, trial].sum(axis=(0, 1))
        if float(_evidence(of_trial, scores[trial].sum(axis=0))) <= evidence + gained.max():
            trial = members.copy()
            trial[gained.argmax()] ^= True
        members = trial
    return members, evidence
