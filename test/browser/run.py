"""Closes the loop in a browser, by clicking alone, on a simulated unit with an effect put in.

A control unit with one effect in its raw samples, the chain, a recorder and the live view run as
processes; a headless Chromium opens the page, records, diagnoses, loads the corrected model and
undoes it. With --calibrate it sets a baseline and fits a new model to the recording instead. What
the page says before and after is printed beside what was put in, with the rate of the page's poses
and the processor time of the live view's process.
"""

import argparse
import json
import os
import re
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from chromium import BROWSER_OPTIONS, browser_of

from anser_ros.cli.processes import (
    BOARD_SEED,
    SAMPLE_RATE_HZ,
    Child,
    Supervisor,
    node_command,
    tail,
)
from anser_ros.settings import Accuracy
from anser_ros.simulation.effects import CATALOGUE
from anser_ros.wire.text_files import config_path

PATIENCE_S = 180.0
"""Time for the chain to start and for a command to end, s."""
FIGURES_S = 13.0
"""Time until the page's figures of the last ten seconds are all of one state, s."""
SIZES = {'dashboard': (1280, 800), 'dashboard_wide': (1920, 1080)}
"""Pictures, and the size of the window for each, in pixels."""


def main() -> int:
    """Run the trial; 1 where the loop was not closed."""
    args = _arguments()
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 101))
    for threads in ('OPENBLAS_NUM_THREADS', 'NUMBA_NUM_THREADS'):
        os.environ.setdefault(threads, '1')
    with tempfile.TemporaryDirectory(prefix='anser_browser_') as name:
        folder = Path(name)
        with _chain(folder, args) as chain, _browser(_address(chain['dashboard'])) as page:
            found = Trial(page, folder, args.pictures).run(args)
            truth = folder / 'truth.json'
            found['put_in'] = json.loads(truth.read_text('utf-8')) if truth.exists() else {}
            print(json.dumps(found, ensure_ascii=False), file=sys.stderr, flush=True)
            if args.processor:
                found['processor'] = _processor(chain, page, args.processor)
    found['put_in'].pop('answers', None)
    print(json.dumps(found, indent=1, ensure_ascii=False))
    return 0 if args.look or found['closed'] else 1


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--effect', default='sensor_gain', choices=sorted(CATALOGUE))
    parser.add_argument('--seed', type=int, default=1, help='of the effect')
    parser.add_argument('--record', type=float, default=15.0, metavar='S', help='of the recording')
    parser.add_argument('--rate', type=float, default=25.0, metavar='HZ', help='of the fluxes')
    parser.add_argument('--metal', action='store_true', help='a steel disc comes and goes')
    parser.add_argument('--watch', action='store_true', help='the watcher runs too')
    parser.add_argument('--look', action='store_true', help='only look; nothing is clicked')
    parser.add_argument(
        '--calibrate', action='store_true', help='set a baseline, and calibrate, not diagnose'
    )
    parser.add_argument('--pictures', type=Path, metavar='DIR', help='folder for pictures')
    parser.add_argument(
        '--processor', type=float, default=0.0, metavar='S', help='measure its load for so long'
    )
    return parser.parse_args()


@contextmanager
def _chain(folder: Path, args: argparse.Namespace) -> Iterator[dict[str, Child]]:
    model, port = config_path('demo_model.yaml'), folder / 'cu'
    commands = {
        'live': node_command(
            'live', acquisition__device=port, acquisition__rate_hz=args.rate,
            field_model__model_file=model, tracker__model_file=model,
            field_model__baseline_at_start=args.metal,
        ),
        'recorder': node_command('recorder', directory=folder / 'bags', autostart=False),
        'cu_simulator': node_command(
            'cu_simulator', link=port, metal=args.metal, board_seed=BOARD_SEED,
            sample_rate_hz=SAMPLE_RATE_HZ, optical_noise_m=Accuracy.optical_position_m,
            effect=args.effect, effect_seed=args.seed, effect_file=folder / 'truth.json',
        ),
        'dashboard': node_command('dashboard', directory=folder / 'bags', port=0),
    }  # fmt: skip
    if args.watch:
        commands['watcher'] = node_command('watcher', model_file=model, window_s=10.0)
    with Supervisor(folder / 'logs') as supervisor:
        children = {name: supervisor.start(name, words) for name, words in commands.items()}
        try:
            yield children
        except BaseException:
            for child in children.values():
                print(f'{child.name}:\n{tail(child)}', file=sys.stderr)
            raise


def _address(dashboard: Child) -> str:
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        said = re.search(r'live view: (\S+)', dashboard.log.read_text(encoding='utf-8'))
        if said:
            return said[1]
        time.sleep(0.1)
    raise TimeoutError('the live view has not started')


@contextmanager
def _browser(address: str) -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=browser_of(), args=BROWSER_OPTIONS)
        width, height = SIZES['dashboard']
        page = browser.new_page(viewport={'width': width, 'height': height})
        page.set_default_timeout(1e3 * PATIENCE_S)
        page.goto(address)
        yield page
        browser.close()


