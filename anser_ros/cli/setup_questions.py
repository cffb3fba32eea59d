"""Asks the questions of `anser setup`: answers are checked when given, and asked for again."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from anser_ros.cli.setup_parts import (
    ANSER,
    GEOMETRY,
    SENSOR_COLUMNS,
    Document,
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
from anser_ros.errors import AnserError, ParameterError
from anser_ros.wire.setup import FIELD_GENERATOR

Answer = TypeVar('Answer')
ONE_TOOL_COIL = {'channel': 0, 'name': 'tool/0', 'body': 'tool', 'position_m': [0, 0, 0],
                 'axis': [0, 0, 1]}  # fmt: skip
"""Stands for the sensors while a board is checked before there are any."""


def ask_all(ask: Callable[[str], str], say: Callable[[str], object]) -> Document:
    """Ask for everything, and return the document.

    Parameters
    ----------
    ask : callable
        Gives the answer to a question; raises `EOFError` where there is none.
    say : callable
        Shows a line.
    """
    say('Lengths are in mm, in the frame of the board: origin at its centre, z up to the patient.')
    say('An empty answer accepts the value in [brackets].')
    emitter = _emitter(ask, say)
    sensors: list[Document] = []
    say('Now the tools: coils fixed to a body that moves, places and axes in its own frame.')
    while True:
        body = _ask(ask, say, 'name of a tool, or empty if there are no more', str)
        if not body:
            if sensors:
                break
            say('  at least one tool is needed')
            continue
        sensors += _sensors(ask, say, emitter, sensors, body)
    say('Reference coils are fixed in the frame of the board; with them the model follows metal.')
    sensors += _sensors(ask, say, emitter, sensors, FIELD_GENERATOR)
    rate = _ask(ask, say, 'flux windows a second [50]', lambda t: number_of(t or '50', 'the rate'))
    volume = _ask(
        ask, say, 'corners of the tracked volume, x y z x y z [above the board, by its size]',
        lambda t: numbers_of(t, (6,), 'the volume') if t else None,
    )  # fmt: skip
    return document_of(emitter, sensors, rate, volume, {})


def _ask(
    ask: Callable[[str], str],
    say: Callable[[str], object],
    question: str,
    read: Callable[[str], Answer],
) -> Answer:
    """Ask until the answer can be read."""
    while True:
        try:
            text = ask(f'{question}: ').strip()
        except EOFError as error:
            raise ParameterError(f'no answer to: {question}') from error
        try:
            return read(text)
        except (AnserError, OSError) as error:
            say(f'  {error}')


def _emitter(ask: Callable[[str], str], say: Callable[[str], object]) -> Document:
    kinds = [ANSER, *GEOMETRY]

    def kind_of(text: str) -> str:
        if (text or ANSER) not in kinds:
            raise ParameterError(f'there are: {", ".join(kinds)}')
        return text or ANSER

    kind = _ask(ask, say, f'board: {", ".join(kinds)} [{ANSER}]', kind_of)
    if kind == ANSER:
        return anser_emitter()
    while True:
        geometry = {
            key: _ask(ask, say, f'{key} (SI units)', partial(number_of, what=key))
            for key in GEOMETRY[kind]
        }
        count = int(_ask(ask, say, 'number of emitter coils [8]', _count(8, 1)))
        coils = []
        for rank in range(count):
            question = f'coil{rank}: x, y, z, turn about z in degrees, tone in Hz'
            coils.append(_ask(ask, say, question, partial(coil_of, f'coil{rank}')))
        emitter = emitter_of(kind, geometry, coils)
        try:
            check_document(document_of(emitter, [ONE_TOOL_COIL], 50.0, None, {}))
        except AnserError as error:
            say(f'  {error}; try again')
            continue
        return emitter


def _sensors(
    ask: Callable[[str], str],
    say: Callable[[str], object],
    emitter: Document,
    others: list[Document],
    body: str,
) -> list[Document]:
    """The sensors of one body: typed one after the other, or all of a CSV file."""
    what = 'reference coils' if body == FIELD_GENERATOR else f'coils on {body}'
    usual = 0 if body == FIELD_GENERATOR else 1
    columns = ','.join(name for name in SENSOR_COLUMNS if name != 'body')

    def checked(found: list[Document]) -> list[Document]:
        filler = [] if others or body != FIELD_GENERATOR else [ONE_TOOL_COIL]
        if found:
            check_document(document_of(emitter, [*others, *filler, *found], 50.0, None, {}))
        return found

    def count_or_file(text: str) -> int | list[Document]:
        if Path(text).suffix == '.csv':
            names = tuple(name for name in SENSOR_COLUMNS if name != 'body')
            return checked([sensor_of(row, body) for row in rows_of(Path(text), names)])
        return _count(usual, 0 if body == FIELD_GENERATOR else 1)(text)

    given = _ask(
        ask, say, f'number of {what}, or a .csv file of {columns} [{usual}]', count_or_file
    )
    if isinstance(given, list):
        return given
    found: list[Document] = []
    for rank in range(given):
        question = f'{what}, {rank + 1} of {given}: {columns}'

        def read(text: str) -> Document:
            one = sensor_of(text, body)
            checked([*found, one])
            return one

        found.append(_ask(ask, say, question, read))
    return found


def check_document(document: Document) -> Any:
    """Return what readers make of a document; raises `SetupError` where it breaks a rule."""
    return text_of(document)[1]


def _count(usual: int, least: int) -> Callable[[str], int]:
    def read(text: str) -> int:
        value = number_of(text or str(usual), 'the number')
        if value != int(value) or value < least:
            raise ParameterError(f'must be a whole number of at least {least}, got {text}')
        return int(value)

    return read
