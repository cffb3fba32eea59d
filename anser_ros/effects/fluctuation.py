"""Lets another effect's parameters change from one frame to the next.

A parameter that steps, swings or rattles has no curve to fit. It is a random number per frame,
with a spread estimated from the data. Its influence on a frame is free along the columns of the
corresponding constant effect, as that of the optical jitter is. A fluctuation costs one spread per
column whatever its course, and explains and hides only what those columns can.
"""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np

from anser_ros.arrays import Array, ComplexArray
from anser_ros.effects.base import Apparatus, View
from anser_ros.effects.channels import SensorGain, ToolGain
from anser_ros.effects.effect import READ_SITE, Effect, Family, FluctuationTerm, Remedy, Site, Term
from anser_ros.effects.emitters import CoilGain
from anser_ros.effects.optical import Registration, TimeOffset
from anser_ros.effects.sensors import SensorAxis, SensorPosition
from anser_ros.field.model import EffectRecord

OPEN = 40
"""Parameters that a fluctuation counts for when explanations are compared: more than a constant
or a curve has, and less than shaped metal (60), which must not explain an emitter that steps."""


class Fluctuation(Effect[FluctuationTerm]):
    """Lets a constant effect, along whose columns a frame may move, fluctuate."""

    family = Family.FLUCTUATION

    def __init__(self, of: Effect[Any], name: str, summary: str, units: Mapping[str, str]) -> None:
        self.of, self.name, self.summary, self.units = of, name, summary, units

    def candidates(self, apparatus: Apparatus) -> Sequence[FluctuationTerm]:
        """Try every site of the constant effect on emitters and tools."""
        ours = apparatus.tool_channels
        return [
            FluctuationTerm(self, term.site, constant=term)
            for term in self.of.candidates(apparatus)
            if all(channel in ours for channel in term.channels)
        ]

    def opened(self, term: FluctuationTerm) -> FluctuationTerm:
        return term

    def complexity(self, term: FluctuationTerm) -> int:
        """Return `OPEN`, whatever the number of its columns."""
        return OPEN

    def covers(self, term: FluctuationTerm, candidate: Term) -> bool:
        """Cover the constant effect at its site too, whose columns are its own."""
        if candidate.effect.name == self.of.name:
            return candidate.name_and_site[1] == term.name_and_site[1]
        return super().covers(term, candidate)

    def rivals(self, term: FluctuationTerm, other: Term) -> bool:
        """Rival what is constant at its site, and whatever is steady on its coil or channel."""
        if other.effect.family is Family.FLUCTUATION:
            return False
        if other.effect.name == self.of.name:
            return all(other.site.get(k) == v for k, v in term.site.items())
        about = [k for k in ('coil', 'channel') if k in term.site]
        return any(term.site[k] == other.site.get(k) for k in about)

    def freedom(self, term: FluctuationTerm) -> int:
        """Count one value for each column in each frame."""
        return 0 if term.spread is None else term.frames * len(term.spread)

    def directions(self, term: FluctuationTerm, view: View) -> ComplexArray | None:
        """Return the columns, scaled to one standard deviation each, or None."""
        columns = term.columns(view)
        return None if columns is None or term.spread is None else columns * term.spread

    def record(self, term: FluctuationTerm, covariance: Array) -> EffectRecord:
        """Record where it is, and how much; sigma is that of a spread of so many numbers."""
        spread = np.zeros(1) if term.spread is None else term.spread
        rms = float(np.sqrt(np.sum(spread**2)))
        sigma = rms / float(np.sqrt(2 * max(term.frames, 1)))
        return EffectRecord(self.name, {**term.recorded_site, 'rms': rms}, {'rms': sigma})

    def term(self, record: EffectRecord) -> FluctuationTerm:
        """Return where it is; what it does in a frame only the frame can tell."""
        record.needed('rms')
        site = {k: READ_SITE[k](v) for k, v in record.parameters.items() if k != 'rms'}
        return FluctuationTerm(self, cast(Site, site))


class CoilFluctuation(Fluctuation):
    """Changes a `CoilGain`; live, the references determine the strength of the moment."""

    remedy = Remedy.FLUX
    drifts = True
    followed = True
    inexact = 0.05  # a step is not normal, and an emitter's own shape stays in its readings alone


class LooseCluster(Fluctuation):
    """Changes a `SensorPosition`, of clusters only: one coil reads too little for it."""

    def candidates(self, apparatus: Apparatus) -> Sequence[FluctuationTerm]:
        return [term for term in super().candidates(apparatus) if len(term.site['channels']) > 1]


EFFECTS = (
    CoilFluctuation(
        CoilGain(), 'coil_fluctuation',
        "an emitter's strength steps, swings or fails, not as a warming coil's does",
        {'coil': '1', 'rms': '1'},
    ),
    Fluctuation(
        SensorGain(), 'sensor_gain_drift', "a sensor's gain changes with time",
        {'channel': '1', 'rms': '1'},
    ),
    Fluctuation(
        ToolGain(), 'tool_gain_drift',
        "the gain that all of a tool's sensors share changes with time",
        {'body': '1', 'rms': '1'},
    ),
    Fluctuation(
        SensorAxis(), 'loose_sensor_axis', "a sensor's axis changes with time",
        {'channel': '1', 'channels': '1', 'rms': 'rad'},
    ),
    LooseCluster(
        SensorPosition(), 'loose_sensor_position',
        "a cluster's place in its body changes with time", {'channels': '1', 'rms': 'm'},
    ),
    Fluctuation(
        TimeOffset(), 'stamp_jitter',
        'the optical stamps are early or late by a different time in every frame', {'rms': 's'},
    ),
    Fluctuation(
        Registration(), 'optical_jitter', 'the optical poses have larger errors than stated',
        {'rms': 'm and rad'},
    ),
)  # fmt: skip
