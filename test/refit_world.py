"""A small exact world for the tests of the refit: a board, reference coils, metal, and frames."""

from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from tracking_world import NOISE_T, anser_board

from anser_ros.field.model import FieldModel
from anser_ros.field.nominal import nominal_model
from anser_ros.physics.board import Board, build_board
from anser_ros.physics.dipole import flux_basis
from anser_ros.physics.sensor import SensorTable
from anser_ros.refit import tables
from anser_ros.refit.layer import Layer
from anser_ros.refit.live_refit import LiveRefit
from anser_ros.refit.tables import RefitTables
from anser_ros.settings import RefitSettings


def reference_ring(count: int, half: float, seed: int = 3) -> SensorTable:
    """Coils around a board of that half width, at three heights, pointing anywhere."""
    rng = np.random.default_rng(seed)
    angle = 2.0 * np.pi * np.arange(count) / count
    height = half * (0.2 + 0.35 * (np.arange(count) % 3))
    position = np.stack([1.2 * half * np.cos(angle), 1.2 * half * np.sin(angle), height], axis=1)
    axis = rng.normal(size=(count, 3))
    return SensorTable(
        channel=np.arange(100, 100 + count), name=tuple(f'ref/{i}' for i in range(count)),
        body=('fg',) * count, position=position, axis=axis / np.linalg.norm(axis, axis=1)[:, None],
        length=np.full(count, 0.008),
    )  # fmt: skip


def metal_block(centre, size, count: int = 60, seed: int = 5):
    """Points of a block of metal, m."""
    rng = np.random.default_rng(seed)
    return np.asarray(centre) + rng.uniform(-0.5, 0.5, (count, 3)) * np.asarray(size)


@dataclass(frozen=True)
class World:
    """A board with references, and everything that is the same for all tests."""

    board: Board
    model: FieldModel
    references: SensorTable
    baseline: np.ndarray

    def metal(self, points, coils: SensorTable | None = None, polarisability=-600.0 + 80.0j):
        """Change (S, K) that uncoupled metal makes in the references, T."""
        table = coils or self.references
        return metal_flux(self.board, points, table.position, table.axis, polarisability)

    def noise(self, rng, scale: float = NOISE_T):
        """Noise of one frame."""
        shape = self.baseline.shape
        return scale * (rng.normal(size=shape) + 1j * rng.normal(size=shape))

    def refit(self, **settings) -> LiveRefit:
        """A refit that has the board's drawing."""
        return LiveRefit(
            self.model, self.references, self.baseline, RefitSettings(**settings),
            self.board.field,
        )  # fmt: skip


def metal_flux(board: Board, points, position, axis, polarisability=-600.0 + 80.0j):
    """Flux (S, K) of metal points of equal polarisability (A m^2 / T each, divided among them)."""
    driven = board.field(points) * (polarisability / len(points))
    out = np.zeros((len(position), driven.shape[1]), dtype=complex)
    for component, unit in enumerate(np.eye(3)):
        basis = flux_basis(position, axis, None, points, np.broadcast_to(unit, points.shape))
        out += basis @ driven[:, :, component]
    return out


def world_of(board: Board, count: int) -> World:
    """The board as drawn, with references around it."""
    model = nominal_model(board)
    model = FieldModel(
        model.positions, model.directions, model.moments, model.emitters, model.frequencies_hz
    )
    half = float(np.abs(np.concatenate(board.paths)[:, :2]).max())
    references = reference_ring(count, half)
    ends = [
        np.einsum(
            'pka,pa->pk',
            board.field(references.position + sign * 0.008 / np.sqrt(12.0) * references.axis),
            references.axis,
        )
        for sign in (-1.0, 1.0)
    ]
    return World(board, model, references, (0.5 * (ends[0] + ends[1])).astype(complex))


@cache
def anser_world(count: int = 16) -> World:
    """The Anser board with references around it."""
    return world_of(anser_board(), count)


