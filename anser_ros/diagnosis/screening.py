"""Looks at residuals alone: what stands out, what they depend on, what is noise."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter
from scipy.special import chdtrc, chdtri

from anser_ros.arrays import Array, Booleans, Integers
from anser_ros.diagnosis import decisions
from anser_ros.diagnosis.problem import Part, Problem, State, evaluate, tool_parts
from anser_ros.effects.effect import Family, Term

WINDOW = 11
"""Neighbouring frames whose median an outlier stands out from: up to five bad ones in a row."""


def without_outliers(problem: Problem, terms: Sequence[Term] = ()) -> Problem:
    """Return the problem without readings and whole frames that stand out beside some effects."""
    kept = []
    moves = any(term.effect.family is Family.FLUCTUATION for term in terms)
    emitters, tools = problem.fields.omega.size, tool_parts(evaluate(problem, terms))
    for part, tool, good in zip(tools, problem.tools, problem.good, strict=False):
        # The residual along the pose's own directions is left in: an optical glitch shows there.
        size = (part.residual * part.whitener.weight) ** 2
        white = part.white**2
        readings = _by_reading(white, good.shape[1], emitters)
        count = np.maximum(good.sum(axis=1), 1)
        frames = np.where(good, readings, 0.0).sum(axis=1) / count
        jumps = np.where(good, _by_reading(size, good.shape[1], emitters), 0.0).sum(axis=1) / count
        values = _values(white, good.shape[1], emitters)
        of_reading = of_frame = decisions.PLACE_RATIO
        if tool.track is None or tool.is_followed:
            of_reading = _ratio(decisions.READING_RATIO, values)
            of_frame = _ratio(decisions.FRAME_RATIO, values * good.shape[1])
        bad = _stands_out(readings, of_reading) | _stands_out(frames[:, None], of_frame)
        if not moves:
            bad |= _stands_out(jumps[:, None], decisions.JUMP_RATIO)
        kept.append(good & ~bad)
    return replace(problem, good=tuple(kept))


def _by_reading(values: Array, sensors: int, emitters: int) -> Array:
    """Mean over the parts of each sensor's phasors that are anything, (F, S)."""
    shaped = values.reshape(values.shape[0], 2, sensors, emitters)
    return np.asarray(shaped.sum(axis=(1, 3)) / _values(values, sensors, emitters))


def _values(values: Array, sensors: int, emitters: int) -> int:
    """Parts of a reading that are anything: constant fields have no quadrature."""
    shaped = values.reshape(values.shape[0], 2, sensors, emitters)
    return max(int(shaped.any(axis=(0, 2)).sum()), 1)


def _ratio(usual: float, values: int) -> float:
    """Mean square of so many values beyond which it is no noise."""
    return max(usual, float(chdtri(values, decisions.RARE)) / values)


def _stands_out(values: Array, ratio: float) -> Booleans:
    """Above ``ratio`` times the median of the neighbours in time, and above noise."""
    local = median_filter(values, size=(WINDOW, 1), mode='nearest')
    return np.asarray(values > ratio * np.maximum(local, 1.0))


def outlying_share(before: Problem, after: Problem) -> tuple[float, list[int]]:
    """Return the share of frames that lost a reading, and the channels that lost most of them;
    no channels if whole frames are outliers.
    """
    lost_frames, frames, whole = 0, 0, 0
    by_channel: dict[int, int] = {}
    for tool, old, new in zip(before.tools, before.good, after.good, strict=True):
        lost = old & ~new
        lost_frames += int(lost.any(axis=1).sum())
        whole += int(
            (lost.sum(axis=1) > decisions.WHOLE_FRAME_SHARE * old.sum(axis=1).clip(1)).sum()
        )
        frames += tool.time.size
        by_channel |= dict(zip(tool.sensors.channel.tolist(), lost.sum(axis=0), strict=True))
    share = lost_frames / max(frames, 1)
    if whole > decisions.WHOLE_FRAME_SHARE * max(lost_frames, 1):
        return share, []
    return share, [
        c for c, n in by_channel.items() if n > decisions.LEAST_CHANNEL_SHARE * max(lost_frames, 1)
    ]


BINS = 12
"""Cells into which frames are binned by one variable, tens of frames in each."""
BINNED = ('time', 'position', 'orientation', 'speed', 'amplitude')  # by which frames are binned
GROUPED = ('channel', 'emitter', 'quadrature')
FEWEST_CELL_VALUES = 4
"""Values that a cell needs for its mean to be compared: fewer add more noise than information."""


