"""What the server sends is read by the compiled OpenIGTLink library, where that is installed."""

import shutil
import subprocess
import threading
from pathlib import Path

import pytest

from anser_ros.apps.slicer import igtl
from anser_ros.apps.slicer.nodes.openigtlink import IgtlServer

HEADERS = Path('/usr/include/openigtlink')
HALF = 0.5**0.5


@pytest.fixture(scope='module')
def client(tmp_path_factory):
    """The client, compiled, as a path."""
    compiler = shutil.which('g++')
    if compiler is None or not HEADERS.is_dir():
        pytest.skip('no g++ or no headers (apt install g++ libopenigtlink-dev)')
    path = tmp_path_factory.mktemp('igtl') / 'client'
    source = Path(__file__).with_name('client.cpp')
    command = [compiler, '-w', f'-I{HEADERS}', str(source), '-o', str(path), '-lOpenIGTLink']
    done = subprocess.run([*command, '-lpthread'], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return path


@pytest.mark.long
@pytest.mark.processes
def test_the_library_reads_poses_states_and_replies(client):
    def answer(header):
        if header.kind == 'GET_CAPABIL':
            return igtl.capability(1.0)
        return igtl.tracking_reply(2.0)

    place, turn = (0.1, -0.02, 0.2), (0.0, 0.0, HALF, HALF)  # a quarter turn about z
    told = [
        igtl.transform('penToTracker', 1_750_000_000.25, place, turn, 1),
        igtl.string('pen/state', 3.5, 'stale'),
        igtl.status('pen', 4.5, 13, 'residual', '4.2 times what is expected'),
    ]
    server = IgtlServer('127.0.0.1', 0, answer)
    done = threading.Event()

    def serve():
        now_s = 0.0
        while not done.wait(0.05):
            now_s += 0.05
            for one in told:
                server.send(one, one)
            server.send_tracking(igtl.tracking(5.0, [igtl.Tracked('pen', place, turn)]), now_s)

    sender = threading.Thread(target=serve)
    sender.start()
    try:
        command = [str(client), str(server.port), '40']
        read = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    finally:
        done.set()
        sender.join()
        server.close()
    assert read.returncode == 0, read.stdout + read.stderr
    lines = set(read.stdout.splitlines())
    matrix = '0.0000 -1.0000 0.0000 100.0000 1.0000 0.0000 0.0000 -20.0000 0.0000 0.0000 1.0000 '
    matrix += '200.0000'
    assert {line.replace('-0.0000', '0.0000') for line in lines} == {
        f'TRANSFORM penToTracker 1750000000.250 matrix {matrix}',
        'STRING pen/state 3.500 stale',
        'STATUS pen 4.500 13 residual 4.2 times what is expected',
        f'CAPABILITY  1.000 {" ".join(igtl.CAPABILITIES)}',
        'RTS_TDATA  2.000 0',
        f'TDATA  5.000 pen {matrix}',
    }
