"""Imports point inwards only, and each foreign library stays in its room.

Every file's syntax tree is walked, imports inside functions included.
"""

import ast
import html
import re
import runpy
import tomllib
from pathlib import Path

from conftest import by_room
from source_trees import nodes_of, tree_of

PACKAGE = Path(__file__).resolve().parents[1] / 'anser_ros'
FILES = sorted(PACKAGE.rglob('*.py'))
CORE = {
    'physics', 'signals', 'wire', 'frames', 'field', 'metal', 'calibration', 'refit', 'effects',
    'known_metal', 'tracking', 'diagnosis', 'sessions', 'integrity', 'poses', 'assessment',
}  # fmt: skip
# What each layer may import of ours, itself and the errors aside.
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
    'known_metal': {'refit', 'field', 'physics'},
    'effects': {'field', 'metal', 'physics'},
    'tracking': {'integrity', 'frames', 'effects', 'field', 'physics'},
    'diagnosis': {'effects', 'field', 'metal', 'physics'},
    'sessions': {
        'wire', 'frames', 'integrity', 'diagnosis', 'tracking', 'calibration', 'refit', 'effects',
        'known_metal', 'field', 'metal', 'physics',
    },
    'poses': {'sessions', 'diagnosis', 'calibration', 'effects', 'field', 'physics', 'wire'},
    'assessment': {'poses', 'sessions', 'tracking', 'field', 'physics', 'wire'},
    'simulation': {'sessions', 'effects', 'field', 'metal', 'physics', 'signals', 'wire'},
    'measured': CORE,
    'experiments': {*CORE, 'simulation', 'measured'},
    'api': CORE,
    '__init__.py': {'api', 'sessions', 'wire'},
    'cli': {*CORE, 'simulation', 'measured', 'experiments'},
    'web': {*CORE, 'cli'},
    'nodes': {*CORE, 'simulation', 'web'},
}  # fmt: skip
# What the rooms inside `nodes` may import of each other; the programs beside them may import all.
WITHIN_NODES = {
    'runtime': set(),
    'streams': {'runtime'},
    'acquisition_parts': {'runtime', 'streams'},
    'field_model_parts': {'runtime', 'streams'},
    'tracker_parts': {'runtime', 'streams'},
    'bag_parts': {'runtime', 'streams'},
    'watcher_parts': {'runtime', 'streams'},
    'output_parts': {'runtime', 'streams'},
}
# Libraries that only some places may know.
ROOMS = {
    'rclpy': ('nodes/',),
    'ament_index_python': ('nodes/',),
    'std_srvs': ('nodes/',),
    'serial': ('wire/port.py', 'wire/port.py'),
    'mcap': ('wire/bag.py', 'wire/bag_writer.py'),
    'mcap_ros2': ('wire/bag.py', 'wire/bag_writer.py'),
    'pyigtl': (),
    'rich': ('nodes/', 'cli/'),
    'matplotlib': ('pictures.py', 'experiments/', 'cli/'),
    'dask': ('cli/batch.py',),
    'distributed': ('cli/batch.py',),
    'magpylib': (),
    'nicegui': ('web/',),
    'fastapi': ('web/',),
    'uvicorn': ('web/',),
}


def place(path):
    return path.relative_to(PACKAGE).as_posix()


