"""Puts simulated faults of sensors, coils, amplifiers and clocks into a control unit's signals.

Times count from the first drive of the coils, s, except for the optical clock. `draw` draws an
effect and its parameters at random, for tests that do not know the answer.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.arrays import Array, ComplexArray
from anser_ros.errors import ParameterError
from anser_ros.simulation.world import MetalBody, at_rest
from anser_ros.wire.channel_calibration import ChannelCalibration
from anser_ros.wire.setup import SensorSpec, Setup


@dataclass(frozen=True)
class RawEffect:
    """Changes the signals at some stages, at the others nothing.

    ``setup`` makes the true setup of the document's. ``flux`` takes a time, s, and the fluxes
    (S, K), T at nominal current, in the order of the setup's sensors, and returns the latter;
    ``volts`` the times (n,), s, of n sampling instants and the voltages (n, S), V, before noise
    and converter. ``optical_time`` is what the optical tracker's clock says at a true time, s.
    """

    setup: Callable[[Setup], Setup] = lambda setup: setup
    flux: Callable[[float, ComplexArray], ComplexArray] = lambda time_s, flux: flux
    volts: Callable[[Array, Array], Array] = lambda time_s, volts: volts
    optical_time: Callable[[float], float] = lambda time_s: time_s


def channel_crosstalk(columns: Sequence[int], matrix: Array) -> RawEffect:
    """Return crosstalk between the sensors of one cluster, in these columns of the setup's order.

    ``matrix`` is the gain from each sensor (column) to each channel (row), with ones on the
    diagonal.
    """

    def mixed(time_s: Array, volts: Array) -> Array:
        out = volts.copy()
        out[:, columns] = volts[:, columns] @ matrix.T
        return out

    return RawEffect(volts=mixed)


def one_sensor(column: int, changed: Callable[[Array, Array], Array]) -> RawEffect:
    """Return a change of the voltages of one sensor, at its column in the order of the setup.

    ``changed`` takes times (n,), s, and the sensor's voltages (n,), V, and returns the latter.
    """

    def volts(time_s: Array, volts: Array) -> Array:
        out = volts.copy()
        out[:, column] = changed(time_s, volts[:, column])
        return out

    return RawEffect(volts=volts)


def compressing(column: int, limit_v: float) -> RawEffect:
    """Return an amplifier that saturates: v becomes ``limit * tanh(v / limit)``."""
    return one_sensor(column, lambda _, volts: limit_v * np.tanh(volts / limit_v))


def crossing_over(column: int, dead_v: float) -> RawEffect:
    """Return crossover distortion, which no diagnosis knows: ``v - dead * tanh(v / dead)``."""
    return one_sensor(column, lambda _, volts: volts - dead_v * np.tanh(volts / dead_v))


def loose(column: int, share: float, period_s: float, rest: float = 0.02) -> RawEffect:
    """Return a contact that is open for a share of each period; a rest of the voltage stays."""

    def changed(time_s: Array, volts: Array) -> Array:
        return np.where((time_s / period_s) % 1.0 < share, volts * rest, volts)

    return one_sensor(column, changed)


def with_gain(column: int, gain: float) -> RawEffect:
    """Return a channel whose gain is wrong."""
    return one_sensor(column, lambda _, volts: volts * gain)


def optical_clock(early_s: float = 0.0, fast_ppm: float = 0.0) -> RawEffect:
    """Return an optical tracker's clock that is early by a constant, and fast."""
    return RawEffect(optical_time=lambda time_s: time_s * (1.0 + 1e-6 * fast_ppm) - early_s)


def tilted(column: int, axis: tuple[float, float, float]) -> RawEffect:
    """Return a sensor that has come loose: its axis is not the setup document's."""

    def setup(stated: Setup) -> Setup:
        sensors = list(stated.sensors)
        sensors[column] = replace(sensors[column], axis=axis)
        return replace(stated, sensors=tuple(sensors))

    return RawEffect(setup)


def gain_ripple(depth: float, period_s: float) -> RawEffect:
    """Return gains that all oscillate, as by a bad supply; the diagnosis has no such effect."""

    def volts(time_s: Array, volts: Array) -> Array:
        return np.asarray(volts * (1 + depth * np.sin(2 * np.pi * time_s / period_s))[:, None])

    return RawEffect(volts=volts)


