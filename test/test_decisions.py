"""Every named number says why it is so."""

import ast
import re
from pathlib import Path

import pytest
from conftest import REPO
from source_trees import nodes_of, tree_of


def is_number(node: ast.expr) -> bool:
    """Whether a constant's value is a number, several, or made of numbers by numpy."""
    leaves = [leaf for leaf in ast.walk(node) if isinstance(leaf, ast.Constant)]
    return bool(leaves) and all(
        isinstance(leaf.value, (int, float)) and not isinstance(leaf.value, bool)
        for leaf in leaves
    )


def numbers(path: Path) -> dict[str, tuple[int, str]]:
    """Named numbers of a module: the line of each, and the words below it."""
    body, found = tree_of(path).body, {}
    for node, after in zip(body, [*body[1:], ast.Pass()], strict=True):
        if not isinstance(node, ast.Assign) or not is_number(node.value):
            continue
        stated = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
        names = [n.id for t in node.targets for n in ast.walk(t) if isinstance(n, ast.Name)]
        words = after.value.value if stated else ''
        found |= {name: (node.lineno, words) for name in names if name.isupper()}
    return found


def test_each_named_number_is_explained():
    """In words below it, or in a comment beside or above it."""
    for path in sorted((REPO / 'anser_ros').rglob('*.py')):
        lines = path.read_text(encoding='utf-8').splitlines()
        for name, (line, words) in numbers(path).items():
            beside = any(' # ' in f' {lines[at]}' for at in (line - 2, line - 1))
            assert words or beside, f'{path}:{line}: state unit, reason and choice of {name}'


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


@pytest.mark.long
def test_sections_list_what_is_there():
    walked = [
        (path, node) for path in (REPO / 'anser_ros').rglob('*.py') for node in nodes_of(path)
    ]
    nodes = [(p, n) for p, n in walked if isinstance(n, (ast.FunctionDef, ast.ClassDef))]
    found = [(p.name, n.name, listed, real) for p, n in nodes for listed, real in pairs(n)]
    assert not [fault for fault in found if fault[2] != fault[3]]
