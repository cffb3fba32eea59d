"""Effects put into a control unit's signals: the place where a simulated fault of nature goes in.

An effect overrides the stage at which it acts. The stages run in the order of the methods: the
world's fluxes, the coil currents, the voltages of all samples before the converter, the records'
device time. Times count from when the coils were first driven, s, but for the device's own clock.
An effect must not know who looks at the result.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.wire.setup import Setup

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


class RawEffect:
    """Base: changes nothing."""

    def setup(self, setup: Setup) -> Setup:
        """The setup as it really is, where the effect makes it differ from the document."""
        return setup

    def flux(self, time_s: float, flux: ComplexArray) -> ComplexArray:
        """Fluxes (S, K) of all sensors, T at nominal current, in the order of the setup."""
        return flux

    def current(self, time_s: float, current: ComplexArray) -> ComplexArray:
        """Coil currents (K,), A; what drives the field is also what the current channel sees."""
        return current

    def volts(self, time_s: Array, volts: Array) -> Array:
        """Voltages (n, S) of all sensors at n sampling instants, before noise and converter."""
        return volts

    def device_time(self, time_s: float) -> float:
        """What the device's clock says at a true time."""
        return time_s

    def delivery_delay_s(self) -> float:
        """How much later than usual the records reach the host."""
        return 0.0


@dataclass(frozen=True)
class RawChannelCrosstalk(RawEffect):
    """Sensors of one cluster leak into each other.

    Attributes
    ----------
    columns : of the cluster's sensors, in the order of the setup
    matrix : what each of them (row) sees of the others (column), ones on the diagonal
    """

    columns: tuple[int, ...]
    matrix: tuple[tuple[float, ...], ...]

    def volts(self, time_s: Array, volts: Array) -> Array:
        """Mix."""
        mixed = volts.copy()
        mixed[:, list(self.columns)] = volts[:, list(self.columns)] @ np.array(self.matrix).T
        return mixed


@dataclass(frozen=True)
class CompressingAmplifier(RawEffect):
    """One sensor's amplifier runs out of room: v becomes limit * tanh(v / limit)."""

    column: int
    limit_v: float

    def volts(self, time_s: Array, volts: Array) -> Array:
        """Compress."""
        compressed = volts.copy()
        compressed[:, self.column] = self.limit_v * np.tanh(volts[:, self.column] / self.limit_v)
        return compressed


@dataclass(frozen=True)
class CrossoverAmplifier(RawEffect):
    """One sensor's output stage loses what is small: v becomes v - dead * tanh(v / dead).

    No effect of any catalogue: the share that is lost is the larger the weaker all tones are.
    """

    column: int
    dead_v: float

    def volts(self, time_s: Array, volts: Array) -> Array:
        """Take the dead zone off."""
        crossed = volts.copy()
        crossed[:, self.column] -= self.dead_v * np.tanh(volts[:, self.column] / self.dead_v)
        return crossed


@dataclass(frozen=True)
class LooseSensor(RawEffect):
    """One sensor's contact fails: for a share of the time its voltage drops to a small rest."""

    column: int
    share: float = 0.1
    rest: float = 0.02
    period_s: float = 0.7

    def volts(self, time_s: Array, volts: Array) -> Array:
        """Drop out."""
        open_contact = (time_s / self.period_s) % 1.0 < self.share
        loose = volts.copy()
        loose[open_contact, self.column] *= self.rest
        return loose


@dataclass(frozen=True)
class SlowClock(RawEffect):
    """The device's clock runs at another rate than it says."""

    error_ppm: float

    def device_time(self, time_s: float) -> float:
        """Time by the wrong clock."""
        return time_s * (1 + 1e-6 * self.error_ppm)


@dataclass(frozen=True)
class LateDelivery(RawEffect):
    """A filter or buffer holds the records back."""

    delay_s: float

    def delivery_delay_s(self) -> float:
        """Constant."""
        return self.delay_s


@dataclass(frozen=True)
class TiltedSensor(RawEffect):
    """A sensor has come loose: it points elsewhere than the setup document says."""

    column: int
    axis: tuple[float, float, float]

    def setup(self, setup: Setup) -> Setup:
        """Turn the one sensor."""
        sensors = list(setup.sensors)
        sensors[self.column] = replace(sensors[self.column], axis=self.axis)
        return replace(setup, sensors=tuple(sensors))


@dataclass(frozen=True)
class ChannelGain(RawEffect):
    """One channel's gain is off."""

    column: int
    gain: float

    def volts(self, time_s: Array, volts: Array) -> Array:
        """Scale."""
        scaled = volts.copy()
        scaled[:, self.column] *= self.gain
        return scaled


@dataclass(frozen=True)
class GainRipple(RawEffect):
    """The gain of all channels swings, as by a bad supply: no effect of any catalogue."""

    depth: float
    period_s: float

    def volts(self, time_s: Array, volts: Array) -> Array:
        """Swing."""
        swing = 1 + self.depth * np.sin(2 * np.pi * time_s / self.period_s)
        return np.asarray(volts * swing[:, None])


@dataclass(frozen=True)
class CoilWeakens(RawEffect):
    """A coil's field changes though its current does not: a turn that heats up and shorts."""

    coil: int
    amount: float
    tau_s: float

    def flux(self, time_s: float, flux: ComplexArray) -> ComplexArray:
        """Drift."""
        drifted = flux.copy()
        drifted[:, self.coil] *= 1 + self.amount * (1 - np.exp(-time_s / self.tau_s))
        return drifted


@dataclass(frozen=True)
class CurrentDrift(RawEffect):
    """A coil's current changes by `amount` with time constant `tau_s`, as its copper warms up."""

    coil: int
    amount: float
    tau_s: float

    def current(self, time_s: float, current: ComplexArray) -> ComplexArray:
        """Drift."""
        drifted = current.copy()
        drifted[self.coil] *= 1 + self.amount * (1 - np.exp(-time_s / self.tau_s))
        return drifted


def chained_volts(effects: Sequence[RawEffect], time_s: Array, volts: Array) -> Array:
    """Voltages behind all effects, in their order."""
    for effect in effects:
        volts = effect.volts(time_s, volts)
    return volts
