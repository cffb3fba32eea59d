"""A room with a board, a tool and perhaps metal, and what the instruments in it read.

An effect (`effects`, `scenarios`) changes the laboratory before a recording is made: its geometry,
its metal, or the chain from the true quantity to the recorded one.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from boards import Board, Sensors
from filaments import along
from sheets import edge_currents, flux_nodes, mesh, sheet_field
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
    sheets: list = field(default_factory=list)
    on_flux: list[Callable] = field(default_factory=list)
    on_optical: list[Callable] = field(default_factory=list)
    noise: dict = field(default_factory=dict)  # factor by channel; key -1 for all

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
    where nothing moves; ``currents`` (T, E, K) of the edges of each sheet's mesh.
    """

    def __init__(self, lab, time):
        self.lab, omega = lab, lab.board.omega
        self.still = not any(travel.moves for _, travel in lab.metals)
        time = np.asarray(time)[:1] if self.still else np.asarray(time)
        self.count = time.size
        poses = [travel.at(time) for _, travel in lab.metals]
        self.place = [
            at[:, None] + np.einsum('tij,nj->tni', turn, body.place)
            for (body, _), (at, turn) in zip(lab.metals, poses, strict=True)
        ]
        self.turns = [turn for _, turn in poses]
        self.grids = [mesh(sheet) for sheet in lab.sheets]
        responses = [response(body, omega) for body, _ in lab.metals]
        drive = [np.moveaxis(lab.field(place), -2, -1) for place in self.place]
        nodes = [flux_nodes(g, s) for g, s in zip(self.grids, lab.sheets, strict=True)]
        normal = [lab.field(n) @ g.normal for n, g in zip(nodes, self.grids, strict=True)]
        self.moments = [np.zeros(d.shape, dtype=complex) for d in drive]
        self.currents = [
            np.zeros((self.count, len(g.start), omega.size), dtype=complex) for g in self.grids
        ]
        rounds = ROUNDS if len(drive) + len(normal) > 1 else 1
        for _ in range(rounds):
            for b, own in enumerate(drive):
                here = own + np.moveaxis(self._others(self.place[b], body=b), -2, -1)
                self.moments[b] = self._answer(responses[b], self.turns[b], here)
            for s, own in enumerate(normal):
                other = self._others(np.broadcast_to(nodes[s], (self.count, *nodes[s].shape)), s)
                total = (own + other @ self.grids[s].normal).mean(axis=-2)
                self.currents[s] = np.array(
                    [edge_currents(self.grids[s], frame, omega) for frame in total]
                )

    @staticmethod
    def _answer(matrices, turn, drive):
        """Moments (T, N, 3, K) of one body by the field at its spheres."""
        own = np.einsum('tji,tnjk->tnik', turn, drive)
        count, spheres, _, emitters = own.shape
        flat = own.reshape(count, 3 * spheres, emitters)
        moments = np.stack([flat[..., k] @ matrices[k].T for k in range(emitters)], axis=-1)
        return np.einsum('tij,tnjk->tnik', turn, moments.reshape(own.shape))

    def _others(self, points, sheet=None, body=None):
        """Field (T, ..., K, 3) of all metal but one piece at points (T, ..., 3)."""
        out = np.zeros((*points.shape[:-1], self.lab.board.omega.size, 3), dtype=complex)
        alone = len(self.place) + len(self.grids) == 1
        if alone and (sheet is not None or body is not None):
            return out
        for t in range(len(points)):
            flat = points[t].reshape(-1, 3)
            now = 0 if self.still else t
            total = np.zeros((len(flat), *out.shape[-2:]), dtype=complex)
            for b, place in enumerate(self.place):
                if b != body:
                    total += dipole_field(flat, place[now], self.moments[b][now])
            for s, grid in enumerate(self.grids):
                if s != sheet:
                    total += sheet_field(flat, grid, self.currents[s][now])
            out[t] = total.reshape(out[t].shape)
        return out

    def field(self, points):
        """Field (T, ..., K, 3), T, at points (T, ..., 3)."""
        return self._others(points)


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
    if lab.metals or lab.sheets:
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
        factor = np.array([lab.noise.get(int(c), lab.noise.get(-1, 1.0)) for c in channels])
        white = rng.normal(size=(*flux.shape, 2)) @ np.array([1.0, 1.0j])
        out.append(flux + noise_t * factor[:, None] * white)
    return out
