"""Find the tip of a stylus from poses while it turns about its tip, and write it to the setup."""

import argparse
import html
import json
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import yaml
from rich.console import Console
from rich.table import Table

from anser_ros.assessment.pivot import PivotFit, PivotLimits, fit_pivot
from anser_ros.assessment.source import AssessedPoses, read_poses
from anser_ros.cli.folders import make_folder
from anser_ros.cli.html_page import page, table
from anser_ros.cli.output import say_written
from anser_ros.cli.pose_source import add_source_options, live_poses, source_of
from anser_ros.cli.progress import progress_of
from anser_ros.errors import FitError, ParameterError, SetupError
from anser_ros.pictures import image
from anser_ros.poses.sequence import missing_words
from anser_ros.wire.setup import parse_setup, topic_of
from anser_ros.wire.setup_tips import SCHEMA, UPPER, TipSpec, dump_tips, with_tips
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
    parser.add_argument(
        '--out',
        type=Path,
        help='folder for pivot.json, tips.yaml and report.html, made if missing',
    )
    limits = PivotLimits()
    parser.add_argument(
        '--max-sigma-mm', type=float, default=1e3 * limits.sigma_m,
        help=f'largest uncertainty of the tip along any direction ({1e3 * limits.sigma_m:g})',
    )  # fmt: skip
    parser.add_argument(
        '--max-rms-mm', type=float, default=1e3 * limits.rms_m,
        help=f'largest rms distance of the poses from one point ({1e3 * limits.rms_m:g})',
    )  # fmt: skip
    parser.add_argument('--json', action='store_true', help='print pivot.json on stdout')


def run(args: argparse.Namespace) -> int:
    """Run the command; the exit code."""
    if args.live == bool(args.recording):
        raise ParameterError('give a recording, or --live with --topic')
    if args.live and not args.topic:
        raise ParameterError('--live needs the --topic of the poses')
    if not (args.max_sigma_mm > 0 and args.max_rms_mm > 0):
        raise ParameterError('--max-sigma-mm and --max-rms-mm must be positive')
    text = read_text(args.setup) if args.setup else ''
    if args.out is not None:
        make_folder(args.out)
    with progress_of('pivot') as progress:
        if args.live:
            found = live_poses(args.topic, args.seconds, progress)
        else:
            found = read_poses(
                args.recording, source_of(args), lambda share: progress('tracking', share)
            )
        body, missing = _body(args, found, text), missing_words(found.poses)
        progress('fitting', 0.5)
        limits = PivotLimits(1e-3 * args.max_sigma_mm, 1e-3 * args.max_rms_mm)
        try:
            fit = fit_pivot(found.poses, np.random.default_rng(SEED), limits)
        except FitError as error:
            words = '; '.join(filter(None, (str(error), missing)))
            raise FitError(f'{found.session.path}: {found.name}: {words}') from error
    document = to_document(fit, found, body)
    written = _write(args, text, body, fit, document)
    if missing:
        print(f'anser pivot: {found.session.path}: {missing}', file=sys.stderr)
    if args.json:
        print(json.dumps(document, indent=1))
        return 0
    Console().print(_table(fit))
    Console().print(
        f'{document["n_agree"]} of {document["n"]} poses agree, rms {1e3 * fit.rms_m:.2f} mm',
        highlight=False,
    )
    if written:
        say_written(*written)
    return 0


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
) -> list[Path]:
    x, y, z = (float(v) for v in fit.tip)
    spec = TipSpec((x, y, z), tuple(float(fit.covariance[i, j]) for i, j in UPPER))
    written = []
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
        written.append(args.setup)
    if args.out is not None:
        tips = {'schema': SCHEMA, 'tips': dump_tips({body: spec})}
        files = {
            'pivot.json': json.dumps(document, indent=1) + '\n',
            'tips.yaml': yaml.safe_dump(tips, sort_keys=False, default_flow_style=None),
            'report.html': render(fit, document),
        }
        for name, content in files.items():
            (args.out / name).write_text(content, encoding='utf-8')
            written.append(args.out / name)
    return written


def _rows(fit: PivotFit) -> list[list[str]]:
    return [
        [axis, f'{1e3 * place:.3f}', f'{1e3 * sigma:.3f}', f'{tilt:.1f}']
        for axis, place, sigma, tilt in zip('xyz', fit.tip, fit.sigma, fit.tilt_deg, strict=True)
    ]


HEAD = ('axis of the body', 'tip, mm', '1 sigma, mm', 'tilt of the axis, rms deg')


def _table(fit: PivotFit) -> Table:
    shown = Table(*HEAD)
    for row in _rows(fit):
        shown.add_row(*row)
    return shown


def render(fit: PivotFit, document: dict[str, Any]) -> str:
    """Return the page as HTML: the tip, and how far each pose puts it from where it rested."""
    figure, axes = plt.subplots(figsize=(9, 3), layout='constrained')
    for mask, colour, label in ((fit.agrees, 'C0', 'agrees'), (~fit.agrees, 'C3', 'left out')):
        axes.plot(fit.time[mask], 1e3 * fit.distance[mask], '.', ms=3, color=colour, label=label)
    axes.set(xlabel='time, s', ylabel='tip from the point, mm', yscale='log')
    figure.legend(loc='outside right upper')
    verdict = (
        f'The tip of {document["body"]} is known to '
        f'{1e3 * float(np.sqrt(np.trace(fit.covariance))):.2f} mm; {document["n_agree"]} of '
        f'{document["n"]} poses agree, rms {1e3 * fit.rms_m:.2f} mm.'
    )
    return page('Pivot', [
        '<h1>Pivot calibration</h1>'
        f'<p class="note"><code>{html.escape(str(document["recording"]))}</code></p>'
        f'<p class="verdict">{html.escape(verdict)}</p>',
        table(HEAD, _rows(fit)), image(figure),
    ])  # fmt: skip
