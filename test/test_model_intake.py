"""Models of a tracker: their uncertainty, the frame that each is for, and how they age."""

from dataclasses import replace

import numpy as np
import pytest
from tracking_world import certain_model, setup_of, triaxial_tool

from anser_ros.chain.chain import MOST_LATE, AnsweredFrames
from anser_ros.chain.frame import Answer, ChainFrame
from anser_ros.nodes.streams.clouds import ModelWriter
from anser_ros.nodes.tracker_models import ModelIntake, ModelReader
from anser_ros.wire.cdr import read_cloud

pytest.importorskip('sensor_msgs')
MODEL = certain_model()
FIRST_NS = 1_750_000_000_000_000_000


def uncertain(n):
    modes = np.full((1, *MODEL.moments.shape), 1e-6 * (1 + n), dtype=complex)
    return replace(MODEL, moments=(1.0 + 1e-3 * n) * MODEL.moments, modes=modes)


def messages(numbers):
    """Uncertainty and dipoles of some models, with the stamps of their numbers."""
    writer = ModelWriter()
    models = {n: writer.given(uncertain(n), FIRST_NS + n, True) for n in numbers}
    errors = {n: read_cloud(writer.error(model, 'fg')) for n, model in models.items()}
    return errors, {n: read_cloud(writer.dipoles(model, 'fg')) for n, model in models.items()}


def taken(intake, maker, *of_model):
    """The model of two messages."""
    given = maker.given(*of_model)
    intake.take_error(read_cloud(maker.error(given, 'fg')))
    return intake.take(read_cloud(maker.dipoles(given, 'fg')))


def size_of(given):
    return None if given.error is None else round(float(given.error.modes[0, 0, 0].real) / 1e-6)


def test_a_busy_tracker_that_reads_many_uncertainties_first_mixes_none_up():
    intake = ModelIntake()
    errors, models = messages(range(8))
    for n in (0, 2, 5, 7):  # the others change nothing about the uncertainty
        assert intake.take_error(errors[n]) is None
    assert [size_of(intake.take(models[n])) for n in range(8)] == [1, 1, 3, 3, 3, 6, 6, 8]


def test_an_uncertainty_that_comes_after_its_model_is_put_right():
    intake = ModelIntake()
    errors, models = messages(range(2))
    intake.take_error(errors[0])
    assert size_of(intake.take(models[0])) == 1
    assert size_of(intake.take(models[1])) == 1
    assert size_of(intake.take_error(errors[1])) == 2


def test_a_model_is_the_one_of_its_messages():
    maker = ModelWriter()
    given = maker.given(uncertain(1), FIRST_NS, True, 2)
    read = taken(ModelIntake(), maker, uncertain(1), FIRST_NS, True, 2)
    assert maker.given(uncertain(1), FIRST_NS + 1, True).error is not given.error
    for name in ('stamp_ns', 'follows', 'withheld'):
        assert getattr(given, name) == getattr(read, name)
    assert (given.error.fingerprint, given.error.effects) == ('', 0)
    for one, other in ((given.points, read.points), (given.error, read.error)):
        for name in sorted(vars(one).keys() - {'fingerprint'}):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-6)


def test_one_whose_model_was_lost_is_passed_over():
    intake = ModelIntake()
    errors, models = messages(range(4))
    for n in (0, 1, 3):
        intake.take_error(errors[n])
    assert [size_of(intake.take(models[n])) for n in (0, 3)] == [1, 4]
    assert size_of(intake.newest) == 4


def test_what_is_not_said_yet_is_unknown_but_a_shift_from_the_file():
    assert ModelIntake().take(messages([0])[1][0]).error is None
    given = ModelIntake().take(messages([0])[1][0])
    setup = setup_of(triaxial_tool())
    for own, size in ((None, 0.0), (replace(MODEL, shift_sigma_m=1e-3), 1e-3)):
        assert ModelReader(setup, own, '').answer(given).model.shift_sigma_m == size


def test_published_models_become_answers_that_share_what_is_the_same():
    maker, intake, now = ModelWriter(), ModelIntake(), 10**12
    reader = ModelReader(setup_of(triaxial_tool()), None, 'nominal')
    assert reader.own.model is None and not reader.own.follows
    answers = [
        reader.answer(taken(intake, maker, MODEL, now + n, n > 0, withheld))
        for n, withheld in enumerate((0, 0, 1, 2))
    ]
    assert [one.stamp_ns for one in answers] == [now, now + 1, now + 2, now + 3]
    assert [one.follows for one in answers] == [False, True, True, True]
    assert answers[0].withheld is None and answers[1].withheld is None
    assert 'no reference readings yet, or too few' in answers[2].withheld.reason
    assert answers[3].withheld.state == 'references_doubtful'
    given = maker.given(MODEL, now + 4, True, 2)  # of the same uncertainty, so not said again
    last = reader.answer(intake.take(read_cloud(maker.dipoles(given, 'fg'))))
    assert last.model is answers[3].model and last.name == str(now + 4)


