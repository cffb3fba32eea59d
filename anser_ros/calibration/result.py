"""Holds the result of a calibration, as records of effects and as ``calibration.json``. Of what
a joint fit of sensors found, some is corrected by the model, and some only reported.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.arrays import Array, ComplexArray, as_real
from anser_ros.calibration.disturbances import spans_of
from anser_ros.calibration.held_out import HeldOut, rms
from anser_ros.calibration.layouts import Layout
from anser_ros.calibration.moments import FitFigures
from anser_ros.calibration.population import FAR, OpticalNoise
from anser_ros.calibration.readings import FEWEST_SCAN_FRAMES, usable_readings
from anser_ros.calibration.selection import LayoutCandidate
from anser_ros.calibration.sensor_fit import SensorFit
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import SESSION, EffectRecord, FieldModel, plain
from anser_ros.physics.rotations import tilted
from anser_ros.settings import Accuracy

SPREADS = {
    'gains': 'sensor_gain_spread',
    'delays': 'sensor_delay_spread',
    'axes': 'sensor_axis_spread',
    'places': 'sensor_place_spread',
    'offsets': 'sensor_pickup_spread',
}
"""Names of the populations' effects."""
FEWEST_REFLECTED = 1e-3
"""Share of frames with a wrong optical pose from which on they are reported."""
UNITS = {
    'gains': (100.0, '%'), 'delays': (1e6, 'us'), 'axes': (1e3, 'mrad'), 'places': (1e3, 'mm'),
    'lever_arm': (1e3, 'mm'), 'time_offset': (1e3, 'ms'), 'clock_rate': (1e6, 'ppm'),
    'offsets': (100.0, '% of the fluxes'), 'registration': (1e3, 'mm'), 'mount': (1e3, 'mm'),
}  # fmt: skip
"""Factor and unit in which each kind of parameter is shown to people."""


def undetermined_words(result: SensorFit) -> tuple[str, ...]:
    """Return a line for every kind of parameter that the scan does not determine."""
    limits = {
        k: f'{_short(UNITS[k][0] * s)} {UNITS[k][1]}' for k, s in result.undetermined.items()
    }
    return tuple(
        f'{kind}: the scan determines it only to {limit}; the value of the setup is kept'
        for kind, limit in limits.items()
    )


def at_start(model: FieldModel) -> FieldModel:
    """Return a model that says for its file which strengths it has of emitters that change."""
    state = {'emitter_strengths': 'those at the start of each session'}
    return replace(model, provenance={**model.provenance, **state})


def drift_records(strength: ComplexArray) -> tuple[EffectRecord, ...]:
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
    records += [*_stands(result), *_clock(result)]
    # Wrong poses of the optical tracker, which it will have in other sessions as well.
    if result.reflected > FEWEST_REFLECTED:
        sigma = float(np.sqrt(result.reflected / max(result.optical.poses, 1.0)))
        records.append(
            EffectRecord('outliers', {'fraction': result.reflected}, {'fraction': sigma})
        )
    return tuple(records)


def _evidence(result: SensorFit, kind: str) -> dict[str, float]:
    return {'log_probability': result.evidence[kind]}


def _stands(result: SensorFit) -> list[EffectRecord]:
    """How each session's frame, and each body in it, stands about what all have in common."""
    parameters, out = result.parameters, list[EffectRecord]()

    def add(kind: str, name: str, session: str, **stated: Any) -> None:
        stated[SESSION] = Path(session).name
        out.append(EffectRecord(name, stated, {}, _evidence(result, kind)))

    def stand(kind: str, body: str, session: str) -> list[Array]:
        return np.split(parameters.stand(kind, body, session, result.posterior.values), 2)

    if 'registration' in result.evidence:
        for session in parameters.sessions['']:
            turn, shift = stand('registration', '', session)
            moved = -Rotation.from_rotvec(-turn).apply(shift)
            turned = np.degrees(-turn).tolist()
            add('registration', 'registration', session,
                rotation_deg=turned, translation_m=moved.tolist())  # fmt: skip
    for body, table in zip(parameters.bodies, parameters.tables, strict=True):
        for session in parameters.sessions[body] if 'mount' in result.evidence else ():
            turn, shift = stand('mount', body, session)
            turned = np.degrees(turn).tolist()
            channels = table.channel.tolist()
            add('mount', 'body_turned', session, channels=channels, rotation_deg=turned)
            add('mount', 'lever_arm', session, offset_m=shift.tolist(), body=body)
    return out


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
    alone = np.isin(rows[:, 0], result.alone[kind]) | (len(rows) == 1)  # one has no population
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
    if not keep.any():
        return [replace(one, evidence=record.evidence) for one in singles]
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
    elif kind == 'delays':
        name = SPREADS[kind]
        stated = {'channels': [channel], 'values': [value.tolist()]}
        sigmas = {'values': [sigma.tolist()]}
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


