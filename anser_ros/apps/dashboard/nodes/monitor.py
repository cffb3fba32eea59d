"""Shows a live table of sensors, rates and latencies."""

import math
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Table
from std_msgs.msg import String

from anser_ros.apps.dashboard.nodes.traces import (
    OpticalTrace,
    PoseTrace,
    Row,
    latency_of,
    middle,
    targets_of,
)
from anser_ros.errors import ParameterError
from anser_ros.nodes.operator_words import causes
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.diagnostics import LastStatus, statuses_in
from anser_ros.nodes.runtime.node import AnserNode, Level, Status
from anser_ros.nodes.runtime.parameters import optical_parameter, parameter
from anser_ros.nodes.runtime.process import main
from anser_ros.stamps import NANO, stamp_of
from anser_ros.wire.recorded import optical_topic, pose_numbers
from anser_ros.wire.setup import Setup, parse_setup, topic_of

PERIOD_S, LINE_PERIOD_S = 0.25, 1.0
"""Time between two tables, and between two lines where the output is no terminal, s."""
NEWEST = 200
"""Optical poses with which the newest poses are compared."""
WIDE = 100
"""Columns of a terminal from which on all columns of the table fit."""
STATE_WIDTH = 14
"""Characters of the column of states: as many as the longest state has."""
# Colours of the levels of diagnostic_msgs.
LEVELS = {0: 'green', 1: 'yellow', 2: 'red', 3: 'red'}


@dataclass(frozen=True)
class MonitorParameters:
    duration_s: float = parameter(
        0.0,
        'time from the first pose until it ends by itself; 0 for never, s',
        within=(0.0, math.inf),
    )
    patience_s: float = parameter(
        0.0, 'time without a pose after which it gives up; 0 for never, s', within=(0.0, math.inf)
    )
    compare: str = parameter('', 'namespace of a second tracker to show as well; empty for none')
    optical: str = optical_parameter()
    output: str = parameter('', 'file (.npz) to write all poses and errors to at the end')