@dataclass(frozen=True)
class StructureTest:
    """Holds the test of one variable."""

    variable: str
    share: float  # part of the residual power that the cell means explain beyond chance
    probability: float  # of as much structure in noise

    @property
    def significant(self) -> bool:
        """Return whether noise hardly does that, and it matters."""
        return self.probability < decisions.SIGNIFICANT and self.share > decisions.LEAST_DEPENDENCE


def structure_tests(state: State) -> list[StructureTest]:
    """Test the tools' whitened residuals against every variable, strongest first.

    For time, position, orientation, speed and amplitude the frames are binned, and the mean of
    each phasor part of each sensor in each bin is compared with zero. For channel, emitter and
    frequency the spread over the groups is compared with the spread of all.
    """
    tools = tool_parts(state)
    noise = _noise(tools)
    tests = [_binned(tools, name, noise) for name in BINNED]
    tests += [_grouped(tools, name, noise) for name in GROUPED]
    return sorted(tests, key=lambda test: -round(test.share, 9))  # which a rounding does not swap


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


def known_variance(state: State) -> float:
    """Return the variance of the tools' residuals that is known of: noise, and what the model
    says that it may be wrong by, which is alike at places close to each other.
    """
    noise = noise_scale(state) ** 2
    return max(noise, min(noise + model_share(state), 1.0))


def model_share(state: State) -> float:
    """Return the share of the tools' expected power that the model states as its own error,
    everywhere and by place.
    """
    weight = np.concatenate([part.whitener.weight.ravel() for part in tool_parts(state)])
    noise = (state.problem.spread.noise_t * weight[weight > 0]) ** 2
    return float(np.mean(np.maximum(1.0 - noise, 0.0)))


def noise_t(state: State) -> float:
    """Return the noise of a phasor component, T: the white part.

    The six directions of a frame's pose are not counted: the residual along them is as large as
    the jitter's prior allows, whatever the noise.
    """
    tools = tool_parts(state)
    count = sum(part.count for part in tools)
    frames = sum(int((part.whitener.weight > 0).any(axis=1).sum()) for part in tools)
    share = min(6 * frames / max(count, 1), 0.9)
    variance = max((_noise(tools) - share) / (1 - share), 1e-6)
    return float(np.sqrt(variance)) * state.problem.spread.flux_t


def _quantiles(values: Array, bins: int) -> Integers:
    edges = np.quantile(values, np.linspace(0, 1, bins + 1)[1:-1])
    return np.searchsorted(edges, values, side='right')


def _cells(part: Part, name: str) -> list[Integers]:
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
        # The turn from the middle frame's orientation, by its components.
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
    share = max(explained - cells * noise, 0.0) / max(total, 1e-300)
    return StructureTest(name, share, float(chdtrc(max(cells, 1), explained / noise)))


def _grouped(parts: list[Part], name: str, noise: float) -> StructureTest:
    groups, squares, counts = [], [], []
    for part in parts:
        quadrature, sensor, emitter = np.indices((2, *part.view.flux.shape[1:])).reshape(3, -1)
        channels = part.view.sensors.channel[sensor]
        groups.append({'channel': channels, 'emitter': emitter, 'quadrature': quadrature}[name])
        good = part.whitener.weight > 0
        squares.append(np.sum((part.white * good) ** 2, axis=0))
        counts.append(good.sum(axis=0))
    _, label = np.unique(np.concatenate(groups), return_inverse=True)
    square, n = (np.bincount(label, np.concatenate(each)) for each in (squares, counts))
    n = np.maximum(n, 1)
    statistic = float(np.sum((square / n / noise - 1.0) ** 2 * n / 2))
    excess = float(np.sum(np.maximum(square - n * noise, 0.0)))
    probability = float(chdtrc(n.size, statistic))
    return StructureTest(name, excess / max(float(square.sum()), 1e-300), probability)


LAGS = 12
"""Frames back to which a memory is looked for: half a second at 25 Hz."""
OUTLYING = 4.5
"""Standard deviations beyond which a value is not used here: one alone would make a kurtosis."""


