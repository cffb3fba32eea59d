"""Write config/anser.yaml with every parameter of every node, its default and its meaning."""

import dataclasses
import importlib
import math
from pathlib import Path

import yaml

from anser_ros.cli.commands import NODES
from anser_ros.nodes.runtime.node import AnserNode

TARGET = Path(__file__).resolve().parents[1] / 'config' / 'anser.yaml'
HEAD = """\
# Parameters of all nodes: ros2 run anser_ros NODE --ros-args --params-file config/anser.yaml
# Written by `make parameters` from the tables of the nodes; the values are the defaults.
# A key that its node does not know stops the node with a line that says so.
"""


def table_of(name):
    module = importlib.import_module(NODES[name][0])
    for value in vars(module).values():
        if isinstance(value, type) and issubclass(value, AnserNode) and value is not AnserNode:
            return value.PARAMETERS
    raise LookupError(name)


def section(name):
    fields = dataclasses.fields(table_of(name))
    lines = [f'/**/{name}:', f'  ros__parameters:{"" if fields else " {}"}']
    for field in fields:
        rule = field.metadata['rule']
        value = list(field.default) if isinstance(field.default, tuple) else field.default
        text = yaml.safe_dump(value, default_flow_style=True, width=1000).split('\n...')[0]
        if isinstance(value, float) and '.' not in text:  # 1e-3 would be read as text
            text = f'{value:.12f}'.rstrip('0')
        limits = ' | '.join(rule.choices)
        if rule.within != type(rule).within:
            limits = '..'.join(f'{end:g}' if math.isfinite(end) else '' for end in rule.within)
        lines.append(f'    # {rule.description}{f" [{limits}]" if limits else ""}')
        lines.append(f'    {field.name}: {text.strip()}')
    return '\n'.join(lines)


def text():
    return '\n'.join([HEAD, '\n\n'.join(map(section, NODES)), ''])


if __name__ == '__main__':
    TARGET.write_text(text())
    print(TARGET)
