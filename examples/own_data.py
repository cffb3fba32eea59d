"""From your own arrays to a session in an MCAP bag, and from that to a field model."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros import Model, calibrate, load_session, load_setup, write_session

ROOT = Path(__file__).resolve().parents[1]
out = Path(sys.argv[1] if len(sys.argv) > 1 else 'out')

# The demo's board with one cluster of its tool, three coils at the origin of the tool's frame.
setup = load_setup(ROOT / 'config' / 'demo_setup.yaml')
tool = tuple(s for s in setup.tool_sensors if s.name.startswith('tool_a/1/'))
setup = replace(setup, sensors=tool)

# Stand-ins for what you have measured: poses (N, 3) and (N, 4), fluxes (N, 3 coils, 8 emitters).
rng = np.random.default_rng(1)
axes = np.linspace(-0.12, 0.12, 6), np.linspace(-0.12, 0.12, 6), (0.10, 0.15, 0.20)
positions = np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 3)
turns = Rotation.random(len(positions), random_state=1)
coil_axes = np.stack([turns.apply(s.axis) for s in tool], axis=1)
drawn = Model.nominal(setup).flux(np.repeat(positions[:, None], 3, axis=1), coil_axes)
gains = 1 + 0.02 * rng.normal(size=8)  # the board as built is not quite the board as drawn
flux = drawn * gains + 30e-12 * rng.normal(size=(*drawn.shape, 2)).view(complex)[..., 0]

times = np.arange(len(positions), dtype=float)
poses = {'tool_a': (times, positions, turns.as_quat())}
write_session(out / 'own.mcap', setup, times, flux, poses, overwrite=True)
result = calibrate(load_session(out / 'own.mcap'), dipoles=8)
result.model.save(out / 'own_model.yaml')
print(f'model error on held-out places: {1e12 * result.flux_error_t:.0f} pT')
