"""Write a setup document by questions or options, check it, and draw it."""

import argparse
import sys
from pathlib import Path

from anser_ros.cli.folders import make_folder
from anser_ros.cli.output import Result, say, write_files
from anser_ros.cli.setup_figure import setup_figure
from anser_ros.cli.setup_parts import (
    ANSER,
    COIL_COLUMNS,
    GEOMETRY,
    SENSOR_COLUMNS,
    Document,
    advice_on,
    anser_emitter,
    coil_of,
    document_of,
    emitter_of,
    number_of,
    numbers_of,
    rows_of,
    sensor_of,
    text_of,
)
from anser_ros.cli.setup_questions import ask_all
from anser_ros.cli.stated_values import (
    add_json,
    add_list,
    add_out,
    add_stated_values,
    stated_values,
)
from anser_ros.errors import ParameterError
from anser_ros.sessions.drawing import board_of
from anser_ros.wire.config_folder import read_config
from anser_ros.wire.setup import Setup, parse_setup

RESULT = 'anser_setup_result/1'
DOCUMENT, PICTURE = 'setup.yaml', 'setup.png'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.epilog = (
        'example: anser setup --board anser '
        '--sensor "0,pen/0,pen,0,0,0,z" --sensor "16,ref/0,fg,150,0,20,1 0 1" --out my_setup/; '
        'anser setup config/demo_setup.yaml --out picture/ (checks and draws it)'
    )
    parser.add_argument('document', nargs='?', help='a setup document to check and draw')
    add_out(parser, f'{DOCUMENT} and {PICTURE}')
    words = 'the Anser v1 board, or the kind of its coils'
    parser.add_argument('--board', choices=[ANSER, *GEOMETRY], help=words)
    kinds = '; '.join(f'{kind}: {", ".join(keys)}' for kind, keys in GEOMETRY.items())
    words = f'geometry of emitter coils, SI units: {kinds}'
    add_list(parser, '--geometry', metavar='KEY=VALUE', help=words)
    words = 'an emitter coil: centre in mm, turn about z in degrees, tone in Hz; may be repeated'
    add_list(parser, '--coil', metavar='X,Y,Z,TURN,TONE', help=words)
    words = f'emitter coils: {",".join(COIL_COLUMNS)}'
    parser.add_argument('--coils', type=Path, metavar='CSV', help=words)
    words = (
        'a sensor coil: position in mm in the frame of its body, which is fg for a reference '
        'coil; the axis is x, -x, ... or three numbers with blanks; may be repeated'
    )
    add_list(parser, '--sensor', metavar='CHANNEL,NAME,BODY,X,Y,Z,AXIS[,LENGTH]', help=words)
    words = f'sensor coils: {",".join(SENSOR_COLUMNS)}[,length_mm]; may be repeated'
    add_list(parser, '--sensors', type=Path, metavar='CSV', help=words)
    parser.add_argument('--rate', type=float, default=50.0, help='flux windows a second (50)')
    parser.add_argument(
        '--volume', metavar='X,Y,Z,X,Y,Z',
        help='two corners of the tracked volume, mm; by default above the board, by its size',
    )  # fmt: skip
    add_stated_values(parser, 'accuracy', 'refit', 'tools')
    add_json(parser, 'the written files and the advice as JSON')


def run(args: argparse.Namespace) -> int:
    """Run the command; the exit code."""
    parts = [args.board, args.geometry, args.coil, args.coils, args.sensor, args.sensors]
    make_folder(args.out)
    if args.document is None and (args.out / DOCUMENT).exists():
        raise ParameterError(
            f'{args.out / DOCUMENT} is there already, perhaps with tips and changes by hand: give '
            f'another folder, or remove it'
        )
    if args.document is not None:
        if any(parts) or args.volume or args.stated:
            raise ParameterError(
                'a setup document is complete: these options are for a new one only'
            )
        text = read_config(args.document)
        setup = parse_setup(text)
    elif any(parts):
        text, setup = text_of(_document(args))
    else:
        text, setup = text_of(ask_all(_ask, _say))
    return _write(args, text, setup)


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
        emitter = anser_emitter()
    else:
        emitter = emitter_of(args.board, _geometry(args.geometry), coils)
    rows = [*args.sensor, *(row for path in args.sensors for row in rows_of(path, SENSOR_COLUMNS))]
    volume = None if args.volume is None else numbers_of(args.volume, 6, '--volume')
    sensors = [sensor_of(row) for row in rows]
    return document_of(emitter, sensors, args.rate, volume, stated_values(args))


def _geometry(entries: list[str]) -> dict[str, float]:
    found = {}
    for entry in entries:
        key, _, value = entry.partition('=')
        found[key] = number_of(value, f'--geometry {key}')
    return found


def _write(args: argparse.Namespace, text: str, setup: Setup) -> int:
    """Write document and picture; nothing is written of a board that cannot be drawn."""
    if args.document is None:
        board_of(setup)
    advice = advice_on(setup)
    own = {} if args.document else {DOCUMENT: text}
    written = write_files(args.out, {**own, PICTURE: setup_figure(setup)})
    words = (
        f'{len(setup.emitter.coils)} emitter coils, {len(setup.reference_sensors)} reference '
        f'coils, tools: {", ".join(setup.bodies) or "none"}'
    )
    document = {'schema': RESULT, 'files': list(map(str, written)), 'advice': advice}
    say('setup', Result(document, tuple(advice), (words,), written), as_json=args.json)
    return 0


def _ask(question: str) -> str:
    """As `input`, with the question on stderr: stdout is for what comes out."""
    print(question, end='', file=sys.stderr, flush=True)
    line = sys.stdin.readline()
    if not line:
        raise EOFError
    return line


def _say(line: str) -> None:
    print(line, file=sys.stderr)
