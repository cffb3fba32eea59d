"""Tests what the residual of held-out poses still depends on."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.poses.problem import PosePart, PoseState

Array = NDArray[np.float64]

GROUPS = 6  # groups of neighbours by which a dependence is looked for
LEAST_OF_MEANS = 0.1
"""Share (0 to 1) of the squared residual that groups' means must explain beyond chance to be
reported; without it the error would be 5 % less."""
FEWEST_POSES = 30  # poses of a sensor by which a dependence is judged
TWICE = 1 / 3
"""Share by which halves of poses differ, of their sum, if one has twice the squared error of the
other; a tracker's error grows a little with the distance."""


def depends_on(state: PoseState) -> tuple[str, ...]:
    """Return names of what the residual depends on, the strongest first.

    The distance is that from the tracker's origin, which is at its field generator.
    """
    shares = {}
    parts = [part for part in state.parts if np.count_nonzero(part.used) > FEWEST_POSES]
    for name in ('time', 'position', 'orientation', 'speed', 'distance') if parts else ():
        shares[name] = float(np.median([_share(part, name) for part in parts]))
    if shares.get('distance', 0.0) < TWICE:
        shares.pop('distance', None)
    ordered = sorted(shares, key=lambda name: -shares[name])
    return tuple(name for name in ordered if shares[name] > LEAST_OF_MEANS)


def _share(part: PosePart, name: str) -> float:
    """Share of the squared residual that means of groups explain, less what chance gives."""
    used = part.used
    residual = part.residual[used, :3]
    if name in ('speed', 'distance'):
        values = part.view.velocity[:, :3] if name == 'speed' else part.view.measured
        along = np.linalg.norm(values[used], axis=1)
        size = np.sum(residual**2, axis=1)
        upper = along > np.median(along)
        if not upper.any():  # all is at rest
            return 0.0
        low, high = float(size[~upper].mean()), float(size[upper].mean())
        return max((high - low) / max(high + low, 1e-18), 0.0)
    groups = _groups(part, used, name)
    explained, count = 0.0, 0
    for group in np.unique(groups):
        rows = residual[groups == group]
        explained += len(rows) * float(np.sum(rows.mean(axis=0) ** 2))
        count += 1
    total = float(np.sum(residual**2))
    return explained / max(total, 1e-18) - count / max(len(residual), 1)


def _groups(part: PosePart, used: NDArray[np.bool_], name: str) -> NDArray[np.int64]:
    if name == 'time':
        time = part.view.time[used]
        return np.asarray(np.argsort(np.argsort(time)) * GROUPS**2 // time.size, dtype=np.int64)
    if name == 'position':
        values = part.view.measured[used]
    else:
        turns = Rotation.from_matrix(part.view.measured_rotation[used])
        values = (turns.mean().inv() * turns).as_rotvec()
    code = np.zeros(len(values), dtype=np.int64)
    for axis in range(3):
        rank = np.argsort(np.argsort(values[:, axis]))
        code = 4 * code + rank * 4 // len(values)
    return code
