"""Lists every command of the package with its module and its one line of help: the only list.

A node runs as a process of its own; a composed one, beside it, is several nodes in one process.
An offline command needs no ROS: its module has ``add_arguments(parser)`` and either
``work(args, tell) -> Result``, which `main` runs under a bar of progress, or, where it shows by
itself how far it is, ``run(args) -> int``. A kind of session of other trackers is an option of
``diagnose`` and ``evaluate``; its module has ``add_options(parser)``, ``diagnose(args, tell)`` and
``evaluate(args, tell)``. Commands of applications are stated in their ``extension.py``.
`setup.py` makes an executable of each command; as it runs before anything is installed, this
module imports nothing of the package.
"""

import runpy
from pathlib import Path

Commands = dict[str, tuple[str, str]]


def _in(folder: str, lines: dict[str, str]) -> Commands:
    """Return commands whose modules have their names, with the module and the line of each."""
    return {name: (f'anser_ros.{folder}.{name}', line) for name, line in lines.items()}


_NODES = {
    'acquisition': "samples of a control unit's serial port to fluxes",
    'field_model': 'serves the field model, and refits it while it runs',
    'tracker': 'fluxes to poses with covariance',
    'recorder': 'records the topics into an MCAP bag',
    'grid': 'guides a coil through the places of a plate, and writes them as a session',
    'replay': 'publishes a bag again: replay BAG [--rate R] [--loop]',
    'cu_simulator': 'a control unit behind a pseudo-terminal',
}
_COMPOSED = {'live': 'acquisition, field_model and tracker in one process, for the least latency'}
_CORE = {
    'calibrate': 'fit a field model to recorded sessions',
    'diagnose': 'find what a model leaves unexplained on a session, name the effect, correct it',
    'doctor': 'check the installation, ports, clock and graph, with a remedy for each problem',
    'evaluate': 'track recorded sessions and compare their poses with the optical ones',
    'export': 'write poses and fluxes of a bag as CSV, TUM or MATLAB files',
    'import': "make a bag of tables (CSV, NumPy, MATLAB), or of another program's bag",
    'setup': 'write a setup document by options and tables, check it, and draw it',
    'views': 'write the views of RViz and Foxglove for a setup document',
    'warm_up': 'compile all kernels once, before the first start of a node',
}

NODES: Commands = _in('nodes', _NODES)
COMPOSED: Commands = _in('nodes', _COMPOSED)
OFFLINE: Commands = _in('cli', _CORE)
SESSION_KINDS: Commands = {}
for _path in sorted(Path(__file__).parents[1].glob('apps/*/extension.py')):
    _app, _stated = f'apps.{_path.parent.name}', runpy.run_path(str(_path))
    NODES |= _in(f'{_app}.nodes', _stated.get('NODES', {}))
    OFFLINE |= _in(f'{_app}.cli', _stated.get('OFFLINE', {}))
    for _name, (_module, _line) in _stated.get('SESSION_KINDS', {}).items():
        SESSION_KINDS[_name] = (f'anser_ros.{_app}.{_module}', _line)
OFFLINE = dict(sorted(OFFLINE.items()))
