"""Compares the refit's error by number of references with simpler methods.

All methods have the same references and start from the same calibrated model: the frozen model,
free dipoles for every emitter (`FreeDipoles`), and the shared polarisability. Free dipoles are a
refit without the physics of metal: clouds, noise, evidence for standoff and strength, and the
layer that carries the result are those of the refit. No gate withholds a pose here, so that wrong
poses count as such.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, ScalarFormatter

from anser_ros.cli.page import legend_beside, save, spell_out
from anser_ros.field.model import FieldModel
from anser_ros.physics.sensor import SensorTable
from anser_ros.refit.clouds import FieldFunction, default_clouds, excitation_for
from anser_ros.refit.layer import bottom_layer
from anser_ros.refit.live_refit import LiveRefit
from anser_ros.refit.posterior import STRENGTHS
from anser_ros.refit.prior import survey_variants, vector_basis
from anser_ros.sessions.baseline import baseline_flux
from anser_ros.sessions.nominal_board import NominalBoard
from anser_ros.sessions.session import Session
from anser_ros.settings import Accuracy
from anser_ros.stamps import NANO
from anser_ros.tracking.solve import RealField, solve_coil, whitening_of


class FreeDipoles:
    """Follows a change with independent dipoles for every emitter, with only places in common.

    ``baseline`` (S, K) complex. ``drawing``: only says where the board is.
    """

    def __init__(
        self, model: FieldModel, table: SensorTable, baseline: Any, drawing: FieldFunction | None
    ) -> None:
        accuracy = Accuracy()
        excitation, region = excitation_for(model, drawing)
        self.model, self.baseline, self._noise = model, baseline, accuracy.flux_noise_t
        self._layer = bottom_layer(region, excitation)
        self._clouds = []
        for cloud in default_clouds(region):
            if cloud.overhead:
                continue
            root = np.repeat(np.sqrt(cloud.volumes), 3)
            basis = vector_basis(table.position, table.axis, table.length, cloud.positions)
            rows = basis.reshape(len(table), -1) * root
            covariance = rows @ rows.T
            for variant in survey_variants(table, cloud.positions, accuracy):
                wrong = variant.reshape(len(table), -1) * root
                covariance[np.diag_indices_from(covariance)] += (wrong**2).sum(axis=1)
            scale = np.trace(covariance) / len(covariance)
            spectrum, vectors = np.linalg.eigh(covariance / scale)
            transfer = (self._layer.project(cloud.positions) * root) @ rows.T
            self._clouds.append((np.maximum(spectrum, 0.0), vectors, transfer @ vectors / scale))

    def update(self, flux: Any) -> FieldModel:
        """Return the model for one frame of all references, shape (S, K), T."""
        change = (flux - self.baseline) / self._noise
        values = np.concatenate([change.real, change.imag], axis=1)
        best, kept = -np.inf, np.zeros((len(self._layer.positions), values.shape[1]))
        for spectrum, vectors, transfer in self._clouds:
            projected = vectors.T @ values
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
        moments = self._noise * (kept[:, :k] + 1j * kept[:, k:])
        return self.model.with_dipoles(layer.positions, layer.directions, moments)


REACH_M = 0.15
"""Largest distance of a solution from the optical position, m, however wrong the model."""
COUNTS = (4, 8, 16, 32)
"""Numbers of reference coils that are compared; the demo's board has 32."""
FROZEN, FREE, SHARED = 'frozen model', 'free dipoles', 'shared polarisability'


class AblationRow(NamedTuple):
    """The error of one method with one number of references on one session."""

    session: str
    method: str
    references: int
    rmse_m: float  # of all tool coils tracked singly, against the optical pose


def spread_out(references: SensorTable, count: int) -> Any:
    """Return the rows of some references, each as far as possible from those before it.

    Coils at the place of another one come last, in the order of how different their axes are.
    """
    chosen = [0]
    while len(chosen) < min(count, len(references)):
        gap = references.position[:, None] - references.position[None, chosen]
        distance = np.linalg.norm(gap, axis=2).min(axis=1)
        across = 1.0 - np.abs(references.axis @ references.axis[chosen].T).max(axis=1)
        score = distance + 1e-3 * across
        score[chosen] = -1.0
        chosen.append(int(score.argmax()))
    return np.sort(np.array(chosen, dtype=np.int64))


