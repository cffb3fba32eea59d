"""Moves dipoles to where the readings put them: drawn coils as a whole, or each dipole by itself.

A board's coils are etched, glued and soldered a fraction of a millimetre off, and near them that
is most of what a nominal model misses. Far fewer readings determine six coordinates and a complex
gain per coil (`CoilPlacer`) than free moments. Single dipoles are moved with their moments
eliminated at every step (Golub and Pereyra, Inverse Problems 19, 2003; `PositionFitter`). With
Kaufman's derivative the normal matrix is a product, entry by entry, of two small matrices: the
Gram matrix of the slopes of the basis outside the span of the basis, and that of the moments. Its
size depends neither on the number of emitters nor on that of readings.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.arrays import Array, ComplexArray, Integers
from anser_ros.calibration.least_squares import as_real
from anser_ros.calibration.readings import BLOCK_ROWS, DipoleSites, frame_blocks, weighted_readings
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import FieldModel
from anser_ros.physics.dipole import GAUSS_OFFSET, dipole_rows, fill_fields, flux_basis

SHIFT_M = 2e-3
"""Prior width of a coil's shift along each axis, m: some times what boards differ by."""
TURN_RAD = 0.03
"""Prior width of a coil's turn about each axis, rad, for the same reason."""
DIFFERENCE = 1e-2
"""Step by which derivatives are taken, as a fraction of these widths."""
COIL_STEPS = 5
"""Gauss-Newton steps of a coil at most; two are enough for shifts of a millimetre."""
COIL_AT_REST = 1e-3
"""Step, as a fraction of the widths, below which a coil stays where it is."""


class CoilPlacer:
    """Places the coils of a drawn board by readings whose poses are right."""

    def __init__(self, nominal: FieldModel) -> None:
        self.nominal = nominal
        used = nominal.moments != 0.0
        self.rows = [np.flatnonzero(used[:, k]) for k in range(used.shape[1])]
        self.possible = bool((used.sum(axis=1) == 1).all() and used.any(axis=0).all())

    @property
    def sites(self) -> DipoleSites:
        """Return the dipoles of the coils as drawn."""
        return DipoleSites(self.nominal.positions, self.nominal.directions)

    def fit(
        self, corrected: Sequence[Measurements], weights: Sequence[Array]
    ) -> tuple[DipoleSites, ComplexArray]:
        """Return the coils' dipoles where the readings put them, and their moments.

        Returns N dipoles, and their moments (N, K), A m^2.
        """
        (points, axes, lengths, flux), root = weighted_readings(corrected, weights)
        positions, directions = self.nominal.positions.copy(), self.nominal.directions.copy()
        moments = np.zeros_like(self.nominal.moments)
        for k, rows in enumerate(self.rows):
            strength = self.nominal.moments[rows, k]

            def field(
                at: Array, rows: Integers = rows, strength: ComplexArray = strength
            ) -> ComplexArray:
                place, turned = self._placed(rows, at)
                made = flux_basis(points, axes, lengths, place, turned) @ strength
                return np.asarray(root * made)

            at, gain = _coil_fit(field, root * flux[:, k])
            positions[rows], directions[rows] = self._placed(rows, at)
            moments[rows, k] = gain * strength
        return DipoleSites(positions, directions), moments

    def _placed(self, rows: Integers, at: Array) -> tuple[Array, Array]:
        """Return a coil's dipoles shifted by at[:3] (m) and turned by at[3:] (rad) about it."""
        where = self.nominal.positions[rows]
        middle = where.mean(axis=0)
        turn = Rotation.from_rotvec(at[3:]).as_matrix()
        placed = (where - middle) @ turn.T + middle + at[:3]
        return placed, self.nominal.directions[rows] @ turn.T


