"""Makes a field model ready for tracking: kernel layout, error model, cold-start grid.

Noise and model error are whitened in one kernel, for models that change every frame. An emitter of
which no sensor has a flux (not finite, or exactly zero) has no part in the solve: it has no
weight, and the covariance grows accordingly.
"""

import hashlib
import math
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from anser_ros.arrays import Array, Booleans, ComplexArray, Integers
from anser_ros.field.model import FieldModel, SymmetryAxis, symmetry_axis
from anser_ros.kernel_cache import inlined, kernel
from anser_ros.physics.dipole import fill_flux_basis, flux_basis
from anser_ros.physics.sensor import along_each_axis
from anser_ros.physics.volume import TrackedVolume
from anser_ros.tracking.estimate import TrackerSettings
from anser_ros.tracking.seed import SeedGrid, build_grid
from anser_ros.tracking.solve import RealField

SAME_PLACE_M = 1e-6
"""Dipoles nearer to each other than this, m, are components of one: rounding moves them apart by
less, and no layout has neighbours within a millimetre."""


NOT_FINITE = 'the model covariance must be finite'


@kernel
def fill_model_errors(  # type: ignore[no-untyped-def]
    points, axes, lengths, dipoles, spacing, modes, sigma, flux, strengths, errors, whitening, near
):  # fmt: skip
    """Write the model's error at S coils, and the factors that make their residuals white.

    The coils have centres ``points`` (m), unit ``axes`` (S, 3), frame fg, and ``lengths``, m. The
    N ``dipoles``, rows of `RealField.columns`, have uncertain moments: ``modes`` (N, R 2K) are
    errors of one standard deviation each, A m^2, ``spacing`` is `source_spacing`, m. ``sigma``
    (2K,) is each flux component's standard deviation, T. The coils read about ``flux`` (S, 2K), T,
    and ``strengths`` (2K, Q), real and imaginary part by turns, are relative errors of the
    emitters', of one standard deviation each.

    Written are flux errors E (S, R, 2K) of one standard deviation each, T; the ``whitening``
    (S, 2K, 2K), 1/T, the inverse Cholesky factor of ``diag(sigma)^2 + E^T E``, and of what the
    emitters' strengths do besides; and ``near``
    (S, 2): the distance from the nearest of the dipoles, m, and spacing over distance of the
    dipole for which that is largest: above 1 a coil is where the dipoles are no description of the
    field. Returns False where a covariance is not finite.
    """
    width, count = sigma.shape[0], errors.shape[1]
    factor, scaled = np.empty((width, width)), np.empty((width, count + strengths.shape[1]))
    basis = np.empty((points.shape[0], dipoles.shape[1]))
    fill_flux_basis(points, axes, lengths, dipoles, basis)
    made = np.dot(basis, modes)
    for s in range(points.shape[0]):
        out, square, among = whitening[s], math.inf, 0.0
        for j in range(dipoles.shape[1]):
            away = 0.0
            for i in range(3):
                away += (points[s, i] - dipoles[i, j]) ** 2
            square, among = min(square, away), max(among, spacing[j] ** 2 / away)
        near[s, 0], near[s, 1] = math.sqrt(square), math.sqrt(among)
        for i in range(width):
            for r in range(count):
                errors[s, r, i] = made[s, r * width + i]
                scaled[i, r] = errors[s, r, i] / sigma[i]
        for i in range(0, width, 2):
            for r in range(strengths.shape[1]):
                a, b = strengths[i, r], strengths[i + 1, r]
                scaled[i, count + r] = (flux[s, i] * a - flux[s, i + 1] * b) / sigma[i]
                scaled[i + 1, count + r] = (flux[s, i + 1] * a + flux[s, i] * b) / sigma[i + 1]
        gram = np.dot(scaled, scaled.T)
        for i in range(width):
            gram[i, i] += 1.0
            for j in range(i + 1):
                total = gram[i, j]
                for k in range(j):
                    total -= factor[i, k] * factor[j, k]
                if i > j:
                    factor[i, j] = total / factor[j, j]
                elif total > 0.0 and math.isfinite(total):
                    factor[i, i] = math.sqrt(total)
                else:
                    return False
        for j in range(width):
            for i in range(j):
                out[i, j] = 0.0
            out[j, j] = 1.0 / factor[j, j]
            for i in range(j + 1, width):
                total = 0.0
                for k in range(j, i):
                    total += factor[i, k] * out[k, j]
                out[i, j] = -total / factor[i, i]
        for i in range(width):
            for j in range(i + 1):
                out[i, j] /= sigma[j]
    return True


