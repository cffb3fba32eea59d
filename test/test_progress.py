"""How far a command is, where there is no terminal: few lines, with a share and a time."""

import pytest

from anser_ros.cli import output
from anser_ros.cli.output import LINE_INTERVAL_S, progress_of


@pytest.fixture
def now_s(monkeypatch):
    """The time by the clock, s, in a list."""
    now = [100.0]
    monkeypatch.setattr(output.time, 'monotonic', lambda: now[0])
    return now


def test_lines_come_now_and_then_with_the_share_and_the_time_that_is_left(now_s, capsys):
    with progress_of('calibrating') as tell:
        for step in range(1, 11):
            now_s[0] += 0.4 * LINE_INTERVAL_S
            tell('layouts' if step < 7 else 'positions', 0.1 * step)
    said = capsys.readouterr().err.splitlines()
    assert said[0] == 'calibrating: layouts, 30%, about 14 s left'
    stages = [line.split(',')[0].removeprefix('calibrating: ') for line in said]
    assert stages == ['layouts', 'layouts', 'positions']


def test_no_time_is_told_that_loading_and_compiling_would_make(now_s, capsys):
    """The first frame of a session takes as long as the kernels need to be there."""
    with progress_of('evaluating') as tell:
        now_s[0] += 25.0
        for frame in range(1, 201):
            tell('tracking', frame / 200)
            now_s[0] += 0.1
    said = capsys.readouterr().err.splitlines()
    assert said[0] == 'evaluating: tracking, 0%'
    left = [float(line.split('about ')[1].split(' s')[0]) for line in said[1:]]
    assert len(left) > 2
    assert all(abs(had + 5.0 * rank - left[0]) < 1.5 for rank, had in enumerate(left))


def test_a_short_command_says_nothing_and_a_long_stage_a_line(now_s, capsys):
    with progress_of('evaluating') as tell:
        tell('tracking', 0.5)
    assert capsys.readouterr() == ('', '')
    with progress_of('diagnosing') as tell:
        tell('a first look')
        now_s[0] += 12.0
        tell('joint fit')
    assert capsys.readouterr().err == 'diagnosing: joint fit, after 12 s\n'
