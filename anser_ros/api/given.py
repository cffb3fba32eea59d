"""Takes what the public functions are given, and refuses what is of another type in words."""

import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from anser_ros.errors import ParameterError
from anser_ros.sessions.session import Session, load_session

SessionSource = Session | str | os.PathLike[str]
Progress = bool | Callable[..., None] | None
"""True draws a bar on the standard error, in a terminal and in a notebook alike."""
BAR = 30
"""Length of a bar, characters."""


def session_given(given: SessionSource) -> Session:
    """Return a session, which is read where its path is given."""
    return given if isinstance(given, Session) else load_session(given)


@contextmanager
def shown(progress: Progress, stage: str) -> Iterator[Callable[..., None] | None]:
    """Yield what is called with a stage in words, a finished share, or both; None for nothing."""
    if not (callable(progress) or progress in (None, True, False)):
        raise ParameterError(f'progress must be True or a function, got {progress!r}')
    last = ''

    def draw(*told: Any) -> None:
        nonlocal last
        words = next((one for one in told if isinstance(one, str)), stage)
        share = next((one for one in told if isinstance(one, float)), None)
        bar = '' if share is None else f' [{"#" * int(BAR * share):<{BAR}}] {share:4.0%}'
        if (line := f'{words}{bar}') != last:
            print(f'\r{line:<{len(last)}}', end='', file=sys.stderr, flush=True)
            last = line

    if progress is not True:
        yield progress or None
        return
    try:
        yield draw
    finally:
        print(file=sys.stderr)


class Figures:
    """Gives a result what a mapping has, by the keys of the file that a command writes."""

    ROWS = ''
    """Key of the list that a data frame is made of."""
    figures: Mapping[str, Any]

    def keys(self) -> tuple[str, ...]:
        """Return the keys of the figures, so that ``dict(result)`` works."""
        return tuple(self.figures)

    def __getitem__(self, key: str) -> Any:
        return self.figures[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self.keys())

    def to_dict(self) -> dict[str, Any]:
        """Return the content of the JSON file (``docs/interfaces.md``)."""
        return dict(self.figures)

    def to_dataframe(self) -> Any:
        """Return a data frame of pandas: a row for each emitter, or for each effect found."""
        import pandas  # late: it takes half a second

        return pandas.DataFrame(self.figures[self.ROWS])
