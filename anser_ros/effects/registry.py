"""Finds all effects by looking: those that the modules of this package list as `EFFECTS`."""

import importlib
import pkgutil
from functools import cache
from types import ModuleType
from typing import Any

import anser_ros.effects
from anser_ros.effects.effect import Effect
from anser_ros.errors import ModelFileError


@cache
def all_effects() -> dict[str, Effect[Any]]:
    """Return every effect by its name, in alphabetical order."""
    return effects_in(anser_ros.effects)


def effects_in(package: ModuleType) -> dict[str, Any]:
    """Return the effects that the modules of a package define, by name in alphabetical order."""
    found: dict[str, Any] = {}
    for info in pkgutil.iter_modules(package.__path__):
        module = importlib.import_module(f'{package.__name__}.{info.name}')
        for effect in getattr(module, 'EFFECTS', ()):
            if effect.name in found:
                raise ValueError(f'two effects are called {effect.name!r}')
            found[effect.name] = effect
    return dict(sorted(found.items()))


def effect_named(name: str) -> Effect[Any]:
    """Return the effect with a name; raises `ModelFileError` when there is none."""
    try:
        return all_effects()[name]
    except KeyError:
        raise ModelFileError(f'model: no effect is called {name!r}') from None
