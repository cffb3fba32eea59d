"""Writes the document that a diagnosis leaves, as `docs/interfaces.md` promises it."""

from typing import Any

from anser_ros.diagnosis.schema import SCHEMA
from anser_ros.field.model import EffectRecord
from anser_ros.field.plain_data import plain
from anser_ros.sessions.diagnosis import SessionDiagnosis

DEPENDENCIES = (
    'time', 'position', 'orientation', 'speed', 'emitter', 'channel', 'amplitude', 'frequency',
)  # fmt: skip
"""Variables on which a remainder may depend in words; other tests are for the report only."""
MODEL_FILE_ONLY = ('groups', 'knots_s', 'course', 'couplings_m3')
"""Parameters that only a program needs: lists of hundreds of numbers. They are left out here and
stand in the model file."""


def to_document(result: SessionDiagnosis) -> dict[str, Any]:
    """Return what was found as plain data."""
    found, before, after = result.diagnosis, result.before, result.after
    return document_of(
        (found.flux_rms_before_t, found.flux_rms_after_t, found.flux_rms_floor_t),
        (before.position_rmse_m, after.position_rmse_m),
        (before.orientation_rmse_rad, after.orientation_rmse_rad),
        [effect_figures(one.record, one.flux_rms_without_t) for one in found.findings],
        (found.unexplained, [name for name in found.depends_on if name in DEPENDENCIES]),
    )


def document_of(
    flux_t: tuple[float, float, float],
    position_m: tuple[float | None, float | None],
    orientation_rad: tuple[float | None, float | None],
    effects: list[dict[str, Any]],
    unexplained: tuple[float, list[str]],
) -> dict[str, Any]:
    """Return the document of errors before and after, of effects, and of what is unexplained.

    Of fluxes there is the error of noise alone too; the last are the share that is unexplained,
    and what that depends on.
    """
    return {
        'schema': SCHEMA,
        'held_out': {
            'flux_rms_before_t': flux_t[0],
            'flux_rms_after_t': flux_t[1],
            'flux_rms_floor_t': flux_t[2],
            'position_rmse_before_m': position_m[0],
            'position_rmse_after_m': position_m[1],
            'orientation_rmse_before_rad': orientation_rad[0],
            'orientation_rmse_after_rad': orientation_rad[1],
        },
        'effects': effects,
        'unexplained': {'fraction': unexplained[0], 'depends_on': unexplained[1]},
    }


def effect_figures(record: EffectRecord, without_t: float) -> dict[str, Any]:
    """Return an effect as plain data; ``without_t``: held-out residual with all but it, T."""
    short = {key: value for key, value in record.parameters.items() if key not in MODEL_FILE_ONLY}
    return {
        'name': record.name,
        'parameters': plain(short),
        'uncertainty': plain(dict(record.uncertainty)),
        'evidence': plain(dict(record.evidence)),
        'flux_rms_without_t': without_t,
    }
