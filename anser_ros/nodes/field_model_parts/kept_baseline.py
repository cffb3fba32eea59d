"""Keeps on disk the baseline that a field_model which was killed needs to follow again at once.

A baseline cannot be taken while metal is near. It holds as long as the sender of the references
goes on and nothing speaks against it: the node confirms it every second, and whoever starts soon
after the last time takes it up.
"""

import contextlib
import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from anser_ros.field.model import FieldModel
from anser_ros.fingerprint import fingerprint_of
from anser_ros.sessions.kept_tables import DAMAGED, read_arrays, used_s, write_arrays
from anser_ros.wire.setup import Setup

BASELINE_S = 60.0
"""How long after it was last confirmed, s, a baseline is taken up: a supervisor starts a process
again sooner, and nobody moves coils meanwhile."""
CONFIRM_S = 1.0
"""Time from one confirmation of a baseline to the next, s."""


class KeptBaseline:
    """Keeps the baseline of a running node of that whole name.

    ``sender`` returns what identifies the only sender of the references; empty where there is
    none.

    Attributes
    ----------
    folder : Path or None
        Where files are kept; None where they are not.
    """

    def __init__(self, folder: Path | None, node: str, sender: Callable[[], str]) -> None:
        self.folder, self._node, self._sender = folder, node, sender
        self._of: tuple[str, ...] = ()
        self._kept: Path | None = None

    def expect(self, setup: Setup, model: FieldModel) -> None:
        """Have to do with the references of a setup and with a model from now on."""
        identity = setup.identity
        self._of = identity.board, *identity.bodies.values(), model.fingerprint
        self._kept = None

    @property
    def is_known(self) -> bool:
        """Return whether the references have one sender, and the setup is known."""
        return self._path() is not None

    def read(self) -> NDArray[np.complex128] | None:
        """Return the baseline that another process confirmed lately; None where there is none."""
        path = self._path()
        with contextlib.suppress(*DAMAGED):
            if path is not None and 0.0 <= time.time() - used_s(path) <= BASELINE_S:
                return np.asarray(read_arrays(path)['flux'], dtype=np.complex128)
        return None

    def confirm(self, flux: NDArray[np.complex128]) -> None:
        """Keep a baseline, shape (R, K), T, to which nothing is opposed at this moment.

        Raises
        ------
        OSError
            When the disk is full, or must not be written.
        """
        path = self._path()
        if path != self._kept:
            self.drop()
        if path is not None and self._kept is None:
            write_arrays(path, {'flux': flux})
            self._kept = path
            for old in path.parent.glob('baseline_*'):
                if time.time() - used_s(old) > BASELINE_S:
                    old.unlink(missing_ok=True)
        elif path is not None:
            os.utime(path)

    def drop(self) -> None:
        """Keep none: another one is active, or something speaks against it."""
        if self._kept is not None:
            self._kept.unlink(missing_ok=True)
        self._kept = None

    def _path(self) -> Path | None:
        sender = self._sender() if self.folder is not None and self._of else ''
        if self.folder is None or not sender:
            return None
        key = fingerprint_of([self._node, sender, *self._of])
        return self.folder / f'baseline_{key}'
