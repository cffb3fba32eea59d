"""Patches in `evaluate`: coils on a body whose poses lie in the bag take part in the refit."""

from dataclasses import replace

import numpy as np
import pytest
from refit_rig import setup_text
from refit_world import anser_world, metal_block, metal_flux

from anser_ros.cli.main import main
from anser_ros.errors import BagError, ParameterError
from anser_ros.sessions.baseline import Baseline
from anser_ros.sessions.evaluation import track_session
from anser_ros.sessions.model_file import save_model
from anser_ros.sessions.patches import PatchFollower, parse_patches
from anser_ros.sessions.prepared import prepare
from anser_ros.sessions.session import load_session
from anser_ros.wire.points import FluxPoints, encode_flux
from anser_ros.wire.session_writer import SessionWriter

pytestmark = pytest.mark.usefixtures('shared_tables')

START_NS = 1_750_000_000_000_000_000
STEP_NS = 40_000_000
TOPIC = '/navigation/patch'
OFFSETS = np.array([[0.01, 0.0, 0.0], [-0.01, 0.0, 0.0]])
AXES = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
METAL = metal_block([0.02, 0.05, 0.36], [0.08, 0.08, 0.03])
STRONG = -6000.0 + 800.0j


COMING, COMING_M = 8, 0.03  # frames and steps in which metal comes: 0.75 m/s


def say(bag, topic, stamp, channels, flux):
    nothing = np.full((len(flux), 3), np.nan)
    points = FluxPoints(np.asarray(channels), np.zeros(len(flux), int), flux, nothing, nothing)
    fields, step, data = encode_flux(points)
    bag.write_flux(topic, stamp, fields, step, len(flux), data)


def write(path, frames, metal_from, place=(0.02, 0.05, 0.26)):
    """A bag in which metal comes over a patch that drifts by half a millimetre a frame."""
    world, rng = anser_world(), np.random.default_rng(3)
    table = world.references
    with SessionWriter(path) as bag:
        bag.write_setup(setup_text(world), START_NS)
        for frame in range(frames):
            stamp = START_NS + frame * STEP_NS
            centre = np.asarray(place) + [0.5e-3 * frame, 0.0, 0.0]
            points = centre + OFFSETS
            tool, fixed = world.model.flux(points, AXES), world.baseline.copy()
            if frame >= metal_from:
                metal = METAL + [0.0, 0.0, COMING_M * max(metal_from + COMING - frame, 0)]
                fixed += metal_flux(world.board, metal, table.position, table.axis, STRONG)
                tool += metal_flux(world.board, metal, points, AXES, STRONG)
            bag.write_pose(TOPIC, stamp, centre, np.array([0.0, 0.0, 0.0, 1.0]))
            noisy = fixed + world.noise(rng)
            say(bag, '/anser/reference/flux', stamp, table.channel, noisy)
            say(bag, '/anser/tool/flux', stamp, [40, 41], tool)
    return path


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    folder = tmp_path_factory.mktemp('patches')
    save_model(folder / 'model.yaml', anser_world().model)
    write(folder / 'clean.mcap', 5, 99)
    write(folder / 'metal.mcap', 18, 4)
    write(folder / 'short.mcap', 6, 3)
    return folder


def prepared(session):
    world = anser_world()
    return replace(prepare(session, world.model), baseline=Baseline('', world.baseline))


@pytest.mark.long
def test_a_patch_in_the_bag_takes_part(bags):
    session = load_session(bags / 'metal.mcap')
    reference, tool = session.reference, session.tools[0]
    follower = PatchFollower(prepared(session), {'patch': TOPIC})
    states, left_out, far = [], [], []
    for frame in range(len(reference.time)):
        stamp = START_NS + frame * STEP_NS
        follower.take_flux(stamp, tool.sensors.channel, tool.flux[frame], tool.flags[frame])
        result = follower.update(
            stamp, reference.sensors.channel, reference.flux[frame], reference.flags[frame]
        )
        states.append(result.state)
        left_out.append(result.left_out)
        far.append([h.distance for h in result.references if h.name.startswith('patch')])
    assert states[3] == 'frozen'
    assert set(states[12:]) == {'refit'}
    assert left_out[0] == left_out[-1] == ()
    assert np.nanmax(far[12:]) < 4.0


@pytest.mark.long
def test_the_command_takes_patches(bags, capsys):
    arguments = ['evaluate', str(bags / 'short.mcap'), '--model', str(bags / 'model.yaml')]
    arguments += ['--refit', '--baseline', str(bags / 'clean.mcap'), '--out', str(bags / 'out')]
    assert main([*arguments, '--patch', f'patch={TOPIC}']) == 0
    assert (bags / 'out' / 'poses.csv').read_text().count('patch/0') == 6
    assert main([*arguments, '--patch', 'patch']) == 2
    assert 'must be BODY=TOPIC' in capsys.readouterr().err


def test_what_the_bag_lacks_is_said(bags):
    session, world = load_session(bags / 'clean.mcap'), anser_world()
    with pytest.raises(BagError, match='no coils on the body other'):
        PatchFollower(prepared(session), {'other': TOPIC})
    with pytest.raises(BagError, match='no pose on the topic /nobody'):
        track_session(
            session, world.model, baseline=session, refit=True, patches={'patch': '/nobody'}
        )
    with pytest.raises(ParameterError, match='must be BODY=TOPIC'):
        parse_patches(['a=x', 'a=y'])