def _coil_fit(field: Callable[[Array], ComplexArray], flux: ComplexArray) -> tuple[Array, complex]:
    """Return the shift and turn (6,) of one coil, and its complex gain, by weighted readings."""
    widths = np.repeat([SHIFT_M, TURN_RAD], 3)
    at, best = np.zeros(6), None
    for _ in range(COIL_STEPS):
        drawn = field(at)
        gain = complex(np.vdot(drawn, flux)) / max(float(np.vdot(drawn, drawn).real), 1e-300)
        rest = flux - gain * drawn
        noise = float(np.sqrt(np.mean(np.abs(rest) ** 2) / 2.0))
        cost = float(np.vdot(rest, rest).real)
        if best is not None and cost >= best[0]:
            break
        best = (cost, at, gain)
        steps = DIFFERENCE * np.diag(widths)
        slopes = np.stack([(field(at + step) - drawn) / DIFFERENCE for step in steps], axis=1)
        columns = np.concatenate([gain * slopes, drawn[:, None], 1j * drawn[:, None]], axis=1)
        rows = np.concatenate([columns.real, columns.imag])
        hold = noise * np.eye(6, columns.shape[1])
        right = np.concatenate([rest.real, rest.imag, -noise * at / widths])
        step = np.linalg.lstsq(np.concatenate([rows, hold]), right, rcond=None)[0][:6]
        at = at + widths * step
        if np.abs(step).max() < COIL_AT_REST:
            break
    assert best is not None
    return best[1], best[2]


MOST_STEPS = 15
"""Levenberg-Marquardt steps at most."""
MOST_TRIALS = 6
"""Trials of a step, each with five times the damping of the one before."""
LONGEST_MOVE_M = 0.01
"""Longest step of a dipole, m: small beside its distance from the sensors."""
CONVERGED = 1e-3
"""Relative fall of the sum of squares below which another step is not worth its time."""


def position_slopes(points: Array, axes: Array, lengths: Array, dipoles: DipoleSites) -> Array:
    """Return the derivative of the flux basis by the dipoles' positions.

    ``points``, ``axes`` (P, 3): sensor centres (m) and unit axes, frame fg. ``lengths`` (P,): coil
    lengths, m.
    Returns (P, N, 3): derivatives, T / (A m^3).
    """
    out = np.zeros((points.shape[0], len(dipoles), 3))
    fields = np.empty((points.shape[0], 9, len(dipoles)))
    rows, (n0, n1, n2) = dipole_rows(dipoles.positions, dipoles.directions), axes.T[:, :, None]
    half = GAUSS_OFFSET * lengths[:, None]
    signs = (1.0, -1.0) if half.any() else (1.0,)
    for sign in signs:
        fill_fields(points + sign * half * axes, rows, fields)
        for i, (x, y, z) in enumerate(((3, 4, 5), (4, 6, 7), (5, 7, 8))):
            # The field depends on the difference of places: moving the dipole is the negative.
            slope = n0 * fields[:, x] + n1 * fields[:, y] + n2 * fields[:, z]
            out[:, :, i] -= slope / len(signs)
    return out


