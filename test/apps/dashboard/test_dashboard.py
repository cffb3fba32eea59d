"""The live view: who may look, what it may touch, the loop, and the page in a browser."""

import argparse
import asyncio
import json
import math
import socket
import threading
from dataclasses import replace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from chromium import BROWSER_OPTIONS
from conftest import wait
from dashboard_world import OFF_M, SENSORS, PretendedChain, browser_path, ten_sensors
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import serialize_message
from tracking_world import certain_model

from anser_ros.apps.dashboard import loop as loop_module
from anser_ros.apps.dashboard.cli import demo
from anser_ros.apps.dashboard.loop import RESULTS, CorrectionLoop, Found, Job, RecordingFolder
from anser_ros.apps.dashboard.nodes import live_view
from anser_ros.apps.dashboard.nodes.dashboard import (
    ChainClient,
    ChainError,
    Dashboard,
    DashboardParameters,
)
from anser_ros.apps.dashboard.nodes.live_view import LiveView, read_pose
from anser_ros.apps.dashboard.nodes.traces import latency_of
from anser_ros.apps.dashboard.nodes.view_source import ViewSource, polling_node
from anser_ros.apps.dashboard.server import (
    COOKIE,
    LEAST_TOKEN,
    MOST_PAGES,
    Guard,
    PageServer,
    token_for,
)
from anser_ros.cli.main import main
from anser_ros.errors import BagError, ParameterError
from anser_ros.nodes.field_model import FieldModelNode
from anser_ros.nodes.operator_words import LastStatus
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.diagnostics import Level, Status, diagnostic_array
from anser_ros.sessions.nominal_board import tracked_volume
from anser_ros.sessions.starting_model import save_model
from anser_ros.wire.setup import dump_setup, parse_setup

pytest.importorskip('nicegui', reason='nicegui is not installed')
TOKEN = 'a-token-of-enough-letters'


def asked(guard, path='/', kind='http', query='', **headers):
    """Ask a guard; return the first thing that it sends, or ``passed``."""
    sent = []
    scope = {
        'type': kind, 'path': path, 'query_string': query.encode(),
        'headers': [(k.encode(), v.encode()) for k, v in {'host': 'localhost', **headers}.items()],
    }  # fmt: skip

    async def receive():
        return {'type': 'websocket.connect'}

    async def send(message):
        sent.append(message)

    asyncio.run(guard(scope, receive, send))
    return sent[0]


async def inner(_scope, _receive, send):
    await send('passed')


@pytest.mark.parametrize('stated', [None, ((-0.1, -0.12, 0.06), (0.1, 0.1, 0.3))])
def test_the_drawn_volume_is_that_in_which_poses_are_accepted(ros, stated):
    owner = ros.create_node('owner', namespace='/anser')
    owner.qos_overrides = []
    node = polling_node(owner)
    owner.destroy_node()
    source = ViewSource(node, 'optical', pytest.fail, lambda _: False)
    setup = replace(parse_setup(ten_sensors()), volume=stated)
    source.setup_text = dump_setup(setup)
    source.look()
    volume = tracked_volume(setup)
    assert source.world()['volume_m'] == [list(volume.low), list(volume.high)]
    assert source.status()['findings'] == [(1, 'no watcher runs')]
    words = 'place 1 is taken; place 2 of 49 is next'  # the guide through a plate is read here too
    said = diagnostic_array('anser/grid', [Status('', Level.OK, words)], Time())
    node.create_publisher(DiagnosticArray, '/diagnostics', qos.EVENTS).publish(said)
    assert wait(lambda: source.look() or source.status()['findings'] == [(0, words)])
    node.destroy_node()


