"""Records what a joint fit of sensors found: what a model corrects, and what is only reported."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.disturbances import spans_of
from anser_ros.calibration.population import FAR
from anser_ros.calibration.sensor_fit import SensorFit
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import EffectRecord
from anser_ros.physics.rotations import tilted

Array = NDArray[np.float64]

SPREADS = {
    'gains': 'sensor_gain_spread',
    'axes': 'sensor_axis_spread',
    'places': 'sensor_place_spread',
    'offsets': 'sensor_pickup_spread',
}
"""Names of the populations' effects."""
FEWEST_REFLECTED = 1e-3
"""Share of frames with a wrong optical pose from which on they are reported."""
UNITS = {
    'gains': (100.0, '%'), 'axes': (1e3, 'mrad'), 'places': (1e3, 'mm'),
    'lever_arm': (1e3, 'mm'), 'time_offset': (1e3, 'ms'), 'clock_rate': (1e6, 'ppm'),
    'offsets': (100.0, '% of the fluxes'),
}  # fmt: skip
"""Factor and unit in which each kind of parameter is shown to people."""


def undetermined_words(result: SensorFit) -> tuple[str, ...]:
    """Return a line for every kind of parameter that the scan does not determine."""
    words = []
    for kind, size in result.undetermined.items():
        factor, unit = UNITS[kind]
        limit = f'{_short(factor * size)} {unit}'
        words.append(
            f'{kind}: the scan determines it only to {limit}; the value of the setup is kept'
        )
    return tuple(words)


def drift_records(strength: NDArray[np.complex128]) -> tuple[EffectRecord, ...]:
    """Return the emitters that drifted in a scan, from their strengths (F, K), and how far."""
    size = np.abs(strength)
    records = []
    for coil in np.flatnonzero((strength != 1.0).any(axis=0)).tolist():
        course = size[:, coil]
        way = float(course.max() - course.min())
        falls = int(np.argmax(course)) < int(np.argmin(course))
        records.append(
            EffectRecord('coil_drift', {'coil': coil, 'amount': -way if falls else way})
        )
    return tuple(records)


def contradiction_words(result: SensorFit, names: Sequence[str]) -> tuple[str, ...]:
    """Return a line for every parameter of which two of the named measurements disagree."""
    words = []
    for found in result.contradictions:
        factor, unit = UNITS[found.kind]
        one, other = (names[i] for i in found.sessions)
        words.append(
            f'{found.kind}{" of " if found.place else ""}{found.place}: {one} and {other} differ '
            f'by {_short(factor * found.size)} {unit} (known to {_short(factor * found.sigma)}); '
            'did something change between them?'
        )
    return tuple(words)


def _short(value: float) -> str:
    """Two digits, and no power of ten."""
    return f'{value:.0f}' if value >= 10.0 else f'{value:.2g}'


def corrections(result: SensorFit) -> tuple[EffectRecord, ...]:
    """Return what the model corrects: sensors, lever arms and the optical tracker."""
    records: list[EffectRecord] = []
    for kind in SPREADS:
        if kind in result.evidence:
            records += _population(result, kind)
    parameters, found = result.parameters, result.posterior
    for body in parameters.bodies:
        offset = parameters.of('lever_arm', body, found.values)
        width = parameters.of('lever_arm', body, found.sigma)
        if offset is not None and width is not None and 'lever_arm' in result.evidence:
            records.append(
                EffectRecord(
                    'lever_arm',
                    {'offset_m': offset.tolist(), 'body': body},
                    {'offset_m': width.tolist()},
                    _evidence(result, 'lever_arm'),
                )
            )
    records += _clock(result)
    # Wrong poses of the optical tracker, which it will have in other sessions as well.
    if result.reflected > FEWEST_REFLECTED:
        sigma = float(np.sqrt(result.reflected / max(result.optical.poses, 1.0)))
        records.append(
            EffectRecord('outliers', {'fraction': result.reflected}, {'fraction': sigma})
        )
    return tuple(records)


def _evidence(result: SensorFit, kind: str) -> dict[str, float]:
    return {'log_probability': result.evidence[kind]}


