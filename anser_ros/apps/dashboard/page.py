"""Lays the page out: header, what moves (`instrument.js`), and the loop with its buttons."""

import asyncio
import contextlib
import math
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any

from nicegui import app, ui
from nicegui.element import Element

from anser_ros.apps.dashboard.loop import CALIBRATE, PAUSE, CorrectionLoop
from anser_ros.apps.dashboard.nodes.view_source import ViewSource
from anser_ros.errors import AnserError

TICK_S = 1.0 / 12.0
"""Time between two pictures of the scene, s: poses at 10 Hz and more."""
POINT_TICKS = 6
"""Pictures between two points of the curves, and between two looks at everything else."""
LOOK_S = 2.0
"""Time between two looks at recordings and model, s: a folder of a thousand bags takes 25 ms."""
STYLE = Path(__file__).with_name('page.css').read_text(encoding='utf-8')
HINT = 'Record while the tool moves all over the volume for half a minute, stop, and diagnose.'
LEAST_SHARE = 0.05
"""Finished share of a command from which on its remaining time is told."""
LEVELS = ('ok', 'warn', 'bad', 'bad')
"""Classes of the levels of diagnostic_msgs."""
# Their libraries, three.js and ECharts, are what the instrument imports.
_LIBRARIES = (ui.scene, ui.echart)


class Instrument(Element, component='instrument.js'):
    """Draws scene, table and curves."""