@pytest.mark.parametrize('kind', ['http', 'websocket'])
def test_the_guard_knows_this_machine_and_the_token(kind):
    local, far = Guard(inner, ''), Guard(inner, TOKEN)
    for host in ('localhost:8642', '127.0.0.1:1', '[::1]:8642'):
        assert asked(local, kind=kind, host=host, origin=f'http://{host}') == 'passed'
    refused = [
        asked(local, kind=kind, host='elsewhere.example:8642'),  # a name that leads here
        asked(local, kind=kind, origin='http://elsewhere.example'),
        asked(far, kind=kind, host='board.lab'),
        asked(far, kind=kind, query='token=wrong'),
        asked(far, kind=kind, cookie=f'{COOKIE}=wrong'),
        asked(far, kind=kind, cookie=f'{COOKIE}={TOKEN}', origin='http://elsewhere.example'),
    ]
    codes = [m.get('status', m.get('code')) for m in refused]
    assert codes == ([403, 403, 401, 401, 401, 403] if kind == 'http' else [1008] * 6)
    assert asked(far, kind=kind, host='board.lab', cookie=f'{COOKIE}={TOKEN}') == 'passed'


def test_the_guard_takes_the_token_out_of_the_address_and_bounds_the_pages():
    answer = asked(Guard(inner, TOKEN), query=f'token={TOKEN}')
    headers = dict(answer['headers'])
    assert (answer['status'], headers[b'location']) == (303, b'/')
    assert headers[b'set-cookie'].decode().startswith(f'{COOKIE}={TOKEN}; HttpOnly')
    guard = Guard(inner, '')
    assert asked(guard, query='EIO=4&transport=polling')['status'] == 403
    guard.pages = MOST_PAGES
    assert asked(guard)['status'] == 503
    assert asked(guard, kind='websocket')['code'] == 1013
    assert asked(guard, path='/_nicegui/file.js') == 'passed', 'for the pages that are open'


def test_other_machines_need_a_token(tmp_path):
    assert token_for('127.0.0.1', '') == ''
    assert len({token_for('0.0.0.0', '') for _ in range(3)}) == 3
    assert len(token_for('0.0.0.0', '')) >= LEAST_TOKEN
    file = tmp_path / 'token'
    file.write_text(f'{TOKEN}\n')
    assert token_for('127.0.0.1', str(file)) == TOKEN
    file.write_text('short')
    for path in (file, tmp_path / 'nowhere'):
        with pytest.raises(ParameterError, match='token_file'):
            token_for('0.0.0.0', str(path))


def test_the_address_for_other_machines_has_the_name_of_this_one(tmp_path):
    server = PageServer('0.0.0.0', 0, TOKEN, RecordingFolder(tmp_path))
    server.end()
    assert server.url == f'http://{socket.gethostname()}:{server.port}/?token={TOKEN}'
    with pytest.raises(ParameterError, match=r'203\.0\.113\.7:8642'):
        PageServer('203.0.113.7', 8642, TOKEN, RecordingFolder(tmp_path))


def test_what_is_missing_is_said_in_a_line(monkeypatch, capsys):
    monkeypatch.setattr('anser_ros.cli.main.find_spec', lambda name: name != 'nicegui')
    assert main(['dashboard']) == 2
    said = capsys.readouterr().err
    assert said == 'anser dashboard: nicegui is not installed: pip install nicegui\n'


def test_the_demo_serves_it_if_asked_to(tmp_path):
    parser = argparse.ArgumentParser()
    demo.add_arguments(parser)
    for words, served in (([], False), (['--dashboard'], True)):
        args = parser.parse_args(words)
        commands = dict(demo._commands(tmp_path, tmp_path / 'cu', args))
        assert ('dashboard' in commands) == served
    assert Dashboard.__module__ in commands['dashboard']
    assert f'directory:={tmp_path}' in commands['dashboard']
    assert DashboardParameters.port == demo.LIVE_VIEW


def bag(path):
    path.mkdir(parents=True)
    (path / 'a_0.mcap').write_bytes(b'')


