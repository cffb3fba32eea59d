"""Describe a board and a tool of your own, and see what a calibration improves on it."""

import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros import Model, calibrate, load_session, track, write_session

out = Path(sys.argv[1] if len(sys.argv) > 1 else 'out')
# Eight round coils; docs/setup.md has every key and every kind of emitter.
places = [(x, y, 0.0) for x in (-0.09, 0.0, 0.09) for y in (-0.09, 0.0, 0.09) if (x, y) != (0, 0)]
setup = {
    'schema': 'anser_setup/1',
    'flux_rate_hz': 10.0,
    'emitter': {'kind': 'circular_loop', 'radius_m': 0.035, 'turns': 60, 'current_a': 0.2,
                'coils': [{'name': f'k{k}', 'centre_m': list(place), 'frequency_hz': 2e3 + 150 * k}
                          for k, place in enumerate(places)]},
    'sensors': [{'channel': c, 'name': f'pen/{"xyz"[c]}', 'body': 'pen',
                 'position_m': [0.0, 0.0, 0.01 * c], 'axis': np.eye(3)[c].tolist()}
                for c in range(3)]}  # fmt: skip
drawn = Model.nominal(setup)

# A simulated scan: a pose a second all over the volume; the board's coils are 2 % off in strength.
rng, count = np.random.default_rng(1), 150
position = rng.uniform((-0.12, -0.12, 0.08), (0.12, 0.12, 0.22), (count, 3))
turn = Rotation.random(count, random_state=1)
coils = np.stack([position + turn.apply([0, 0, 0.01 * c]) for c in range(3)], axis=1)
flux = drawn.flux(coils, turn.as_matrix().swapaxes(1, 2)) * (1 + 0.02 * rng.normal(size=8))
flux = flux + 60e-12 * rng.normal(size=(*flux.shape, 2)).view(complex)[..., 0]
poses = {'pen': (np.arange(float(count)), position, turn.as_quat())}
write_session(out / 'board.mcap', setup, poses['pen'][0], flux, poses, overwrite=True)

session = load_session(out / 'board.mcap')
for label, model in ('as drawn', drawn), ('calibrated', calibrate(session, dipoles=10).model):
    pen = track(session, model)['pen']
    both = (pen.sigma_position_m, pen.position_error_m)
    sigma, error = (1e3 * np.nanmedian(values[pen.ok]) for values in both)
    print(f'{label}: {pen.ok.mean():.0%} tracked, error {error:.3f} mm, sigma {sigma:.3f} mm')
