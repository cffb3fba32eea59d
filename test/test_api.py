"""The public library: its examples run, without ROS, and what it refuses it refuses in words."""

import doctest
import importlib
import json
import re
import runpy
import subprocess
import sys

import numpy as np
import pytest
from conftest import REPO

import anser_ros
from anser_ros import (
    Model,
    load_session,
    load_setup,
    plot_field,
    simulate,
    track,
    write_session,
)  # fmt: skip
from anser_ros.api.given import shown
from anser_ros.errors import BagError, FitError, ParameterError, PlausibilityError, SetupError

MODULES = (
    pytest.param('calibration', marks=pytest.mark.long),
    pytest.param('diagnosis', marks=pytest.mark.long),
    'design', 'model', 'recording', 'tracking',
)  # fmt: skip
# A meta path hook in whose presence nothing of ROS can be imported.
NO_ROS = """
import sys

class Refuses:
    def find_spec(self, name, path=None, target=None):
        first = name.split('.')[0]
        if first in ('rclpy', 'std_srvs', 'ament_index_python') or first.endswith('_msgs'):
            raise ImportError(f'{name}: there is no ROS here')

sys.meta_path.insert(0, Refuses())
"""
SETUP = {
    'schema': 'anser_setup/1',
    'flux_rate_hz': 50.0,
    'emitter': {
        'kind': 'circular_loop',
        'radius_m': 0.05,
        'coils': [
            {'name': f'k{k}', 'centre_m': [0.1 * k, 0, 0], 'frequency_hz': 1000 + 100 * k}
            for k in range(2)
        ],
    },
    'sensors': [
        {'channel': 7, 'name': 'ref', 'body': 'fg', 'position_m': [0, 0, 0.1], 'axis': [0, 0, 1]},
        {'channel': 3, 'name': 'pen/x', 'body': 'pen', 'position_m': [0, 0, 0], 'axis': [1, 0, 0]},
    ],
}


@pytest.fixture
def workshop(tmp_path, monkeypatch):
    """Stand in a folder with what the examples read, where they may write."""
    for folder in ('bags', 'config'):
        (tmp_path / folder).symlink_to(REPO / folder)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize('name', MODULES)
def test_examples_of_the_docstrings(workshop, name):
    module = importlib.import_module(f'anser_ros.api.{name}')
    outcome = doctest.testmod(module, optionflags=doctest.IGNORE_EXCEPTION_DETAIL)
    assert outcome.failed == 0 and outcome.attempted > 0


def test_every_public_name_is_there_and_documented():
    assert set(anser_ros.__all__) == set(anser_ros._HOMES) <= set(dir(anser_ros))
    page = (REPO / 'docs' / 'api.md').read_text(encoding='utf-8')
    told = re.findall(r'^\.\. auto(?:function|class):: (\w+)$', page, re.MULTILINE)
    assert sorted(told) == sorted(anser_ros.__all__)
    assert all(getattr(anser_ros, name).__doc__ for name in anser_ros.__all__)
    with pytest.raises(AttributeError, match='no attribute'):
        _ = anser_ros.nonsense


@pytest.mark.processes
def test_importing_the_package_loads_no_library():
    code = 'import sys, anser_ros; assert not {"numpy", "scipy", "yaml"} & set(sys.modules)'
    subprocess.run([sys.executable, '-P', '-c', code], cwd=REPO, check=True)


@pytest.mark.processes
def test_the_library_needs_no_ros(workshop):
    """As in a notebook on a laptop: every public name, and a session tracked."""
    code = (
        f'{NO_ROS}\nimport anser_ros as a\n[getattr(a, n) for n in a.__all__]\n'
        "m = a.Model.load('config/demo_model.yaml')\n"
        "a.calibrate(a.load_session('bags/factory.mcap'), dipoles=3, estimate=(), force=True)\n"
        "print(a.track(a.load_session('bags/moving.mcap'), m).bodies['tool_a'].ok.all())\n"
    )
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, cwd=workshop, check=False
    )
    assert (done.stdout, done.returncode) == ('True\n', 0), done.stderr