class PositionFitter:
    """Moves dipoles to lower the damped residual of measurements at fixed, corrected poses."""

    def __init__(
        self,
        measurements: Sequence[Measurements],
        weights: Sequence[Array],
        dipoles: DipoleSites,
        damping: float,
        prior: ComplexArray | None = None,
    ) -> None:
        self.blocks = [
            _rows(m.frames(block), w[block])
            for m, w in zip(measurements, weights, strict=True)
            for block in frame_blocks(len(m.time), len(m.sensors), BLOCK_ROWS // 4)
        ]
        self.dipoles, self.damping = dipoles, damping
        parts = self.blocks[0][4].shape[1]
        self.prior = np.zeros((len(dipoles), parts)) if prior is None else as_real(prior)
        self.ridge = self._ridge()

    def _ridge(self) -> Array:
        """Return Tikhonov's term (N,), fixed at the start so that the cost is the same."""
        gram, _, _ = self._linear(self.dipoles)
        diagonal = np.diag(gram)
        scaled = gram / np.sqrt(np.outer(diagonal, diagonal))
        return np.asarray(self.damping**2 * np.linalg.eigvalsh(scaled)[-1] * diagonal)

    def _linear(self, dipoles: DipoleSites) -> tuple[Array, Array, float]:
        size, parts = len(dipoles), self.blocks[0][4].shape[1]
        gram, right, power = np.zeros((size, size)), np.zeros((size, parts)), 0.0
        for points, axes, lengths, root, flux in self.blocks:
            basis = flux_basis(points, axes, lengths, dipoles.positions, dipoles.directions)
            basis *= root[:, None]
            gram += basis.T @ basis
            right += basis.T @ flux
            power += float((flux**2).sum())
        return gram, right, power

    def solve(self, dipoles: DipoleSites) -> tuple[Array, float]:
        """Return the damped moments (N, 2K) of dipoles, and their damped sum of squares."""
        gram, right, power = self._linear(dipoles)
        normal = gram + np.diag(self.ridge)
        moments = np.linalg.solve(normal, right + self.ridge[:, None] * self.prior)
        fixed = float((self.ridge[:, None] * self.prior**2).sum())
        explained = (moments * (right + self.ridge[:, None] * self.prior)).sum()
        return np.asarray(moments), max(power + fixed - float(explained), 0.0)

    def _normal(self, dipoles: DipoleSites, moments: Array) -> tuple[Array, Array]:
        """Return Kaufman's normal matrix (3N, 3N) and gradient (3N,) of the positions."""
        size = len(dipoles)
        inner = np.zeros((3 * size, 3 * size))
        cross = np.zeros((size, 3 * size))
        gram = np.zeros((size, size))
        gradient = np.zeros((size, 3))
        for points, axes, lengths, root, flux in self.blocks:
            basis = flux_basis(points, axes, lengths, dipoles.positions, dipoles.directions)
            basis *= root[:, None]
            slopes = position_slopes(points, axes, lengths, dipoles) * root[:, None, None]
            residual = flux - basis @ moments
            along = np.einsum('pr,nr->pn', residual, moments, optimize=True)
            gradient += np.einsum('pnc,pn->nc', slopes, along, optimize=True)
            flat = slopes.reshape(len(points), -1)
            inner += flat.T @ flat
            cross += basis.T @ flat
            gram += basis.T @ basis
        inner -= cross.T @ np.linalg.solve(gram + np.diag(self.ridge), cross)
        pairs = np.repeat(np.repeat(moments @ moments.T, 3, axis=0), 3, axis=1)
        return inner * pairs, gradient.ravel()

    def fit(self, most_steps: int = MOST_STEPS) -> DipoleSites:
        """Take Levenberg-Marquardt steps until the cost hardly falls any more."""
        dipoles, strength = self.dipoles, 1e-2
        moments, cost = self.solve(dipoles)
        for _ in range(most_steps):
            normal, gradient = self._normal(dipoles, moments)
            before = cost
            for _ in range(MOST_TRIALS):
                trial = self._moved(dipoles, normal, gradient, strength)
                trial_moments, trial_cost = self.solve(trial)
                if trial_cost < cost:
                    dipoles, moments, cost = trial, trial_moments, trial_cost
                    strength = max(strength / 5.0, 1e-9)
                    break
                strength *= 5.0
            if before - cost < CONVERGED * before:
                break
        return dipoles

    def _moved(
        self, dipoles: DipoleSites, normal: Array, gradient: Array, strength: float
    ) -> DipoleSites:
        diagonal = np.diag(normal)
        floor = 1e-9 * float(diagonal.max())
        step = np.linalg.solve(
            normal + np.diag(strength * np.maximum(diagonal, floor) + floor), gradient
        ).reshape(-1, 3)
        size = np.linalg.norm(step, axis=1, keepdims=True)
        step *= np.minimum(1.0, LONGEST_MOVE_M / np.maximum(size, 1e-12))
        return DipoleSites(dipoles.positions + step, dipoles.directions)


def _rows(measurements: Measurements, weights: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Return points, axes, lengths, root weights and weighted real fluxes (P, 2K)."""
    (points, axes, lengths, flux), root = weighted_readings([measurements], [weights])
    return points, axes, lengths, root, as_real(flux) * root[:, None]
