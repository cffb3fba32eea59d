"""Tools as witnesses of metal: what a rigid tool's coils contradict helps few references."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from clouds_of import FluxCloud, received
from conftest import REPO
from geometry_msgs.msg import PoseStamped
from refit_world import NOISE_T, anser_world, metal_block, metal_flux
from tracked_tool import CHANNELS, MODEL
from tracking_world import flux_points, triaxial_tool

from anser_ros.chain.frame import ChainFrame, FrameReadings
from anser_ros.cli.main import main
from anser_ros.errors import BagError
from anser_ros.nodes.field_model_io import ToolWitnesses
from anser_ros.nodes.runtime.node import AnserNode
from anser_ros.refit.live_refit import LiveRefit
from anser_ros.refit.witness import (
    CONTRADICTION_S,
    CoilErrors,
    ToolReading,
    _Errors,
    _Filter,
    _kalman,
    linearised,
)
from anser_ros.sessions.follower import with_references
from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import load_model
from anser_ros.sessions.tracked_session import track_session
from anser_ros.settings import RefitSettings, ToolSettings
from anser_ros.wire.setup import parse_setup
from anser_ros.wire.text_files import read_config

STEP_NS = 40_000_000
FRAMES = 25
METAL = metal_block([0.03, -0.02, -0.09], [0.1, 0.12, 0.06])
"""Points whose answers do not touch each other, which is no cloud of the refit's."""
pytestmark = pytest.mark.usefixtures('shared_tables')
TOOL = triaxial_tool('tool')


@pytest.fixture(scope='module')
def world():
    return anser_world(16)


def few(world) -> LiveRefit:
    """A refit to four coils."""
    rows = [0, 4, 8, 12]
    return LiveRefit(
        world.model, world.references.select(rows), world.baseline[rows], RefitSettings(),
        world.board.field,
    )  # fmt: skip


def flux_at(world, place, metal=METAL):
    """The tool's fluxes (S, K) with its axes along those of fg, and its coils' places."""
    at, axes = TOOL.placed(place, np.eye(3))
    flux = world.model.flux(at, axes).astype(complex)
    return (flux if metal is None else flux + metal_flux(world.board, metal, at, axes)), at, axes


def way(frame: int) -> np.ndarray:
    """Where the tool is."""
    angle = 0.15 * frame
    return np.array([0.05 * np.cos(angle), 0.05 * np.sin(angle), 0.14])


def followed(world, witnesses: bool, gain=None, off_m: float = 0.0):
    """Error of the field where the tool is over its change, the last frames of a walk."""
    refit, rng = few(world), np.random.default_rng(4)
    rows = [0, 4, 8, 12]
    if witnesses:
        refit.enable_witnesses(NOISE_T)
    share, gain = [], np.ones(9) if gain is None else gain
    for frame in range(2 * FRAMES):
        metal = METAL if frame >= FRAMES else None
        reading = world.baseline[rows] + world.noise(rng)[rows]
        if metal is not None:
            reading = reading + world.metal(metal)[rows]
        result = refit.update((1 + frame) * STEP_NS, world.references.channel[rows], reading)
        place = way(frame)
        flux, at, axes = flux_at(world, place, metal)
        if frame >= 2 * FRAMES - 5:
            change = flux - world.model.flux(at, axes)
            left = flux - result.model.flux(at, axes)
            share.append(np.linalg.norm(left) / np.linalg.norm(change))
        noise = NOISE_T * (rng.normal(size=(9, 8)) + 1j * rng.normal(size=(9, 8)))
        told = place + off_m * rng.normal(size=3)
        refit.witnessed([ToolReading(TOOL, gain[:, None] * flux + noise, told, np.eye(3))])
    return float(np.mean(share)), refit


@pytest.fixture(scope='module')
def alone(world):
    return followed(world, witnesses=False)[0]


@pytest.mark.long
def test_a_tool_tells_what_few_references_leave_open(world, alone):
    share, _ = followed(world, witnesses=True, off_m=2e-4)
    assert share < 0.6 * alone


@pytest.mark.long
def test_metal_that_has_left_is_forgotten(world):
    _, refit = followed(world, witnesses=True)
    rows, rng = [0, 4, 8, 12], np.random.default_rng(8)
    states = []
    for frame in range(2 * FRAMES, 2 * FRAMES + 12):
        reading = world.baseline[rows] + world.noise(rng)[rows]
        result = refit.update((1 + frame) * STEP_NS, world.references.channel[rows], reading)
        states.append(result.state)
        flux, _, _ = flux_at(world, way(frame), None)
        noise = NOISE_T * (rng.normal(size=(9, 8)) + 1j * rng.normal(size=(9, 8)))
        refit.witnessed([ToolReading(TOOL, flux + noise, way(frame), np.eye(3))])
    assert states[-1] == 'frozen'


