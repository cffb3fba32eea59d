"""How far a command is, where there is no terminal: few lines, with a share and a time."""

from anser_ros.cli import output
from anser_ros.cli.output import LINE_INTERVAL_S, progress_of


def test_lines_come_now_and_then_with_the_share_and_the_time_that_is_left(monkeypatch, capsys):
    now_s = [100.0]
    monkeypatch.setattr(output.time, 'monotonic', lambda: now_s[0])
    with progress_of('calibrating') as tell:
        for step in range(1, 11):
            now_s[0] += 0.4 * LINE_INTERVAL_S
            tell('layouts' if step < 7 else 'positions', 0.1 * step)
    said = capsys.readouterr().err.splitlines()
    assert said[0] == 'calibrating: layouts, 30%, about 14 s left'
    assert [line.split(',')[0] for line in said] == [
        'calibrating: layouts', 'calibrating: layouts', 'calibrating: positions',
    ]  # fmt: skip


def test_no_time_is_told_that_loading_and_compiling_would_make(monkeypatch, capsys):
    """The first frame of a session takes as long as the kernels need to be there."""
    now_s = [100.0]
    monkeypatch.setattr(output.time, 'monotonic', lambda: now_s[0])
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


def test_a_short_command_says_nothing(capsys):
    with progress_of('evaluating') as tell:
        tell('tracking', 0.5)
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ('', '')


def test_stages_are_lines_of_their_own_once_it_takes_long(monkeypatch, capsys):
    now_s = [100.0]
    monkeypatch.setattr(output.time, 'monotonic', lambda: now_s[0])
    with progress_of('diagnosing') as say:
        say('a first look')
        now_s[0] += 12.0
        say('joint fit')
    assert capsys.readouterr().err == 'diagnosing: joint fit, after 12 s\n'
