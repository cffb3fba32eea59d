"""The window of readings that a baseline is the mean of."""

import numpy as np
import pytest
from tracking_world import triaxial_tool

from anser_ros.errors import FitError
from anser_ros.frames.intake import Intake
from anser_ros.refit.frame import ReadingWindow

TOOL = triaxial_tool()
CHANNELS = TOOL.channel
STEP_NS = 20_000_000


def test_baseline_window():
    window, intake = ReadingWindow(TOOL, 8, 0.1), Intake(CHANNELS)
    with pytest.raises(FitError, match='needs 3 frames'):
        window.mean()
    flux = 1e-3 * (np.arange(72.0).reshape(9, 8) + 1j)
    flags = np.zeros(9, int)
    for i in range(10):
        noisy = flux + (1e-3 if i % 2 else -1e-3)
        noisy[0] = np.nan
        flags[1] = 1 if i < 8 else 0
        window.add(intake.judge((i + 1) * STEP_NS, CHANNELS[::-1], noisy[::-1], flags[::-1]))
    assert window.full
    assert len(window) == 6, 'only the last tenth of a second'
    mean = window.mean()
    assert np.isnan(mean[0]).all()
    assert np.isnan(mean[1]).all(), 'flagged in most frames'
    np.testing.assert_allclose(mean[2:], flux[2:])
    window.add(intake.judge(1, CHANNELS, flux, flags))
    assert len(window) == 1, 'a jump back starts anew'
    assert not window.full
    with pytest.raises(FitError, match='8 emitters'):
        window.add(intake.judge(1, CHANNELS, flux[:, :3], flags))
    with pytest.raises(FitError, match='positive'):
        ReadingWindow(TOOL, 8, 0.0)
    dead = ReadingWindow(TOOL, 8, 1.0)
    for i in range(4):
        dead.add(intake.judge(i + 1, CHANNELS, np.full((9, 8), np.nan, complex), flags))
    with pytest.raises(FitError, match='no reference'):
        dead.mean()
