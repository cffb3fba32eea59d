"""Tests what residuals depend on: means over cells of each variable, against what noise gives."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from anser_ros.diagnosis.decisions import LEAST_DEPENDENCE, SIGNIFICANT
from anser_ros.diagnosis.problem import Part, State
from anser_ros.diagnosis.residuals import tool_parts

Array = NDArray[np.float64]

BINS = 12
"""Cells into which frames are binned by one variable: tens of frames in each of a session of some
hundreds."""
BINNED = ('time', 'position', 'orientation', 'speed', 'amplitude')  # by which frames are binned
FEWEST_CELL_VALUES = 4
"""Values that a cell needs for its mean to be compared: the mean of four is uncertain by half of
what one value is, and cells of fewer would add more noise than information."""


@dataclass(frozen=True)
class StructureTest:
    """Holds the test of one variable."""

    variable: str
    share: float  # part of the residual power that the cell means explain beyond chance
    probability: float  # of as much structure in noise

    @property
    def significant(self) -> bool:
        """Return whether noise hardly does that, and it matters."""
        return self.probability < SIGNIFICANT and self.share > LEAST_DEPENDENCE


def structure_tests(state: State) -> list[StructureTest]:
    """Test the tools' whitened residuals against every variable, strongest first.

    For time, position, orientation, speed and amplitude the frames are binned, and the mean of
    each phasor part of each sensor in each bin is compared with zero. For channel, emitter and
    frequency the spread over the groups is compared with the spread of all.
    """
    tools = tool_parts(state)
    noise = _noise(tools)
    tests = [_binned(tools, name, noise) for name in BINNED]
    tests += [_grouped(tools, name, noise) for name in ('channel', 'emitter', 'quadrature')]
    return sorted(tests, key=lambda test: -test.share)


def _noise(parts: list[Part]) -> float:
    """Variance of the white part of the residuals, from differences of neighbouring frames."""
    squares, count = 0.0, 0
    for part in parts:
        if part.white.shape[0] < 2:
            continue
        both = (part.whitener.weight[1:] > 0) & (part.whitener.weight[:-1] > 0)
        close = np.diff(part.view.time) < 3 * np.median(np.diff(part.view.time))
        step = np.diff(part.white, axis=0)[close][both[close]] / np.sqrt(2)
        squares += float(np.sum(step**2))
        count += step.size
    return squares / count if count else 1.0


def noise_scale(state: State) -> float:
    """Return the deviation of the white part of the tools' residuals over the expected one."""
    return float(np.sqrt(_noise(tool_parts(state))))


def noise_t(state: State) -> float:
    """Return the noise of a phasor component, T: the white part, without the pose's own
    directions.

    Along those six directions of a frame the residual is as large as the jitter's prior allows,
    whatever the noise; they are not counted.
    """
    tools = tool_parts(state)
    count = sum(part.count for part in tools)
    frames = sum(int((part.whitener.weight > 0).any(axis=1).sum()) for part in tools)
    share = min(6 * frames / max(count, 1), 0.9)
    variance = max((_noise(tools) - share) / (1 - share), 1e-6)
    return float(np.sqrt(variance)) * state.problem.spread.flux_t


def _quantiles(values: Array, bins: int) -> NDArray[np.int64]:
    edges = np.quantile(values, np.linspace(0, 1, bins + 1)[1:-1])
    return np.searchsorted(edges, values, side='right')


def _cells(part: Part, name: str) -> list[NDArray[np.int64]]:
    """Cell of each frame by a variable; by the amplitude, those of each reading apart."""
    view = part.view
    if name == 'time':
        return [_quantiles(view.time, BINS)]
    if name == 'amplitude':
        size = view.flux.real.reshape(len(view.flux), -1)
        return [_quantiles(column, BINS) for column in size.T]
    if name == 'position':
        x, y, z = view.position.T
        return [_quantiles(x, 4) * 8 + _quantiles(y, 4) * 2 + _quantiles(z, 2)]
    if name == 'speed':
        x, y, z = view.velocity[:, :3].T
    else:
        # The turn from the middle frame's orientation, by its components: any orientation that
        # the tool is near to serves, as the cells are quantiles.
        turn = view.rotation[len(view.rotation) // 2].T @ view.rotation
        x, y, z = (turn[:, b, a] - turn[:, a, b] for a, b in ((1, 2), (2, 0), (0, 1)))
    return [_quantiles(x, 3) * 9 + _quantiles(y, 3) * 3 + _quantiles(z, 3)]


def _binned(parts: list[Part], name: str, noise: float) -> StructureTest:
    explained, cells, total = 0.0, 0, 0.0
    for part in parts:
        bins = _cells(part, name)
        good = part.whitener.weight > 0
        total += float(np.sum(part.white[good] ** 2))
        half = part.white.shape[1] // 2
        for i, number in enumerate(bins):
            columns = slice(None) if len(bins) == 1 else [i, half + i]
            white, counted = part.white[:, columns], good[:, columns]
            for cell in np.unique(number):
                rows = number == cell
                n = counted[rows].sum(axis=0)
                sums = (white[rows] * counted[rows]).sum(axis=0)
                use = n >= FEWEST_CELL_VALUES
                explained += float(np.sum(sums[use] ** 2 / n[use]))
                cells += int(use.sum())
    return _verdict(name, explained, cells, total, noise)


def _grouped(parts: list[Part], name: str, noise: float) -> StructureTest:
    squares: dict[int, float] = {}
    counts: dict[int, int] = {}
    for part in parts:
        sensors, emitters = part.view.flux.shape[1:]
        shape = (2, sensors, emitters)
        quadrature, sensor, emitter = (a.ravel() for a in np.indices(shape))
        channels = part.view.sensors.channel[sensor]
        group = {'channel': channels, 'emitter': emitter, 'quadrature': quadrature}[name]
        good = part.whitener.weight > 0
        for value in np.unique(group):
            columns = group == value
            squares[int(value)] = squares.get(int(value), 0.0) + float(
                np.sum((part.white[:, columns] * good[:, columns]) ** 2)
            )
            counts[int(value)] = counts.get(int(value), 0) + int(good[:, columns].sum())
    total = sum(squares.values())
    excess, statistic = 0.0, 0.0
    for value, square in squares.items():
        n = max(counts[value], 1)
        over = square / n / noise - 1.0
        statistic += over**2 * n / 2
        excess += max(square - n * noise, 0.0)
    probability = float(chdtrc(max(len(squares), 1), statistic))
    return StructureTest(name, excess / max(total, 1e-300), probability)


def _verdict(name: str, explained: float, cells: int, total: float, noise: float) -> StructureTest:
    share = max(explained - cells * noise, 0.0) / max(total, 1e-300)
    probability = float(chdtrc(max(cells, 1), explained / noise))
    return StructureTest(name, share, probability)
