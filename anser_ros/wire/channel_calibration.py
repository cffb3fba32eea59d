"""Reads the channel calibration (`anser_channels/1`), from volts at the converter to tesla.

For each sensor channel it holds the effective area a = N A G of coil and amplifier, m^2, so that
V = j w a B exp(-j w d), and the delay d, s, of everything behind the coil. It belongs to a control
unit and its cables, whereas the setup document belongs to the geometry.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from anser_ros.arrays import Array
from anser_ros.errors import SetupError
from anser_ros.wire.text_files import read_own_yaml

SCHEMA = 'anser_channels/1'


@dataclass(frozen=True)
class ChannelResponse:
    """Holds effective area (m^2, negative when wired the other way round) and delay (s)."""

    area_m2: float
    delay_s: float = 0.0


@dataclass(frozen=True)
class ChannelCalibration:
    """Holds channels' responses by number, that of all others, and the current's delay."""

    default: ChannelResponse
    channels: Mapping[int, ChannelResponse] = field(default_factory=dict)
    current_delay_s: float = 0.0

    def areas_m2(self, channels: Iterable[int]) -> Array:
        """Return the effective area of each channel, m^2."""
        return np.array([self.channels.get(c, self.default).area_m2 for c in channels], float)

    def delays_s(self, channels: Iterable[int]) -> Array:
        """Return the delay of each channel, s."""
        return np.array([self.channels.get(c, self.default).delay_s for c in channels], float)


def _number(item: Mapping[str, Any], key: str, where: str, fallback: float | None) -> float:
    value = item.get(key, fallback)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise SetupError(f'channels: {where}.{key} must be a finite number, got {value!r}')
    if key == 'area_m2' and value == 0:
        raise SetupError(f'channels: {where}.area_m2 must not be zero')
    if key == 'delay_s' and abs(value) > 1e-2:
        raise SetupError(f'channels: {where}.delay_s must be within 10 ms, got {value!r}')
    return float(value)


def _response(item: Any, where: str, default: ChannelResponse | None) -> ChannelResponse:
    if not isinstance(item, dict):
        raise SetupError(f'channels: {where} must be a mapping, got {item!r}')
    unknown = set(item) - {'area_m2', 'delay_s', 'channel'}
    if unknown:
        raise SetupError(f'channels: {where} holds the unknown key {sorted(map(str, unknown))[0]}')
    area = default.area_m2 if default else None
    delay = default.delay_s if default else 0.0
    return ChannelResponse(
        _number(item, 'area_m2', where, area), _number(item, 'delay_s', where, delay)
    )


def parse_channels(text: str) -> ChannelCalibration:
    """Read and check a channel calibration; `SetupError` names the rule that is broken."""
    root = read_own_yaml(text, 'channels')
    if not isinstance(root, dict) or root.get('schema') != SCHEMA:
        raise SetupError(f'channels: schema must be {SCHEMA!r}')
    default = _response(root.get('default'), 'default', None)
    current = _response({'area_m2': 1.0, **(root.get('current') or {})}, 'current', None)
    items = root.get('channels') or []
    if not isinstance(items, list):
        raise SetupError('channels: channels must be a list')
    channels: dict[int, ChannelResponse] = {}
    for rank, item in enumerate(items):
        where = f'channels[{rank}]'
        response = _response(item, where, default)
        number = item.get('channel')
        if isinstance(number, bool) or not isinstance(number, int) or number < 0:
            raise SetupError(f'channels: {where}.channel must be a channel number, got {number!r}')
        if number in channels:
            raise SetupError(f'channels: channel {number} appears twice')
        channels[number] = response
    return ChannelCalibration(default, channels, current.delay_s)