def test_no_name_leads_out_of_the_folder(tmp_path):
    folder = RecordingFolder(tmp_path / 'bags')
    assert folder.recordings() == []
    bag(tmp_path / 'bags' / 'one')
    bag(tmp_path / 'secret')
    (tmp_path / 'bags' / 'link').symlink_to(tmp_path / 'secret')
    assert folder.recordings() == ['one']
    assert folder.recording('one') == tmp_path / 'bags' / 'one'
    for name in ('../secret', 'link', '', '.', '..', str(tmp_path / 'secret'), 'two'):
        with pytest.raises(BagError, match='holds no recording'):
            folder.recording(name)
    first, second = (folder.new_result('diagnose', 'one') for _ in range(2))
    assert first.name != second.name
    (first / 'report.html').write_text('<p>')
    (first / 'other.txt').write_text('')
    (first / 'choice.png').symlink_to('/etc/hostname')
    (tmp_path / 'bags' / 'report.html').write_text('')
    assert folder.shown(first.name, 'report.html') == first / 'report.html'
    for result, name in (
        (first.name, 'other.txt'), (first.name, 'choice.png'), ('..', 'report.html'),
        (f'../{RESULTS}/{first.name}', 'report.html'), (first.name, '../report.html'),
    ):  # fmt: skip
        assert folder.shown(result, name) is None


def test_progress_is_read_from_what_a_command_says(tmp_path):
    job = Job('calibrate', [], tmp_path)
    job.take_line('calibrating: layouts, 43%, about 5 s left')
    assert (job.share, job.stage) == (0.43, 'layouts, 43%, about 5 s left')
    job.take_line('diagnosing: search, after 12 s')
    assert math.isnan(job.share)
    assert job.stage == 'search, after 12 s'


@pytest.mark.processes
def test_a_job_tells_why_it_failed_and_can_be_ended(tmp_path):
    job = Job('calibrate', [str(tmp_path / 'nowhere'), '--out', str(tmp_path / 'm')], tmp_path)
    asyncio.run(job.run())
    assert job.exit_code == 2
    assert job.failure.startswith('anser calibrate: ')
    ended = Job('warm_up', [], tmp_path)

    async def cancelled():
        task = asyncio.create_task(ended.run())
        await asyncio.sleep(0.2)
        ended.cancel()
        await asyncio.wait_for(task, 60.0)

    asyncio.run(cancelled())
    assert ended.failure == 'warm_up was cancelled'


class FakeChain:
    """Nodes that do what they are asked, or refuse."""

    def __init__(self):
        self.files = {'field_model': 'nominal', 'tracker': ''}
        self.refuses = ''
        self.asked, self.marks, self.tracked = [], [], 100.0

    async def trigger(self, service):
        self.asked.append(service)
        if self.refuses == service:
            raise ParameterError('refused, here')
        return f'{service}: bags/one'

    async def model_files(self):
        return dict(self.files)

    async def load_model(self, files):
        for name, path in files.items():
            if self.refuses == name and path:
                raise ParameterError(f'{name}: not a model')
            self.files[name] = path

    async def baseline_file(self):
        return 'clean.mcap'

    def figures(self, since_s):
        return {'tracked_percent': 50.0 if since_s == 0.0 else self.tracked, 'error_mm': None}

    def mark(self, words):
        self.marks.append(words)


DIAGNOSIS = {
    'held_out': {
        'flux_rms_before_t': 5e-9, 'flux_rms_after_t': 1e-10, 'flux_rms_floor_t': 1e-10,
        'position_rmse_before_m': 4e-3, 'position_rmse_after_m': 2e-4,
        'orientation_rmse_before_rad': None, 'orientation_rmse_after_rad': None,
    },
    'effects': [{'name': 'sensor_gain', 'parameters': {'channel': 3, 'gain': 1.1}}],
    'unexplained': {'fraction': 0.0, 'depends_on': []},
}  # fmt: skip


STATUS = {'recorder': True, 'field_model': False, 'recording': ''}


def test_buttons_say_why_they_cannot_be_used(tmp_path):
    chain = FakeChain()
    loop = CorrectionLoop(chain, chain, RecordingFolder(tmp_path))
    assert loop.obstacles(STATUS) == {
        'record': '', 'stop': 'nothing is recorded', 'baseline': 'no field_model runs',
        'calibrate': 'there is no recording yet', 'diagnose': 'there is no recording yet',
        'report': 'nothing was calibrated or diagnosed yet',
        'load': 'there is no model to load yet', 'undo': 'no model was loaded from this page',
    }  # fmt: skip
    running = loop.obstacles(STATUS | {'recorder': True, 'recording': 'one 3 s'})
    assert (running['record'], running['stop']) == ('it records already', '')
    assert loop.obstacles(STATUS | {'recorder': False})['record'] == 'no recorder runs'