def poses(count, turn=(0.0, 0.0, 0.0, 1.0)):
    return np.arange(count) / 60.0, np.zeros((count, 3)), np.tile(turn, (count, 1))


class TestWriteSession:
    def test_round_trip(self, tmp_path):
        rng = np.random.default_rng(1)
        times = 5.0 + np.arange(4) / 50.0
        flux = 1e-6 * (rng.normal(size=(4, 2, 2)) + 1j * rng.normal(size=(4, 2, 2)))
        flux[2, 1] = np.nan
        given = (times, rng.normal(size=(4, 3)), np.tile([0.0, 0.0, 1.0, 0.0], (4, 1)))
        write_session(tmp_path / 'a.mcap', SETUP, times, flux, {'pen': given})
        session = load_session(tmp_path / 'a.mcap')
        (tool,), reference = session.tools, session.reference
        assert session.setup == load_setup(SETUP)
        np.testing.assert_allclose(reference.flux[:, 0], flux[:, 0], rtol=1e-6)
        np.testing.assert_allclose(tool.flux[:, 0], flux[:, 1], rtol=1e-6)
        np.testing.assert_allclose(tool.time, times - times[0], atol=1e-9)
        np.testing.assert_allclose(tool.position, given[1], atol=1e-12)
        assert tool.valid[:, 0].tolist() == [True, True, False, True]
        words = 'fluxes of pen are missing or not finite in 1 of 4 frames'
        assert session.lost == f'{words}; these readings are not used'

    def test_a_setup_of_numpy_s_numbers_is_one_of_python_s(self, tmp_path):
        setup = {**SETUP, 'flux_rate_hz': np.float64(50.0)}
        setup['sensors'] = tuple(
            {**one, 'channel': np.int64(one['channel']), 'axis': np.array(one['axis'])}
            for one in SETUP['sensors']
        )
        write_session(
            tmp_path / 'a.mcap', setup, np.arange(3), np.zeros((3, 2, 2)) + 1e-6,
            start_ns=np.int64(10**18),
        )  # fmt: skip
        assert load_session(tmp_path / 'a.mcap').setup == load_setup(SETUP)
        with pytest.raises(SetupError, match='text, numbers'):
            load_setup({**SETUP, 'flux_rate_hz': object()})

    def test_refusals(self, tmp_path):
        path, times, flux = tmp_path / 'a.mcap', np.arange(3), np.zeros((3, 2, 2))
        for arguments, said in (
            ((times, flux[:, :1]), r'flux must be \(times, sensors, coils\) = \(3, 2, 2\)'),
            ((times[::-1], flux), 'times must ascend'),
            (([], flux[:0]), 'list of finite numbers'),
            ((times, flux, {'pin': poses(3)}), "no body 'pin' in the setup: pen"),
            ((times, flux, {'pen': poses(3, (0, 0, 0, 2))}), 'quaternions of unit length'),
            ((times, flux, {'pen': poses(3)[:2] + poses(2)[2:]}), 'need positions'),
        ):
            with pytest.raises(ParameterError, match=said):
                write_session(path, SETUP, *arguments)
        with pytest.raises(ParameterError, match='start_ns'):
            write_session(path, SETUP, times, flux, start_ns=0)
        assert not path.exists()

    def test_a_bag_is_replaced_only_when_asked(self, tmp_path):
        path, times, flux = tmp_path / 'a.mcap', np.arange(3), np.full((3, 2, 2), 1e-9)
        write_session(path, SETUP, times, flux)
        with pytest.raises(BagError, match='already exists'):
            write_session(path, SETUP, times, flux)
        write_session(path, SETUP, 9 * times[:2], flux[:2], overwrite=True)
        assert load_session(path).tools[0].time.size == 2
        write_session(tmp_path / 'b.mcap', SETUP, times, flux)
        with pytest.raises(BagError, match='several sessions, of other boards or at the same'):
            load_session(tmp_path)


