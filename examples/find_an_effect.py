"""Put a known fault into a recorded session, let the diagnosis find it, and correct it."""

import sys
from dataclasses import replace
from pathlib import Path

from anser_ros import Model, diagnose, load_session, track, write_session

ROOT = Path(__file__).resolve().parents[1]
out = Path(sys.argv[1] if len(sys.argv) > 1 else 'out')

clean = load_session(ROOT / 'bags' / 'moving.mcap')
model = Model.load(ROOT / 'config' / 'demo_model.yaml')
(tool,) = clean.tools

# The amplifier of one coil gains 2 % too much. Six coils and every fifth frame are enough here.
flux = tool.flux[::5, :6].copy()
flux[:, 4] *= 1.02
setup = replace(clean.setup, sensors=clean.setup.tool_sensors[:6])
poses = {tool.body: (tool.track.time, tool.track.position, tool.track.quaternion)}
write_session(out / 'fault.mcap', setup, tool.time[::5], flux, poses, overwrite=True)
session = load_session(out / 'fault.mcap')

found = diagnose(session, model)
found.model.save(out / 'corrected_model.yaml')
for effect in found.to_dict()['effects']:
    print(effect['name'], effect['parameters'])

name = tool.sensors.name[4]
for label, used in (('before', model), ('after', found.model)):
    figures = track(session, used, gate=float('inf')).to_dict()['sensors'][name]
    print(f'{name} {label}: {1e3 * figures["position_rmse_m"]:.2f} mm')
