"""Public things are described in whole sentences, and named numbers are explained.

Only syntax trees and tokens are read; nothing of the package is imported.
"""

import ast
import io
import re
import tokenize
from itertools import zip_longest
from pathlib import Path

import pytest
from conftest import by_room

pytestmark = pytest.mark.long

PACKAGE = Path(__file__).resolve().parents[1] / 'anser_ros'
FEWEST_WORDS = 4
"""A sentence of fewer words than these is a fragment."""
TITLE_WORDS = ('What', 'Whether', 'How', 'Why', 'Which')
"""A docstring that begins with one of these is a title, and so is one of a function that begins
with an article: it says neither `Return` nor what is done."""
ARTICLES = ('The', 'A', 'An')
FILES = sorted(PACKAGE.rglob('*.py'))
DEFINITIONS = (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def place(path):
    return path.relative_to(PACKAGE).as_posix()


def first_sentence(docstring):
    """The docstring up to the first full stop that ends a sentence, or up to a blank line."""
    paragraph = ' '.join(docstring.strip().split('\n\n')[0].split())
    return re.split(r'(?<=[.?!])\s+(?=[A-Z`])', paragraph)[0]


def fault_of(docstring, is_function=False):
    """What is wrong with a docstring's first sentence, or None."""
    if not docstring:
        return 'has no docstring'
    sentence = first_sentence(docstring)
    if not sentence.endswith('.'):
        return f'does not end with a full stop: {sentence!r}'
    if not sentence[0].isupper():
        return f'does not begin with a capital letter: {sentence!r}'
    if len(sentence.split()) < FEWEST_WORDS:
        return f'is a fragment: {sentence!r}'
    if sentence.split()[0] in (*TITLE_WORDS, *(ARTICLES if is_function else ())):
        return f'has a title, and no sentence: {sentence!r}'
    return None


def is_accessor(node):
    """Whether a definition only completes another one: an overload, a setter, a stub."""
    if not isinstance(node, ast.ClassDef) and ast.unparse(node.body[0]) == '...':
        return True  # what a protocol asks for is described where it is done
    names = {ast.unparse(d).split('.')[-1].split('(')[0] for d in node.decorator_list}
    return bool(names & {'overload', 'override', 'setter'})


def public_definitions(body, prefix=''):
    """Yield the full name and node of public classes, functions and methods."""
    for node in body:
        if not isinstance(node, DEFINITIONS) or node.name.startswith('_') or is_accessor(node):
            continue
        yield f'{prefix}{node.name}', node
        if isinstance(node, ast.ClassDef):
            yield from public_definitions(node.body, f'{prefix}{node.name}.')


def docstring_faults(source):
    tree = ast.parse(source)
    fault = fault_of(ast.get_docstring(tree))
    if fault:
        yield f'1: the module {fault}'
    for name, node in public_definitions(tree.body):
        fault = fault_of(ast.get_docstring(node), not isinstance(node, ast.ClassDef))
        if fault:
            yield f'{node.lineno}: {name} {fault}'


def has_number(node):
    return any(
        isinstance(part, ast.Constant)
        and isinstance(part.value, (int, float, complex))
        and not isinstance(part.value, bool)
        for part in ast.walk(node)
    )


def is_constant(node):
    """Whether a statement of a module gives a name in capitals a value with a number in it."""
    if isinstance(node, ast.Assign):
        targets = node.targets
    elif isinstance(node, ast.AnnAssign) and node.value is not None:
        targets = [node.target]
    else:
        return False
    names = [part.id for target in targets for part in ast.walk(target)
             if isinstance(part, ast.Name)]  # fmt: skip
    return bool(names) and all(name.isupper() for name in names) and has_number(node.value)


def commented_lines(source):
    """Numbers of the lines that carry a comment, those for the formatter and linters aside."""
    return {
        token.start[0]
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT and not re.match(r'#\s*(fmt:|noqa|type:)', token.string)
    }


def is_explained(node, following, comments):
    below = isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
    beside = any(line in comments for line in range(node.lineno - 1, node.end_lineno + 1))
    return beside or (below and isinstance(following.value.value, str))


def constant_faults(source):
    body, comments = ast.parse(source).body, commented_lines(source)
    for node, following in zip_longest(body, body[1:]):
        if is_constant(node) and not is_explained(node, following, comments):
            yield f'{node.lineno}: nothing explains {ast.unparse(node)[:60]}'


def all_faults(paths, faults_of):
    """Lines of what is wrong in some files, with its place."""
    return '\n'.join(
        f'{place(path)}:{fault}'
        for path in paths
        for fault in faults_of(path.read_text(encoding='utf-8'))
    )


@by_room(FILES)
def test_public_things_are_described_in_whole_sentences(paths):
    faults = all_faults(paths, docstring_faults)
    assert not faults, faults


@by_room(FILES)
def test_named_numbers_are_explained(paths):
    faults = all_faults(paths, constant_faults)
    assert not faults, faults


def test_the_walk_sees_what_it_should():
    """A guard on the guard: fragments and bare numbers are found, wherever they stand."""
    fragments = (
        '"""A module of some kind."""\n'
        'class Shape:\n    """Linear."""\n'
        '    def f(self):\n        """two words and more."""\n'
    )
    assert [fault.split(':')[0] for fault in docstring_faults(fragments)] == ['2', '4']
    titles = '"""Holds a module of some kind."""\ndef f():\n    """The number of all coils."""\n'
    assert [fault.split(':')[0] for fault in docstring_faults(titles)] == ['2']
    assert list(docstring_faults('def f(): pass')) != []
    assert list(constant_faults('LIMIT = 3\n\nOTHER = (1.0, 2.0)\n"""Why."""\n')) == [
        '1: nothing explains LIMIT = 3'
    ]
    assert list(constant_faults('# Why.\nLIMIT = 3\nname = 4\nTEXT = "a"\nTHIRD = 2  # m\n')) == []
    assert list(constant_faults('LIMIT = 3  # noqa\n')) != []
