"""Starts a fit from a session: blocks, a coarse time offset, two frames, swapped sensors."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses.effect import PoseSetting, PoseSite, PoseTerm, Role, effect_with
from anser_ros.apps.poses.fit import PoseFit, robust_fit
from anser_ros.apps.poses.problem import PoseNoise, PoseProblem, predicted
from anser_ros.apps.poses.sequence import OpticalPath, PoseSequence, PoseSession, jumping_poses
from anser_ros.arrays import Array, Booleans, Integers
from anser_ros.calibration.readings import fold_of_frames
from anser_ros.diagnosis.problem import BLOCKS, TEST_EVERY
from anser_ros.errors import DiagnosisError, FitError
from anser_ros.field.model import EffectRecord
from anser_ros.physics.pose_track import LONGEST_GAP_S, PoseTrack
from anser_ros.physics.rotations import nearest_rotation
from anser_ros.stamps import NANO

PAUSE_S = 2.0
"""Pause, s, that parts static recordings; where there are several, each is a block."""
AT_REST_M, POSES_AT_REST = 2e-3, 4
"""Extent of a recording at rest, m, and the poses of it that are kept."""
HAND_M = 0.1  # a hand's breadth, m: distance at which an angle counts as the displacement it makes
AT_REST_SHARE = 0.7  # share of poses in recordings at rest from which all is such
FEWEST_PARTS = 5  # recordings that make blocks of their own; fewer leave too few to hold out
FEWEST_HAND_EYE_POSES = 8  # poses with a reference: hand-eye has twelve unknowns, a pose gives six
MOST_POSES = 900
"""Poses of a sensor that are fitted at most: more add nothing of errors alike for seconds."""
GOLDEN = (5**0.5 - 1) / 2
"""Its multiples by squares, less whole numbers, are spread evenly, in step with no poll."""
COARSE_S, COARSE_STEP_S = 1.5, 0.05
"""Range and step of the first look for a time offset, s."""
SHORT_SHARE = 0.125
"""Largest offset that is looked for in a short recording, as a share of its length: a hand begins
a motion anew each second or two, and a few of them may be alike at a wrong time."""
COARSE_POSES = 300  # poses of that look; it takes a regression at each of its steps
FAR_STEP_S, FASTEST = 0.1, 3e-3
"""Step, s, of looks beyond that range and at clocks that run apart, by this share at most."""
LEAST_OVERLAP = 0.25  # share of the poses that must have a reference at an offset
ALIKE, UNLIKE = 0.8, 0.5
"""Correlation of one body's motions at the right time (chance: 0.5), and the share that must be
left of what another lacks of one: a clock that runs apart slowly leaves some of them alike."""
HAND_S = 0.3  # time, s, in which a hand turns and moves by what it is told by
COARSE_OFFSET_MISFIT = 0.8
"""Share of the misfit at no offset below which a coarse offset is taken; chance takes off 6 %."""
START_NOISE = PoseNoise(2e-3, 0.02)  # m, rad: of the first fit, which then finds its own


def pose_problem(session: PoseSession) -> PoseProblem:
    """Set a session up; without a reference the sensor with most poses takes its place.

    Raises `DiagnosisError` when there are too few poses.
    """
    sensors = dict(session.sensors)
    reference = session.reference
    if reference is None:
        name = max(sensors, key=lambda s: sensors[s].size)
        reference = sensors.pop(name)
        if not sensors:
            raise DiagnosisError(
                f'{session.path}: one sensor and no reference; there is nothing to compare'
            )
    reference = reference.rows(~jumping_poses(reference))
    path = OpticalPath.through(reference.track(), is_at_rest=is_at_rest(reference))
    sensors = {name: poses.rows(~poses.repeated) for name, poses in sensors.items()}
    starts = _pauses(list(sensors.values()))
    if starts.size + 1 >= FEWEST_PARTS:
        track, sensors, share = _recordings(reference, sensors, starts)
        if share > AT_REST_SHARE:
            path = OpticalPath.through(track, is_at_rest=True)
    thin = {name: _thinned(poses) for name, poses in sensors.items()}
    kept = {
        name: poses
        for name, poses in thin.items()
        if np.count_nonzero(path.at(poses.time)[3]) >= FEWEST_HAND_EYE_POSES
    }
    if not kept:
        words = f'no sensor has {FEWEST_HAND_EYE_POSES} poses at times with a reference'
        raise DiagnosisError(f'{session.path}: {_apart(session) or words}')
    everywhere = np.concatenate([poses.position for poses in kept.values()])
    centre = np.median(everywhere, axis=0)
    size = float(np.sqrt(np.mean(np.sum((everywhere - centre) ** 2, axis=1))))
    start = min(float(poses.time[0]) for poses in kept.values())
    end = max(float(poses.time[-1]) for poses in kept.values())
    setting = PoseSetting(tuple(kept), start, max(end - start, 1e-3), centre, max(size, 1e-3))
    values = tuple(kept.values())
    return PoseProblem(
        values,
        path,
        setting,
        _time_blocks(values, starts),
        _space_blocks(values, starts),
        tuple(np.ones(poses.size) for poses in values),
        tuple(START_NOISE for _ in values),
    )


def _apart(session: PoseSession) -> str:
    """Both intervals, where the reference's shares no time with that of the sensors."""
    tracked = [p.time for p in session.sensors.values() if p.size]
    if session.reference is None or not (tracked and session.reference.size):
        return ''
    first, last = min(float(t[0]) for t in tracked), max(float(t[-1]) for t in tracked)
    begin, end = (float(session.reference.time[k]) for k in (0, -1))
    if begin <= last and first <= end:
        return ''
    start = datetime.fromtimestamp(session.start_ns * NANO, UTC)
    dates = [start + timedelta(seconds=round(s)) for s in (first, last)]
    away, lasts = begin - first, end - begin
    return (
        f'{dates[0]:%Y-%m-%d %H:%M:%S} to {dates[1]:%H:%M:%S}, reference {abs(away):.1f} s '
        f'{"later" if away > 0.0 else "earlier"}, for {lasts:.0f} s: other time zones or epochs? '
        f'--shift {away:.1f} shifts the tracked ones of files'
    )