def source_spacing(positions: Array, floor_m: float) -> Array:
    """Return how far dipoles where tools may be are from their neighbours, m, shape (N,).

    Dipoles that stand for metal do not determine the field between themselves and others of their
    kind. Those lower than ``floor_m`` are below all tools and get 0.
    """
    square = np.zeros((len(positions), len(positions)))
    for column in positions.T:
        square += (column[:, None] - column) ** 2
    square[square <= SAME_PLACE_M**2] = np.inf
    nearest = np.sqrt(square.min(axis=1, initial=np.inf))
    return np.where((nearest < np.inf) & (positions[:, 2] >= floor_m), nearest, 0.0)


BOX_MARGIN_M = 0.1
"""How far beyond the volume the solver may go, so that a tool there counts as there."""
GRID_TOLERANCE = 0.05
"""Relative change of the field up to which a grid may go on serving as a source of starts."""


@lru_cache(maxsize=4)
def _landmarks(volume: TrackedVolume) -> tuple[Array, Array]:
    """Return 27 places in a volume along each axis: points (P, 3), m, and unit axes (P, 3)."""
    sides = [
        np.linspace(a + 0.15 * (b - a), b - 0.15 * (b - a), 3)
        for a, b in zip(volume.low, volume.high, strict=True)
    ]
    points = np.stack([side.ravel() for side in np.meshgrid(*sides, indexing='ij')], axis=1)
    return along_each_axis(points)


class Starts:
    """Makes the cold start's grid in a field when it is needed.

    That of the model ``before`` serves on while the field is nearly the same.
    """

    def __init__(
        self, volume: TrackedVolume, spacing_m: float, before: 'Starts | None' = None
    ) -> None:
        self._volume, self._spacing_m = volume, spacing_m
        self._before = before
        self._made: tuple[SeedGrid, Array] | None = None
        # Positions and directions of dipoles, and their coupling with the landmarks.
        self._coupled: tuple[Array, Array, Array] | None = None

    def following(self) -> 'Starts':
        """Make the context for the next model, with the last grid that was made."""
        before = self._before if self._made is None else self
        starts = Starts(self._volume, self._spacing_m, before)
        starts._coupled = self._coupled
        return starts

    def anew(self) -> 'Starts':
        """Return an empty one, for a field that has nothing in common with this one."""
        return Starts(self._volume, self._spacing_m)

    def landmarks(self, field: RealField) -> tuple[Array, Array]:
        """Return the coupling (P, N) of the dipoles with a few points of the volume; field there,
        (P, 2K).
        """
        places, known = (field.positions, field.directions), self._coupled
        if known is None or known[0] is not places[0] or known[1] is not places[1]:
            basis = flux_basis(*_landmarks(self._volume), None, *places)
            self._coupled = known = *places, basis
        return known[2], known[2] @ field.moments

    def grid(self, field: RealField, sigma: Array) -> SeedGrid:
        """Return the grid of start poses in the field."""
        if self._made is None:
            flux = self.landmarks(field)[1]
            made = None if self._before is None else self._before._made
            if made is not None and made[1].shape == flux.shape:
                change = np.linalg.norm(flux - made[1], axis=1)
                if (change <= GRID_TOLERANCE * np.linalg.norm(made[1], axis=1)).all():
                    self._made = made
            if self._made is None:
                grid = build_grid(field, sigma, self._volume, self._spacing_m)
                self._made = (grid, flux)
            self._before = None
        return self._made[0]


