"""`anser calibrate` on bags: files, figures, refusals with the number needed and found."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from conftest import REPO

from anser_ros.calibration.calibrate import Options
from anser_ros.calibration.layouts import Layout
from anser_ros.calibration.sensor_parameters import KINDS
from anser_ros.cli import calibrate as command
from anser_ros.cli.main import main
from anser_ros.cli.output import loss_notes
from anser_ros.errors import FitError
from anser_ros.field.model import EffectRecord
from anser_ros.sessions.calibration import calibrate_sessions, check_explained, generator_of
from anser_ros.sessions.nominal_board import NominalBoard
from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import load_model
from anser_ros.sessions.tracked_session import track_session
from anser_ros.wire.bag_writer import SessionWriter
from anser_ros.wire.setup import dump_setup

BAGS = REPO / 'bags'
FACTORY = BAGS / 'factory.mcap'
START = 1_700_000_000_000_000_000


@pytest.fixture(scope='module')
def factory():
    return load_session(FACTORY)


def write_bag(path, setup, tool, *, poses=True, fluxes=True, with_setup=True):
    """A bag of one tool's frames; the stamps are a second apart."""
    topic, quaternion = f'/optical/{tool.body}/pose', np.array([0.0, 0.0, 0.0, 1.0])
    with SessionWriter(str(path)) as writer:
        if with_setup:
            writer.write_setup(dump_setup(setup), START)
        for frame in range(len(tool.time)):
            stamp = START + frame * 1_000_000_000
            if poses:
                writer.write_pose(topic, stamp, tool.position[frame], quaternion)
            if fluxes:
                writer.write_readings(setup.tool_sensors, stamp, tool.flux[frame])
    return path


def calibrate(*arguments):
    return main(['calibrate', *map(str, arguments)])


@pytest.mark.long
def test_calibration_json_and_the_model_are_those_of_the_interfaces(factory_calibration):
    document = json.loads((factory_calibration / 'calibration.json').read_text())
    assert document['schema'] == 'anser_calibration/1'
    assert document['n_measurements'] == 169 * 9
    assert document['n_dipoles'] == len(load_model(factory_calibration / 'model.yaml').positions)
    for key in ('flux_rmse_t', 'heldout_flux_rmse_t'):
        assert 0 < document[key] < 2e-9
        assert all(0 < emitter[key] < 2e-9 for emitter in document['emitters'])
    assert document['heldout_flux_rmse_t'] > document['flux_rmse_t']
    assert 0 < document['heldout_n_mae_percent'] < document['heldout_n_rmse_percent'] < 0.1
    assert [emitter['name'] for emitter in document['emitters']] == [f'coil{k}' for k in range(8)]
    curve = document['choice']['curve']
    assert len({row['layout'] for row in curve}) > 10
    assert {'layout', 'n_dipoles', 'damping', 'heldout_t'} == set(curve[0])
    assert (factory_calibration / 'choice.png').read_bytes()[:4] == b'\x89PNG'

    text = yaml.safe_load((factory_calibration / 'model.yaml').read_text())
    assert text['provenance']['sessions'] == ['factory.mcap']
    assert text['provenance']['heldout_flux_rmse_t'] > 0
    assert text['units']['moment'] == 'A m^2'
    assert 0 <= text['flux_error_t'] < 100e-12


@pytest.mark.long
def test_the_model_tracks_to_the_optical_jitter(factory_calibration):
    evaluation = track_session(
        load_session(BAGS / 'moving.mcap'), load_model(factory_calibration / 'model.yaml')
    )
    for series in evaluation.sensors.values():
        assert np.sqrt(np.nanmean(series.position_error**2)) < 0.16e-3


def test_what_a_scan_contained_is_shown_though_no_model_has_it(tmp_path, capsys, monkeypatch):
    metal = EffectRecord('moving_metal', {'t_start_s': 12.5, 't_end_s': 20.0})

    def with_metal(*arguments):
        found = calibrate_sessions(*arguments)
        return replace(found, scan=replace(found.scan, reported_effects=(metal,)))

    monkeypatch.setattr(command, 'calibrate_sessions', with_metal)
    arguments = (FACTORY, '--out', tmp_path / 'm.yaml', '--dipoles', '9x9', '--estimate', 'none')
    assert calibrate(*arguments) == 0
    (row,) = [line for line in capsys.readouterr().out.splitlines() if 'moving_metal' in line]
    assert 'not in the model' in row and 't_start_s 12.5' in row


@pytest.mark.long
def test_reference_sensors_take_no_part(factory):
    options = Options(layout=Layout('layer', 9, 1.25, 0.0))
    sessions = factory, replace(factory, reference=None)
    models = [calibrate_sessions([session], options).model for session in sessions]
    assert factory.reference is not None
    assert np.array_equal(models[0].moments, models[1].moments)


