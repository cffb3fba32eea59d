"""Which model a frame is tracked with, and when."""

import pytest

from anser_ros.nodes.tracker_models import MOST_LATE, AnsweredFrames

STEP_NS = 20_000_000
FIRST_NS = 1_750_000_000_000_000_000
WAIT_S = 0.1


class Log:
    """A queue whose frames note the model in force."""

    def __init__(self, follows=True):
        self.model, self.tracked = None, []
        self.queue = AnsweredFrames(self.use, self.track)
        self.queue.follows = follows

    def use(self, model):
        self.model = model

    def track(self, frame):
        self.tracked.append((frame, self.model))

    def say(self, n, name=None, now_s=0.0):
        self.queue.add_model(FIRST_NS + n * STEP_NS, n if name is None else name, now_s)

    def frame(self, n, now_s=0.0):
        self.queue.add_frame(FIRST_NS + n * STEP_NS, n, now_s, WAIT_S)


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
    log.queue.add_model(FIRST_NS * 2, 'reset', 0.0)
    assert log.model == 'reset'
    log.frame(1)
    assert log.queue.waiting == follows, 'a reset is no answer'


def test_nobody_waits_for_a_server_that_does_not_follow():
    log = Log(follows=False)
    log.queue.add_model(5, 'base', 0.0)
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
    used = []
    log.queue._use = used.append
    for n in range(1, 30):
        log.say(n)
    log.frame(30)
    assert used == [29]


def test_a_recording_that_begins_again():
    log = Log()
    for n in (0, 1000, 0):
        log.frame(n)
        log.say(n)
    assert log.tracked == [(0, 0), (1000, 1000), (0, 0)]
