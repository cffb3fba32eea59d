"""Puts simulated faults of sensors, coils, amplifiers and clocks into a control unit's signals.

An effect overrides the stage at which it acts. The stages run in the order of the methods: the
world's fluxes, the coil currents, the voltages of all samples before the converter, the device
time of the records. Times count from the first drive of the coils, s, except for the device's
clock. An effect does not know which analysis will look at the result.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.wire.setup import Setup

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


class RawEffect:
    """Changes nothing at any stage; it is the base of all effects."""

    def setup(self, setup: Setup) -> Setup:
        """Return the true setup, which the effect may make differ from its document."""
        return setup

    def flux(self, time_s: float, flux: ComplexArray) -> ComplexArray:
        """Return the fluxes (S, K), T at nominal current, in the order of the setup's sensors."""
        return flux

    def current(self, time_s: float, current: ComplexArray) -> ComplexArray:
        """Return the coil currents (K,), A, for the field and for the current channel alike."""
        return current

    def volts(self, time_s: Array, volts: Array) -> Array:
        """Return the voltages (n, S), V, at n sampling instants before noise and converter."""
        return volts

    def optical_time(self, time_s: float) -> float:
        """Return the time that the optical tracker's clock stamps with at a true time, s."""
        return time_s


@dataclass(frozen=True)
class RawChannelCrosstalk(RawEffect):
    """Makes crosstalk between the sensors of one cluster."""

    columns: tuple[int, ...]  # of the cluster's sensors in the order of the setup
    # gain from each sensor (column) to each channel (row), with ones on the diagonal
    matrix: tuple[tuple[float, ...], ...]

    def volts(self, time_s: Array, volts: Array) -> Array:
        mixed = volts.copy()
        mixed[:, list(self.columns)] = volts[:, list(self.columns)] @ np.array(self.matrix).T
        return mixed


@dataclass(frozen=True)
class OneSensor(RawEffect):
    """Changes the voltages of one sensor, at its column in the order of the setup."""

    column: int

    def volts(self, time_s: Array, volts: Array) -> Array:
        changed = volts.copy()
        changed[:, self.column] = self.changed(time_s, volts[:, self.column])
        return changed

    def changed(self, time_s: Array, volts: Array) -> Array:
        """Return the sensor's voltages (n,), V."""
        raise NotImplementedError


@dataclass(frozen=True)
class CompressingAmplifier(OneSensor):
    """Saturates one sensor's amplifier: v becomes ``limit * tanh(v / limit)``."""

    limit_v: float

    def changed(self, time_s: Array, volts: Array) -> Array:
        return np.asarray(self.limit_v * np.tanh(volts / self.limit_v))


@dataclass(frozen=True)
class CrossoverAmplifier(OneSensor):
    """Distorts one sensor by crossover: v becomes ``v - dead * tanh(v / dead)``.

    The diagnosis has no such effect. The weaker all tones are, the larger is the lost fraction.
    """

    dead_v: float

    def changed(self, time_s: Array, volts: Array) -> Array:
        return np.asarray(volts - self.dead_v * np.tanh(volts / self.dead_v))


@dataclass(frozen=True)
class LooseSensor(OneSensor):
    """Loosens a sensor's contact: periodically its voltage drops to a small remainder."""

    share: float = 0.1  # fraction of the time in which the contact is open
    rest: float = 0.02  # factor of the voltage at an open contact
    period_s: float = 0.7  # from one opening to the next, s

    def changed(self, time_s: Array, volts: Array) -> Array:
        is_open = (time_s / self.period_s) % 1.0 < self.share
        return np.where(is_open, volts * self.rest, volts)


@dataclass(frozen=True)
class ChannelGain(OneSensor):
    """Makes the gain of one channel wrong."""

    gain: float

    def changed(self, time_s: Array, volts: Array) -> Array:
        return volts * self.gain


@dataclass(frozen=True)
class OpticalClock(RawEffect):
    """Makes the optical tracker's clock early by a constant, and fast."""

    early_s: float = 0.0
    fast_ppm: float = 0.0

    def optical_time(self, time_s: float) -> float:
        return time_s * (1.0 + 1e-6 * self.fast_ppm) - self.early_s


@dataclass(frozen=True)
class TiltedSensor(RawEffect):
    """Tilts a sensor that has come loose: its axis is not the setup document's."""

    column: int
    axis: tuple[float, float, float]

    def setup(self, setup: Setup) -> Setup:
        sensors = list(setup.sensors)
        sensors[self.column] = replace(sensors[self.column], axis=self.axis)
        return replace(setup, sensors=tuple(sensors))


@dataclass(frozen=True)
class GainRipple(RawEffect):
    """Makes all gains oscillate, as by a bad supply; the diagnosis has no such effect."""

    depth: float
    period_s: float

    def volts(self, time_s: Array, volts: Array) -> Array:
        swing = 1 + self.depth * np.sin(2 * np.pi * time_s / self.period_s)
        return np.asarray(volts * swing[:, None])


@dataclass(frozen=True)
class CoilWeakens(RawEffect):
    """Changes a coil's field at constant current, as by a turn that heats up and shorts."""

    coil: int
    amount: float
    tau_s: float

    def flux(self, time_s: float, flux: ComplexArray) -> ComplexArray:
        drifted = flux.copy()
        drifted[:, self.coil] *= 1 + self.amount * (1 - np.exp(-time_s / self.tau_s))
        return drifted
