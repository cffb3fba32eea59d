"""Write a setup document by options and tables, check it, and draw it."""

import argparse
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from anser_ros.cli import output
from anser_ros.cli.board_figures import setup_figure
from anser_ros.errors import ParameterError
from anser_ros.sessions.nominal_board import board_of
from anser_ros.settings import sections_of
from anser_ros.wire.setup import FIELD_GENERATOR, SCHEMA, Setup, parse_setup
from anser_ros.wire.tables import read_table
from anser_ros.wire.text_files import read_config, read_yaml

ANSER, ANSER_FILE = 'anser', 'demo_setup.yaml'
"""The board that is known by name, and the file of `config/` that has it."""
SPIRAL = ('turns', 'pitch_m', 'layers', 'thickness_m', 'current_a')
GEOMETRY = {
    'square_spiral_pcb': ('side_m', *SPIRAL),
    'rectangular_spiral_pcb': ('side_x_m', 'side_y_m', *SPIRAL),
    'rectangular_loop': ('side_x_m', 'side_y_m', 'turns', 'current_a'),
    'circular_loop': ('radius_m', 'turns', 'current_a'),
}
"""What is stated of the coils of a kind of board."""
WHOLE = ('turns', 'layers')
DIRECTIONS = {
    f'{sign}{name}': [factor * float(axis == name) for axis in 'xyz']
    for name in 'xyz'
    for sign, factor in (('', 1.0), ('+', 1.0), ('-', -1.0))
}
"""Directions that have a name."""
SENSOR_COLUMNS = ('channel', 'name', 'body', 'x_mm', 'y_mm', 'z_mm', 'axis')
COIL_COLUMNS = ('name', 'x_mm', 'y_mm', 'z_mm', 'turn_deg', 'tone_hz')
LEAST_EMITTERS = 6
"""Emitter coils from which on a single coil can be tracked: a pose has five unknowns."""
FEWEST_WINDOWS = 1.0
"""Least distance of two tones, in windows a second: nearer ones leak into each other."""
PARALLEL = 0.999
"""Cosine from which on two axes count as parallel, 2.6 degrees."""

Document = dict[str, Any]


def number_of(text: str, what: str) -> float:
    """Return the finite number that a text says; raises `ParameterError` where it is none."""
    try:
        value = float(text)
    except ValueError:
        value = float('nan')
    if not np.isfinite(value):
        raise ParameterError(f'{what} must be a number, got {text.strip()!r}')
    return value


def numbers_of(text: str, count: int, what: str) -> list[float]:
    """Return so many numbers with commas or blanks between them."""
    parts = text.replace(',', ' ').split()
    if len(parts) != count:
        raise ParameterError(f'{what} takes {count} numbers, got {text.strip()!r}')
    return [number_of(part, what) for part in parts]


def metres(values: Sequence[float]) -> list[float]:
    """Return lengths in mm in m, without the rounding of the division in the document."""
    return [round(1e-3 * value, 9) for value in values]


def emitter_of(kind: str, geometry: Mapping[str, float], coils: list[Document]) -> Document:
    """Return the section of a board; its values are checked with the whole document."""
    values = {k: int(v) if k in WHOLE and v == int(v) else v for k, v in geometry.items()}
    return {'kind': kind, **values, 'coils': coils}


def coil_of(name: str, text: str) -> Document:
    """Return an emitter coil of ``x, y, z, turn about z, tone`` in mm, degrees and Hz."""
    x, y, z, turn, tone = numbers_of(text, 5, f'coil {name}')
    return {
        'name': name, 'centre_m': metres((x, y, z)), 'rotation_deg': turn, 'frequency_hz': tone,
    }  # fmt: skip


def sensor_of(text: str) -> Document:
    """Return a sensor of ``channel, name, body, x, y, z, axis[, length]``, mm; see `axis_of`."""
    cells = [cell.strip() for cell in text.split(',')]
    if len(cells) not in (7, 8):
        names = ','.join(SENSOR_COLUMNS)
        raise ParameterError(f'a sensor takes {names}[,length_mm], got {text.strip()!r}')
    what = f'sensor {cells[1]}'
    channel = number_of(cells[0], f'{what}: channel')
    if channel != int(channel):
        raise ParameterError(f'{what}: channel must be a whole number, got {cells[0]}')
    return {
        'channel': int(channel), 'name': cells[1], 'body': cells[2],
        'position_m': metres([number_of(cell, what) for cell in cells[3:6]]),
        'axis': axis_of(cells[6], what),
        'length_m': metres([number_of(cells[7], what)])[0] if len(cells) == 8 else 0.0,
    }  # fmt: skip


