"""Guides through the places of a plate in a terminal, and writes a session that calibrates."""

import argparse
import sys
import threading
from functools import partial
from pathlib import Path
from typing import Any

from std_msgs.msg import String
from std_srvs.srv import Trigger

from anser_ros.errors import AnserError, ParameterError
from anser_ros.nodes.runtime.node import AnserNode, Level, Status
from anser_ros.nodes.runtime.process import main
from anser_ros.nodes.streams.clouds import read_frame
from anser_ros.nodes.streams.one_source import NewestSource, sender_words, setup_source
from anser_ros.sessions.plate import PLATES, PlateGuide, places_of
from anser_ros.wire.cdr import PointCloud
from anser_ros.wire.setup import parse_setup

ACTIONS = ('undo', 'skip', 'keep', 'end')
"""What a person may ask for: services of these names, and their first letters in the terminal."""
KEYS = 'u: undo, s: skip this place, k: keep what was refused, e: end; then Enter'


class GridGuide(AnserNode):
    """Takes a point of a plate when the coil rests, says what is wrong with one, and writes all.

    The file is whole after every point. Raises `ParameterError` when it is there already, or there
    is no such plate.
    """

    NAME = 'grid'
    EXAMPLE = '--plate 7x7 --height-mm 84 --out plate.mcap'
    HAS_KERNELS = True

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        words = 'session to write; the list of places is written beside it, as CSV'
        parser.add_argument('--out', type=Path, required=True, metavar='FILE.mcap', help=words)
        words = f'{", ".join(PLATES)}, or a table with x_mm, y_mm, z_mm (%(default)s)'
        parser.add_argument('--plate', default='7x7', help=words)
        words = "distance of neighbouring places, mm; by default the plate's own"
        parser.add_argument('--pitch-mm', type=float, help=words)
        own = ', '.join(f'{1e3 * one[2]:g} ({name})' for name, one in PLATES.items())
        words = f"height of the coil's middle over the board, mm, once a plane; by default {own}"
        parser.add_argument('--height-mm', type=float, action='append', default=[], help=words)
        parser.add_argument('--body', default='', help='the probe, where the setup has several')

    def __init__(
        self, out: Path, plate: str, pitch_mm: float | None, height_mm: list[float], body: str,
        **options: Any,
    ) -> None:  # fmt: skip
        self._out, self._body, self._said = out, body, ''
        self._guide: PlateGuide | None = None
        pitch = None if pitch_mm is None else 1e-3 * pitch_mm
        self._places = places_of(plate, pitch, [1e-3 * one for one in height_mm])
        rows = [','.join(f'{1e3 * value:.3f}' for value in place) for place in self._places]
        words, listed = '\n'.join(['x_mm,y_mm,z_mm', *rows, '']), out.with_suffix('.csv')
        is_other = listed.exists() and listed.read_bytes() != words.encode()
        for is_wrong, reason in (
            (out.suffix != '.mcap', f'{out}: --out must end in .mcap'),
            (not out.absolute().parent.is_dir(), f'{out}: there is no such folder'),
            (out.exists(), f'{out}: already exists'),
            (is_other, f'{listed}: already exists with other text; give --out another name'),
        ):
            if is_wrong:
                raise ParameterError(reason)
        super().__init__(**options)
        listed.write_text(words, 'utf-8')
        for name in ACTIONS:
            self.create_service(Trigger, f'grid/{name}', partial(self._on_ask, name))
        self._setup_source = setup_source(self, self._on_setup)
        self._fluxes = NewestSource(self, 'tool/flux', self._on_flux)
        threading.Thread(target=self._listen, name='keys', daemon=True).start()
        self._show('waiting for a setup')

    def _on_setup(self, message: String) -> None:
        if self._guide is None:
            try:
                self._guide = PlateGuide(parse_setup(message.data), self._places, self._body)
            except AnserError as error:
                self._show(str(error))
                self.stop(2)
                return
            self._show(KEYS)

    def _on_flux(self, message: PointCloud) -> None:
        guide = self._guide
        if guide is not None:
            stamp_ns, points = read_frame(message, guide.setup.frame_id, self.count)
            self._after(guide.take(stamp_ns, points.channel, points.flux, points.flags))

    def _on_ask(self, name: str, _request: Any, response: Any) -> Any:
        response.success, response.message = True, self._do(name)
        return response

    def _listen(self) -> None:
        """Take what is asked for in the terminal, until its input ends."""
        for line in sys.stdin:
            asked = [name for name in ACTIONS if name.startswith(line.strip().lower() or '?')]
            for name in asked:
                self.given(self._do)(name)

    def _do(self, name: str) -> str:
        if name == 'end' or self._guide is None:
            if name == 'end':
                self.stop(0)
            return self._said
        words = str(getattr(self._guide, name)())
        self._after(words)
        return words

    def _after(self, words: str) -> None:
        """Keep and show what has happened, if something has; end where all is taken."""
        guide = self._guide
        if not words or guide is None:
            return
        if any(guide.taken):
            guide.write(self._out)
        else:
            self._out.unlink(missing_ok=True)
        self._show(words)
        if guide.is_complete:
            self.stop(0)

    def _show(self, words: str) -> None:
        self._said = words
        print(words if self._guide is None else f'{words}; {self._guide.words}', flush=True)

    def status(self) -> Status:
        guide = self._guide
        if guide is None:
            return Status('', Level.WARN, 'waiting for a setup')
        senders = sender_words([self._setup_source, self._fluxes])
        bad = bool(senders) or self._said.startswith('not taken')
        words = senders or f'{self._said}; {guide.words}'
        values = {'taken': sum(map(bool, guide.taken)), 'places': len(self._places)}
        return Status('', Level.WARN if bad else Level.OK, words, values)

    def close(self) -> None:
        if self._out.exists():
            print(f'wrote {self._out}; next: anser calibrate {self._out} --out model.yaml')


if __name__ == '__main__':
    sys.exit(main(GridGuide))
