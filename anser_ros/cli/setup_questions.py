"""Asks the questions of `anser setup`: answers are checked when given, and asked for again."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TypeVar

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

    ``ask`` gives the answer to a question and raises `EOFError` where there is none; ``say`` shows
    a line.
    """
    return _Questions(ask, say).document()


class _Questions:
    """The questions in their order, of which each is asked until its answer can be read."""

    def __init__(self, ask: Callable[[str], str], say: Callable[[str], object]) -> None:
        self._put, self._say = ask, say
        self._sensors: list[Document] = []

    def document(self) -> Document:
        """Ask for board, tools, reference coils, rate and volume."""
        self._say(
            'Lengths are in mm, in the frame of the board: origin at its centre, z up to the '
            'patient.'
        )
        self._say('An empty answer accepts the value in [brackets].')
        self._emitter = self._board()
        self._say(
            'Now the tools: coils fixed to a body that moves, places and axes in its own frame.'
        )
        while True:
            body = self._ask('name of a tool, or empty if there are no more', str)
            if body:
                self._coils(body)
            elif self._sensors:
                break
            else:
                self._say('  at least one tool is needed')
        self._say(
            'Reference coils are fixed in the frame of the board; with them the model follows '
            'metal.'
        )
        self._coils(FIELD_GENERATOR)
        rate = self._ask('flux windows a second [50]', lambda t: number_of(t or '50', 'the rate'))
        volume = self._ask(
            'corners of the tracked volume, x y z x y z [above the board, by its size]',
            lambda t: numbers_of(t, 6, 'the volume') if t else None,
        )
        return document_of(self._emitter, self._sensors, rate, volume)

    def _ask(self, question: str, read: Callable[[str], Answer]) -> Answer:
        while True:
            try:
                text = self._put(f'{question}: ').strip()
            except EOFError as error:
                raise ParameterError(f'no answer to: {question}') from error
            try:
                return read(text)
            except (AnserError, OSError) as error:
                self._say(f'  {error}')

    def _board(self) -> Document:
        kinds = [ANSER, *GEOMETRY]

        def kind_of(text: str) -> str:
            if (text or ANSER) not in kinds:
                raise ParameterError(f'there are: {", ".join(kinds)}')
            return text or ANSER

        kind = self._ask(f'board: {", ".join(kinds)} [{ANSER}]', kind_of)
        if kind == ANSER:
            return anser_emitter()
        while True:
            geometry = {
                key: self._ask(f'{key} (SI units)', partial(number_of, what=key))
                for key in GEOMETRY[kind]
            }
            words = 'x, y, z, turn about z in degrees, tone in Hz'
            coils = [
                self._ask(f'coil{rank}: {words}', partial(coil_of, f'coil{rank}'))
                for rank in range(self._ask('number of emitter coils [8]', _count(8, 1)))
            ]
            emitter = emitter_of(kind, geometry, coils)
            try:
                text_of(document_of(emitter, [ONE_TOOL_COIL]))
            except AnserError as error:
                self._say(f'  {error}; try again')
                continue
            return emitter

    def _coils(self, body: str) -> None:
        """Take the sensors of one body: typed one after the other, or all of a CSV file."""
        is_board = body == FIELD_GENERATOR
        what, usual = ('reference coils', 0) if is_board else (f'coils on {body}', 1)
        names = tuple(name for name in SENSOR_COLUMNS if name != 'body')
        columns = ','.join(names)

        def count_or_file(text: str) -> int:
            if Path(text).suffix != '.csv':
                return _count(usual, usual)(text)
            self._add([sensor_of(row, body) for row in rows_of(Path(text), names)])
            return 0

        count = self._ask(
            f'number of {what}, or a .csv file of {columns} [{usual}]', count_or_file
        )
        for rank in range(count):
            self._ask(
                f'{what}, {rank + 1} of {count}: {columns}',
                lambda text: self._add([sensor_of(text, body)]),
            )

    def _add(self, found: list[Document]) -> None:
        """Keep sensors with which the document breaks no rule; it raises where it does."""
        every = [*self._sensors, *found]
        if found:
            text_of(document_of(self._emitter, every))
        self._sensors = every


def _count(usual: int, least: int) -> Callable[[str], int]:
    def read(text: str) -> int:
        value = number_of(text or str(usual), 'the number')
        if value != int(value) or value < least:
            raise ParameterError(f'must be a whole number of at least {least}, got {text}')
        return int(value)

    return read
