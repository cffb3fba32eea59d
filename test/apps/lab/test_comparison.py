"""Two evaluations are compared by the frames that both have, and noise alone decides nothing."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from anser_ros.apps.lab.cli.compare import FEWEST_BLOCKS, compare, read_errors
from anser_ros.cli.main import main
from anser_ros.errors import ParameterError
from anser_ros.pose_states import OK
from anser_ros.sessions.tracked_session import ERRORS_FILE, Evaluation, PoseSeries, write_tables

STEP_NS = 40_000_000
FRAMES = 750


def errors(scale, seed=3, frames=FRAMES):
    rng = np.random.default_rng(seed)
    sizes = scale * np.abs(rng.normal(size=frames)) * 1e-3
    return {(1_000_000_000 + STEP_NS * i, 'a'): float(e) for i, e in enumerate(sizes)}


def test_a_clear_difference_has_an_interval_that_holds_it():
    rng = np.random.default_rng(1)
    found = compare(errors(2.0), errors(1.0, seed=4), rng)['a']
    assert found.verdict == 'b' and found.n == FRAMES
    assert found.low < -1e-3 < found.high, 'the true difference is -1 mm'
    back = compare(errors(1.0, seed=4), errors(2.0), rng)['a']
    assert back.verdict == 'a'


def test_noise_alone_is_seldom_called_a_difference():
    rng = np.random.default_rng(2)
    pairs = [(errors(1.0, seed=s), errors(1.0, seed=100 + s)) for s in range(40)]
    called = sum(compare(*pair, rng)['a'].verdict != 'neither' for pair in pairs)
    assert called <= 6, 'of 40, two are expected'


def test_frames_that_only_one_has_are_counted_and_not_compared():
    first, second = errors(1.0), errors(1.0)
    for key in list(first)[:10]:
        del first[key]
    for key in list(second)[-3:]:
        second.pop(key)
    worst = next(iter(second))
    second[worst] = 1.0  # not in the other: a metre that counts for nothing
    found = compare(first, second, np.random.default_rng(1))['a']
    assert (found.n, found.only_a, found.only_b) == (FRAMES - 13, 3, 10)
    assert found.a == found.b and found.verdict == 'neither'


def test_few_stretches_give_no_interval_and_other_sessions_are_refused():
    short = errors(1.0, frames=25 * (FEWEST_BLOCKS - 1))
    found = compare(short, short, np.random.default_rng(1))['a']
    assert np.isnan(found.low) and found.verdict == 'neither'
    with pytest.raises(ParameterError, match='of the same session'):
        compare(short, {(1, 'a'): 1.0}, np.random.default_rng(1), are_shares=True)


def test_a_side_without_a_pose_is_told_and_not_refused(tmp_path, capsys):
    some = errors(1.0)
    states = {'one': OK, 'none': 'residual'}
    folders = [written(tmp_path / name, some, state) for name, state in states.items()]
    found = compare(some, {}, np.random.default_rng(1))['a']
    assert (found.n, found.only_a, found.only_b) == (0, FRAMES, 0)
    assert found.verdict == 'neither'
    assert main(['compare', *folders, '--out', str(tmp_path / 'out')]) == 0
    out = capsys.readouterr().out
    assert 'position error: nothing to compare of 1' in out
    assert 'frames with a pose: first better for 1 of 1' in out
    assert f'Both have 0 poses with an error; {FRAMES - 1} only the first, 0 only the sec' in out
    document = json.loads((tmp_path / 'out' / 'comparison.json').read_text())
    assert document['position']['a']['rmse_b'] is None


def test_the_share_of_frames_with_a_pose_has_a_verdict_of_its_own():
    def states(share, seed):
        had = np.random.default_rng(seed).random(FRAMES) < share
        return {key: float(pose) for key, pose in zip(errors(1.0), had, strict=True)}

    rng = np.random.default_rng(1)
    found = compare(states(0.9, 5), states(0.6, 6), rng, are_shares=True)['a']
    assert found.verdict == 'a' and found.n == FRAMES
    assert found.low < -0.3 < found.high, 'the true difference is 30 %'
    assert compare(states(0.6, 6), states(0.9, 5), rng, are_shares=True)['a'].verdict == 'b'
    pairs = [(states(0.8, s), states(0.8, 100 + s)) for s in range(40)]
    called = sum(compare(*pair, rng, are_shares=True)['a'].verdict != 'neither' for pair in pairs)
    assert called <= 6, 'of 40, two are expected'


def evaluation_of(found, state=OK):
    estimates = tuple(
        SimpleNamespace(
            stamp_ns=stamp, state=state if rank % 50 else 'residual', position=np.zeros(3),
            axis=np.zeros(3), sigma_position_m=1e-4, residual_t=1e-9,
        )
        for rank, (stamp, _) in enumerate(found)
    )  # fmt: skip
    sizes = np.array(list(found.values()))
    sizes[5] = np.nan
    if state != OK:
        sizes[:] = np.nan
    return Evaluation({'a': PoseSeries('a', estimates, sizes, 2 * sizes)}, {})


def written(folder, found, state=OK):
    """Write the tables of an evaluation, and return their folder."""
    folder.mkdir()
    write_tables(folder, evaluation_of(found, state))
    return str(folder)


def test_the_command(tmp_path, capsys):
    scales = {'one': 2.0, 'two': 1.0}
    folders = [written(tmp_path / name, errors(scale)) for name, scale in scales.items()]
    read = read_errors(tmp_path / 'one')
    assert len(read['position']) == FRAMES - 1
    key = next(iter(read['position']))
    assert read['position'][key] == pytest.approx(errors(2.0)[key], rel=1e-8)
    assert main(['compare', *folders, '--out', str(tmp_path / 'out'), '--json']) == 0
    document = json.loads(capsys.readouterr().out)
    assert document == json.loads((tmp_path / 'out' / 'comparison.json').read_text())
    assert document['position']['a']['better'] == 'b'
    assert document['coverage']['a']['better'] == 'neither'
    assert document['coverage']['a']['share_a'] == pytest.approx(0.98)
    assert (tmp_path / 'out' / 'comparison.png').read_bytes()[:4] == b'\x89PNG'
    assert main(['compare', *folders]) == 0
    out = capsys.readouterr().out
    assert max(map(len, out.split('position error: ')[0].splitlines())) <= 80
    assert 'position error: second better for 1 of 1' in out
    assert 'frames with a pose: no difference of 1' in out
    assert main(['compare', folders[0], str(tmp_path)]) == 2
    assert 'is it a folder of anser evaluate?' in capsys.readouterr().err
    for folder, recording in zip(folders, ('1a', '2b'), strict=True):
        document = json.dumps({'recording': recording})
        (Path(folder) / 'evaluation.json').write_text(document, encoding='utf-8')
    assert main(['compare', *folders, '--out', str(tmp_path / 'none')]) == 2
    assert 'two different recordings (1a, 2b)' in capsys.readouterr().err
    assert not (tmp_path / 'none').exists()
    (Path(folders[1]) / 'evaluation.json').unlink()
    (tmp_path / 'two' / ERRORS_FILE).write_text('a,b\n1,2\n')
    assert main(['compare', *folders]) == 2
    assert 'columns must be' in capsys.readouterr().err
