"""The thresholds of the diagnosis stand in one module, and every named number says why it is so.

Every file's syntax tree is walked.
"""

import ast
from pathlib import Path

from conftest import REPO
from source_trees import nodes_of, tree_of

ROOMS = ('diagnosis', 'effects')
DECISIONS = REPO / 'anser_ros' / 'diagnosis' / 'decisions.py'
ELSEWHERE = {
    'departure.EXPLAINED': 'asked by a calibration about its own scan',
    'departure.NEAR_NOISE': 'the same',
    'engine.SETTLED': 'ends a fit',
    'prepare.FEWEST_POSED_FRAMES': 'what a diagnosis needs at all',
    'prepare.MARGIN_S': 'frames that take part',
    'remainder.NEW_MODES_M': 'when the shapes of metal are made anew',
    'rich_modes.LEAST_INFORMATION': 'modes of metal that only take time',
    'engine.MOST_COLUMNS': 'terms that are refitted with a candidate',
    'structure.FEWEST_CELL_VALUES': 'cells that have a mean',
    'whiteness.LAGS': 'how far back a memory is looked for',
    'whiteness.OUTLYING': 'values that are left out of a kurtosis',
}
"""Numbers that are compared with something where they stand, and judge no explanation."""


def is_number(node: ast.expr) -> bool:
    """Whether a constant's value is a number, several, or made of numbers by numpy."""
    leaves = [leaf for leaf in ast.walk(node) if isinstance(leaf, ast.Constant)]
    return bool(leaves) and all(
        isinstance(leaf.value, (int, float)) and not isinstance(leaf.value, bool)
        for leaf in leaves
    )


def numbers(path: Path) -> dict[str, str]:
    """Named numbers of a module, with the words below each."""
    body, found = tree_of(path).body, {}
    for node, after in zip(body, [*body[1:], ast.Pass()], strict=True):
        if not isinstance(node, ast.Assign) or not is_number(node.value):
            continue
        stated = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
        names = [n.id for t in node.targets for n in ast.walk(t) if isinstance(n, ast.Name)]
        found |= {name: after.value.value if stated else '' for name in names if name.isupper()}
    return found


def test_each_named_number_is_explained():
    for room in ROOMS:
        for path in sorted((REPO / 'anser_ros' / room).glob('*.py')):
            bare = [name for name, words in numbers(path).items() if not words]
            assert not bare, f'{path.name}: state unit, reason and choice of {bare}'


def test_thresholds_stand_in_one_module():
    """`docs/diagnosis.md` says so; the exceptions are listed here, each with its reason."""
    found = set()
    for path in (REPO / 'anser_ros' / 'diagnosis').glob('*.py'):
        own = set() if path == DECISIONS else set(numbers(path))
        compared = [
            leaf for n in nodes_of(path) if isinstance(n, ast.Compare) for leaf in ast.walk(n)
        ]
        used = {leaf.id for leaf in compared if isinstance(leaf, ast.Name)} & own
        found |= {f'{path.stem}.{name}' for name in used}
    assert found == set(ELSEWHERE)