PLACES = 9
"""Places along each side of the volume at which the field's error is looked up; its logarithm is
interpolated. Over 0.3 m they are 4 cm apart: a scan's gaps are as wide."""
MOST_GROWTH = 4.0
"""Largest factor by which a variance grows by place. Where a scan left more open, a residual tells
no pose from a wrong one: without a bound, 2 of 632 frames of another source (`docs/measured.md`)
were tracked, 21 cm off; with 9, far halves of a volume have an error over sigma of 1.6, with 4 of
1.5. Smaller withholds good poses of models of few places."""
NO_ERROR = -200.0
"""Logarithm of a variance, T^2, that adds nothing to any noise."""


class PlacedErrors(NamedTuple):
    """Holds by how much a flux component may be off at places, beyond what is typical."""

    log: Array  # (PLACES^3,), logarithm of the variance, T^2, at places of a grid, z fastest
    low: Array  # (3,), where the grid begins, m
    step: Array  # (3,), m

    @classmethod
    def of(cls, model: FieldModel, box: TrackedVolume) -> 'PlacedErrors':
        """Work out what a model states of its errors in a volume."""
        low, step = np.array(box.low), np.subtract(box.high, box.low) / (PLACES - 1)
        places = low + step * np.indices((PLACES,) * 3).reshape(3, -1).T
        at, axes = (some.reshape(-1, 3, 3) for some in along_each_axis(places))
        variance = (model.error_t(at, axes, np.zeros(3)) ** 2).mean(axis=1)
        return cls(np.log(np.maximum(variance, math.exp(NO_ERROR))), low, step)


@inlined
def growth_at(place, model):  # type: ignore[no-untyped-def]
    """Return by which factor a flux component's variance at a place (3,), m, is larger than it
    typically is, at most `MOST_GROWTH`. ``model`` is `SolveContext.arrays`.
    """
    log, low, step = model.errors
    total = 0.0
    for corner in range(8):
        index, weight = 0, 1.0
        for i in range(3):
            at = min(max((place[i] - low[i]) / step[i], 0.0), PLACES - 1.001)
            side, cell = (corner >> i) & 1, int(at)
            index = PLACES * index + cell + side
            weight *= at - cell if side else 1.0 - at + cell
        total += weight * log[index]
    return min(1.0 + math.exp(total) / model.sigma[0] ** 2, MOST_GROWTH)


@dataclass(frozen=True)
class ErrorModes:
    """Lays a model's uncertainty out for one product with sensors' coupling to its dipoles."""

    # (R, N, K), the model's own array that the rest was made from: a model that has the same array
    # has the same modes, and all that sensors derived from them stays good
    given: ComplexArray
    rows: Integers  # (M,), the dipoles whose moments are uncertain
    moments: Array  # (M, R' 2K), of the modes that are not zero, A m^2
    places: Array  # (M, 3), m
    spacing: Array  # (M,), see `source_spacing`, m

    @classmethod
    def of(
        cls,
        given: ComplexArray | None,
        positions: Array,
        floor_m: float,
        before: 'ErrorModes | None' = None,
    ) -> 'ErrorModes | None':
        """Lay out modes (R, N, K), A m^2; None where there is no uncertainty.

        ``positions`` (N, 3) are the dipoles', m; those over the height ``floor_m`` are where tools
        may be. Spacings are those of ``before`` where its dipoles are at the same places.
        """
        if given is None:
            return None
        parts = np.ascontiguousarray(given, dtype=np.complex128).view(np.float64)
        there = np.einsum('rnk,rnk->rn', parts, parts) != 0.0
        if not there.any():
            return None
        rows, some = np.flatnonzero(there.any(axis=0)), there.any(axis=1)
        kept = parts if some.all() else parts[some]
        moments = np.ascontiguousarray(kept.swapaxes(0, 1)[rows])
        places = positions[rows]
        if before is not None and np.array_equal(places, before.places):
            spacing = before.spacing
        else:
            spacing = source_spacing(places, floor_m)
        return cls(given, rows, moments.reshape(rows.size, -1), places, spacing)

    def of_components(self, kept: Booleans) -> 'ErrorModes':
        """Return the modes' part in some of the 2K flux components."""
        parts = self.moments.reshape(len(self.rows), -1, kept.size)[:, :, kept]
        return replace(self, moments=np.ascontiguousarray(parts.reshape(len(self.rows), -1)))


