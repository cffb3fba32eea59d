"""Metal that is known from one recording, followed in others by the tools alone.

Recorded sessions are compared with the optical pose, which jitters by 0.12 mm; an ``ok`` pose is
over three sigmas if it is farther off than three times its sigma and the jitter. No reference
takes part in what is evaluated. Every fourth frame.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial

import harness
from bench_references import judged, thinned
from bench_refit import JITTER_M

from anser_ros.apps.lab.metal_follower import KnownMetalModels
from anser_ros.apps.lab.metal_lattice import KnownMetal
from anser_ros.apps.lab.metal_learning import learn
from anser_ros.field.model import FieldModel
from anser_ros.sessions.prepared import prepare
from anser_ros.sessions.session import Session, load_session
from anser_ros.sessions.tracked_session import track_session

EVERY = 4
PAIRS = (
    ('online/approach', ('online/sweep', 'effects/s05', 'effects/s01')),
    ('online/sweep', ('online/approach', 'effects/s05', 'effects/s01')),
)
"""The session in which the head is learnt, and those in which it is followed: the same head on
another way, other metal, and none."""
TARGETS_MM = {'online/sweep': 1.0, 'online/approach': 3.0}


def rows() -> Iterator[harness.Row]:
    """All figures; none without the recordings."""
    scan, paths = harness.online_recordings()
    if 'online/sweep' not in paths:
        return
    model = harness.calibrated(load_session(scan), layout=None)
    for learnt, followed in PAIRS:
        began_s = time.perf_counter()
        known = learn(prepare(load_session(paths[learnt]), model, load_session(scan)), 'head')
        yield from of_learning(learnt, known, time.perf_counter() - began_s)
        for name in followed:
            yield from of_following(learnt, known, name, load_session(paths[name]), model)


def of_learning(learnt: str, known: KnownMetal, spent_s: float) -> Iterator[harness.Row]:
    """Rows about what was learnt."""
    yield harness.row(f'head of {learnt}: learnt in', spent_s, 's')
    yield harness.row(f'head of {learnt}: left of the references', known.misfit, '1')


def of_following(
    learnt: str, known: KnownMetal, name: str, session: Session, model: FieldModel
) -> Iterator[harness.Row]:
    """Rows about a session in which it is followed."""
    session = thinned(session, EVERY)
    began_s = time.perf_counter()
    found = track_session(session, model, models=partial(KnownMetalModels, known=known))
    spent_s = (time.perf_counter() - began_s) / len(session.tools[0].time)
    for what, series in (('coils', found.sensors), ('body', found.bodies)):
        figures = judged(list(series.values()), JITTER_M)
        about = f'head of {learnt} in {name}, no references, {what}'
        target = TARGETS_MM.get(name) if what == 'body' else None
        yield harness.row(f'{about}: position RMSE', figures['rms'], 'mm', target=target)
        yield harness.row(f'{about}: withheld', figures['withheld'], '1')
        share = figures['over'] / max(figures['poses'], 1)
        yield harness.row(f'{about}: over 3 sigma', share, '1', target=0.003)
    yield harness.row(f'head of {learnt} in {name}: a frame', spent_s, 's')
