"""Hostile and implausible inputs to commands: refused with 2, in one line, within seconds."""

from pathlib import Path

import numpy as np
from fault import Command
from faults_graph import bomb

from anser_ros.wire.bag import read_bag
from anser_ros.wire.bag_writer import SessionWriter
from anser_ros.wire.recorded import Bag
from anser_ros.wire.text_files import config_path

BAGS = Path(__file__).resolve().parents[2] / 'bags'


def _written(path: Path, bag: Bag, poses: object = None, scale: float = 1.0) -> Path:
    """Write a bag anew, with other poses or larger fluxes."""
    with SessionWriter(path) as writer:
        writer.write_setup(bag.setup_text, int(bag.tool.stamp_ns[0]))
        for stamp, flux in zip(bag.tool.stamp_ns.tolist(), bag.tool.flux, strict=True):
            writer.write_readings(bag.setup.tool_sensors, stamp, scale * flux)
        for body, stream in bag.optical.items():
            position, quaternion = stream.position, stream.quaternion
            if poses is not None:
                position, quaternion = poses(position, quaternion)
            rows = zip(stream.stamp_ns.tolist(), position, quaternion, strict=True)
            for stamp, place, turn in rows:
                writer.write_pose(f'/optical/{body}/pose', stamp, place, turn)
    return path


def _session(verb: str, poses: object = None, scale: float = 1.0) -> object:
    def make(folder: Path) -> list[object]:
        path = _written(folder / 'bag.mcap', read_bag(BAGS / 'moving.mcap'), poses, scale)
        model = [] if verb == 'calibrate' else ['--model', config_path('demo_model.yaml')]
        return [verb, path, *model, '--out', folder / 'out.yaml']

    return make


def _bytes(change: object) -> object:
    def make(folder: Path) -> list[object]:
        path = folder / 'bag.mcap'
        path.write_bytes(change((BAGS / 'moving.mcap').read_bytes()))
        return ['evaluate', path, '--model', config_path('demo_model.yaml'), '--out', folder / 'o']

    return make


def _model(text: object) -> object:
    def make(folder: Path) -> list[object]:
        path = folder / 'model.yaml'
        path.write_text(text(config_path('demo_model.yaml').read_text()))
        return ['evaluate', BAGS / 'moving.mcap', '--model', path, '--out', folder / 'o']

    return make


def _with_length(data: bytes) -> bytes:
    return data[:8] + b'\x06' + (2**62).to_bytes(8, 'little') + data[17:9000]


def _first(position: np.ndarray, quaternion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.tile(position[:1], (len(position), 1)), np.tile(quaternion[:1], (len(position), 1))


COMMANDS = (
    Command('diagnose-mm', 'diagnose with optics in mm',
            _session('diagnose', lambda p, q: (1e3 * p, q)), 'millimetres'),
    Command('evaluate-inches', 'evaluate with optics in inches',
            _session('evaluate', lambda p, q: (p / 0.0254, q)), 'inches'),
    Command('diagnose-w-first', 'diagnose with quaternions w first',
            _session('diagnose', lambda p, q: (p, q[:, [3, 0, 1, 2]])), 'w first'),
    Command('calibrate-w-first', 'calibrate with quaternions w first',
            _session('calibrate', lambda p, q: (p, q[:, [3, 0, 1, 2]])), 'w first'),
    Command('diagnose-identical', 'diagnose with all poses identical',
            _session('diagnose', _first), 'same'),
    Command('evaluate-microtesla', 'evaluate with fluxes in microtesla',
            _session('evaluate', None, 1e6), 'microtesla'),
    Command('bag-empty', 'an empty bag', _bytes(lambda b: b''), 'empty'),
    Command('bag-random', 'a bag of random bytes behind its magic', _bytes(
        lambda b: b[:8] + np.random.default_rng(1).bytes(200_000)), 'message'),
    Command('bag-length', 'a bag that declares a record of 2^62 bytes',
            _bytes(_with_length), 'read'),
    Command('model-bomb', 'a model file of aliases of aliases',
            _model(lambda _: bomb()), 'aliases'),
    Command('model-deep', 'a model file of 10^5 brackets', _model(lambda _: '[' * 100_000),
            'model.yaml'),
    Command('model-tag', 'a model file with a python tag', _model(
        lambda _: '!!python/object/apply:os.system ["true"]'), 'model.yaml'),
    Command('model-nan', 'a model file with NaN', _model(
        lambda text: text.replace('- - ', '- - .nan #', 1)), 'model.yaml'),
    Command('model-cut', 'half a model file', _model(lambda text: text[: len(text) // 2]),
            'model.yaml'),
)  # fmt: skip
"""Each has to end with 2 and a line that has the word."""
