"""The device's clock in the host's: stamps that late arrivals do not move."""

import numpy as np
import pytest

from anser_ros.signals.clock import DeviceClock


class TestClock:
    def test_latency_that_varies_does_not_move_the_stamps(self):
        rng = np.random.default_rng(0)
        clock = DeviceClock(1e6)
        errors = []
        for k in range(20000):
            true_ns = 10**15 + k * 1_000_000
            device = (k * 1_000_000) * (1 - 50e-6) / 1e3
            clock.observe(device, int(true_ns + 200_000 + rng.exponential(300_000)))
            errors.append(clock.host_ns(device) - true_ns)
        settled = np.array(errors[100:])
        assert np.abs(settled - 200_000).max() < 30_000

    @pytest.mark.parametrize('ppm', [-60.0, 0.0, 60.0])
    def test_a_busy_host_does_not_move_the_stamps(self, ppm):
        """Nothing comes in time but for one block in four seconds."""
        rng = np.random.default_rng(1)
        clock, errors = DeviceClock(1e6), []
        for k in range(60_000):
            true_ns = 10**15 + k * 1_000_000
            device = k * 1e3 * (1 + 1e-6 * ppm)
            late_ns = 0.0 if rng.random() < 1 / 4000 else 2e6 + rng.exponential(3e6)
            clock.observe(device, int(true_ns + 200_000 + late_ns))
            errors.append(clock.host_ns(device) - true_ns)
        assert clock.jumps == 0
        assert np.abs(np.array(errors[30_000:]) - 200_000).max() < 60_000

    def test_before_the_first_arrival_there_is_no_time(self):
        assert DeviceClock(1e6).host_ns(5.0) == 0

    @pytest.mark.parametrize('ticks', [0.0, 60e6])
    def test_a_device_clock_that_jumps_is_followed(self, ticks):
        clock = DeviceClock(1e6)
        clock.observe(5e6, 10**12)
        clock.observe(ticks, 10**12 + 1_000_000)
        assert clock.jumps == 1
        assert clock.host_ns(ticks) == 10**12 + 1_000_000

    def test_a_host_that_stalls_does_not_move_the_stamps(self):
        clock = DeviceClock(1e6)
        clock.observe(1e6, 10**12)
        clock.observe(1.1e6, 10**12 + 2_000_000_000)
        assert clock.jumps == 0
        assert abs(clock.host_ns(1.1e6) - 10**12 - 100_000_000) < 20_000
        for second in range(2, 7):
            clock.observe(second * 1e6, 10**12 + (second + 4) * 1_000_000_000)
        assert clock.jumps == 1
        assert abs(clock.host_ns(6e6) - 10**12 - 10_000_000_000) < 1_000_000
