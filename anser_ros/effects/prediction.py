"""Predicts what the sensors of a body read when a list of effects holds: the forward chain."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.effect import Term
from anser_ros.effects.view import View
from anser_ros.field.dipoles import Dipoles
from anser_ros.field.measurements import Measurements
from anser_ros.physics.dipole import flux_jacobian
from anser_ros.physics.pose_track import PoseTrack

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Fields:
    """Holds the fields that a prediction starts from."""

    model: Dipoles  # Good where tool sensors were calibrated
    illumination: Dipoles  # Good beside and below the board: what metal and reference sensors see
    omega: Array  # (K,), rad/s


def tool_view(body: Measurements, terms: Sequence[Term], fields: Fields) -> View:
    """Predict a tool's fluxes; the caller leaves out frames without a pose."""
    position, rotation, velocity = _poses(body, terms)
    sensors = body.sensors
    for term in terms:
        sensors = term.effect.table(term, sensors)
    centres, axes = sensors.placed(position, rotation)
    dipoles = _with_sources(fields.model, terms, fields)
    light = changed_illumination(terms, fields.illumination)
    lengths = np.tile(sensors.length, body.time.size)
    flux, d_position, d_axis = flux_jacobian(
        centres.reshape(-1, 3), axes.reshape(-1, 3), lengths,
        dipoles.positions, dipoles.directions, dipoles.moments,
    )  # fmt: skip
    shape = (body.time.size, len(sensors))
    d_position, d_axis = d_position.reshape(*shape, 3, -1), d_axis.reshape(*shape, 3, -1)
    lever = (centres - position[:, None, :])[..., :, None]
    d_turn = np.cross(lever, d_position, axis=2) + np.cross(axes[..., :, None], d_axis, axis=2)
    view = View(
        time=body.time, sensors=sensors, position=position, rotation=rotation, velocity=velocity,
        centres=centres, axes=axes, linear=flux.reshape(*shape, -1),
        flux=flux.reshape(*shape, -1), d_position=d_position, d_axis=d_axis, d_turn=d_turn,
        dipoles=dipoles, illumination=light, omega=fields.omega, is_reference=False,
    )  # fmt: skip
    return _measured(_with_motion(view, terms), terms)


def reference_view(
    reference: Measurements, baseline: ComplexArray, terms: Sequence[Term], fields: Fields
) -> View:
    """Predict the reference sensors: their clean readings (S, K) and what the effects change."""
    sensors, frames = reference.sensors, reference.time.size
    base = fields.illumination
    added = _with_sources(Dipoles.none(base.moments.shape[1]), terms, fields, base)
    flux, d_position, d_axis = flux_jacobian(
        sensors.position, sensors.axis, sensors.length,
        base.positions, base.directions, base.moments,
    )  # fmt: skip
    change = np.zeros_like(flux)
    if added.positions.shape[0]:
        change = added.flux(sensors.position, sensors.axis, sensors.length)
    shape = (frames, *change.shape)
    eye = np.broadcast_to(np.eye(3), (frames, 3, 3))
    linear = np.broadcast_to(baseline + change, shape)
    view = View(
        time=reference.time, sensors=sensors, position=np.zeros((frames, 3)), rotation=eye,
        velocity=np.zeros((frames, 6)),
        centres=np.broadcast_to(sensors.position, (frames, len(sensors), 3)),
        axes=np.broadcast_to(sensors.axis, (frames, len(sensors), 3)),
        linear=linear, flux=linear,
        d_position=np.broadcast_to(d_position, (frames, *d_position.shape)),
        d_axis=np.broadcast_to(d_axis, (frames, *d_axis.shape)),
        d_turn=np.broadcast_to(np.zeros_like(d_axis), (frames, *d_axis.shape)),
        dipoles=base.joined(added), illumination=changed_illumination(terms, base),
        omega=fields.omega,
        is_reference=True,
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


def _with_sources(
    start: Dipoles, terms: Sequence[Term], fields: Fields, base: Dipoles | None = None
) -> Dipoles:
    out, light = start, changed_illumination(terms, fields.illumination)
    for term in terms:
        added = term.effect.sources(term, base or fields.model, light, fields.omega)
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
    linear, channels = view.linear, view.sensors.channel
    # The derivatives go the way that the flux goes.
    slopes = [view.d_position, view.d_axis, view.d_turn]
    for term in terms:
        matrix = term.effect.emitter_matrix(term, view.time, view.omega)
        if matrix is not None:
            mixed = np.broadcast_to(matrix, (view.time.size, *matrix.shape[1:]))
            linear = np.einsum('fab,fsb->fsa', mixed, linear)
            slopes = [np.einsum('fab,fsib->fsia', mixed, slope) for slope in slopes]
    for term in terms:
        mixing = term.effect.channel_matrix(term, channels)
        if mixing is not None:
            linear = np.einsum('st,ftk->fsk', mixing, linear)
            slopes = [np.einsum('st,ftik->fsik', mixing, slope) for slope in slopes]
    flux = linear
    for term in terms:
        added = term.effect.offset(term, channels, view.omega.size)
        flux = flux if added is None else flux + added
    for term in terms:
        flux = term.effect.compress(term, channels, flux)
    d_position, d_axis, d_turn = slopes
    return replace(
        view, linear=linear, flux=flux, d_position=d_position, d_axis=d_axis, d_turn=d_turn
    )
