"""Units, orders and clocks that contradict a recording are named before anything works on it.

The recordings are those of bags/, written down wrongly in ways that people do.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
from conftest import REPO
from scipy.spatial.transform import Rotation

from anser_ros.cli.main import main
from anser_ros.errors import DiagnosisError, ModelFileError, PlausibilityError
from anser_ros.physics.pose_track import PoseTrack
from anser_ros.sessions.diagnosis import diagnose_session
from anser_ros.sessions.nominal_board import NominalBoard
from anser_ros.sessions.plausibility import (
    FLUX_UNITS,
    LENGTH_UNITS,
    check_points,
    plausible_tools,
    times_of_mounting,
)
from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import load_model
from anser_ros.sessions.tracked_session import track_session
from anser_ros.wire.bag import read_bag
from anser_ros.wire.bag_writer import SessionWriter

MODEL = REPO / 'config' / 'demo_model.yaml'
SEED = 5


@pytest.fixture(scope='module')
def moving():
    return load_session(REPO / 'bags' / 'moving.mcap')


@pytest.fixture(scope='module')
def tool(moving):
    return moving.tools[0]


def checked(session, tool, refused=None):
    tools, left_out = plausible_tools('bag', session.setup, (tool,), refused or {})
    return tools[0], left_out


def with_track(tool, time=None, position=None, quaternion=None):
    """The tool with optical poses that were written down another way."""
    old = tool.track
    track = PoseTrack(
        old.time if time is None else time,
        old.position if position is None else position,
        old.quaternion if quaternion is None else quaternion,
    )
    return tool.with_track(track)


def says(session, tool, *words, refused=None):
    with pytest.raises(PlausibilityError) as caught:
        checked(session, tool, refused)
    text = str(caught.value)
    assert '\n' not in text and all(word in text for word in words), text


def test_what_is_right_passes_unchanged(moving, tool):
    same, left_out = checked(moving, tool)
    assert same is tool and left_out == '' and moving.lost == ''
    flux = np.where(np.arange(8) == 1, 0.0, tool.flux)
    flux[5], flux[:, 2] = np.nan, np.nan
    words = (
        f'coil1 gives nothing but noise: is it dead?; no reading of {tool.sensors.name[2]}; '
        f'fluxes of {tool.body} are missing or not finite in 1 of {len(flux)} frames'
    )
    assert words in checked(moving, replace(tool, flux=flux))[1]
    assert checked(moving, tool, {'tool/flux: twice': 7})[1] == '7 of tool/flux: twice'
    faint = np.where(np.arange(len(tool.sensors))[:, None] == 2, 1e-11, tool.flux)
    assert 'no reading of' in checked(moving, replace(tool, flux=faint))[1]
    half = tool.flux.copy()
    half[len(half) // 2 :, :, 1] = 0.0
    half[:9] = np.nan  # missing readings are no silence
    dead = f'in {len(half) - len(half) // 2} of {len(half) - 9} frames: is it dead?'
    assert f'coil1 gives nothing but noise {dead}' in checked(moving, replace(tool, flux=half))[1]
    half[len(half) // 2 :, :, 1] = np.nan
    assert 'noise' not in checked(moving, replace(tool, flux=half))[1]
    with pytest.raises(ModelFileError, match=r'no field of coil1, .* dead in the calibration'):
        known = load_model(MODEL)
        moments = np.where(np.arange(8) == 1, 0.0, known.moments)
        diagnose_session(moving, replace(known, moments=moments))


@pytest.mark.parametrize('unit', [*LENGTH_UNITS, 'kilometres'])
def test_positions_in_another_unit(moving, tool, unit):
    wrong = with_track(tool, position=LENGTH_UNITS.get(unit, 1e-3) * tool.track.position)
    says(moving, wrong, f'positions in {unit}', 'span')
    also = with_track(wrong, quaternion=tool.track.quaternion[:, [3, 0, 1, 2]])
    says(moving, also, f'positions in {unit} and quaternions with w first')


def test_positions_far_away_need_no_drawing(moving, tool):
    """A board that can't be drawn explains no flux; its tracked volume still bounds the poses."""
    emitter = replace(moving.setup.emitter, kind='somebody_elses')
    undrawn = replace(moving, setup=replace(moving.setup, emitter=emitter))
    assert NominalBoard.of(undrawn.setup).field is None
    assert checked(undrawn, tool)[1] == ''
    far = with_track(tool, position=1e3 * tool.track.position)
    says(undrawn, far, 'span', 'millimetres?')


