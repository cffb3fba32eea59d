"""A device's samples in the host's time: stamps are right to 5 ms, or there are none.

The line between device and host is simulated. Its true delays are known, so each stamp that the
clock calls good is compared with the time at which its sample was taken.
"""

from dataclasses import dataclass, field

import numpy as np
import pytest

from anser_ros.nodes.acquisition_stream import WallClock
from anser_ros.signals.clock import LARGEST_LATENESS_S, ClockState, SampleClock

RATE_HZ = 40e3
BLOCK = 40
SECOND = 1_000_000_000


@dataclass
class Line:
    """Blocks of 1 ms on a line with delays of its own; all times in s since it began.

    ``lost_s`` is time that the device loses without counting, ``ppm`` how fast its oscillator is.
    """

    clock: SampleClock = field(default_factory=lambda: SampleClock(RATE_HZ))
    seed: int = 0
    ppm: float = 0.0
    now_s: float = 0.0
    lost_s: float = 0.0
    sample: int = 0
    delivered_s: float = 0.0
    worst_s: float = 0.0
    good: list = field(default_factory=list)
    known_s: list = field(default_factory=list)

    def __post_init__(self):
        self.rng = np.random.default_rng(self.seed)

    def run(
        self,
        seconds,
        delay=lambda rng: 2e-4 + rng.exponential(3e-4),
        answers_s=None,
        in_order=True,
    ):
        """Let blocks arrive, each after a delay; at the end all that is on its way arrives.

        ``answers_s`` is how long the device's answers take; without it, it gives none.
        """
        end = self.now_s + self.lost_s + seconds
        for _ in range(round(seconds * RATE_HZ / BLOCK)):
            self.sample += BLOCK
            self.now_s += BLOCK / RATE_HZ / (1 + 1e-6 * self.ppm)
            taken = self.now_s + self.lost_s
            arrival = min(taken + delay(self.rng), max(end, taken + 2e-4))
            if in_order:
                arrival = max(arrival, self.delivered_s)
            self.delivered_s = arrival
            self.clock.observe(self.sample, int(SECOND * (100 + arrival)))
            if answers_s is not None and self.clock.wants_answer:
                sent = arrival - min(answers_s, arrival - taken + 0.002)
                self.clock.bound(self.sample + BLOCK, int(SECOND * (100 + sent)))
            self.known_s.append(taken)
            self.good.append(self.clock.is_good(self.sample))
            if self.good[-1]:
                self.worst_s = max(self.worst_s, abs(self.error_s()))
        return self

    def lose(self, seconds):
        """The device stands still and does not know it."""
        self.lost_s += seconds
        return self

    def error_s(self, block=-1):
        """Error of the stamp of a block, with the line of now."""
        index = block % len(self.known_s)
        stamp = self.clock.host_ns((index + 1) * BLOCK) / SECOND - 100
        return stamp - self.known_s[index]


def late_by(seconds):
    return lambda rng: seconds + 2e-4 + rng.exponential(3e-4)


