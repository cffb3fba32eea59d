"""A plate is gone through live: places, rests, what is wrong at once, undo, and the session."""

import time
from dataclasses import replace

import numpy as np
import pytest
from conftest import REPO, ask, diagnostics, spin_until
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String
from std_srvs.srv import Trigger
from test_drawn_calibration import NOISE_T, World

from anser_ros.calibration.calibrate import Options
from anser_ros.calibration.sensor_parameters import KINDS
from anser_ros.errors import ParameterError
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.streams.clouds import flux_cloud
from anser_ros.sessions.calibration import calibrate_sessions
from anser_ros.sessions.plate import PlateGuide, places_of
from anser_ros.sessions.session import load_session
from anser_ros.wire.points import FluxPoints
from anser_ros.wire.setup import dump_setup

RATE_HZ = 25.0
CHANNEL, NO_FLAG, UP = np.zeros(1, dtype=int), np.zeros(1, dtype=int), np.array([0.0, 0.0, 1.0])


class Hand:
    """Moves a coil over a board whose coils are off, and gives what it reads, frame by frame."""

    def __init__(self, seed):
        setup = load_session(REPO / 'bags' / 'factory.mcap').setup
        coil = replace(setup.tool_sensors[0], channel=0, name='probe/z', body='probe')
        coil = replace(coil, position_m=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0), length_m=0.0)
        self.setup = replace(setup, sensors=(coil,), flux_rate_hz=RATE_HZ)
        self.world, self.count = World(self.setup, seed), 0
        self.at = np.array([0.0, 0.0, 0.2])

    def to(self, place, rest_s=1.6, up=UP):
        """Yield stamps and fluxes on the way to a place, and while the coil rests there."""
        way = np.linspace(self.at, place, 15)
        points = np.concatenate([way, np.repeat([place], int(rest_s * RATE_HZ), axis=0)])
        self.at = np.asarray(place)
        # A rest is one place: of its field only the noise differs.
        field = self.world.field(points[:16])[:, :, :] @ up
        flux = np.concatenate([field, np.repeat(field[-1:], len(points) - 16, axis=0)])
        parts = NOISE_T * self.world.rng.normal(size=(2, *flux.shape))
        for one in flux + parts[0] + 1j * parts[1]:
            self.count += 1
            yield 10**18 + round(1e9 * self.count / RATE_HZ), one[None]


def said(guide, frames):
    """What a guide says of some frames."""
    return ' '.join(filter(None, (guide.take(t, CHANNEL, flux, NO_FLAG) for t, flux in frames)))


def test_plates_have_their_known_places():
    assert places_of('7x7')[[0, 1, 7, -1]].round(5).tolist() == [
        [-0.12858, -0.12858, 0.084], [-0.08572, -0.12858, 0.084], [-0.12858, -0.08572, 0.084],
        [0.12858, 0.12858, 0.084],
    ]  # fmt: skip
    assert len(places_of('9x9', heights_m=[0.08, 0.15])) == 162
    assert places_of('duplo')[0].round(5).tolist() == [-0.09525, -0.09525, 0.1206]
    with pytest.raises(ParameterError, match='7x7'):
        places_of('gremlin')
    with pytest.raises(ParameterError, match='between 1 and 1000 mm'):
        places_of('7x7', 0.0)


