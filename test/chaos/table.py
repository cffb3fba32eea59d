"""The rows of the trial, as a line for whoever watches and as a table of the documents."""

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from pathlib import Path

BEGIN, END = '<!-- chaos: begin -->', '<!-- chaos: end -->'
ALLOWED_S = 1.0
"""Time within which poses have to be back after a fault has gone, s."""
HEAD = '| fault | said | after, s | wrong of ok poses | back after, s |'
WORDS = 90
"""Characters of a state's words that the table shows."""
FOLDER = re.compile(r'/tmp/[^/\s]+/')
"""Temporary folders, which say nothing to who reads the table."""


@dataclass(frozen=True)
class Row:
    """What came of one fault."""

    group: str
    name: str
    what: str
    said: str  # the first state that told of it
    detected_s: float | None  # time until then
    poses: int  # published from the beginning on
    wrong: int
    worst_m: float | None  # the largest error of a wrong pose
    sigma_m: float | None  # the sigma that it stated
    back_s: float | None  # time from the fault's end until poses came again, if they did
    crashed: tuple[str, ...] = ()  # what ended by itself, or answered as it should not
    skipped: int = 0  # poses that were not judged, since the simulated unit itself was late
    heard: tuple[str, ...] = ()  # all new states that told of it, whichever node was first

    @property
    def is_judged(self) -> bool:
        """Whether the machine kept up well enough for this to say something."""
        return self.skipped <= self.poses

    def failed(self, allowed_s: float) -> bool:
        """Return whether this must not be; how soon poses are back says nothing if it is busy."""
        late = self.is_judged and (self.back_s is None or self.back_s > allowed_s)
        return bool(self.wrong or self.crashed or late)

    def verdict(self, allowed_s: float) -> str:
        """Return the verdict in a word."""
        if self.failed(allowed_s):
            return 'FAILED'
        return 'ok' if self.is_judged else 'BUSY'


def _worst(row: Row) -> str:
    if row.worst_m is None:
        return ''
    if row.worst_m == float('inf'):
        return 'stamped where no truth is'
    return f'{1e3 * row.worst_m:.1f} mm at sigma {1e3 * (row.sigma_m or 0.0):.2f}'


def _seconds(value: float | None, otherwise: str) -> str:
    return otherwise if value is None else f'{value:.1f}'


def line(row: Row) -> str:
    """Return a row as one line."""
    parts = [
        f'{row.verdict(ALLOWED_S):6} {row.name:24}',
        f'wrong {row.wrong}/{row.poses} {_worst(row)}',
        f'said after {_seconds(row.detected_s, "-")} s: {row.said[:WORDS] or "nothing"}',
        f'back after {_seconds(row.back_s, "NEVER")} s',
        *([f'{row.skipped} not judged'] if row.skipped else []),
        *row.crashed,
    ]
    return ' | '.join(parts)


def save(path: Path, rows: Iterable[Row]) -> None:
    """Write rows to a file, from which `load` reads them."""
    path.write_text(json.dumps([asdict(row) for row in rows], indent=1) + '\n', encoding='utf-8')


def load(path: Path) -> list[Row]:
    """Return the rows of a file."""
    rows = [Row(**row) for row in json.loads(path.read_text(encoding='utf-8'))]
    return [replace(row, crashed=tuple(row.crashed), heard=tuple(row.heard)) for row in rows]


def write_docs(path: Path, rows: Sequence[Row], seed: int, rate_hz: float) -> None:
    """Write the table between its two marks of a document."""
    words = f'Written by `make chaos ARGS=--write-docs` (seed {seed}, {rate_hz:g} Hz).'
    out = [BEGIN, '', words, '']
    for group, some in groupby(rows, key=lambda row: row.group):
        out += [f'### {group.capitalize()}', '', HEAD, '|---' * HEAD.count(' | ') + '|---|']
        for row in some:
            said = FOLDER.sub('', row.said).replace('|', '/').replace('<', '&lt;')
            said = said[:WORDS] or 'nothing'
            wrong = f'{row.wrong} of {row.poses}' if row.is_judged else 'machine too busy'
            wrong += f', {_worst(row)}' if row.wrong else ''
            out.append(
                f'| {row.what} | {said} | {_seconds(row.detected_s, "-")} | {wrong} '
                f'| {_seconds(row.back_s, "never")} |'
            )
        out.append('')
    out.append(END)
    text = path.read_text(encoding='utf-8') if path.is_file() else f'{BEGIN}\n{END}\n'
    if BEGIN not in text:
        text += f'\n{BEGIN}\n{END}\n'
    head, rest = text.split(BEGIN, 1)
    path.write_text(head + '\n'.join(out) + rest.split(END, 1)[1], encoding='utf-8')
