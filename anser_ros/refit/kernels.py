"""Compiles the products of every frame: each table is read once, in single precision.

The time of a frame is spent on loading the tables, not on arithmetic. Single precision is 1e-7 of
a reading that is at most 1e6 noise deviations. Sums may be reordered, so that they go through
vector registers; infinities and NaN keep their meaning.
"""

import math

import numpy as np

from anser_ros.kernel_cache import inlined, kernel

FAST = {'reassoc', 'contract', 'nsz'}


@kernel(fastmath=FAST)
def fill_products(matrix, columns, out):  # type: ignore[no-untyped-def]
    """Write a matrix (R, n) times two columns, given as rows (2, n), into ``out`` (R, 2)."""
    for i in range(matrix.shape[0]):
        first, second = np.float32(0.0), np.float32(0.0)
        for j in range(matrix.shape[1]):
            first += matrix[i, j] * columns[0, j]
            second += matrix[i, j] * columns[1, j]
        out[i, 0], out[i, 1] = first, second


@inlined
def _fill_probabilities(curve, probability):  # type: ignore[no-untyped-def]
    """Write the weights of log likelihoods (A,) and return the logarithm of their mean."""
    top, total = curve[0], 0.0
    for a in range(curve.shape[0]):
        top = max(top, curve[a])
    for a in range(curve.shape[0]):
        probability[a] = math.exp(curve[a] - top)
        total += probability[a]
    for a in range(curve.shape[0]):
        probability[a] /= total
    return top + math.log(total / curve.shape[0])


@kernel(fastmath=FAST)
def fill_evidence(  # type: ignore[no-untyped-def]
    analysis, readings, precision, log_det, log_prior, projected, curve, strength, log_evidence,
    weighted,
):  # fmt: skip
    """Write what readings (2, n) say about all hypotheses; see `FrameEvidence`.

    ``analysis`` (H n, n), ``precision`` (H, A, n), ``log_det`` (H, A); ``log_prior`` (H,) is minus
    infinity for empty slots, of which nothing else is written. On entry ``log_evidence`` (H,) and
    ``weighted`` (2, n) are zero. Returns the most likely hypothesis.
    """
    count, strengths, n = precision.shape
    first, second, best = np.empty(n, np.float32), np.empty(n, np.float32), 0
    for h in range(count):
        if log_prior[h] == -math.inf:
            continue
        fill_products(analysis[h * n : (h + 1) * n], readings, projected[h])
        for i in range(n):
            first[i] = projected[h, i, 0] * projected[h, i, 0]
            second[i] = projected[h, i, 1] * projected[h, i, 1]
        for a in range(strengths):
            real, imaginary = np.float32(0.0), np.float32(0.0)
            for i in range(n):
                real += precision[h, a, i] * first[i]
                imaginary += precision[h, a, i] * second[i]
            curve[h, 0, a] = -0.5 * (real + log_det[h, a])
            curve[h, 1, a] = -0.5 * (imaginary + log_det[h, a])
        log_evidence[h] = _fill_probabilities(curve[h, 0], strength[h, 0])
        log_evidence[h] += _fill_probabilities(curve[h, 1], strength[h, 1])
    for h in range(count):
        log_evidence[h] += log_prior[h]
        if log_evidence[h] > log_evidence[best]:
            best = h
    for part in range(2):
        top = 0
        for a in range(strengths):
            if strength[best, part, a] > strength[best, part, top]:
                top = a
        for i in range(n):
            scaled = np.float64(projected[best, i, part]) * precision[best, top, i]
            for j in range(n):
                weighted[part, j] += scaled * analysis[best * n + i, j]
    return best


@kernel(nogil=True, fastmath=FAST)
def fill_scores(directions, white, inside, rest, log_det, scores):  # type: ignore[no-untyped-def]
    """Write the approximate log evidence of bodies (L,) from whitened readings (2, n).

    ``directions`` (L r, n); ``inside`` (L, A, r), ``rest`` (A,): precisions; ``log_det`` (L, A).
    """
    bodies, strengths, count = inside.shape
    power, curve = np.empty((count, 2), np.float32), np.empty((2, strengths))
    probability, total = np.empty(strengths), np.empty(2)
    for part in range(2):
        total[part] = 0.0
        for i in range(white.shape[1]):
            total[part] += white[part, i] * white[part, i]
    for body in range(bodies):
        fill_products(directions[body * count : (body + 1) * count], white, power)
        left0, left1 = total[0], total[1]
        for r in range(count):
            power[r, 0] *= power[r, 0]
            power[r, 1] *= power[r, 1]
            left0 -= power[r, 0]
            left1 -= power[r, 1]
        left0, left1 = max(left0, 0.0), max(left1, 0.0)
        for a in range(strengths):
            real, imaginary = rest[a] * left0, rest[a] * left1
            for r in range(count):
                real += inside[body, a, r] * power[r, 0]
                imaginary += inside[body, a, r] * power[r, 1]
            curve[0, a] = -0.5 * (real + log_det[body, a])
            curve[1, a] = -0.5 * (imaginary + log_det[body, a])
        scores[body] = _fill_probabilities(curve[0], probability)
        scores[body] += _fill_probabilities(curve[1], probability)


