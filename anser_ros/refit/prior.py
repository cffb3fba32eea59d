"""Predicts by one hypothesis: the covariance of readings, the map to the field, and the few
numbers that poses feel.

With the excitation B_k(r_j) of emitter k at source j and the coupling G_s(r_j) of coil s, a source
of the polarisability tensor P_j changes the reading by ``G_s(r_j)^T P_j B_k(r_j)``: the same P_j
for all emitters. Independent P_j of variance ``a v_j`` (v_j the source's volume) make the readings
Gaussian with the covariance ``a C``. All that depends on the geometry is computed here, once.

Polarisabilities vary a little with the drive frequency: each source gets a second, independent
part proportional to log(f_k / f_mean), of `FREQUENCY_SLOPE` times the first one's deviation.

A surveyed coil differs slightly from the table in place, direction and gain. Without metal this is
part of its baseline and cancels; in the change caused by metal it leaves an error proportional to
the change. To first order it is the reading of a few displaced, turned and scaled copies of the
coil (`survey_variants`).

The field of a cloud's thousands of sources, as the layer makes it in the tracked volume, has some
tens of directions that affect poses (`reduced`). Coordinates along them have unit variance for
metal of unit strength, so a posterior over metal is a mean and a small covariance matrix, which
readings of coils that move can update frame by frame. The directions are those of a randomised
singular value decomposition (Halko, Martinsson & Tropp, SIAM Review 53 (2011) 217).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from anser_ros.arrays import Array, Single
from anser_ros.metal.body import FREQUENCY_SLOPE
from anser_ros.physics.dipole import flux_basis
from anser_ros.physics.rotations import tangents
from anser_ros.physics.sensor import SensorTable, along_each_axis
from anser_ros.refit.clouds import Cloud
from anser_ros.refit.layer import Layer
from anser_ros.settings import Accuracy

STEP_M = 1e-4
"""Step of the numerical derivative by a reference's position, m."""


def vector_basis(points: Array, axes: Array, lengths: Array | None, sources: Array) -> Array:
    """Return each coil's flux per unit moment along x, y and z of each source, (S, M, 3)."""
    basis = flux_basis(points, axes, lengths, *along_each_axis(sources))
    return basis.reshape(len(points), len(sources), 3)


def survey_variants(
    references: SensorTable, sources: Array, accuracy: Accuracy
) -> Iterator[Array]:
    """Yield the change (S, M, 3) of `vector_basis` by one deviation of each survey error."""
    p, n, lengths = references.position, references.axis, references.length
    if accuracy.reference_gain > 0.0:
        yield accuracy.reference_gain * vector_basis(p, n, lengths, sources)
    if accuracy.reference_axis_rad > 0.0:
        across = tangents(n)
        for side in range(2):
            yield accuracy.reference_axis_rad * vector_basis(p, across[:, side], lengths, sources)
    if accuracy.reference_position_m > 0.0:
        for unit in np.eye(3) * STEP_M:
            ahead = vector_basis(p + unit, n, lengths, sources)
            ahead -= vector_basis(p - unit, n, lengths, sources)
            yield ahead * (accuracy.reference_position_m / (2.0 * STEP_M))


N_SAMPLES = 48
"""Draws from the prior, from which the posterior's uncertainty is made. Fewer make the uncertainty
itself uncertain, by a tenth with 48; more cost memory and the start of the refit in proportion."""


@dataclass(frozen=True)
class Response:
    """Holds the prior of a source's polarisability tensor, as variances of its independent parts
    over that of a multiple of the unit tensor.

    A compact piece responds equally in all directions. A flat piece responds only across its face,
    and pieces that touch drive each other: in recordings, metal below a board responds differently
    along the board's normal, and plates in yet other ways.
    """

    name: str = ''  # empty for the plain one
    upright: float = 0.0  # of the component along the board's normal (z)
    tensor: float = 0.0  # of every component of a symmetric tensor, in an orthonormal basis


UPRIGHT = Response('upright', 1.0, 0.0)
"""Metal that answers in every direction, and more along the normal of the board."""
ORIENTED = Response('oriented', 0.0, 0.25)
"""Metal whose answer depends moderately on the direction of the field."""
BODY = Response('', 0.0, 0.5)
"""Dense pieces of metal that drive each other and answer in any direction."""


