"""Track recorded sessions and compare their poses with the optical ones."""

import argparse
import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from anser_ros.cli import output, sessions
from anser_ros.cli import page as html
from anser_ros.diagnosis.diagnose import WIRING_FRAMES
from anser_ros.diagnosis.wiring import common_gain, wiring_faults
from anser_ros.errors import DiagnosisError, ParameterError
from anser_ros.field.model import FieldModel
from anser_ros.fingerprint import fingerprint_of
from anser_ros.physics.constants import DEGREES
from anser_ros.pose_states import OK, RESIDUAL
from anser_ros.sessions.diagnosis import problem_of
from anser_ros.sessions.follower import parse_references, with_references
from anser_ros.sessions.prepared import correct, prepare
from anser_ros.sessions.session import Session
from anser_ros.sessions.tracked_session import (
    Evaluation,
    PoseSeries,
    to_document,
    track_session,
    write_tables,
)
from anser_ros.settings import SECTIONS
from anser_ros.tracking.estimate import TrackerSettings

MOST_POINTS = 4000
"""Most points that a figure shows of one coil: more cannot be distinguished."""
COVERAGE_SIGMAS = np.linspace(0.0, 4.0, 81)
"""Multiples of sigma for which the share of errors within is drawn, to where all should be."""
HARDLY = 0.05
"""Share of the poses up to which it is said why there are hardly any."""
ERRORS_HEAD = ('sensor', 'frames', 'tracked', 'RMSE mm', 'PRC95 mm', 'RMSE deg', 'PRC95 deg')
"""Head of the table of `error_rows`."""


def _series(evaluation: Evaluation) -> dict[str, PoseSeries]:
    return {**evaluation.sensors, **evaluation.bodies}