class Screen:
    """Holds one page that is open in a browser."""

    def __init__(self, source: ViewSource, loop: CorrectionLoop) -> None:
        self._source, self._loop = source, loop
        self._client = ui.context.client
        self._version, self._is_ready = -1, False
        self._shown: dict[Callable[[Any], Any], Any] = {}
        ui.add_css(STYLE)
        ui.colors(primary='#1d4ed8')
        with ui.element('div').classes('bar'):
            ui.html('<b>anser_ros</b>', sanitize=False)
            self._place = ui.label().classes('space')
            self._pill = ui.label().classes('pill').mark('tracked')
            self._recording = ui.label().classes('recording').mark('recording')
            ui.element('div').classes('fill')
            self._figures = [_figure(label) for label in FIGURES]
        with ui.element('div').classes('chain'):
            self._nodes = ui.html(sanitize=False).classes('nodes')
            self._why = ui.html(sanitize=False).classes('why').mark('why')
            self._why.on('click', lambda: self._why.classes(toggle='open'))
        with ui.element('div').classes('desk'):
            self._instrument = Instrument().on('ready', self._ready)
            with ui.element('div').classes('panel loop'):
                self._build_loop()
        self.refresh()

    def _build_loop(self) -> None:
        loop = self._loop
        _heading('1  Record')
        with ui.element('div').classes('row'):
            record = _button('Record', loop.record, 'fiber_manual_record')
            stop = _button('Stop', loop.stop, 'stop')
            baseline = _button('Set baseline', loop.set_baseline, 'flag').tooltip(
                'No metal near: what the references read now is taken for undistorted'
            )
        _heading('2  Find what is wrong')
        with ui.element('div').classes('row'):
            self._pick = ui.select([], on_change=self._choose).props(
                'dense outlined options-dense'
            )
            self._pick.classes('pick').mark('recordings')
        with ui.element('div').classes('row').style('margin-top:6px'):
            calibrate = _button('Calibrate', loop.calibrate, 'tune').tooltip(
                'Fit a field model to this recording, which has optical poses'
            )
            diagnose = _button('Diagnose', loop.diagnose, 'search').tooltip(
                'Find what the active model lacks on this recording'
            )
            self._cancel = _button('Cancel', loop.cancel, 'close', flat=True)
        self._progress = ui.linear_progress(0.0, show_value=False).classes('progress')
        self._message = ui.label().classes('words').mark('said')
        self._verdict = ui.label().classes('verdict').mark('verdict')
        self._held_out = ui.html(sanitize=False).mark('held_out')
        _heading('3  Use it')
        with ui.element('div').classes('row'):
            report = _button('Report', self._open_report, 'description')
            load = _button('Load corrected model', loop.load, 'check').tooltip(PAUSE)
            undo = _button('Undo', loop.undo, 'undo')
        self._buttons = {
            'record': record, 'stop': stop, 'baseline': baseline, 'calibrate': calibrate,
            'diagnose': diagnose, 'report': report, 'load': load, 'undo': undo,
        }  # fmt: skip
        self._model = ui.label().classes('words path').mark('model')
        self._live = ui.html(sanitize=False).mark('live')
        _heading('Watcher')
        self._findings = ui.html(sanitize=False).mark('findings')

    # What is done -------------------------------------------------------------------------

    def _ready(self) -> None:
        self._is_ready, self._version = True, -1
        self.refresh()

    def _choose(self, event: Any) -> None:
        self._loop.chosen = event.value or ''

    async def _open_report(self) -> None:
        found = self._loop.found
        if found is not None:
            name = 'choice.png' if found.kind == CALIBRATE else 'report.html'
            ui.navigate.to(f'/results/{found.folder.name}/{name}', new_tab=True)

    # What is shown ------------------------------------------------------------------------

    @property
    def is_seen(self) -> bool:
        return bool(self._client.has_socket_connection)

    def show_frame(self, rows: list[Any]) -> None:
        if self.is_seen and self._is_ready and self._version == self._source.version:
            self._instrument.run_method('frame', rows)

    def refresh(self) -> None:
        """Show everything else again, as far as it has changed."""
        source = self._source
        if self._is_ready and self._version != source.version:
            world = source.world()
            if world is not None:
                self._version = source.version
                self._instrument.run_method('setup', world)
        elif self._is_ready:
            self._instrument.run_method('table', source.table(), source.metal)
            self._instrument.run_method('point', source.point())
            self._once(self._show_marks, source.marks())
        self._show_status(source.status())
        self._show_loop()

    def _once(self, show: Callable[[Any], Any], value: Any) -> None:
        """Show a value by a method where it is another than before: what stays costs nothing."""
        if self._shown.get(show, self) != value:
            self._shown[show] = value
            show(value)

    def _show_status(self, status: dict[str, Any]) -> None:
        self._once(self._place.set_text, status['place'])
        self._once(self._pill.set_text, status['tracked'])
        self._once(self._show_level, status['level'])
        self._once(
            self._recording.set_text, f'● {status["recording"]}' if status['recording'] else ''
        )
        for label, key in zip(self._figures, FIGURES.values(), strict=True):
            self._once(label.set_text, status[key])
        self._once(self._nodes.set_content, ''.join(
            f'<span class="dot {LEVELS[level]}" title="{escape(text)}">{escape(name)}</span>'
            for name, level, text in status['nodes']
        ))  # fmt: skip
        why = escape('  ·  '.join(status['why']))
        self._once(self._why.set_content, f'<span title="{why}">{why}</span>')
        self._once(self._findings.set_content, ''.join(
            f'<div class="finding dot {LEVELS[level]}">{escape(words)}</div>'
            for level, words in status['findings']
        ))  # fmt: skip
        self._once(self._show_obstacles, self._loop.obstacles(status))

    def _show_obstacles(self, obstacles: dict[str, str]) -> None:
        for name, why in obstacles.items():
            button = self._buttons[name]
            button.set_enabled(not why)
            button.props(f'title="{why.replace(chr(34), chr(39))}"')

    def _show_loop(self) -> None:
        loop, job, found = self._loop, self._loop.job, self._loop.found
        self._once(self._offer, (loop.names, loop.chosen))
        self._once(self._cancel.set_visibility, loop.is_running)
        self._once(self._progress.set_visibility, loop.is_running)
        message = loop.message or ('' if loop.names else HINT)
        if job is not None and loop.is_running:
            known = not math.isnan(job.share)
            self._once(self._show_share, job.share if known else -1.0)
            rest_s = job.seconds * (1.0 / job.share - 1.0) if job.share > LEAST_SHARE else 0.0
            left = f', about {rest_s:.0f} s left' if rest_s else ''
            message = f'{job.kind}: {job.stage or "begins"}, {job.seconds:.0f} s{left}'
        warning = '' if loop.is_running else loop.warning
        self._once(self._message.set_text, warning or message)
        self._once(self._show_trouble, bool(warning) or loop.is_trouble)
        self._once(self._verdict.set_text, '' if found is None else found.words)
        self._once(self._verdict.set_visibility, found is not None)
        self._once(
            self._held_out.set_content, '' if found is None else _table('held out', found.rows)
        )
        self._once(self._model.set_text, f'active: {loop.model_name}' if loop.model else '')
        self._once(self._live.set_content, _table('live, last 10 s', loop.comparison()))

    def _show_marks(self, marks: Any) -> None:
        self._instrument.run_method('marks', marks)

    def _show_level(self, level: int) -> None:
        self._pill.classes(remove='ok warn bad', add=LEVELS[level])

    def _show_trouble(self, is_trouble: bool) -> None:
        self._message.classes(**{'add' if is_trouble else 'remove': 'trouble'})

    def _show_share(self, share: float) -> None:
        self._progress.props(add='indeterminate' if share < 0 else '',
                             remove='' if share < 0 else 'indeterminate')  # fmt: skip
        self._progress.set_value(max(share, 0.0))

    def _offer(self, offered: tuple[tuple[str, ...], str]) -> None:
        names, chosen = offered
        self._pick.set_options(list(names), value=chosen if chosen in names else None)


