"""Propose places and axes of reference coils, and say what error each number of them leaves."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from anser_ros.apps.planning.design import Design, StatedMetal, choose, family, random_designs
from anser_ros.arrays import Array
from anser_ros.cli import output
from anser_ros.cli.board_figures import Label, name_points
from anser_ros.cli.page import legend_under, spell_out
from anser_ros.errors import ParameterError, SetupError
from anser_ros.physics.sensor import SensorTable
from anser_ros.refit.clouds import Excitation, Region, region_of
from anser_ros.sessions.nominal_board import NominalBoard, stated_volume
from anser_ros.sessions.plausibility import LENGTH_UNITS, unit_words
from anser_ros.sessions.session import sensor_table
from anser_ros.wire.setup import FIELD_GENERATOR, Setup, parse_setup
from anser_ros.wire.tables import read_table
from anser_ros.wire.text_files import read_config

SCHEMA = 'anser_places/1'
DOCUMENT, TABLE, FIGURE = 'places.json', 'places.csv', 'places.png'
KINDS = ('below', 'around')
SPACING = 0.4
"""Distance of neighbouring places of a plane, in halves of the board."""
FRAME_HEIGHTS, FRAME_WIDTH, FRAME_PLACES = (0.15, 0.7, 1.3), 1.15, 12
"""Heights and half width of the frame, in halves of the board, and places at each height."""
AXES = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [1, -1, -1]]) / np.sqrt(
    np.array([[1], [1], [1], [3], [3]])
)
"""Axes that a coil may have if none are stated: three of a cluster, and two oblique ones."""
LENGTH_M = 0.008
"""Length of a coil that is not stated, m: about that of the coils of the demo's setup."""
FARTHEST = 10.0
"""Distance of a coil, in halves of the board, beyond which it receives nothing of it."""
MOST_CANDIDATES = 400
"""Coils to choose from at most; more take minutes and gigabytes."""
RANDOM_TRIES, SEED = 20, 1
"""Choices by chance that the found one is compared with, and the seed of these."""


class Proposal(NamedTuple):
    """Holds what was found: the candidates, the designs by number of coils, and random ones."""

    candidates: SensorTable
    region: Region
    metals: list[StatedMetal]
    designs: list[Design]
    random: dict[int, list[Design]]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        'example: anser place config/demo_setup.yaml --references 8 --from frame --out places/'
    )
    parser.add_argument('setup', help='setup document: a path, or a file of config/')
    parser.add_argument('--references', type=int, required=True, metavar='N', help='coils wanted')
    parser.add_argument(
        '--from', dest='origin', default='setup', metavar='WHERE',
        help="places to choose from: 'setup' (its own reference sensors, the default), 'frame' "
        '(around the board), plane=Z (a lattice at that height, m), or a CSV file with x_m, y_m, '
        'z_m and, where they are given, ax, ay, az, length_m',
    )  # fmt: skip
    words = 'family of metals: below the board, around the volume, or both (%(default)s)'
    parser.add_argument('--metal', default=','.join(KINDS), help=words)
    words = 'pose error that each metal causes while it is not compensated (%(default)s)'
    parser.add_argument('--error-mm', type=float, default=5.0, help=words)
    output.add_out(parser)
    output.add_stated_values(parser, 'accuracy', 'refit')
    output.add_json(parser, f'{DOCUMENT} on stdout')


def work(args: argparse.Namespace, tell: output.Tell) -> output.Result:
    """Propose places for the setup of the arguments."""
    kinds = [kind.strip() for kind in args.metal.split(',')]
    if not set(kinds) <= set(KINDS):
        raise ParameterError(f'--metal {args.metal}: must be some of {", ".join(KINDS)}')
    if not (np.isfinite(args.error_mm) and args.error_mm > 0.0):
        raise ParameterError(f'--error-mm must be positive, got {args.error_mm}')
    setup = parse_setup(read_config(args.setup)).with_stated(output.stated_values(args))
    found = propose(setup, args.references, args.origin, kinds, 1e-3 * args.error_mm, tell)
    output.make_folder(args.out)
    document = to_document(found, args.origin)
    figure = places_figure(found.candidates, found.region, found.designs, found.random)
    written = output.write_files(
        args.out, {DOCUMENT: document, FIGURE: figure, TABLE: _table_of(document['places'])}
    )
    head = ['references', 'expected error mm', 'random places mm (best to worst)']
    return output.Result(document, (), (output.terminal_table(head, _rows(document)),), written)