@dataclass(frozen=True)
class Residuals:
    """Holds the residuals of a model at the measured poses."""

    each_t: Array  # (K,): root mean square of the magnitude of each emitter's complex residual, T
    span_t: float  # range of the measured in-phase fluxes, T
    unexplained: float  # median magnitude of a residual over that of a reading
    read_t: float  # root mean square of the magnitude of a reading, T

    @property
    def rmse_t(self) -> float:
        """Return the root mean square over the readings of all emitters, T."""
        return float(np.sqrt(np.mean(self.each_t**2)))

    @classmethod
    def of(cls, left: ComplexArray, read: ComplexArray) -> 'Residuals':
        """Return what is ``left`` of what was ``read``, both (N, K), T."""
        size, whole = np.abs(left), np.abs(read)
        each_t, span_t = np.sqrt((size**2).mean(axis=0)), np.ptp(read.real)
        share = float(np.median(size) / np.median(whole))
        return cls(each_t, float(span_t), share, float(np.sqrt((whole**2).mean())))


def residuals(measurements: Sequence[Measurements], model: FieldModel) -> Residuals:
    """Return a model's residuals of the usable readings at the measured poses."""
    blocks = [
        (flux - model.flux(points, axes, lengths), flux)
        for points, axes, lengths, flux in usable_readings(measurements)
    ]
    left, read = (np.concatenate(part) for part in zip(*blocks, strict=True))
    return Residuals.of(left, read)


@dataclass(frozen=True)
class Scan:
    """Holds a scan as ideal sensors and an ideal clock would have given it."""

    measurements: tuple[Measurements, ...]  # the frames that are used, one per body and session
    accuracy: Accuracy  # noise and jitter, estimated where they were
    # what was wrong with sensors and clock; the model corrects it
    corrections: tuple[EffectRecord, ...] = ()
    reported_effects: tuple[EffectRecord, ...] = ()  # what the scan contained besides
    sensor_fit: SensorFit | None = None  # how that was found; None where nothing was estimated
    # standard deviation of what was taken off the fluxes, T a phasor component: the field that is
    # learnt from them is no better
    field_sigma_t: float = 0.0


@dataclass(frozen=True)
class Calibration:
    """Holds a field model with the figures of its fit and of its choice."""

    model: FieldModel
    fit: FitFigures  # of the moments, to all readings
    held_out: HeldOut  # of the chosen layout, with every fold fitted from the start
    layout: Layout  # chosen or given, as is the damping
    damping: float
    n_measurements: int  # readings of each emitter
    residuals: Residuals  # on all readings that the model was fitted to
    scan: Scan  # with what was wrong with it
    # root mean square of the magnitude of the nominal model's residual on the same readings, T
    nominal_rmse_t: float | None = None
    candidates: tuple[LayoutCandidate, ...] = ()  # all layouts that were compared
    # a line for everything of which two sessions disagree, or that a plate's places contradict
    contradictions: tuple[str, ...] = ()
    undetermined: tuple[str, ...] = ()  # lines on what the readings cannot determine
    # of each emitter how it differs from its drawing, where that was found, as plain data
    emitters: Sequence[Mapping[str, Any]] = ()
    # sections that only some engine's calibrations have in their document, as plain data
    more: Mapping[str, Any] = field(default_factory=dict)

    @property
    def better_than_nominal(self) -> bool:
        """Return whether the held-out error is below the nominal model's, or nothing compares."""
        return self.nominal_rmse_t is None or rms(self.held_out.error) < self.nominal_rmse_t


def with_provenance(calibration: Calibration, names: Sequence[str]) -> Calibration:
    """Return a calibration whose model says for its file how it was made, of named sessions."""
    held_out, figures = calibration.held_out, to_document(calibration)
    provenance = {
        'method': 'calibration',
        'sessions': list(dict.fromkeys(names)),
        'n_measurements': calibration.n_measurements,
        **{key: figures['choice'][key] for key in ('layout', 'damping', 'rank', 'condition')},
        'noise_t': calibration.fit.noise_t,
        'heldout_flux_rmse_t': figures['heldout_flux_rmse_t'],
        'heldout_marginal_rmse_t': figures['marginal']['heldout_component_rmse_t'],
        'heldout_chi_square': held_out.chi_square,
        'flux_error_t': calibration.model.flux_error_t,
        'nominal_flux_rmse_t': calibration.nominal_rmse_t,
    }
    return replace(calibration, model=replace(calibration.model, provenance=provenance))


