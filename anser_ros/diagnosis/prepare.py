"""Makes a problem of measurements: the emitters' field, bins of references, blocks of time."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.problem import Problem, References, Spread
from anser_ros.effects.correction import Fields
from anser_ros.effects.view import Apparatus
from anser_ros.errors import DiagnosisError
from anser_ros.field.dipoles import Dipoles
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import FieldModel
from anser_ros.physics.dipole import field_basis, flux_basis

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

VOLUME_ERROR = 1e-3
"""Relative error that the fit allows the model in the volume, a quarter of a reference's."""
LEAST_ERROR = 1e-5
"""Relative error that references have at least, so that exact ones do not divide by zero."""
DRAWING_ERROR = 0.05
"""Prior spread of the sheet's moments about the drawn ones, as a share of their rms: a coil's
moment is off by 2 % (`nominal.Tolerances`), and half a millimetre moves a few percent of it."""


def board_box(model: FieldModel) -> Array:
    """Return the two corners of the model's dipoles that carry the field, shape (2, 3), m."""
    strength = np.abs(model.moments).max(axis=1)
    used = model.positions[strength > 1e-3 * strength.max()]
    return np.stack([used.min(axis=0), used.max(axis=0)])


def fit_illumination(
    model: FieldModel,
    drawn: FieldModel | None,
    points: Array,
    references: References | None,
    gain_error: float,
) -> Dipoles:
    """Return a sheet of dipoles that is good in the volume, at the references and below the board.

    ``model``: trusted at ``points`` (P, 3), m, in the volume; ``drawn``: the nominal model of the
    setup's geometry, without which the model itself is all that there is; ``gain_error``: relative
    error of the references' gains.
    """
    if drawn is None:
        return Dipoles(model.positions, model.directions, model.moments)
    place, direction = drawn.positions, drawn.directions
    basis = field_basis(points, place, direction).transpose(0, 2, 1).reshape(-1, len(place))
    wanted = Dipoles(model.positions, model.directions, model.moments).field(points)
    wanted = wanted.reshape(-1, wanted.shape[2])
    # Complex gain of each emitter that brings the drawn field nearest to the wanted one.
    near = basis @ drawn.moments
    power = np.sum(np.abs(near) ** 2, axis=0)
    gain = np.sum(near.conj() * wanted, axis=0) / np.where(power > 0, power, 1.0)
    start = drawn.moments * gain
    scale = VOLUME_ERROR * np.sqrt(np.mean(np.abs(wanted) ** 2))
    rows, values = [basis / scale], [(wanted - basis @ start) / scale]
    if references is not None:
        s, clean = references.readings.sensors, references.baseline
        sheet = flux_basis(s.position, s.axis, s.length, place, direction)
        weight = max(gain_error, LEAST_ERROR) * np.sqrt(np.mean(np.abs(clean) ** 2))
        rows.append(sheet / weight)
        values.append((clean - sheet @ start) / weight)
    spread = DRAWING_ERROR * np.sqrt(np.mean(np.abs(start) ** 2))
    matrix, target = np.concatenate(rows) * spread, np.concatenate(values)
    normal = matrix.T @ matrix + np.eye(len(place))
    change = np.linalg.solve(normal, matrix.T @ target) * spread
    return Dipoles(place, direction, start + change)


BLOCKS = 25
"""Blocks of time in a session: longer than what is alike from frame to frame, and enough of them
to hold some out and still have every pose in the rest."""
TEST_EVERY = 5
"""One block of five never takes part in choosing or fitting."""
BINS_PER_BLOCK = 2
"""Means of the references in each block of time: they don't move, so more add nothing."""
FEWEST_POSED_FRAMES = 30
"""Frames with an optical pose that a diagnosis needs, about one in each block."""
POINTS = 250
"""Places in the volume, about, at which the emitters' own field is fitted to the model."""
MARGIN_S = 0.15
"""Time (s) by which fluxes may lie outside the optical track: a time offset may bring them in."""