class Trial:
    """What a person would do on the page."""

    def __init__(self, page: Any, folder: Path, pictures: Path | None) -> None:
        self.page, self._folder, self._pictures = page, folder, pictures

    def run(self, args: argparse.Namespace) -> dict[str, Any]:
        """Close the loop; what the page said on the way."""
        page = self.page
        page.wait_for_selector('.instrument[data-poses]:not([data-poses="0"])')
        page.wait_for_timeout(1e3 * FIGURES_S)
        self._picture('before')
        found: dict[str, Any] = {'poses_hz': self._rate(), 'header': self._header()}
        return found if args.look else found | self._loop(args)

    def _header(self) -> dict[str, str]:
        figures = [f.inner_text().split('\n') for f in self.page.locator('.bar .figure').all()]
        return {label: value for value, label in figures}

    def _loop(self, args: argparse.Namespace) -> dict[str, Any]:
        page, found = self.page, {}
        if args.calibrate:
            self._click('Set baseline')
            said = page.locator('.words').filter(
                has_text=re.compile(r'\w'), has_not_text='active: '
            )
            found['baseline'] = said.first.inner_text()
        self._click('Record')
        page.wait_for_timeout(1e3 * args.record)
        self._click('Stop')
        began_s = time.monotonic()
        self._command('Calibrate' if args.calibrate else 'Diagnose')
        found['command_s'] = round(time.monotonic() - began_s, 1)
        found['verdict'] = page.locator('.verdict').inner_text()
        with page.expect_popup() as opened:
            self._click('Report')
        opened.value.wait_for_load_state()
        found['report'] = opened.value.locator('body').inner_text()[:60].replace('\n', ' ')
        opened.value.close()
        self._click('Load corrected model')
        page.get_by_text('the new model is active').wait_for()
        found['tracked_again_s'] = self._tracked_again_s()
        page.wait_for_timeout(1e3 * FIGURES_S)
        found['tables'] = self._tables()
        self._picture('')
        self._click('Undo')
        page.get_by_text('the previous model is active again').wait_for()
        found['tracked_again_after_undo_s'] = self._tracked_again_s()
        found['after_undo'] = page.locator('.bar .pill').inner_text()
        live = found['tables']['live, last 10 s']
        found['closed'] = _fell(live['tracked frames, %'][::-1]) or _fell(live['error, mm rms'])
        if args.calibrate:
            found['closed'] &= found['baseline'].startswith('baseline of')
        return found

    def _tracked_again_s(self) -> float:
        """Return how long no pose is given while the refit to another model is made, s."""
        began_s = time.monotonic()
        self.page.wait_for_timeout(2e3)  # the page shows the last two seconds
        pill = self.page.locator('.bar .pill')
        pill.filter(has_text=re.compile('^[1-9]')).wait_for(timeout=3e4)
        return round(time.monotonic() - began_s, 1)

    def _click(self, name: str) -> None:
        self.page.get_by_role('button', name=name, exact=True).click()

    def _command(self, name: str) -> None:
        self._click(name)
        done = self.page.get_by_text(re.compile(rf'{name.lower()} \S+: done in'))
        done.or_(self.page.locator('.words.trouble')).first.wait_for()
        if not done.count():
            raise RuntimeError(self.page.locator('.words.trouble').inner_text())

    def _rate(self, seconds: float = 5.0) -> float:
        instrument = self.page.locator('.instrument')
        begin, begin_s = int(instrument.get_attribute('data-frames')), time.monotonic()
        self.page.wait_for_timeout(1e3 * seconds)
        shown = int(instrument.get_attribute('data-frames')) - begin
        return round(shown / (time.monotonic() - begin_s), 2)

    def _tables(self) -> dict[str, dict[str, list[str]]]:
        tables = {}
        for table in self.page.locator('table.compare').all():
            rows = [row.locator('th, td').all_inner_texts() for row in table.locator('tr').all()]
            tables[rows[0][0]] = {label: values for label, *values in rows[1:]}
        return tables

    def _picture(self, ending: str) -> None:
        if self._pictures is None:
            return
        self._pictures.mkdir(parents=True, exist_ok=True)
        for name, (width, height) in SIZES.items():
            self.page.set_viewport_size({'width': width, 'height': height})
            self.page.wait_for_timeout(1.5e3)
            path = self._pictures / '_'.join(filter(None, (name, ending)))
            self.page.screenshot(path=f'{path}.png')
        width, height = SIZES['dashboard']
        self.page.set_viewport_size({'width': width, 'height': height})


def _fell(pair: list[str]) -> bool:
    try:
        before, after = map(float, pair)
    except ValueError:
        return False
    return after < before


def _processor(chain: dict[str, Child], page: Any, seconds: float) -> dict[str, float]:
    """Shares of one processor: of the live view with a page and without, of the chain beside it
    and alone."""
    view, live = (chain[name].process.pid for name in ('dashboard', 'live'))
    shares = {'page_open': _share(view, seconds), 'chain_with_page': _share(live, seconds)}
    page.goto('about:blank')
    time.sleep(8.0)  # the server waits for a page to come back
    shares |= {'no_page': _share(view, seconds)}
    chain['dashboard'].process.terminate()
    chain['dashboard'].process.wait()
    return shares | {'chain_alone': _share(live, seconds)}


def _share(pid: int, seconds: float) -> float:
    begin, begin_s = _ticks(pid), time.monotonic()
    time.sleep(seconds)
    used_s = (_ticks(pid) - begin) / os.sysconf('SC_CLK_TCK')
    return round(used_s / (time.monotonic() - begin_s), 4)


def _ticks(pid: int) -> int:
    fields = Path(f'/proc/{pid}/stat').read_text(encoding='ascii').rpartition(')')[2].split()
    return int(fields[11]) + int(fields[12])


if __name__ == '__main__':
    sys.exit(main())
