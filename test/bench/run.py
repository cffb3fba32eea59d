"""Runs every benchmark here, prints their rows and writes bench.json.

A benchmark is a module ``bench_*.py`` with ``rows()``, which returns or yields dicts. A row has
``name``, ``value`` and ``unit``, and where there are such: ``rival``, ``rival_value``, ``ratio``
(the rival's value over ours), ``target`` (a number, with ``target_is`` 'most' or 'least') and
``met``. Everything runs on one thread, ours and the rival in the same process one after the other.
Each row is printed as it comes; bench.json is written after every module.
"""

import argparse
import importlib
import json
import os
import sys
import time
import traceback
from pathlib import Path
from typing import Any

import harness

KEYS = ('name', 'value', 'unit', 'rival', 'rival_value', 'ratio', 'target', 'met')


def complete(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row with all keys of bench.json, those that were left out worked out or None."""
    unknown = set(row) - {*KEYS, 'target_is'}
    if unknown:
        raise ValueError(f'row {row.get("name")!r} has unknown keys {sorted(unknown)}')
    value, rival, target = row['value'], row.get('rival_value'), row.get('target')
    if row.get('ratio') is None and rival is not None and value:
        row['ratio'] = rival / value
    if row.get('met') is None and isinstance(target, int | float):
        at_least = row.get('target_is', 'most') == 'least'
        row['met'] = bool(value >= target if at_least else value <= target)
    return {key: row.get(key) for key in KEYS}


def text(value: Any) -> str:
    """Return a cell of the table."""
    if value is None:
        return ''
    if isinstance(value, bool):
        return 'yes' if value else 'NO'
    return f'{value:.4g}' if isinstance(value, float) else str(value)


def line(row: dict[str, Any]) -> str:
    """Return a row as one line, for whoever watches."""
    parts = [f'  {row["name"]}: {text(row["value"])} {row["unit"]}']
    if row['rival_value'] is not None:
        parts.append(f'{row["rival"]} {text(row["rival_value"])}')
    if row['target'] is not None:
        parts.append(f'target {text(row["target"])}: {"met" if row["met"] else "NOT met"}')
    return '; '.join(parts)


def main() -> int:
    """Run the benchmarks; 1 when one of them broke, whatever the figures."""
    parser = argparse.ArgumentParser(description='benchmarks beside their rivals, on one thread')
    parser.add_argument('names', nargs='*', help='run only these: demodulation, solve, ...')
    parser.add_argument(
        '--out', type=Path, default=harness.REPO / 'bench.json', help='file to write'
    )
    args = parser.parse_args()
    # The others print a table of their own, and are run by their names.
    paths = [
        path for path in sorted(harness.HERE.glob('bench_*.py')) if 'def rows(' in path.read_text()
    ]
    known = [path.stem.removeprefix('bench_') for path in paths]
    unknown = set(args.names) - set(known)
    if unknown:
        print(f'bench: no {", ".join(sorted(unknown))}; there are: {", ".join(known)}')
        return 2
    chosen = [name for name in known if not args.names or name in args.names]
    os.environ.update(dict.fromkeys(harness.THREADS, '1'))  # before numpy is imported
    rows: list[dict[str, Any]] = []
    try:
        broken = run(chosen, rows, args.out)
    except KeyboardInterrupt:
        print(f'bench: interrupted; {len(rows)} rows are in {args.out}', file=sys.stderr)
        return 130
    if broken:
        print(f'bench: broken: {", ".join(broken)}', file=sys.stderr)
    return 1 if broken else 0


def run(chosen: list[str], rows: list[dict[str, Any]], out: Path) -> list[str]:
    """Run benchmarks one after the other into ``rows``; return the names of those that broke."""
    broken = []
    for name in chosen:
        began_s = time.monotonic()
        print(f'{name} ...', file=sys.stderr, flush=True)
        try:
            for row in importlib.import_module(f'bench_{name}').rows():
                rows.append(complete(row))
                print(line(rows[-1]), flush=True)
        except Exception:  # noqa: BLE001 - the others are still worth their figures
            traceback.print_exc()
            broken.append(name)
        finally:
            out.write_text(json.dumps(rows, indent=1) + '\n', encoding='utf-8')
        print(f'{name}: {time.monotonic() - began_s:.1f} s', file=sys.stderr, flush=True)
    return broken


if __name__ == '__main__':
    sys.exit(main())
