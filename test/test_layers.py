"""Imports point inwards only, and each foreign library stays in its room.

Every file's syntax tree is walked, imports inside functions included.
"""

import ast
import re
from pathlib import Path

from conftest import by_room
from source_trees import nodes_of, tree_of

PACKAGE = Path(__file__).resolve().parents[1] / 'anser_ros'
FILES = sorted(PACKAGE.rglob('*.py'))
# What each package of the core may import of ours, itself and the modules beside them aside.
ALLOWED = {
    'physics': set(),
    'signals': set(),
    'wire': set(),
    'frames': {'physics', 'wire'},
    'field': {'physics'},
    'metal': {'field', 'physics'},
    'calibration': {'field', 'physics'},
    'integrity': {'frames', 'field', 'physics'},
    'refit': {'integrity', 'frames', 'field', 'metal', 'physics'},
    'effects': {'field', 'metal', 'physics'},
    'tracking': {'integrity', 'frames', 'effects', 'field', 'physics'},
    'chain': {'tracking', 'refit', 'integrity', 'effects', 'frames', 'field', 'physics'},
    'diagnosis': {'effects', 'field', 'metal', 'physics'},
    'sessions': {
        'wire', 'frames', 'integrity', 'diagnosis', 'chain', 'tracking', 'calibration', 'refit',
        'effects', 'field', 'physics',
    },
    'simulation': {'sessions', 'metal', 'physics', 'wire'},
    'api': {'simulation', 'sessions', 'tracking', 'calibration', 'field', 'physics', 'wire'},
    '__init__.py': {'api', 'sessions', 'wire'},
    'cli': {
        'simulation', 'sessions', 'diagnosis', 'tracking', 'calibration', 'refit', 'effects',
        'field', 'physics', 'signals', 'wire',
    },
    'nodes': {
        'simulation', 'sessions', 'chain', 'tracking', 'refit', 'integrity', 'effects', 'frames',
        'field', 'physics', 'signals', 'wire',
    },
}  # fmt: skip
APPS = {path.name for path in (PACKAGE / 'apps').iterdir() if (path / 'extension.py').is_file()}
# What the packages inside `nodes` may import of it; the programs beside them may import all.
WITHIN_NODES = {'runtime': set(), 'streams': {'runtime'}}
# Libraries that only some places may know.
NODES = ('nodes/', *(f'apps/{app}/nodes/' for app in APPS))
COMMANDS = ('cli/', *(f'apps/{app}/cli/' for app in APPS))
ROOMS = {
    'rclpy': NODES,
    'ament_index_python': NODES,
    'std_srvs': NODES,
    'serial': ('wire/port.py',),
    'mcap': ('wire/bag.py', 'wire/bag_files.py', 'wire/bag_writer.py'),
    'mcap_ros2': ('wire/bag.py', 'wire/bag_writer.py'),
    'pyigtl': (),
    'rich': (*NODES, *COMMANDS),
    'matplotlib': ('api/', 'apps/lab/experiments/', *COMMANDS),
    'magpylib': (),
    'nicegui': ('apps/dashboard/',),
    'fastapi': ('apps/dashboard/',),
    'uvicorn': ('apps/dashboard/',),
}


def place(path):
    return path.relative_to(PACKAGE).as_posix()


def imports(path, nodes=None):
    """Yield the full names that a file, or some nodes of it, import."""
    module = ('anser_ros', *path.relative_to(PACKAGE).with_suffix('').parts)
    for node in nodes_of(path) if nodes is None else nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = '.'.join(module[: -node.level]) if node.level else ''
            source = '.'.join(part for part in (base, node.module) if part)
            yield source
            yield from (f'{source}.{alias.name}' for alias in node.names)


def run_of(path):
    """Return the nodes of a file without what only a type checker reads."""
    return [
        node
        for top in tree_of(path).body
        if not (isinstance(top, ast.If) and ast.unparse(top.test) == 'TYPE_CHECKING')
        for node in ast.walk(top)
    ]


def is_ros(name):
    return name.endswith('_msgs') or name in ('rclpy', 'std_srvs')


def package_of(parts):
    """Return the package of a path or module, `apps.NAME` for one of an application's."""
    return f'apps.{parts[1]}' if parts[0] == 'apps' and len(parts) > 1 else parts[0]