class ModelArrays(NamedTuple):
    """Holds a model and its uncertainty, as the compiled steps need them; see `SolveContext`."""

    columns: Array
    moments: Array
    sigma: Array
    uncertain: Array  # (6, M), the dipoles whose moments are uncertain, as in `columns`
    spacing: Array
    modes: Array  # (M, R 2K); (0, 0) without uncertainty
    strengths: Array
    low: Array
    high: Array
    share: float
    errors: PlacedErrors


AS_THEY_ARE: Array = np.empty((0, 0))
"""Errors of emitters' strengths where these are the model's."""
LEAST_READING = 0.01
"""Least share of a field that tells places apart, of the strongest component: errors of gains and
of the model are some thousandths, and a pose that followed from less would be theirs."""


@dataclass(frozen=True)
class SolveContext:
    """Holds what every solve of a frame shares."""

    field: RealField
    sigma: Array  # (2K,), noise and the model's own unexplained part, T
    modes: ErrorModes | None
    starts: Starts
    # low, high: (3,), box of the solver, m
    low: Array
    high: Array
    model_id: str
    # Part of the expected residual's power that is the model's own error, the modes aside
    model_share: float
    # (2K, Q), relative errors of the emitters' strengths, of one standard deviation each, real and
    # imaginary part by turns; (0, 0) where these are the model's
    strengths: Array
    errors: PlacedErrors
    errors_of: tuple[object, ...]  # what these were made from, besides the field

    @property
    def is_certain(self) -> bool:
        """Return whether flux components err by ``sigma`` alone, each by itself."""
        return self.modes is None and not self.strengths.size

    def with_strengths(self, strengths: Array) -> 'SolveContext':
        """Return the same with other errors of the emitters' strengths."""
        other = copy(self)  # with what has been worked out of the field
        other.__dict__.pop('arrays', None)
        object.__setattr__(other, 'strengths', strengths)
        return other

    @property
    def grid(self) -> SeedGrid:
        """Return the grid of start poses for a cold start."""
        return self.starts.grid(self.field, self.sigma)

    @cached_property
    def middle(self) -> Array:
        """Return the middle of the field's dipoles, weighted by their strength, (3,), m."""
        weight = np.abs(self.field.moments).sum(axis=1)
        return np.asarray(weight @ self.field.positions / max(float(weight.sum()), 1e-300))

    @cached_property
    def readings(self) -> int:
        """Return how many independent components of the flux the field makes.

        A constant field has no quadrature, and one whose phase is everywhere alike none besides.
        """
        flux = self.starts.landmarks(self.field)[1]
        flux = flux[np.isfinite(flux).all(axis=1)]
        power = np.linalg.eigvalsh(flux.T @ flux)
        return int((power > LEAST_READING**2 * power[-1]).sum())

    @cached_property
    def symmetry(self) -> SymmetryAxis | None:
        """Return the axis about which the field is the same all around, where it has one."""
        moments = self.field.moments.view(np.complex128)
        return symmetry_axis(self.field.positions, self.field.directions, moments)

    @cached_property
    def relative_error(self) -> float:
        """Return the typical model error by ``modes`` over the field's strength."""
        if self.modes is None:
            return 0.0
        basis, flux = self.starts.landmarks(self.field)
        error = basis[:, self.modes.rows] @ self.modes.moments
        error = error.reshape(len(flux), -1, flux.shape[1])
        power = (error**2).sum(axis=1).mean(axis=1) / (flux**2).mean(axis=1)
        return float(np.sqrt(np.median(power)))

    @cached_property
    def arrays(self) -> ModelArrays:
        """Return what the compiled steps need."""
        modes, columns = self.modes, self.field.columns
        uncertain, spacing, moments = np.empty((6, 0)), np.empty(0), np.empty((0, 0))
        if modes is not None:
            uncertain, spacing = columns.take(modes.rows, axis=1), modes.spacing
            moments = modes.moments
        return ModelArrays(
            columns, self.field.moments, self.sigma, uncertain, spacing, moments, self.strengths,
            self.low, self.high, self.model_share, self.errors,
        )  # fmt: skip

    def make_ready(self) -> None:
        """Work out what a warm solve needs of the field and its uncertainty."""
        _ = self.readings, self.symmetry, self.arrays, self.middle