@pytest.mark.parametrize(
    'parameters', [{'t_start_s': 3.0, 't_end_s': 5.0}, {'path': {'time_s': [0.0]}}]
)
def test_what_belongs_to_a_time_is_no_correction(tmp_path, parameters):
    """Metal that came and went: a model with it would withhold the poses of every other time."""
    effects = [*DIAGNOSIS['effects'], {'name': 'moving_metal', 'parameters': parameters}]
    chain = FakeChain()
    loop = CorrectionLoop(chain, chain, RecordingFolder(tmp_path))
    passing = loop_module._passing(DIAGNOSIS | {'effects': effects})
    loop.found = Found('diagnose', 'one', tmp_path, '', (), passing)
    words = 'moving_metal belongs to the time of that recording and corrects no other'
    assert loop.obstacles(STATUS)['load'] == words
    asyncio.run(loop.load())
    assert (loop.message, loop.is_trouble) == (words, True)
    assert set(chain.files.values()) == {'nominal', ''}, 'nothing was loaded'
    loop.found = loop.found._replace(passing=loop_module._passing(DIAGNOSIS))
    assert not loop.obstacles(STATUS)['load']


def test_the_loop_from_recording_to_undo(tmp_path, monkeypatch):
    class Instant(Job):
        async def run(self):
            (self.folder / 'diagnosis.json').write_text(json.dumps(DIAGNOSIS))
            self.exit_code = 0

    monkeypatch.setattr(loop_module, 'Job', Instant)
    chain = FakeChain()
    loop = CorrectionLoop(chain, chain, RecordingFolder(tmp_path))

    async def closed():
        await loop.diagnose()
        assert loop.is_trouble, 'there is no recording yet'
        await loop.load()
        assert loop.is_trouble, 'and no model'
        await loop.record()
        bag(tmp_path / 'one')
        await loop.stop()
        assert loop.chosen == 'one'
        await loop.diagnose()
        assert loop.job._arguments == [
            str(tmp_path / 'one'), '--model', 'nominal', '--baseline', 'clean.mcap',
            '--out', str(loop.job.folder), '--json',
        ]  # fmt: skip
        async with asyncio.timeout(60.0):
            while loop.found is None:
                await asyncio.sleep(0.01)
        assert 'sensor_gain (channel 3, gain 1.1)' in loop.found.words
        assert loop.found.rows[0] == ('residual, pT', '5000', '100')
        assert loop.found.rows[1] == ('position error, mm', '4.00', '0.20')
        assert loop.found.rows[2][1:] == ('–', '–')
        assert loop.comparison() == []
        chain.refuses = 'tracker'
        await loop.load()
        assert (loop.message, loop.is_trouble) == ('tracker: not a model', True)
        assert chain.files == {'field_model': 'nominal', 'tracker': ''}, 'all or none'
        chain.refuses = ''
        await loop.load()
        assert set(chain.files.values()) == {str(loop.found.model)}
        assert loop.obstacles(STATUS)['load'] == 'this model is active'
        assert loop.message.endswith('poses pause until all nodes have taken it')
        assert loop.warning == '', 'more is tracked than before'
        chain.tracked = 12.0
        assert loop.warning == 'tracked frames fell from 50 to 12 % with this model: Undo?'
        chain.tracked = 100.0
        assert loop.comparison()[0] == ('tracked frames, %', '50', '100')
        await loop.undo()
        assert chain.files == {'field_model': 'nominal', 'tracker': ''}
        assert chain.marks == ['model loaded', 'undone']
        assert not loop.obstacles(STATUS)['load'] and loop.warning == ''
        assert loop.obstacles(STATUS)['undo'] == 'no model was loaded from this page'

    asyncio.run(closed())
    assert chain.asked == ['recorder/start', 'recorder/stop']


