"""Makes the document ``calibration.json`` that a calibration writes (see docs/interfaces.md)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.factors import as_real
from anser_ros.calibration.held_out import HeldOut, rms
from anser_ros.calibration.optical_noise import OpticalNoise
from anser_ros.calibration.requirements import FEWEST_SCAN_FRAMES
from anser_ros.calibration.result import Calibration
from anser_ros.calibration.survey_records import undetermined_words
from anser_ros.field.model import EffectRecord
from anser_ros.field.plain_data import plain

OUTLIER_WEIGHT = 0.25
"""A reading whose weight fell below this counts as an outlier: its residual is twice as large as
the one from which on readings lose weight."""


def to_document(calibration: Calibration) -> dict[str, Any]:
    """Return the figures of a calibration as plain data.

    Errors are root mean squares of the complex residual's magnitude at the measured poses; the
    normalised ones are divided by the range of the measured in-phase fluxes (article, equation 8).
    """
    held_out, scan = calibration.held_out, calibration.scan
    inside, span = calibration.residuals, calibration.residuals.span_t
    each = zip(calibration.model.emitters, inside.each_t, held_out.error.T, strict=True)
    nominal = calibration.nominal_rmse_t
    return {
        'schema': 'anser_calibration/1',
        'n_measurements': calibration.n_measurements,
        'n_dipoles': len(calibration.model.positions),
        'flux_rmse_t': inside.rmse_t,
        'heldout_flux_rmse_t': rms(held_out.error),
        'heldout_n_rmse_percent': 100.0 * rms(held_out.error) / span,
        'heldout_n_mae_percent': 100.0 * float(np.abs(held_out.error).mean()) / span,
        'emitters': [
            {'name': name, 'flux_rmse_t': float(fitted), 'heldout_flux_rmse_t': rms(outside)}
            for name, fitted, outside in each
        ],
        'marginal': {
            'noise_t': held_out.noise_t,
            'flux_noise_t': held_out.flux_noise_t,
            'heldout_component_rmse_t': float(np.sqrt(np.mean(as_real(held_out.left_over) ** 2))),
            'heldout_chi_square': held_out.chi_square,
            'flux_error_t': held_out.flux_error_t,
            'fit_noise_t': calibration.fit.noise_t,
            'outlier_fraction': _outlier_fraction(calibration.fit.weights),
        },
        **_by_pose(held_out),
        'choice': {
            'layout': calibration.layout.describe(),
            'damping': calibration.damping,
            'rank': calibration.fit.rank,
            'condition': calibration.fit.condition,
            'freedom': calibration.fit.freedom,
            'alternations': calibration.fit.alternations,
            'curve': [
                {
                    'layout': c.layout.describe(),
                    'n_dipoles': len(c.dipoles),
                    'damping': damping,
                    'heldout_t': score,
                }
                for c in calibration.candidates
                for damping, score in c.curve
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
    }


def _by_pose(held_out: HeldOut) -> dict[str, Any]:
    """Errors of single poses, where so few were recorded that each is worth a look."""
    if len(held_out.place) >= FEWEST_SCAN_FRAMES:
        return {}
    order = np.lexsort(held_out.place.T)
    return {
        'heldout_by_pose': [
            {
                'position_m': held_out.place[k].tolist(),
                'flux_rmse_t': float(held_out.frame_rmse_t[k]),
            }
            for k in order
        ]
    }


def _effect(record: EffectRecord) -> dict[str, Any]:
    return {
        'name': record.name,
        'parameters': plain(dict(record.parameters)),
        'uncertainty': plain(dict(record.uncertainty)),
        'evidence': plain(dict(record.evidence)),
    }


def _optical(noise: OpticalNoise) -> dict[str, Any]:
    relative = noise.relative_uncertainty
    return {
        'position_m': noise.position_m,
        'rotation_rad': noise.rotation_rad,
        'uncertainty': {
            'position_m': relative * noise.position_m,
            'rotation_rad': relative * noise.rotation_rad,
        },
    }


def _outlier_fraction(weights: Sequence[NDArray[np.float64]]) -> float:
    every = np.concatenate([w.ravel() for w in weights])
    return float((every[every > 0.0] < OUTLIER_WEIGHT).mean())
