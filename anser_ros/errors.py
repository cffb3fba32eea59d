"""Defines every error that this package raises on purpose: one root, one child a kind of cause.

A message is one clear line that names the rule and what was found instead.
"""

import argparse
from typing import NoReturn


class AnserError(Exception):
    """Something is wrong that the package names on purpose; it is the root of all its errors."""


class SetupError(AnserError):
    """A setup document breaks a rule of its schema."""


class FrameError(AnserError):
    """Bytes on the control unit's port are no valid frame."""


class PortError(AnserError):
    """The serial port can't be opened, read or written."""


class LayoutError(AnserError):
    """A point cloud's fields or bytes don't fit the layout that it should have."""


class BagError(AnserError):
    """A bag can't be read, or lacks what was asked of it."""


class ModelFileError(AnserError):
    """A file is not a model file, or doesn't fit the session."""


class FitError(AnserError):
    """The data can't determine the model that was asked for."""


class TrackingError(AnserError):
    """The tracker was given what it can't track with."""


class ParameterError(AnserError):
    """A parameter is unknown, of the wrong type or out of its range."""


class DiagnosisError(AnserError):
    """A session can't be diagnosed."""


class PlausibilityError(AnserError):
    """Data contradict their own units, clocks or conventions."""


class OneLineParser(argparse.ArgumentParser):
    """Ends with exit code 2 and one line on stderr, without the usage of a page or more."""

    def error(self, message: str) -> NoReturn:
        """State what is wrong and where the usage is, and exit."""
        self.exit(2, f'{self.prog}: {" ".join(message.split())} (usage: {self.prog} --help)\n')