@dataclass(frozen=True)
class CloudPrior:
    """Holds one hypothesis about the change of the readings."""

    name: str
    cloud: Cloud
    layer: Layer
    response: Response  # of its sources
    # (S K, M), covariance of each reading with each source's mean polarisability (a third of the
    # tensor's trace, A m^2 / T), normalised like ``covariance``
    coupling: Array
    # (S K, S K), of the readings, survey errors included, normalised to a mean variance of 1
    covariance: Array
    # (N K, S K), from weighted readings ``covariance^-1 y`` to moments of the layer, dipole by
    # dipole
    transfer: Array
    # (S K, D), readings, survey errors included, of draws from the normalised prior
    draw_readings: Array
    draw_moments: Array  # (N K, D), moments of the layer of the same draws
    scale: float  # what ``covariance`` was divided by


class _Sources:
    """A cloud with its excitation and response, with the products that covariances share."""

    def __init__(self, cloud: Cloud, excitation: Array, response: Response) -> None:
        self.volumes, self.excitation, self.response = cloud.volumes, excitation, response
        self.width = excitation.shape[1]
        # (M, K, K): scalar products of the emitters' fields at each source.
        self.likeness = np.einsum('mka,mla->mkl', excitation, excitation)

    def along(self, basis: Array) -> Array:
        """Return the readings (R, K, M) of unit isotropic sources, from a basis (R, M, 3)."""
        return np.asarray(np.einsum('rma,mka->rkm', basis, self.excitation, optimize=True))

    def upright(self, basis: Array) -> Array:
        """Return the readings (R, K, M) of unit sources that answer along z only."""
        return np.asarray(np.einsum('rm,mk->rkm', basis[:, :, 2], self.excitation[:, :, 2]))

    def covariance(self, first: Array, second: Array) -> Array:
        """Return the covariance (R1, K, R2, K) of the readings of two sets of rows (R, M, 3)."""
        mine, theirs = self.along(first), self.along(second)
        product = self._product(mine, theirs)
        out = product.copy()
        if self.response.upright > 0.0:
            out += self.response.upright * self._product(self.upright(first), self.upright(second))
        if self.response.tensor > 0.0:
            # Sum over an orthonormal basis E of symmetric tensors of (u^T E b) (v^T E c):
            # half of (u.v)(b.c) + (u.c)(v.b).
            flat = second.reshape(len(second), -1).T
            for k in range(self.width):
                for j in range(k, self.width):
                    weight = np.repeat(self.volumes * self.likeness[:, k, j], 3)
                    block = (first.reshape(len(first), -1) * weight) @ flat
                    out[:, k, :, j] += 0.5 * self.response.tensor * block
                    if j != k:
                        out[:, j, :, k] += 0.5 * self.response.tensor * block
            out += 0.5 * self.response.tensor * product.swapaxes(1, 3)
        return out

    def _product(self, first: Array, second: Array) -> Array:
        rows = (first * self.volumes).reshape(-1, len(self.volumes))
        product = rows @ second.reshape(-1, len(self.volumes)).T
        return np.asarray(product.reshape(*first.shape[:2], *second.shape[:2]))

    def blocks(self, basis: Array) -> Array:
        """Return the covariance (R, K, K) of the readings of each row among themselves."""
        rows = self.along(basis)
        alike = (rows * self.volumes) @ rows.swapaxes(1, 2)
        out = (1.0 + 0.5 * self.response.tensor) * alike
        if self.response.upright > 0.0:
            rows = self.upright(basis)
            out += self.response.upright * ((rows * self.volumes) @ rows.swapaxes(1, 2))
        if self.response.tensor > 0.0:
            size = (basis**2).sum(axis=2) * self.volumes
            flat = size @ self.likeness.reshape(len(self.volumes), -1)
            out += 0.5 * self.response.tensor * flat.reshape(out.shape)
        return np.asarray(out)

    def coupling(self, basis: Array) -> Array:
        """Return the covariance (R K, M) of readings with a third of each source's trace."""
        out = (1.0 + self.response.tensor / 3.0) * self.along(basis)
        if self.response.upright > 0.0:
            out += self.response.upright / 3.0 * self.upright(basis)
        return np.asarray((out * self.volumes).reshape(-1, len(self.volumes)))

    def draws(self, rng: np.random.Generator, count: int) -> Array:
        """Return random polarisability tensors, (M, 3, 3, D)."""
        m, response = len(self.volumes), self.response
        out = np.zeros((m, 3, 3, count))
        isotropic = rng.standard_normal((m, count))
        for axis in range(3):
            out[:, axis, axis] = isotropic
        out[:, 2, 2] += np.sqrt(response.upright) * rng.standard_normal((m, count))
        if response.tensor > 0.0:
            free = np.sqrt(response.tensor) * rng.standard_normal((m, 3, 3, count))
            out += 0.5 * (free + free.swapaxes(1, 2))
        return np.asarray(out * np.sqrt(self.volumes)[:, None, None, None])


