"""Statistics of assessments: names and quartiles as MITK's, intervals that hold, Allan's laws."""

import numpy as np
import pytest

from anser_ros.apps.poses.assessment.intervals import (
    cluster_weights,
    deviation_interval,
    independent_for_variance,
    mitk_statistics,
    summarised,
)
from anser_ros.apps.poses.assessment.rest import allan_deviation, assess_rest
from anser_ros.apps.poses.sequence import sequence_of

pytestmark = pytest.mark.long

STILL = np.array([0.0, 0.0, 0.0, 1.0])


def test_names_and_quartiles_are_mitks():
    """Elements of the sorted list at n/4, n/2 and n/4 + n/2, rounded down; worked by hand."""
    found = mitk_statistics(np.array([5.0, 1.0, 4.0, 2.0, 3.0, 7.0, 6.0]))
    assert found == pytest.approx({
        'N': 7, 'Mean': 4, 'Min': 1, 'Max': 7, 'Quartile 1': 2, 'Median': 4, 'Quartile 3': 5,
        'Variance': 4, 'Sample Variance': 28 / 6, 'Standard Deviation': 2,
        'Sample Standard Deviation': np.sqrt(28 / 6),
    })  # fmt: skip


def test_intervals_of_clusters_hold_the_truth():
    """Errors in clusters that share a part: resampling single ones would be too narrow."""
    hits, narrow = [], []
    for seed in range(5000, 5060):
        rng = np.random.default_rng(seed)
        clusters = np.repeat(np.arange(20), 10)
        values = 3.0 + rng.normal(size=20)[clusters] + rng.normal(size=200)
        for box, labels, count in ((hits, clusters, 20), (narrow, np.arange(200), 200)):
            found = summarised(values, cluster_weights(labels, rng), count)['Mean']
            box.append(found.low < 3.0 < found.high)
    assert 0.86 < np.mean(hits) <= 1.0
    assert np.mean(narrow) < 0.75


def test_a_deviation_of_correlated_values_has_a_wider_interval():
    hits, widths = [], []
    for seed in range(5200, 5300):
        noise = np.random.default_rng(seed).normal(size=1200)
        values = np.zeros(1000)
        state = 0.0
        for k, step in enumerate(noise):
            state = 0.9 * state + step
            if k >= 200:
                values[k - 200] = state
        freedoms = independent_for_variance(values) - 1
        found = deviation_interval(float(np.std(values, ddof=1)), freedoms)
        hits.append(found.low < 1 / np.sqrt(1 - 0.81) < found.high)
        widths.append(freedoms)
    assert 0.85 < np.mean(hits) <= 1.0
    assert np.median(widths) < 250  # of a thousand values


@pytest.mark.parametrize(
    ('make', 'law'),
    [
        (lambda rng, n: rng.normal(size=n), lambda tau: np.sqrt(0.02 / tau)),
        (lambda rng, n: np.cumsum(rng.normal(size=n)), lambda tau: np.sqrt(50 * tau / 3)),
    ],
)
def test_allan_deviations_follow_their_laws(make, law):
    """White noise falls, and a random walk grows, as the root of the averaging time."""
    hits = []
    for seed in range(5300, 5312):
        curve = allan_deviation(make(np.random.default_rng(seed), 4000), 50.0)
        long = curve.tau_s > 0.3  # the discrete walk has reached its law
        low, high, true = curve.low_m[long], curve.high_m[long], law(curve.tau_s[long])
        hits += list((low < true) & (true < high))
    assert 0.88 < np.mean(hits) <= 1.0


def test_a_ramp_is_a_drift():
    time = np.arange(0, 200, 0.02)
    place = np.outer(time, [2e-6, 0, 0]) + 1e-4 * np.random.default_rng(1).normal(
        size=(time.size, 3)
    )
    poses = sequence_of('pen', time, place, np.tile(STILL, (time.size, 1)))
    estimates, allan, _ = assess_rest(poses)
    drift = estimates['position_drift_x_m_per_h']
    assert drift.low < 2e-6 * 3600 < drift.high and drift.low > 6e-3
    other = estimates['position_drift_y_m_per_h']
    assert other.low < 0 < other.high
    jitter = estimates['position_jitter_y_m']
    assert jitter.value == pytest.approx(1e-4, rel=0.03)
    assert jitter.low < jitter.value < jitter.high < 1.05 * jitter.value
    curve = allan['x']
    at = curve.tau_s > 30
    np.testing.assert_allclose(
        curve.deviation_m[at], 2e-6 * curve.tau_s[at] / np.sqrt(2), rtol=0.15
    )