@inlined
def _fill_block(rows, precision, weighted, block):  # type: ignore[no-untyped-def]
    """Write ``rows diag(precision) rows^T`` of rows (m, n), two by two, as a lower half."""
    count, n = rows.shape
    for r in range(0, count, 2):
        also = min(r + 1, count - 1)
        for i in range(n):
            weighted[0, i] = precision[i] * rows[r, i]
            weighted[1, i] = precision[i] * rows[also, i]
        for s in range(0, r + 2, 2):
            beside = min(s + 1, count - 1)
            first, second, third, fourth = 0.0, 0.0, 0.0, 0.0
            for i in range(n):
                first += weighted[0, i] * rows[s, i]
                second += weighted[0, i] * rows[beside, i]
                third += weighted[1, i] * rows[s, i]
                fourth += weighted[1, i] * rows[beside, i]
            block[r, s], block[r, beside] = first, second
            block[also, s], block[also, beside] = third, fourth


@inlined
def _fill_gains(rows, width, projected, precision, weighted, block, columns, gains):  # type: ignore[no-untyped-def]
    """Write by how much a log likelihood grows without the first coil, the first two, and so on.

    ``rows`` (m, n) are those coils' rows of the eigenvectors; ``gains`` (m / width, 2). By the
    rules of the conditional normal distribution, with a Cholesky factor that all of them share.
    """
    _fill_block(rows, precision, weighted, block)
    for i in range(rows.shape[1]):
        weighted[0, i] = precision[i] * projected[i, 0]
        weighted[1, i] = precision[i] * projected[i, 1]
    half_log_det, power, imaginary_power = 0.0, 0.0, 0.0
    for r in range(rows.shape[0]):
        real, imaginary = 0.0, 0.0
        for i in range(rows.shape[1]):
            real += weighted[0, i] * rows[r, i]
            imaginary += weighted[1, i] * rows[r, i]
        for s in range(r):
            total = block[r, s]
            for i in range(s):
                total -= block[r, i] * block[s, i]
            block[r, s] = total / block[s, s]
            real -= block[r, s] * columns[s, 0]
            imaginary -= block[r, s] * columns[s, 1]
        total = block[r, r]
        for i in range(r):
            total -= block[r, i] * block[r, i]
        block[r, r] = math.sqrt(total)
        columns[r, 0], columns[r, 1] = real / block[r, r], imaginary / block[r, r]
        half_log_det += math.log(block[r, r])
        power += columns[r, 0] * columns[r, 0]
        imaginary_power += columns[r, 1] * columns[r, 1]
        if (r + 1) % width == 0:
            gains[r // width, 0] = 0.5 * power - half_log_det
            gains[r // width, 1] = 0.5 * imaginary_power - half_log_det


@kernel(fastmath=FAST)
def fill_without(  # type: ignore[no-untyped-def]
    bases, coils, width, projected, precision, curve, log_evidence, bounds, best, done,
    gain, strength,
):  # fmt: skip
    """Write what all hypotheses say without the first coil, the first two, and so on.

    ``bases`` (H, n, n), ``coils`` (Q,); ``curve`` (H, 2, A) and ``log_evidence`` (H,) are those of
    all coils. On entry ``best`` (Q,) is -inf, ``done`` (H, A) False. ``gain`` (H, Q), then zero,
    is by how much the log likelihood at its top is larger without them, ``strength`` (H, Q, 2)
    where that top is. It has one top, so only strengths between the top with all coils and that
    without them are worked out: as far as it rises by more than ``bounds[0]``, and where a
    hypothesis is within ``bounds[1]`` of the best.
    """
    count, grid, n = precision.shape
    size, sets = len(coils) * width, len(coils)
    rows, block = np.empty((size, n)), np.empty((size, size))
    columns, weighted = np.empty((size, 2)), np.empty((2, n))
    gains = np.empty((count, grid, sets, 2))
    for is_walk in (False, True):
        for h in range(count):
            if log_evidence[h] == -math.inf:
                continue
            behind = math.inf
            for q in range(sets):
                behind = min(behind, best[q] - log_evidence[h] - gain[h, q])
            if behind > bounds[1]:
                continue
            for r in range(size):
                row = coils[r // width] * width + r % width
                for i in range(n):
                    rows[r, i] = bases[h, row, i]
            for q in range(sets):
                gain[h, q] = 0.0
            for part in range(2):
                start = 0
                for a in range(grid):
                    if curve[h, part, a] > curve[h, part, start]:
                        start = a
                for q in range(sets):
                    top = start
                    for step in (1, -1):
                        a = top
                        while 0 <= a < grid:
                            if not done[h, a]:
                                done[h, a] = True
                                _fill_gains(
                                    rows, width, projected[h], precision[h, a], weighted, block,
                                    columns, gains[h, a],
                                )  # fmt: skip
                            rise = curve[h, part, a] + gains[h, a, q, part]
                            rise -= curve[h, part, top] + gains[h, top, q, part]
                            if not is_walk or (a != top and rise < bounds[0]):
                                break
                            top = a
                            a += step
                        if not is_walk or top != start:
                            break
                    strength[h, q, part] = top
                    gain[h, q] += curve[h, part, top] + gains[h, top, q, part]
                    gain[h, q] -= curve[h, part, start]
            if not is_walk:
                for q in range(sets):
                    best[q] = max(best[q], log_evidence[h] + gain[h, q])
