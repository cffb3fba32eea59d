"""Follows how probable each hypothesis about metal is, from frame to frame."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

UNCHANGED = 0.99
"""Probability of no change from which on the calibrated model is active."""


class Belief:
    """Holds probabilities of the hypotheses; the first of them is that nothing has changed.

    ``persistence`` is the probability that the hypothesis of one frame still holds in the next.

    Attributes
    ----------
    weights : ndarray, shape (H,)
        Probability of each hypothesis. It is replaced, never changed in place.
    """

    def __init__(self, count: int, persistence: float) -> None:
        self._persistence = persistence
        self.weights = np.zeros(count)
        self.forget()

    def forget(self) -> None:
        """Believe that nothing has changed."""
        self.weights = np.zeros(len(self.weights))
        self.weights[0] = 1.0

    @property
    def may_have_changed(self) -> bool:
        """Return whether the field may have changed: the calibrated model does not hold then."""
        return bool(self.weights[0] < UNCHANGED)

    @property
    def log_odds(self) -> float:
        """Return the logarithm of the odds that something has changed."""
        nothing = self.weights[0]
        return float(np.log(max(1.0 - nothing, 1e-300)) - np.log(max(nothing, 1e-300)))

    def update(self, log_evidence: Array) -> None:
        """Take in a frame's evidence of each hypothesis, shape (H,)."""
        prior = self._persistence * self.weights
        prior += (1.0 - self._persistence) / len(prior)
        log_weight = np.log(prior) + log_evidence
        weights = np.exp(log_weight - log_weight.max())
        self.weights = weights / weights.sum()

    def update_by(self, names: Sequence[str], evidence: Mapping[str, float]) -> None:
        """Update the weights of the named hypotheses by other evidence of the same frame.

        Hypotheses that are not in it are ruled out, unless all are.
        """
        if not evidence:
            return
        gain = np.array([evidence.get(name, -np.inf) for name in names])
        weights = self.weights * np.exp(gain - gain.max())
        if weights.sum() > 0.0:
            self.weights = weights / weights.sum()
