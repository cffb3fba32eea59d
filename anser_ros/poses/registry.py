"""Finds all effects of trackers of poses by looking, as those on fluxes are found."""

from functools import cache

import anser_ros.poses.effects as package
from anser_ros.effects.registry import effects_in
from anser_ros.field.model import EffectRecord
from anser_ros.poses.effect import PoseEffect, Role


@cache
def pose_effects() -> dict[str, PoseEffect]:
    """Return every effect on poses by its name, in alphabetical order."""
    return effects_in(package)


@cache
def effect_with(role: Role) -> PoseEffect:
    """Return the effect that has a role."""
    return next(effect for effect in pose_effects().values() if effect.role is role)


def effect_of_record(record: EffectRecord) -> PoseEffect:
    """Return the effect of a record; one that changes nothing where none has its name."""
    return pose_effects().get(record.name, PoseEffect())