def _clock(result: SensorFit) -> list[EffectRecord]:
    """The rate and offset of the optical clock, or its offset alone."""
    parameters, values, sigma = result.parameters, result.posterior.values, result.posterior.sigma
    at_offset, at_rate = (parameters.rows(kind) for kind in ('time_offset', 'clock_rate'))
    if at_rate.size and 'clock_rate' in result.evidence:
        errors = result.errors_of(parameters.bodies[0])
        of_rate, of_offset = float(sigma[at_rate][0]), float(sigma[at_offset].sum())
        stated = {'offset_s': errors.offset_s, 'rate_ppm': 1e6 * errors.rate}
        sigmas = {
            'offset_s': float(np.hypot(of_offset, of_rate * parameters.middle_s)),
            'rate_ppm': 1e6 * of_rate,
        }
        return [EffectRecord('clock_rate', stated, sigmas, _evidence(result, 'clock_rate'))]
    if not at_offset.size or 'time_offset' not in result.evidence:
        return []
    offset, width = ({'offset_s': float(v[at_offset][0])} for v in (values, sigma))
    return [EffectRecord('time_offset', offset, width, _evidence(result, 'time_offset'))]


def _population(result: SensorFit, kind: str) -> list[EffectRecord]:
    """The population's record, and one for each channel that stands outside it."""
    parameters, found = result.parameters, result.posterior
    rows = parameters.rows(kind).reshape(-1, parameters.each[kind])
    unit = parameters.unit_t if kind == 'offsets' else 1.0
    values, sigma = unit * found.values[rows], unit * found.sigma[rows]
    channels = np.concatenate([table.channel for table in parameters.tables])
    axes = np.concatenate([table.axis for table in parameters.tables])
    alone = np.isin(rows[:, 0], result.alone[kind])
    singles = [
        _single(kind, int(channels[i]), axes[i], values[i], sigma[i])
        for i in np.flatnonzero(alone)
    ]
    members, keep = rows[~alone], ~alone
    width = unit * found.width[members[0]] if members.size else np.zeros(parameters.each[kind])
    # A width is known as well as that many squares of Gaussian numbers tell.
    relative = 1.0 / np.sqrt(2.0 * max(members.size / (2 if kind == 'gains' else 1), 1.0))
    stated, more, listed = {'spread': float(width[0])}, {}, values
    if kind == 'gains':
        listed = values + [1.0, 0.0]
        stated['phase_spread_rad'] = float(width[1])
        if found.shared > 0.0:
            stated['shared'] = found.shared
    if kind == 'axes':
        more = {'axes': tilted(axes, values)[keep].tolist()}
    record = EffectRecord(
        SPREADS[kind],
        {
            **stated,
            'channels': channels[keep].tolist(),
            'values': listed[keep].tolist(),
            'uncertainty': sigma[keep].tolist(),
            **more,
        },
        {'spread': float(width[0] * relative), 'values': sigma[keep].tolist()},
        _evidence(result, kind),
    )
    return [record, *singles]


def _single(kind: str, channel: int, axis: Array, value: Array, sigma: Array) -> EffectRecord:
    """The record of a channel with such an error of its own."""
    name, stated, sigmas = 'sensor_axis', dict[str, Any](channel=channel), dict[str, Any]()
    if kind == 'gains':
        gain = complex(1.0 + value[0], value[1])
        name = 'sensor_gain'
        stated |= {'gain': abs(gain), 'phase_deg': float(np.degrees(np.angle(gain)))}
        phase_deg = float(np.degrees(sigma[1] / abs(gain)))
        sigmas = {'gain': float(sigma[0]), 'phase_deg': phase_deg}
    elif kind == 'offsets':
        name = 'pickup'
        stated['phasor_t'] = value.reshape(-1, 2).tolist()
        sigmas = {'phasor_t': sigma.reshape(-1, 2).tolist()}
    elif kind == 'places':
        name = 'sensor_position'
        stated = {'channels': [channel], 'offset_m': value.tolist()}
        sigmas = {'offset_m': sigma.tolist()}
    else:
        stated |= {
            'tilt_deg': float(np.degrees(np.arctan(np.linalg.norm(value)))),
            'axis': tilted(axis[None], value[None])[0].tolist(),
            'surveyed_axis': axis.tolist(),
        }
        sigmas = {'tilt_deg': float(np.degrees(np.linalg.norm(sigma)))}
    return EffectRecord(name, stated, sigmas, {'widths_of_its_population': FAR})


def reported_effects(
    result: SensorFit, measurements: Sequence[Measurements]
) -> tuple[EffectRecord, ...]:
    """Return what the scan alone contained: metal that moved."""
    spans = [
        span
        for whole, steady in zip(measurements, result.steady, strict=True)
        for span in spans_of(whole.time, ~steady)
    ]
    return tuple(
        EffectRecord('moving_metal', {'t_start_s': span.start_s, 't_end_s': span.end_s})
        for span in dict.fromkeys(spans)
    )
