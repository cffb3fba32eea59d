"""The system's clock beside the monotonic one, with clocks of the test's own."""

from anser_ros.nodes.acquisition_stream import WallClock


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