def model_digest(model: FieldModel) -> str:
    """Return eight hexadecimal digits that distinguish models."""
    digest = hashlib.blake2b(digest_size=4)
    for array in (model.positions, model.directions, model.moments):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def depends_on(settings: TrackerSettings) -> tuple[object, ...]:
    """Return the settings that `build_context` makes a difference by."""
    return settings.flux_noise_t, settings.box, settings.grid_spacing_m


def build_context(
    model: FieldModel,
    settings: TrackerSettings,
    previous: SolveContext | None = None,
    model_id: str | None = None,
) -> SolveContext:
    """Make a model ready; what depends on things that have not changed is kept.

    Raises `TrackingError` when the model's arrays can't be used.
    """
    field = RealField.of(model.positions, model.directions, model.moments)
    variance = settings.flux_noise_t**2 + float(model.flux_error_t) ** 2
    sigma = np.full(field.moments.shape[1], math.sqrt(variance))
    if previous is not None and np.array_equal(sigma, previous.sigma):
        sigma = previous.sigma
    modes = None if previous is None else previous.modes
    if modes is None or modes.given is not model.modes:
        floor_m = 0.5 * settings.box.low[2]
        modes = ErrorModes.of(model.modes, field.positions, floor_m, modes)
    name = model_digest(model) if model_id is None else model_id
    low, high = settings.box.grown(BOX_MARGIN_M)
    starts = Starts(settings.box, settings.grid_spacing_m)
    if previous is None:
        starts.grid(field, sigma)  # the first frame needs it
    else:
        starts = previous.starts.following()
    share = 1.0 - settings.flux_noise_t**2 / variance
    errors_of = model.gaps, model.error_share, settings.box
    if previous is not None and previous.errors_of == errors_of:
        errors = previous.errors
    else:
        errors = PlacedErrors.of(model, settings.box)
    return SolveContext(
        field, sigma, modes, starts, low, high, name, share, AS_THEY_ARE, errors, errors_of
    )


FEWEST_EMITTERS = 6
"""One more than a coil's pose has unknowns, so that a residual is left to judge it by."""


@dataclass(frozen=True)
class ReducedScene:
    """Holds a context without its dead emitters, and what it was made from."""

    whole: SolveContext
    living: Booleans
    context: SolveContext


def without_dead(
    context: SolveContext, living: Booleans, previous: ReducedScene | None = None
) -> ReducedScene:
    """Return the context of the living emitters; what has not changed since ``previous`` is
    kept.
    """
    same = previous is not None and bool((previous.living == living).all())
    if same and previous is not None and previous.whole is context:
        return previous
    kept = np.repeat(living, 2)
    field = RealField(
        context.field.positions,
        context.field.directions,
        np.ascontiguousarray(context.field.moments[:, kept]),
    )
    sigma, starts, modes = context.sigma[kept], context.starts.anew(), context.modes
    if same and previous is not None:
        starts = previous.context.starts.following()
    if same and previous is not None and previous.whole.modes is modes:
        modes = previous.context.modes
    elif modes is not None:
        modes = modes.of_components(kept)
    strengths = context.strengths[kept] if context.strengths.size else context.strengths
    reduced = replace(
        context, field=field, sigma=sigma, modes=modes, starts=starts, strengths=strengths
    )
    return ReducedScene(context, living, reduced)
