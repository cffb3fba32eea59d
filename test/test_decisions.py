"""Every named number says why it is so."""

import ast
from pathlib import Path

from conftest import REPO
from source_trees import tree_of


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