class Monitor(AnserNode):
    """Shows state, pose, sigma, true error, rate and latency of every sensor and body."""

    NAME = 'monitor'
    EXAMPLE = '--ros-args -p duration_s:=30.0'
    PARAMETERS = MonitorParameters

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        if self.parameters.output:
            _check(Path(self.parameters.output))
        self._console = Console()
        self._live: Live | None = None
        if self._console.is_terminal:
            self._live = Live(console=self._console, auto_refresh=False)
        self._setup: Setup | None = None
        self._chains: dict[str, list[PoseTrace]] = {}
        self._optical: dict[str, OpticalTrace] = {}
        self._statuses: dict[str, LastStatus] = {}
        self._note = ''
        self._metal: list[tuple[float, float]] = []
        self._pose_subscriptions: list[Any] = []
        self._first_s: float | None = None
        self._last_s = time.monotonic()
        self.create_subscription(String, 'setup', self._on_setup, qos.LATCHED)
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, qos.EVENTS)
        period_s = PERIOD_S if self._live else LINE_PERIOD_S
        self.create_timer(period_s, self._show, clock=self.steady_clock)

    def _on_setup(self, message: String) -> None:
        setup = parse_setup(message.data)
        known, self._setup = self._setup, setup
        if known is not None and known.sensors == setup.sensors:
            return
        for subscription in self._pose_subscriptions:
            self.destroy_subscription(subscription)
        chains = dict.fromkeys(('', self.parameters.compare))
        self._chains = {chain: [PoseTrace(t) for t in targets_of(setup)] for chain in chains}
        self._optical = {body: OpticalTrace() for body in setup.bodies}
        wanted: list[tuple[type, str, Any]] = [
            (PoseStamped, optical_topic(body, self.parameters.optical),
             partial(self._on_optical, seen)) for body, seen in self._optical.items()
        ]  # fmt: skip
        for chain, traces in self._chains.items():
            for trace in traces:
                stem = topic_of(trace.target.name)
                topic = '/'.join(filter(None, (chain, stem, 'pose_with_covariance')))
                wanted.append((PoseWithCovarianceStamped, topic, partial(self._on_pose, trace)))
        self._pose_subscriptions = [
            self.create_subscription(kind, topic, callback, qos.OTHERS)
            for kind, topic, callback in wanted
        ]

    def _on_pose(self, trace: PoseTrace, message: PoseWithCovarianceStamped) -> None:
        now_s = time.time()
        if self._first_s is None:
            self._first_s = time.monotonic()
        variance, stamp_s = message.pose.covariance, stamp_of(message) * NANO
        trace.stamp_s.append(stamp_s)
        trace.position.append(pose_numbers(message.pose.pose)[:3])
        trace.sigma_m.append(float(np.sqrt(variance[0] + variance[7] + variance[14])))
        trace.latency_s.append(latency_of(now_s, stamp_s))

    def _on_optical(self, trace: OpticalTrace, message: PoseStamped) -> None:
        pose = pose_numbers(message.pose)
        trace.add(stamp_of(message) * NANO, pose[:3], pose[3:])

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        statuses = statuses_in(message)
        self._statuses |= statuses
        for name, (_, _, values) in statuses.items():
            if name.endswith('cu_simulator') and 'metal_distance_m' in values:
                self._metal.append((time.time(), float(values['metal_distance_m'])))

    def _show(self) -> None:
        now_s = time.monotonic()
        elapsed_s, self._last_s = now_s - self._last_s, now_s
        tracks = {body: seen.track(NEWEST) for body, seen in self._optical.items()}
        rows = {
            chain: [trace.row(tracks.get(trace.target.body), elapsed_s) for trace in traces]
            for chain, traces in self._chains.items()
        }
        if not self.parameters.output:  # else all are written at the end
            for traces in self._chains.values():
                for trace in traces:
                    trace.forget()
            for seen in self._optical.values():
                seen.forget(NEWEST)
        if self._live is not None:
            # It hides the cursor, so only once the node is made and will surely be closed.
            self._live.start()
            self._live.update(self._table(rows), refresh=True)
        else:
            print(self._line(rows), flush=True)
        self._check_end(now_s)

    def _check_end(self, now_s: float) -> None:
        table = self.parameters
        if self._first_s is None:
            if table.patience_s and now_s - self.started_s > table.patience_s:
                self._note = f'no pose within {table.patience_s:g} s'
                print(f'monitor: {self._note}; {self._problems()}', file=sys.stderr)
                self.stop(1)
        elif table.duration_s and now_s - self._first_s >= table.duration_s:
            self.stop(0)

    def _problems(self) -> str:
        return '; '.join(self._causes()) or 'no node complains'

    def _causes(self) -> list[str]:
        rate_hz = 0.0 if self._setup is None else self._setup.flux_rate_hz
        return causes(self._statuses, self.get_namespace().strip('/'), rate_hz)

    def _state(self, chain: str, name: str) -> tuple[int, str]:
        namespace = self.get_namespace().strip('/')
        prefix = f'{namespace}/{chain}' if chain else namespace
        return self._statuses.get(f'{prefix}/tracker: {name}', LastStatus(1, 'waiting', {}))[:2]

    def _table(self, rows: dict[str, list[Row]]) -> Table:
        """The table; one column for a position, and states only where they are not ok."""
        second = self.parameters.compare
        narrow = self._console.width < WIDE
        table = Table(
            title=self._title(), title_justify='left', caption=self._caption(),
            caption_justify='left', padding=(0, 0) if narrow else (0, 1), collapse_padding=True,
        )  # fmt: skip
        for heading in ('sensor', 'state'):
            table.add_column(heading, no_wrap=True)
        others_error = [f'{second}\nerror'] if second else []
        for heading in ('x, y, z mm', 'sigma\nmm', 'error\nmm', *others_error, 'Hz', 'ms'):
            table.add_column(heading, justify='right', no_wrap=True)
        others = {row.name: row for row in rows.get(second, [])} if second else {}
        for row in rows.get('', []):
            level, state = self._state('', row.name)
            if narrow:  # the reason stands below the table
                state = state.split(':')[0][:STATE_WIDTH]
            cells = [row.name, f'[{LEVELS.get(level, "red")}]{state}']
            cells.append(' '.join(f'{_mm(v, 1):>6}' for v in row.position_m))
            cells += [_mm(row.sigma_m), _mm(row.error_m)]
            if second:
                level, state = self._state(second, row.name)
                error = _mm(others[row.name].error_m)
                cells.append(error if level == 0 else f'[{LEVELS.get(level, "red")}]{state[:9]}')
            cells += [f'{row.rate_hz:.0f}', _number(1e3 * row.latency_s, 1)]
            table.add_row(*cells)
        return table

    def _title(self) -> str:
        if self._first_s is None:
            return f'waiting for the first pose: {self._problems()}'
        end_s = self.parameters.duration_s
        ran_s = time.monotonic() - self._first_s
        return f'{ran_s:.0f} s' + (f' of {end_s:.0f} s' if end_s else '')

    def _caption(self) -> str:
        caption = 'ms: latency from the middle of the window'
        if self._metal:
            caption = f'metal {100 * self._metal[-1][1]:.0f} cm from the board; {caption}'
        if self._first_s is not None:  # until then they are in the title
            caption += ''.join(f'\n{escape(text)}' for text in self._causes())
        return caption

    def _line(self, rows: dict[str, list[Row]]) -> str:
        parts = [self._title()]
        if self._first_s is None:
            return parts[0]
        for chain, found in rows.items():
            good = sum(row.rate_hz > 0 for row in found)
            error = middle([row.error_m for row in found])
            sigma = middle([row.sigma_m for row in found])
            parts.append(
                f'{chain or "live"}: {good}/{len(found)} tracked, '
                f'error {_mm(error)} mm, sigma {_mm(sigma)} mm'
            )
        live = rows.get('', [])
        parts.append(f'{middle([row.rate_hz for row in live]):.0f} Hz')
        parts.append(f'{_number(1e3 * middle([row.latency_s for row in live]), 1)} ms')
        if self._metal:
            parts.append(f'metal {100 * self._metal[-1][1]:.0f} cm')
        if why := self._causes():
            parts.append(f'why: {"; ".join(why)}')
        return '  '.join(parts)

    def status(self) -> Status:
        poses = {
            f'poses_{chain or "live"}': sum(t.forgotten + len(t.stamp_s) for t in traces)
            for chain, traces in self._chains.items()
        }
        return Status('', Level.OK, self._note or 'watching', poses)

    def close(self) -> None:
        if self._live is not None:
            self._live.stop()
        if self.parameters.output:
            self._write(Path(self.parameters.output))

    def _write(self, path: Path) -> None:
        arrays: dict[str, Any] = {
            'chains': np.array(list(self._chains), dtype=str),
            'metal': np.array(self._metal, float).reshape(-1, 2),
        }
        names = [trace.target.name for trace in self._chains.get('', [])]
        arrays['names'] = np.array(names, dtype=str)
        for rank, traces in enumerate(self._chains.values()):
            for index, trace in enumerate(traces):
                optical = self._optical[trace.target.body].track()
                key = f'{rank}_{index}'
                arrays[f'stamp_{key}'] = np.array(trace.stamp_s)
                arrays[f'position_{key}'] = np.array(trace.position, float).reshape(-1, 3)
                arrays[f'sigma_{key}'] = np.array(trace.sigma_m)
                arrays[f'latency_{key}'] = np.array(trace.latency_s)
                arrays[f'error_{key}'] = trace.distances(optical) if optical else np.zeros(0)
        for body, seen in self._optical.items():
            arrays[f'optical_{body}'] = np.column_stack(
                [np.array(seen.stamp_s), np.array(seen.position, float).reshape(-1, 3)]
            )
        temporary = _part(path)
        np.savez_compressed(temporary, **arrays)
        temporary.replace(path)


def _part(path: Path) -> Path:
    """Where an output file is written, before it takes its place as a whole."""
    return path.with_suffix('.part.npz')


def _check(path: Path) -> None:
    """Refuse an output file that cannot be written before anything is recorded for it."""
    try:
        _part(path).touch()
        _part(path).unlink()
    except OSError as error:
        raise ParameterError(f'parameter output: {path}: {error.strerror}') from error


def _mm(value_m: float, digits: int = 2) -> str:
    return _number(1e3 * value_m, digits)


def _number(value: float, digits: int) -> str:
    return f'{value:.{digits}f}' if np.isfinite(value) else '-'


if __name__ == '__main__':
    sys.exit(main(Monitor))
