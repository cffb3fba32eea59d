"""Defines what an installation may state about itself: its accuracy, and how the refit follows.

A value's name is the key in the setup document, the parameter of a node, and the NAME in ``--set
NAME=VALUE``. Options and parameters go before the document, and that before the default.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from anser_ros.arrays import Array
from anser_ros.errors import ParameterError


def _value(default: float, meaning: str, low: float, high: float) -> Any:
    """A value that may be stated: its default, its meaning in a line, and its range."""
    return field(default=default, metadata={'meaning': meaning, 'low': low, 'high': high})


@dataclass(frozen=True)
class _Stated:
    """Raises `ParameterError` when a value is no number or out of its range."""

    def __post_init__(self) -> None:
        for item in fields(self):
            if item.metadata:
                _check(item, getattr(self, item.name))


def _check(item: Any, value: object) -> None:
    whole = item.type is int
    kinds = int if whole else (int, float)
    if isinstance(value, bool) or not isinstance(value, kinds) or not math.isfinite(value):
        what = 'a whole number' if whole else 'a number'
        hint = ' (YAML takes 6e-11 for text, and 6.0e-11 for a number)'
        hint = hint if isinstance(value, str) else ''
        raise ParameterError(f'{item.name} must be {what}, got {value!r}{hint}')
    low, high = item.metadata['low'], item.metadata['high']
    if not low <= value <= high:
        raise ParameterError(f'{item.name} must be in [{low:g}, {high:g}], got {value:g}')


@dataclass(frozen=True)
class Accuracy(_Stated):
    """States how accurate an installation's instruments are: one standard deviation of each error.

    Defaults are those of the Anser sessions of the development. Too small, ordinary errors look
    like an effect or metal; too large, these are hidden and poses have too large a sigma.
    """

    # Where the noise is measured (the refit, the tracker's adaptive scale, the calibration), the
    # estimate starts here.
    flux_noise_t: float = _value(60e-12, 'noise of a phasor component, T', 1e-15, 1e-3)
    # Of optical poses after interpolation to the fluxes' stamps.
    optical_position_m: float = _value(
        0.07e-3, 'jitter of an optical position along each axis, m', 0.0, 0.1
    )
    optical_rotation_rad: float = _value(
        0.4e-3, 'jitter of an optical orientation about each axis, rad', 0.0, 1.0
    )
    reference_position_m: float = _value(
        0.2e-3, "error of a reference sensor's surveyed place along each axis, m", 0.0, 0.1
    )
    reference_axis_rad: float = _value(
        math.radians(0.3), "error of a reference sensor's surveyed axis, rad a tangent", 0.0, 1.0
    )
    reference_gain: float = _value(0.004, "relative error of a reference sensor's gain", 0.0, 1.0)
    stamp_sigma_s: float = _value(0.3e-3, 'error of a flux stamp, s', 0.0, 0.1)

    @property
    def pose_jitter(self) -> Array:
        """Return the jitter of an optical pose along (m) and about (rad) the axes, shape (6,)."""
        return np.repeat([self.optical_position_m, self.optical_rotation_rad], 3)


@dataclass(frozen=True)
class ToolSettings(_Stated):
    """States how well tools are known, and how fast they may be."""

    # Too small, and faultless coils contradict their body; too large, and a coil may be wrong by
    # some times this before its body notices.
    tool_coil_position_m: float = _value(
        0.12e-3, "error of a tool coil's place along each axis, m", 0.0, 0.1
    )
    tool_coil_axis_rad: float = _value(
        math.radians(0.5), "error of a tool coil's axis, rad a tangent", 0.0, 1.0
    )
    tool_coil_gain: float = _value(0.002, "relative error of a tool coil's gain", 0.0, 1.0)
    # Poses that would take more are not published until the frames after them confirm them. The
    # defaults are a hand's: it reaches over a table at 1 to 1.5 m/s, and jerks at 3 g. Too small,
    # and fast movements lose frames; too large, and wrong poses look like movements.
    max_speed_m_s: float = _value(2.0, 'largest speed of a tool, m/s', 1e-3, 1e4)
    max_acceleration_m_s2: float = _value(40.0, 'largest acceleration of a tool, m/s^2', 1e-3, 1e6)


@dataclass(frozen=True)
class RefitSettings(_Stated):
    """States how the live refit follows; nothing here belongs to a particular board or metal."""

    # The current has a gain error of its own. A larger deviation lets a change of one emitter
    # explain more of what metal does.
    emitter_drift: float = _value(
        0.003, "deviation of an emitter's strength relative to its measured current", 0.0, 1.0
    )
    # Eight emitters give eight complex readings per sensor; with fewer than four sensors the
    # place of metal is open.
    min_references: int = _value(
        4, 'usable reference sensors below which poses are withheld', 1, 10_000
    )
    # More make the refit quieter at rest; movement ends the average at once.
    average_frames: int = _value(
        5, 'most frames that unchanging readings are averaged over', 1, 10_000
    )
    # The closer to 1, the longer a fresh hypothesis waits for its evidence.
    persistence: float = _value(
        0.98, 'probability that a hypothesis still holds in the next frame', 0.01, 0.9999
    )
    # 25 are half a second at 50 Hz.
    hold_frames: int = _value(
        25, 'frames of agreement after which a sensor left out is used again', 1, 1_000_000
    )
    # A C-arm that comes at 10 cm/s is 5 cm nearer after half a second, and metal that comes again
    # has not come far. Shorter, and a hiccup of the line costs poses; longer, and poses are given
    # without evidence.
    references_age_s: float = _value(
        0.5, 'longest time for which poses are given without references, s', 0.02, 60.0
    )
    # Fewer are cheaper to send and to use; what they leave out is added as noise.
    error_modes: int = _value(12, "rank of the model's uncertainty", 1, 96)
    seed: int = _value(1, 'seed of the draws that the uncertainty is made from', 1, 2**31)
    accuracy: Accuracy = field(default_factory=Accuracy)
    # The refit itself has no use for tools: settings that differ in them only are the same.
    tools: ToolSettings = field(default_factory=ToolSettings, compare=False)


SECTIONS = {
    'accuracy': {item.name: item for item in fields(Accuracy)},
    'refit': {item.name: item for item in fields(RefitSettings) if item.metadata},
    'tools': {item.name: item for item in fields(ToolSettings)},
}
"""The values that may be stated, by section of the setup document and by name."""
VALUES = {name: item for section in SECTIONS.values() for name, item in section.items()}
"""The same without the sections: no name stands twice."""


def settings_from(stated: Mapping[str, Any]) -> RefitSettings:
    """Return the settings with some values stated by name; raises `ParameterError`."""
    unknown = sorted(set(map(str, stated)) - set(VALUES))
    if unknown:
        raise ParameterError(
            f'there is no value {", ".join(unknown)} to state; there are: {", ".join(VALUES)}'
        )
    given = sections_of(stated)
    return RefitSettings(
        **given['refit'],
        accuracy=Accuracy(**given['accuracy']),
        tools=ToolSettings(**given['tools']),
    )


def sections_of(stated: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return stated values by section of the setup document, and by name."""
    return {
        section: {name: stated[name] for name in names if name in stated}
        for section, names in SECTIONS.items()
    }


def parse_entries(entries: list[str]) -> dict[str, float]:
    """Return values from entries ``NAME=VALUE`` for `settings_from`; raises `ParameterError`."""
    stated: dict[str, float] = {}
    for entry in entries:
        name, _, text = entry.partition('=')
        if name in stated:
            raise ParameterError(f'{name} is stated twice')
        try:
            whole = name in VALUES and VALUES[name].type is int
            stated[name] = int(text) if whole else float(text)
        except ValueError:
            raise ParameterError(f'{entry!r} must be NAME=VALUE with a number') from None
    settings_from(stated)
    return stated
