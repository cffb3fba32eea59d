"""A lump of coupled conducting spheres that moves about the drawn board, and what coils read.

The spheres and their answers are those of the benchmarks' field world (`bench/world`), which
shares no code with the lattices of `anser_ros.apps.lab`.
"""

import importlib
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from refit_world import reference_ring
from scipy.spatial.transform import Rotation
from tracking_world import NOISE_T, anser_board, certain_model, setup_of, triaxial_tool

from anser_ros.field.measurements import Measurements
from anser_ros.physics.sensor import SensorTable
from anser_ros.refit.clouds import Excitation, excitation_for
from anser_ros.refit.witness import ToolReading
from anser_ros.sessions.session import Session
from anser_ros.wire.bag_writer import SessionWriter
from anser_ros.wire.setup import Setup, dump_setup

WORLD = Path(__file__).parent / 'bench' / 'world'
RATE_HZ, START_NS = 12.5, 10**18
PHASE = np.exp(1j * np.linspace(-0.02, 0.02, 8))
"""Of the emitters' fields, as `certain_model` has it."""
TOOL = triaxial_tool()
HIDDEN = np.array([0.01, -0.01, 0.015])
"""How far from the lump's middle the refit sees it."""


def of_world(name: str):
    """A module of the field world; they import each other as a script's do."""
    sys.path.insert(0, str(WORLD))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(WORLD))


@cache
def lump(material: str = 'aluminium', radius_m: float = 0.05, seed: int = 4):
    """The places of an irregular lump's spheres, and their moments by the field (K, 3N, 3N)."""
    body = of_world('bodies').block(np.random.default_rng(seed), radius_m, material, count=30)
    omega = 2.0 * np.pi * np.array(certain_model().frequencies_hz)
    return body.place, of_world('spheres').response(body, omega)


@cache
def excitation() -> Excitation:
    """The board's field, in the phases of the model."""
    return excitation_for(certain_model(), anser_board().field)[0]


@cache
def references() -> SensorTable:
    """Point coils around the board."""
    ring, n = reference_ring(24, 0.13), 24
    place = np.round(ring.position, 6)
    return SensorTable(ring.channel, ring.name, ring.body, place, ring.axis, np.zeros(n))


@cache
def world_setup() -> Setup:
    """The setup of board, tool and references."""
    return setup_of(TOOL, setup_of(references()).sensors)


def metal_flux(metal, place, turn, at, axes):
    """What point coils read of a lump, (S, K), T."""
    points, response = metal
    spheres = place + points @ turn.T
    field = np.moveaxis(anser_board().field(spheres), 1, 2) * PHASE
    own = np.einsum('ji,njk->nik', turn, field).reshape(-1, len(PHASE))
    moments = np.stack([response[k] @ own[:, k] for k in range(len(PHASE))], axis=1)
    moments = np.einsum('ij,njk->nik', turn, moments.reshape(-1, 3, len(PHASE)))
    return np.einsum('ska,sa->sk', of_world('spheres').dipole_field(at, spheres, moments), axes)


def way(start, end, seconds, lean=0.1):
    """A way of metal from one place to another: a function of time (F,)."""

    def at(time):
        share = np.clip(time / seconds, 0.0, 1.0)[:, None]
        place = np.asarray(start) + share * (np.asarray(end) - np.asarray(start))
        return place, Rotation.from_rotvec(share * [0.0, 0.0, lean]).as_matrix()

    return at


SWEEP = way((-0.16, 0.03, -0.12), (0.16, -0.02, -0.1), 8.0)
APPROACH = way((0.08, -0.06, -0.17), (-0.02, 0.0, -0.11), 4.0)
DIVE = way((0.07, -0.06, -0.15), (0.0, 0.0, -0.07), 2.0)


class RefitThatSees:
    """Stands for the refit, which sees the metal of a way about where it is."""

    def __init__(self, path, start_ns=START_NS):
        self.path, self.start_ns = path, start_ns

    def update(self, stamp_ns, *readings):
        place, _ = self.path(np.array([(stamp_ns - self.start_ns) * 1e-9]))
        return SimpleNamespace(metal=SimpleNamespace(centroid=place[0] + HIDDEN))


def tool_path(time):
    """A tool that wanders over the board: places (F, 3) and rotations (F, 3, 3)."""
    place = np.stack(
        [0.07 * np.sin(0.9 * time), 0.07 * np.cos(0.7 * time), 0.14 + 0.03 * np.sin(time)], axis=1
    )
    turn = np.stack([0.5 * np.sin(0.8 * time), 0.4 * np.cos(time), 0.3 * time], axis=1)
    return place, Rotation.from_rotvec(turn).as_matrix()


def session(path, metal, count: int, seed: int, rate_hz: float = RATE_HZ) -> Session:
    """A session of so many frames with true optical poses; ``metal`` None: there is none."""
    rng, model = np.random.default_rng(seed), certain_model()
    time = np.round(np.arange(count) / rate_hz, 6)
    still = np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1))
    places, turns = path(time)

    def read(table, frame, position, rotation):
        at, axes = table.placed(position, rotation)
        flux = model.flux(at, axes, table.length)
        if metal is not None:
            flux = flux + metal_flux(metal, places[frame], turns[frame], at, axes)
        return flux + NOISE_T * (rng.normal(size=(*flux.shape, 2)) @ [1.0, 1.0j])

    out = []
    for body, table, poses in (('tool_a', TOOL, tool_path(time)), ('fg', references(), still)):
        pairs = enumerate(zip(*poses, strict=True))
        flux = np.array([read(table, frame, *pose) for frame, pose in pairs])
        good = np.ones(flux.shape[:2], dtype=bool)
        flags, seen = np.zeros(good.shape, dtype=np.int64), np.ones(count, dtype=bool)
        out.append(Measurements(body, table, time, flux, good, flags, *poses, seen))
    return Session('world', world_setup(), START_NS, (out[0],), out[1])


def write(path: Path, made: Session) -> Path:
    """Write a session as a bag."""
    (tool,), reference, setup = made.tools, made.reference, made.setup
    if reference is None:
        setup = replace(setup, sensors=setup.tool_sensors)
    with SessionWriter(path) as writer:
        writer.write_setup(dump_setup(setup), START_NS)
        for row, time in enumerate(tool.time.tolist()):
            stamp_ns = START_NS + round(time * 1e9)
            turn = Rotation.from_matrix(tool.rotation[row]).as_quat()
            writer.write_pose('/optical/tool_a/pose', stamp_ns, tool.position[row], turn)
            flux = [tool.flux[row], *(() if reference is None else (reference.flux[row],))]
            writer.write_readings(setup.sensors, stamp_ns, np.concatenate(flux))
    return path


def readings(made: Session, row: int) -> list[ToolReading]:
    """What the tool of a session reads in a frame, at a pose that is wrong by some millimetres."""
    tool = made.tools[0]
    place = tool.position[row] + [0.002, -0.001, 0.001]
    return [ToolReading(TOOL, tool.flux[row], place, tool.rotation[row])]
