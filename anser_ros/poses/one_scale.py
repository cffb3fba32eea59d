"""Judges whether all sensors see one scale, as they do if it is the reference's."""

from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.special import ndtri

from anser_ros.poses.effect import Role
from anser_ros.poses.fit import PoseFit, fit_poses

SAME_SCALE = 1 / 370
"""Chance that noise makes the scales of any two sensors of one reference differ so much: of one
pair, three standard deviations. Larger takes noise for a difference; smaller misses some."""
SCALE_DIFFERS = 0.003  # difference of scales that matters: 1 mm in a tracked volume


def is_one_scale(fit: PoseFit) -> bool:
    """Return whether each sensor alone sees the same scale as the others do."""
    problem, found = fit.state.problem, []
    if len(problem.sensors) < 2:
        return True
    for i, poses in enumerate(problem.sensors):
        alone = replace(
            problem,
            **{key: getattr(problem, key)[i : i + 1]
               for key in ('sensors', 'blocks', 'places', 'weight', 'noise')},
        )  # fmt: skip
        # A map of its own would take up what differs.
        terms = [
            t for t in fit.terms
            if t.acts_on(poses.name) and t.role is not Role.MAP
        ]  # fmt: skip
        one = fit_poses(alone, terms)
        index = next(k for k, t in enumerate(one.terms) if t.role is Role.SCALE)
        scale = 1e-3 * float(one.terms[index].theta[0])
        found.append((scale, 1e-3 * float(np.sqrt(one.covariance_of(index)[0, 0]))))
    pairs = list(combinations(found, 2))
    times = -float(ndtri(SAME_SCALE / (2 * len(pairs))))
    return all(
        abs(scale - other) <= max(times * float(np.hypot(sigma, apart)), SCALE_DIFFERS)
        for (scale, sigma), (other, apart) in pairs
    )