def test_what_is_none_is_refused(tmp_path):
    with pytest.raises(SetupError, match=r'none\.yaml'):
        load_setup(tmp_path / 'none.yaml')
    with pytest.raises(FitError, match='at least one session'):
        anser_ros.calibrate([])
    for axis, said in (([0.0, 0.0, 1.0], 'must both be'), ([[0.0, 0.0, 2.0]], 'unit vectors')):
        with pytest.raises(ParameterError, match=said):
            Model.nominal(SETUP).flux([[0.0, 0.0, 0.1]], axis)
    with pytest.raises(SetupError, match=r'none\.yaml: No such file'):
        load_setup(str(tmp_path / 'none.yaml'))
    assert load_setup(str(REPO / 'config/demo_setup.yaml')).bodies == ('tool_a',)


@pytest.mark.parametrize(
    ('call', 'said'),
    [
        (lambda s, m: load_session(5), 'a session is wanted as a path, got int'),
        (lambda s, m: Model.load(None), 'a model is wanted as a path, got NoneType'),
        (lambda s, m: load_setup(5), 'a setup document is wanted as a path'),
        (lambda s, m: m.save(1), 'a file to write is wanted'),
        (lambda s, m: write_session(5, SETUP, [], []), 'a file to write is wanted'),
        (lambda s, m: write_session('x.mcap', SETUP, ['a'], []), 'times must be numbers'),
        (lambda s, m: write_session('x.mcap', SETUP, [0.0], 'a'), 'flux must be complex'),
        (lambda s, m: track(s, 5), 'a model is wanted'),
        (lambda s, m: track(s, m, gate='wide'), 'gate must be numbers'),
        (lambda s, m: anser_ros.diagnose(None, m), 'a session is wanted as a path'),
        (lambda s, m: anser_ros.calibrate([s, 5]), 'a session is wanted as a path'),
        (lambda s, m: anser_ros.calibrate(s, dipoles='x'), 'dipoles must be a number'),
        (lambda s, m: anser_ros.calibrate(s, estimate=['x']), 'estimate must be some of'),
        (lambda s, m: m.flux('a', 'b'), 'positions must be numbers'),
        (lambda s, m: m.field([0.0, 0.0]), r'points must be \(\.\.\., 3\)'),
        (lambda s, m: plot_field(m, 'k9'), "no emitter 'k9'"),
        (lambda s, m: plot_field('nominal'), 'give Model.nominal'),
        (lambda s, m: m.field([0.0, 0.0, 150.0]), 'points must be finite and below 10 m'),
        (lambda s, m: m.flux([0.0, np.nan, 0.1], [0.0, 0.0, 1.0]), 'positions must be finite'),
        (lambda s, m: track(s, m, progress='x'), 'progress must be True or a function'),
        (lambda s, m: plot_field(m, normal='w'), 'normal must be x, y or z'),
        (lambda s, m: simulate(SETUP, 5), 'times, positions and quaternions'),
        (lambda s, m: simulate(SETUP, {}), 'poses at the same times of pen'),
        (lambda s, m: simulate(SETUP, poses(2), -1.0), 'noise must be T'),
        (lambda s, m: simulate(SETUP, poses(2), seed='a'), 'seed must be a whole number'),
        (lambda s, m: track(s, m, baseline=s), 'a baseline is of a refit'),
    ],
)
def test_what_is_of_another_type_is_refused_in_words(call, said):
    session = simulate(SETUP, poses(2))
    with pytest.raises(ParameterError, match=said):
        call(session, Model.nominal(SETUP))


def test_a_simulation_measures_the_field_of_its_model():
    """Without noise it is the flux of the model; sessions and models may be given as they are."""
    times, position, turn = poses(3)
    model = Model.nominal(SETUP)
    path = times, position + [0.0, 0.02, 0.1], turn
    session = simulate(SETUP, path, 0.0, model='nominal')
    with pytest.raises(PlausibilityError, match='lie 100 m from the board'):
        simulate(SETUP, (times, position + [0.0, 20.0, 98.0], turn))
    (tool,), place = session.tools, [[0.0, 0.02, 0.1]] * 3
    np.testing.assert_allclose(tool.flux[:, 0], model.flux(place, [[1.0, 0.0, 0.0]] * 3))
    np.testing.assert_allclose(model.field(place)[:, 0], tool.flux[:, 0])
    np.testing.assert_allclose(session.reference.flux[0, 0], model.field([0.0, 0.0, 0.1])[2])
    assert Model.load(model.field) == model
    assert model.field(np.zeros((0, 3))).shape == (0, *model.field(place).shape[1:])
    noisy = [simulate(SETUP, path, 1e-9, seed=s).tools[0].flux for s in range(40)]
    assert np.std(noisy, axis=0).mean() == pytest.approx(1.4e-9, rel=0.2)
    assert max(len(repr(one)) for one in (session, session.setup, tool, model, model.field)) < 200