def ablate(
    session: Session, name: str, model: FieldModel, baseline: Session,
    counts: Sequence[int] = COUNTS, every: int = 7,
) -> list[AblationRow]:  # fmt: skip
    """Track a session by every method with every number of references.

    ``every``: only so many frames are tracked; best no common divisor of the rates, or all of them
    meet an optical pose whose jitter no interpolation has smoothed.
    """
    reference, drawing = session.reference, NominalBoard.of(session.setup).field
    clean = baseline_flux(baseline, reference.sensors)
    stamps = session.start_ns + np.round(reference.time[::every] / NANO).astype(np.int64)
    rows = [AblationRow(name, FROZEN, 0, rmse_m(session, [model], every))]
    for count in counts:
        if count > len(reference.sensors):
            continue
        chosen = spread_out(reference.sensors, count)
        given = model, reference.sensors.select(chosen), clean[chosen]
        flux = reference.flux[::every, chosen]
        free, refit = FreeDipoles(*given, drawing), LiveRefit(*given, drawing=drawing)
        followed = {
            FREE: [free.update(frame) for frame in flux],
            SHARED: [
                refit.update(stamp, given[1].channel, frame).model
                for stamp, frame in zip(stamps.tolist(), flux, strict=True)
            ],
        }
        for method, models in followed.items():
            rows.append(AblationRow(name, method, count, rmse_m(session, models, every)))
    return rows


def rmse_m(session: Session, models: Sequence[FieldModel], every: int) -> float:
    """Position RMSE of the first tool's coils, by one model or one a frame.

    The solve starts at the optical pose, since the models are compared and not the search.
    """
    tool = session.tools[0]
    centres, axes = tool.placed()
    whitening = whitening_of(np.full(2 * tool.flux.shape[2], Accuracy.flux_noise_t))
    errors = []
    for step, frame in enumerate(range(0, len(tool.time), every)):
        if not tool.has_pose[frame]:
            continue
        model = models[min(step, len(models) - 1)]
        field = RealField.of(model.positions, model.directions, model.moments)
        values = np.ascontiguousarray(tool.flux[frame]).view(np.float64)
        for coil in np.flatnonzero(tool.valid[frame]):
            start, axis = centres[frame, coil], axes[frame, coil]
            solution = solve_coil(
                field, values[coil], whitening, start, axis, start - REACH_M, start + REACH_M,
                float(tool.sensors.length[coil]),
            )  # fmt: skip
            errors.append(float(np.linalg.norm(solution.position - start)))
    return float(np.sqrt(np.mean(np.square(errors))))


def plot(rows: Sequence[AblationRow], path: Path, titles: dict[str, str]) -> None:
    """Draw the error over the number of references with a panel for each session of the titles."""
    sessions = list(dict.fromkeys(row.session for row in rows))
    figure = Figure(figsize=(4.2 * len(sessions), 3.9), layout='constrained')
    for panel, session in enumerate(sessions):
        axes = figure.add_subplot(1, len(sessions), panel + 1)
        here = [row for row in rows if row.session == session]
        for method, style in ((FREE, 'o--'), (SHARED, 's-')):
            points = [(row.references, 1e3 * row.rmse_m) for row in here if row.method == method]
            axes.plot(*zip(*points, strict=True), style, label=method)
        axes.axhline(1e3 * here[0].rmse_m, color='0.5', label=FROZEN)
        axes.set_xscale('log', base=2)
        axes.set_yscale('log')
        axes.set_xticks(sorted({row.references for row in here[1:]}))
        axes.xaxis.set_major_formatter(ScalarFormatter())
        axes.xaxis.set_minor_formatter(NullFormatter())
        spell_out(axes.yaxis)
        axes.set(title=titles[session], xlabel='reference coils', ylabel='position RMSE, mm')
        axes.grid(True, which='both', alpha=0.3)
    legend_beside(figure, below=1.0)
    save(figure, path)
