"""Find the tip of a stylus from poses while it turns about its tip, and write it to the setup."""

import argparse
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import yaml

from anser_ros.apps.poses.assessment.pivot import PivotFit, PivotLimits, fit_pivot
from anser_ros.apps.poses.assessment.source import AssessedPoses, read_poses
from anser_ros.apps.poses.cli.pose_source import add_source_options, live_poses, source_of
from anser_ros.apps.poses.sequence import missing_words
from anser_ros.cli import output
from anser_ros.cli.page import legend_beside, page, picture, table, top
from anser_ros.errors import FitError, ParameterError, SetupError
from anser_ros.wire.setup import parse_setup, topic_of
from anser_ros.wire.setup_values import SCHEMA, UPPER, TipSpec, dump_tips, with_tips
from anser_ros.wire.text_files import read_text

DOCUMENT = 'anser_pivot/1'
SEED = 1
"""Seed of the random samples, so that the same recording gives the same tip."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = (
        'example: anser pivot examples/data/pivot.csv --out result/;\n'
        'while the tracker runs: anser pivot --live --topic /anser/pen/pose --seconds 20 '
        '--setup setup.yaml'
    )
    parser.add_argument(
        'recording', nargs='?', help='bag, or file of poses (CSV, TUM, ...), of the pivot'
    )
    parser.add_argument(
        '--live', action='store_true', help='take the poses of --topic from the running graph'
    )
    parser.add_argument(
        '--seconds', type=float, default=20.0, help='with --live: how long, s (20)'
    )
    add_source_options(parser, tip=False)
    parser.add_argument(
        '--setup', type=Path, metavar='FILE', help='setup document that the tip is written into'
    )
    output.add_out(parser, 'pivot.json, tips.yaml and report.html', required=False)
    limits = PivotLimits()
    parser.add_argument(
        '--max-sigma-mm', type=float, default=1e3 * limits.sigma_m,
        help=f'largest uncertainty of the tip along any direction ({1e3 * limits.sigma_m:g})',
    )  # fmt: skip
    parser.add_argument(
        '--max-rms-mm', type=float, default=1e3 * limits.rms_m,
        help=f'largest rms distance of the poses from one point ({1e3 * limits.rms_m:g})',
    )  # fmt: skip
    output.add_json(parser, 'pivot.json on stdout')


def work(args: argparse.Namespace, tell: output.Tell) -> output.Result:
    """Find the tip, and write it."""
    if args.live == bool(args.recording):
        raise ParameterError('give a recording, or --live with --topic')
    if args.live and not args.topic:
        raise ParameterError('--live needs the --topic of the poses')
    if not (args.max_sigma_mm > 0 and args.max_rms_mm > 0):
        raise ParameterError('--max-sigma-mm and --max-rms-mm must be positive')
    text = read_text(args.setup) if args.setup else ''
    output.make_folder(args.out)
    if args.live:
        found = live_poses(args.topic, args.seconds, tell)
    else:
        found = read_poses(args.recording, source_of(args), lambda share: tell('tracking', share))
    body, missing = _body(args, found, text), missing_words(found.poses)
    tell('fitting', 0.5)
    limits = PivotLimits(1e-3 * args.max_sigma_mm, 1e-3 * args.max_rms_mm)
    try:
        fit = fit_pivot(found.poses, np.random.default_rng(SEED), limits)
    except FitError as error:
        words = '; '.join(filter(None, (str(error), missing)))
        raise FitError(f'{found.session.path}: {found.name}: {words}') from error
    document = to_document(fit, found, body)
    written = _write(args, text, body, fit, document)
    notes = tuple(
        f'{found.session.path}: {words}' for words in (found.session.lost, missing) if words
    )
    shown = output.terminal_table(HEAD, _rows(fit)), _agreement(fit, document)
    return output.Result(document, notes, shown, written)


def _agreement(fit: PivotFit, document: dict[str, Any]) -> str:
    return f'{document["n_agree"]} of {document["n"]} poses agree, rms {1e3 * fit.rms_m:.2f} mm'


def _body(args: argparse.Namespace, found: AssessedPoses, text: str) -> str:
    """The body that the poses are of, as the setup document calls it."""
    setup = parse_setup(text) if text else found.setup
    if setup is None:
        return str(args.body or found.name)
    if args.body:
        name = args.body
    elif found.name in setup.bodies:
        name = found.name
    else:
        fitting = [b for b in setup.bodies if f'/{found.name}'.endswith(f'/{topic_of(b)}')]
        if len(fitting) != 1:
            raise SetupError(
                f'the setup does not say which body {found.name} is; state it with --body, one '
                f'of {", ".join(setup.bodies)}'
            )
        name = fitting[0]
    # Refuses a body that the document does not have, and a topic that a sensor has.
    setup.with_tips({name: TipSpec((0.0, 0.0, 0.0))})
    return str(name)


def to_document(fit: PivotFit, found: AssessedPoses, body: str) -> dict[str, Any]:
    """Return the result as plain data."""
    return {
        'schema': DOCUMENT,
        'recording': found.session.path,
        'body': body,
        'tip_m': fit.tip.tolist(),
        'covariance_m2': fit.covariance.tolist(),
        'sigma_m': fit.sigma.tolist(),
        'pivot_point_m': fit.point.tolist(),
        'pivot_point_sigma_m': np.sqrt(np.diag(fit.point_covariance)).tolist(),
        'rms_m': fit.rms_m,
        'n': int(fit.time.size),
        'n_missing': int(found.poses.missing.size),
        'n_agree': int(fit.agrees.sum()),
        'tilt_rms_deg': fit.tilt_deg.tolist(),
    }


def _write(
    args: argparse.Namespace, text: str, body: str, fit: PivotFit, document: dict[str, Any]
) -> tuple[Path, ...]:
    x, y, z = (float(v) for v in fit.tip)
    spec = TipSpec((x, y, z), tuple(float(fit.covariance[i, j]) for i, j in UPPER))
    if args.setup is not None:
        new = with_tips(text, {body: spec})
        try:
            kept = parse_setup(new).tips.get(body) == spec
        except SetupError:
            kept = False
        if not kept:
            raise SetupError(
                f'{args.setup}: the key tips cannot be written into a document of this layout; '
                'write its keys one per line, not in braces'
            )
        aside = args.setup.with_name(args.setup.name + '.new')
        aside.write_text(new, encoding='utf-8')
        aside.replace(args.setup)
    written = () if args.setup is None else (args.setup,)
    if args.out is None:
        return written
    tips = {'schema': SCHEMA, 'tips': dump_tips({body: spec})}
    tips_yaml = yaml.safe_dump(tips, sort_keys=False, default_flow_style=None)
    report = render(fit, document)
    files = {'pivot.json': document, 'tips.yaml': tips_yaml, 'report.html': report}
    return (*written, *output.write_files(args.out, files))


def _rows(fit: PivotFit) -> list[list[str]]:
    return [
        [axis, f'{1e3 * place:.3f}', f'{1e3 * sigma:.3f}', f'{tilt:.1f}']
        for axis, place, sigma, tilt in zip('xyz', fit.tip, fit.sigma, fit.tilt_deg, strict=True)
    ]


HEAD = ('axis of the body', 'tip, mm', '1 sigma, mm', 'tilt of the axis, rms deg')


def render(fit: PivotFit, document: dict[str, Any]) -> str:
    """Return the page as HTML: the tip, and how far each pose puts it from where it rested."""
    figure, axes = plt.subplots(figsize=(9, 3), layout='constrained')
    for mask, colour, label in ((fit.agrees, 'C0', 'agrees'), (~fit.agrees, 'C3', 'left out')):
        axes.plot(fit.time[mask], 1e3 * fit.distance[mask], '.', ms=3, color=colour, label=label)
    axes.set(xlabel='time, s', ylabel='tip from the point, mm', yscale='log')
    legend_beside(figure)
    verdict = (
        f'The tip of {document["body"]} is known to '
        f'{1e3 * float(np.sqrt(np.trace(fit.covariance))):.2f} mm; {_agreement(fit, document)}.'
    )
    return page(
        'Pivot',
        top('Pivot calibration', verdict, recording=str(document['recording'])),
        table(HEAD, _rows(fit)),
        picture(figure),
    )