def imports(path):
    """Yield the full names that a file imports."""
    module = ('anser_ros', *path.relative_to(PACKAGE).with_suffix('').parts)
    for node in nodes_of(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = '.'.join(module[: -node.level]) if node.level else ''
            source = '.'.join(part for part in (base, node.module) if part)
            yield source
            yield from (f'{source}.{alias.name}' for alias in node.names)


def is_ros(name):
    return name.endswith('_msgs') or name in ('rclpy', 'std_srvs')


@by_room(FILES)
def test_imports_of_ours_point_inwards(paths):
    modules, faults = {path.stem for path in PACKAGE.glob('*.py')}, []
    for path in paths:
        layer = path.relative_to(PACKAGE).parts[0]
        if layer.endswith('.py'):  # errors.py knows nothing; __init__.py names what is public
            allowed, layer = ALLOWED['__init__.py'] if layer == '__init__.py' else set(), ''
        else:
            assert layer in ALLOWED, f'{layer} is no layer'
            allowed = ALLOWED[layer]
        for name in imports(path):
            parts = name.split('.')
            is_ours = parts[0] == 'anser_ros' and len(parts) > 1 and parts[1] not in modules
            if is_ours and parts[1] != layer and parts[1] not in allowed:
                faults.append(f'{place(path)} imports {name}')
    assert not faults, '\n'.join(faults)


def test_parts_of_a_node_import_no_other_node():
    nodes = PACKAGE / 'nodes'
    rooms = {path.name for path in nodes.iterdir() if (path / '__init__.py').is_file()}
    assert rooms == set(WITHIN_NODES)
    faults = []
    for path in nodes.rglob('*/*.py'):
        room = path.relative_to(nodes).parts[0]
        for name in imports(path):
            parts = name.split('.')
            is_of_nodes = parts[:2] == ['anser_ros', 'nodes'] and len(parts) > 2
            if is_of_nodes and parts[2] not in WITHIN_NODES[room] | {room}:
                faults.append(f'{place(path)} imports {name}')
    assert not faults, '\n'.join(faults)


def test_the_picture_of_the_rooms_has_the_arrows_of_the_table():
    repository = PACKAGE.parent
    arrows = runpy.run_path(str(repository / '.ci' / 'draw_rooms.py'))['arrows_of'](ALLOWED)
    picture = html.unescape((repository / 'docs' / 'rooms.svg').read_text(encoding='utf-8'))
    assert set(re.findall(r'<title>(\w+)->(\w+)</title>', picture)) == arrows


def test_the_page_has_the_same_table_and_every_file():
    """What a newcomer reads about the rooms is what is enforced."""
    page = (PACKAGE.parent / 'docs' / 'architecture.md').read_text(encoding='utf-8')
    page = page[page.index('## Where code lives') :]
    core = re.search(r'\*The core\* is (.*?)\.\n', page, re.DOTALL)
    assert set(re.findall(r'`(\w+)`', core[1])) == CORE
    told = {}
    for rooms, may in re.findall(r'^\| (`.*?) \| (.*?) \|', page.split('### Inside')[0], re.M):
        names = set(re.findall(r'`(\w+)`', may)) | (CORE if 'the core' in may else set())
        told |= dict.fromkeys(re.findall(r'`(\w+)`', rooms), names)
    for room, names in told.items():
        assert names - {room} == ALLOWED[room] - {room}, room
    assert {*told, '__init__.py'} == set(ALLOWED)
    beside = {path.name for path in PACKAGE.glob('*.py')} - {'__init__.py'}
    assert set(re.findall(r'`(\w+\.py)`', page.split('### Inside')[0])) >= beside
    inside = page.split('### Inside')[1]
    assert {path.stem for path in (PACKAGE / 'nodes').glob('[!_]*.py')} <= set(
        re.findall(r'`(\w+)`', inside)
    )
    for room in WITHIN_NODES:
        row = re.search(rf'^\| `{room}` .*', inside, re.M)
        files = {path.stem for path in (PACKAGE / 'nodes' / room).glob('[!_]*.py')}
        assert set(re.findall(r'`(\w+)`', row[0])) >= files, room


def test_types_are_strict_everywhere():
    """As CONTRIBUTING.md says; only calls of rclpy, which has types in part, are excepted."""
    settings = tomllib.loads((PACKAGE.parent / 'pyproject.toml').read_text(encoding='utf-8'))
    mypy = settings['tool']['mypy']
    assert mypy['strict']
    assert mypy['files'] == ['anser_ros']
    excepted = {
        name: set(rule) - {'module'}
        for rule in mypy['overrides']
        for name in rule['module']
        if name.startswith('anser_ros')
    }
    assert excepted == {'anser_ros.nodes.*': {'disallow_untyped_calls'}}


@by_room(FILES)
def test_libraries_stay_in_their_rooms(paths):
    faults = []
    for path in paths:
        for name in imports(path):
            library = name.split('.')[0]
            rooms = ('nodes/',) if is_ros(library) else ROOMS.get(library)
            if rooms is not None and not place(path).startswith(rooms):
                faults.append(f'{place(path)} imports {name}')
    assert not faults, '\n'.join(faults)


def test_the_walk_sees_imports_everywhere(tmp_path):
    """A guard on the guard: relative, aliased and local imports are all found."""
    text = 'import a.b as c\ndef f():\n    from ..x import y\nfrom . import z\n'
    path = PACKAGE / 'wire' / 'unwritten.py'

    class Text(type(path)):
        def read_text(self, encoding=None):
            return text

    found = set(imports(Text(path)))
    assert {'a.b', 'anser_ros.x', 'anser_ros.x.y', 'anser_ros.wire.z'} <= found


def test_broad_excepts_are_the_outermost():
    """`except Exception` that swallows stands only where a callback, a thread or all ends."""
    allowed = {
        'cli/main.py',
        'nodes/runtime/node.py',
        'nodes/runtime/process.py',
        'nodes/replay.py',
    }
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