def weakening(coil: int, amount: float, tau_s: float) -> RawEffect:
    """Return a change of a coil's field at constant current, as by a turn that shorts."""

    def flux(time_s: float, flux: ComplexArray) -> ComplexArray:
        out = flux.copy()
        out[:, coil] *= 1 + amount * (1 - np.exp(-time_s / tau_s))
        return out

    return RawEffect(flux=flux)


NONE = 'none'
RANDOM = 'random'


@dataclass(frozen=True)
class Drawn:
    """Holds a drawn effect with its name and parameters."""

    name: str  # name of the effect
    # its parameters as plain data, named as in docs/interfaces.md where the effect is there
    parameters: dict[str, Any]
    effects: tuple[RawEffect, ...] = ()  # what puts the effect into the signals
    metal: tuple[MetalBody, ...] = ()  # what puts it into the world
    # names under which a diagnosis may rightly report the effect; empty where it has no such
    # effect and only ``unexplained`` is right
    answers: tuple[str, ...] = ()

    def document(self) -> dict[str, Any]:
        """Return the effect as plain data for a file of the truth."""
        answers = list(self.answers)
        return {'name': self.name, 'parameters': self.parameters, 'answers': answers}


@dataclass(frozen=True)
class Unit:
    """Holds the sensors that an effect is put into, with the response of their channels."""

    setup: Setup
    channels: ChannelCalibration


def _tool_columns(setup: Setup) -> list[int]:
    moving = {sensor.name for sensor in setup.tool_sensors}
    return [column for column, s in enumerate(setup.sensors) if s.name in moving]


def _tool_sensor(unit: Unit, rng: np.random.Generator) -> tuple[int, SensorSpec]:
    """Draw a tool sensor: its column, and what the setup says of it."""
    column = int(rng.choice(_tool_columns(unit.setup)))
    return column, unit.setup.sensors[column]


def _clusters(setup: Setup) -> list[list[int]]:
    """Return the columns of tool sensors of which three or more are at the same place."""
    places: dict[tuple[str, tuple[float, ...]], list[int]] = {}
    for column in _tool_columns(setup):
        sensor = setup.sensors[column]
        places.setdefault((sensor.body, sensor.position_m), []).append(column)
    return [columns for columns in places.values() if len(columns) >= 3]


def _static_metal(unit: Unit, rng: np.random.Generator) -> Drawn:
    place = np.array([*rng.uniform(-0.08, 0.08, 2), rng.uniform(-0.12, -0.07)])
    radius = float(rng.uniform(0.03, 0.045))
    body = MetalBody(np.zeros((1, 3)), radius, 5e6, 200.0, at_rest(place))
    parameters = {'position_m': place.tolist(), 'radius_m': radius}
    return _known('static_metal', parameters, metal=(body,))


def _known(name: str, parameters: dict[str, Any], *effects: RawEffect, **rest: Any) -> Drawn:
    """Return an effect that the diagnosis reports under the same name."""
    return Drawn(name, parameters, effects, answers=(name,), **rest)


def _channel_crosstalk(unit: Unit, rng: np.random.Generator) -> Drawn:
    clusters = _clusters(unit.setup)
    columns = clusters[rng.integers(len(clusters))] if clusters else _tool_columns(unit.setup)[:2]
    count = len(columns)
    matrix = np.eye(count) + rng.uniform(0.01, 0.04, (count, count)) * (1 - np.eye(count))
    matrix[~np.eye(count, dtype=bool)] *= rng.choice([-1.0, 1.0], count * (count - 1))
    channels = [unit.setup.sensors[c].channel for c in columns]
    parameters = {'channels': channels, 'matrix': matrix.tolist()}
    return _known('channel_crosstalk', parameters, channel_crosstalk(columns, matrix))


def _time_offset(unit: Unit, rng: np.random.Generator) -> Drawn:
    early = float(rng.uniform(0.015, 0.04))
    return _known('time_offset', {'offset_s': early}, optical_clock(early_s=early))


def _clock_rate(unit: Unit, rng: np.random.Generator) -> Drawn:
    fast_ppm = float(rng.uniform(2500.0, 6000.0))
    return _known('clock_rate', {'rate_ppm': -fast_ppm}, optical_clock(fast_ppm=fast_ppm))


