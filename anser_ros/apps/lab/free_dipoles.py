"""Fits free dipoles, a set for every emitter, for comparison with the shared polarisability.

This is a refit without the physics of metal: each emitter's change is fitted by separate sources,
which have only their possible places in common. Clouds, noise, evidence for standoff and strength,
and the layer that carries the result are those of the refit, so the two differ only in the shared
polarisability. It exists for the ablation.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.field.model import FieldModel
from anser_ros.physics.sensor import SensorTable
from anser_ros.refit.clouds import FieldFunction, default_clouds, excitation_for
from anser_ros.refit.layer import bottom_layer
from anser_ros.refit.posterior import STRENGTHS
from anser_ros.refit.prior import survey_variants, vector_basis
from anser_ros.settings import Accuracy

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


class FreeDipoles:
    """Follows a change with independent dipoles for every emitter.

    ``baseline`` (S, K) complex. ``drawing``: only says where the board is.
    """

    def __init__(
        self,
        model: FieldModel,
        references: SensorTable,
        baseline: ComplexArray,
        drawing: FieldFunction | None = None,
    ) -> None:
        accuracy = Accuracy()
        excitation, region = excitation_for(model, drawing)
        clouds = [cloud for cloud in default_clouds(region) if not cloud.overhead]
        self.model, self.baseline, self._noise = model, baseline, accuracy.flux_noise_t
        self._layer = bottom_layer(model, region, excitation, clouds[0].positions)
        self._spectra, self._bases, self._transfers = [], [], []
        for cloud in clouds:
            root = np.repeat(np.sqrt(cloud.volumes), 3)
            table = references
            basis = vector_basis(table.position, table.axis, table.length, cloud.positions)
            rows = basis.reshape(len(table), -1) * root
            covariance = rows @ rows.T
            for variant in survey_variants(table, cloud.positions, accuracy):
                wrong = variant.reshape(len(table), -1) * root
                covariance[np.diag_indices_from(covariance)] += (wrong**2).sum(axis=1)
            scale = np.trace(covariance) / len(covariance)
            values, vectors = np.linalg.eigh(covariance / scale)
            self._spectra.append(np.maximum(values, 0.0))
            self._bases.append(vectors)
            transfer = (self._layer.project(cloud.positions) * root) @ rows.T
            self._transfers.append(transfer @ vectors / scale)

    def update(self, flux: ComplexArray) -> FieldModel:
        """Return the model for one frame of all references, shape (S, K), T."""
        change = (flux - self.baseline) / self._noise
        values = np.concatenate([change.real, change.imag], axis=1)
        best, kept = -np.inf, np.zeros((len(self._layer.positions), values.shape[1]))
        for spectrum, basis, transfer in zip(
            self._spectra, self._bases, self._transfers, strict=True
        ):
            projected = basis.T @ values
            variance = STRENGTHS[:, None] * spectrum + 1.0
            curve = -0.5 * (
                (1.0 / variance) @ projected**2 + np.log(variance).sum(axis=1)[:, None]
            )
            top = curve.max(axis=0)
            weight = np.exp(curve - top)
            total = weight.sum(axis=0)
            evidence = float((top + np.log(total / len(STRENGTHS))).sum())
            if evidence > best:
                shrink = (STRENGTHS[:, None] / variance).T @ (weight / total)
                best, kept = evidence, transfer @ (shrink * projected)
        k, layer = flux.shape[1], self._layer
        moments = (self._noise * (kept[:, :k] + 1j * kept[:, k:])).astype(np.complex128)
        rows = np.empty(0, dtype=np.int64) if layer.rows is None else layer.rows
        base = self.model.moments.copy()
        base[rows] += moments[: rows.size]
        model = replace(self.model, moments=base)
        return model.with_dipoles(
            layer.positions[rows.size :], layer.directions[rows.size :], moments[rows.size :]
        )
