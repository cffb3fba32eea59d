"""Learn a piece of metal from a recorded session, to follow it in others by the tools alone."""

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from anser_ros.apps.lab.metal_follower import KnownMetalModels
from anser_ros.apps.lab.metal_lattice import load_known_metal, save_known_metal
from anser_ros.cli import output
from anser_ros.errors import ParameterError
from anser_ros.sessions.follower import FrameModels
from anser_ros.sessions.prepared import PreparedSession, prepare
from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import model_for


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.epilog = (
        'example: anser known_metal bags/metal.mcap --model config/demo_model.yaml'
        ' --baseline bags/scan.mcap --name c_arm --out c_arm.yaml'
    )
    parser.add_argument(
        'session', metavar='BAG',
        help='bag in which one rigid piece of metal moves, seen by reference sensors and a tool '
        'with optical poses',
    )  # fmt: skip
    output.add_model(parser, required=True)
    parser.add_argument(
        '--baseline', required=True, help='recording of the same board without the metal'
    )
    parser.add_argument('--name', required=True, help='name of the metal')
    parser.add_argument(
        '--out', required=True, type=Path, help='file to write; its folder is made if missing'
    )
    output.add_stated_values(parser, 'accuracy', 'refit', 'tools')
    output.add_json(parser, 'what was learnt on stdout')


def work(args: argparse.Namespace, tell: output.Tell) -> output.Result:
    """Learn the metal of the session, and write it."""
    if not args.name.strip():
        raise ParameterError('--name must not be empty')
    session = load_session(args.session).with_stated(output.stated_values(args))
    model = model_for(args.model, session)
    baseline = load_session(args.baseline)
    prepared = prepare(session, model, baseline)
    output.check_file(args.out)
    # Loaded here, as each evaluation would pay for it, which asks this module for its option.
    from anser_ros.apps.lab.metal_learning import learn

    known = learn(prepared, args.name.strip(), tell)
    save_known_metal(args.out, known)
    document = {
        'name': known.name,
        'points': len(known.lattice),
        'misfit': known.misfit,
        'strongest_t': known.strongest_t,
        'nearest_m': known.nearest_m,
    }
    size = known.lattice.points.max(axis=0) - known.lattice.points.min(axis=0)
    words = (
        f'{known.name}: {len(known.lattice)} points over '
        f'{" x ".join(f"{side * 1e2:.0f}" for side in size)} cm; in frames that took no part '
        f"{known.misfit:.1%} of the references' readings are left"
    )
    return output.Result(document, output.loss_notes(session, baseline), (words,), (args.out,))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the option."""
    parser.add_argument(
        '--known-metal', type=Path, metavar='FILE',
        help='metal that anser known_metal has learnt: let the model follow it by the tools, '
        'without references',
    )  # fmt: skip


def models(
    args: argparse.Namespace, others: Sequence[str]
) -> Callable[[PreparedSession], FrameModels] | None:
    """Return what gives the model of each frame, None where the option is not given.

    Raises `ParameterError` when it is given beside other options that give a model, and as
    `load_known_metal`.
    """
    if args.known_metal is None:
        return None
    if others:
        raise ParameterError(
            f'--known-metal follows metal by the tools alone; leave out {", ".join(others)}'
        )
    return partial(KnownMetalModels, known=load_known_metal(args.known_metal))
