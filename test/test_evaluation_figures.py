"""What `evaluate` draws is what was found, and a session without optics draws nothing."""

from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pytest

from anser_ros.cli import evaluate as figures
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


def test_errors_and_lost_frames_over_time(evaluation):
    upper, lower = figures.over_time(evaluation).axes
    x = upper.lines[0].get_xydata()
    np.testing.assert_allclose(x[:, 0], 0.02 * np.arange(FRAMES), atol=1e-6)
    np.testing.assert_allclose(x[:, 1], 1e3 * evaluation.sensors['a/x'].position_error)
    assert [len(line.get_xdata()) for line in lower.lines] == [0, 2, 0] and not lower.texts
    plt.close('all')


def test_the_place_of_every_pose_has_its_error(evaluation):
    above = figures.over_space(evaluation).axes[0].collections[0]
    places, colours = above.get_offsets(), above.get_array()
    assert len(places) == 2 * FRAMES - 2
    np.testing.assert_allclose(places[5], [5.0, 0.0], atol=1e-9)
    assert colours[5] == pytest.approx(1e3 * evaluation.sensors['a/x'].position_error[5])
    plt.close('all')


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
