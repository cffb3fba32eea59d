"""Records what a survey found: what a model corrects, and what is only reported."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.disturbances import spans_of
from anser_ros.calibration.population import FAR
from anser_ros.calibration.sensor_parameters import SensorParameters
from anser_ros.calibration.source_size import SourceSize
from anser_ros.calibration.survey_result import SurveyResult
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import EffectRecord
from anser_ros.field.symmetry import size_parameters
from anser_ros.physics.tangent import tilted

Array = NDArray[np.float64]

SPREADS = {
    'gains': 'sensor_gain_spread',
    'axes': 'sensor_axis_spread',
    'places': 'sensor_place_spread',
    'offsets': 'sensor_pickup_spread',
}
"""Names of the populations' effects."""
FEWEST_REFLECTED = 1e-3
"""Share of frames with a wrong optical pose from which on they are told."""


UNITS = {
    'gains': (100.0, '%'), 'axes': (1e3, 'mrad'), 'places': (1e3, 'mm'),
    'lever_arm': (1e3, 'mm'), 'time_offset': (1e3, 'ms'), 'clock_rate': (1e6, 'ppm'),
    'offsets': (100.0, '% of the fluxes'),
}  # fmt: skip
"""Factor and unit in which each kind of parameter is told to people."""


def undetermined_words(result: SurveyResult) -> tuple[str, ...]:
    """Return a line for every kind of parameter that the scan does not determine."""
    words = []
    for kind, size in result.undetermined.items():
        factor, unit = UNITS[kind]
        limit = f'{_short(factor * size)} {unit}'
        words.append(
            f'{kind}: the scan determines it only to {limit}; the value of the setup is kept'
        )
    return tuple(words)


def reversed_sensors(
    channels: NDArray[np.int64], evidence: Array, held_out: Array
) -> tuple[EffectRecord, ...]:
    """Return a record of the channels that are the wrong way round, none where there are none.

    ``evidence`` is the log probability of each over its opposite, ``held_out`` the same where the
    channel took no part.
    """
    if not channels.size:
        return ()
    found = {
        'log_probability': float(evidence.min()),
        'held_out_log_probability': float(held_out.min()),
    }
    return (EffectRecord('sensor_polarity', {'channels': channels.tolist()}, {}, found),)


def noisy_sensors(channels: NDArray[np.int64], ratios: Array) -> tuple[EffectRecord, ...]:
    """Return a record of each channel that is noisier than the median one by a ratio."""
    return tuple(
        EffectRecord('excess_noise', {'factor': ratio, 'channels': [channel]})
        for channel, ratio in zip(channels.tolist(), ratios.tolist(), strict=True)
    )


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


def size_records(sizes: Sequence[SourceSize]) -> tuple[EffectRecord, ...]:
    """Return a record of each emitter whose size the scan tells."""
    records = []
    for found in sizes:
        figures, sigmas = size_parameters(found.second_moment_m2, found.sigma_m2)
        evidence = {'heldout_point_t': found.point_t, 'heldout_sized_t': found.sized_t}
        records.append(
            EffectRecord('emitter_size', {'coil': found.emitter, **figures}, sigmas, evidence)
        )
    return tuple(records)


def contradiction_words(result: SurveyResult, names: Sequence[str]) -> tuple[str, ...]:
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


def corrections(result: SurveyResult) -> tuple[EffectRecord, ...]:
    """Return what the model knows of: sensors, lever arms and the optical tracker."""
    records: list[EffectRecord] = []
    for kind in SPREADS:
        if kind in result.evidence:
            records += _population(result, kind)
    parameters, found = result.parameters, result.posterior
    sigma = np.sqrt(np.maximum(np.diag(found.covariance), 0.0))
    for body in parameters.bodies:
        offset = parameters.of('lever_arm', body, found.values)
        if offset is not None and 'lever_arm' in result.evidence:
            width = parameters.of('lever_arm', body, sigma)
            records.append(
                EffectRecord(
                    'lever_arm',
                    {'offset_m': offset.tolist(), 'body': body},
                    {'offset_m': [] if width is None else width.tolist()},
                    _evidence(result, 'lever_arm'),
                )
            )
    return (*records, *_clock(result, sigma), *_reflected(result))


def _evidence(result: SurveyResult, kind: str) -> dict[str, float]:
    return {'log_probability': result.evidence[kind]}


def _reflected(result: SurveyResult) -> list[EffectRecord]:
    """Wrong poses of the optical tracker, which it will have in other sessions as well."""
    if result.reflected <= FEWEST_REFLECTED:
        return []
    sigma = float(np.sqrt(result.reflected / max(result.optical.poses, 1.0)))
    return [EffectRecord('outliers', {'fraction': result.reflected}, {'fraction': sigma})]


