"""What a docstring lists as parameters or attributes is what the code has, all of it."""

import ast
import re
from pathlib import Path

import pytest
from source_trees import nodes_of

pytestmark = pytest.mark.long

PACKAGE = Path(__file__).resolve().parents[1] / 'anser_ros'


def told(node, section):
    """Names that a numpydoc section lists, None where there is no such section."""
    pattern = rf'^{section}\n-+\n(.*?)(?=^\S[^\n]*\n-+\n|\Z)'
    found = re.search(pattern, ast.get_docstring(node) or '', re.MULTILINE | re.DOTALL)
    heads = re.findall(r'^(\S[^:\n]*?)(?: :.*)?$', found[1], re.MULTILINE) if found else []
    return [name.strip(' *') for head in heads for name in head.split(',')] if found else None


def pairs(node):
    """Yield what a docstring lists, and what is there: parameters in order, fields in any."""
    inner = node.body if isinstance(node, ast.ClassDef) else [node]
    for of in (f for f in inner if f is node or getattr(f, 'name', '') == '__init__'):
        listed, spec = told(node, 'Parameters'), of.args
        real = [*spec.posonlyargs, *spec.args, spec.vararg, *spec.kwonlyargs, spec.kwarg]
        names = [one.arg for one in real if one is not None and one.arg not in ('self', 'cls')]
        yield names if listed is None else listed, names
    fields = [f.target.id for f in inner if isinstance(f, ast.AnnAssign)]
    public = sorted(f for f in fields if not f.startswith('_'))
    if inner is node.body and any('dataclass' in ast.unparse(d) for d in node.decorator_list):
        yield sorted({*public} & {*(told(node, 'Attributes') or public)}), public


def test_sections_list_what_is_there():
    walked = [(path, node) for path in PACKAGE.rglob('*.py') for node in nodes_of(path)]
    nodes = [(p, n) for p, n in walked if isinstance(n, (ast.FunctionDef, ast.ClassDef))]
    found = [(p.name, n.name, listed, real) for p, n in nodes for listed, real in pairs(n)]
    assert not [fault for fault in found if fault[2] != fault[3]]