def _thinned(count: int) -> slice:
    return slice(0, None, max(1, -(-count // MOST_POINTS)))


def over_time(evaluation: Evaluation) -> Figure:
    """Draw the position error of every coil and body over time, and which of them had a pose."""
    found = _series(evaluation)
    start = min(s.estimates[0].stamp_ns for s in found.values() if s.estimates)
    figure, (upper, lower) = plt.subplots(
        2, 1, figsize=(9, 5.6), sharex=True, layout='constrained', height_ratios=(3, 1)
    )
    for rank, (name, series) in enumerate(found.items()):
        stamps = np.array([one.stamp_ns for one in series.estimates], dtype=np.int64)
        time, keep, colour = 1e-9 * (stamps - start), _thinned(stamps.size), f'C{rank % 10}'
        error = 1e3 * series.position_error[keep]
        upper.plot(time[keep], error, '.', ms=3, color=colour, label=name)
        lost = time[~series.ok]
        lower.plot(lost, np.full(lost.size, rank), '|', color=colour)
    upper.set(ylabel='position error, mm', yscale='log')
    html.spell_out(upper.yaxis)
    lower.set(xlabel='time, s', ylabel='no pose', ylim=(-0.8, len(found) - 0.2))
    lower.set_yticks([])
    if all(series.ok.all() for series in found.values()):
        lower.text(0.5, 0.5, 'every frame has a pose', transform=lower.transAxes, ha='center')
    upper.grid(alpha=0.3)
    html.legend_beside(figure, below=1.0)
    return figure


def over_space(evaluation: Evaluation) -> Figure:
    """Draw where the poses were, from above and from the side, coloured by their error."""
    place, error = [], []
    for series in evaluation.sensors.values():
        good = np.isfinite(series.position_error)
        place += [e.position for e, g in zip(series.estimates, good, strict=True) if g]
        error.append(series.position_error[good])
    where = 1e3 * np.array(place).reshape(-1, 3)
    size = 1e3 * np.concatenate(error) if error else np.zeros(0)
    keep = _thinned(len(where))
    figure, panels = plt.subplots(1, 2, figsize=(9, 4.2), layout='constrained')
    top = float(np.percentile(size, 98)) if size.size else 1.0
    for panel, up in zip(panels, (1, 2), strict=True):
        places = where[keep][:, [0, up]]
        shown = panel.scatter(*places.T, c=size[keep], s=8, vmin=0.0, vmax=top)
        panel.set(xlabel='x, mm', ylabel=f'{"xyz"[up]}, mm', aspect='equal')
        panel.grid(alpha=0.3)
    figure.colorbar(shown, ax=panels, label='position error, mm', extend='max')
    return figure


def by_coil(evaluation: Evaluation) -> Figure:
    """Draw the distribution of each coil's and body's errors of position and orientation."""
    found = _series(evaluation)
    figure, panels = plt.subplots(
        1, 2, figsize=(9, 1.4 + 0.3 * len(found)), layout='constrained', sharey=True
    )
    for panel, scale, kind, unit in (
        (panels[0], 1e3, 'position', 'mm'), (panels[1], DEGREES, 'orientation', 'deg'),
    ):  # fmt: skip
        for row, series in enumerate(found.values(), start=1):
            error = getattr(series, f'{kind}_error')
            finite = scale * error[np.isfinite(error)]
            if not finite.size:
                continue
            least, lower, middle, upper, most = np.percentile(finite, (5, 25, 50, 75, 95))
            panel.hlines(row, least, most, color='0.5')
            panel.barh(row, upper - lower, 0.6, left=lower, color='C0', alpha=0.6)
            panel.vlines(middle, row - 0.3, row + 0.3, color='C1', lw=2)
        panel.set(xlabel=f'{kind} error, {unit}')
        panel.set_xlim(left=0.0)
        panel.locator_params(axis='x', nbins=5)
        panel.grid(alpha=0.3, axis='x')
    panels[0].set_yticks(np.arange(1, len(found) + 1), list(found))
    panels[0].invert_yaxis()
    return figure


def against_sigma(evaluation: Evaluation, jitter_m: float = 0.0) -> Figure:
    """Draw the errors against the reported sigma, and how many lie within a multiple of it.

    ``jitter_m``, the optical tracker's own error per component, m, is part of the expected error.
    """
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4.2), layout='constrained')
    low, high = np.inf, 0.0
    for rank, (name, series) in enumerate(_series(evaluation).items()):
        sigma = np.array([estimate.sigma_position_m for estimate in series.estimates])
        good = np.isfinite(series.position_error) & (sigma > 0)
        error = 1e3 * series.position_error[good]
        sigma = 1e3 * np.hypot(sigma[good], math.sqrt(3.0) * jitter_m)
        if not error.size:
            continue
        keep, colour = _thinned(error.size), f'C{rank % 10}'
        left.plot(sigma[keep], error[keep], '.', ms=3, color=colour, label=name)
        low, high = min(low, float(sigma.min())), max(high, float(sigma.max()))
        within = [(error <= k * sigma).mean() for k in COVERAGE_SIGMAS]
        right.plot(COVERAGE_SIGMAS, within, color=colour)
    if high > 0:
        line = np.linspace(low, high)
        left.plot(line, line, '-', color='0.3', label='error = sigma')
        left.plot(line, 3 * line, '--', color='0.3', label='error = 3 sigma')
        left.set(yscale='log')
        html.spell_out(left.yaxis)
        if high > html.WIDE * low:
            left.set(xscale='log')
            html.spell_out(left.xaxis)
        else:
            left.locator_params(axis='x', nbins=5)
    left.set(xlabel='sigma, with the optical jitter, mm', ylabel='position error, mm')
    right.set(xlabel='multiple of sigma', ylabel='share of the errors within', ylim=(0, 1.02))
    for panel in (left, right):
        panel.grid(alpha=0.3)
    html.legend_beside(figure, below=1.0)
    return figure


FIGURES = {
    'error_over_time': 'Error over time; marks below: frames without a pose',
    'error_over_space': 'Error over the volume',
    'error_by_coil': 'Errors by coil and body: median, quartiles, 5 and 95 %',
    'sigma_and_error': "Errors against the poses' own sigma and the optical jitter",
}
"""Figures by the names of their files, with what they show."""


def write_figures(
    evaluation: Evaluation, document: Mapping[str, Any], folder: Path, *, session: str,
    model: str, jitter_m: float = 0.0,
) -> list[Path]:  # fmt: skip
    """Write every figure and the page that holds them; return the files.

    Without an optical pose there is no error, and nothing is drawn or written.
    """
    found = _series(evaluation)
    if not any(np.isfinite(series.position_error).any() for series in found.values()):
        return []
    parts: list[html.Html] = []
    files = []
    drawn = (
        over_time(evaluation), over_space(evaluation), by_coil(evaluation),
        against_sigma(evaluation, jitter_m),
    )  # fmt: skip
    for (name, title), figure in zip(FIGURES.items(), drawn, strict=True):
        files.append(folder / f'{name}.png')
        html.save(figure, files[-1])
        parts += [html.heading(title), html.picture(files[-1])]
    head = html.top('Evaluation', session=session, model=model)
    text = html.page('Evaluation', head, html.table(ERRORS_HEAD, error_rows(document)), parts)
    files.append(folder / 'evaluation.html')
    files[-1].write_text(text, encoding='utf-8')
    return files


def error_rows(document: Mapping[str, Any]) -> list[list[str]]:
    """Return the errors of every sensor, body and source as rows of a table."""
    return [
        [
            f'source seen from {name}' if group == 'sources' else name,
            str(row['n']),
            f'{row["tracked_fraction"]:.1%}',
            *(output.number(row[f'position_{key}_m'], 1e3) for key in ('rmse', 'prc95')),
            *(output.number(row[f'orientation_{key}_rad'], DEGREES) for key in ('rmse', 'prc95')),
        ]
        for group in ('sensors', 'bodies', 'sources')
        for name, row in document.get(group, {}).items()
    ]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        'example: anser evaluate bags/metal.mcap --model config/demo_model.yaml'
        ' --refit --baseline bags/scan.mcap --out refit/'
    )
    sessions.add_session_options(parser, 'track', 'evaluation.json', 'optical_rotation_rad')
    words = 'let the model follow the reference sensors'
    parser.add_argument('--refit', action='store_true', help=words)
    words = 'reference sensors that the refit may use; the others are ignored'
    parser.add_argument('--references', metavar='CHANNEL,...|none', help=words)
    parser.add_argument(
        '--witnesses', action='store_true',
        help='let the refit also use contradictions among the coils of rigid tools; for few '
        'references',
    )  # fmt: skip
    words = "use in-phase fluxes only, the article's way"
    parser.add_argument('--in-phase', action='store_true', help=words)
    parser.add_argument(
        '--gate', type=float, default=TrackerSettings().gate,
        help='largest residual of a pose, in units of the expected one; inf withholds none (only '
        'to see the error that a wrong model would cause)',
    )  # fmt: skip