FIGURES = {
    'poses a second': 'rate',
    'latency': 'latency',
    'processor': 'processor',
    'this view': 'own',
}
"""Figures of the header, and their keys in the source's status."""


def _figure(label: str) -> Any:
    with ui.element('div').classes('figure'):
        value = ui.label().classes('value')
        ui.label(label).classes('label')
    return value


def _heading(text: str) -> None:
    ui.html(f'<h2>{text}</h2>', sanitize=False)


def _button(text: str, action: Callable[[], Any], icon: str, flat: bool = False) -> Any:
    style = 'flat' if flat else 'outline'
    return ui.button(text, on_click=action, icon=icon).props(f'{style} dense no-caps')


def _table(title: str, rows: Any) -> str:
    if not rows:
        return ''
    body = ''.join(
        '<tr>' + ''.join(f'<td>{escape(cell)}</td>' for cell in row) + '</tr>' for row in rows
    )
    head = f'<tr><th>{escape(title)}</th><th>before</th><th>after</th></tr>'
    return f'<table class="compare">{head}{body}</table>'


class Pages:
    """Holds all open pages, and what drives them.

    ``guarded`` makes of a function one that outlives its errors, and reports them.
    """

    def __init__(
        self, source: ViewSource, loop: CorrectionLoop, guarded: Callable[[Any], Callable[[], Any]]
    ) -> None:
        self._source, self._loop = source, loop
        self._screens: dict[str, Screen] = {}
        self._ticks = 0
        self._tick = guarded(self._move)

    def register(self) -> None:

        @ui.page('/', title='anser_ros live view')
        def _page() -> None:
            client = ui.context.client
            self._screens[client.id] = Screen(self._source, self._loop)
            client.on_delete(lambda: self._screens.pop(client.id, None))

        app.on_startup(self._drive)
        app.on_startup(self._watch)

    @property
    def count(self) -> int:
        return len(self._screens)

    async def _drive(self) -> None:
        clock = asyncio.get_running_loop()
        due_s = clock.time()
        while True:
            self._tick()
            # What is late is left out, not made up for.
            due_s = max(due_s + TICK_S, clock.time())
            await asyncio.sleep(due_s - clock.time())

    async def _watch(self) -> None:
        """See now and then which recordings there are, and which model is active.

        Others may record and change models too.
        """
        while True:
            if self._screens:
                # A bag may be gone between two looks at it, as a node may.
                with contextlib.suppress(AnserError, OSError):
                    self._loop.refresh_names()
                    await self._loop.look()
            await asyncio.sleep(LOOK_S)

    def _move(self) -> None:
        """Look at the topics, and show on all pages what is due."""
        self._source.look()
        screens = list(self._screens.values())
        if self._ticks % POINT_TICKS == 0:
            self._source.add_point()
            for screen in filter(lambda screen: screen.is_seen, screens):
                screen.refresh()
        self._ticks += 1
        rows = self._source.frame() if screens else []
        for screen in screens:
            screen.show_frame(rows)