def propose(
    setup: Setup, count: int, origin: str, kinds: list[str], error_m: float,
    progress: Callable[[str, float], None] = lambda *_: None,
) -> Proposal:  # fmt: skip
    """Choose reference coils of a setup.

    ``origin`` is ``setup``, ``frame``, ``plane=Z`` or the path of a CSV file, ``kinds`` are of
    `KINDS`, and ``error_m`` is the error of poses, m, that each metal makes uncorrected. Raises
    `ParameterError` when there are not as many places, or the list of them can't be read,
    `SetupError` when the board can't be drawn from the setup.
    """
    field = NominalBoard.of(setup).field
    if field is None:
        raise SetupError(
            f'places need a board with drawn coils, not one of the kind {setup.emitter.kind!r}'
        )
    whole = region_of(field)
    region = Region(whole.centre, whole.half, stated_volume(setup))
    candidates = candidates_of(setup, origin, region)
    if not 1 <= count <= len(candidates):
        raise ParameterError(
            f'--references {count}: there are {len(candidates)} coils to choose from'
        )
    k = len(setup.emitter_names)
    excitation = Excitation('board', np.ones(k, dtype=complex), field)
    progress('metals', 0.0)
    metals = family(
        candidates, excitation, region, setup.frequencies_hz, setup.refit, kinds, error_m
    )
    progress('places', 0.4)
    designs = choose(metals, count, k)
    rng = np.random.default_rng(SEED)
    counts = sorted({2**i for i in range(10) if 2**i < count} | {count})
    progress('places by chance', 0.8)
    drawn = {n: random_designs(metals, n, k, RANDOM_TRIES, rng) for n in counts}
    return Proposal(candidates, region, metals, designs, drawn)


def candidates_of(setup: Setup, origin: str, region: Region) -> SensorTable:
    """Return the coils to choose from; raises as `propose`."""
    if origin == 'setup':
        table = sensor_table(setup.reference_sensors)
        if not len(table):
            raise ParameterError('the setup has no reference sensors; use --from frame or plane=Z')
    elif origin == 'frame':
        table = _every_axis(_frame(region))
    elif origin.startswith('plane='):
        table = _every_axis(_plane(origin, region))
    else:
        table = _read(Path(origin))
    return _bounded(table, origin, region)


def _frame(region: Region) -> Array:
    """Places around the board."""
    angle = 2.0 * np.pi * np.arange(FRAME_PLACES) / FRAME_PLACES
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rim *= FRAME_WIDTH * region.half / np.abs(rim).max(axis=1, keepdims=True)
    heights = [np.full(len(rim), z * region.half) for z in FRAME_HEIGHTS]
    return np.concatenate([np.column_stack([rim + region.centre, z]) for z in heights])


def _plane(origin: str, region: Region) -> Array:
    """Places of a lattice at the height that ``plane=Z`` states."""
    try:
        height = float(origin.removeprefix('plane='))
    except ValueError:
        height = float('nan')
    if not np.isfinite(height):
        raise ParameterError(f'--from {origin}: the height must be a number, m')
    line = SPACING * region.half * np.arange(-3, 4)
    x, y = np.meshgrid(line + region.centre[0], line + region.centre[1], indexing='ij')
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)


def _bounded(table: SensorTable, origin: str, region: Region) -> SensorTable:
    """The coils, if they are not too many and none is too far from the board to receive it."""
    away = np.linalg.norm(table.position - np.array([*region.centre, 0.0]), axis=1)
    if away.max() > FARTHEST * region.half:
        unit = unit_words(float(np.median(away)) / region.half, LENGTH_UNITS)
        raise ParameterError(
            f'--from {origin}: coils lie up to {away.max():.3g} m from a board of '
            f'{2e3 * region.half:.0f} mm, whose field they receive only within '
            f'{FARTHEST * region.half:.2g} m' + (f': {unit}?' if unit else '; places are in m')
        )
    if len(table) > MOST_CANDIDATES:
        raise ParameterError(
            f'--from {origin}: {len(table)} coils to choose from, {MOST_CANDIDATES} at most'
        )
    return table


def _every_axis(places: Array) -> SensorTable:
    """Coils at places (P, 3) with each of the axes."""
    return _coils(np.repeat(places, len(AXES), axis=0), np.tile(AXES, (len(places), 1)), LENGTH_M)


def _coils(places: Array, axes: Array, length_m: float | Array) -> SensorTable:
    count = len(places)
    return SensorTable(
        channel=np.arange(count),
        name=tuple(f'place/{i}' for i in range(count)),
        body=(FIELD_GENERATOR,) * count,
        position=places,
        axis=axes / np.linalg.norm(axes, axis=1, keepdims=True),
        length=np.broadcast_to(np.asarray(length_m, dtype=np.float64), (count,)).copy(),
    )


def _read(path: Path) -> SensorTable:
    """Return the coils of a list of places."""
    table = read_table(path)
    places = table.positions()
    if 'ax' not in table.names:
        return _every_axis(places)
    axes = table.numbers(('ax', 'ay', 'az'))
    if not (np.linalg.norm(axes, axis=1) > 0.0).all():
        raise ParameterError(f'{path}: an axis has zero length')
    length: float | Array = LENGTH_M
    if 'length_m' in table.names:
        length = table.numbers(('length_m',))[:, 0]
    return _coils(places, axes, length)