def axis_of(text: str, what: str) -> list[float]:
    """Return a direction: x, -z and the like, or three numbers with blanks between them."""
    if text.lower() in DIRECTIONS:
        return DIRECTIONS[text.lower()]
    if len(text.split()) != 3:
        raise ParameterError(f'{what}: axis is x, -x, ... or three numbers, got {text!r}')
    values = np.array(numbers_of(text, 3, f'{what}: axis'))
    length = float(np.linalg.norm(values))
    if length == 0.0:
        raise ParameterError(f'{what}: an axis must not have zero length')
    return [round(float(value), 9) for value in values / length]


def rows_of(path: Path, columns: Sequence[str]) -> list[str]:
    """Return the rows of a CSV file with a head, each as the text that is typed for it."""
    table = read_table(path, as_text=True)
    found = [name.casefold() for name in table.names]
    extra = [name for name in found if name == 'length_mm']
    if set(found) - set(extra) != set(columns):
        got = ','.join(table.names)
        raise ParameterError(f'{path}: columns must be {",".join(columns)}, got {got}')
    rows = table.cells.set_axis(found, axis=1)[[*columns, *extra]].to_numpy().tolist()
    if not rows:
        raise ParameterError(f'{path}: no rows')
    return [','.join(row).rstrip(',') for row in rows]


def document_of(
    emitter: Document,
    sensors: list[Document],
    rate_hz: float = 50.0,
    volume_mm: Sequence[float] | None = None,
    stated: Mapping[str, float] | None = None,
) -> Document:
    """Return the whole document as plain data."""
    document: Document = {
        'schema': SCHEMA, 'frame_id': FIELD_GENERATOR, 'flux_rate_hz': rate_hz, 'flux_unit': 'T',
        'emitter': emitter, 'sensors': sensors,
    }  # fmt: skip
    if volume_mm is not None:
        low, high = metres(volume_mm[:3]), metres(volume_mm[3:])
        document['volume'] = {'low_m': low, 'high_m': high}
    document |= {name: values for name, values in sections_of(stated or {}).items() if values}
    return document


class _RowDumper(yaml.SafeDumper):
    """Writes the coils and sensors of a document in a line each, as the files of `config/` do."""

    def represent_mapping(self, tag: str, mapping: Any, flow_style: bool | None = None) -> Any:
        is_row = 'name' in dict(mapping)
        return super().represent_mapping(tag, mapping, flow_style=is_row or flow_style)

    def represent_sequence(self, tag: str, sequence: Any, flow_style: bool | None = None) -> Any:
        is_vector = all(isinstance(value, int | float) for value in sequence)
        return super().represent_sequence(tag, sequence, flow_style=is_vector or flow_style)


def text_of(document: Document) -> tuple[str, Setup]:
    """Return the document as YAML, and what readers make of it.

    Raises `SetupError` when the document breaks a rule.
    """
    plain = yaml.safe_load(yaml.safe_dump(document))  # nothing in it is shared
    text = yaml.dump(plain, Dumper=_RowDumper, sort_keys=False, width=200)
    return text, parse_setup(text)


def advice_on(setup: Setup) -> list[str]:
    """Return what is allowed, and will be missed later; a line each."""
    found, emitters = [], setup.emitter.coils
    if len(emitters) < LEAST_EMITTERS:
        found.append(
            f'{len(emitters)} emitter coils: tracking a single coil needs at least '
            f'{LEAST_EMITTERS}'
        )
    tones = sorted((coil.frequency_hz, coil.name) for coil in emitters)
    for (one, name), (other, neighbour) in itertools.pairwise(tones):
        if other - one < FEWEST_WINDOWS * setup.flux_rate_hz:
            found.append(
                f'tones of {name} and {neighbour} are {other - one:g} Hz apart, too close for '
                f'{setup.flux_rate_hz:g} windows a second to separate them'
            )
    for body in setup.bodies:
        axes = np.array([sensor.axis for sensor in setup.sensors if sensor.body == body])
        if (np.abs(axes @ axes[0]) > PARALLEL).all():
            found.append(
                f'{body}: all coils are parallel, so its roll cannot be determined, nor a 6-DoF '
                'pose'
            )
    count, least = len(setup.reference_sensors), setup.refit.min_references
    if count < least:
        found.append(f'{count} reference coils: the refit needs at least {least}, better 16')
    return found


