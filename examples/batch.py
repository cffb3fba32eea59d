"""Track every session of a folder, and write one table of errors."""

import csv
import sys
from pathlib import Path

from anser_ros import Model, load_session, track
from anser_ros.errors import AnserError

ROOT = Path(__file__).resolve().parents[1]
out = Path(sys.argv[1] if len(sys.argv) > 1 else 'out')
folder = Path(sys.argv[2] if len(sys.argv) > 2 else ROOT / 'bags')

model = Model.load(ROOT / 'config' / 'demo_model.yaml')
out.mkdir(parents=True, exist_ok=True)
with (out / 'errors.csv').open('w', newline='', encoding='utf-8') as stream:
    table = csv.writer(stream)
    table.writerow(['session', 'sensor', 'frames', 'tracked', 'rmse_mm', 'p95_mm'])
    for bag in sorted(folder.glob('*.mcap')):
        try:
            result = track(load_session(bag), model)
        except AnserError as error:  # a bag that cannot be used does not end the batch
            print(f'{bag.name}: left out: {error}', file=sys.stderr)
            continue
        for name, row in result.to_dict()['sensors'].items():
            figures = [row['position_rmse_m'], row['position_prc95_m']]
            cells = ['' if f is None else f'{1e3 * f:.3f}' for f in figures]
            table.writerow([bag.name, name, row['n'], f'{row["tracked_fraction"]:.3f}', *cells])
        body = result['tool_a']
        print(f'{bag.name}: {body.ok.mean():.0%} of {len(body.time)} frames tracked')