def work(args: argparse.Namespace, tell: output.Tell) -> output.Result:
    """Evaluate the session of the arguments into its folder; several one after the other."""
    return sessions.on_each('evaluate', _one, args, tell)


def _one(args: argparse.Namespace, tell: output.Tell) -> output.Result:
    for name in ('witnesses', 'references', 'baseline'):
        if getattr(args, name) and not args.refit:
            raise ParameterError(f'--{name} is of a refit; it needs --refit')
    idle = () if args.refit else SECTIONS['refit']
    session, model, baseline, told = sessions.given(args, idle, '--refit')
    if args.references is not None:
        session = with_references(session, parse_references(args.references))
    evaluation = track_session(
        session, model, TrackerSettings(gate=args.gate), baseline=baseline, refit=args.refit,
        in_phase=args.in_phase, witnesses=args.witnesses,
        progress=lambda share: tell('tracking', share),
    )  # fmt: skip
    document = to_document(evaluation)
    # What was recorded, whatever the file is called.
    document['recording'] = fingerprint_of([tool.flux[:, :1] for tool in session.tools])
    if why := why_withheld(model, evaluation, session):
        document['withheld'] = why[0]
    written = list(output.write_files(args.out, {'evaluation.json': document}))
    written += write_tables(args.out, evaluation)
    written += write_figures(
        evaluation, document, args.out, session=args.session, model=args.model,
        jitter_m=session.setup.accuracy.optical_position_m,
    )[-1:]  # fmt: skip
    shown: list[Any] = [output.terminal_table(ERRORS_HEAD, error_rows(document))]
    if refit := document.get('refit'):
        states = ', '.join(f'{name} in {count} frames' for name, count in refit['states'].items())
        out = ', '.join(f'{name} in {count}' for name, count in refit['left_out'].items())
        shown.append(f'refit: {states or "no frame"}; left out: {out or "no reference"}')
    strengths = evaluation.strengths
    notes = (
        *told,
        *((_few_notes(session) if args.refit else ()) or why),
        *(one.words for one in evaluation.disagreements),
        *((f'emitters differ from the model, tools say: {strengths}',) if strengths else ()),
    )
    return output.Result(document, notes, tuple(shown), tuple(written))