# Refusals.


def test_a_loss_that_an_error_says_is_not_said_again():
    lost = (
        SimpleNamespace(path='a', lost='x is dead?; 2 poses'),
        SimpleNamespace(path='b', lost=''),
    )
    assert loss_notes(*lost, None, said='a: x is dead? mend it') == ('a: 2 poses',)


def test_a_session_that_is_given_twice_is_refused(capsys, tmp_path):
    assert f'{FACTORY} is given twice' in refusal(
        capsys, FACTORY, FACTORY, '--out', tmp_path / 'm.yaml'
    )


def refusal(capsys, *arguments):
    assert calibrate(*arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ''
    # On a slow machine lines about the progress come before it.
    (line,) = [x for x in captured.err.splitlines() if not x.startswith('calibrate: ')]
    return line


@pytest.mark.parametrize(
    ('part', 'message'),
    [
        ('poses', 'at least 10 frames with a pose, got 0 of 169'),
        ('fluxes', 'no readable flux'),
        ('with_setup', 'no setup'),
    ],
)
def test_a_bag_that_lacks_something_is_refused(factory, tmp_path, capsys, part, message):
    # With a drawing, a tool needs no poses.
    emitter = replace(factory.setup.emitter, kind='something_else', geometry={})
    setup = replace(factory.setup, emitter=emitter)
    bag = write_bag(tmp_path / 'b.mcap', setup, factory.tools[0], **{part: False})
    assert message in refusal(capsys, bag, '--out', tmp_path / 'm.yaml')
    assert not (tmp_path / 'm.yaml').exists()


def test_two_drawings(factory, tmp_path, capsys):
    setup, tool = factory.setup, factory.tools[0]
    emitter, coils = setup.emitter, setup.emitter.coils
    moved = (*coils[:2], replace(coils[2], centre_m=(0.1, 0.1, 0.0)), *coils[3:])
    turned = tuple(replace(one, axis=(1.0, 0.0, 0.0)) for one in setup.sensors)
    for number, (changed, words) in enumerate((
        ({'emitter': replace(emitter, coils=moved)}, 'of one board: .*coil2'),
        ({'emitter': replace(emitter, coils=coils[:7])}, 'number of coils, 8 and 7'),
        ({'sensors': turned}, f'states other sensors of {tool.body} than sessions before'),
    )):  # fmt: skip
        other = replace(setup, **changed)
        part = replace(tool, flux=tool.flux[:, :, : len(other.emitter.coils)])
        bag = write_bag(tmp_path / f'{number}.mcap', other, part)
        assert re.search(words, refusal(capsys, FACTORY, bag, '--out', tmp_path / 'm.yaml'))


@pytest.mark.long
def test_a_model_worse_than_the_nominal_one_is_only_written_when_forced(factory, tmp_path, capsys):
    tool = factory.tools[0]
    rng = np.random.default_rng(0)
    # Points that say almost nothing of the places between them, and a drawing that is exact.
    nominal = NominalBoard.of(factory.setup).model
    points, axes = tool.placed()
    flux = nominal.flux(points, axes, tool.sensors.length)
    flux = flux + 3e-9 * rng.normal(size=flux.shape)
    few = replace(tool, flux=flux).frames(np.arange(0, 169, 12))
    bag = write_bag(tmp_path / 'b.mcap', factory.setup, few)
    arguments = (bag, '--out', tmp_path / 'm.yaml', '--dipoles', '6x6')
    assert re.search("worse than the nominal model's.*--force", refusal(capsys, *arguments))
    assert not (tmp_path / 'm.yaml').exists()
    assert calibrate(*arguments, '--force') == 0 and (tmp_path / 'm.yaml').exists()


def test_missing_folders_are_made_before_the_work(tmp_path, capsys, monkeypatch):
    out = tmp_path / 'a' / 'b' / 'm.yaml'

    def work(*_):
        assert out.parent.is_dir() and (tmp_path / 'c' / 'd').is_dir()
        raise FitError('begun')

    monkeypatch.setattr(command, 'calibrate_sessions', work)
    assert calibrate(FACTORY, '--out', out, '--report', tmp_path / 'c' / 'd') == 2
    assert 'begun' in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [], 'what stays empty is taken back'
    (tmp_path / 'file').write_text('')
    assert calibrate(FACTORY, '--out', tmp_path / 'file' / 'm.yaml') == 2
    assert capsys.readouterr().err == f'anser calibrate: no folder {tmp_path}/file: File exists\n'


@pytest.mark.parametrize(
    ('argument', 'said'),
    [(f'--{usage}', 'usage') for usage in (
        'dipoles=3x4', 'dipoles=0x0', 'dipoles=many', 'estimate=colour'
    )] + [
        ('--set=flux_noise_t=0', 'must be in'), ('--set=optical_position_m=-1', 'must be in'),
    ],
)  # fmt: skip
def test_bad_arguments_are_refused(tmp_path, argument, said, capsys):
    assert said in refusal(capsys, FACTORY, '--out', tmp_path / 'm.yaml', argument)


@pytest.mark.long
def test_a_cut_scan_is_said_to_be_cut(tmp_path, capsys):
    whole = FACTORY.read_bytes()
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes(whole[: len(whole) * 3 // 4])
    few = ('--estimate', 'none', '--dipoles', '10')  # it is about the bag, not the model
    assert calibrate(cut, *few, '--out', tmp_path / 'm.yaml') == 0, 'with what can be read'
    assert f'{cut}: the bag breaks off after' in capsys.readouterr().err


def test_a_board_of_unknown_kind_still_calibrates(factory):
    emitter = replace(factory.setup.emitter, kind='something_else', geometry={})
    session = replace(factory, setup=replace(factory.setup, emitter=emitter))
    assert NominalBoard.of(session.setup).model is None
    assert generator_of(session.setup).side_m == pytest.approx(0.0969, abs=2e-3)
    found = calibrate_sessions([session], Options(layout=Layout('layer', 10, 1.25, 0.0)))
    assert found.nominal_rmse_t is None and found.better_than_nominal
    assert found.residuals.rmse_t < 1e-9


def test_a_reversed_sensor_of_a_scan_is_used_and_what_no_field_explains_refused(factory):
    tool, options = factory.tools[0], Options(layout=Layout('layer', 10, 1.25, 0.0))
    signs = np.where(np.arange(len(tool.sensors)) == 1, -1, 1)
    given = signs[:, None] * tool.flux, np.roll(tool.flux, len(tool.flux) // 3, axis=0)
    wrong, mixed = (replace(factory, tools=(replace(tool, flux=flux),)) for flux in given)
    right, found, none = (calibrate_sessions([s], options) for s in (factory, wrong, mixed))
    assert [e.name for e in right.model.effects] == []
    noise_t = right.held_out.flux_noise_t
    for stated_t, said in ((noise_t, ''), (1e-3 * noise_t, 'millitesla'), (1e3 * noise_t, 'unit')):
        stated = factory.with_stated({'flux_noise_t': stated_t})
        words = ' '.join(calibrate_sessions([stated], options).contradictions)
        assert said in words and ('times the stated flux_noise_t' in words) is bool(said)
    middle = replace(tool.sensors, position=np.zeros((len(tool.sensors), 3)))
    bare = replace(tool, sensors=middle, position=1e-4 * tool.position, track=None)
    with pytest.raises(FitError, match=r'within 0\.\d+ mm rms: are places in m\?'):
        calibrate_sessions([replace(factory, tools=(bare,))], options)
    (record,) = found.model.effects
    channels = tool.sensors.channel[1:2].tolist()
    assert (record.name, record.parameters) == ('sensor_polarity', {'channels': channels})
    assert found.residuals.rmse_t == pytest.approx(right.residuals.rmse_t)
    name = tool.sensors.name[1]
    assert [f'sensor {name} is reversed' in w for w in found.contradictions] == [True]
    other = replace(wrong, path='other.mcap')
    unlike = f'^other.mcap: unlike in the other sessions, sensor {name} is reversed'
    with pytest.raises(FitError, match=unlike):
        calibrate_sessions([factory, replace(factory, path='again'), other], options)
    with pytest.raises(FitError, match=f'other.mcap contradict .* one of them, sensor {name} is'):
        calibrate_sessions([factory, other], options)
    unread = np.where(np.arange(len(tool.sensors))[:, None] == 1, 1e-11, tool.flux)
    calibrate_sessions([replace(factory, tools=(replace(tool, flux=unread),))], options)
    exact = factory.with_stated({'optical_position_m': 1e-6})
    doubts = calibrate_sessions([exact], replace(options, estimate=KINDS)).contradictions
    assert [w for w in doubts if 'some stand elsewhere than they say' in w]
    check_explained(right)
    apart = replace(right.held_out, error=right.held_out.error + 0.1 * right.residuals.read_t)
    with pytest.raises(FitError, match=r'10 % of the signal is left.*sessions of its own'):
        check_explained(replace(right, held_out=apart))  # its parts contradict each other
    with pytest.raises(FitError, match=r'no field explains the scan: \d+ % of the signal'):
        check_explained(none)
