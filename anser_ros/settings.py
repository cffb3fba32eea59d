"""Defines what an installation may state about itself: its accuracy, and how the refit follows.

A value's name is the key in the setup document, and the NAME in ``--set NAME=VALUE``. Options go
before the document, and that before the default.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from anser_ros.arrays import Array
from anser_ros.errors import ParameterError


def _value(default: float, low: float, high: float) -> Any:
    """A value that may be stated: its default and its range."""
    return field(default=default, metadata={'low': low, 'high': high})


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

    # Noise of a phasor component. Where it is measured (the refit, the tracker's adaptive scale,
    # the calibration), the estimate starts here.
    flux_noise_t: float = _value(60e-12, 1e-15, 1e-3)
    # Jitter of an optical pose along and about each axis, interpolated to the fluxes' stamps.
    optical_position_m: float = _value(0.07e-3, 0.0, 0.1)
    optical_rotation_rad: float = _value(0.4e-3, 0.0, 1.0)
    # Errors of a reference's surveyed place (each axis), axis (a tangent) and gain (relative).
    reference_position_m: float = _value(0.2e-3, 0.0, 0.1)
    reference_axis_rad: float = _value(math.radians(0.3), 0.0, 1.0)
    reference_gain: float = _value(0.004, 0.0, 1.0)
    stamp_sigma_s: float = _value(0.3e-3, 0.0, 0.1)  # error of a flux stamp

    @property
    def pose_jitter(self) -> Array:
        """Return the jitter of an optical pose along (m) and about (rad) the axes, shape (6,)."""
        return np.repeat([self.optical_position_m, self.optical_rotation_rad], 3)


@dataclass(frozen=True)
class ToolSettings(_Stated):
    """States how well tools are known, how fast they may be, and what emitters do meanwhile."""

    # Errors of a tool coil's place (each axis), axis (a tangent) and gain (relative). Too small,
    # and faultless coils contradict their body; too large, and a coil may be wrong by some times
    # this before its body notices.
    tool_coil_position_m: float = _value(0.12e-3, 0.0, 0.1)
    tool_coil_axis_rad: float = _value(math.radians(0.5), 0.0, 1.0)
    tool_coil_gain: float = _value(0.002, 0.0, 1.0)
    # Poses that would take more are not published until the frames after them confirm them. The
    # defaults are a hand's: it reaches over a table at 1 to 1.5 m/s, and jerks at 3 g. Too small,
    # and fast movements lose frames; too large, and wrong poses look like movements.
    max_speed_m_s: float = _value(2.0, 1e-3, 1e4)
    max_acceleration_m_s2: float = _value(40.0, 1e-3, 1e6)
    # Deviation of an emitter's strength from the calibrated one, and of its rate of change, 1/s.
    # Where no reference follows an emitter, tools learn its strength. The defaults are those of a
    # coil that warms up by 10 K in a minute. Too small, and warm emitters cost poses; too large,
    # and metal looks like warm emitters to a single coil.
    emitter_offset: float = _value(0.03, 1e-9, 1.0)
    emitter_rate_1_s: float = _value(5e-4, 1e-12, 1.0)


@dataclass(frozen=True)
class RefitSettings(_Stated):
    """States how the live refit follows; nothing here belongs to a particular board or metal."""

    # Deviation of an emitter's strength relative to its measured current, which has a gain error
    # of its own. A larger one lets a change of one emitter explain more of what metal does.
    emitter_drift: float = _value(0.003, 0.0, 1.0)
    # Usable sensors below which poses are withheld. Eight emitters give eight complex readings per
    # sensor; with fewer than four sensors the place of metal is open.
    min_references: int = _value(4, 1, 10_000)
    # Most frames that unchanging readings are averaged over. More make the refit quieter at rest;
    # movement ends the average at once.
    average_frames: int = _value(5, 1, 10_000)
    # Probability that a hypothesis still holds in the next frame. The closer to 1, the longer a
    # fresh one waits for its evidence.
    persistence: float = _value(0.98, 0.01, 0.9999)
    # Frames of agreement after which a sensor left out is used again, half a second at 50 Hz.
    hold_frames: int = _value(25, 1, 1_000_000)
    # Longest time for which poses are given without references. A C-arm that comes at 10 cm/s is
    # 5 cm nearer after half a second, and metal that comes again has not come far. Shorter, and a
    # hiccup of the line costs poses; longer, and poses are given without evidence.
    references_age_s: float = _value(0.5, 0.02, 60.0)
    # Rank of the model's uncertainty. Fewer are cheaper to send and to use; what they leave out is
    # added as noise.
    error_modes: int = _value(12, 1, 96)
    seed: int = _value(1, 1, 2**31)  # of the draws that the uncertainty is made from
    accuracy: Accuracy = field(default_factory=Accuracy)
    # The refit itself has no use for tools: settings that differ in them only are the same.
    tools: ToolSettings = field(default_factory=ToolSettings, compare=False)


EMITTER_STEADY_S = 60.0
"""Time for which an emitter that warms up goes on at its rate, s: that of a coil on a board."""
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