def noisy_channels(state: State) -> dict[int, float]:
    """Return mean squares of tools' channels that are larger than expected, if not of all.

    Taking the pose out spreads a trace of each channel's noise over all.
    """
    power = {c: own.mean() for part in tool_parts(state) for c, own in part.power().items()}
    least = max(decisions.LEAST_NOISE_GROWTH**2, decisions.CHANGED * max(power.values()))
    noisy = {c: float(own) for c, own in power.items() if own > least}
    return noisy if len(noisy) < len(power) else {}


def not_white(state: State, channels: Sequence[int] = ()) -> tuple[str, ...]:
    """Return what the tools' residuals, each over the spread of its own kind, depend on.

    Of some channels where these are noisy. In the words of `docs/interfaces.md`; nothing where
    they may be called noise.
    """
    tools = [part for part in tool_parts(state) if part.white.shape[0] > 2 * LAGS]
    values = [_scaled(part, channels) for part in tools]
    pairs = list(zip(tools, values, strict=True))
    found: list[str] = []
    if any(_memory(part, v) > decisions.LEAST_CORRELATION for part, v in pairs):
        found.append('time')
    if any(_shared(v) > decisions.SHARED for v in values):
        found += ['channel', 'emitter']
    with_size = any(_with_size(part, v) > decisions.WITH_SIZE for part, v in pairs)
    if with_size or (values and abs(_kurtosis(values)) > decisions.NOT_NORMAL):
        found.append('amplitude')
    return tuple(found)


def _scaled(part: Part, channels: Sequence[int]) -> Array:
    """Residuals over the spread of their column; NaN where there is none, or of other channels."""
    good = part.whitener.weight > 0
    if channels:
        good &= np.tile(
            np.repeat(np.isin(part.view.sensors.channel, channels), part.view.omega.size), 2
        )
    white = np.where(good, part.white, np.nan)
    count = np.maximum(good.sum(axis=0), 1)
    size = np.sqrt(np.nansum(white**2, axis=0) / count)
    out = white / np.where(size > 0, size, 1.0)
    return np.where(np.abs(out) < OUTLYING, out, np.nan)


def _sure(figure: float, values: int) -> float:
    """What so many values give, as far as fewer than the bounds were chosen on show it."""
    return figure * min(1.0, float(np.sqrt(values / decisions.BOUNDED_VALUES)))


def _memory(part: Part, values: Array) -> float:
    """Largest correlation with an earlier frame, over lags and all columns pooled."""
    step = np.median(np.diff(part.view.time))
    known = np.nan_to_num(values)
    most = 0.0
    for lag in range(1, LAGS + 1):
        near = np.abs(part.view.time[lag:] - part.view.time[:-lag] - lag * step) < 0.5 * step
        if near.sum() < LAGS:
            continue
        one, other = known[lag:][near], known[:-lag][near]
        power = np.sqrt(float(np.sum(one**2)) * float(np.sum(other**2)))
        share = abs(float(np.sum(one * other))) / max(power, 1e-300)
        most = max(most, _sure(share, int(np.count_nonzero(one))))
    return most


def _shared(values: Array) -> float:
    """Largest eigenvalue of the correlations over Marchenko and Pastur's upper edge."""
    used = values[:, np.isfinite(values).mean(axis=0) > 0.5]
    frames, count = used.shape
    if count < 2 or frames < 8:
        return 0.0
    known = np.nan_to_num(used)
    known = known / np.sqrt(np.maximum(np.mean(known**2, axis=0), 1e-300))
    gram = known @ known.T if frames < count else known.T @ known
    largest = float(np.linalg.eigvalsh(gram / frames)[-1])
    return largest / float(1 + np.sqrt(count / frames)) ** 2


def _with_size(part: Part, values: Array) -> float:
    """Correlation of squared residuals with squared readings, each over its column's mean."""
    flux = part.view.flux
    flat = np.concatenate([np.abs(flux).reshape(flux.shape[0], -1) ** 2] * 2, axis=1)
    known = np.isfinite(values)
    size = flat / np.maximum(flat.mean(axis=0), 1e-300)
    a, b = values[known] ** 2, size[known]
    a, b = a - a.mean(), b - b.mean()
    power = np.sqrt(float(a @ a) * float(b @ b))
    return _sure(float(a @ b) / power, a.size) if power > 0 else 0.0


def _kurtosis(values: list[Array]) -> float:
    known = np.concatenate([v[np.isfinite(v)] for v in values])
    # A normal distribution cut at OUTLYING has a kurtosis of 2.99.
    return _sure(float(np.mean(known**4) / np.mean(known**2) ** 2 - 2.99), known.size)
