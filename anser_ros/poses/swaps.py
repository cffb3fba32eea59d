"""Finds sensors exchanged for a while by whose prediction each pose fits, and puts them back."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from anser_ros.field.model import EffectRecord
from anser_ros.poses.effect import Role
from anser_ros.poses.fit import PoseFit
from anser_ros.poses.problem import PoseProblem
from anser_ros.poses.registry import effect_with
from anser_ros.poses.sequence import PoseSequence, PoseSession
from anser_ros.poses.start import coarse_offset, first_fit, pose_problem

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FAR, FITS = 8.0, 0.25
"""Distance of a pose from its own prediction, in spreads, from which it may be another sensor's,
and the share of it that is left from the other's prediction."""
EARLY = 0.4
"""Share of a session by which the sensors' names are meant, where they are exchanged for half of
it. Smaller determines no lever arms; larger meets the exchange itself."""
NEAR_S = 1.0  # s; nearer spans are one: nobody swaps two plugs and back in a second
FEWEST, LEAST_SHARE = 5, 0.01  # poses in a span, and share of a sensor's poses, that are a swap


def swapped_spans(
    problem: PoseProblem, fit: PoseFit
) -> list[tuple[str, str, list[tuple[float, float]]]]:
    """Return pairs of sensors, and the spans (s) in which each gives the other's poses."""
    found = []
    for a, b in combinations(range(len(problem.sensors)), 2):
        (mask, rather), (other, _) = (_look_like(problem, fit, *pair) for pair in ((a, b), (b, a)))
        if min(float(mask.mean()), float(other.mean())) < LEAST_SHARE:
            continue
        spans = _runs(problem.sensors[a].time, mask, rather)
        if spans:
            found.append((problem.sensors[a].name, problem.sensors[b].name, spans))
    return found


def untangled(session: PoseSession) -> tuple[PoseSession, list[EffectRecord]]:
    """Return the session with sensors put back that were exchanged for about half of it, and the
    records of it; as it is if there are none.

    Nothing fits all of such a session. Its first part says whose poses are whose.
    """
    problem = pose_problem(session)
    blocks = np.unique(np.concatenate(problem.blocks))
    early = problem.in_blocks(blocks[: round(EARLY * blocks.size)])
    if len(problem.sensors) < 2 or session.reference is None:
        return session, []
    fit = first_fit(early, coarse_offset(early), False)
    return put_back(session, swapped_spans(problem, fit))


def _look_like(problem: PoseProblem, fit: PoseFit, i: int, j: int) -> tuple[Mask, Mask]:
    """Masks of the poses of sensor i that fit where sensor j should be, and that rather fit there
    than where i should be."""
    problem = replace(problem, noise=fit.state.problem.noise)
    own = problem.state(fit.terms).parts[i]
    sensors = list(problem.sensors)
    sensors[i] = replace(sensors[i], name=problem.sensors[j].name)
    as_other = replace(problem, sensors=tuple(sensors)).state(fit.terms).parts[i]
    noise = replace(own.noise, stamp_s=0.0)
    here, there = (
        np.linalg.norm(noise.whitened(part.residual, own.view.velocity), axis=1)
        for part in (own, as_other)
    )
    return (here > FAR) & (there < FITS * here) & (own.weight > 0), there < here


def _runs(time: Array, mask: Mask, rather: Mask) -> list[tuple[float, float]]:
    """Spans in which a mask holds, as far as poses rather fit the other sensor."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    runs = zip(edges[::2], edges[1::2], strict=True)
    spans: list[tuple[float, float]] = []
    for first, last in runs:
        a, b = int(first), int(last)
        while a > 0 and rather[a - 1]:
            a -= 1
        while b < time.size and rather[b]:
            b += 1
        start, end = float(time[a]), float(time[b - 1])
        if spans and start - spans[-1][1] < NEAR_S:  # a pose between that could be either's
            start = spans.pop()[0]
        spans.append((start, end))
    least = (FEWEST - 1) * float(np.median(np.diff(time)))
    return [(start, end) for start, end in spans if end - start >= least]


def put_back(
    session: PoseSession, swaps: Sequence[tuple[str, str, list[tuple[float, float]]]]
) -> tuple[PoseSession, list[EffectRecord]]:
    """Return the session with exchanged poses under their own names, and the records of it."""
    sensors, records = dict(session.sensors), []
    for one, other, spans in swaps:
        left, right = sensors[one], sensors[other]
        gap = 0.5 * float(np.median(np.diff(left.time)))
        masks = [
            np.any([(p.time > a - gap) & (p.time < b + gap) for a, b in spans], axis=0)
            for p in (left, right)
        ]
        sensors[one] = _merged(left, ~masks[0], right, masks[1])
        sensors[other] = _merged(right, ~masks[1], left, masks[0])
        share = float(np.mean(masks[0]))
        values = {'sensors': [one, other], 'fraction': share, 'spans': [list(s) for s in spans]}
        effect = effect_with(Role.SWAP)
        evidence = {'summary': effect.summary, 'remedy': 'the names are put back'}
        records.append(EffectRecord(effect.name, values, {}, evidence))
    return replace(session, sensors=sensors), records


def _merged(own: PoseSequence, keep: Mask, other: PoseSequence, take: Mask) -> PoseSequence:
    time = np.concatenate([own.time[keep], other.time[take]])
    order = np.argsort(time, kind='stable')
    return replace(
        own,
        time=time[order],
        position=np.concatenate([own.position[keep], other.position[take]])[order],
        quaternion=np.concatenate([own.quaternion[keep], other.quaternion[take]])[order],
    )
