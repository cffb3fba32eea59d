"""Predicts by one hypothesis: the covariance of readings, and the map to the field.

With the excitation B_k(r_j) of emitter k at source j and the coupling G_s(r_j) of coil s, a source
of the polarisability tensor P_j changes the reading by ``G_s(r_j)^T P_j B_k(r_j)``: the same P_j
for all emitters. Independent P_j of variance ``a v_j`` (v_j the source's volume) make the readings
Gaussian with the covariance ``a C``. All that depends on the geometry is computed here, once.

Polarisabilities vary a little with the drive frequency: each source gets a second, independent
part proportional to log(f_k / f_mean), of `FREQUENCY_SLOPE` times the first one's deviation.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.metal.body import FREQUENCY_SLOPE
from anser_ros.physics.sensor import SensorTable
from anser_ros.refit.clouds import Cloud
from anser_ros.refit.layer import Layer
from anser_ros.refit.references import survey_variants, vector_basis
from anser_ros.settings import Accuracy

Array = NDArray[np.float64]

N_SAMPLES = 48
"""Draws from the prior, from which the posterior's uncertainty is made. Fewer make the uncertainty
itself uncertain, by a tenth with 48; more cost memory and the start of the refit in proportion."""


@dataclass(frozen=True)
class Response:
    """Holds the prior of a source's polarisability tensor, as variances of its independent parts.

    A compact piece responds equally in all directions. A flat piece responds only across its face,
    and pieces that touch drive each other: in recordings, metal below a board responds differently
    along the board's normal, and plates in yet other ways.

    Attributes
    ----------
    name : str
        Empty for the plain one.
    isotropic : float
        Of a multiple of the unit tensor.
    upright : float
        Of the component along the board's normal (z).
    tensor : float
        Of every component of a symmetric tensor, in an orthonormal basis.
    """

    name: str = ''
    isotropic: float = 1.0
    upright: float = 0.0
    tensor: float = 0.0


UPRIGHT = Response('upright', 1.0, 1.0, 0.0)
"""Metal that answers in every direction, and more along the normal of the board."""
ORIENTED = Response('oriented', 1.0, 0.0, 0.25)
"""Metal whose answer depends moderately on the direction of the field."""
BODY = Response('', 1.0, 0.0, 0.5)
"""Dense pieces of metal that drive each other and answer in any direction."""


@dataclass(frozen=True)
class CloudPrior:
    """Holds one hypothesis about the change of the readings.

    Attributes
    ----------
    name : str
    cloud : Cloud
    layer : Layer
    response : Response
        Of its sources.
    coupling : ndarray, shape (S K, M)
        Covariance of each reading with each source's mean polarisability (a third of the tensor's
        trace, A m^2 / T), normalised like ``covariance``.
    covariance : ndarray, shape (S K, S K)
        Of the readings, survey errors included, normalised to a mean variance of 1.
    transfer : ndarray, shape (N K, S K)
        From weighted readings ``covariance^-1 y`` to moments of the layer, dipole by dipole.
    draw_readings : ndarray, shape (S K, D)
        Readings, survey errors included, of draws from the normalised prior.
    draw_moments : ndarray, shape (N K, D)
        Moments of the layer of the same draws.
    scale : float
        What ``covariance`` was divided by.
    """

    name: str
    cloud: Cloud
    layer: Layer
    response: Response
    coupling: Array
    covariance: Array
    transfer: Array
    draw_readings: Array
    draw_moments: Array
    scale: float


class _Sources:
    """A cloud with its excitation and response, with the products that covariances share."""

    def __init__(self, cloud: Cloud, excitation: Array, response: Response) -> None:
        self.excitation = excitation
        self.volumes = cloud.volumes
        self.response = response
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
        out = self.response.isotropic * self._product(mine, theirs)
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
                for j in range(self.width):
                    block = (mine[:, j] * self.volumes) @ theirs[:, k].T
                    out[:, k, :, j] += 0.5 * self.response.tensor * block
        return out

    def _product(self, first: Array, second: Array) -> Array:
        rows = (first * self.volumes).reshape(-1, len(self.volumes))
        product = rows @ second.reshape(-1, len(self.volumes)).T
        return np.asarray(product.reshape(*first.shape[:2], *second.shape[:2]))

    def blocks(self, basis: Array) -> Array:
        """Return the covariance (R, K, K) of the readings of each row among themselves."""
        rows = self.along(basis)
        alike = (rows * self.volumes) @ rows.swapaxes(1, 2)
        out = (self.response.isotropic + 0.5 * self.response.tensor) * alike
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
        mean = self.response.isotropic + self.response.tensor / 3.0
        out = mean * self.along(basis)
        if self.response.upright > 0.0:
            out += self.response.upright / 3.0 * self.upright(basis)
        return np.asarray((out * self.volumes).reshape(-1, len(self.volumes)))

    def draws(self, rng: np.random.Generator, count: int) -> Array:
        """Return random polarisability tensors, (M, 3, 3, D)."""
        m, response = len(self.volumes), self.response
        out = np.zeros((m, 3, 3, count))
        isotropic = np.sqrt(response.isotropic) * rng.standard_normal((m, count))
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
    cloud: Cloud,
    response: Response,
    layer: Layer,
    references: SensorTable,
    excitation: Array,
    frequencies_hz: Array,
    accuracy: Accuracy,
    rng: np.random.Generator,
) -> CloudPrior:
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