OUTLIER_WEIGHT = 0.25
"""A reading whose weight fell below this counts as an outlier: its residual is twice as large as
the one from which on readings lose weight."""


def to_document(calibration: Calibration) -> dict[str, Any]:
    """Return the figures of a calibration as plain data.

    Errors are root mean squares of the complex residual's magnitude at the measured poses; the
    normalised ones are divided by the range of the measured in-phase fluxes (article, equation 8).
    """
    held_out, scan, fit = calibration.held_out, calibration.scan, calibration.fit
    inside, span = calibration.residuals, calibration.residuals.span_t
    each = zip(calibration.model.emitters, inside.each_t, held_out.error.T, strict=True)
    nominal = calibration.nominal_rmse_t
    drawn = calibration.emitters or [{}] * len(calibration.model.emitters)
    every = np.concatenate([w.ravel() for w in fit.weights])
    return {
        'schema': 'anser_calibration/1',
        'n_measurements': calibration.n_measurements,
        'n_dipoles': len(calibration.model.positions),
        'flux_rmse_t': inside.rmse_t,
        'heldout_flux_rmse_t': rms(held_out.error),
        'heldout_n_rmse_percent': 100.0 * rms(held_out.error) / span,
        'heldout_n_mae_percent': 100.0 * float(np.abs(held_out.error).mean()) / span,
        'emitters': [
            {'name': name, 'flux_rmse_t': float(inner), 'heldout_flux_rmse_t': rms(outer), **own}
            for (name, inner, outer), own in zip(each, drawn, strict=True)
        ],
        'marginal': {
            **{key: getattr(held_out, key) for key in ('noise_t', 'flux_noise_t', 'flux_error_t')},
            'heldout_component_rmse_t': float(np.sqrt(np.mean(as_real(held_out.left_over) ** 2))),
            'heldout_chi_square': held_out.chi_square,
            'fit_noise_t': fit.noise_t,
            'outlier_fraction': float((every[every > 0.0] < OUTLIER_WEIGHT).mean()),
        },
        **_by_pose(held_out),
        'choice': {
            'layout': calibration.layout.describe(),
            'damping': calibration.damping,
            **{key: getattr(fit, key) for key in ('rank', 'condition', 'freedom', 'alternations')},
            'curve': [
                {'layout': c.layout.describe(), 'n_dipoles': len(c.dipoles),
                 'damping': damping, 'heldout_t': score}
                for c in calibration.candidates for damping, score in c.curve
            ],
        },
        'nominal_flux_rmse_t': nominal,
        'effects': [_effect(record) for record in (*scan.corrections, *scan.reported_effects)],
        'unobservable': [
            *([] if scan.sensor_fit is None else undetermined_words(scan.sensor_fit)),
            *calibration.undetermined,
        ],
        **calibration.more,
        'shift_sigma_m': calibration.model.shift_sigma_m,
        'contradictions': list(calibration.contradictions),
        'optical_noise': None if scan.sensor_fit is None else _optical(scan.sensor_fit.optical),
    }  # fmt: skip


def _by_pose(held_out: HeldOut) -> dict[str, Any]:
    """Errors of single poses, where so few were recorded that each is worth a look."""
    if len(held_out.place) >= FEWEST_SCAN_FRAMES:
        return {}
    order = np.lexsort(held_out.place.T)
    pairs = [(held_out.place[k].tolist(), float(held_out.frame_rmse_t[k])) for k in order]
    return {'heldout_by_pose': [{'position_m': p, 'flux_rmse_t': e} for p, e in pairs]}


def _effect(record: EffectRecord) -> dict[str, Any]:
    parts = ('parameters', 'uncertainty', 'evidence')
    return {'name': record.name, **{part: plain(dict(getattr(record, part))) for part in parts}}


def _optical(noise: OpticalNoise) -> dict[str, Any]:
    sizes = {key: getattr(noise, key) for key in ('position_m', 'rotation_rad')}
    relative = noise.relative_uncertainty
    return {**sizes, 'uncertainty': {key: relative * size for key, size in sizes.items()}}
