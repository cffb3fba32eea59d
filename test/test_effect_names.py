"""Effects declare what the rest needs to know of them: nothing outside asks for one by name.

Every file's syntax tree is walked. Left out are files that speak of effects without the classes in
`anser_ros/effects`, each for the reason that stands beside it.
"""

import ast
import importlib
import inspect
import pkgutil

from conftest import REPO
from source_trees import nodes_of

import anser_ros.apps.poses.effects as pose_package
import anser_ros.effects as package
from anser_ros.apps.poses.effect import pose_effects
from anser_ros.effects.base import BaseEffect, BaseTerm
from anser_ros.effects.effect import all_effects

PACKAGE = REPO / 'anser_ros'
ALLOWED = {
    'effects/': 'their own room',
    'simulation/': 'faults of a simulated nature, labelled with what a diagnosis should call them',
    'apps/lab/measured/': 'recipes count the effects that the commands named',
    'apps/poses/effects/': 'the room of effects of trackers that give poses alone',
    'calibration/sensor_parameters.py': 'parameters of a fit below the effects, as they are named',
    'calibration/result.py': 'writes records as `docs/interfaces.md` names them, from '
    'below the effects: a scan finds what is wrong with itself by its own fit',
    'apps/lab/one_place.py': 'the same, of a body of many sensors at one place',
    'apps/lab/calibration_engines.py': 'the same, of the sizes of magnets',
}
GENERAL = {'base', 'correction', 'effect'}
"""Modules in the room of effects that are about no single one; others may import these."""
MAY_IMPORT = {
    'diagnosis/wiring.py': {'seen', 'sensors'},
    'diagnosis/diagnose.py': {'seen'},
    'diagnosis/fit.py': {'metal_at_rest'},
    'diagnosis/departure.py': {'moving_metal'},
    'apps/poses/diagnosis.py': {'episodes'},
}
"""Modules of single effects that a file may import, as it makes their terms without the search:
wiring, quarter turns, noise and outliers are seen directly, as no fit could propose them;
the remainder is fitted beside metal at rest, whichever effect that is; departed metal is asked for
by a calibration alone, from a way that no search starts from; a map of space is searched again
without the poses of episodes."""
FILES = sorted(
    path
    for path in PACKAGE.rglob('*.py')
    if not path.relative_to(PACKAGE).as_posix().startswith(tuple(ALLOWED))
)


ROOMS = package, pose_package


def members(base, package):
    """The names of all classes of a room of effects that derive from a base."""
    found = set()
    for info in pkgutil.iter_modules(package.__path__):
        module = importlib.import_module(f'{package.__name__}.{info.name}')
        found |= {
            name
            for name, value in inspect.getmembers(module, inspect.isclass)
            if issubclass(value, base) and value.__module__.startswith(package.__name__)
        }
    return found


NAMES = {*all_effects(), *pose_effects(), 'metal_remainder'}
BASES = BaseEffect, BaseTerm
CLASSES = {name for room in ROOMS for base in BASES for name in members(base, room)}


def special_cases(nodes):
    """Yield the line and text of each effect's name, and each test for an effect's class."""
    for node in nodes:
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value in NAMES:
            yield f'{node.lineno}: {node.value!r}'
        elif isinstance(node, ast.Call) and _named(node.func) in ('isinstance', 'issubclass'):
            kinds = {_named(part) for part in ast.walk(node.args[1])}
            yield from (f'{node.lineno}: isinstance of {kind}' for kind in kinds & CLASSES)
        elif isinstance(node, ast.Compare) and 'type' in {
            _named(part.func) for part in ast.walk(node) if isinstance(part, ast.Call)
        }:
            kinds = {_named(part) for part in ast.walk(node)}
            yield from (f'{node.lineno}: type is {kind}' for kind in kinds & CLASSES)
        elif isinstance(node, ast.MatchClass) and _named(node.cls) in CLASSES:
            yield f'{node.lineno}: case {_named(node.cls)}'


def imports_of_effects(nodes):
    """Yield the module in a room of effects that an import names."""
    for node in nodes:
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [f'{node.module}.{alias.name}' for alias in node.names]
        for name in names:
            for room in ROOMS:
                if name.startswith(f'{room.__name__}.'):
                    yield name.removeprefix(f'{room.__name__}.').split('.')[0]


def _named(node):
    if isinstance(node, ast.Attribute):
        return node.attr
    return node.id if isinstance(node, ast.Name) else ''


def test_no_effect_is_a_special_case_outside_its_room():
    found = [f'{path}: {case}' for path in FILES for case in special_cases(nodes_of(path))]
    assert not found, f'let the effect declare it (anser_ros/effects/effect.py): {found}'


def test_no_module_of_a_single_effect_is_imported_outside_its_room():
    found = {}
    for path in PACKAGE.rglob('*.py'):
        place = path.relative_to(PACKAGE).as_posix()
        if not place.startswith(('effects/', 'apps/poses/effects/')):
            single = set(imports_of_effects(nodes_of(path))) - GENERAL
            found |= {place: single} if single else {}
    assert found == MAY_IMPORT


def test_what_a_site_holds_is_known_to_the_effects_alone():
    """Others ask a term for its channels, seat or label, and an effect on poses for its sensor."""
    for path in set(FILES) - {PACKAGE / 'apps' / 'poses' / 'effect.py'}:
        nodes = nodes_of(path)
        lines = [n.lineno for n in nodes if isinstance(n, ast.Attribute) and n.attr == 'site']
        assert not lines, f'{path}: {lines}'
