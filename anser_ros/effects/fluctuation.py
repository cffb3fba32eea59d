"""What another effect's parameters do when they change from one frame to the next.

A parameter that steps, swings or rattles has no curve to fit. It is a random number a frame, with
a spread found from the data, and what it does to a frame is left open along the columns of the
effect that is constant otherwise, as the optical jitter is. A fluctuation costs one spread a
column however it goes, explains nothing but what those columns can, and hides nothing else.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from anser_ros.effects.coil_gain import CoilGain
from anser_ros.effects.effect import (
    Apparatus,
    Array,
    ComplexArray,
    Effect,
    Remedy,
    Term,
    View,
    needed,
)  # fmt: skip
from anser_ros.effects.registration import Registration
from anser_ros.effects.sensor_axis import SensorAxis
from anser_ros.effects.sensor_gain import SensorGain
from anser_ros.effects.sensor_position import SensorPosition
from anser_ros.effects.time_offset import TimeOffset
from anser_ros.effects.tool_gain import ToolGain
from anser_ros.field.model import EffectRecord


class Fluctuation(Effect):
    """No theta; the site's ``_spread`` is the standard deviation of each of the columns.

    Attributes
    ----------
    of : Effect
        The constant effect whose columns a frame may move along.
    """

    of: ClassVar[Effect]
    plausible: ClassVar[Mapping[str, tuple[float, float]]] = {'rms': (0.0, 1.0)}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Every site of the constant effect on emitters and tools."""
        return [
            Term(self, {**term.site, '_constant': term})
            for term in self.of.candidates(apparatus)
            if self._is_tool(term, apparatus)
        ]

    @staticmethod
    def _is_tool(term: Term, apparatus: Apparatus) -> bool:
        own = apparatus.tool_channels
        return bool(term.site.get('channel', own[0]) in own)

    def free_columns(self, term: Term, view: View) -> ComplexArray | None:
        """Columns (F, S, K, q) of unit size along which a frame may move."""
        constant: Term = term.site['_constant']
        return self.of.columns(constant, view)

    def unit_spread(self, term: Term) -> Array:
        """Standard deviations that the constant effect expects, shape (q,)."""
        return self.of.prior(term.site['_constant'])

    def spread_out(self, term: Term, spread: Array) -> Term:
        """The term with a spread for each column."""
        return replace(term, site={**term.site, '_spread': spread})

    def directions(self, term: Term, view: View) -> ComplexArray | None:
        """The columns, a standard deviation long."""
        columns = self.free_columns(term, view)
        spread = term.site.get('_spread')
        return None if columns is None or spread is None else columns * spread

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Where, and how much."""
        site = {k: v for k, v in term.site.items() if k[0] != '_'}
        spread = np.asarray(term.site['_spread'])
        rms, frames = float(np.sqrt(np.sum(spread**2))), max(int(term.site.get('_frames', 1)), 1)
        where: dict[str, Any] = {k: list(v) if k == 'channels' else v for k, v in site.items()}
        return EffectRecord(
            self.name, {**where, 'rms': rms}, {'rms': rms / float(np.sqrt(2 * frames))}
        )

    def term(self, record: EffectRecord) -> Term:
        """Where it is; what it does in a frame only the frame can tell."""
        needed(record, 'rms')
        where = {k: v for k, v in record.parameters.items() if k != 'rms'}
        return Term(self, where)


class CoilFluctuation(Fluctuation):
    """Of a `CoilGain`; live, the references tell the strength of the moment."""

    name = 'coil_fluctuation'
    summary = "an emitter's strength steps, swings or fails, not as a warming coil's does"
    units: ClassVar[Mapping[str, str]] = {'coil': '1', 'rms': '1'}
    remedy = Remedy.FLUX
    of = CoilGain()


class SensorGainDrift(Fluctuation):
    """Of a `SensorGain`."""

    name = 'sensor_gain_drift'
    summary = "a sensor's gain changes with time"
    units: ClassVar[Mapping[str, str]] = {'channel': '1', 'rms': '1'}
    of = SensorGain()


class ToolGainDrift(Fluctuation):
    """Of a `ToolGain`."""

    name = 'tool_gain_drift'
    summary = "the gain that all of a tool's sensors share changes with time"
    units: ClassVar[Mapping[str, str]] = {'body': '1', 'rms': '1'}
    of = ToolGain()


class LooseSensorAxis(Fluctuation):
    """Of a `SensorAxis`."""

    name = 'loose_sensor_axis'
    summary = "a sensor's axis changes with time"
    units: ClassVar[Mapping[str, str]] = {'channel': '1', 'channels': '1', 'rms': 'rad'}
    of = SensorAxis()


class LooseSensorPosition(Fluctuation):
    """Of a `SensorPosition`, for clusters: the readings of one coil are too few for three."""

    name = 'loose_sensor_position'
    summary = "a cluster's place in its body changes with time"
    units: ClassVar[Mapping[str, str]] = {'channels': '1', 'rms': 'm'}
    of = SensorPosition()

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Every cluster."""
        return [term for term in super().candidates(apparatus) if len(term.site['channels']) > 1]


class StampJitter(Fluctuation):
    """Of a `TimeOffset`."""

    name = 'stamp_jitter'
    summary = 'the optical stamps are early or late by a different time in every frame'
    units: ClassVar[Mapping[str, str]] = {'rms': 's'}
    of = TimeOffset()


class OpticalJitter(Fluctuation):
    """Of a `Registration`: what the optical poses err by beyond what they may."""

    name = 'optical_jitter'
    summary = 'the optical poses err by more than they may'
    units: ClassVar[Mapping[str, str]] = {'rms': 'm and rad'}
    of = Registration()


EFFECTS = (
    CoilFluctuation(), SensorGainDrift(), ToolGainDrift(), LooseSensorAxis(),
    LooseSensorPosition(), StampJitter(), OpticalJitter(),
)  # fmt: skip
