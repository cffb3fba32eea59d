"""The search for effects: finds what is there, leaves out what is not, prefers the simple."""

import numpy as np
import pytest

from anser_ros.measured.candidates import grow, search_text


def regression(truth, columns, noise, rng, blocks=8, rows=20):
    """Score of least squares on the named columns, block by block left out."""
    x = {name: rng.normal(size=(blocks, rows, width)) for name, width in columns.items()}
    y = sum(np.sum(x[name], axis=2) * size for name, size in truth.items())
    y = y + noise * rng.normal(size=(blocks, rows))

    def score(names):
        power = []
        for b in range(blocks):
            rest = np.arange(blocks) != b
            matrix = np.concatenate([np.zeros((blocks, rows, 1)), *(x[n] for n in names)], axis=2)
            inside = matrix[rest].reshape(-1, matrix.shape[2])
            solution = np.linalg.lstsq(inside, y[rest].ravel(), rcond=None)[0]
            power.append(np.mean((y[b] - matrix[b] @ solution) ** 2))
        return np.array(power)

    return score


def test_finds_the_effects_that_are_there():
    rng = np.random.default_rng(1)
    columns = {'a': 1, 'b': 1, 'c': 1, 'many': 12}
    search = grow(tuple(columns), regression({'a': 1.0, 'c': 0.5}, columns, 0.1, rng))
    assert set(search.chosen) == {'a', 'c'}
    assert search.end == pytest.approx(0.1, rel=0.2)
    assert search.end < search.start


def test_clean_data_choose_nothing():
    rng = np.random.default_rng(3)
    columns = dict.fromkeys('abcdef', 2)
    search = grow(tuple(columns), regression({'a': 0.0}, columns, 1.0, rng))
    assert search.chosen == ()


def test_of_two_that_score_alike_the_smaller_wins():
    def score(names):
        wiggle = np.array([0.99, 1.0, 1.01, 1.0])
        return wiggle if not names else 0.1 * wiggle[::-1] * (0.999 if 'large' in names else 1.0)

    assert grow(('large', 'small'), score, {'large': 9, 'small': 1}).chosen == ('small',)


def test_an_effect_that_others_made_idle_is_taken_back():
    table = {
        (): 10.0,
        ('rough',): 3.0,
        ('x',): 6.0,
        ('y',): 7.0,
        ('rough', 'x'): 2.0,
        ('rough', 'y'): 2.9,
        ('x', 'y'): 0.5,
        ('rough', 'x', 'y'): 0.5,
    }
    wiggle = np.array([0.995, 1.0, 1.005])
    search = grow(('rough', 'x', 'y'), lambda names: table[tuple(sorted(names))] * wiggle)
    assert set(search.chosen) == {'x', 'y'}
    assert any(trial.name == '-rough' for trial in search.trials)


def test_text_shows_every_candidate():
    search = grow(('one', 'two'), lambda names: np.array([1.0, 2.0]) / (1 + 9 * ('two' in names)))
    text = search_text('title', search, 'mm')
    assert 'one' in text and 'two' in text and '<- chosen' in text
