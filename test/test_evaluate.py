"""`anser evaluate` on bags of our own simulator: accuracy, honest uncertainty, files, figures."""

import csv
import dataclasses
import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from conftest import REPO

from anser_ros.cli import evaluate as figures
from anser_ros.cli.calibrate import population_figure, population_table, populations
from anser_ros.cli.main import main
from anser_ros.errors import BagError, ParameterError
from anser_ros.field.model import EffectRecord
from anser_ros.physics.rotations import rotation_of_vector
from anser_ros.pose_states import OK
from anser_ros.sessions import session
from anser_ros.sessions.baseline import baseline_flux
from anser_ros.sessions.disagreement import disagreement
from anser_ros.sessions.follower import RefitSummary, parse_references, with_references
from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import load_model
from anser_ros.sessions.tracked_session import Evaluation, PoseSeries, to_document, track_session
from anser_ros.settings import Accuracy
from anser_ros.tracking.estimate import TrackerSettings

pytestmark = pytest.mark.usefixtures('shared_tables')
BAGS = REPO / 'bags'
OPTICAL_JITTER_M = 0.12e-3
FIGURES = {
    f'{what}_{statistic}_{unit}'
    for what, unit in (('position', 'm'), ('orientation', 'rad'))
    for statistic in ('rmse', 'me', 'prc50', 'prc95')
} | {'n', 'tracked_fraction'}


@pytest.fixture(scope='module')
def model() -> Path:
    return BAGS.parent / 'config' / 'demo_model.yaml'


@pytest.fixture(scope='module')
def moving(model):
    return track_session(load_session(BAGS / 'moving.mcap'), load_model(model))


def test_every_frame_is_tracked_to_the_optical_jitter_with_an_honest_sigma(moving):
    assert len(moving.sensors) == 9
    for series in moving.sensors.values():
        assert series.ok.mean() >= 0.99
        rmse = np.sqrt(np.nanmean(series.position_error**2))
        assert rmse < 0.16e-3
        assert np.sqrt(np.nanmean(series.orientation_error**2)) < np.radians(0.1)
    for series in moving.sensors.values():
        sigma = np.array([estimate.sigma_position_m for estimate in series.estimates])
        score = series.position_error / np.hypot(sigma, OPTICAL_JITTER_M)
        assert 1.1 < np.nanpercentile(score, 95) < 2.3


def test_a_pose_near_unmodelled_metal_is_withheld_unless_there_is_no_gate(model):
    evaluation = track_session(load_session(BAGS / 'metal.mcap'), load_model(model))
    for series in evaluation.sensors.values():
        assert 0.2 < series.ok.mean() < 0.9
        assert np.nanmax(series.position_error) < 2e-3
    settings = TrackerSettings(gate=math.inf)
    evaluation = track_session(load_session(BAGS / 'metal.mcap'), load_model(model), settings)
    for series in evaluation.sensors.values():
        assert {e.state for e in series.estimates} <= {'ok', 'outside_volume'}
        assert series.ok.mean() > 0.9
        assert np.nanmax(series.position_error) > 1e-3


