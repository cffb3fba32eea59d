"""Makes the document `accuracy.json`, and its figures as rows of text."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.assessment.control import Verdict
from anser_ros.assessment.history import SessionVerdict
from anser_ros.assessment.hummel import ErrorGroup
from anser_ros.assessment.intervals import IntervalEstimate, mitk_statistics
from anser_ros.assessment.protocols import Assessment
from anser_ros.physics.constants import DEGREES
from anser_ros.poses.document import finite

SCHEMA = 'anser_accuracy/1'
SHOWN_UNITS = (
    ('_m_per_h', 1e3, 'mm/h'), ('_rad_per_h', DEGREES, 'deg/h'), ('_m_s', 1e3, 'mm/s'),
    ('_m', 1e3, 'mm'), ('_rad', DEGREES, 'deg'), ('_s', 1e3, 'ms'),
)  # fmt: skip
"""Endings of figures' names, with the factor to the unit that is shown."""


def to_document(found: Assessment, verdict: SessionVerdict | None) -> dict[str, Any]:
    """Return the assessment as plain data, null where there is no number; judged by a verdict."""
    document: dict[str, Any] = {
        'schema': SCHEMA, 'protocol': found.protocol, 'body': found.body,
        'recordings': list(found.recordings), 'start_ns': found.start_ns,
        'figures': {name: _estimate(e) for name, e in found.estimates.items()},
        'groups': {name: _group(group) for name, group in found.groups.items()},
        'points': [
            {
                'begin_s': p.begin_s, 'end_s': p.end_s, 'n': p.n,
                'position_m': p.position.tolist(),
                'quaternion_xyzw': Rotation.from_matrix(p.rotation).as_quat().tolist(),
                'jitter_rms_m': p.jitter_m,
            }
            for p in found.points
        ],
        'allan': {
            axis: {
                'tau_s': c.tau_s.tolist(), 'deviation_m': c.deviation.tolist(),
                'low_m': c.low.tolist(), 'high_m': c.high.tolist(),
            }
            for axis, c in found.allan.items()
        },
        'speeds': [
            {
                'speed_low_m_s': g.low_m_s, 'speed_high_m_s': g.high_m_s,
                'speed_mean_m_s': g.mean_m_s, 'n': g.n, 'error_rms_m': _estimate(g.error_m),
                'error_live_rms_m': _estimate(g.error_live_m),
                'latency_s': _estimate(g.latency_s),
            }
            for g in found.speeds
        ],
        'notes': list(found.notes),
    }  # fmt: skip
    if verdict is not None:
        document['qa'] = {
            'state': verdict.state,
            'earlier_sessions': verdict.sessions,
            'figures': {name: _verdict(v) for name, v in verdict.figures.items()},
        }
    return dict(finite(document))


def _estimate(estimate: IntervalEstimate) -> dict[str, float]:
    return {'value': estimate.value, 'low': estimate.low, 'high': estimate.high}


def _group(group: ErrorGroup) -> dict[str, Any]:
    return {
        'unit': group.unit,
        'statistics': mitk_statistics(group.errors),
        'summary': {name: _estimate(e) for name, e in group.summary.items()},
        'errors': [
            {'description': words, 'distanceError': float(size), 'signedError': float(signed)}
            for words, size, signed in zip(
                group.descriptions, group.errors, group.signed, strict=True
            )
        ],
    }


def _verdict(verdict: Verdict) -> dict[str, Any]:
    limits = verdict.limits
    names = ('mean', 'sigma', 'note', 'alert')
    return {
        'state': verdict.state,
        'words': verdict.words,
        **{name: None if limits is None else getattr(limits, name) for name in names},
        'sessions': 0 if limits is None else limits.n,
        'tolerance': verdict.tolerance,
    }


def qa_words(qa: Mapping[str, Any]) -> str:
    """State in a line how a session compares with earlier ones."""
    words = [f'{name}: {one["words"]}' for name, one in qa['figures'].items() if one['words']]
    compared = f'{qa["state"]}, compared with {qa["earlier_sessions"]} earlier sessions'
    return ': '.join([compared, *filter(None, ['; '.join(words)])])


def figure_rows(found: Assessment, document: Mapping[str, Any]) -> list[tuple[str, str, str, str]]:
    """Return name, value with unit, interval, and state of every figure."""
    judged = document.get('qa', {}).get('figures', {})
    figures = dict(found.estimates)
    for name, group in found.groups.items():
        figures |= {f'{name}/{key}': estimate for key, estimate in group.summary.items()}
    return [
        (name, *_texts(one, *shown_unit(found, name)), judged.get(name, {}).get('state', ''))
        for name, one in figures.items()
    ]


def shown_unit(found: Assessment, name: str) -> tuple[float, str]:
    """Return the factor from a figure, by its name, to the unit that is shown, and that unit."""
    group = found.groups.get(name.rpartition('/')[0])
    if group is not None:
        return 1.0, group.unit
    for ending, scale, unit in SHOWN_UNITS:
        if name.endswith(ending):
            return scale, unit
    return 1.0, ''


def _texts(estimate: IntervalEstimate, scale: float, unit: str) -> tuple[str, str]:
    value = f'{scale * estimate.value:.4g} {unit}'
    if not np.isfinite(estimate.low):
        return value, '-'
    return value, f'{scale * estimate.low:.4g} .. {scale * estimate.high:.4g}'