def test_blocks() -> NDArray[np.int64]:
    """Return the numbers of the blocks that are held out to the end."""
    return np.arange(TEST_EVERY // 2, BLOCKS, TEST_EVERY)


def train_blocks() -> NDArray[np.int64]:
    """Return the numbers of the blocks that effects are chosen and fitted on."""
    return np.setdiff1d(np.arange(BLOCKS), test_blocks())


def build_problem(
    tools: Sequence[Measurements],
    reference: Measurements | None,
    baseline: ComplexArray | None,
    model: FieldModel,
    drawn: FieldModel | None,
    spread: Spread,
) -> Problem:
    """Set up the diagnosis of a session.

    ``tools``: bodies without an optical pose are left out; ``baseline`` (R, K): clean readings of
    the reference sensors (NaN where there are none); without them the references say nothing;
    ``drawn``: the nominal model of the setup, if its kind of emitter has one.

    Raises `DiagnosisError` when a sensor is a sum of windings, fewer than 30 frames have fluxes
    and a pose, or all poses are the same.
    """
    for tool in tools:
        if not tool.sensors.is_single.all():
            name = tool.sensors.name[int(np.argmin(tool.sensors.is_single))]
            raise DiagnosisError(f'{name} has windings: a diagnosis takes single coils only')
    posed = tuple(t for t in (_with_pose(tool) for tool in tools) if t.time.size)
    count = sum(tool.time.size for tool in posed)
    if count < FEWEST_POSED_FRAMES:
        raise DiagnosisError(
            f'a diagnosis needs at least {FEWEST_POSED_FRAMES} frames with an optical pose, '
            f'got {count}'
        )
    if not any(
        np.ptp(t.position, axis=0).any() or np.ptp(t.rotation, axis=0).any() for t in posed
    ):
        raise DiagnosisError(
            f'all {count} optical poses are the same: a diagnosis needs a tool that moves'
        )
    start, end = min(tool.time[0] for tool in posed), max(tool.time[-1] for tool in posed)
    edges = np.linspace(start, end + 1e-9, BLOCKS + 1)
    references, reference_blocks = None, np.zeros(0, dtype=np.int64)
    if reference is not None and baseline is not None:
        references = _binned(reference, baseline, edges)
    if references is not None:
        reference_blocks = _numbers(references.readings.time, edges)
    centres = np.concatenate([tool.placed()[0].reshape(-1, 3) for tool in posed])
    some = centres[:: max(1, centres.shape[0] // POINTS)]
    gain_error = spread.accuracy.reference_gain
    illumination = fit_illumination(model, drawn, some, references, gain_error)
    omega = 2 * np.pi * np.asarray(model.frequencies_hz)
    fields = Fields(Dipoles(model.positions, model.directions, model.moments), illumination, omega)
    apparatus = Apparatus(
        tools=tuple(tool.sensors for tool in posed),
        references=None if references is None else references.readings.sensors,
        emitters=omega.size,
        omega=omega,
        duration=float(end - start),
        illumination=illumination,
        visited_box=np.stack([centres.min(axis=0), centres.max(axis=0)]),
        board=board_box(drawn or model),
    )
    return Problem(
        tools=posed,
        blocks=tuple(_numbers(tool.time, edges) for tool in posed),
        references=references,
        reference_blocks=reference_blocks,
        fields=fields,
        apparatus=apparatus,
        spread=spread,
        good=tuple(tool.valid.copy() for tool in posed),
        gaps_t=tuple(_gaps_t(tool, model) for tool in posed),
    )


def _gaps_t(tool: Measurements, model: FieldModel) -> Array:
    if model.gaps is None:
        return np.zeros(tool.valid.shape)
    return model.gaps.sigma_t(*tool.placed(), tool.sensors.length)


def _numbers(time: Array, edges: Array) -> NDArray[np.int64]:
    return np.clip(np.searchsorted(edges, time, side='right') - 1, 0, BLOCKS - 1)


def _with_pose(tool: Measurements) -> Measurements:
    keep = tool.has_pose & tool.valid.any(axis=1)
    if tool.track is not None and tool.track.time.size > 1:
        track = tool.track
        keep &= (tool.time >= track.time[0] - MARGIN_S) & (tool.time <= track.time[-1] + MARGIN_S)
    return tool.frames(np.flatnonzero(keep))


def _binned(reference: Measurements, baseline: ComplexArray, edges: Array) -> References | None:
    """Means over equal bins of time, two a block."""
    known = np.isfinite(baseline).all(axis=1) & reference.valid.any(axis=0)
    if not known.any():
        return None
    readings = reference.sensors_only(np.flatnonzero(known))
    fine = np.interp(
        np.linspace(0, BLOCKS, BINS_PER_BLOCK * BLOCKS + 1), np.arange(BLOCKS + 1), edges
    )
    inside = (readings.time >= fine[0]) & (readings.time < fine[-1])
    readings = readings.frames(np.flatnonzero(inside))
    number = np.searchsorted(fine, readings.time, side='right') - 1
    if number.size == 0:
        return None
    flux, count, time = [], [], []
    for bin_number in np.unique(number):
        rows = number == bin_number
        good = readings.valid[rows]
        n = good.sum(axis=0)
        total = np.where(good[..., None], readings.flux[rows], 0.0).sum(axis=0)
        flux.append(total / np.maximum(n, 1)[:, None])
        count.append(n)
        time.append(float(readings.time[rows].mean()))
    counts, n_bins = np.array(count), len(time)
    binned = Measurements(
        body=readings.body, sensors=readings.sensors, time=np.array(time), flux=np.array(flux),
        valid=counts > 0, flags=np.zeros(counts.shape, dtype=np.int64),
        position=np.zeros((n_bins, 3)), rotation=np.broadcast_to(np.eye(3), (n_bins, 3, 3)),
        has_pose=np.ones(n_bins, dtype=bool),
    )  # fmt: skip
    return References(binned, counts.astype(np.float64), baseline[known])
