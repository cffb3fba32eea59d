"""Writes config/sros2_policy.xml: what each node publishes, hears and serves, and nothing more.

The nodes are made in this process, told a setup, and asked what they have on the graph. With a
setup of your own as argument the policy is of its sensors and bodies: `.ci/write_policy.py
SETUP.yaml`.
"""

import contextlib
import importlib
import os
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from anser_ros.apps.poses.corrector import MODEL_SCHEMA
from anser_ros.cli.commands import COMPOSED
from anser_ros.cli.commands import NODES as ALL_NODES

os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')

POLICY = Path(__file__).resolve().parents[1] / 'config' / 'sros2_policy.xml'
SIMULATED = ('cu_simulator', 'grid', 'replay')
"""What belongs on no graph that is secured: simulations, and the guide through a plate, which is
gone through before. All other nodes of the package have an enclave."""
NODES = tuple(node for node in ALL_NODES if node not in SIMULATED)
TRANSFORMS = (('tracker', 'publish'), ('recorder', 'subscribe'))
"""Who has to do with transforms: they are there only where tf2_msgs is installed."""
SETTLES_S = 60.0
"""Longest time, s, for all topics of a setup to appear."""
KINDS = (
    ('topics', 'publish', 'topic', 'get_publisher_names_and_types_by_node'),
    ('topics', 'subscribe', 'topic', 'get_subscriber_names_and_types_by_node'),
    ('services', 'reply', 'service', 'get_service_names_and_types_by_node'),
    ('services', 'request', 'service', 'get_client_names_and_types_by_node'),
)
"""Groups of a profile: tags, verb, and the question that fills it."""


def policy(setup_file: str = 'demo_setup.yaml') -> str:
    """Return the policy of a setup; rclpy must be initialised."""
    graph = _graph(setup_file)
    enclaves = {node: _profiles_of(node, graph) for node in NODES}
    for process in COMPOSED:
        chain = importlib.import_module(COMPOSED[process][0]).CHAIN
        enclaves[process] = [name for node in chain for name in enclaves[node.NAME]]
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<!-- Written by .ci/write_policy.py; docs/security.md says how it is used. -->',
        '<policy version="0.2.0">',
        '  <enclaves>',
    ]
    for enclave, profiles in enclaves.items():
        lines += [f'    <enclave path="/anser/{enclave}">', '      <profiles>']
        for node in profiles:
            lines += [f'        <profile ns="/anser" node="{node}">']
            for tag, verb, item, _ in KINDS:
                names = graph[node, verb]
                if names:
                    lines.append(f'          <{tag} {verb}="ALLOW">')
                    lines += [f'            <{item}>{name}</{item}>' for name in names]
                    lines.append(f'          </{tag}>')
            lines.append('        </profile>')
        lines += ['      </profiles>', '    </enclave>']
    return '\n'.join([*lines, '  </enclaves>', '</policy>', ''])


def _profiles_of(node: str, graph: Mapping[tuple[str, str], list[str]]) -> list[str]:
    """A node of the package, and what it polls topics with."""
    from anser_ros.apps.dashboard.nodes.view_source import STREAMS

    return sorted({name for name, _ in graph if name.removesuffix(STREAMS) == node})


def _pose_model(bodies: Sequence[str]) -> str:
    """A model for `corrector` that changes nothing, of sensors named as the bodies are."""
    support = {'low_m': [-1.0] * 3, 'high_m': [1.0] * 3}
    effects = [{'name': 'hand_eye', 'parameters': {'sensor': body}} for body in bodies]
    return yaml.safe_dump({
        'schema': MODEL_SCHEMA, 'support': support, 'effects': effects,
        'held_out_position_rmse_m': 1e-3, 'held_out_orientation_rmse_rad': 1e-3,
    })  # fmt: skip


def _graph(setup_file: str) -> dict[tuple[str, str], list[str]]:
    import rclpy
    from geometry_msgs.msg import PoseStamped
    from rclpy.executors import SingleThreadedExecutor
    from std_msgs.msg import String

    from anser_ros.nodes.runtime import qos
    from anser_ros.wire.setup import parse_setup, topic_of
    from anser_ros.wire.text_files import read_config

    text = read_config(setup_file)
    bodies = parse_setup(text).bodies
    peer = rclpy.create_node('policy_writer')
    setup = peer.create_publisher(String, '/anser/setup', qos.LATCHED)
    for body in bodies:
        peer.create_publisher(PoseStamped, f'/optical/{topic_of(body)}/pose', qos.STREAM)
    executor = SingleThreadedExecutor()
    executor.add_node(peer)
    made: list[Any] = []
    with tempfile.TemporaryDirectory() as folder:
        pose_model = Path(folder) / 'model.yaml'
        pose_model.write_text(_pose_model(bodies), encoding='utf-8')
        given = {
            'acquisition': {'device': '/nowhere', 'setup_file': setup_file},
            'openigtlink': {'port': 0},
            'recorder': {'directory': folder},
            'corrector': {'model': str(pose_model)},
            'dashboard': {'directory': folder, 'port': 0},
        }
        try:
            for name in NODES:
                made.append(_node(name, given.get(name, {})))
                executor.add_node(made[-1])
            setup.publish(String(data=text))
            found, since = _asked(peer), time.monotonic()
            end = since + SETTLES_S
            # Until poses are recorded and shown, and nothing new has come for a while.
            while time.monotonic() < end and (
                time.monotonic() < since + 3.0 or not _settled(found)
            ):
                executor.spin_once(timeout_sec=0.1)
                now = _asked(peer)
                if now != found:
                    found, since = now, time.monotonic()
        finally:  # nodes have threads of their own, which would outlive an interruption
            for node in made:
                node.close()
            executor.shutdown()
    return found


def _node(name: str, parameters: Mapping[str, Any]) -> Any:
    from rclpy.parameter import Parameter

    from anser_ros.nodes.runtime.node import AnserNode

    kinds = vars(importlib.import_module(ALL_NODES[name][0])).values()
    nodes = [k for k in kinds if isinstance(k, type) and issubclass(k, AnserNode)]
    (kind,) = (k for k in nodes if vars(k).get('NAME') == name)
    values = [Parameter(key, value=value) for key, value in parameters.items()]
    return kind(parameter_overrides=values)


def _settled(found: Mapping[tuple[str, str], list[str]]) -> bool:
    heard = {name for (_, verb), names in found.items() if verb == 'subscribe' for name in names}
    poses = {name for name in found.get(('tracker', 'publish'), []) if '/pose' in name}
    return bool(poses) and poses <= heard


def _asked(peer: Any) -> dict[tuple[str, str], list[str]]:
    found = {}
    for node in sorted(set(peer.get_node_names()) - {peer.get_name()}):
        for _, verb, _, question in KINDS:
            try:
                names = {name for name, _ in getattr(peer, question)(node, '/anser')}
            except Exception:  # noqa: BLE001 - the graph does not know the node yet
                names = set()
            if names and (node, verb) in TRANSFORMS:
                names |= {'/tf', '/tf_static'}
            found[node, verb] = sorted(names - {'/anser/policy_writer'})
    return found


def main() -> int:
    """Write the file, or that of another setup to stdout."""
    import rclpy

    rclpy.init()
    try:
        with contextlib.redirect_stdout(sys.stderr):  # the nodes have their say there
            text = policy(*sys.argv[1:2])
        if len(sys.argv) > 1:
            print(text, end='')
        else:
            POLICY.write_text(text, encoding='utf-8')
    finally:
        rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
