"""Places of reference coils: chosen by the error that they leave, from what a user can use."""

import itertools
import json

import numpy as np
import pytest
from refit_world import anser_world

from anser_ros.apps.planning.design import choose, expected_errors, family, random_designs
from anser_ros.cli.main import main
from anser_ros.refit.clouds import Excitation, Region, region_of
from anser_ros.settings import RefitSettings

UNCORRECTED_M = 5e-3
K = 8


@pytest.fixture(scope='module')
def metals():
    """The family of metals, for ten coils around the board."""
    world = anser_world(32)
    whole = region_of(world.board.field)
    excitation = Excitation('board', np.ones(K, dtype=complex), world.board.field)
    return family(
        world.references.select(np.arange(0, 30, 3)), excitation,
        Region(whole.centre, whole.half), world.model.frequencies_hz, RefitSettings(),
        ('below',), UNCORRECTED_M,
    )  # fmt: skip


def test_more_coils_leave_less_error(metals):
    errors = [design.error_m for design in choose(metals, 10, K)]
    assert len(errors) == 10
    assert (np.diff(errors) < 0.0).all()
    assert errors[0] < UNCORRECTED_M
    np.testing.assert_allclose(expected_errors(metals, (), K), UNCORRECTED_M)
    one, other = (expected_errors(metals, order, K) for order in ((7, 2, 5), (2, 5, 7)))
    np.testing.assert_allclose(one, other)
    twice = expected_errors(metals, (0, 4), K)
    assert (twice < expected_errors(metals, (0,), K)).all()


def test_the_choice_is_about_the_best_of_all(metals):
    every = [
        float(np.sqrt(np.mean(expected_errors(metals, pick, K) ** 2)))
        for pick in itertools.combinations(range(10), 3)
    ]
    chosen = choose(metals, 3, K)[-1]
    assert len(set(chosen.coils)) == 3
    assert chosen.error_m <= min(every) * 1.05
    drawn = random_designs(metals, 3, K, 20, np.random.default_rng(1))
    assert chosen.error_m < np.mean([design.error_m for design in drawn])


@pytest.mark.long
def test_a_list_of_places_gives_a_table_and_a_picture(tmp_path, capsys):
    angle = np.linspace(0.0, 2.0 * np.pi, 7)[:-1]
    lines = ['x_m,y_m,z_m', *(f'{0.17 * np.cos(a)},{0.17 * np.sin(a)},0.05' for a in angle)]
    places = tmp_path / 'places.csv'
    places.write_text('\n'.join(lines) + '\n')
    arguments = ['place', 'demo_setup.yaml', '--references', '3', '--from', str(places), '--json']
    assert main([*arguments, '--metal', 'below', '--out', str(tmp_path / 'out')]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document == json.loads((tmp_path / 'out' / 'places.json').read_text())
    assert [row['references'] for row in document['expected']] == [1, 2, 3]
    for row in document['places']:
        assert np.hypot(*row['position_m'][:2]) == pytest.approx(0.17)
        assert np.linalg.norm(row['axis']) == pytest.approx(1.0)
    random = document['random'][-1]
    assert document['expected'][-1]['error_m'] <= random['best_error_m'] * 1.01
    assert len((tmp_path / 'out' / 'places.csv').read_text().splitlines()) == 4
    assert (tmp_path / 'out' / 'places.png').stat().st_size > 5000


@pytest.mark.parametrize(('scale', 'said'), [(1e3, ': millimetres?'), (3e4, ' within 1.')])
def test_coils_that_receive_nothing_are_refused(scale, said, tmp_path, capsys):
    places, far = tmp_path / 'places.csv', 0.1 * scale
    places.write_text(f'x_m,y_m,z_m\n{far},{far},{far / 2}\n{-far},{far},{far / 2}\n')
    command = ['place', 'demo_setup.yaml', '--references', '2', '--from', str(places)]
    assert main([*command, '--out', str(tmp_path / 'out')]) == 2
    words = capsys.readouterr().err
    assert 'coils lie up to' in words and said in words


@pytest.mark.parametrize(
    ('count', 'more', 'said'),
    [
        ('0', '', 'coils to choose from'), ('99', '', 'coils to choose from'),
        ('2', '--metal above', '--metal'), ('2', '--error-mm -1', '--error-mm'),
        ('2', '--from plane=x', 'height'), ('2', '--from plane=50', 'are in m'),
        ('2', '--from nowhere.csv', 'nowhere.csv'),
    ],
)  # fmt: skip
def test_bad_input_is_one_line(count, more, said, tmp_path, capsys):
    command = ['place', 'demo_setup.yaml', '--references', count, *more.split()]
    assert main([*command, '--out', str(tmp_path / 'out')]) == 2
    words = capsys.readouterr().err
    assert said in words
    assert len(words.splitlines()) == 1
    assert not (tmp_path / 'out').exists()
