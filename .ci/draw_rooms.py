"""Print, for Graphviz, which room of anser_ros may import which, from the table in the tests.

Draw the picture again after a change: python .ci/draw_rooms.py | dot -Tsvg > docs/rooms.svg
"""

import sys
from pathlib import Path


def arrows_of(allowed):
    """Return (room, room below) without what goes without saying through another room."""
    allowed = {room: below for room, below in allowed.items() if '.' not in room}
    reached = {}
    while len(reached) < len(allowed):
        for room, below in allowed.items():
            if below <= set(reached):
                reached[room] = below.union(*(reached[b] for b in below))
    return {
        (room, b)
        for room, below in allowed.items()
        for b in below
        if not any(b in reached[other] for other in below)
    }


if __name__ == '__main__':
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test'))
    from test_layers import ALLOWED

    print(
        'digraph { bgcolor=white; ranksep=0.3; nodesep=0.4; edge [color="#777777" arrowsize=0.6]'
    )
    print('node [shape=box style="rounded,filled" fillcolor="#eef4fb" color="#2a6099"')
    print('height=0.3 fontname="sans-serif" fontsize=12]')
    print('\n'.join(f'{room} -> {below}' for room, below in sorted(arrows_of(ALLOWED))), '}')