@cache
def three_coil_world() -> World:
    """Three round coils, as other systems have."""
    centres = np.array([[-0.06, -0.04, 0.0], [0.06, -0.04, 0.0], [0.0, 0.07, 0.0]])
    board = build_board(
        'circular_loop', {'turns': 30, 'radius_m': 0.04, 'current_a': 0.5}, ['a', 'b', 'c'],
        centres, np.zeros(3), [1000.0, 1300.0, 1700.0],
    )  # fmt: skip
    return world_of(board, 24)


def volume_points(count: int = 60, seed: int = 11):
    """Places and axes of tool coils over the board."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-0.12, -0.12, 0.09], [0.12, 0.12, 0.2], (count, 3))
    axes = rng.normal(size=(count, 3))
    return points, axes / np.linalg.norm(axes, axis=1)[:, None]


TABLES: dict[tuple, RefitTables] = {}
PROJECTED: dict[tuple, np.ndarray] = {}
PLACES = np.array([[0.03, -0.02, 0.05], [-0.07, 0.04, -0.06], [0.01, 0.09, 0.2]])


@contextmanager
def tables_made_once():
    """Within it, refits of one board with the same references and settings share their tables.

    So do refits that only the references tell apart share what layers make of clouds. Both are
    functions of what they are kept by, and are worked out once for all tests of a process.
    """
    build, project = tables.build_tables, Layer.project

    def shared(model, references, settings, drawing, *rest, **told):
        arrays = model.positions, model.directions, model.moments, references.position
        arrays += references.axis, references.length, references.channel
        if drawing is not None:
            arrays += (drawing(PLACES),)
        words = references.name, model.frequencies_hz, settings, rest
        key = (*(array.tobytes() for array in arrays), repr(words))
        if key not in TABLES:
            TABLES[key] = build(model, references, settings, drawing, *rest, **told)
        return TABLES[key]

    def projected(layer, sources):
        if layer.inverse is None:
            return project(layer, sources)
        key = tuple(hash(a.tobytes()) for a in (layer.inverse, layer.points, sources))
        if key not in PROJECTED:
            PROJECTED[key] = project(layer, sources)
        return PROJECTED[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tables, 'build_tables', shared)
        patch.setattr(Layer, 'project', projected)
        yield


STEP_NS = 20_000_000
HEAD = metal_block([0.03, -0.02, -0.11], [0.1, 0.12, 0.06])


def run(refit, world, change, frames=3, seed=1, start=1, fault=None, flags=None):
    """Feed frames with noise; the last result."""
    rng, result = np.random.default_rng([seed, start]), None  # never the same noise again
    for frame in range(frames):
        flux = world.baseline + change + world.noise(rng)
        if fault is not None:
            fault(flux)
        stamp = (start + frame) * STEP_NS
        result = refit.update(stamp, world.references.channel, flux, flags)
    return result


def errors(world, model, points, polarisability=-600.0 + 80.0j):
    """Rms of the field's error before and after, and the predicted sigma, over the volume, T."""
    places, axes = volume_points()
    tools = replace_geometry(world.references, places, axes)
    truth = world.metal(points, tools, polarisability)
    made = model.flux(places, axes) - world.model.flux(places, axes)
    modes = np.zeros((0, 1)) if model.modes is None else model.modes
    spread = np.full(truth.shape, model.flux_error_t**2)
    for mode in modes:
        spread += np.abs(replace(model, moments=mode, modes=None).flux(places, axes)) ** 2 / 2.0
    return rms(truth), rms(truth - made), np.sqrt(spread), truth - made


def share_left(world, model, points):
    """What is left of the field's error over the volume."""
    before, after, _, _ = errors(world, model, points)
    return after / before


def replace_geometry(table, places, axes):
    """The references' table cut or repeated to other places."""
    rows = np.arange(len(places)) % len(table)
    return replace(table.select(rows), position=places, axis=axes, length=np.zeros(len(places)))


def rms(values):
    return float(np.sqrt(np.mean(np.abs(values) ** 2)))