def pose(stamp_s, place, sigma_m=0.0, frame='left_fg'):
    message = PoseWithCovarianceStamped() if sigma_m else PoseStamped()
    message.header.frame_id = frame
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(round(1e9 * stamp_s), 10**9)
    at = (message.pose.pose if sigma_m else message.pose).position
    at.x, at.y, at.z = place
    if sigma_m:
        message.pose.covariance = np.diag([sigma_m**2, 0, 0, 1, 1, 1]).astype(float).ravel()
    return bytes(serialize_message(message)), {}


def test_poses_are_read_from_their_bytes():
    for frame in ('', 'f', 'fg', 'left_fg', 'right_fg'):  # lengths that need padding, and do not
        data, _ = pose(12.5, (0.0, 3.0, 0.0), frame=frame)
        stamp_s, values = read_pose(data)
        assert (stamp_s, values.tolist()) == (12.5, [0, 3, 0, 0, 0, 0, 1])
        with pytest.raises(ValueError, match='not a pose'):
            read_pose(data[:-8])
    assert latency_of(1.75e9, 1.75e9 - 0.02) == pytest.approx(0.02, abs=1e-6)
    assert math.isnan(latency_of(1.75e9, 1e9)), 'a replayed one has no latency'


def test_the_view_has_place_ellipsoid_error_and_residual(monkeypatch):
    monkeypatch.setattr(live_view, 'FRESH_S', math.inf)
    view = LiveView(parse_setup(ten_sensors()), 'anser')
    assert view.frame() == [None] * 11
    view.take_optical('pen', [pose(t, (0.1, 0.0, 0.2)) for t in (1.0, 1.02, 1.04)])
    view.take_pose(2, [pose(1.01, (9.0, 9.0, 9.0), 1.0), pose(1.03, (0.1, OFF_M, 0.22), 1e-3)])
    told = LastStatus(0, 'ok', {'residual_t': '2e-10', 'rate_hz': '25', 'frame_rate_hz': '50'})
    view.statuses['anser/tracker: pen/c2'] = told
    view.add_point()
    row = view.frame()[2]
    assert row[:7] == [0.1, OFF_M, 0.22, 0, 0, 0, 1]
    axes = np.array(row[7:]).reshape(3, 3)
    assert np.abs(axes).sum(0).tolist() == [3e-3, 0, 0], 'three sigma along x'
    assert view.rate_hz[2] > 0
    assert view.error_m[2] == pytest.approx(OFF_M), 'of the pose shown, coil 2 is 20 mm up the pen'
    assert np.isnan(np.delete(view.error_m, 2)).all()
    figures = view.figures()
    assert figures['tracked_percent'] == 50.0
    assert figures['error_mm'] == pytest.approx(1e3 * OFF_M)
    assert figures['residual_pt'] == 200.0
    assert view.points[-1][2][2] == 2e-10


def test_the_nodes_are_asked_for_services_and_models(ros, tmp_path):
    server, asker = FieldModelNode(), ros.create_node('asker', namespace='anser')
    client = ChainClient(asker)
    executor = SingleThreadedExecutor()
    for node in (server, asker):
        executor.add_node(node)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    save_model(tmp_path / 'model.yaml', certain_model())
    files = {'field_model': str(tmp_path / 'model.yaml')}

    async def asked_for():
        async with asyncio.timeout(60.0):
            while not (client.is_there('field_model/set_baseline') and await client.model_files()):
                await asyncio.sleep(0.05)
        assert await client.model_files() == {'field_model': 'nominal'}
        assert await client.baseline_file() == ''
        with pytest.raises(ChainError, match='no setup yet'):
            await client.trigger('field_model/set_baseline')
        with pytest.raises(ChainError, match='no node offers'):
            await client.trigger('recorder/start')
        with pytest.raises(ChainError, match=r'field_model: .*nowhere'):
            await client.load_model({'field_model': str(tmp_path / 'nowhere.yaml')})
        await client.load_model(files)
        assert await client.model_files() == files

    try:
        asyncio.run(asked_for())
    finally:
        executor.shutdown()
        thread.join(5.0)
        for node in (server, asker):
            node.destroy_node()


