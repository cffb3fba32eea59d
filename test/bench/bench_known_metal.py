"""Metal that is known from one recording, followed in others by the tools alone.

Recorded sessions are compared with the optical pose, which jitters by 0.12 mm; an ``ok`` pose is
over three sigmas if it is farther off than three times its sigma and the jitter. No reference
takes part in what is evaluated. Every fourth frame.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path[1:1] = [str(HERE.parents[1]), str(HERE), str(HERE / 'world')]

from bench_references import judged, thinned  # noqa: E402
from bench_refit import JITTER_M, recordings  # noqa: E402

from anser_ros.apps.lab.metal_follower import KnownMetalModels  # noqa: E402
from anser_ros.apps.lab.metal_lattice import KnownMetal  # noqa: E402
from anser_ros.apps.lab.metal_learning import learn  # noqa: E402
from anser_ros.calibration.calibrate import Options  # noqa: E402
from anser_ros.field.model import FieldModel  # noqa: E402
from anser_ros.sessions.calibration import calibrate_sessions  # noqa: E402
from anser_ros.sessions.prepared import prepare  # noqa: E402
from anser_ros.sessions.session import Session, load_session  # noqa: E402
from anser_ros.sessions.tracked_session import track_session  # noqa: E402

EVERY = 4
PAIRS = (
    ('online/approach', ('online/sweep', 'effects/s05', 'effects/s01')),
    ('online/sweep', ('online/approach', 'effects/s05', 'effects/s01')),
)
"""The session in which the head is learnt, and those in which it is followed: the same head on
another way, other metal, and none."""
TARGETS_MM = {'online/sweep': 1.0, 'online/approach': 3.0}


def rows() -> Iterator[dict[str, Any]]:
    """All figures; none without the recordings."""
    scan, paths = recordings()
    if 'online/sweep' not in paths:
        return
    model = calibrated(scan)
    for learnt, followed in PAIRS:
        began_s = time.perf_counter()
        known = learn(prepare(load_session(paths[learnt]), model, load_session(scan)), 'head')
        yield from of_learning(learnt, known, time.perf_counter() - began_s)
        for name in followed:
            yield from of_following(learnt, known, name, load_session(paths[name]), model)


def calibrated(scan: Path) -> FieldModel:
    """The model of the sessions' board."""
    return calibrate_sessions([load_session(scan)], Options()).model


def of_learning(learnt: str, known: KnownMetal, spent_s: float) -> Iterator[dict[str, Any]]:
    """Rows about what was learnt."""
    yield {'name': f'head of {learnt}: learnt in', 'value': spent_s, 'unit': 's'}
    yield {
        'name': f'head of {learnt}: left of the references', 'value': known.misfit, 'unit': '1'
    }  # fmt: skip


def of_following(
    learnt: str, known: KnownMetal, name: str, session: Session, model: FieldModel
) -> Iterator[dict[str, Any]]:
    """Rows about a session in which it is followed."""
    session = thinned(session, EVERY)
    began_s = time.perf_counter()
    found = track_session(session, model, models=partial(KnownMetalModels, known=known))
    spent_s = (time.perf_counter() - began_s) / len(session.tools[0].time)
    for what, series in (('coils', found.sensors), ('body', found.bodies)):
        figures = judged(list(series.values()), JITTER_M)
        about = f'head of {learnt} in {name}, no references, {what}'
        target = TARGETS_MM.get(name) if what == 'body' else None
        yield {
            'name': f'{about}: position RMSE', 'value': figures['rms'], 'unit': 'mm',
            'target': target,
        }  # fmt: skip
        yield {'name': f'{about}: withheld', 'value': figures['withheld'], 'unit': '1'}
        share = figures['over'] / max(figures['poses'], 1)
        yield {'name': f'{about}: over 3 sigma', 'value': share, 'unit': '1', 'target': 0.003}
    yield {'name': f'head of {learnt} in {name}: a frame', 'value': spent_s, 'unit': 's'}
