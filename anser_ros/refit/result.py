"""Defines the results that the live refit reports of a frame."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from anser_ros.field.model import FieldModel
from anser_ros.pose_states import REFERENCES_DOUBTFUL, REFERENCES_LOST
from anser_ros.refit import health
from anser_ros.refit.evidence import FrameEvidence
from anser_ros.refit.health import ReferenceHealth
from anser_ros.refit.posterior import Bank

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

FROZEN = 'frozen'
REFIT = 'refit'
FEW_REFERENCES = 'few_references'
POOR_FIT = 'poor_fit'
STATES = (FROZEN, REFIT, FEW_REFERENCES, POOR_FIT, REFERENCES_DOUBTFUL)
"""No change; the model follows one; too few references to know; a change that
nothing explains; references of which most jumped by themselves."""

POOR = 4.0
"""Typical left-out distance from which on the state is `POOR_FIT`."""

WITHHELD = {
    FEW_REFERENCES: REFERENCES_LOST,
    POOR_FIT: REFERENCES_DOUBTFUL,
    REFERENCES_DOUBTFUL: REFERENCES_DOUBTFUL,
}
"""State that trackers receive in states whose model is none to give poses by."""


@dataclass(frozen=True)
class Metal:
    """Describes the sources of the change, as the most likely cloud has them.

    Attributes
    ----------
    positions : ndarray, shape (M, 3)
        m, frame fg.
    polarisability : ndarray, shape (M,), complex
        A m^2 / T.
    volumes : ndarray, shape (M,)
        Volume that each source stands for, m^3.
    centroid : ndarray, shape (3,)
        Mean of the space, weighted by the squared magnitude of the polarisability's density: it
        leans towards the part of the metal that the emitters reach best.
    standoff_m : float
        The cloud's distance from the board.
    """

    positions: Array
    polarisability: ComplexArray
    volumes: Array
    centroid: Array
    standoff_m: float


def locate_metal(
    bank: Bank, seen: FrameEvidence, weights: Array, flux_noise_t: float
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
    return Metal(cloud.positions, polarisability, cloud.volumes, centroid, cloud.standoff_m)


@dataclass(frozen=True)
class RefitResult:
    """Holds the result of one frame of the references.

    Attributes
    ----------
    stamp_ns : int
    model : FieldModel
        The active model; the calibrated one itself while nothing has changed.
    state : str
        One of `STATES`, and the `reason` why.
    judge, find : callable
        Work out `references` and `metal`.
    log_odds : float
        Natural logarithm of the odds that something has changed.
    weights : mapping of str to float
        Probability of every cloud, and of ``nothing``.
    noise_t : float
        Measured noise of the references' phasor components, T.
    drift : ndarray, shape (K,), complex
        Relative change of each emitter's strength; where nothing else changes, zero unless it is
        significant.
    reason : str
    """

    stamp_ns: int
    model: FieldModel
    state: str
    judge: Callable[[], tuple[ReferenceHealth, ...]] = field(repr=False)
    log_odds: float
    weights: dict[str, float]
    noise_t: float
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
    def references(self) -> tuple[ReferenceHealth, ...]:
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