def _clock(result: SurveyResult, sigma: Array) -> list[EffectRecord]:
    parameters = result.parameters
    offset = parameters.of('time_offset', '', result.posterior.values)
    rate = parameters.of('clock_rate', '', result.posterior.values)
    if rate is not None and 'clock_rate' in result.evidence:
        survey = result.survey(parameters.bodies[0])
        of_rate = float(sigma[parameters.rows('clock_rate')][0])
        of_offset = float(sigma[parameters.rows('time_offset')].sum())
        return [
            EffectRecord(
                'clock_rate',
                {'offset_s': survey.offset_s, 'rate_ppm': 1e6 * survey.rate},
                {
                    'offset_s': float(np.hypot(of_offset, of_rate * parameters.middle_s)),
                    'rate_ppm': 1e6 * of_rate,
                },
                _evidence(result, 'clock_rate'),
            )
        ]
    if offset is None or 'time_offset' not in result.evidence:
        return []
    return [
        EffectRecord(
            'time_offset',
            {'offset_s': float(offset[0])},
            {'offset_s': float(sigma[parameters.rows('time_offset')][0])},
            _evidence(result, 'time_offset'),
        )
    ]


def _population(result: SurveyResult, kind: str) -> list[EffectRecord]:
    """The population's record, and one for each channel that stands outside it."""
    parameters, found = result.parameters, result.posterior
    rows = parameters.rows(kind).reshape(-1, parameters.each[kind])
    sigma = np.sqrt(np.maximum(np.diag(found.covariance), 0.0))[rows]
    unit = parameters.unit_t if kind == 'offsets' else 1.0
    values, sigma = unit * found.values[rows], unit * sigma
    channels = np.concatenate([table.channel for table in parameters.tables])
    alone = np.isin(rows[:, 0], result.alone[kind])
    records = [
        _single(parameters, kind, int(i), values[i], sigma[i]) for i in np.flatnonzero(alone)
    ]
    members = rows[~alone]
    width = unit * found.width[members[0]] if members.size else np.zeros(parameters.each[kind])
    # A width is known as well as that many squares of Gaussian numbers tell.
    relative = 1.0 / np.sqrt(2.0 * max(members.size / (2 if kind == 'gains' else 1), 1.0))
    keep, listed = ~alone, values
    stated = {'spread': float(width[0])}
    if kind == 'gains':
        listed = values + [1.0, 0.0]
        stated['phase_spread_rad'] = float(width[1])
        if found.shared > 0.0:
            stated['shared'] = found.shared
    more = {}
    if kind == 'axes':
        axes = np.concatenate([table.axis for table in parameters.tables])
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
    return [record, *records]


def _single(
    parameters: SensorParameters, kind: str, row: int, value: Array, sigma: Array
) -> EffectRecord:
    channels = np.concatenate([table.channel for table in parameters.tables])
    channel, evidence = int(channels[row]), {'widths_of_its_population': FAR}
    if kind == 'gains':
        gain = complex(1.0 + value[0], value[1])
        return EffectRecord(
            'sensor_gain',
            {
                'channel': channel,
                'gain': abs(gain),
                'phase_deg': float(np.degrees(np.angle(gain))),
            },
            {'gain': float(sigma[0]), 'phase_deg': float(np.degrees(sigma[1] / abs(gain)))},
            evidence,
        )
    if kind == 'offsets':
        return EffectRecord(
            'pickup',
            {'channel': channel, 'phasor_t': value.reshape(-1, 2).tolist()},
            {'phasor_t': sigma.reshape(-1, 2).tolist()},
            evidence,
        )
    if kind == 'places':
        return EffectRecord(
            'sensor_position',
            {'channels': [channel], 'offset_m': value.tolist()},
            {'offset_m': sigma.tolist()},
            evidence,
        )
    surveyed = np.concatenate([table.axis for table in parameters.tables])[row]
    return EffectRecord(
        'sensor_axis',
        {
            'channel': channel,
            'tilt_deg': float(np.degrees(np.arctan(np.linalg.norm(value)))),
            'axis': tilted(surveyed[None], value[None])[0].tolist(),
            'surveyed_axis': surveyed.tolist(),
        },
        {'tilt_deg': float(np.degrees(np.linalg.norm(sigma)))},
        evidence,
    )


def reported_effects(
    result: SurveyResult, measurements: Sequence[Measurements]
) -> tuple[EffectRecord, ...]:
    """Return what the scan alone contained: metal that moved.

    Parameters
    ----------
    result : SurveyResult
        The survey.
    measurements : sequence of Measurements
        What was surveyed, one per body and session.
    """
    spans = [
        span
        for whole, steady in zip(measurements, result.steady, strict=True)
        for span in spans_of(whole.time, ~steady)
    ]
    records = [
        EffectRecord('moving_metal', {'t_start_s': span.start_s, 't_end_s': span.end_s})
        for span in dict.fromkeys(spans)
    ]
    return tuple(records)