def _few_notes(session: Session) -> tuple[str, ...]:
    """State why a refit gives no pose, where it has fewer references than it takes."""
    count = 0 if session.reference is None else len(session.reference.sensors)
    need = session.setup.refit.min_references
    if count >= need:
        return ()
    return (
        f'a refit with {count} reference sensors gives no pose, because min_references is '
        f'{need}; evaluate without --refit, or --set min_references={max(count, 1)}',
    )


def _read_as(session: Session, model: FieldModel) -> str:
    """What fluxes read like at their poses: wired otherwise than a model says, as `diagnose` names
    it, or all that many times as large; empty without poses.
    """
    try:
        problem = problem_of(correct(prepare(session, model))).thinned(WIRING_FRAMES)
    except DiagnosisError:
        return ''
    if wired := ', '.join(term.label for term in wiring_faults(problem)):
        return f'they read like {wired}; anser diagnose writes a model with that'
    gain = common_gain(problem)
    made = f'fluxes are {gain or 1.0:.4g} times what the model makes at their poses'
    return f'{made}: another coil, other currents, or another unit?' if gain else ''


def why_withheld(model: FieldModel, evaluation: Evaluation, session: Session) -> tuple[str, ...]:
    """State why hardly a body, or else a coil, has a pose, or most misfit a known model."""
    known = sorted({channel for effect in model.effects for channel in effect.channels})
    of_bodies = any(2 * body.ok.mean() > 1 for body in evaluation.bodies.values())
    asked = evaluation.sensors if of_bodies else evaluation.bodies or evaluation.sensors
    poses = [pose for series in asked.values() for pose in series.estimates]
    found = Counter(pose.state for pose in poses)
    worst, count = max(found.items(), key=lambda one: (one[0] != OK, one[1]), default=(OK, 0))
    is_other = worst == RESIDUAL and known and 2 * count > len(poses)
    if worst == OK or (found[OK] > HARDLY * len(poses) and not is_other):
        return ()
    whose = 'most poses of single coils are' if of_bodies else 'most poses are'
    reasons = [pose.reason for pose in poses if pose.state == worst and pose.reason]
    such = f' ({reasons[len(reasons) // 2]})' if reasons else ''
    words = f'{whose} withheld, state {worst} in {count} of {len(poses)}{such}'
    if worst != RESIDUAL:
        return (words,)
    if read_as := _read_as(session, model):
        return (f'{words}: {read_as}',)
    listed = f'the coils of its calibration (channels {", ".join(map(str, known))})'
    return (
        f'{words}: the model knows {listed if known else "no coil by itself"}; any other, 2 % '
        'and 1 deg off as wound by hand, needs a calibration with it; anser diagnose names what '
        'else differs, as metal does',
    )