@by_room(FILES)
def test_imports_of_ours_point_inwards(paths):
    """The core imports no application, and an application no other one."""
    beside, faults = {path.stem for path in PACKAGE.glob('*.py')}, []
    for path in paths:
        own = package_of(path.relative_to(PACKAGE).parts)
        if own.endswith('.py') and own != '__init__.py':
            allowed = {'apps'} if own == 'extensions.py' else set()
        elif own.removeprefix('apps.') in APPS:
            runs_ros = place(path).startswith(NODES)
            allowed = set(ALLOWED) - (set() if runs_ros else {'nodes'})
        elif own == 'apps':
            allowed = set()
        else:
            assert own in ALLOWED, f'{own} is no package of the core'
            allowed = ALLOWED[own]
        for name in imports(path):
            parts = name.split('.')[1:]
            if name.startswith('anser_ros.') and parts[0] not in beside:
                of = package_of(parts)
                if of != own and of not in allowed:
                    faults.append(f'{place(path)} imports {name}')
    assert not faults, '\n'.join(faults)


def test_no_package_imports_itself_in_a_circle():
    """A module is read after what it imports, down to those that import nothing; types aside."""
    names = {p: '.'.join(p.relative_to(PACKAGE.parent).with_suffix('').parts) for p in FILES}
    modules = set(names.values())
    below = {
        name: (set(imports(path, run_of(path))) & modules) - {name} for path, name in names.items()
    }
    while free := {name for name, of in below.items() if not of & set(below)}:
        below = {name: of for name, of in below.items() if name not in free}
    assert not below, sorted(below)


def test_parts_of_nodes_import_no_program():
    nodes = PACKAGE / 'nodes'
    packages = {path.name for path in nodes.iterdir() if (path / '__init__.py').is_file()}
    assert packages == set(WITHIN_NODES)
    faults = []
    for path in nodes.rglob('*/*.py'):
        room = path.relative_to(nodes).parts[0]
        for name in imports(path):
            parts = name.split('.')
            is_of_nodes = parts[:2] == ['anser_ros', 'nodes'] and len(parts) > 2
            if is_of_nodes and parts[2] not in WITHIN_NODES[room] | {room}:
                faults.append(f'{place(path)} imports {name}')
    assert not faults, '\n'.join(faults)


def test_the_page_has_the_same_table():
    """What a newcomer reads about the packages is what is enforced."""
    whole = (PACKAGE.parent / 'docs' / 'architecture.md').read_text(encoding='utf-8')
    page = whole[whole.index('## Where code lives') : whole.index('## What flows')]
    said = {
        name: set(re.findall(r'`(\w+)`', may))
        for name, may in re.findall(r'^\| `(\w+)` \| (.*?) \|', page, re.M)
    }
    assert said == {name: may for name, may in ALLOWED.items() if name != '__init__.py'}
    beside = {path.name for path in PACKAGE.glob('*.py')} - {'__init__.py'}
    assert set(re.findall(r'`(\w+\.py)`', page)) >= beside
    for app in APPS:
        assert (PACKAGE / 'apps' / app / 'README.md').is_file() and f'apps/{app}' in whole


@by_room(FILES)
def test_libraries_stay_in_their_packages(paths):
    faults = []
    for path in paths:
        for name in imports(path):
            library = name.split('.')[0]
            packages = NODES if is_ros(library) else ROOMS.get(library)
            if packages is not None and not place(path).startswith(packages):
                faults.append(f'{place(path)} imports {name}')
    assert not faults, '\n'.join(faults)


def test_broad_excepts_are_the_outermost():
    """`except Exception` that swallows stands only where a callback, a thread or all ends."""
    allowed = {
        'cli/main.py', 'nodes/runtime/node.py', 'nodes/runtime/process.py', 'nodes/replay.py',
    }  # fmt: skip
    for path in FILES:
        for node in nodes_of(path):
            if not isinstance(node, ast.ExceptHandler) or isinstance(node.body[-1], ast.Raise):
                continue
            kind = ast.unparse(node.type) if node.type else 'BaseException'
            broad = kind in ('Exception', 'BaseException')
            assert not broad or place(path) in allowed, f'{place(path)}:{node.lineno}'


def test_no_class_name_stands_twice():
    """One name is one concept: a class is found by its name alone."""
    places = {}
    for path in FILES:
        for node in tree_of(path).body:
            if isinstance(node, ast.ClassDef):
                places.setdefault(node.name, []).append(place(path))
    twice = {name: found for name, found in places.items() if len(found) > 1}
    assert not twice, twice
