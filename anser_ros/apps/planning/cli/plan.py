"""Says which accuracy which effort of calibration buys, for the reader's own board and tool.

The drawn fit says what an effort leaves open of a board that is made as boards are, before
anything is read. What is open of the field (its modes) moves the poses of single coils: that is
the bound, whatever the errors of this one board are. With an optical tracker the frame is that
tracker's.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from anser_ros.arrays import Array, as_real
from anser_ros.calibration import drawn_fit as drawn
from anser_ros.calibration.layouts import Generator
from anser_ros.calibration.readings import thinned
from anser_ros.cli import output
from anser_ros.cli.page import legend_under
from anser_ros.errors import SetupError
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import Dipoles, FieldModel
from anser_ros.field.nominal import nominal_model
from anser_ros.physics.rotations import tangents
from anser_ros.physics.sensor import SensorTable
from anser_ros.refit.clouds import Region, region_of
from anser_ros.sessions.calibration import generator_of
from anser_ros.sessions.nominal_board import NominalBoard
from anser_ros.sessions.session import sensor_table
from anser_ros.simulation.recording import GridScan
from anser_ros.simulation.world import Lissajous, Path
from anser_ros.wire.setup import parse_setup
from anser_ros.wire.text_files import read_config

SCHEMA = 'anser_plan/1'
DOCUMENT, FIGURE = 'plan.json', 'plan.png'
PLANES = (0.55, 1.0)
"""Heights of a plate, in halves of the board: 84 and 150 mm over an Anser board."""
WORKING, REACH = (0.5, 1.5), 0.85
"""Heights between which a tool is moved and poses are judged, and how far to the side of the
middle, in halves of the board."""
BANDS = np.linspace(0.4, 2.2, 10)
"""Heights of the picture, in halves of the board."""
COILS, SEED, STEP = 60, 1, 1e-5
"""Coils at each height of which poses are judged, seed, and step of differences, m and rad."""
FEWEST = 5
"""Emitters at least: a single coil's pose has as many numbers."""
CAMERA = np.array([7e-5] * 3 + [4e-4] * 3)
"""Jitter of an optical tracker's poses, m and rad."""


class Effort(NamedTuple):
    """Describes readings at some times, s, of sensors on a path."""

    words: str
    sensors: SensorTable
    path: Path
    times: Array
    errors: Array | None = None  # (6,), of stated poses, m and rad; None where none is stated


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = 'example: anser plan config/demo_setup.yaml --out plan/'
    parser.add_argument('setup', help='setup document: a path, or a file of config/')
    parser.add_argument('--body', help="the tool; by default the setup's first body")
    output.add_out(parser, f'{DOCUMENT} and {FIGURE}', required=False)
    output.add_stated_values(parser, 'accuracy')
    output.add_json(parser, f'{DOCUMENT} on stdout')


def work(args: argparse.Namespace, tell: output.Tell) -> output.Result:
    """Plan for the setup of the arguments; raises `SetupError` when its board has no drawing."""
    setup = parse_setup(read_config(args.setup)).with_stated(output.stated_values(args))
    board = NominalBoard.of(setup)
    body = args.body or next(iter(setup.bodies), None)
    if board.board is None or board.field is None or body not in setup.bodies:
        raise SetupError(f'no board that can be drawn, or no tool {body!r}, in the setup')
    if len(setup.emitter_names) < FEWEST:
        raise SetupError(f'a single coil has no pose over fewer than {FEWEST} emitters')
    output.make_folder(args.out)
    nominal = nominal_model(board.board, drawn.FINE)
    generator = replace(generator_of(setup), nominal=nominal)
    region = region_of(board.field)
    tool = sensor_table(setup.tool_sensors).of_body(body)
    noise_t = setup.accuracy.flux_noise_t
    efforts = list(efforts_of(tool, region, len(generator.emitters)))
    models = {'the drawing alone': nominal}
    for count, effort in enumerate(efforts):
        tell(effort.words, count / len(efforts))
        models[effort.words] = planned(effort, generator, noise_t)
    figures = {words: pose_sigmas(model, region, noise_t) for words, model in models.items()}
    rows = [{'effort': words, **found} for words, found in figures.items()]
    document = {'schema': SCHEMA, 'body': body, 'efforts': rows}
    written = output.write_files(args.out, {DOCUMENT: document, FIGURE: _figure(rows)})
    head = ['effort', 'field mm', 'with the noise of a window mm', 'and of the frame mm']
    cells = [[row['effort'], *(f'{1e3 * v:.3f}' for v in _sums(row))] for row in rows]
    return output.Result(document, (), (output.terminal_table(head, cells),), written)


def _sums(row: dict[str, Any]) -> Array:
    """A field's part of the errors, with a window's, and with the frame's."""
    parts = [row['field_m'], row['window_m'], row['frame_m']]
    return np.asarray(np.sqrt(np.cumsum(np.square(parts))))