@pytest.mark.long
def test_files_and_json_are_those_of_the_interfaces(model, tmp_path, capsys):
    arguments = ['evaluate', str(BAGS / 'moving.mcap'), '--model', str(model), '--json']
    assert main([*arguments, '--out', str(tmp_path)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document == json.loads((tmp_path / 'evaluation.json').read_text())
    assert document['schema'] == 'anser_evaluation/1'
    assert set(document['bodies']) == {'tool_a'}
    for row in [*document['sensors'].values(), *document['bodies'].values()]:
        assert set(row) == FIGURES
    lines = (tmp_path / 'poses.csv').read_text().splitlines()
    header = 'stamp_ns,sensor,x_m,y_m,z_m,ax,ay,az,sigma_position_m,residual_t,status'
    assert lines[0] == header
    rows = list(csv.DictReader(lines))
    assert len(rows) == 9 * 200
    assert {row['sensor'] for row in rows} == set(document['sensors'])
    good = [row for row in rows if row['status'] == 'ok']
    axes = np.array([[float(row[key]) for key in ('ax', 'ay', 'az')] for row in good])
    np.testing.assert_allclose(np.linalg.norm(axes, axis=1), 1.0, atol=1e-6)
    assert all(float(row['sigma_position_m']) > 0 for row in good)


@pytest.mark.long
@pytest.mark.parametrize(
    ('name', 'options', 'low_m', 'high_m'),
    [('calibrated', ['--in-phase'], 0.0, 0.25e-3), ('nominal', [], 0.3e-3, 1.0)],
)
def test_one_phase_suffices_without_metal_and_a_drawing_does_not(
    model, tmp_path, name, options, low_m, high_m
):
    used = ['--model', str(model) if name == 'calibrated' else name, *options]
    assert main(['evaluate', str(BAGS / 'moving.mcap'), *used, '--out', str(tmp_path)]) == 0
    rows = json.loads((tmp_path / 'evaluation.json').read_text())['sensors']
    errors = [row['position_rmse_m'] for row in rows.values()]
    assert max(errors) < high_m and rows['tool_a/2/y']['position_rmse_m'] > low_m


@pytest.mark.parametrize(
    ('record', 'moved_m'),
    [
        (EffectRecord('registration', {'rotation_deg': [0.0] * 3,
                                       'translation_m': [0.0, 0.0, 0.01]}), 0.01),
        (EffectRecord('time_offset', {'offset_s': 0.5}), None),
    ],
)  # fmt: skip
def test_the_truth_is_what_the_model_s_effects_make_of_it(model, moving, record, moved_m):
    wrong = dataclasses.replace(load_model(model), effects=(record,))
    session = load_session(BAGS / 'moving.mcap')
    body = track_session(session, wrong).bodies['tool_a']
    # The tool moves, so the poses half a second apart differ by what the track itself says.
    track = session.tools[0].track
    later = track.at(session.tools[0].time - 0.5, 0.1)
    apart = np.linalg.norm(later[0] - track.at(session.tools[0].time, 0.1)[0], axis=1)
    expected = np.full(len(apart), moved_m) if moved_m else np.where(later[2], apart, np.nan)
    assert np.nanmax(expected) > 5e-3
    np.testing.assert_allclose(body.position_error, expected, atol=1.5e-3)


def test_what_all_poses_and_the_reference_have_between_them_is_said(moving):
    (body,) = moving.bodies.values()
    place = np.array([estimate.position for estimate in body.estimates])
    turn = np.array([estimate.rotation for estimate in body.estimates])
    quarter = rotation_of_vector(np.array([0.0, 0.5 * np.pi, 0.0]))

    def found(position, rotation):
        return disagreement('tool', body.estimates, (position, rotation), Accuracy())

    def said(position, rotation):
        return ' '.join(one.words for one in found(position, rotation))

    assert moving.disagreements == () and said(place, turn) == ''
    assert said(place + [1e-4, 0.0, 0.0], turn) == ''  # three sigma are more
    assert 'in a frame that is 2.00 mm and 0.00 deg beside fg, ' in said(
        place + [0, 2e-3, 0], turn
    )
    assert '90.00 deg beside fg, 0.00 mm' in said(place @ quarter.T + 0.5, quarter @ turn)
    arm = place + turn @ [0.0, 0.0, 0.02]
    assert 'on a body mounted 20.00 mm and 90.00 deg otherwise' in said(arm, turn @ quarter)
    assert 'read as positions in millimetres' in said(1e3 * place, turn)
    assert 'read as rotations from fg to the body' in said(place, np.swapaxes(turn, 1, 2))
    words = said(place[::-1], turn[::-1])
    assert 'no frame, mounting, unit or order of axes explains that' in words
    assert said(np.full_like(place, np.nan), turn) == ''
    later = said(np.roll(place, 3, axis=0), np.roll(turn, 3, axis=0))
    assert 'read as stamped 0.12 s late, 0.00 mm' in later
    shift, small = [0.03, 0.0, 0.0], rotation_of_vector(np.array([0.0, 0.1, 0.0]))
    for position, rotation, is_stated in (
        (place + shift, turn, False), (place @ small.T, small @ turn, False),
        (place @ quarter.T, quarter @ turn, True), (place[:, [1, 0, 2]], turn, True),
        (place, turn @ quarter, False), (place[::-1], turn[::-1], False),
    ):  # fmt: skip
        (one,) = found(position, rotation)
        assert one.is_gross and one.is_stated is is_stated, one.words
    third = place.copy()
    third[: len(place) // 3] += [0.05, 0.0, 0.0]
    assert f'{len(place) // 3} of {len(place)} by more than 5.00 mm' in said(third, turn)


def test_parts_of_several_mountings_are_tracked_one_after_the_other(model, moving, monkeypatch):
    recorded = load_session(BAGS / 'moving.mcap')
    middle = recorded.tools[0].time[100]
    monkeypatch.setattr(session, 'times_of_mounting', lambda tool: [middle])
    found = track_session(recorded, load_model(model))
    assert found.groups.keys() == moving.groups.keys()
    for kind, group in moving.groups.items():
        for name, whole in group.items():
            parts = found.groups[kind][name]
            assert [e.stamp_ns for e in parts.estimates] == [e.stamp_ns for e in whole.estimates]
            both = parts.ok & whole.ok
            assert both.mean() > 0.97
            apart = np.abs(parts.position_error - whole.position_error)[both]
            assert np.median(apart) < 1e-5


def test_exchanged_emitters_are_named_where_no_pose_is_given(model):
    known, session = load_model(model), load_session(BAGS / 'moving.mcap')
    tool = session.tools[0].frames(np.arange(0, len(session.tools[0].time), 5))
    order = [0, 2, 1, *range(3, 8)]
    gains = np.linspace(0.8, 1.2, tool.flux.shape[1])[:, None]
    for flux, words in (
        (tool.flux[:, :, order], 'swapped_coils'),
        (1.5 * tool.flux, 'fluxes are 1.5 times what the model makes at their poses'),
        (gains * tool.flux, 'any other'),
    ):
        wrong = replace(session, tools=(replace(tool, flux=flux),), reference=None)
        (said,) = figures.why_withheld(known, track_session(wrong, known), wrong)
        assert 'state residual' in said and words in said
        assert ('wound by hand' in said) is (words == 'any other')


def test_a_baseline_whose_references_are_elsewhere_is_refused():
    clean = load_session(BAGS / 'factory.mcap')
    sensors = clean.reference.sensors
    assert np.isfinite(baseline_flux(clean, sensors)).all()
    moved = dataclasses.replace(sensors, position=sensors.position + [0.0, 0.02, 0.0])
    with pytest.raises(BagError, match='20 mm from where'):
        baseline_flux(clean, moved)


def test_a_refit_says_in_how_many_frames_it_did_what():
    summary = RefitSummary()
    for state, out in (('refit', ()), ('refit', ('ref/1',)), ('frozen', ('ref/1',))):
        summary.add(SimpleNamespace(state=state, left_out=out))
    document = to_document(Evaluation({}, {}, summary))
    assert document['refit'] == {'states': {'refit': 2, 'frozen': 1}, 'left_out': {'ref/1': 2}}
    assert 'refit' not in to_document(Evaluation({}, {}))


MODEL = REPO / 'config' / 'demo_model.yaml'
METAL = REPO / 'bags' / 'metal.mcap'


@pytest.fixture(scope='module')
def metal():
    """A few frames with metal near."""
    session = load_session(METAL)
    late = slice(-12, None)
    tools = tuple(tool.frames(late) for tool in session.tools)
    return replace(session, tools=tools, reference=session.reference.frames(late))


@pytest.mark.parametrize('text', ['', '1,1', '3,x', '3;4', 'None', '-1'])
def test_a_list_that_is_none_is_refused(text):
    assert parse_references('17, 20') == (17, 20) and parse_references('none') == ()
    with pytest.raises(ParameterError, match='references'):
        parse_references(text)


def test_the_chosen_references_are_all_that_a_session_has(metal):
    channels = metal.reference.sensors.channel
    chosen = with_references(metal, channels[[5, 2]].tolist()).reference
    assert chosen.sensors.channel.tolist() == channels[[2, 5]].tolist()
    np.testing.assert_array_equal(chosen.flux, metal.reference.flux[:, [2, 5]])
    with pytest.raises(BagError, match='no reference sensor on channel 9999'):
        with_references(metal, [int(channels[0]), 9999])
    with pytest.raises(BagError, match='no reference fluxes'):
        with_references(replace(metal, reference=None), [1])


@pytest.mark.long
@pytest.mark.usefixtures('shared_tables')
def test_without_enough_references_there_is_no_pose_near_metal(metal):
    model, clean = load_model(MODEL), load_session(REPO / 'bags' / 'factory.mcap')
    few, none = (
        track_session(
            with_references(metal, metal.reference.sensors.channel[:count].tolist()), model,
            baseline=clean, refit=True,
        )
        for count in (2, 0)
    )  # fmt: skip
    assert {e.state for s in few.sensors.values() for e in s.estimates} == {'references_lost'}
    alone = track_session(metal, model)
    for name, series in alone.sensors.items():
        states = [e.state for e in series.estimates]
        assert [e.state for e in none.sensors[name].estimates] == states
        assert 'residual' in states and 'ok' not in states, 'metal is noticed without references'
    (words,) = figures.why_withheld(model, alone, metal)
    assert 'state residual in' in words and 'the model knows' in words


@pytest.mark.parametrize(
    ('options', 'said'),
    [
        ('--model nominal --references none', '--references is of a refit; it needs --refit'),
        ('--model nominal --baseline x.mcap', '--baseline is of a refit; it needs --refit'),
        ('--poses --refit', 'without effect on a session of poses, leave out: --refit'),
        ('--model nominal --optical /x', '--optical has no effect without --poses'),
    ],
)
def test_options_without_effect_are_bad_usage(tmp_path, capsys, options, said):
    assert main(['evaluate', str(METAL), *options.split(), '--out', str(tmp_path)]) == 2
    assert said in capsys.readouterr().err


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
    return Evaluation(sensors, {'a': series('a', 3.0, rng)})


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
    seen = Evaluation({'a': blind}, {})
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


def test_every_channel_has_its_values_and_their_sigma_or_there_is_nothing_to_show():
    head, rows = population_table([GAINS, SINGLE, PLACES])
    assert head[1] == 'sensor_gain_spread in phase, %'
    assert head[-1] == 'sensor_place_spread z, mm'
    assert [row[0] for row in rows] == ['0', '1', '2', '4']
    assert rows[0][1:4] == ['0.2000 ± 0.0100', '0.1000 ± 0.0100', '']
    assert rows[1][3:] == ['0.1000 ± 0.1000', '0.0000 ± 0.1000', '-0.2000 ± 0.1000']
    head, rows = population_table([PICKUP])
    assert head == ['channel', 'sensor_pickup_spread rms, nT']
    assert rows[0][1].startswith('2.5000 ±')
    assert populations([SINGLE]) == []
    assert population_table([SINGLE])[1] == []
    assert population_figure([SINGLE]) is None