def to_document(proposal: Proposal, origin: str) -> dict[str, Any]:
    """Return a proposal as plain data."""
    table, best = proposal.candidates, proposal.designs[-1]
    names = [metal.name for metal in proposal.metals]
    return {
        'schema': SCHEMA,
        'from': origin,
        'metals': names,
        'uncorrected_error_m': proposal.metals[0].error_m,
        'places': [
            {
                'name': table.name[i], 'channel': int(table.channel[i]),
                'position_m': table.position[i].tolist(), 'axis': table.axis[i].tolist(),
                'length_m': float(table.length[i]),
            }
            for i in best.coils
        ],
        'expected': [
            {
                'references': len(design.coils), 'error_m': design.error_m,
                'by_metal_m': dict(zip(names, design.errors_m.tolist(), strict=True)),
            }
            for design in proposal.designs
        ],
        'random': [
            {
                'references': count, 'mean_error_m': float(np.mean([d.error_m for d in drawn])),
                'best_error_m': float(min(d.error_m for d in drawn)),
                'worst_error_m': float(max(d.error_m for d in drawn)),
            }
            for count, drawn in proposal.random.items()
        ],
    }  # fmt: skip


def _rows(document: dict[str, Any]) -> list[list[str]]:
    drawn = {row['references']: row for row in document['random']}
    rows = []
    for row in document['expected']:
        if other := drawn.get(row['references']):
            mean, best, worst = (
                1e3 * other[f'{which}_error_m'] for which in ('mean', 'best', 'worst')
            )
            cell = f'{mean:.3f} ({best:.3f} to {worst:.3f})'
            rows.append([str(row['references']), f'{1e3 * row["error_m"]:.3f}', cell])
    return rows


def _table_of(places: list[dict[str, Any]]) -> str:
    rows = [(row['name'], *row['position_m'], *row['axis'], row['length_m']) for row in places]
    head = ('name', 'x_m', 'y_m', 'z_m', 'ax', 'ay', 'az', 'length_m')
    return ''.join(','.join(map(str, row)) + '\n' for row in (head, *rows))


PLACE_ARROW = 0.15
"""Length of an axis in the picture, in halves of the board."""


def places_figure(
    candidates: SensorTable,
    region: Region,
    designs: Sequence[Design],
    random: Mapping[int, Sequence[Design]],
) -> Figure:
    """Draw the chosen coils from above and from the side, and the error against their number."""
    figure = Figure(figsize=(13.0, 4.2), layout='constrained')
    above, side, right = figure.subplots(1, 3)
    chosen = list(designs[-1].coils)
    named = []
    for axes, sides in ((above, [0, 1]), (side, [0, 2])):
        named.append((axes, _draw_places(axes, candidates, chosen, region, sides)))
    above.set_title('from above')
    side.set_title('from the side')
    _draw_errors(right, designs, random)
    for panel in (above, right):  # below, where no place and no error lies
        legend_under(panel, 0.14, columns=2)
    figure.draw_without_rendering()
    for axes, labels in named:
        name_points(axes, labels, size=8.0)
    return figure


def _draw_places(
    axes: Any, candidates: SensorTable, chosen: list[int], region: Region, sides: list[int]
) -> list[Label]:
    """Draw candidates, chosen coils and board, and return the coils' numbers."""
    axes.plot(*candidates.position[:, sides].T, '.', color='0.75', label='candidates')
    at, axis = candidates.position[chosen][:, sides], candidates.axis[chosen][:, sides]
    size = PLACE_ARROW * region.half
    axes.quiver(
        *at.T, *axis.T, angles='xy', scale_units='xy', scale=1.0 / size, color='tab:blue',
        width=0.006,
    )  # fmt: skip
    axes.update_datalim(at + size * axis)
    axes.margins(0.12)
    square = region.half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    board = np.column_stack([square + region.centre, np.zeros(5)])[:, sides]
    axes.plot(*board.T, color='tab:brown', label='board')
    axes.set_aspect('equal', 'datalim')
    axes.locator_params(axis='x', nbins=5)
    axes.set(xlabel='x / m', ylabel=f'{"xyz"[sides[1]]} / m')
    return [
        Label(str(rank), tuple(point), tuple(-way))
        for rank, (point, way) in enumerate(zip(at.tolist(), axis, strict=True), start=1)
    ]


def _draw_errors(
    axes: Any, designs: Sequence[Design], random: Mapping[int, Sequence[Design]]
) -> None:
    counts = [len(design.coils) for design in designs]
    axes.plot(counts, [1e3 * design.error_m for design in designs], 's-', label='proposed')
    errors = [[1e3 * design.error_m for design in drawn] for drawn in random.values()]
    mean, low, high = (np.array([pick(e) for e in errors]) for pick in (np.mean, min, max))
    axes.errorbar(
        list(random), mean, [mean - low, high - mean], fmt='o', color='0.5', capsize=3,
        label='random places, best to worst',
    )  # fmt: skip
    axes.set_xscale('log', base=2)
    axes.set_yscale('log')
    spell_out(axes.yaxis)
    axes.set_xticks(list(random), [str(n) for n in random])
    axes.set(xlabel='reference coils', ylabel='expected position error / mm')
    axes.grid(True, which='both', alpha=0.3)
