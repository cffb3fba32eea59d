"""All effects of trackers of poses, found by looking, as those on fluxes are."""

import importlib
import pkgutil
from functools import cache

import anser_ros.poses.effects as package
from anser_ros.errors import ModelFileError
from anser_ros.poses.effect import PoseEffect


@cache
def pose_effects() -> dict[str, PoseEffect]:
    """Every effect on poses by its name, in alphabetical order."""
    found: dict[str, PoseEffect] = {}
    for info in pkgutil.iter_modules(package.__path__):
        module = importlib.import_module(f'{package.__name__}.{info.name}')
        for effect in getattr(module, 'EFFECTS', ()):
            if effect.name in found:
                raise ValueError(f'two effects are called {effect.name!r}')
            found[effect.name] = effect
    return dict(sorted(found.items()))


def pose_effect_named(name: str) -> PoseEffect:
    """The effect with a name; raises `ModelFileError` when there is none."""
    try:
        return pose_effects()[name]
    except KeyError:
        raise ModelFileError(f'model: no effect on poses is called {name!r}') from None