def test_a_bar_is_drawn_on_the_standard_error(capsys):
    with shown(True, 'track') as tell:
        tell(0.5)
        tell('fit', 1.0)
    drawn = capsys.readouterr().err.split('\r')
    assert drawn[1].split() == ['track', f'[{"#" * 15}', ']', '50%'] and '100%' in drawn[2]
    with shown(None, 'track') as tell:
        assert tell is None


def test_tracks_are_saved_as_arrays(tmp_path):
    session = str(REPO / 'bags' / 'moving.mcap')
    result = track(session, str(REPO / 'config' / 'demo_model.yaml'))
    result.save(str(tmp_path / 'poses.npz'))
    assert len(repr(result)) < 2000 and 'tool_a: 200 of 200 frames' in repr(result)
    assert dict(result).keys() == set(result) and len(result) == len(result.values()) == 10
    with pytest.raises(KeyError, match="no 'nix'; there are: tool_a, "):
        result['nix']
    whole = result.to_dataframe()
    assert len(whole) == 2000 and set(whole['name']) == set(result)
    table = result['tool_a'].to_dataframe()
    np.testing.assert_array_equal(table['position_z_m'], result['tool_a'].position[:, 2])
    assert len(table) == 200 and set(table['state']) == {'ok'}
    with np.load(tmp_path / 'poses.npz') as saved:
        np.testing.assert_array_equal(saved['tool_a:position'], result['tool_a'].position)
        assert set(saved['tool_a/0/x:state']) == {'ok'}


EXAMPLES = REPO / 'examples'
SAID = {
    'own_data': 'model error on held-out places',
    'track_and_plot': '100% of 200 frames tracked',
    'find_an_effect': "sensor_gain {'channel': 4",
    'own_board': 'calibrated: 9',
    'batch': 'moving.mcap: 100% of 200 frames tracked',
}
# A whole diagnosis or calibration: some ten seconds on a quiet machine, a minute on a busy one.
SLOW = pytest.mark.long
LONG = ('find_an_effect', 'own_board', 'own_data')
NAMES = [pytest.param(n, marks=SLOW) if n in LONG else n for n in SAID]


@pytest.mark.parametrize('name', NAMES)
def test_example_runs(name, tmp_path, monkeypatch, capsys):
    arguments = [str(tmp_path / 'out')]
    if name == 'batch':  # two bags are as good as all
        bags = tmp_path / 'bags'
        bags.mkdir()
        (bags / 'moving.mcap').symlink_to(REPO / 'bags' / 'moving.mcap')
        (bags / 'none.mcap').write_text('no bag')
        arguments.append(str(bags))
    monkeypatch.setenv('MPLBACKEND', 'Agg')
    monkeypatch.setattr(sys, 'argv', [name, *arguments])
    runpy.run_path(str(EXAMPLES / f'{name}.py'), run_name='__main__')
    assert SAID[name] in capsys.readouterr().out


def test_every_example_is_run():
    assert {path.stem for path in EXAMPLES.glob('*.py')} == set(SAID)


def test_the_notebook_finds_a_layout(monkeypatch, capsys):
    """Its cells run in order; the best layout is better than the worst."""
    monkeypatch.setenv('MPLBACKEND', 'Agg')
    names = {}
    for cell in json.loads((EXAMPLES / 'design_coils.ipynb').read_text())['cells']:
        if cell['cell_type'] == 'code':
            exec(''.join(cell['source']), names)
    assert 'best 0.' in capsys.readouterr().out
    assert 0.0 < 1.5 * names['errors'].min() < names['errors'].max() < 5.0