def is_at_rest(poses: PoseSequence) -> bool:
    """Return whether a body stays where it is: what differs between its poses is noise."""
    if not poses.size:
        return False
    turns = Rotation.from_quat(poses.quaternion)
    turned = HAND_M * (turns.mean().inv() * turns).as_rotvec()
    return _extent(np.concatenate([poses.position, turned], axis=1)) < AT_REST_M


def _extent(values: Array) -> float:
    return float(np.linalg.norm(np.ptp(np.percentile(values, [10, 90], axis=0), axis=0)))


def _thinned(poses: PoseSequence) -> PoseSequence:
    """At most `MOST_POSES` poses, one of a few neighbours, in no rhythm that a poll may have."""
    step = max(1, -(-poses.size // MOST_POSES))
    groups = np.arange(poses.size // step)
    return poses.rows(step * groups + (step * (GOLDEN * groups**2 % 1)).astype(np.int64))


def _pauses(sensors: Sequence[PoseSequence]) -> Array:
    """Times, s, at which recordings begin that a pause parts from the one before."""
    every = np.sort(np.concatenate([poses.time for poses in sensors]))
    return np.asarray(every[1:][np.diff(every) > PAUSE_S])


def _recordings(
    reference: PoseSequence, sensors: Mapping[str, PoseSequence], starts: Array
) -> tuple[PoseTrack, dict[str, PoseSequence], float]:
    """The reference's track, throughout each recording at rest; a few poses of these; their share:
    two programs that record one after the other share no time, and still the place.
    """
    streams = [reference, *sensors.values()]
    common = _pauses(streams)
    starts = common if common.size + 1 >= FEWEST_PARTS else starts
    number = [np.searchsorted(starts, p.time, side='right') for p in streams]
    pieces, resting = [], set()
    for one in np.unique(number[0]):
        rows = reference.rows(number[0] == one)
        if is_at_rest(rows):
            resting.add(one)
            every = np.concatenate(
                [p.time[n == one] for p, n in zip(streams, number, strict=True)]
            )
            steps = int(np.ptp(every) / (LONGEST_GAP_S / 2)) + 2
            time = np.linspace(every.min(), every.max() + 1e-6, steps)
            turn = Rotation.from_matrix(_middle(Rotation.from_quat(rows.quaternion))).as_quat()
            place = np.median(rows.position, axis=0)
            pieces.append((time, np.tile(place, (steps, 1)), np.tile(turn, (steps, 1))))
        else:
            track = rows.track()
            pieces.append((track.time, track.position, track.quaternion))
    kept, still = {}, 0
    for (name, poses), numbers in zip(sensors.items(), number[1:], strict=True):
        keep = [np.zeros(0, dtype=np.int64)]
        for one in np.unique(numbers):
            rest = np.flatnonzero(numbers == one)
            is_still = one in resting or _extent(poses.position[rest]) < AT_REST_M
            if is_still and rest.size > POSES_AT_REST:
                still += rest.size
                rest = rest[np.linspace(0, rest.size - 1, POSES_AT_REST).astype(int)]
            keep.append(rest)
        kept[name] = poses.rows(np.concatenate(keep))
    track = PoseTrack(*(np.concatenate(values) for values in zip(*pieces, strict=True)))
    return track, kept, still / max(sum(p.size for p in sensors.values()), 1)


def _time_blocks(sensors: Sequence[PoseSequence], starts: Array) -> tuple[Integers, ...]:
    """Equal stretches of time, of a long pause 10 s, or the recordings if there are several."""
    if starts.size + 1 >= FEWEST_PARTS:
        return tuple(np.searchsorted(starts, p.time, side='right') for p in sensors)
    every = np.unique(np.concatenate([poses.time for poses in sensors]))
    steps = np.diff(every, prepend=every[0])
    run = np.cumsum(np.minimum(steps, 5 * PAUSE_S))
    share = [np.interp(p.time, every, run) / max(float(run[-1]), 1e-9) for p in sensors]
    return tuple(np.minimum((BLOCKS * s).astype(np.int64), BLOCKS - 1) for s in share)


def _space_blocks(sensors: Sequence[PoseSequence], starts: Array) -> tuple[Integers, ...]:
    """Cells of space dealt to folds; blocks of time where all is at one place."""
    places = [poses.position for poses in sensors]
    every = np.concatenate(places)
    low, high = np.percentile(every, [1, 99], axis=0)
    try:
        return tuple(fold_of_frames([np.clip(p, low, high) for p in places]))
    except FitError:
        return _time_blocks(sensors, starts)


def train_blocks(problem: PoseProblem) -> tuple[Integers, Integers]:
    """Return blocks of time to choose and fit on, and those that are held out."""
    every = np.unique(np.concatenate(problem.blocks))
    held = np.arange(every.size) % TEST_EVERY == TEST_EVERY - 2
    return every[~held], every[held]


def coarse_clock(problem: PoseProblem) -> list[PoseTerm]:
    """Return the offset of a clock to start from, and its rate where it runs apart by far."""
    offset, rate = 0.0, 0.0
    if not problem.path.is_at_rest:
        offset, rate = _coarse_rate(problem, _coarse_offset(problem))
    clock = [PoseTerm(effect_with(Role.OFFSET), {}, np.array([offset]))]
    rates = effect_with(Role.RATE).sites(problem.setting) if rate else ()
    return [*clock, *(term.with_theta(np.array([1e3 * rate])) for term in rates)]


def _coarse_offset(problem: PoseProblem) -> float:
    """The offset, s, at which tracked places are most nearly linear in the optical pose, or if
    motions are not alike then that, within a recording's length, at which they are.
    """
    chosen = [p.rows(slice(None, None, max(1, p.size // COARSE_POSES))) for p in problem.sensors]
    longest = longest_recording(problem)
    reach = min(COARSE_S, SHORT_SHARE * longest)
    steps = round(reach / COARSE_STEP_S)
    trials = COARSE_STEP_S * np.arange(-steps, steps + 1)
    misfits = np.array([_misfit(problem.path, chosen, float(trial)) for trial in trials])
    still = float(misfits[np.argmin(np.abs(trials))])
    best = int(np.argmin(misfits))
    near = float(trials[best]) if misfits[best] < COARSE_OFFSET_MISFIT * still else 0.0
    far = np.arange(COARSE_S, longest if reach == COARSE_S else 0.0, FAR_STEP_S)
    return _most_alike(problem, near, [(float(o), 0.0) for o in (*-far, *far)], ALIKE)[0]


def _coarse_rate(problem: PoseProblem, offset: float) -> tuple[float, float]:
    """Offset, s, and rate (parts of one) of clocks that run apart by far in a session."""
    moved = 0.5 * problem.setting.duration  # by a rate of one, at the session's ends
    steps = np.arange(1, FASTEST * moved / FAR_STEP_S)
    rates = np.r_[-steps[::-1], 0, steps] * FAR_STEP_S / moved
    near = offset + np.arange(-COARSE_S, COARSE_S, FAR_STEP_S)
    trials = [(float(o), float(r)) for r in rates for o in near]
    return _most_alike(problem, offset, trials if steps.size else [], 1.0)


def longest_recording(problem: PoseProblem) -> float:
    """Return the length, s, of the longest recording of the reference that no pause interrupts."""
    knots = problem.path.knots
    ends = np.flatnonzero(np.diff(knots) > PAUSE_S)
    return float(np.max(knots[np.r_[ends, -1]] - knots[np.r_[0, ends + 1]]))


def _most_alike(
    problem: PoseProblem, offset: float, trials: Sequence[tuple[float, float]], enough: float
) -> tuple[float, float]:
    """The offset, s, and rate, of some, at which motions are more alike, if they are not enough.

    Ways and angles between two times are the same in all frames, but for lever arms.
    """
    pairs = []
    for poses in problem.sensors:
        later = np.searchsorted(poses.time, poses.time + HAND_S)
        rows = np.flatnonzero(later < poses.size)
        rows = rows[poses.time[later[rows]] - poses.time[rows] < 10 * HAND_S]
        rows = rows[:: max(1, rows.size * len(problem.sensors) // COARSE_POSES)]
        ends = poses.time[rows], poses.time[later[rows]]
        turns = Rotation.from_quat(poses.quaternion)
        turned = (turns[rows].inv() * turns[later[rows]]).magnitude()
        moved = np.linalg.norm(poses.position[later[rows]] - poses.position[rows], axis=1)
        pairs.append((ends, turned, moved))
    middle = problem.setting.start + 0.5 * problem.setting.duration

    def alike(trial: tuple[float, float]) -> float:
        return float(np.mean([_alike(problem.path, *pair, trial, middle) for pair in pairs]))

    here = alike((offset, 0.0))
    if here > enough or not trials:
        return offset, 0.0
    best = max(trials, key=alike)
    is_more = alike(best) > max(ALIKE, 1 - UNLIKE * (1 - here))
    return best if is_more else (offset, 0.0)


def _alike(
    path: OpticalPath, ends: tuple[Array, Array], turned: Array, moved: Array,
    clock: tuple[float, float], middle: float,
) -> float:  # fmt: skip
    """The larger correlation of ways and of angles between two times with the reference's."""
    offset, rate = clock
    one, other = (path.fixed(time - offset - rate * (time - middle)) for time in ends)
    known = one[3] & other[3]
    if np.count_nonzero(known) < max(FEWEST_HAND_EYE_POSES + 13, LEAST_OVERLAP * known.size):
        return 0.0
    way = np.linalg.norm(one[0] - other[0], axis=1)[known]
    cosine = np.abs(np.sum(one[1][known] * other[1][known], axis=1))
    angle = 2 * np.arccos(np.minimum(cosine, 1.0))
    return max(float(np.corrcoef(a, b)[0, 1]) if np.ptp(a) > 0 and np.ptp(b) > 0 else 0.0
               for a, b in ((way, moved[known]), (angle, turned[known])))  # fmt: skip


def _misfit(path: OpticalPath, sensors: Sequence[PoseSequence], offset: float) -> float:
    """Mean distance, m, of tracked places from a linear function of the optical pose."""
    total = 0.0
    for poses in sensors:
        place, turn, _, known = path.at(poses.time - offset)
        if np.count_nonzero(known) < FEWEST_HAND_EYE_POSES + 13:
            continue
        columns = np.concatenate(
            [np.ones((known.sum(), 1)), place[known], turn[known].reshape(-1, 9)], axis=1
        )
        columns -= columns.mean(axis=0) * (np.arange(13) > 0)
        columns /= np.linalg.norm(columns, axis=0) + 1e-12
        tracked, weight, size = poses.position[known], np.ones(len(columns)), np.zeros(0)
        for _ in range(3):  # towards the median: a few poses may be far off
            weighted = (columns * weight[:, None]).T
            normal = weighted @ columns
            normal += 1e-6 * np.trace(normal) / 13 * np.eye(13)
            size = np.linalg.norm(
                tracked - columns @ np.linalg.solve(normal, weighted @ tracked), axis=1
            )
            weight = 1 / np.maximum(size, 0.3 * np.median(size) + 1e-9)
            weight /= weight.mean()
        total += float(np.mean(size))
    return total if total > 0 else np.inf


def frames_from_places(tracked: Array, optical: Array) -> Array:
    """Return the rotation (3, 3) that takes optical places (n, 3) to tracked ones."""
    left, right = tracked - np.median(tracked, axis=0), optical - np.median(optical, axis=0)
    return nearest_rotation(left.T @ right)


def frames_from_turns(tracked: Array, optical: Array) -> Array:
    """Return the rotation (3, 3) from the optical frame to the tracker's, from quaternions alone.

    ``q_tracked = q_frame q_optical q_mount`` is a rotation of four dimensions, which splits into
    the two factors.
    """
    solution = _turn_of_turns(tracked, optical)
    # Of all products of units from the left and the right, how much of each is in it: a dyad.
    units = [Rotation.from_quat(unit) for unit in np.eye(4)]
    every, matrix = Rotation.from_quat(np.eye(4)), np.zeros((4, 4))
    for a, b in np.ndindex(4, 4):
        matrix[a, b] = np.sum((units[a] * every * units[b]).as_quat().T * solution)
    u, _, _ = np.linalg.svd(matrix)
    return np.asarray(Rotation.from_quat(u[:, 0]).as_matrix())


def turn_misfit(tracked: Array, optical: Array) -> float:
    """Return the median angle, rad, by which quaternions (n, 4) miss any frame and mount."""
    agreement = np.einsum('ij,ij->i', tracked, optical @ _turn_of_turns(tracked, optical).T)
    return float(np.median(2 * np.arccos(np.clip(np.abs(agreement), 0.0, 1.0))))


def _turn_of_turns(tracked: Array, optical: Array) -> Array:
    """The rotation (4, 4) of quaternions, found as any rotation is from pairs."""
    solution = np.eye(4)
    sign = np.ones(len(tracked))
    jumps = np.sign(np.einsum('ij,ij->i', tracked[1:], tracked[:-1]))
    jumps *= np.sign(np.einsum('ij,ij->i', optical[1:], optical[:-1]))
    sign[1:] = np.cumprod(np.where(jumps < 0, -1.0, 1.0))
    for _ in range(10):
        solution = nearest_rotation((tracked * sign[:, None]).T @ optical)
        agreement = np.sign(np.einsum('ij,ij->i', tracked, optical @ solution.T))
        if np.array_equal(agreement, sign):
            break
        sign = np.where(agreement == 0, 1.0, agreement)
    return np.asarray(solution)


def times_by(clock: Sequence[PoseTerm], poses: PoseSequence) -> Array:
    """Return the times, s, of poses on the reference's clock."""
    time = poses.time
    for term in clock:
        time = term.effect.clock(term, poses.name, time)
    return time


def started(
    problem: PoseProblem, clock: Sequence[PoseTerm], frame: Array | None = None
) -> list[PoseTerm]:
    """Return both frames and a clock to start from; a known registration is the identity."""
    pairs = []
    for poses in problem.sensors:
        place, turn, _, known = problem.path.at(times_by(clock, poses))
        pairs.append((poses.position[known], poses.rotation[known], place[known], turn[known]))
    terms: list[PoseTerm] = []
    rotation = np.eye(3) if frame is None else frame
    if frame is not None:
        apart = np.concatenate([p - o @ frame.T for p, _, o, _ in pairs if len(p)])
        shift = np.median(apart, axis=0)
        terms.append(effect_with(Role.REGISTRATION).at_frame({}, shift, frame))
    for poses, (_, turned, _, turn) in zip(problem.sensors, pairs, strict=True):
        mounts = Rotation.from_matrix(turn.transpose(0, 2, 1) @ (rotation.T @ turned))
        site: PoseSite = {'sensor': poses.name}
        terms.append(effect_with(Role.MOUNT).at_frame(site, np.zeros(3), _middle(mounts)))
    return [*terms, *clock]


def _middle(turns: Rotation) -> Array:
    """A rotation that most of some agree with: the mean, of those near it, some times over."""
    mean = turns.mean()
    for _ in range(5):
        angle = (mean.inv() * turns).magnitude()
        weight = 1 / np.maximum(angle, np.median(angle) + 1e-6) ** 2
        mean = turns.mean(weights=weight)
    return np.asarray(mean.as_matrix())


def first_fit(problem: PoseProblem, clock: Sequence[PoseTerm], is_one_frame: bool) -> PoseFit:
    """Return the best robust fit of the two frames from several starts."""
    frames = [None] if is_one_frame else _frames(problem, clock)
    fits = [robust_fit(problem, started(problem, clock, frame)) for frame in frames]
    return min(fits, key=first_cost)


def _frames(problem: PoseProblem, clock: Sequence[PoseTerm]) -> list[Array]:
    """The rotations to start from, by places and by turns."""
    poses = max(problem.sensors, key=lambda p: p.size)
    place, turn, _, known = problem.path.at(times_by(clock, poses))
    turned = Rotation.from_matrix(turn[known]).as_quat()
    return [
        frames_from_places(poses.position[known], place[known]),
        frames_from_turns(poses.quaternion[known], turned),
    ]


def first_cost(fit: PoseFit) -> float:
    """Return the median misfit of a sensor's poses, m, on average over the sensors.

    An angle counts as the displacement that it causes at a hand's breadth.
    """
    total = 0.0
    for part in fit.state.parts:
        far = np.linalg.norm(part.residual[:, :3], axis=1)
        far = far + HAND_M * np.linalg.norm(part.residual[:, 3:], axis=1)
        total += float(np.median(far[part.used])) if part.used.any() else 0.0
    return total / max(len(fit.state.parts), 1)


FAR, FITS = 8.0, 0.25
"""Distance of a pose from its own prediction, in spreads, from which it may be another sensor's,
and the share of it that is left from the other's prediction."""
EARLY = 0.4
"""Share of a session that says whose names are meant: smaller determines no lever arms."""
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
    """Return the session with sensors put back that were swapped for half of it, and the records.

    Nothing fits all of such a session. Its first part says whose poses are whose.
    """
    problem = pose_problem(session)
    blocks = np.unique(np.concatenate(problem.blocks))
    early = problem.in_blocks(blocks[: round(EARLY * blocks.size)])
    if len(problem.sensors) < 2 or session.reference is None:
        return session, []
    fit = first_fit(early, coarse_clock(early), False)
    return put_back(session, swapped_spans(problem, fit))


def _look_like(problem: PoseProblem, fit: PoseFit, i: int, j: int) -> tuple[Booleans, Booleans]:
    """Masks of the poses of sensor i that fit where j should be, and that rather fit there."""
    own = replace(problem, noise=fit.state.problem.noise).state(fit.terms).parts[i]
    renamed = replace(problem.sensors[i], name=problem.sensors[j].name)
    _, as_other, _ = predicted(problem.path, renamed, fit.terms)
    noise = replace(own.noise, stamp_s=0.0)
    here, there = (
        np.linalg.norm(noise.whitened(residual, own.view.velocity), axis=1)
        for residual in (own.residual, as_other)
    )
    return (here > FAR) & (there < FITS * here) & (own.weight > 0), there < here


def _runs(time: Array, mask: Booleans, rather: Booleans) -> list[tuple[float, float]]:
    """Spans in which a mask holds, as far as poses rather fit the other sensor."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    spans: list[tuple[float, float]] = []
    for a, b in edges.reshape(-1, 2).tolist():
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
        records.append(EffectRecord(effect.name, values, {}, effect.words))
    return replace(session, sensors=sensors), records


def _merged(
    own: PoseSequence, keep: Booleans, other: PoseSequence, take: Booleans
) -> PoseSequence:
    left, right = own.rows(keep), other.rows(take)
    both = replace(
        own,
        time=np.concatenate([left.time, right.time]),
        position=np.concatenate([left.position, right.position]),
        quaternion=np.concatenate([left.quaternion, right.quaternion]),
    )
    return both.rows(np.argsort(both.time, kind='stable'))