def _sensor_axis(unit: Unit, rng: np.random.Generator) -> Drawn:
    column, sensor = _tool_sensor(unit, rng)
    across = np.cross(sensor.axis, rng.standard_normal(3))
    tilt_deg = float(rng.uniform(3.0, 8.0))
    turn = Rotation.from_rotvec(np.radians(tilt_deg) * across / np.linalg.norm(across))
    x, y, z = (float(v) for v in turn.apply(sensor.axis))
    parameters = {'channel': sensor.channel, 'tilt_deg': tilt_deg, 'axis': [x, y, z]}
    return _known('sensor_axis', parameters, tilted(column, (x, y, z)))


def _sensor_gain(unit: Unit, rng: np.random.Generator) -> Drawn:
    column, sensor = _tool_sensor(unit, rng)
    gain = float(1 + rng.choice([-1, 1]) * rng.uniform(0.01, 0.04))
    parameters = {'channel': sensor.channel, 'gain': gain, 'phase_deg': 0.0}
    return _known('sensor_gain', parameters, with_gain(column, gain))


def _saturation(unit: Unit, rng: np.random.Generator) -> Drawn:
    column, sensor = _tool_sensor(unit, rng)
    limit_v = float(rng.uniform(2.0, 4.0))
    # The amplifier's limit is a voltage, which grows with the frequency: the mean tone stands for
    # all of them.
    area_m2 = unit.channels.areas_m2([sensor.channel])[0]
    full_scale_t = float(limit_v / (2 * np.pi * area_m2 * np.mean(unit.setup.frequencies_hz)))
    parameters = {'channel': sensor.channel, 'full_scale_t': full_scale_t, 'limit_v': limit_v}
    return _known('saturation', parameters, compressing(column, limit_v))


def _coil_drift(unit: Unit, rng: np.random.Generator) -> Drawn:
    coil = int(rng.integers(len(unit.setup.emitter.coils)))
    amount = float(rng.choice([-1, 1]) * rng.uniform(0.01, 0.03))
    tau_s = float(rng.uniform(5.0, 20.0))
    parameters = {'coil': coil, 'amount': amount, 'tau_s': tau_s}
    return _known('coil_drift', parameters, weakening(coil, amount, tau_s))


def _loose_contact(unit: Unit, rng: np.random.Generator) -> Drawn:
    column, sensor = _tool_sensor(unit, rng)
    share, period_s = float(rng.uniform(0.04, 0.1)), float(rng.uniform(0.6, 1.2))
    parameters = {'channels': [sensor.channel], 'share': share, 'period_s': period_s}
    effects = (loose(column, share, period_s),)
    return Drawn('loose_contact', parameters, effects, answers=('loose_contact', 'outliers'))


def _gain_ripple(unit: Unit, rng: np.random.Generator) -> Drawn:
    depth, period_s = float(rng.uniform(0.005, 0.02)), float(rng.uniform(1.0, 4.0))
    parameters = {'depth': depth, 'period_s': period_s}
    # The diagnosis has no oscillating gain, but one that varies over time.
    answers = ('tool_gain_drift', 'sensor_gain_drift')
    return Drawn('gain_ripple', parameters, (gain_ripple(depth, period_s),), answers=answers)


def _crossover(unit: Unit, rng: np.random.Generator) -> Drawn:
    column, sensor = _tool_sensor(unit, rng)
    dead_v = float(rng.uniform(0.01, 0.03))
    parameters = {'channel': sensor.channel, 'dead_v': dead_v}
    return Drawn('crossover', parameters, (crossing_over(column, dead_v),))


CATALOGUE: dict[str, Callable[[Unit, np.random.Generator], Drawn]] = {
    draws.__name__.removeprefix('_'): draws
    for draws in (
        _static_metal, _channel_crosstalk, _time_offset, _clock_rate, _sensor_axis, _sensor_gain,
        _saturation, _coil_drift, _loose_contact, _gain_ripple, _crossover,
    )
}  # fmt: skip


def draw(name: str, setup: Setup, channels: ChannelCalibration, rng: np.random.Generator) -> Drawn:
    """Draw the parameters of an effect, and the effect itself when `name` is ``random``.

    Raises `ParameterError` when there is no effect of that name.
    """
    if name == NONE:
        return Drawn(NONE, {})
    if name == RANDOM:
        name = str(rng.choice(sorted(CATALOGUE)))
    if name not in CATALOGUE:
        raise ParameterError(f'no effect {name!r}; there are: {", ".join(sorted(CATALOGUE))}')
    return CATALOGUE[name](Unit(setup, channels), rng)