@pytest.fixture
def page(ros, start, tmp_path):
    """An open page of a live view, and the chain that it shows."""
    executable = browser_path()
    from playwright.sync_api import sync_playwright

    dashboard = start(
        'dashboard', '--ros-args', '-p', 'port:=0', '-p', f'directory:={tmp_path / "bags"}'
    )
    chain = PretendedChain(ros)
    dashboard.wait_for('live view: ')
    address = dashboard.output.split('live view: ')[1].split()[0]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, args=BROWSER_OPTIONS)
        opened = browser.new_page(viewport={'width': 1280, 'height': 800})
        opened.asked, opened.errors = [], []
        opened.on('request', lambda request: opened.asked.append(request.url))
        opened.on('pageerror', lambda error: opened.errors.append(str(error)))
        opened.goto(address)
        yield opened, chain, address
        browser.close()
    chain.end()
    assert dashboard.interrupt() == 0


SIZES = """() => {
  const of = (e) => { const b = e.getBoundingClientRect(); return [b.width, b.height]; };
  return {
    boxes: [...document.querySelectorAll('.scene, .chart')].map(
      (e) => [of(e), of(e.querySelector('canvas'))]),
    width: innerWidth, inside: document.documentElement.scrollWidth };
}"""
"""What the browser says of the sizes of scene and curves, and of the whole page."""


def is_laid_out(sizes):
    """Whether the scene fills its box, the curves are seen, and nothing is beside the window."""
    (scene, canvas), *curves = sizes['boxes']
    fills = np.allclose(scene, canvas, atol=3.0) and min(scene) > 200.0
    are_seen = len(curves) == 2 and all(min(curve[0]) > 100.0 for curve in curves)
    return fills and are_seen and sizes['inside'] <= sizes['width']


def test_it_opens_offline_and_shows_ten_sensors(page):
    opened, chain, address = page
    instrument = opened.locator('.instrument')
    opened.wait_for_selector(f'.instrument[data-poses="{SENSORS + 1}"]', timeout=60_000)
    begin = int(instrument.get_attribute('data-frames'))
    assert wait(lambda: int(instrument.get_attribute('data-frames')) > begin + 10)
    own = tuple(prefix + address.split('/')[2] for prefix in ('http://', 'ws://'))
    foreign = [url for url in opened.asked if not url.startswith((*own, 'data:', 'blob:'))]
    assert not foreign
    assert not opened.errors

    rows = opened.locator('.states tbody tr')
    assert rows.count() == SENSORS + 1
    bad, good = (rows.nth(n).locator('td').all_text_contents() for n in (0, 1))
    assert bad[:2] == ['pen/c0', 'residual4.2 times'], 'a state that is not ok, with its reason'
    assert good[:2] == ['pen/c1', 'ok']
    assert float(good[4]) == pytest.approx(162.0, abs=0.06), 'z, mm'
    assert float(good[5]) == pytest.approx(0.24, abs=0.01), 'sigma, mm'
    assert float(good[6]) == pytest.approx(2.0, abs=0.05), 'error to the optical pose, mm'
    assert float(good[7]) == pytest.approx(90.0, abs=0.6), 'residual, pT'
    assert float(good[8]) > 0.0, 'poses a second'
    assert 'something <b>new</b>' in opened.locator('.loop').inner_text(), 'as text, not as HTML'

    assert 'Record while the tool moves' in opened.locator('.loop').inner_text(), 'first use'
    assert opened.locator('button[title*="no model to load"]').is_disabled()
    opened.locator('.why').click()
    opened.locator('.why.open').wait_for()
    for width, height in ((1280, 800), (390, 844)):  # in two columns, in one
        opened.set_viewport_size({'width': width, 'height': height})
        assert wait(lambda: is_laid_out(opened.evaluate(SIZES)))

    opened.get_by_role('button', name='Record').click()
    opened.get_by_text('the disk is full').wait_for(timeout=60_000)
    assert chain.calls == ['recorder/start']
    assert opened.get_by_role('button', name='Load corrected model').is_disabled()
