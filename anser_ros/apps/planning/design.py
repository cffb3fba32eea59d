"""Finds where reference coils inform most: expected errors of poses over a family of metals.

For metal of a known kind and strength everything is Gaussian, so the remaining uncertainty with
any choice of coils follows before a coil is glued on: the posterior covariance of the metal's
coordinates (`ReducedPrior`), weighted by their effect on poses. Coils are chosen one after the
other, each the one that leaves the least uncertainty, and are then exchanged while that helps
(Fedorov, Theory of Optimal Experiments, 1972).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from anser_ros.arrays import Array, Integers
from anser_ros.physics.sensor import SensorTable
from anser_ros.refit.clouds import Excitation, Region, below, overhead
from anser_ros.refit.layer import bottom_layer, box_layer
from anser_ros.refit.prior import UPRIGHT, Response, build_prior, reduced
from anser_ros.settings import RefitSettings

BELOW, AROUND = (0.2, 0.5, 1.1), (0.25, 0.6)
"""Standoffs of the metals below the board and around the volume, in halves of the board."""
GRADIENT = 3.0
"""Field of a dipole over its gradient times the distance: by it field errors move poses."""
MOST_EXCHANGES = 3
"""Rounds of exchanging every coil; the second seldom finds more than a percent."""


@dataclass(frozen=True)
class StatedMetal:
    """States one metal of the family, for C candidate coils.

    ``cross`` (D, C K) is the covariance of what poses feel of the metal, m, with the readings, in
    noise deviations, ``covariance`` (C K, C K) that of the readings, noise and drift included.
    While it is not corrected, poses have the error ``error_m``, root mean square.
    """

    name: str
    cross: Array
    covariance: Array
    error_m: float


@dataclass(frozen=True)
class Design:
    """Holds a choice of coils, rows of the candidates in the order in which they were chosen.

    ``errors_m`` is the expected error of poses that they leave, of each metal.
    """

    coils: tuple[int, ...]
    errors_m: Array

    @property
    def error_m(self) -> float:
        """Return the root mean square of the errors over the metals, m."""
        return float(np.sqrt(np.mean(self.errors_m**2)))


def family(
    candidates: SensorTable,
    excitation: Excitation,
    region: Region,
    frequencies_hz: Sequence[float],
    settings: RefitSettings,
    kinds: Sequence[str],
    error_m: float,
) -> list[StatedMetal]:
    """Return the metals of the stated kinds, ``below`` and ``around``.

    Each is as strong as to make poses in the volume wrong by ``error_m``, root mean square. Of
    the ``candidates``, in fg, some will be chosen.
    """
    noise = settings.accuracy.flux_noise_t
    clean = np.einsum('pa,pka->pk', candidates.axis, excitation.field(candidates.position))
    count, k = clean.shape
    drift = ((clean * settings.emitter_drift / noise)[:, :, None] * np.eye(k)).reshape(-1, k)
    others = np.eye(count * k) + drift @ drift.T
    points = region.volume.samples()
    size = np.linalg.norm(excitation.field(points), axis=(1, 2))
    per_field = float((points[:, 2] / size).mean()) / GRADIENT
    bottom, box = bottom_layer(region, excitation), box_layer(region, excitation)
    clouds = [below(region, part * region.half) for part in BELOW if 'below' in kinds]
    clouds += [overhead(region, part * region.half) for part in AROUND if 'around' in kinds]
    metals = []
    for cloud in clouds:
        layer, response = (box, Response()) if cloud.overhead else (bottom, UPRIGHT)
        field = excitation.field(cloud.positions)
        rng = np.random.default_rng(settings.seed)
        prior = build_prior(
            cloud, response, layer, candidates, field, np.array(frequencies_hz),
            settings.accuracy, rng,
        )  # fmt: skip
        few = reduced(prior, field, np.array(frequencies_hz), rng)
        # Per noise deviation of the readings; the metric is a sum over the samples.
        felt = few.felt * noise * per_field / np.sqrt(len(layer.points))
        strength = (error_m / float(np.linalg.norm(felt))) ** 2
        metals.append(
            StatedMetal(
                cloud.name,
                strength * felt[:, None] * few.cross,
                strength * prior.covariance + others,
                error_m,
            )
        )
    return metals


def _rows(coils: Sequence[int], k: int) -> Integers:
    return (np.asarray(coils, dtype=np.int64)[:, None] * k + np.arange(k)).ravel()


def expected_errors(metals: Sequence[StatedMetal], coils: Sequence[int], k: int) -> Array:
    """Return the error of poses (metals,), m, that some coils of K readings each leave."""
    rows = _rows(coils, k)
    out = []
    for metal in metals:
        known = 0.0
        if len(rows):
            factor = np.linalg.cholesky(metal.covariance[np.ix_(rows, rows)])
            known = float((np.linalg.solve(factor, metal.cross[:, rows].T) ** 2).sum())
        out.append(np.sqrt(max(metal.error_m**2 - known, 0.0)))
    return np.array(out)


def _gains(metals: Sequence[StatedMetal], coils: Sequence[int], k: int) -> Array:
    """Return how much each candidate (C,) would lower the mean square error of some coils, m^2."""
    rows = _rows(coils, k)
    total = np.zeros(len(metals[0].covariance) // k)
    for metal in metals:
        cross, covariance = metal.cross, metal.covariance
        blocks = np.stack([covariance[i : i + k, i : i + k] for i in range(0, len(covariance), k)])
        if len(rows):
            factor = np.linalg.cholesky(covariance[np.ix_(rows, rows)])
            half = np.linalg.solve(factor, covariance[rows])
            cross = cross - np.linalg.solve(factor, cross[:, rows].T).T @ half
            parts = half.reshape(len(rows), -1, k)
            blocks = blocks - np.einsum('rck,rcl->ckl', parts, parts, optimize=True)
        blocks[list(coils)] = np.eye(k)  # nothing is left of what is chosen: these are singular
        each = cross.reshape(len(cross), -1, k).transpose(1, 2, 0)
        total += np.einsum('ckd,ckd->c', each, np.linalg.solve(blocks, each))
    total[list(coils)] = -np.inf
    return total / len(metals)


def choose(metals: Sequence[StatedMetal], count: int, k: int) -> list[Design]:
    """Return the best choices of 1 to ``count`` coils, each one found from the one before.

    ``count``: at most the number of candidates. ``k``: readings of a coil.
    """
    coils: list[int] = []
    designs = []
    while len(coils) < count:
        coils.append(int(_gains(metals, coils, k).argmax()))
        designs.append(Design(tuple(coils), expected_errors(metals, coils, k)))
    for _ in range(MOST_EXCHANGES):
        before = tuple(coils)
        for i in range(len(coils)):
            others = coils[:i] + coils[i + 1 :]
            coils[i] = int(_gains(metals, others, k).argmax())
        if tuple(coils) == before:
            break
        found = Design(tuple(coils), expected_errors(metals, coils, k))
        if found.error_m < designs[-1].error_m:
            designs[-1] = found
    return designs


def random_designs(
    metals: Sequence[StatedMetal], count: int, k: int, tries: int, rng: np.random.Generator
) -> list[Design]:
    """Return random choices of so many coils."""
    total = len(metals[0].covariance) // k
    drawn = (rng.permutation(total)[:count].tolist() for _ in range(tries))
    return [Design(tuple(coils), expected_errors(metals, coils, k)) for coils in drawn]
