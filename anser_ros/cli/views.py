"""Write views of RViz, Foxglove, 3D Slicer for a setup: board, tools, coils, references, metal."""

import argparse
import copy
import json
import math
import re
from collections.abc import Iterator
from typing import Any, NamedTuple

import yaml

from anser_ros.cli.output import Result, Tell, add_json, add_out, make_folder, write_files
from anser_ros.errors import ParameterError
from anser_ros.wire.setup import SensorSpec, Setup, parse_setup, topic_of
from anser_ros.wire.text_files import read_config

SCHEMA = 'anser_views/1'
RVIZ, FOXGLOVE, SLICER = 'anser.rviz', 'foxglove_layout.json', 'slicer_view.py'
"""Files that are written; those of `config/`, of the demo's setup, are also what is begun with."""
CELL_M = 0.05
"""Side of a square of the grid that stands for the board, m: half a coil of the usual boards."""
UPRIGHT = 0.9
"""Least part along z of an axis whose coil is shown from the start: one of a cluster is enough."""
NAMESPACE = re.compile(r'^[A-Za-z_]\w*(/[A-Za-z_]\w*)*$')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = 'example: anser views config/demo_setup.yaml --namespace left --out views/'
    parser.add_argument('setup', help='setup document: a path, or a file of config/')
    add_out(parser)
    parser.add_argument('--namespace', default='anser', help='of the nodes (%(default)s)')
    parser.add_argument('--optical', default='/optical', help='namespace of the optical poses')
    parser.add_argument('--frame-prefix', default='', help="the tracker's, for several boards")
    words = 'also a scene of 3D Slicer that hides a tool without a pose'
    parser.add_argument('--slicer', action='store_true', help=words)
    add_json(parser, 'the written files as JSON')


def work(args: argparse.Namespace, tell: Tell) -> Result:
    space = args.namespace.strip('/')
    if not NAMESPACE.match(space):
        raise ParameterError(f'{args.namespace!r} is not a namespace')
    setup = parse_setup(read_config(args.setup))
    make_folder(args.out)
    topics = Topics(space, args.optical.rstrip('/'), f'{args.frame_prefix}{setup.frame_id}')
    rviz = yaml.safe_dump(rviz_view(setup, topics), sort_keys=False, allow_unicode=True)
    cut = {name: name[-20:] for name in (*setup.bodies, *(s.name for s in setup.tool_sensors))}
    notes = tuple(f'{n} is cut to {c}' for n, c in cut.items() if args.slicer and n != c)
    scene = re.sub('(?m)^DEVICES = .*', f'DEVICES = {[*cut.values()]}', read_config(SLICER))
    views = {RVIZ: rviz, FOXGLOVE: foxglove_view(setup, topics)}
    written = write_files(args.out, views | ({SLICER: scene} if args.slicer else {}))
    return Result({'schema': SCHEMA, 'files': list(map(str, written))}, notes, written=written)


class Topics(NamedTuple):
    """Holds full names: topics of the nodes and of the optical tracker, and the board's frame."""

    namespace: str
    optical_namespace: str
    frame: str

    def own(self, name: str) -> str:
        return f'/{self.namespace}/{name}'

    def pose(self, name: str, ending: str = 'pose') -> str:
        return self.own(f'{topic_of(name)}/{ending}')

    def optical(self, body: str) -> str:
        return f'{self.optical_namespace}/{topic_of(body)}/pose'


def _solid_bodies(setup: Setup) -> list[str]:
    """Bodies with coils enough for a pose of their own."""
    return [b for b in setup.bodies if sum(s.body == b for s in setup.tool_sensors) > 1]


def _is_shown(sensor: SensorSpec, setup: Setup) -> bool:
    return sensor.body not in _solid_bodies(setup) or abs(sensor.axis[2]) > UPRIGHT


def _cells(setup: Setup) -> int:
    reach = max(max(abs(c.centre_m[0]), abs(c.centre_m[1])) for c in setup.emitter.coils)
    return 2 * math.ceil(round((reach + CELL_M) / CELL_M, 6))