@pytest.mark.long
def test_a_wrong_gain_is_learnt_and_is_no_metal(world, alone):
    gain = np.ones(9)
    gain[4] = 1.01
    share, _ = followed(world, witnesses=True, gain=gain)
    assert share < 0.8 * alone


@pytest.mark.long
def test_a_step_of_the_tool_is_no_metal(world):
    """To first order; what is left of a step of a tenth of a millimetre is below the noise."""
    place, step = way(0), np.array([1e-4, -5e-5, 8e-5])
    flux, _, _ = flux_at(world, place + step, None)
    rows = linearised(
        ToolReading(TOOL, flux, place, np.eye(3)), world.model, world.model.moments,
        np.full(8, 1.0 / NOISE_T, dtype=complex),
    )  # fmt: skip
    pose = rows.pose.real
    rest = rows.left.real - pose @ np.linalg.lstsq(pose, rows.left.real, rcond=None)[0]
    assert np.abs(rows.left.real).max() > 5.0
    assert np.abs(rest).max() < 0.2


def test_the_errors_of_coils_have_the_sigma_that_they_say():
    rng, tools = np.random.default_rng(2), ToolSettings()
    table = TOOL.select(np.arange(3))
    scale = np.tile([tools.tool_coil_gain] * 2 + [tools.tool_coil_position_m] * 3
                    + [tools.tool_coil_axis_rad] * 2, 3)  # fmt: skip
    scores = []
    for _ in range(40):
        errors, true = CoilErrors(table, tools), scale * rng.normal(size=21)
        for _ in range(5):
            rows = rng.normal(size=(30, 21)) / scale
            errors.learn(rows, rows @ true + rng.normal(size=30))
        mean, covariance = errors.posterior
        scores.append((mean - true) / np.sqrt(np.diagonal(covariance)))
    assert 0.2 < np.sqrt(np.mean(np.square(scores))) < 1.1
    assert np.sqrt(np.diagonal(covariance)).max() < scale.max()


@pytest.mark.parametrize('size', [0.0, 4.0])
def test_a_contradiction_that_lasts_is_not_counted_in_every_frame(size):
    """Errors in units of their sigma after fifty frames that are off by nearly the same."""
    rng, step_s, n, d = np.random.default_rng(5), 0.04, 40, 6
    keep, scores = np.exp(-step_s / CONTRADICTION_S), []
    repeated = 1.0 + 2.0 * CONTRADICTION_S / step_s
    errors = _Errors(np.eye(n), np.zeros((n, n)), np.zeros((n, n)), 1.0, repeated)
    for _ in range(20):
        true, off = rng.normal(size=d), size * rng.normal(size=n)
        state = _Filter(np.zeros((d, 2)), np.stack([np.eye(d)] * 2), np.stack([np.eye(d)] * 2))
        for _ in range(50):
            off = keep * off + np.sqrt(1.0 - keep**2) * size * rng.normal(size=n)
            rows = np.linspace(-1.0, 1.0, n)[:, None] ** np.arange(d)
            _kalman(state, 0, errors, rows, rows @ true + off + rng.normal(size=n))
        scores.append((state.mean[:, 0] - true) / np.sqrt(np.diagonal(state.covariance[0])))
    assert 0.8 < np.sqrt(np.mean(np.square(scores))) < 1.2


def test_witnesses_need_a_refit_and_references(tmp_path, capsys):
    bag, model = REPO / 'bags' / 'metal.mcap', REPO / 'config' / 'demo_model.yaml'
    arguments = ['evaluate', str(bag), '--model', str(model), '--witnesses']
    assert main([*arguments, '--out', str(tmp_path)]) == 2
    assert '--refit' in capsys.readouterr().err
    session, clean = load_session(bag), load_session(REPO / 'bags' / 'factory.mcap')
    short = replace(session, tools=tuple(t.frames(slice(0, 2)) for t in session.tools),
                    reference=session.reference.frames(slice(0, 2)))  # fmt: skip
    with pytest.raises(BagError, match='no reference sensors'):
        track_session(
            with_references(short, ()), load_model(model), baseline=clean, refit=True,
            witnesses=True,
        )  # fmt: skip


class Refit:
    """Stands for the refit: notes what it is given."""

    def __init__(self):
        self.given = []

    def witnessed(self, readings):
        self.given.append(readings)