RESULT = 'anser_setup_result/1'
DOCUMENT, PICTURE = 'setup.yaml', 'setup.png'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        'example: anser setup --board anser '
        '--sensor "0,pen/0,pen,0,0,0,z" --sensor "16,ref/0,fg,150,0,20,1 0 1" --out my_setup/; '
        'anser setup config/demo_setup.yaml --out picture/ (checks and draws it)'
    )
    parser.add_argument('document', nargs='?', help='a setup document to check and draw')
    output.add_out(parser, f'{DOCUMENT} and {PICTURE}')
    words = 'the Anser v1 board, or the kind of its coils'
    parser.add_argument('--board', choices=[ANSER, *GEOMETRY], help=words)
    kinds = '; '.join(f'{kind}: {", ".join(keys)}' for kind, keys in GEOMETRY.items())
    words = f'geometry of emitter coils, SI units: {kinds}'
    output.add_list(parser, '--geometry', metavar='KEY=VALUE', help=words)
    words = 'an emitter coil: centre in mm, turn about z in degrees, tone in Hz; may be repeated'
    output.add_list(parser, '--coil', metavar='X,Y,Z,TURN,TONE', help=words)
    words = f'emitter coils: {",".join(COIL_COLUMNS)}'
    parser.add_argument('--coils', type=Path, metavar='CSV', help=words)
    words = (
        'a sensor coil: position in mm in the frame of its body, which is fg for a reference '
        'coil; the axis is x, -x, ... or three numbers with blanks; may be repeated'
    )
    output.add_list(
        parser, '--sensor', metavar='CHANNEL,NAME,BODY,X,Y,Z,AXIS[,LENGTH]', help=words
    )
    words = f'sensor coils: {",".join(SENSOR_COLUMNS)}[,length_mm]; may be repeated'
    output.add_list(parser, '--sensors', type=Path, metavar='CSV', help=words)
    parser.add_argument('--rate', type=float, default=50.0, help='flux windows a second (50)')
    words = 'two corners of the tracked volume, mm; by default above the board, by its size'
    parser.add_argument('--volume', metavar='X,Y,Z,X,Y,Z', help=words)
    output.add_stated_values(parser, 'accuracy', 'refit', 'tools')
    output.add_json(parser, 'the written files and the advice as JSON')


def work(args: argparse.Namespace, tell: output.Tell) -> output.Result:
    """Draw a document, a new one or one that is there; nothing is written where that fails."""
    output.make_folder(args.out)
    if args.document is not None:
        parts = args.board, args.geometry, args.coil, args.coils, args.sensor, args.sensors
        if any(parts) or args.volume or args.stated:
            raise ParameterError(
                'a setup document is complete: these options are for a new one only'
            )
        own, setup = {}, parse_setup(read_config(args.document))
    elif (args.out / DOCUMENT).exists():
        raise ParameterError(
            f'{args.out / DOCUMENT} is there already, perhaps with tips and changes by hand: give '
            f'another folder, or remove it'
        )
    else:
        text, setup = text_of(_document(args))
        own = {DOCUMENT: text}
        board_of(setup)
    advice = advice_on(setup)
    written = output.write_files(args.out, {**own, PICTURE: setup_figure(setup)})
    words = (
        f'{len(setup.emitter.coils)} emitter coils, {len(setup.reference_sensors)} reference '
        f'coils, tools: {", ".join(setup.bodies) or "none"}'
    )
    document = {'schema': RESULT, 'files': list(map(str, written)), 'advice': advice}
    return output.Result(document, tuple(advice), (words,), written)


def _document(args: argparse.Namespace) -> Document:
    """The document that the options state."""
    if args.board is None:
        raise ParameterError(f'--board is needed: {", ".join([ANSER, *GEOMETRY])}')
    coils = [coil_of(f'coil{rank}', text) for rank, text in enumerate(args.coil)]
    if args.coils is not None:
        for row in rows_of(args.coils, COIL_COLUMNS):
            name, _, rest = row.partition(',')
            coils.append(coil_of(name, rest))
    if args.board == ANSER:
        if coils or args.geometry:
            raise ParameterError('the Anser board has its own coils; name another kind of board')
        emitter: Document = read_yaml(read_config(ANSER_FILE))['emitter']
    else:
        stated = [entry.partition('=') for entry in args.geometry]
        geometry = {key: number_of(value, f'--geometry {key}') for key, _, value in stated}
        emitter = emitter_of(args.board, geometry, coils)
    rows = [*args.sensor, *(row for path in args.sensors for row in rows_of(path, SENSOR_COLUMNS))]
    volume = None if args.volume is None else numbers_of(args.volume, 6, '--volume')
    sensors = [sensor_of(row) for row in rows]
    return document_of(emitter, sensors, args.rate, volume, output.stated_values(args))
