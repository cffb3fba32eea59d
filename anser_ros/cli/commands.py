"""Lists every command of the package with its one line of help: the only list of them.

A command's name is that of its module. A node's lies in ``anser_ros/nodes`` and runs as a process
of its own; a composed one, beside it, is several nodes in one process; the others lie in
``anser_ros/cli``, have ``add_arguments(parser)`` and ``run(args) -> int``, and need no ROS.
`setup.py` makes an executable of each; as it runs before anything is installed, this module
imports nothing.
"""

NODES = {
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

COMPOSED = {
    'live': 'acquisition, field_model and tracker in one process, for the least latency',
}

OFFLINE = {
    'accuracy': 'jitter, drift, distances, rotations, latency by published protocols',
    'bags': 'record the small simulated sessions of the folder bags/',
    'batch': 'calibrate, evaluate or diagnose many sessions with Dask, with a summary',
    'calibrate': 'fit a field model to recorded sessions',
    'compare': 'compare two evaluations of a session, paired, with bootstrap intervals',
    'demo': 'watch a simulated tool being tracked: a live table, a bag, a picture',
    'diagnose': 'find what a model leaves unexplained on a session, name the effect, correct it',
    'doctor': 'check the installation, ports, clock and graph, with a remedy for each problem',
    'error_map': 'learn an error map from tracked and true positions, and apply it to others',
    'evaluate': 'track recorded sessions and compare their poses with the optical ones',
    'export': 'write poses and fluxes of a bag as CSV, TUM or MATLAB files',
    'handeye': 'frames, lever arm, mount and clocks of two streams of poses, jointly',
    'import': "make a bag of tables (CSV, NumPy, MATLAB), or of another program's bag",
    'import_poses': 'files of poses as trackers write them, to a bag',
    'known_metal': 'learn a piece of metal from a session, for evaluate --known-metal',
    'loop': 'put an effect into simulated samples, find it blind, correct it, measure again',
    'measured': "other people's measurements: what they contain, and the error before and after",
    'paper': "redo the article's experiments: Tables II to V, Figs. 2 and 5 to 10",
    'pivot': 'the tip of a stylus, from poses while it turns about its tip',
    'place': 'propose places of reference coils, with the error that each number of them leaves',
    'setup': 'write a setup document by questions or options, check it, and draw it',
    'views': 'write the views of RViz and Foxglove for a setup document',
    'warm_up': 'compile all kernels once, before the first start of a node',
}