def frequency_tilt(frequencies_hz: Array) -> Array:
    """Return `FREQUENCY_SLOPE` times log(f_k / f_mean), (K,)."""
    logs = np.log(frequencies_hz)
    return np.asarray(FREQUENCY_SLOPE * (logs - logs.mean()))


def build_prior(
    cloud: Cloud, response: Response, layer: Layer, references: SensorTable, excitation: Array,
    frequencies_hz: Array, accuracy: Accuracy, rng: np.random.Generator,
) -> CloudPrior:  # fmt: skip
    """Compute a hypothesis for a set of references.

    ``excitation`` (M, K, 3) is the field of the emitters at the sources, T; ``accuracy`` that of
    the references' survey; ``rng`` is for the draws.
    """
    n_refs, k = len(references), excitation.shape[1]
    sources = _Sources(cloud, excitation, response)
    tilt = frequency_tilt(frequencies_hz)
    alike = 1.0 + np.outer(tilt, tilt)
    basis = vector_basis(references.position, references.axis, references.length, cloud.positions)
    covariance = sources.covariance(basis, basis) * alike[:, None, :]
    blocks = np.zeros((n_refs, k, k))
    for variant in survey_variants(references, cloud.positions, accuracy):
        blocks += sources.blocks(variant)
    blocks *= alike
    for s in range(n_refs):
        covariance[s, :, s] += blocks[s]
    covariance = covariance.reshape(n_refs * k, -1)
    scale = float(np.trace(covariance)) / len(covariance)
    projected = layer.project(cloud.positions).reshape(len(layer.positions), -1, 3)
    transfer = sources.covariance(projected, basis) * (alike[:, None, :] / scale)
    readings, moments = _draws(sources, basis, projected, tilt, rng)
    errors = rng.standard_normal((n_refs, k, N_SAMPLES))
    factors = np.linalg.cholesky(blocks + np.eye(k) * 1e-12 * scale)
    readings = readings + (factors @ errors).reshape(n_refs * k, N_SAMPLES)
    name = f'{cloud.name}, {response.name}' if response.name else cloud.name
    coupling, transfer = sources.coupling(basis) / scale, transfer.reshape(-1, n_refs * k)
    drawn = readings / np.sqrt(scale), moments / np.sqrt(scale)
    return CloudPrior(
        name, cloud, layer, response, coupling, covariance / scale, transfer, *drawn, scale
    )


