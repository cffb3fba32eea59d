"""Keeps the folder of recordings: all that the page can read or write lies in it."""

import os
from pathlib import Path

from anser_ros.errors import BagError

RESULTS = 'results'
"""Folder inside it, in which every calibration and diagnosis gets a folder of its own."""
SHOWN_FILES = (
    'report.html',
    'choice.png',
    'populations.png',
    'calibration.json',
    'diagnosis.json',
)
"""Files of a result that a browser may ask for."""
MOST = 100
"""Recordings that are offered, the newest: more is no list to choose from."""


class RecordingFolder:
    """Finds recordings and results by their names; no name leads out of the folder.

    The folder need not be there yet.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.expanduser().resolve()

    def trouble(self) -> str:
        """Return why nothing can be written there, in words; empty where it can."""
        place = self.path
        while not place.exists():
            place = place.parent
        if not place.is_dir():
            return f'{place} is no folder'
        return '' if os.access(place, os.W_OK | os.X_OK) else f'no permission to write {place}'

    def recordings(self) -> list[str]:
        """Return names of the bags, the newest first."""
        if not self.path.is_dir():
            return []
        bags = [entry for entry in self.path.iterdir() if _is_bag(entry)]
        bags.sort(key=lambda entry: entry.stat().st_mtime, reverse=True)
        return [entry.name for entry in bags[:MOST]]

    def recording(self, name: str) -> Path:
        """Return the path of a bag.

        Raises `BagError` when the folder has no bag of that name.
        """
        path = self.path / name
        if Path(name).name != name or not _is_bag(path):
            raise BagError(f'{self.path} holds no recording {name!r}')
        return path

    def new_result(self, kind: str, recording: str) -> Path:
        """Make the folder of a result and return it."""
        stem, number = f'{Path(recording).stem}_{kind}', 1
        while True:
            path = self.path / RESULTS / (stem if number == 1 else f'{stem}_{number}')
            try:
                path.mkdir(parents=True)
            except FileExistsError:
                number += 1
            else:
                return path

    def shown(self, result: str, name: str) -> Path | None:
        """Return the path of a result's file that may be shown, None where there is none."""
        path = self.path / RESULTS / result / name
        is_inside = Path(result).name == result and result not in ('.', '..')
        if not is_inside or name not in SHOWN_FILES or path.is_symlink() or not path.is_file():
            return None
        return path


def _is_bag(path: Path) -> bool:
    if path.is_symlink():
        return False
    if path.is_dir():
        return any(path.glob('*.mcap'))
    return path.suffix == '.mcap' and path.is_file()
