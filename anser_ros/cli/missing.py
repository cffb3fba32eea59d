"""Handles packages that rosdep does not know: a command that needs one says so in a line."""

from importlib.util import find_spec

from anser_ros.errors import AnserError

PYPI = {
    'allantools': 'allantools',
    'dask': 'dask',
    'distributed': 'distributed',
    'mcap': 'mcap',
    'mcap_ros2': 'mcap-ros2-support',
    'zstandard': 'zstandard',
    'nicegui': 'nicegui',
}
"""Modules without a key of rosdep, and what they are called on PyPI."""
OPTIONAL = ('nicegui',)
"""Of these, what only somebody needs who wants the live view in a browser."""
NEEDED = {
    'dashboard': ('nicegui',),
    'recorder': ('mcap',),
    'replay': ('mcap', 'mcap_ros2', 'zstandard'),
}
"""Nodes that do nothing without one of these; all others start where they are missing."""


class MissingPackageError(AnserError):
    """A package that is needed here is not installed."""


def check(node: str) -> None:
    """Raise `MissingPackageError` where a node lacks a package."""
    for module in NEEDED.get(node, ()):
        if not find_spec(module):
            raise MissingPackageError(words_of(module))


def words_of(module: str) -> str:
    """Return what is missing, with its remedy; the module may be one inside a package."""
    package = module.split('.')[0]
    return f'{package} is not installed: pip install {PYPI.get(package, package)}'
