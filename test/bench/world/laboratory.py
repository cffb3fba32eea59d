"""A room with a board, a tool and perhaps metal, and what the instruments in it read.

An effect (`effects`, `scenarios`) changes the laboratory before a recording is made: its geometry,
its metal, or the chain from the true quantity to the recorded one.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from boards import Board, Sensors
from filaments import along
from spheres import dipole_field, response

FLUX_NOISE_T = 60e-12
STATIC_NOISE_T = 30e-12
OPTICAL_JITTER_M = 0.07e-3
OPTICAL_JITTER_RAD = 0.4e-3
ROUNDS = 4
"""How often several scatterers answer to each other's answers."""


@dataclass
class Laboratory:
    """What an effect may change.

    ``on_flux`` are functions ``(lab, time, channels, flux) -> flux`` in the order of the signal:
    emitters first, then channels; tool and references alike. ``on_optical``, ``(time, position,
    rotation) -> the same``, go from the true pose to what is stamped and reported.
    """

    board: Board
    tool: Sensors  # as they really are
    paths: list  # the emitters' tracks
    metals: list = field(default_factory=list)  # of (Body, Travel)
    on_flux: list[Callable] = field(default_factory=list)
    on_optical: list[Callable] = field(default_factory=list)

    @classmethod
    def clean(cls, board):
        """The room as it was when the board was calibrated."""
        return cls(board, replace(board.tool), [path.copy() for path in board.paths])

    def field(self, points):
        """Field of the emitters alone, (..., K, 3), T."""
        flat = self.board.field(points.reshape(-1, 3), self.paths)
        return flat.reshape(*points.shape[:-1], *flat.shape[1:])


class Scattered:
    """The answer of all metal at given times.

    ``place`` (T, N, 3) and ``moments`` (T, N, 3, K) are of the spheres of each body, T being 1
    where nothing moves.
    """

    def __init__(self, lab, time):
        self.lab, omega = lab, lab.board.omega
        self.still = not any(travel.moves for _, travel in lab.metals)
        time = np.asarray(time)[:1] if self.still else np.asarray(time)
        poses = [travel.at(time) for _, travel in lab.metals]
        self.place = [
            at[:, None] + np.einsum('tij,nj->tni', turn, body.place)
            for (body, _), (at, turn) in zip(lab.metals, poses, strict=True)
        ]
        responses = [response(body, omega) for body, _ in lab.metals]
        drive = [np.moveaxis(lab.field(place), -2, -1) for place in self.place]
        self.moments = [np.zeros(d.shape, dtype=complex) for d in drive]
        for _ in range(ROUNDS if len(drive) > 1 else 1):
            for b, own in enumerate(drive):
                here = own + np.moveaxis(self.field(self.place[b], without=b), -2, -1)
                self.moments[b] = self._answer(responses[b], poses[b][1], here)

    @staticmethod
    def _answer(matrices, turn, drive):
        """Moments (T, N, 3, K) of one body by the field at its spheres."""
        own = np.einsum('tji,tnjk->tnik', turn, drive)
        count, spheres, _, emitters = own.shape
        flat = own.reshape(count, 3 * spheres, emitters)
        moments = np.stack([flat[..., k] @ matrices[k].T for k in range(emitters)], axis=-1)
        return np.einsum('tij,tnjk->tnik', turn, moments.reshape(own.shape))

    def field(self, points, without=None):
        """Field (T, ..., K, 3), T, of all metal but perhaps one body at points (T, ..., 3)."""
        out = np.zeros((*points.shape[:-1], self.lab.board.omega.size, 3), dtype=complex)
        for t, frame in enumerate(points):
            flat = frame.reshape(-1, 3)
            for b, place in enumerate(self.place):
                if b != without:
                    now = 0 if self.still else t
                    total = dipole_field(flat, place[now], self.moments[b][now])
                    out[t] += total.reshape(out[t].shape)
        return out


def _flux_of(total, axes, weights):
    """Mean of the field (..., Q, K, 3) along sensors with axes (..., 3)."""
    return np.einsum('...qkc,...c,q->...k', total, axes, weights)


def tool_geometry(sensors, position, rotation):
    """Places and axes (F, S, 3) of a tool's sensors."""
    place = position[:, None] + np.einsum('fij,sj->fsi', rotation, sensors.place)
    return place, np.einsum('fij,sj->fsi', rotation, sensors.axis)


def read_fluxes(lab, time, position, rotation):
    """True fluxes of tool (F, S, K) and references (F, R, K), T, before any channel's errors."""
    place, axes = tool_geometry(lab.tool, position, rotation)
    nodes, weights = along(place, axes, np.broadcast_to(lab.tool.length, place.shape[:2]))
    real = lab.board.reference_real
    fixed, fixed_weights = along(real.place, real.axis, real.length)
    tool = _flux_of(lab.field(nodes), axes, weights).astype(complex)
    reference = _flux_of(lab.field(fixed), real.axis, fixed_weights).astype(complex)
    reference = np.tile(reference, (len(time), 1, 1))
    if lab.metals:
        scattered = Scattered(lab, time)
        tool += _flux_of(scattered.field(nodes), axes, weights)
        frames = (
            fixed[None] if scattered.still else np.broadcast_to(fixed, (len(time), *fixed.shape))
        )
        reference = reference + _flux_of(scattered.field(frames), real.axis, fixed_weights)
    return tool, reference * lab.board.reference_gain[:, None]


def measured(lab, time, fluxes, noise_t, rng):
    """Fluxes as recorded: every change of the chain in turn, then noise."""
    out = []
    groups = zip((lab.tool.channel, lab.board.reference.channel), fluxes, strict=True)
    for channels, flux in groups:
        for change in lab.on_flux:
            flux = change(lab, time, channels, flux)
        out.append(flux + noise_t * (rng.normal(size=(*flux.shape, 2)) @ np.array([1.0, 1.0j])))
    return out
