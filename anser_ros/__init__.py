"""Tracks electromagnetically in real time, with online compensation of metal distortion.

The functions of `anser_ros.api` are names of this package. They are imported when the first of
them is used, so ``import anser_ros`` itself loads nothing.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from anser_ros.api.calibration import CalibrationResult, calibrate
    from anser_ros.api.design import plot_field, simulate
    from anser_ros.api.diagnosis import DiagnosisResult, diagnose
    from anser_ros.api.model import Model
    from anser_ros.api.recording import load_setup, write_session
    from anser_ros.api.tracking import TrackedPoses, TrackingResult, track
    from anser_ros.sessions.session import Session, load_session
    from anser_ros.wire.setup import Setup

_HOMES = {
    'CalibrationResult': 'api.calibration',
    'DiagnosisResult': 'api.diagnosis',
    'Model': 'api.model',
    'Session': 'sessions.session',
    'Setup': 'wire.setup',
    'TrackedPoses': 'api.tracking',
    'TrackingResult': 'api.tracking',
    'calibrate': 'api.calibration',
    'diagnose': 'api.diagnosis',
    'load_session': 'sessions.session',
    'load_setup': 'api.recording',
    'plot_field': 'api.design',
    'simulate': 'api.design',
    'track': 'api.tracking',
    'write_session': 'api.recording',
}
"""Module of every public name."""

__all__ = [
    'CalibrationResult', 'DiagnosisResult', 'Model', 'Session', 'Setup', 'TrackedPoses',
    'TrackingResult', 'calibrate', 'diagnose', 'load_session', 'load_setup', 'plot_field',
    'simulate', 'track', 'write_session',
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import a public name's module when it is first asked for (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(importlib.import_module(f'anser_ros.{_HOMES[name]}'), name)


def __dir__() -> list[str]:
    """Return the public names besides the module's own."""
    return sorted({*globals(), *__all__})
