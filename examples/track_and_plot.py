"""Track a recorded session, and plot each coil's error beside its stated uncertainty."""

import sys
from pathlib import Path

import matplotlib.pyplot as plt

from anser_ros import Model, load_session, track

ROOT = Path(__file__).resolve().parents[1]
out = Path(sys.argv[1] if len(sys.argv) > 1 else 'out')

session = load_session(ROOT / 'bags' / 'moving.mcap')
result = track(session, Model.load(ROOT / 'config' / 'demo_model.yaml'))

figure, (path, error) = plt.subplots(1, 2, figsize=(9, 4), layout='constrained')
for name, coil in result.sensors.items():
    good = coil.ok
    path.plot(1e3 * coil.position[good, 0], 1e3 * coil.position[good, 1], '.', ms=2, label=name)
    error.plot(coil.time[good], 1e3 * coil.position_error_m[good], lw=0.8)
tool = result['tool_a']
error.plot(tool.time, 3e3 * tool.sigma_position_m, 'k--', label='3 sigma of the whole tool')
path.set(xlabel='x, mm', ylabel='y, mm', aspect='equal', title='coils, seen from above')
error.set(xlabel='time, s', ylabel='mm', title='distance from the (jittering) optical pose')
path.legend(fontsize=6)
error.legend()
out.mkdir(parents=True, exist_ok=True)
figure.savefig(out / 'tracks.png', dpi=150)
result.save(out / 'tracks.npz')

rmse = result.to_dict()['bodies']['tool_a']['position_rmse_m']
print(f'{tool.ok.mean():.0%} of {len(tool.time)} frames tracked, RMSE {1e3 * rmse:.3f} mm')
