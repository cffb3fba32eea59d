"""Shows the diagnosis of a session of few poses as a self-contained page."""

from collections.abc import Iterator
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from anser_ros.apps.lab.few_poses import FewPosesDiagnosis, residual_power
from anser_ros.apps.lab.still import PLACEMENT
from anser_ros.cli.diagnose import effects_section, population_sections
from anser_ros.cli.diagnosis_words import LONGEST, flux_unit, held_out_rows, verdict
from anser_ros.cli.page import (
    AFTER,
    BEFORE,
    heading,
    legend_under,
    page,
    paragraph,
    picture,
    table,
    top,
)

FAR = 3.0
"""Times the median channel's residual to be named: noise of a dozen readings does not make it."""


def render(
    result: FewPosesDiagnosis, document: dict[str, Any], *, session: str, model: str
) -> str:
    """Return the page of a diagnosis, and of the document that describes it, as HTML."""
    return page(
        'Diagnosis',
        top('Diagnosis', verdict(document), session=session, model=model),
        heading(
            'Before and after',
            'This session has too few poses to test a field model, so the field is estimated anew '
            'from it, together with what is wrong with the sensors. What is predicted takes no '
            'part: each pose is predicted from the others, or for a body at one place each fifth '
            f'of its sensors from the rest. Where poses were not as stated ({PLACEMENT}), each '
            'half of the sensors is predicted at the pose that the other half finds.',
        ),
        table(['', 'before', 'after'], held_out_rows(document)),
        _by_pose(result),
        effects_section(document),
        _poses(result),
        _sureness(result),
        population_sections(result.model.effects),
        heading('What remains', 'The held-out residual with everything corrected.'),
        picture(_remainder(result)),
        _largest(result),
        map(paragraph, result.after.undetermined),
    )


def _by_pose(result: FewPosesDiagnosis) -> Iterator[str]:
    """A table of each pose's prediction, where there are several."""
    pair = [calibration.held_out for calibration in (result.before, result.after)]
    if any(len(one.frame_rmse_t) < 2 for one in pair):
        return
    factor, unit = flux_unit(float(pair[0].frame_rmse_t.max()))
    columns = []
    for one in pair:
        order = np.lexsort(np.round(one.place, 6).T)
        columns.append(zip(one.place[order], factor * one.frame_rmse_t[order], strict=True))
    rows = [
        [_place(place), f'{old:.4g}', f'{new:.4g}']
        for (_, old), (place, new) in zip(*columns, strict=True)
    ]
    yield table(['pose at x, y, z, mm', f'before, {unit} rms', f'after, {unit} rms'], rows)


def _place(position_m: Any) -> str:
    return ', '.join(f'{1e3 * v:.1f}' for v in position_m)


def _poses(result: FewPosesDiagnosis) -> Iterator[str]:
    """How far the poses are from where they were stated, in a table where that is an effect."""
    survey = result.after.scan.sensor_fit
    if survey is None:
        return
    off = survey.optical
    yield paragraph(
        f'The body stood {1e3 * off.position_m:.2f} mm and {1e3 * off.rotation_rad:.2f} '
        'mrad (rms a component) from where its poses were stated.'
    )
    (measured,) = result.after.scan.measurements
    for record in result.effects:
        if record.name != PLACEMENT:
            continue
        value, sigma = (
            1e3 * np.hstack([part['shift_m'], part['rotation_rad']])
            for part in (record.parameters, record.uncertainty)
        )
        yield table(
            ['stated at x, y, z, mm', 'stood further by x, mm', 'y', 'z',
             'turned about x, mrad', 'y', 'z'],
            [
                [_place(at), *(f'{v:.2f} ± {s:.2f}' for v, s in zip(*pair, strict=True))]
                for at, *pair in zip(measured.position, value, sigma, strict=True)
            ],
        )  # fmt: skip


def _sureness(result: FewPosesDiagnosis) -> Iterator[str]:
    """How sure each effect is, and the channels that are too many for the table of effects."""
    for record in result.effects:
        gain = record.evidence.get('log_probability')
        channels = record.parameters.get('channels', [])
        text = [] if gain is None else [f'raises the log probability of all by {gain:.1f}']
        if len(channels) > LONGEST and 'values' not in record.parameters:
            text.append(f'concerns {len(channels)} channels: {", ".join(map(str, channels))}')
        if text:
            yield paragraph(f'{record.name} {" and ".join(text)}.')


def _largest(result: FewPosesDiagnosis) -> Iterator[str]:
    """Which sensors what remains is mostly of."""
    size = np.sqrt(np.nanmean(residual_power(result.after), axis=(0, 2)))
    sensors = result.after.scan.measurements[0].sensors
    far = np.flatnonzero(size > FAR * np.nanmedian(size))
    if far.size:
        first = far[np.argsort(-size[far])][:LONGEST]
        named = ', '.join(f'{sensors.name[k]} (channel {sensors.channel[k]})' for k in first)
        yield paragraph(
            f'{far.size} channels leave more than {FAR:g} times as much as the median channel: '
            f'{named}{" and others" if far.size > first.size else ""}. Look at these sensors, at '
            'what is next to them, and at how they are mounted.'
        )


def _remainder(result: FewPosesDiagnosis) -> Figure:
    """Draw what remains by channel, and by emitter and pose."""
    power = residual_power(result.after)
    before = float(np.sqrt(np.mean(np.abs(result.before.held_out.error) ** 2)))
    factor, unit = flux_unit(before)
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(10, 3.4), layout='constrained', width_ratios=(3, 1)
    )
    channel = result.after.scan.measurements[0].sensors.channel
    left.plot(channel, factor * np.sqrt(np.nanmean(power, axis=(0, 2))), '.', color=AFTER)
    left.axhline(factor * before, color=BEFORE, label='all channels before')
    left.axhline(factor * result.floor_t, color='0.5', label='noise')
    left.set(xlabel='channel', ylabel=f'residual, {unit} rms', ylim=(0.0, None))
    legend_under(left, 0.2)
    emitters = result.model.emitters
    for frame, row in enumerate(np.sqrt(np.nanmean(power, axis=1))):
        label = f'pose {frame + 1}' if len(power) > 1 else None
        right.plot(emitters, factor * row, 'o', label=label)
    right.set(xlabel='emitter', ylim=(0.0, None))
    if len(power) > 1:
        legend_under(right, 0.2)
    for panel in (left, right):
        panel.grid(alpha=0.3)
    return figure