@pytest.fixture
def witnesses(ros):
    class Server(AnserNode):
        NAME = 'server'

    node, refused = Server(), []
    made = ToolWitnesses(node, True, lambda: 'fg', lambda *why: refused.append(why))
    made.expect(parse_setup(read_config('demo_setup.yaml')), MODEL)
    made.refused = refused
    yield made
    node.destroy_node()


def flux(stamp_ns, level):
    """A frame of all of the tool's channels, each emitter with the same flux."""
    values = np.full((len(CHANNELS), 8), level, dtype=np.complex128)
    values[2] = np.nan
    return received(FluxCloud('fg').message(flux_points(values, channels=CHANNELS), stamp_ns))


def pose(stamp_ns, x, frame_id='fg'):
    message = PoseStamped()
    message.header.frame_id, message.header.stamp.nanosec = frame_id, stamp_ns
    message.pose.position.x, message.pose.orientation.w = x, 1.0
    return message


def test_readings_and_poses_of_one_frame_come_together_in_any_order(witnesses):
    refit, found = Refit(), partial(witnesses._on_pose, 'tool_a')
    assert witnesses.noise_t > 0
    witnesses._on_flux(flux(100, 1e-9))
    found(pose(100, 0.01))
    found(pose(200, 0.02))  # the next frame is here before the references of this one
    witnesses._on_flux(flux(200, 2e-9))
    for stamp_ns in (100, 100, 200, 300):
        witnesses.pass_on(refit, stamp_ns)
    assert len(refit.given) == 2, 'no frame twice, none without readings'
    for (reading,), x, level in zip(refit.given, (0.01, 0.02), (1e-9, 2e-9), strict=True):
        assert reading.position[0] == x and np.array_equal(reading.rotation, np.eye(3))
        assert (reading.flux == np.float32(level)).all()
        assert len(reading.table) == len(TOOL) - 1, 'the one without a reading is left out'


def test_frames_of_the_same_process_come_with_the_poses_that_were_found(witnesses):
    refit, values = Refit(), np.full((len(CHANNELS), 8), 1e-9, dtype=np.complex128)
    tools = FrameReadings(np.array(CHANNELS), values, np.zeros(len(CHANNELS), int))
    turn, good = np.eye(3), {'state': 'ok', 'position': np.ones(3)}
    found = [
        SimpleNamespace(name=name, rotation=rotation, **good)
        for name, rotation in (('tool_a', turn), ('tool_a/0/x', None))
    ]
    witnesses.note(ChainFrame(100, tools, None), found)
    witnesses.pass_on(refit, 100)
    ((reading,),) = refit.given
    assert reading.rotation is turn and len(reading.table) == len(TOOL)


def test_what_has_no_partner_is_forgotten_and_an_earlier_recording_is_taken(witnesses):
    refit, found = Refit(), partial(witnesses._on_pose, 'tool_a')
    for stamp_ns in range(1000, 3000, 100):
        found(pose(stamp_ns, 0.01))
        witnesses._on_flux(flux(stamp_ns + 1, 1e-9))
    assert len(witnesses._frames) < 10 and len(witnesses._poses) < 10
    found(pose(5, 0.03))
    witnesses._on_flux(flux(5, 3e-9))
    witnesses.pass_on(refit, 5)
    assert refit.given[0][0].position[0] == 0.03


def test_poses_of_another_frame_are_refused(witnesses):
    refit = Refit()
    witnesses._on_flux(flux(100, 1e-9))
    witnesses._on_pose('tool_a', pose(100, 0.01, 'world'))
    witnesses.pass_on(refit, 100)
    assert not refit.given
    ((counter, error),) = witnesses.refused
    assert counter == 'tool_poses_refused' and "'world'" in str(error)


def test_a_body_whose_poses_have_two_publishers_witnesses_nothing(ros, witnesses):
    from conftest import spin_until

    stranger, refit = ros.create_node('stranger'), Refit()
    publishers = [stranger.create_publisher(PoseStamped, '/anser/tool_a/pose', 5) for _ in 'ab']
    assert spin_until(stranger, lambda: stranger.count_publishers('/anser/tool_a/pose') == 2)
    witnesses._on_flux(flux(100, 1e-9))
    witnesses._on_pose('tool_a', pose(100, 0.01))
    assert spin_until(stranger, lambda: not witnesses._has_one_source('tool_a'))
    witnesses.pass_on(refit, 100)
    assert not refit.given
    for publisher in publishers:
        stranger.destroy_publisher(publisher)
    stranger.destroy_node()