STEP_NS = 20_000_000
WAIT_S = 0.1


class Log:
    """A queue whose frames note the model in force."""

    def __init__(self, follows=True):
        self.model, self.tracked, self.used = None, [], []
        self.queue = AnsweredFrames(self)
        self.queue.follows = follows

    def use(self, answer, ahead):
        self.model = answer.model
        self.used.append((answer.model, ahead))

    def step(self, _stamp_ns, tools):
        self.tracked.append((tools, self.model))
        return []

    def say(self, n, name=None, stamp_ns=None):
        answer = Answer(stamp_ns or FIRST_NS + n * STEP_NS, n if name is None else name)
        self.queue.add_answer(answer, 0.0)

    def frame(self, n, now_s=0.0, lags=False):
        frame = ChainFrame(FIRST_NS + n * STEP_NS, n, None)
        self.queue.add_frame(frame, now_s, WAIT_S, lags)


ORDERS = {
    'tools first': [0, 'm0', 1, 'm1', 2, 'm2', 3, 'm3'],
    'references first': ['m0', 0, 'm1', 1, 'm2', 2, 'm3', 3],
    'a tracker that has fallen behind': ['m0', 0, 'm1', 'm2', 'm3', 1, 2, 3],
    'frames in a burst': ['m0', 0, 1, 2, 3, 'm1', 'm2', 'm3'],
}


@pytest.mark.parametrize('order', ORDERS.values(), ids=ORDERS)
def test_every_frame_gets_the_model_of_its_own_instant(order):
    log, frames, models = Log(), set(), set()
    for event in order:
        if isinstance(event, int):
            log.frame(event)
            frames.add(event)
        else:
            log.say(int(event[1:]))
            models.add(int(event[1:]))
        assert log.tracked == [(n, n) for n in sorted(frames & models)]
        assert bool(log.queue.waiting) == bool(frames - models)
    assert log.queue.late == 0


@pytest.mark.parametrize('order', ORDERS.values(), ids=ORDERS)
def test_a_live_frame_gets_the_model_of_the_instant_before(order):
    log, frames, models = Log(), set(), set()
    for event in order:
        if isinstance(event, int):
            log.frame(event, lags=True)
            frames.add(event)
        else:
            log.say(int(event[1:]))
            models.add(int(event[1:]))
        ready = [n for n in sorted(frames) if max(n - 1, 0) in models]
        assert log.tracked == [(n, max(n - 1, 0)) for n in ready], 'the first has its own'
    assert log.queue.late == 0 and all(ahead for _, ahead in log.used[1:])


def test_no_answer_delays_a_few_frames_and_then_none():
    log = Log()
    log.say(0)
    log.frame(0)
    now_s = 0.0
    for n in range(1, 1 + MOST_LATE):
        log.frame(n, now_s)
        log.queue.work(now_s + 0.99 * WAIT_S)
        assert len(log.tracked) == n
        now_s += WAIT_S
        log.queue.work(now_s)
    assert log.queue.late == MOST_LATE
    for n in range(1 + MOST_LATE, 10):
        log.frame(n, now_s)
    assert log.tracked == [(n, 0) for n in range(10)], 'the newest model there is'
    log.say(9)  # the server is back
    log.frame(10)
    assert log.queue.waiting
    log.say(10)
    assert log.tracked[-1] == (10, 10)


def test_a_frame_whose_answer_was_lost_goes_on_with_the_next_one():
    log = Log()
    log.say(0)
    log.frame(0)
    log.frame(1)
    log.say(2)
    assert log.tracked == [(0, 0), (1, 0)]
    log.frame(2)
    assert log.tracked[-1] == (2, 2)


@pytest.mark.parametrize('follows', [True, False])
def test_a_model_with_another_clock_s_stamp_is_used_at_once(follows):
    log = Log(follows)
    log.frame(0)
    log.say(0)
    log.say(0, 'reset', FIRST_NS * 2)
    assert log.model == 'reset'
    log.frame(1)
    assert log.queue.waiting == follows, 'a reset is no answer'


def test_nobody_waits_for_a_server_that_does_not_follow():
    log = Log(follows=False)
    log.say(0, 'base', 5)
    for n in range(3):
        log.frame(n)
    assert log.tracked == [(n, 'base') for n in range(3)]
    log.say(3)
    assert log.model == 'base', 'it belongs to a later frame'
    log.frame(3)
    assert log.tracked[-1] == (3, 3)


def test_only_the_newest_of_many_is_used():
    log = Log(follows=False)
    log.frame(0)
    log.used.clear()
    for n in range(1, 30):
        log.say(n)
    log.frame(30)
    assert log.used == [(29, False)]


def test_a_recording_that_begins_again():
    log = Log()
    for n in (0, 1000, 0):
        log.frame(n)
        log.say(n)
    assert log.tracked == [(0, 0), (1000, 1000), (0, 0)]