class TestLine:
    @pytest.mark.parametrize('ppm', [-60.0, 0.0, 60.0])
    def test_delays_that_vary_do_not_move_the_stamps(self, ppm):
        line = Line(ppm=ppm).run(0.3)
        errors = []
        for _ in range(100):
            line.run(0.1)
            errors.append(line.error_s())
        assert all(line.good[300:])
        assert np.abs(np.array(errors) - 2e-4).max() < 3e-4
        assert np.abs(np.array(errors[50:]) - 2e-4).max() < 6e-5
        assert line.clock.sigma_s < 5e-4

    @pytest.mark.parametrize('ppm', [-60.0, 0.0, 60.0])
    def test_a_busy_host_does_not_move_the_stamps(self, ppm):
        """Nothing comes in time but for one block in four seconds."""

        def busy(rng):
            return 2e-4 + (0.0 if rng.random() < 1 / 4000 else 2e-3 + rng.exponential(3e-3))

        line = Line(ppm=ppm, seed=1).run(60.0, busy, in_order=False)
        assert line.clock.jumps == 0
        assert abs(line.error_s() - 2e-4) < 2e-4
        assert np.mean(line.good[30_000:]) > 0.3, 'the others wait for these'

    def test_before_the_first_arrival_there_is_no_time(self):
        clock = SampleClock(RATE_HZ)
        assert clock.host_ns(5.0) == 0
        assert not clock.is_good(-1) and not clock.wants_answer and clock.sigma_s == np.inf
        assert clock.state is ClockState.SETTLING

    def test_bytes_that_had_piled_up_at_the_start_give_no_stamp(self):
        """A second of blocks comes within 0.1 s, and only then the line is in time."""
        line = Line()
        line.run(1.0, lambda rng: 1.0 - 0.9 * line.now_s)
        assert not any(line.good)
        line.run(0.3)
        assert line.good[-1] and abs(line.error_s()) < 5e-3

    def test_an_answer_settles_a_new_line_and_tells_one_that_is_late_from_the_start(self):
        line = Line().run(0.002, answers_s=0.001)
        assert line.good[-1] and abs(line.error_s()) < 2e-3
        line = Line().run(3.0, late_by(1.2), answers_s=1.3)
        assert not any(line.good[:-1250]), 'the last 1.2 s arrive together'
        line.run(0.1, answers_s=0.002)
        assert line.good[-1] and line.worst_s < 5e-3


class TestFaults:
    @pytest.mark.parametrize('stall_s', [0.05, 0.3, 2.0])
    def test_a_stall_of_the_host_costs_no_stamp(self, stall_s):
        line = Line().run(5.0)
        begin = line.now_s
        count = len(line.good)
        line.run(stall_s + 0.5, lambda rng: max(begin + stall_s - line.now_s, 2e-4))
        assert abs(line.error_s(count + 5)) < 1e-3
        assert line.clock.is_good((count + 5) * BLOCK) and line.clock.jumps == 0
        assert line.clock.state is ClockState.GOOD

    @pytest.mark.parametrize('answers_s', [None, 1.3])
    def test_a_line_that_is_late_for_long_does_not_move_the_stamps(self, answers_s):
        line = Line().run(5.0)
        count = len(line.good)
        line.run(3.5, late_by(1.2), answers_s=answers_s)
        assert answers_s or not any(line.good[count:-1250])
        line.run(0.01)
        assert line.good[-1] and line.worst_s < 1e-3 and line.clock.jumps == 0

    @pytest.mark.parametrize('lost_s', [0.008, 0.05, 1.2])
    def test_time_that_the_device_lost_is_found_by_an_answer(self, lost_s):
        line = Line().run(5.0)
        count = len(line.good)
        line.lose(lost_s).run(0.5, answers_s=0.002)
        good = np.array(line.good[count:])
        assert not good[:25].any() and good[-300:].all()
        assert abs(line.error_s()) < 3e-3 and line.clock.jumps == 1

    def test_without_answers_lost_time_is_believed_after_ten_seconds(self):
        line = Line().run(5.0)
        count = len(line.good)
        line.lose(1.2).run(11.0)
        assert not any(line.good[count : count + 10_000])
        assert line.good[-1] and abs(line.error_s()) < 3e-3

    def test_a_line_that_stays_late_is_not_taken_for_lost_time(self):
        line = Line().run(5.0, answers_s=0.002)
        count = len(line.good)
        line.run(13.0, late_by(1.2), answers_s=1.3)
        assert np.mean(line.good[count:]) > 0.9, 'late answers show that it is the line'
        assert line.worst_s < 1e-3 and line.clock.jumps == 0

    def test_time_that_the_device_gained_begins_the_line_anew(self):
        """It jumps ahead of what it counts: the arrivals are earlier than they could be."""
        line = Line().run(5.0)
        count = len(line.good)
        line.lose(-0.05)
        line.delivered_s = 0.0
        line.run(0.5)
        assert line.clock.jumps == 1 and not line.good[count] and line.good[-1]
        assert abs(line.error_s()) < 1e-3

    def test_a_sample_rate_that_is_not_what_the_device_says(self):
        """Too slow by 1 %: nothing is in time any more until the device has answered again."""
        line = Line(ppm=-1e4).run(5.0, answers_s=0.002)
        assert line.worst_s < 5e-3 and line.clock.jumps >= 8
        assert not all(Line(ppm=-1e4).run(5.0).good[1000:])

    def test_answers_that_come_before_the_samples_are_not_believed(self):
        """A device that answers at once, and sends what it sampled 50 ms ago only then."""
        line = Line().run(0.3, late_by(0.05), answers_s=0.002)
        for _ in range(10):
            line.clock.bound(line.sample + BLOCK, int(SECOND * (100.04 + line.now_s)))
            line.run(0.5)
        assert not line.clock.wants_answer and line.good[-1] and line.clock.jumps <= 3
        assert abs(line.error_s()) < 1e-3

    def test_samples_that_run_backwards_begin_anew(self):
        clock = SampleClock(RATE_HZ)
        clock.observe(4000, SECOND)
        clock.observe(40, SECOND + 1000)
        assert clock.jumps == 1 and clock.host_ns(40) == SECOND + 1000

    def test_a_stream_that_begins_on_a_late_line_waits_for_its_answer(self):
        """The last block of the old stream comes after the answer to the start and refutes it."""
        line = Line().run(0.5, answers_s=0.002)
        line.clock.restart()
        line.clock.bound(0, int(SECOND * 100.5))
        line.clock.observe(line.sample + BLOCK, int(SECOND * 101.7))
        line.clock.restart()
        new = Line(clock=line.clock, now_s=0.5, delivered_s=1.7).run(2.0, late_by(1.2))
        assert not any(new.good)
        new.run(0.2, answers_s=0.002)
        assert new.good[-1] and new.worst_s < 1e-3

    @pytest.mark.parametrize('seed', range(12))
    def test_no_course_of_faults_gives_a_wrong_stamp_that_is_called_good(self, seed):
        rng = np.random.default_rng(seed)
        line = Line(seed=seed, ppm=rng.uniform(-80, 80)).run(0.5, answers_s=0.002)
        for kind in rng.choice(['late', 'stall', 'lose', 'load'], 4):
            size, lasts_s = rng.uniform(0.0, 1.5, 2)
            if kind == 'lose':
                line.lose(size)
            begin = line.now_s
            delay = {
                'late': late_by(size),
                'stall': lambda rng, s=size, b=begin: max(b + s - line.now_s, 2e-4),
                'load': lambda rng, s=size: 2e-4 + rng.exponential(0.02 * s),
            }.get(kind, late_by(0.0))
            line.run(lasts_s, delay, answers_s=2.0)
            assert line.worst_s < LARGEST_LATENESS_S + 1e-3, (kind, size, lasts_s)
        line.run(0.6, answers_s=0.002)
        assert line.good[-1] and line.worst_s < LARGEST_LATENESS_S + 1e-3


