"""Compile all numerical kernels once, so that no later start of a node or command waits for them.

Nodes do this by themselves when they start with an empty cache. For the image of a machine, or an
installer, it can be done before: as the user who will run the nodes.
"""

import argparse
import contextlib
import json
import sys

from anser_ros.field.model import FieldModel
from anser_ros.kernel_cache import PARTS, KernelCache, compile_kernels
from anser_ros.stamps import SECOND_NS
from anser_ros.wire.setup import parse_setup
from anser_ros.wire.text_files import config_path, read_config

SCHEMA = 'anser_warm_up/1'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = 'example: anser warm_up'
    parser.add_argument('--json', action='store_true', help='print the number of kernels as JSON')


def run(args: argparse.Namespace) -> int:
    """Compile what is not there yet, and say how far that is.

    Raises `ParameterError` when a kernel can't be compiled.
    """
    stream = sys.stderr if args.json else sys.stdout
    compile_kernels(lambda text: print(text, file=stream, flush=True))
    if args.json:
        count = KernelCache().total
        print(json.dumps({'schema': SCHEMA, 'kernels': count}))
    else:
        print('all kernels are compiled')
    return 0


def main(part: str) -> int:
    """Call the kernels of one part the way that nodes and commands do."""
    for step in STEPS[part]:
        step()
    return 0


def _track() -> None:
    from anser_ros.tracking.tracker import warm_up

    warm_up()


def _solve_body() -> None:
    from anser_ros.tracking.tracker import warm_up_bodies

    warm_up_bodies(_demo_model())


def _refit() -> None:
    """Make a refit of the demo's board; its tables, most of the work, are kept for the demo."""
    from anser_ros.refit.live_refit import LiveRefit
    from anser_ros.refit.tables import build_tables
    from anser_ros.sessions.kept_tables import KeptTables, kept_folder
    from anser_ros.sessions.nominal_board import NominalBoard, stated_volume
    from anser_ros.sessions.session import sensor_table
    from anser_ros.simulation.world import Approach, World, board_source, steel_disc

    setup = parse_setup(read_config('demo_setup.yaml'))
    source, near = board_source(setup), Approach(start_s=-1e3, travel_s=1.0, stay_s=1e6)
    references = sensor_table(setup.reference_sensors)
    clean, bent = (
        World(setup, source, metal=metal).flux(0.0)[len(setup.tool_sensors) :]
        for metal in ([], [steel_disc(near)])
    )
    model, folder = _demo_model(), kept_folder()
    tables = build_tables(
        model, references, setup.refit, NominalBoard.of(setup).field, stated_volume(setup)
    )
    refit = LiveRefit(model, references, clean, setup.refit, tables=tables)
    if folder is not None:
        with contextlib.suppress(OSError):  # a full disk only makes the demo's first start slower
            KeptTables(folder, setup, model, references).write(tables)
    for frame, flux in enumerate((clean, bent, bent, bent)):
        refit.update(SECOND_NS + frame * 20_000_000, references.channel, flux)


def _watch_samples() -> None:
    import numpy as np

    from anser_ros.signals.repetition import RepetitionWatch

    watch = RepetitionWatch(2, 40e3)
    for _ in range(2):
        watch.take(np.random.default_rng(0).integers(-99, 99, (2000, 2)).astype(np.int16))
    watch.ages(0)


def _demo_model() -> FieldModel:
    from anser_ros.sessions.starting_model import load_model

    return load_model(config_path('demo_model.yaml'))


STEPS = dict(zip(PARTS, ((_track,), (_watch_samples, _solve_body, _refit)), strict=True))
"""What each of the processes does, both for as long. What one has compiled the other one loads: so
the second one begins with what the first does not need, and with what it comes to last."""


if __name__ == '__main__':
    sys.exit(main(sys.argv[1]))