def test_rests_are_taken_and_what_is_wrong_is_said_at_once(tmp_path):
    hand, places = Hand(3), places_of('7x7')
    guide = PlateGuide(hand.setup, places)
    off = np.array([2e-3, -1e-3, 1e-3])  # of a plate laid by eye
    assert said(guide, hand.to(places[0] + off, rest_s=0.6)) == ''  # moved on too early
    unplugged = [(t, np.nan * flux) for t, flux in hand.to(places[0])]
    assert said(guide, unplugged) == 'not taken: the coil gives no reading. Is it connected?'
    assert 'upside down' in said(guide, hand.to(places[0] + off, up=-UP))
    assert said(guide, hand.to(places[0] + off)) == 'place 1 is taken'
    hand.at = hand.at + [0.0, 0.0, 0.03]  # lifted, and put down in the same hole
    assert 'place 1 again, not 2' in said(guide, hand.to(places[0] + off))
    assert 'place 3, not 2' in said(guide, hand.to(places[2] + off))
    narrow = said(guide, hand.to(places[0] + off + [0.03175, 0.0, 0.0]))
    assert '11 mm too far left' in narrow and 'pitch' in narrow, narrow
    tremor = [(t, flux * (1.0 + 0.02 * (i % 2))) for i, (t, flux) in enumerate(hand.to(places[1]))]
    assert said(guide, tremor) == ''
    assert guide.undo() == 'place 1 is forgotten' and guide.words.startswith('place 1 of 49')
    rests = []
    for row, place in enumerate(places):
        rests.append(said(guide, hand.to(place + off)))
        if row == 30:  # one that is seated badly is kept on demand
            guide.undo()
            assert '9 mm too far up' in said(guide, hand.to(place + off + [0, 0, 9e-3]))
            assert guide.keep() == 'place 31 is taken' and guide.undo()
            said(guide, hand.to(place + off))
    assert rests == [f'place {row + 1} is taken' for row in range(49)] and guide.is_complete
    guide.write(tmp_path / 'plate.mcap')
    session = load_session(tmp_path / 'plate.mcap')
    assert session.tools[0].has_pose.all() and np.allclose(session.tools[0].position, places)
    model = calibrate_sessions([session], Options(estimate=KINDS)).model
    assert hand.world.error_m(model)[1] < 4e-4


def test_over_the_graph_with_a_bad_point_and_undo(start, ros, tmp_path):
    hand, out = Hand(4), tmp_path / 'plate.mcap'
    node = ros.create_node('hand')
    states = diagnostics(node)
    setups = node.create_publisher(String, '/anser/setup', qos.LATCHED)
    fluxes = node.create_publisher(PointCloud2, '/anser/tool/flux', qos.STREAM)
    rows = ['x_mm,y_mm,z_mm', '-42.86,0,84', '0,0,84', '42.86,0,84']
    (tmp_path / 'three.csv').write_text('\n'.join(rows))
    process = start('grid', '--plate', tmp_path / 'three.csv', '--out', out)
    setups.publish(String(data=dump_setup(hand.setup)))

    def rests(place, words):
        hand.at = hand.at + [0.0, 0.0, 0.03]  # lifted, even where it comes down again
        for stamp_ns, flux in hand.to(place):
            points = FluxPoints(CHANNEL, NO_FLAG, flux, *np.full((2, 1, 3), np.nan))
            fluxes.publish(flux_cloud(points, hand.setup.frame_id, stamp_ns))
            time.sleep(0.005)
        assert spin_until(node, lambda: process.log.read_text().count(words)), states['anser/grid']

    assert spin_until(node, lambda: 'place 1 of 3' in states.get('anser/grid', ('', ''))[1])
    left, middle, right = places_of(str(tmp_path / 'three.csv'))
    rests(left, 'place 1 is taken; place 2 of 3 is next: x 0.0, y 0.0, z 84.0 mm')
    rests(right, 'not taken: that is place 3, not 2')
    rests(middle, 'place 2 is taken')
    undone = ask(node, Trigger, '/anser/grid/undo')
    assert undone.success and undone.message == 'place 2 is forgotten'
    assert len(load_session(out).tools[0].time) == 1  # whole after every point
    rests(middle, 'forgotten; place 2 of 3 is next: x 0.0, y 0.0, z 84.0 mm\nplace 2 is taken')
    rests(right, 'place 3 is taken; all 3 places are taken')
    assert process.popen.wait(60) == 0
    assert load_session(out).tools[0].position[:, 0].round(5).tolist() == [-0.04286, 0, 0.04286]
    again = start('grid', '--out', out)
    assert again.popen.wait(60) == 2 and 'already exists' in again.log.read_text()
    plate = tmp_path / 'three.csv'
    for name, words in (('three.mcap', 'three.csv: already exists'), ('q.csv', 'end in .mcap')):
        wrong = start('grid', '--plate', plate, '--out', tmp_path / name)
        assert wrong.popen.wait(60) == 2 and words in wrong.log.read_text()
    assert plate.read_text() == '\n'.join(rows)