class Clocks:
    """Two clocks; `waits` are pauses (ns) between the readings, one after the other."""

    def __init__(self, waits=()):
        self.now_ns, self.wall_offset_ns = 10**12, 5 * 10**17
        self.waits = list(waits)

    def _pass(self):
        self.now_ns += self.waits.pop(0) if self.waits else 100

    def wall(self):
        self._pass()
        return self.now_ns + self.wall_offset_ns

    def monotonic(self):
        self._pass()
        return self.now_ns


def test_a_pause_between_two_readings_is_not_taken_for_time():
    """A thread that has to wait 8 ms between the two clocks, twice."""
    clocks = Clocks([100, 8_000_000, 100, 100, 100, 8_000_000, 100, 100, 100])
    clock = WallClock(clocks.wall, clocks.monotonic)
    assert abs(clock.offset_ns() - clocks.wall_offset_ns) < 1000


def test_a_setting_is_followed_and_counted_and_a_drift_is_not():
    clocks = Clocks()
    clock = WallClock(clocks.wall, clocks.monotonic)
    for _ in range(50):
        clocks.wall_offset_ns += 10_000
        clock.offset_ns()
    assert clock.sets == 0
    clocks.wall_offset_ns -= 2_000_000_000
    assert abs(clock.offset_ns() - clocks.wall_offset_ns) < 1000
    clock.offset_ns()
    assert clock.sets == 1
