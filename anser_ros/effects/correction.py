"""Predicts what sensors read when effects hold, and undoes a model's effects on what is measured.

The forward chain is ``flux = compress(R C T (field) + offset)`` with C mixing channels, T mixing
emitters and R factors of both; it is undone from the outside in, live in the tracker and node, and
offline. Effects on the field are in the model's dipoles already, and effects that cannot be
corrected are skipped.
"""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from anser_ros.arrays import AnyArray, Array, ComplexArray, Integers
from anser_ros.effects.base import View
from anser_ros.effects.effect import Effect, Remedy, Term, effect_named
from anser_ros.errors import ModelFileError
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import SESSION, Dipoles, EffectRecord
from anser_ros.physics.dipole import flux_jacobian
from anser_ros.physics.pose_track import PoseTrack
from anser_ros.physics.sensor import SensorTable

Kept = TypeVar('Kept')
KEPT = 12
"""Views, and sets of sensors with their slopes, that are kept, some megabytes each."""


@dataclass(frozen=True)
class Fields:
    """Holds the fields that a prediction starts from."""

    model: Dipoles  # Good where tool sensors were calibrated
    illumination: Dipoles  # Good beside and below the board: what metal and reference sensors see
    omega: Array  # (K,), rad/s
    # what was found last, by what was asked for; other fields begin with nothing
    kept: dict[Hashable, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def slopes(
        self, points: Array, axes: Array, lengths: Array, far: bool = False
    ) -> tuple[ComplexArray, ...]:
        """Return fluxes (P, K) of the model, or of the illumination where sensors are ``far``.

        With their derivatives (P, 3, K) by place and axis. A fit asks for the same sensors again
        and again: the last answers are kept, and must not be changed.
        """
        dipoles = self.illumination if far else self.model
        sites = dipoles.positions, dipoles.directions, dipoles.moments
        key = far, b''.join(array.tobytes() for array in (points, axes, lengths))
        return self.once(key, lambda: flux_jacobian(points, axes, lengths, *sites))

    def once(self, key: Hashable, make: Callable[[], Kept]) -> Kept:
        """Return what was made for a key, or make it; what is kept must not be changed."""
        found: Kept | None = self.kept.get(key)
        if found is None:
            found = self.kept[key] = make()
            for oldest in list(self.kept)[:-KEPT]:
                self.kept.pop(oldest, None)
        return found


def tool_view(body: Measurements, terms: Sequence[Term], fields: Fields) -> View:
    """Predict a tool's fluxes; the caller leaves out frames without a pose."""
    still = tuple(term for term in terms if not term.effect.moving)
    key = id(body), *map(id, still)  # kept with its objects, whose addresses no others get then
    *_, view = fields.once(key, lambda: (body, still, _still_view(body, still, fields)))
    return _measured(_with_motion(view, terms), terms)


def _still_view(body: Measurements, terms: Sequence[Term], fields: Fields) -> View:
    """What a tool would read without emitters' and channels' errors, and where nothing moves."""
    position, rotation, velocity = _poses(body, terms)
    sensors = body.sensors
    for term in terms:
        sensors = term.effect.table(term, sensors)
    centres, axes = sensors.placed(position, rotation)
    added = _sources(terms, fields, fields.model)
    light = changed_illumination(terms, fields.illumination)
    flat = centres.reshape(-1, 3), axes.reshape(-1, 3), np.tile(sensors.length, body.time.size)
    flux, d_position, d_axis = fields.slopes(*flat)
    if len(added.positions):
        more = flux_jacobian(*flat, added.positions, added.directions, added.moments)
        flux, d_position, d_axis = flux + more[0], d_position + more[1], d_axis + more[2]
    shape = (body.time.size, len(sensors))
    d_position, d_axis = d_position.reshape(*shape, 3, -1), d_axis.reshape(*shape, 3, -1)
    lever = (centres - position[:, None, :])[..., :, None]
    d_turn = np.cross(lever, d_position, axis=2) + np.cross(axes[..., :, None], d_axis, axis=2)
    return View(
        time=body.time, sensors=sensors, position=position, rotation=rotation, velocity=velocity,
        centres=centres, axes=axes, linear=flux.reshape(*shape, -1),
        flux=flux.reshape(*shape, -1), d_position=d_position, d_axis=d_axis, d_turn=d_turn,
        dipoles=fields.model.joined(added), illumination=light, omega=fields.omega,
        is_reference=False,
    )  # fmt: skip


def reference_view(
    reference: Measurements, baseline: ComplexArray, terms: Sequence[Term], fields: Fields
) -> View:
    """Predict the reference sensors: their clean readings (S, K) and what the effects change."""
    sensors, base = reference.sensors, fields.illumination
    added = _sources(terms, fields, base)
    where = sensors.position, sensors.axis, sensors.length
    _, d_position, d_axis = fields.slopes(*where, far=True)

    def always(values: Any) -> Any:
        return np.broadcast_to(values, (reference.time.size, *values.shape))

    linear = always(baseline + added.flux(*where))
    view = View(
        time=reference.time, sensors=sensors, position=always(np.zeros(3)),
        rotation=always(np.eye(3)), velocity=always(np.zeros(6)),
        centres=always(sensors.position), axes=always(sensors.axis), linear=linear, flux=linear,
        d_position=always(d_position), d_axis=always(d_axis),
        d_turn=always(np.zeros_like(d_axis)), dipoles=base.joined(added),
        illumination=changed_illumination(terms, base), omega=fields.omega, is_reference=True,
    )  # fmt: skip
    return _measured(_with_motion(view, terms), terms)


def true_track(track: PoseTrack, terms: Sequence[Term]) -> PoseTrack:
    """Return the optical track on the fluxes' clock and in fg."""
    for term in terms:
        track = term.effect.optical(term, track)
    return track


def _poses(body: Measurements, terms: Sequence[Term]) -> tuple[Array, Array, Array]:
    """Position (F, 3), rotation (F, 3, 3) and velocity (F, 6) by the corrected track."""
    if body.track is None:
        return body.position, body.rotation, np.zeros((body.time.size, 6))
    track = true_track(body.track, terms)
    inside = np.clip(body.time, track.time[0], track.time[-1])
    position, rotation, _ = track.at(inside, np.inf)
    return position, rotation, track.velocity(inside)


def changed_illumination(terms: Sequence[Term], illumination: Dipoles) -> Dipoles:
    """Return the emitters' own dipoles, as the effects change what metal receives of them."""
    for term in terms:
        illumination = term.effect.light(term, illumination)
    return illumination


def _sources(terms: Sequence[Term], fields: Fields, base: Dipoles) -> Dipoles:
    """The dipoles that the effects add where the emitters' own are ``base``."""
    out = Dipoles.none(base.moments.shape[1])
    light = changed_illumination(terms, fields.illumination)
    for term in terms:
        added = term.effect.sources(term, base, light, fields.omega)
        if added is not None:
            out = out.joined(added)
    return out


def _with_motion(view: View, terms: Sequence[Term]) -> View:
    """Add what moves in fg (its gradient is left out: it is a small part of the field's)."""
    for term in terms:
        if term.effect.moving:
            linear = view.linear + term.effect.moving_flux(term, view)
            view = replace(view, linear=linear, flux=linear)
    return view


def _measured(view: View, terms: Sequence[Term]) -> View:
    """Emitters, channels, offsets and compression."""
    channels = view.sensors.channel
    # The derivatives go the way that the flux goes.
    values = [view.linear[:, :, None], view.d_position, view.d_axis, view.d_turn]
    for term in terms:
        matrix = term.effect.emitter_matrix(term, view.time, view.omega)
        if matrix is not None:
            mixed = np.broadcast_to(matrix, (view.time.size, *matrix.shape[1:]))
            values = [np.einsum('fab,fsib->fsia', mixed, value) for value in values]
    for term in terms:
        mixing = term.effect.channel_matrix(term, channels)
        if mixing is not None:
            values = [np.einsum('st,ftik->fsik', mixing, value) for value in values]
    for term in terms:
        factor = term.effect.response(term, channels, view.omega)
        if factor is not None:
            values = [value * factor[:, None, :] for value in values]
    flux = linear = values[0][:, :, 0]
    for term in terms:
        added = term.effect.offset(term, channels, view.omega.size)
        flux = flux if added is None else flux + added
    for term in terms:
        flux = term.effect.compress(term, channels, flux)
    _, d_position, d_axis, d_turn = values
    return replace(
        view, linear=linear, flux=flux, d_position=d_position, d_axis=d_axis, d_turn=d_turn
    )


def coils_read(plugs: Sequence[Term], channels: Integers) -> Integers:
    """Return the numbers of the coils that are read on channels (S,), of which some are exchanged.

    What was known of a coil before its plug was found elsewhere, its gain, has gone with it.
    """
    for term in plugs:
        mixing = term.effect.channel_matrix(term, channels) if not term.theta.size else None
        if mixing is not None:
            channels = channels[np.abs(mixing).argmax(axis=1)]
    return channels


DECOMPRESSION_STEPS = 12
"""Most steps of the fixed point that undoes a compression. Each leaves of the error about the
share that the compression takes of a change of the signal."""

LIVE = (Remedy.FLUX, Remedy.SENSORS)
"""Remedies of effects that a tracker undoes; those of the field are in the model's dipoles."""


def drifts(record: EffectRecord) -> bool:
    """Return whether no session repeats a course; raises `ModelFileError` on an unknown effect."""
    return effect_named(record.name).drifts


def needs_correction(record: EffectRecord) -> bool:
    """Return whether the dipoles lack an effect; raises `ModelFileError` on an unknown one."""
    return effect_named(record.name).remedy in LIVE


def _term(effect: Effect[Any], record: EffectRecord) -> Term:
    """The term of a record from a file, where anything may stand as a parameter."""
    try:
        with np.errstate(invalid='raise', divide='raise'):
            term: Term = effect.term(record)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise ModelFileError(
            f'effect {record.name}: its parameters are malformed ({type(error).__name__}: {error})'
        ) from error
    if not np.isfinite(np.asarray(term.theta, dtype=np.float64)).all():
        raise ModelFileError(f'effect {record.name}: its parameters are not finite')
    return term


@dataclass(frozen=True)
class Correction:
    """Makes the corrections that a model's effect records ask for."""

    terms: tuple[Term, ...]
    surveyed: SensorTable  # Sensors as the setup has them
    omega: Array  # (K,)

    @staticmethod
    def of(
        records: Sequence[EffectRecord], sensors: SensorTable, frequencies: Sequence[float]
    ) -> 'Correction':
        """Make the corrections of a model's records, but for those of one session alone.

        Raises `ModelFileError` on an unknown one.
        """
        held = [record for record in records if SESSION not in record.parameters]
        named = [(effect_named(record.name), record) for record in held]
        undone = [pair for pair in named if pair[0].remedy in (*LIVE, Remedy.OPTICAL)]
        omega = 2 * np.pi * np.asarray(frequencies, dtype=np.float64)
        return Correction(tuple(_term(*pair) for pair in undone), sensors, omega)

    def _with(self, remedy: Remedy) -> list[Term]:
        return [term for term in self.terms if term.effect.remedy is remedy]

    @property
    def changes_flux(self) -> bool:
        """Return whether any term makes `flux` change the measured flux."""
        return bool(self._with(Remedy.FLUX))

    @property
    def drifting(self) -> tuple[str, ...]:
        """Return the effects that only references, or a recorded course, can correct."""
        return tuple(term.label for term in self.terms if term.effect.drifts)

    @property
    def corrected(self) -> tuple[str, ...]:
        """Return name and site of every effect that is undone, except those that drift."""
        return tuple(term.label for term in self.terms if not term.effect.drifts)

    def sensors(self, table: SensorTable | None = None) -> SensorTable:
        """Return the sensors (by default those given at the start) as they truly are."""
        out = self.surveyed if table is None else table
        for term in self._with(Remedy.SENSORS):
            out = term.effect.table(term, out)
        return out

    def gain_changes(self) -> Array | None:
        """Return changes of gains since the model was made that sensors may share, shape (G, S).

        Relative, one standard deviation each; None if no effect contains any.
        """
        every = (term.effect.gain_changes(term, self.surveyed) for term in self.terms)
        known = [changes for changes in every if changes is not None]
        return np.concatenate(known) if known else None

    def optical(self, track: PoseTrack) -> PoseTrack:
        """Return an optical track on the fluxes' clock and in fg."""
        return true_track(track, self._with(Remedy.OPTICAL))

    def flux(
        self, time: float, channels: AnyArray, flux: ComplexArray, *,
        recorded: bool = False,
    ) -> ComplexArray:  # fmt: skip
        """Return a frame's fluxes (S, K), T, as ideal sensors and emitters would have given them.

        ``time``: s since the start of the diagnosed session, for effects that change with time;
        ``flux`` (S, K), T: a row with NaN stays NaN; ``recorded``: whether this is the diagnosed
        session, so that the course of a drift holds. Otherwise a drift is left as it is: live, the
        refit follows the strengths of the emitters with the references.
        """
        terms = [t for t in self._with(Remedy.FLUX) if recorded or not t.effect.drifts]
        if not terms:
            return flux
        out = np.array(flux, dtype=complex)
        good = np.isfinite(out).all(axis=1)
        if not good.any():
            return out
        number = np.asarray(channels, dtype=np.int64)[good]
        values: ComplexArray = self._decompressed(terms, number, out[good])
        for term in terms:
            added = term.effect.offset(term, number, self.omega.size)
            values = values if added is None else values - added
        coils = number
        for term in reversed(terms):
            factor = term.effect.response(term, coils, self.omega)
            values = values if factor is None else values / factor
            coils = coils_read([term], coils)
        for term in reversed(terms):
            mixing = term.effect.channel_matrix(term, number)
            if mixing is not None:
                values = np.asarray(np.linalg.solve(mixing, values), dtype=complex)
        for term in reversed(terms):
            matrix = term.effect.emitter_matrix(term, np.array([time]), self.omega)
            if matrix is not None:
                values = np.asarray(np.linalg.solve(matrix[0], values.T).T, dtype=complex)
        out[good] = values
        return out

    @staticmethod
    def _decompressed(
        terms: list[Term], channels: Integers, measured: ComplexArray
    ) -> ComplexArray:
        """Fixed point of ``x = measured - (compress(x) - x)``; at most half of x is corrected."""
        x = measured
        for _ in range(DECOMPRESSION_STEPS):
            behind = whole = x[None]
            for term in terms:
                behind = term.effect.compress(term, channels, behind)
            if behind is whole:  # nothing compresses
                return measured
            loss = behind[0] - x
            most = 0.5 * np.abs(measured)
            share = most / np.maximum(np.abs(loss), np.maximum(most, 1e-300))
            step = measured - loss * share
            if np.allclose(step, x, rtol=1e-9, atol=0.0):
                return np.asarray(step)
            x = step
        return np.asarray(x)
