"""Has a refit's tables computed by another process, which keeps them where this one reads them.

In a thread of this process the work takes turns with the frames, which then come late for as long
as it lasts: the interpreter runs one thread at a time.
"""

import contextlib
import os
import pickle
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path

from anser_ros.field.model import FieldModel
from anser_ros.nodes.field_model_parts.kept_files import KeptTables
from anser_ros.parallel import ONE_THREAD
from anser_ros.physics.sensor import SensorTable
from anser_ros.refit import tables
from anser_ros.sessions.drawing import Drawing
from anser_ros.sessions.volume import stated_volume
from anser_ros.wire.setup import Setup

Task = tuple[Path, Setup, FieldModel, SensorTable]
"""The folder for the tables, and what they are made from."""
NICENESS = 10
"""Of the process: frames go before it wherever they need a core."""


class TablesProcess:
    """Runs the process, at most one at a time."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def run(self, task: Task, report: Callable[[float], None]) -> bool:
        """Wait until the tables are kept; return whether they are.

        They are not where the folder can't be written, where none can be made for these
        references, or when the process was ended: whoever needs them then makes them himself.

        Parameters
        ----------
        task : Task
        report : callable
            Gets the share that is done; what it raises ends the process.
        """
        report(0.0)
        self._process = subprocess.Popen(
            [sys.executable, '-P', '-m', __name__],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            env=os.environ | dict.fromkeys(ONE_THREAD, '1'),
            start_new_session=True,  # Ctrl-C ends this process, which ends that one
        )  # fmt: skip
        with self._process as process:
            assert process.stdin is not None and process.stdout is not None
            try:
                with contextlib.suppress(BrokenPipeError):
                    process.stdin.write(pickle.dumps(task))
                    process.stdin.flush()
                for line in process.stdout:
                    report(float(line))
            except BaseException:
                self.end()
                raise
        return process.returncode == 0

    def end(self) -> None:
        """End the process if it runs."""
        if self._process is not None:
            self._process.kill()


def main() -> int:
    """Make the tables of the task on the standard input, and print the share that is done.

    Returns
    -------
    int
        0 when they are kept, 1 where the folder can't be written.
    """
    folder, setup, model, references = task = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.nice(NICENESS)
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return 1
    drawing, volume = Drawing.of(setup).field, stated_volume(setup)
    made = tables.build_tables(
        model, references, setup.refit, drawing, volume,
        report=lambda share: print(share, flush=True),
    )  # fmt: skip
    KeptTables(*task).write(made)
    return 0


def _end_with_parent() -> None:
    """End this process when the one that has started it is gone, and its pipe with it."""
    while os.read(sys.stdin.fileno(), 1):
        pass
    os._exit(1)


if __name__ == '__main__':
    sys.exit(main())
