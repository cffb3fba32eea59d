"""What `evaluate` draws is what was found, and a session without optics draws nothing."""

from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pytest

from anser_ros.cli import evaluate as figures
from anser_ros.cli.calibrate import population_figure, population_table, populations
from anser_ros.field.model import EffectRecord
from anser_ros.pose_states import OK
from anser_ros.sessions.evaluation_files import to_document
from anser_ros.sessions.tracked_session import Evaluation, PoseSeries

FRAMES = 200


def series(name, scale, rng, lost=()):
    """Errors that are half-normal of the sigma told, times a scale."""
    sigma = np.linspace(0.1e-3, 1e-3, FRAMES)
    error = scale * sigma * np.abs(rng.normal(size=FRAMES))
    error[list(lost)] = np.nan
    estimates = tuple(
        SimpleNamespace(
            stamp_ns=1_750_000_000_000_000_000 + 20_000_000 * i,
            position=np.array([1e-3 * i, 0.0, 0.15]),
            sigma_position_m=float(sigma[i]),
            state='residual' if i in lost else OK,
        )
        for i in range(FRAMES)
    )
    return PoseSeries(name, estimates, error, error)


@pytest.fixture
def evaluation():
    rng = np.random.default_rng(2)
    sensors = {n: series(n, 1.0, rng, lost) for n, lost in (('a/x', ()), ('a/y', (3, 4)))}
    return Evaluation(sensors, {'a': series('a', 3.0, rng)}, 1e-3)


def test_sigma_that_is_too_small_shows(evaluation):
    """Of half-normal errors 68 % lie within a sigma; of ones three times as large, 26 %."""
    left, right = figures.against_sigma(evaluation).axes
    at_one = int(np.argmin(np.abs(figures.COVERAGE_SIGMAS - 1.0)))
    narrow, wider = figures.against_sigma(evaluation, jitter_m=1.0).axes
    assert (left.get_xscale(), narrow.get_xscale()) == ('log', 'linear'), 'labels have room'
    assert wider.lines[2].get_ydata()[at_one] == 1.0, 'a jitter of 1 m explains all'
    shares = [line.get_ydata()[at_one] for line in right.lines]
    assert shares[0] == pytest.approx(0.68, abs=0.1) and shares[2] == pytest.approx(0.26, abs=0.1)
    plt.close('all')


@pytest.mark.long
def test_the_page_holds_all_figures(evaluation, tmp_path):
    document = to_document(evaluation)
    files = figures.write_figures(
        evaluation, document, tmp_path, session='run <1>.mcap', model='nominal'
    )
    assert {path.name for path in files} == {
        'evaluation.html', *(f'{name}.png' for name in figures.FIGURES)
    }  # fmt: skip
    text = (tmp_path / 'evaluation.html').read_text()
    assert text.count('data:image/png;base64,') == len(figures.FIGURES)
    assert 'run &lt;1&gt;.mcap' in text and 'http' not in text
    nothing = np.full(FRAMES, np.nan)
    blind = PoseSeries('a', evaluation.bodies['a'].estimates, nothing, nothing)
    seen = Evaluation({'a': blind}, {}, 1e-3)
    assert not figures.write_figures(seen, document, tmp_path / 'none', session='', model='')


def record(name, values, channels=(0, 1, 2)):
    sigma = np.full(np.shape(values), 1e-4).tolist()
    return EffectRecord(
        name, {'spread': 2e-3, 'channels': list(channels), 'values': values, 'uncertainty': sigma}
    )


GAINS = record('sensor_gain_spread', [[1.002, 0.001], [0.999, 0.0], [1.0, -0.003]])
PLACES = record('sensor_place_spread', [[1e-4, 0.0, -2e-4], [0.0, 3e-5, 0.0]], (1, 4))
PICKUP = record('sensor_pickup_spread', [[3e-9, 4e-9, 0.0, 0.0], [0.0] * 4, [1e-9] * 4])
SINGLE = EffectRecord('sensor_gain', {'channel': 3, 'gain': 1.1})


def test_every_channel_has_its_values_and_their_sigma():
    head, rows = population_table([GAINS, SINGLE, PLACES])
    assert head[1] == 'sensor_gain_spread in phase, %'
    assert head[-1] == 'sensor_place_spread z, mm'
    assert [row[0] for row in rows] == ['0', '1', '2', '4']
    assert rows[0][1:4] == ['0.2000 ± 0.0100', '0.1000 ± 0.0100', '']
    assert rows[1][3:] == ['0.1000 ± 0.1000', '0.0000 ± 0.1000', '-0.2000 ± 0.1000']


def test_many_values_of_a_channel_are_summed_up():
    head, rows = population_table([PICKUP])
    assert head == ['channel', 'sensor_pickup_spread rms, nT']
    assert rows[0][1].startswith('2.5000 ±')


def test_without_a_population_there_is_nothing_to_show():
    assert populations([SINGLE]) == []
    assert population_table([SINGLE])[1] == []
    assert population_figure([SINGLE]) is None
