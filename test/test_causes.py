"""The monitor says why: in the nodes' own words, the gravest first, and not too many."""

from anser_ros.nodes.operator_words import MOST_CAUSES, MOST_TEXT, LastStatus, causes


def told(**changes):
    quiet = {
        'anser/acquisition': LastStatus(0, 'streaming', {'rate_hz': '50'}),
        'anser/tracker': LastStatus(0, 'tracking', {}),
        'anser/tracker: tool_a/0/x': LastStatus(0, 'ok', {}),
        'other/tracker: tool_a/0/x': LastStatus(2, 'stale: no flux', {}),
    }
    return {**quiet, **{name.replace('__', '/'): value for name, value in changes.items()}}


def test_nothing_is_said_of_what_is_well():
    assert causes(told(), 'anser', 50.0) == []


def test_a_computer_that_is_too_slow():
    words = 'overrun_blocks 120 (blocks lost: this computer is too slow)'
    slow = told(anser__acquisition=LastStatus(1, words, {'rate_hz': '30'}))
    assert causes(slow, 'anser', 50.0) == [f'acquisition: {words}; 40% of the frames are missing']
    assert causes(slow, 'anser') == [f'acquisition: {words}']
    slow['anser/acquisition'] = LastStatus(1, words, {'rate_hz': '49'})
    assert causes(slow, 'anser', 50.0) == [f'acquisition: {words}']


def test_sensors_of_one_reason_stand_together_behind_the_nodes():
    stale = 'references_lost: no reference fluxes for 1.2 s'
    found = told(
        anser__field_model=LastStatus(2, stale, {}), anser__tracker=LastStatus(1, 'no poses', {})
    )
    for n in range(5):
        found[f'anser/tracker: tool_a/{n}'] = LastStatus(1, 'references_lost', {})
    assert causes(found, 'anser') == [
        f'field_model: {stale}',
        'tracker: no poses',
        'references_lost (tool_a/0, tool_a/1, tool_a/2 and 2 more)',
    ]


def test_a_flood_has_an_end():
    flood = {f'anser/node{n}': LastStatus(1, 500 * 'x', {}) for n in range(30)}
    texts = causes(flood, 'anser')
    assert len(texts) == MOST_CAUSES and max(map(len, texts)) == MOST_TEXT