def test_quaternions_in_another_order_and_axes_exchanged_or_reversed(moving, tool):
    first = with_track(tool, quaternion=tool.track.quaternion[:, [3, 0, 1, 2]])
    says(moving, first, 'quaternions with w first', '100 %')
    inverse = with_track(tool, quaternion=tool.track.quaternion * [-1, -1, -1, 1])
    says(moving, inverse, 'rotations from fg to the body')
    place, turned = tool.track.position, Rotation.from_quat(tool.track.quaternion)
    says(moving, with_track(tool, position=place[:, [1, 0, 2]]), 'positions with the axes y, x, z')
    mirror = np.diag([1.0, 1.0, -1.0])
    left_handed = Rotation.from_matrix(mirror @ turned.as_matrix() @ mirror).as_quat()
    flat = with_track(tool, position=place @ mirror, quaternion=left_handed)
    says(moving, flat, 'poses in a frame of the axes x, y, -z')
    sideways = Rotation.from_matrix([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    other = with_track(
        tool, position=sideways.apply(place), quaternion=(sideways * turned).as_quat()
    )
    says(moving, other, 'poses in a frame of the axes z, x, y')


def test_what_cannot_be_decided_is_not_said(moving, tool):
    """An optical frame that is not the board's explains nothing in any order."""
    turn = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    elsewhere = with_track(tool, position=tool.track.position @ turn.T + 0.3)
    assert checked(moving, elsewhere)[1] == ''
    # Nor is a tool whose every third coil is wired the other way round.
    flip = np.where(np.arange(len(tool.sensors)) % 3 == 0, -1.0, 1.0)[:, None]
    assert checked(moving, replace(tool, flux=flip * tool.flux))[1] == ''


def test_fluxes_that_are_all_reversed_are_said_to_be(moving, tool):
    _, words = checked(moving, replace(tool, flux=-tool.flux))
    assert words.startswith(f'all fluxes of {tool.body} are the reverse of what the drawn board')


@pytest.mark.parametrize('unit', FLUX_UNITS)
def test_fluxes_in_another_unit(moving, tool, unit):
    larger = replace(tool, flux=FLUX_UNITS[unit] * tool.flux)
    says(moving, larger, f'{unit}?', 'drawn board')
    _, words = checked(moving, replace(tool, flux=tool.flux / FLUX_UNITS[unit]))
    assert 'times what the drawn board makes at its poses: another unit than T?' in words
    blind = replace(larger, track=None, has_pose=np.zeros_like(tool.has_pose))
    says(moving, replace(tool, flux=0.0 * tool.flux), 'all fluxes of all tools are zero')
    says(moving, replace(tool, flux=np.nan * tool.flux), 'of all tools are missing or not finite')
    if unit == 'millitesla':  # without poses, so much could still be near a coil
        assert checked(moving, blind)[1] == ''
    else:
        says(moving, blind, '?', 'drawn board')


def test_clocks_that_do_not_overlap(moving, tool):
    says(moving, with_track(tool, time=tool.track.time + 3600.0), 'after the last flux', 'clocks')
    says(moving, with_track(tool, time=tool.track.time - 3600.0), 'before the first flux')


def test_a_frozen_optical_tracker(moving, tool):
    """It repeats its last pose; such poses are left out, and most of them are too many."""
    track = tool.track
    size = track.time.size

    def frozen(first, last):
        rows = np.arange(size)
        rows[first:last] = first
        return with_track(tool, position=track.position[rows], quaternion=track.quaternion[rows])

    some = frozen(size // 2, size // 2 + size // 4)
    kept, left_out = checked(moving, some)
    inside = (tool.time > track.time[size // 2 + 5]) & (
        tool.time < track.time[size // 2 + size // 4 - 5]
    )
    assert 'bit for bit' in left_out and not kept.has_pose[inside].any()
    assert kept.has_pose[~inside].sum() > 0.9 * tool.has_pose[~inside].sum()
    says(moving, frozen(10, size), 'bit for bit', 'frozen?')
    # A tool at rest has the same pose for a good reason.
    rest = replace(frozen(0, size), flux=np.broadcast_to(tool.flux[:1], tool.flux.shape))
    assert checked(moving, rest)[1] == ''


def test_quaternions_that_are_none(moving, tool):
    reason = f'/optical/{tool.body}/pose: a quaternion not of unit length'
    none = replace(tool, track=None, has_pose=np.zeros_like(tool.has_pose))
    says(moving, none, 'all 7 optical poses', 'unit length', refused={reason: 7})
    assert '7 optical poses' in checked(moving, tool, {reason: 7})[1]


def test_a_reference_that_no_effect_explains_is_told_and_no_effect_is_named(moving, tool):
    """As `evaluate` tells it: before the search, or after it where effects leave it so."""
    model = load_model(MODEL)
    turned = with_track(tool, position=tool.track.position[:, [1, 0, 2]])
    again = with_track(
        tool, position=tool.track.position[::-1], quaternion=tool.track.quaternion[::-1]
    )
    for wrong, words in (
        (turned, r'read as positions with the axes y, x, z'),
        (again, 'no frame, mounting, unit or order of axes explains that'),
    ):
        session = replace(moving, tools=(wrong,))
        (one,) = track_session(session, model).disagreements
        assert words in one.words
        with pytest.raises(PlausibilityError, match=re.escape(one.words)):
            diagnose_session(session, model)


def test_a_diagnosis_of_one_pose_ends_at_once(moving, tool):
    track = tool.track
    rest = with_track(
        tool,
        position=np.broadcast_to(track.position[:1], track.position.shape),
        quaternion=np.broadcast_to(track.quaternion[:1], track.quaternion.shape),
    )
    with pytest.raises(DiagnosisError, match='optical poses are the same'):
        diagnose_session(replace(moving, tools=(rest,)), load_model(MODEL))
    large = replace(moving, tools=(replace(tool, flux=1e3 * tool.flux),))
    for use in (diagnose_session, track_session):
        with pytest.raises(PlausibilityError, match=r'times what the model makes .* millitesla'):
            use(large, load_model(MODEL))
    small = replace(moving, tools=(replace(tool, flux=1e-3 * tool.flux),))
    with pytest.raises(PlausibilityError, match=r'0.001 times what the model makes'):
        track_session(small, load_model(MODEL))


def test_commands_say_it_in_one_line(tmp_path, capsys):
    bag = read_bag(REPO / 'bags' / 'moving.mcap')
    path = tmp_path / 'millimetres.mcap'
    with SessionWriter(path) as writer:
        writer.write_setup(bag.setup_text, int(bag.tool.stamp_ns[0]))
        for stamp, flux in zip(bag.tool.stamp_ns[::10].tolist(), bag.tool.flux[::10], strict=True):
            writer.write_readings(bag.setup.tool_sensors, stamp, flux)
        for body, stream in bag.optical.items():
            rows = zip(stream.stamp_ns.tolist(), stream.position, stream.quaternion, strict=True)
            for stamp, position, quaternion in rows:
                writer.write_pose(f'/optical/{body}/pose', stamp, 1e3 * position, quaternion)
    out = ['--out', str(tmp_path / 'out')]
    for command in (
        ['calibrate', str(path), *out],
        ['evaluate', str(path), '--model', str(MODEL), *out],
        ['diagnose', str(path), '--model', str(MODEL), *out],
        ['evaluate', str(REPO / 'bags' / 'moving.mcap'), '--model', str(MODEL), *out, '--refit',
         '--baseline', str(path)],
    ):  # fmt: skip
        assert main(command) == 2
        said = capsys.readouterr().err
        assert 'millimetres' in said and said.count('\n') == 1, said


def test_a_body_that_a_stage_turns_is_mounted_otherwise_where_its_axis_jumps(moving, tool, rng):
    def mounted(*held, turn=90.0, jitter=2e-3):
        """The tool turned about fg's z in steps, on mounts of these Euler angles, deg."""
        part = len(tool.time) // len(held)
        spin = Rotation.from_rotvec(np.outer(np.radians(np.linspace(0.0, turn, part)), [0, 0, 1]))
        mounts = [spin * Rotation.from_euler('xyz', one, degrees=True) for one in held]
        wrong = Rotation.from_rotvec(jitter * rng.normal(size=(part * len(held), 3)))
        quaternion = (wrong * Rotation.concatenate(mounts)).as_quat()
        rows = tool.frames(slice(0, len(quaternion)))
        track = PoseTrack(rows.time, rows.position, quaternion)
        return replace(rows, track=track).with_track(track)

    home, down, side = (0, 0, 0), (90, 0, 0), (0, 90, 0)
    three = mounted(home, down, side)
    starts = three.time[[len(three.time) // 3, 2 * (len(three.time) // 3)]].tolist()
    assert times_of_mounting(three) == starts
    # A turn about the axis itself is none, nor is what hardly turns, or a hand's motion.
    for one in (mounted(home), mounted(home, (0, 0, 90)), mounted(home, down, turn=5.0), tool):
        assert times_of_mounting(one) == []
    assert f'{tool.body} turns about another axis' in checked(moving, three)[1]
    first, *others = replace(moving, tools=(three,)).mountings()
    assert [part.tools[0].time[0] for part in others] == starts
    assert first.path == f'{moving.path} from 0 s on' == first.tools[0].session
    assert sum(len(part.tools[0].time) for part in (first, *others)) == len(three.time)
    assert moving.mountings() == (moving,)


def test_points_of_an_error_map():
    rng = np.random.default_rng(2)
    true = rng.uniform(-0.1, 0.1, (30, 3))
    tracked = true + 1e-3 * rng.standard_normal((30, 3))
    check_points(tracked, true)
    check_points(np.full((3, 3), np.nan), np.zeros((3, 3)))
    for unit, size in LENGTH_UNITS.items():
        for one, other in ((tracked, size * true), (size * tracked, true)):
            with pytest.raises(PlausibilityError, match=unit):
                check_points(one, other)
    with pytest.raises(PlausibilityError, match=r'span 3.*millimetres'):
        check_points(1e3 * tracked, 1e3 * true)
    with pytest.raises(PlausibilityError, match='all 30 true positions are the same'):
        check_points(tracked, np.tile(true[:1], (30, 1)))
