"""Handles packages that may be missing, ROS among them: what needs one says so in a line."""

from importlib.util import find_spec

from anser_ros import extensions
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
OPTIONAL = ('dask', 'distributed', 'nicegui')
"""Of these, what only `anser batch` and the live view in a browser need."""
ROS = 'rclpy'
"""Module that every node needs, and that pip does not install with this package."""
ROS_REMEDY = 'source /opt/ros/jazzy/setup.bash, or use the environment that `make` makes'
NEEDED = {
    'recorder': ('mcap',),
    'replay': ('mcap', 'mcap_ros2', 'zstandard'),
    **{node: needed for table in extensions.tables('NEEDED') for node, needed in table.items()},
}
"""Nodes that do nothing without one of these; all others need ROS alone."""


class MissingPackageError(AnserError):
    """A package that is needed here is not installed."""


def check(node: str) -> None:
    """Raise `MissingPackageError` where a node lacks a package."""
    for module in (ROS, *NEEDED.get(node, ())):
        if not find_spec(module):
            raise MissingPackageError(words_of(module))


def is_known(module: str | None) -> bool:
    """Return whether a module is of a package that may be missing."""
    return module is not None and module.split('.')[0] in PYPI


def words_of(module: str) -> str:
    """Return what is missing, with its remedy; the module may be one inside a package."""
    package = module.split('.')[0]
    remedy = ROS_REMEDY if package == ROS else f'pip install {PYPI.get(package, package)}'
    return f'{package} is not installed: {remedy}'