def rviz_view(setup: Setup, topics: Topics) -> dict[str, Any]:
    view: dict[str, Any] = yaml.safe_load(read_config(RVIZ))
    manager = view['Visualization Manager']
    manager['Displays'] = list(_displays(manager['Displays'], setup, topics))
    manager['Global Options']['Fixed Frame'] = topics.frame
    manager['Views']['Current']['Target Frame'] = topics.frame
    return view


def _displays(known: list[Any], setup: Setup, topics: Topics) -> Iterator[dict[str, Any]]:
    kind = 'rviz_default_plugins/'
    first = {name: next(d for d in known if d['Class'] == kind + name)
             for name in ('Grid', 'TF', 'PoseWithCovariance')}  # fmt: skip
    optical, *coils = [d for d in known if d['Class'] == f'{kind}Pose']
    clouds = [d for d in known if d['Class'] == f'{kind}PointCloud2']
    grid = copy.deepcopy(first['Grid'])
    grid.update({'Reference Frame': topics.frame, 'Plane Cell Count': _cells(setup)})
    yield grid
    yield first['TF']
    for body in _solid_bodies(setup):
        topic = topics.pose(body, 'pose_with_covariance')
        yield _display(first['PoseWithCovariance'], body, topic)
    for body in setup.bodies:
        yield _display(optical, f'{body}, optical', topics.optical(body))
    for sensor in setup.tool_sensors:
        topic = topics.pose(sensor.name)
        yield _display(coils[0], sensor.name, topic, _is_shown(sensor, setup))
    for cloud, name in zip(clouds, ('field_model', 'reference/flux'), strict=True):
        yield _display(cloud, cloud['Name'], topics.own(name))
    yield {
        'Class': f'{kind}MarkerArray', 'Name': 'Metal', 'Enabled': True, 'Value': True,
        'Namespaces': {},
        'Topic': {**copy.deepcopy(clouds[0]['Topic']), 'Value': topics.own('metal')},
    }  # fmt: skip


def _display(known: dict[str, Any], name: str, topic: str, shown: bool = True) -> dict[str, Any]:
    made = copy.deepcopy(known)
    made.update({'Name': name, 'Enabled': shown, 'Value': shown})
    made['Topic']['Value'] = topic
    return made


def foxglove_view(setup: Setup, topics: Topics) -> dict[str, Any]:
    view: dict[str, Any] = json.loads(read_config(FOXGLOVE))
    panels = view['configById']
    scene = panels['3D!tool']
    scene['followTf'] = scene['layers']['board']['frameId'] = topics.frame
    cells = _cells(setup)
    scene['layers']['board'].update({'size': CELL_M * cells, 'divisions': cells})
    known = list(scene['topics'].values())
    body_style = next(t for t in known if t.get('showCovariance'))
    optical_style = next(t for t in known if t.get('type') == 'arrow')
    coil_style = next(t for t in known if t.get('axisScale', 1) < body_style['axisScale'])
    model_style, reference_style = (t for t in known if 'pointShape' in t)
    bodies = _solid_bodies(setup)
    shown = {topics.pose(body, 'pose_with_covariance'): body_style for body in bodies}
    shown |= {topics.optical(body): optical_style for body in setup.bodies}
    for sensor in setup.tool_sensors:
        shown[topics.pose(sensor.name)] = {**coil_style, 'visible': _is_shown(sensor, setup)}
    others = {'field_model': model_style, 'reference/flux': reference_style}
    shown |= {topics.own(name): style for name, style in others.items()}
    scene['topics'] = shown | {topics.own('metal'): {'visible': True}}
    plotted = bodies[0] if bodies else setup.tool_sensors[0].name
    panels['Plot!position']['title'] = f'Position of {plotted}'
    plots = {'Plot!position': 'pose', 'Plot!variance': 'pose_with_covariance'}
    for panel, ending in plots.items():
        for path in panels[panel]['paths']:
            field = path['value'].split('.', 1)[1]
            path['value'] = f'{topics.pose(plotted, ending)}.{field}'
    panels['DiagnosticStatusPanel!tracker']['selectedName'] = f'{topics.namespace}/tracker'
    return view
