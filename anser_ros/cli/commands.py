"""Lists every command of the package with its module and its one line of help: the only list.

A node runs as a process of its own; a composed one, beside it, is several nodes in one process.
An offline command needs no ROS: its module, wherever it lies in the package, has
``add_arguments(parser)`` and either ``work(args, tell) -> Result``, which `main` runs under a bar
of progress, or, where it shows by itself how far it is, ``run(args) -> int``. A kind of session of
other trackers is an option of ``diagnose`` and ``evaluate``; its module has
``add_options(parser)``, ``diagnose(args, tell)`` and ``evaluate(args, tell)``.
`setup.py` makes an executable of each command; as it runs before anything is installed, this
module imports nothing.
"""

Commands = dict[str, tuple[str, str]]


def _in(folder: str, lines: dict[str, str]) -> Commands:
    """Return commands whose modules have their names, with the module and the line of each."""
    return {name: (f'anser_ros.{folder}.{name}', line) for name, line in lines.items()}


_NODES = {
    'acquisition': "samples of a control unit's serial port to fluxes",
    'field_model': 'serves the field model, and refits it while it runs',
    'tracker': 'fluxes to poses with covariance',
    'recorder': 'records the topics into an MCAP bag',
    'replay': 'publishes a bag again: replay BAG [--rate R] [--loop]',
    'openigtlink': 'serves the poses to 3D Slicer as OpenIGTLink',
    'cu_simulator': 'a control unit behind a pseudo-terminal',
    'corrector': 'corrects the poses of another tracker with a model of diagnose --poses',
    'monitor': 'a live table of sensors, rates and latencies',
    'dashboard': 'a live view in the browser, with the loop of record, diagnose and correct',
    'watcher': 'names the effects that the model lacks, live in /diagnostics',
}
_COMPOSED = {
    'live': 'acquisition, field_model and tracker in one process, for the least latency',
}
_CORE = {
    'bags': 'record the small simulated sessions of the folder bags/',
    'batch': 'calibrate, evaluate or diagnose many sessions with Dask, with a summary',
    'calibrate': 'fit a field model to recorded sessions',
    'compare': 'compare two evaluations of a session, paired, with bootstrap intervals',
    'demo': 'watch a simulated tool being tracked: a live table, a bag, a picture',
    'diagnose': 'find what a model leaves unexplained on a session, name the effect, correct it',
    'doctor': 'check the installation, ports, clock and graph, with a remedy for each problem',
    'evaluate': 'track recorded sessions and compare their poses with the optical ones',
    'export': 'write poses and fluxes of a bag as CSV, TUM or MATLAB files',
    'import': "make a bag of tables (CSV, NumPy, MATLAB), or of another program's bag",
    'place': 'propose places of reference coils, with the error that each number of them leaves',
    'setup': 'write a setup document by questions or options, check it, and draw it',
    'views': 'write the views of RViz and Foxglove for a setup document',
    'warm_up': 'compile all kernels once, before the first start of a node',
}
_POSES = {
    'accuracy': 'jitter, drift, distances, rotations, latency by published protocols',
    'handeye': 'frames, lever arm, mount and clocks of two streams of poses, jointly',
    'import_poses': 'files of poses as trackers write them, to a bag',
    'pivot': 'the tip of a stylus, from poses while it turns about its tip',
}
_LAB = {
    'error_map': 'learn an error map from tracked and true positions, and apply it to others',
    'known_metal': 'learn a piece of metal from a session, for evaluate --known-metal',
    'loop': 'put an effect into simulated samples, find it blind, correct it, measure again',
    'measured': "other people's measurements: what they contain, and the error before and after",
    'paper': "redo the article's experiments: Tables II to V, Figs. 2 and 5 to 10",
}

NODES: Commands = _in('nodes', _NODES)
COMPOSED: Commands = _in('nodes', _COMPOSED)
OFFLINE: Commands = dict(
    sorted({**_in('cli', _CORE), **_in('cli', _POSES), **_in('cli', _LAB)}.items())
)
SESSION_KINDS: Commands = {
    'poses': ('anser_ros.cli.pose_session', 'a session of a tracker that gives poses only'),
}
