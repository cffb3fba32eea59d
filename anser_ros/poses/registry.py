"""Finds all effects of trackers of poses by looking, as those on fluxes are found."""

from functools import cache

import anser_ros.poses.effects as package
from anser_ros.effects.registry import effects_in
from anser_ros.poses.effect import PoseEffect


@cache
def pose_effects() -> dict[str, PoseEffect]:
    """Return every effect on poses by its name, in alphabetical order."""
    return effects_in(package)