def efforts_of(tool: SensorTable, region: Region, emitters: int) -> Iterator[Effort]:
    """Yield the efforts with a tool: its first coil on plates, and all of it moved by hand.

    Without a camera it must be rigid, with more readings than a pose takes.
    """
    probe = replace(
        tool.select(np.arange(1)), position=np.zeros((1, 3)), axis=np.array([[0.0, 0.0, 1.0]])
    )
    half, (low, high) = region.half, WORKING
    for planes, words in ((1, '49 places, one height'), (2, '49 places at two heights')):
        heights = tuple(half * height for height in PLANES[:planes])
        plate = GridScan(7, 2.0 * REACH * half, heights, tilt_rad=0.0)
        yield Effort(words, probe, plate, np.arange(float(plate.frames)), drawn.PLACE)
    centre, size = half * (high + low) / 2.0, half * (high - low) / 2.0
    hand = Lissajous((0.0, 0.0, centre), (REACH * half, REACH * half, size))
    minute = np.arange(0.0, 60.0, 0.2)
    if len(tool) > 1 and len(tool) * emitters > 6:
        yield Effort('the tool moved by hand for 10 s', tool, hand, minute[:50])
        yield Effort('the tool moved by hand for 60 s', tool, hand, minute)
    yield Effort('60 s before an optical tracker', tool, hand, minute, CAMERA)


def planned(effort: Effort, generator: Generator, noise_t: float) -> FieldModel:
    """Return the drawing with what an effort leaves open of a board that is made as boards are."""
    position, turn = map(np.array, zip(*map(effort.path, effort.times.tolist()), strict=True))
    position += generator.middle
    points, axes = (each.reshape(-1, 3) for each in effort.sensors.placed(position, turn))
    count, sensors = len(effort.times), len(effort.sensors)
    assert generator.nominal is not None
    flux = generator.nominal.flux(points, axes, np.tile(effort.sensors.length, count))
    there = np.ones((count, sensors), dtype=bool)
    read = Measurements(
        effort.sensors.body[0], effort.sensors, effort.times, flux.reshape(count, sensors, -1),
        there, np.zeros(there.shape, dtype=np.int64), position, turn, there[:, 0],
    )  # fmt: skip
    is_typed = [effort.errors is not None]
    fitter = drawn.DrawnFitter(
        thinned([read], drawn.MOST_READINGS), is_typed, generator, tuple(drawn.SENSORS), noise_t
    )
    if effort.errors is not None:
        fitter.jitter = effort.errors
    model = fitter.planned()
    return replace(model, shift_sigma_m=0.0) if effort.errors is CAMERA else model


def pose_sigmas(model: FieldModel, region: Region, noise_t: float) -> dict[str, Any]:
    """Return how far single coils are found off, m rms.

    ``field_m`` is by what is open of the field, after a rigid registration, ``window_m`` by noise
    and ``frame_m`` by what is open of the frame, between the heights in which a tool is moved.
    """
    rng, count = np.random.default_rng(SEED), COILS * len(BANDS)
    across = rng.uniform(-REACH, REACH, size=(count, 2)) * region.half + region.centre
    heights = np.repeat(BANDS, COILS)
    places, axes = np.column_stack([across, region.half * heights]), rng.normal(size=(count, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)

    def flux(points: Array, along: Array) -> Array:
        return as_real(model.flux(points, along, None))

    still, tilts = np.zeros(3), STEP * tangents(axes)
    ways = [(STEP * unit, still) for unit in np.eye(3)] + [(still, tilts[:, j]) for j in (0, 1)]
    slope = [(flux(places + p, axes + n) - flux(places - p, axes - n)) / 2 for p, n in ways]
    inverse = np.linalg.pinv(np.stack(slope, axis=2) / STEP)[:, :3]
    assert model.modes is not None
    modes = [Dipoles(model.positions, model.directions, mode) for mode in model.modes]
    moved = np.stack([as_real(mode.flux(places, axes, None)) for mode in modes], axis=2)
    moved = np.einsum('pij,pjr->pir', inverse, moved)
    inside = (heights >= WORKING[0]) & (heights < WORKING[1])
    arms = places - places[inside].mean(axis=0)
    turns = [np.cross(unit, arms) for unit in np.eye(3)]
    rigid = np.concatenate([np.tile(np.eye(3), (count, 1, 1)), np.stack(turns, axis=2)], axis=2)
    rows = rigid[inside].reshape(-1, 6)
    moved -= rigid @ np.linalg.lstsq(rows, moved[inside].reshape(len(rows), -1), rcond=None)[0]
    field, window = (moved**2).sum(axis=(1, 2)), noise_t**2 * (inverse**2).sum(axis=(1, 2))
    return {
        'field_m': float(np.sqrt(field[inside].mean())),
        'window_m': float(np.sqrt(window[inside].mean())),
        'frame_m': float(np.sqrt(3.0) * model.shift_sigma_m),
        'height_m': (region.half * BANDS).tolist(),
        'field_by_height_m': np.sqrt(field.reshape(-1, COILS).mean(axis=1)).tolist(),
    }


def _figure(rows: list[dict[str, Any]]) -> Figure:
    figure = Figure(figsize=(7.0, 4.5), layout='constrained')
    axes = figure.subplots()
    for row in rows:
        heights, errors = (1e3 * np.array(row[key]) for key in ('height_m', 'field_by_height_m'))
        axes.plot(heights, errors, '.-', label=row['effort'])
    axes.set(xlabel='height over the board / mm', ylabel='error by the field / mm', yscale='log')
    axes.grid(alpha=0.3, which='both')
    legend_under(axes, 0.15)
    return figure
