"""What one cloud predicts: covariance of the references' readings, and the way back to the field.

With the excitation B_k(r_j) of emitter k at source j and the coupling G_s(r_j) of coil s, a source
of polarisability p_j changes the reading by ``p_j G_s(r_j) . B_k(r_j)``: the same p_j for all
emitters. Independent p_j of variance ``a v_j`` (v_j the source's volume) make the readings
Gaussian with the covariance ``a C``. All that depends on the geometry is computed here, once.

Polarisabilities vary a little with the drive frequency: each source gets a second, independent
part proportional to log(f_k / f_mean), of `FREQUENCY_SLOPE` times the first one's deviation.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.fitting.refit_clouds import Cloud
from anser_ros.fitting.refit_layer import Layer
from anser_ros.fitting.refit_references import SurveyError, survey_variants, vector_basis
from anser_ros.physics.sensor import SensorTable

Array = NDArray[np.float64]

FREQUENCY_SLOPE = 0.5
"""Deviation of d(ln p)/d(ln f); a sphere's parts have slopes between -1/2 and 1."""
N_SAMPLES = 48
"""Draws from the prior, from which the posterior's uncertainty is made."""


@dataclass(frozen=True)
class CloudPrior:
    """One cloud's hypothesis about the readings.

    Attributes
    ----------
    cloud : Cloud
    layer : Layer
    coupling : ndarray, shape (S K, M)
        Reading per unit of polarisability (A m^2 / T), weighted by the root of the volume.
    tilt : ndarray, shape (K,)
        `FREQUENCY_SLOPE` times log(f_k / f_mean).
    covariance : ndarray, shape (S K, S K)
        Of the readings, survey errors included, normalised to a mean variance of 1.
    scale : float
        What it was divided by.
    transfer : ndarray, shape (N K, S K)
        From weighted readings ``covariance^-1 y`` to moments of the layer, dipole by dipole.
    draw_readings : ndarray, shape (S K, D)
        Readings, survey errors included, of draws from the normalised prior.
    draw_moments : ndarray, shape (N K, D)
        Moments of the layer of the same draws.
    """

    cloud: Cloud
    layer: Layer
    coupling: Array
    tilt: Array
    covariance: Array
    scale: float
    transfer: Array
    draw_readings: Array
    draw_moments: Array


def _coupled(basis: Array, excitation: Array, root_volume: Array) -> Array:
    """Readings (S, K, M) of unit-variance sources: basis (S, M, 3), excitation (M, K, 3)."""
    return np.asarray(np.einsum('sma,mka->skm', basis, excitation, optimize=True) * root_volume)


def _frequency_tilt(frequencies_hz: Array) -> Array:
    logs = np.log(frequencies_hz)
    return np.asarray(FREQUENCY_SLOPE * (logs - logs.mean()))


def _survey_factors(
    references: SensorTable,
    cloud: Cloud,
    excitation: Array,
    root_volume: Array,
    survey: SurveyError,
    alike: Array,
) -> Array:
    """Covariance of the survey's errors, coil by coil, shape (S, K, K)."""
    total = np.zeros((len(references), *alike.shape))
    for variant in survey_variants(references, cloud.positions, survey):
        rows = _coupled(variant, excitation, root_volume)
        total += rows @ rows.swapaxes(1, 2)
    return total * alike


def build_prior(
    cloud: Cloud,
    layer: Layer,
    references: SensorTable,
    excitation: Array,
    frequencies_hz: Array,
    survey: SurveyError,
    rng: np.random.Generator,
) -> CloudPrior:
    """Compute a cloud's prior for a set of references.

    Parameters
    ----------
    cloud : Cloud
    layer : Layer
    references : SensorTable
        Places and axes in fg.
    excitation : ndarray, shape (M, K, 3)
        Field of the emitters at the sources, T.
    frequencies_hz : ndarray, shape (K,)
    survey : SurveyError
    rng : numpy Generator
        For the draws.
    """
    n_refs, k = len(references), excitation.shape[1]
    root = np.sqrt(cloud.volumes)
    tilt = _frequency_tilt(frequencies_hz)
    alike = 1.0 + np.outer(tilt, tilt)
    basis = vector_basis(references.position, references.axis, references.length, cloud.positions)
    coupling = _coupled(basis, excitation, root).reshape(n_refs * k, -1)
    covariance = (coupling @ coupling.T) * np.tile(alike, (n_refs, n_refs))
    blocks = _survey_factors(references, cloud, excitation, root, survey, alike)
    for s in range(n_refs):
        covariance[s * k : (s + 1) * k, s * k : (s + 1) * k] += blocks[s]
    scale = float(np.trace(covariance)) / len(covariance)
    projected = layer.project(cloud.positions).reshape(len(layer.positions), -1, 3)
    transfer = np.empty((len(projected), k, n_refs, k))
    draws = rng.standard_normal((2, len(root), N_SAMPLES)) / np.sqrt(scale)
    draw_moments = np.empty((len(projected), k, N_SAMPLES))
    for emitter in range(k):
        induced = np.einsum('nma,ma->nm', projected, excitation[:, emitter], optimize=True) * root
        rows = (induced @ coupling.T).reshape(len(projected), n_refs, k)
        transfer[:, emitter] = rows * (alike[emitter] / scale)
        draw_moments[:, emitter] = induced @ (draws[0] + tilt[emitter] * draws[1])
    readings = (coupling @ draws[0]) + (coupling @ draws[1]) * np.tile(tilt, n_refs)[:, None]
    survey_draws = rng.standard_normal((n_refs, k, N_SAMPLES)) / np.sqrt(scale)
    factors = np.linalg.cholesky(blocks + np.eye(k) * 1e-12 * scale)
    readings += (factors @ survey_draws).reshape(n_refs * k, N_SAMPLES)
    return CloudPrior(
        cloud,
        layer,
        coupling,
        tilt,
        covariance / scale,
        scale,
        transfer.reshape(-1, n_refs * k),
        readings,
        draw_moments.reshape(-1, N_SAMPLES),
    )