def _draws(
    sources: _Sources, basis: Array, projected: Array, tilt: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return readings (S K, D) and moments of the layer (N K, D) of draws from the prior."""
    plain, tilted = (sources.draws(rng, N_SAMPLES) for _ in range(2))
    readings = np.empty((len(basis), sources.width, N_SAMPLES))
    moments = np.empty((len(projected), sources.width, N_SAMPLES))
    for k in range(sources.width):
        tensors = plain + tilt[k] * tilted
        induced = np.einsum('mabd,mb->mad', tensors, sources.excitation[:, k], optimize=True)
        induced = induced.reshape(-1, N_SAMPLES)
        readings[:, k] = basis.reshape(len(basis), -1) @ induced
        moments[:, k] = projected.reshape(len(projected), -1) @ induced
    return readings.reshape(-1, N_SAMPLES), moments.reshape(-1, N_SAMPLES)


DIRECTIONS = 64
"""Directions that are kept. What more would add, poses feel a thousandth of."""
OVERSAMPLED = 12
"""Further directions that are searched in, without which the last ones kept are poor."""
AT_ONCE = 400
"""Sources worked out at once: their columns are some tens of megabytes."""


@dataclass(frozen=True)
class ReducedPrior:
    """Holds the coordinates of a hypothesis."""

    # (N, K D), single precision, moments of the layer by unit coordinates; metal of strength a has
    # coordinates of variance a, independent of each other
    basis: Single
    cross: Array  # (D, S K), covariance of the coordinates with all readings of the references
    felt: Array  # (D,), what poses feel of unit coordinates (`Layer.metric`); no two feel alike


def reduced(
    prior: CloudPrior, excitation: Array, frequencies_hz: Array, rng: np.random.Generator
) -> ReducedPrior:
    """Return the coordinates of a hypothesis.

    ``excitation`` (M, K, 3): field of the emitters at its sources, T. ``rng``: for the search of
    the directions.
    """
    layer, k = prior.layer, excitation.shape[1]
    n = len(layer.positions)

    def felt(moments: Array) -> Array:
        """What poses feel of moments (N K, R)."""
        return np.asarray((layer.metric @ moments.reshape(n, -1)).reshape(moments.shape))

    wanted = DIRECTIONS + OVERSAMPLED
    sketch = np.zeros((n * k, wanted))
    for part in _columns(prior, excitation, frequencies_hz):
        sketch += part @ rng.standard_normal((part.shape[1], wanted)).astype(np.float32)
    frame, _ = np.linalg.qr(felt(sketch))
    # Transposed metric: rows of the layer, emitter by emitter.
    seen = (layer.metric.T @ frame.reshape(n, -1)).reshape(n * k, -1)
    moments = np.zeros((n * k, frame.shape[1]))
    small = seen.astype(np.float32)
    for part in _columns(prior, excitation, frequencies_hz):
        moments += part @ (part.T @ small)
    values, vectors = np.linalg.eigh(frame.T @ felt(moments))
    values, vectors = values[::-1][:DIRECTIONS], vectors[:, ::-1][:, :DIRECTIONS]
    keep = values > 1e-12 * values[0]
    root, vectors = np.sqrt(values[keep]), vectors[:, keep]
    scale = np.sqrt(prior.scale)
    basis = (moments @ vectors / (root * scale)).reshape(n, -1).astype(np.float32)
    # From moments of the layer to coordinates.
    analysis = (seen @ vectors / root).T * scale
    return ReducedPrior(basis, np.asarray(analysis @ prior.transfer), root / scale)


def _columns(prior: CloudPrior, excitation: Array, frequencies_hz: Array) -> Iterator[Single]:
    """Yield the layer's moments (N K, C) by each free number of the sources' polarisabilities."""
    cloud, layer, response = prior.cloud, prior.layer, prior.response
    tilt = frequency_tilt(frequencies_hz)
    projected = layer.project(cloud.positions).reshape(len(layer.positions), -1, 3)
    for start in range(0, len(cloud.positions), AT_ONCE):
        at = slice(start, start + AT_ONCE)
        p = projected[:, at].astype(np.float32)
        b = (excitation[at] * np.sqrt(cloud.volumes[at])[:, None, None]).astype(np.float32)
        parts = [np.einsum('nma,mka->nkm', p, b, optimize=True)]
        if response.upright > 0.0:
            up = p[:, None, :, 2] * b[None, :, :, 2].swapaxes(1, 2)
            parts.append(np.sqrt(response.upright) * up)
        if response.tensor > 0.0:
            for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)):
                one = p[:, None, :, i] * b[None, :, :, j].swapaxes(1, 2)
                if i != j:
                    one = one + p[:, None, :, j] * b[None, :, :, i].swapaxes(1, 2)
                    one *= np.sqrt(0.5)
                parts.append(np.sqrt(response.tensor) * one)
        for part in parts:
            yield part.reshape(-1, part.shape[2])
            tilted = part * tilt[:, None].astype(np.float32)
            yield tilted.reshape(-1, part.shape[2])
