"""The acquisition on a line that repeats itself or has a broken clock, over a pseudo-terminal.

The unit's fluxes tell when they were sampled: each that is not flagged must be stamped so.
"""

import numpy as np
import pytest
from faulty_unit import FaultyUnit, Ring, Ticks, sampled_s
from test_acquisition_node import Listener, points

from anser_ros.wire.points import STALE

WORST_S = 6e-3
"""Largest error of a stamp, s: 5 ms, and what the noise makes of the reading of the time."""


@pytest.fixture
def line(ros, start, tmp_path):
    """The unit, and a listener that already hears the acquisition."""
    unit = FaultyUnit(tmp_path / 'cu')
    listener = Listener(ros)
    start('acquisition', '--ros-args', '-p', f'device:={tmp_path / "cu"}')
    try:
        listener.until(lambda: len(listener.tool) > 10)
        yield unit, listener
    finally:
        unit.close()


def errors_s(unit, messages):
    """Errors (n,) of the stamps of all fluxes without a flag, s."""
    found = []
    for message, _ in messages:
        stamp = message.header.stamp
        meant_s = unit.taken_s(stamp.sec * 10**9 + stamp.nanosec)
        fluxes = points(message)
        found += (meant_s - sampled_s(fluxes.flux, meant_s))[fluxes.flags == 0].tolist()
    return np.abs(np.array(found))


def test_what_repeats_itself_is_stale_and_said(line):
    unit, listener = line
    unit.tamper = ring = Ring(100)
    count = len(listener.tool)
    listener.until(lambda: len(listener.tool) > count + 15 and ring.is_full)
    ring.on = True
    told = 'anser/acquisition: the control unit keeps sending the same samples'
    listener.until(lambda: told in listener.seen)
    assert (points(listener.tool[-1][0]).flags & STALE).all()
    ring.on = False
    listener.until(lambda: not points(listener.tool[-1][0]).flags.any())
    assert errors_s(unit, listener.tool[count:]).max() < WORST_S


def test_ticks_that_stand_still_or_lie_about_their_rate_move_no_stamp(line):
    unit, listener = line
    unit.tamper = ticks = Ticks()
    ticks.change = lambda _ticks: 7
    listener.until(lambda: any("the device's ticks stand still" in said for said in listener.seen))
    ticks.change, ticks.rate = (lambda now: now), 2.0
    listener.until(lambda: any('ticks run at 0.5 times' in said for said in listener.seen))
    count = len(listener.tool)
    listener.until(lambda: len(listener.tool) > count + 10)
    assert errors_s(unit, listener.tool).max() < WORST_S
