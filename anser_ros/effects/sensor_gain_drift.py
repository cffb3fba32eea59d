"""One sensor's gain changes with time: a warming amplifier, a contact that gives way."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.effect import (
    Array,
    ComplexArray,
    Effect,
    Remedy,
    Scene,
    Term,
    View,
    needed,
    sigmas,
)
from anser_ros.effects.hats import hats, knots_of
from anser_ros.fitting.model import EffectRecord


class SensorGainDrift(Effect):
    """theta: relative change of the gain at the knots, straight lines between."""

    name = 'sensor_gain_drift'
    summary = "a sensor's gain changes with time"
    units: ClassVar[Mapping[str, str]] = {'channels': '1', 'time_s': 's', 'change': '1'}
    plausible: ClassVar[Mapping[str, tuple[float, float]]] = {'change': (-0.5, 0.5)}
    remedy = Remedy.FLUX

    def candidates(self, scene: Scene) -> Sequence[Term]:
        """Every channel of a tool, and all together."""
        knots = knots_of(scene.duration)
        groups: list[tuple[int, ...]] = [(c,) for c in scene.tool_channels]
        if len(groups) > 1:
            groups.append(scene.tool_channels)
        return [Term(self, {'channels': g, '_knots': knots}, np.zeros(knots.size)) for g in groups]

    def prior(self, term: Term) -> Array:
        """Some percent."""
        return np.full(term.theta.size, 0.1)

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """The channels' flux times the hat functions."""
        rows = np.isin(view.sensors.channel, term.site['channels'])
        if not rows.any():
            return None
        shape = hats(term.site['_knots'], view.time)
        out = view.columns(term.theta.size)
        own = view.linear[:, rows] / (1 + shape @ term.theta)[:, None, None]
        out[:, rows] = own[..., None] * shape[:, None, None, :]
        return out

    def channel_gain(
        self, term: Term, channels: NDArray[np.int64], time: Array
    ) -> ComplexArray | None:
        """Gain by time, (F, S)."""
        rows = np.isin(channels, term.site['channels'])
        change = hats(term.site['_knots'], time) @ term.theta
        return np.asarray(1 + change[:, None] * rows[None, :], dtype=complex)

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """The curve."""
        return EffectRecord(
            self.name,
            {
                'channels': list(term.site['channels']),
                'time_s': np.asarray(term.site['_knots']).tolist(),
                'change': term.theta.tolist(),
            },
            {'change': sigmas(covariance).tolist()},
        )

    def term(self, record: EffectRecord) -> Term:
        """From the curve."""
        knots = np.asarray(needed(record, 'time_s'), dtype=np.float64)
        change = np.asarray(needed(record, 'change'), dtype=np.float64)
        channels = tuple(int(c) for c in needed(record, 'channels'))
        return Term(self, {'channels': channels, '_knots': knots}, change)


EFFECTS = (SensorGainDrift(),)
