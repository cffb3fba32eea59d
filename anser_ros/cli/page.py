"""Makes files of figures, and self-contained pages of HTML.

A page is a sequence of headings, paragraphs, tables, pictures and details, each made of plain text
as `Html`; what is empty is left out. Who imports this draws without a window.
"""

import base64
import html
import io
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import matplotlib

matplotlib.use('Agg')
from matplotlib import pyplot as plt
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

DOTS_PER_INCH = 110
"""Resolution of the figures, a compromise between legible text and the size of the files."""
WIDE = 4.0
"""Largest over smallest value from which an axis is logarithmic: else it has too few labels."""


def save(figure: Figure, path: Path | io.BytesIO) -> None:
    """Write a figure as PNG and close it; the same figure gives the same bytes."""
    # No version of the library in the file.
    figure.savefig(path, format='png', dpi=DOTS_PER_INCH, metadata={'Software': None})
    plt.close(figure)


def legend_beside(figure: Figure, below: float = 0.0) -> None:
    """Put one legend beside all panels, with an entry for each label of any of them.

    Where ``below`` is given it is below them, its markers larger than the panels' by that factor.
    """
    unique: dict[str, Artist] = {}
    for panel in figure.axes:
        handles, labels = panel.get_legend_handles_labels()
        unique |= dict(zip(labels, handles, strict=True))
    figure.legend(
        list(unique.values()), list(unique), fontsize=8, markerscale=below or None,
        loc='outside lower center' if below else 'outside right upper',
        ncols=min(len(unique), 5) if below else 1,
    )  # fmt: skip


def spell_out(axis: Axis) -> None:
    """Label a logarithmic axis with numbers at 1, 2 and 5 of each power, which have room."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FormatStrFormatter('%g'))
    axis.set_minor_formatter(NullFormatter())


STYLE = """
body { font: 15px/1.5 sans-serif; max-width: 60em; margin: 2em auto; padding: 0 1em; color: #222 }
table { border-collapse: collapse; margin: 1em 0 } td, th { padding: .25em .8em; text-align: left;
border-bottom: 1px solid #ddd; vertical-align: top } th { background: #f4f4f4 }
img { max-width: 100% }
.verdict { background: #eef3fa; padding: 1em; border-left: 4px solid #4c72b0 }
td.n { text-align: right; font-variant-numeric: tabular-nums } code { background: #f4f4f4 }
.note { color: #666 }
"""
NUMBER = re.compile(r'-|[-+]?\d[\d.]*(e[-+]?\d+)?%?')
"""Cells of a table that are aligned to the right."""
BEFORE, AFTER = '#c44e52', '#4c72b0'
"""Colours of errors without and with what was found."""


class Html(str):
    __slots__ = ()


def escaped(text: str) -> Html:
    """Return plain text, or what is HTML already, as HTML; its lines stay lines."""
    return text if isinstance(text, Html) else Html(html.escape(text).replace('\n', '<br>'))


def page(title: str, *sections: str | Iterable[str], style: str = '') -> str:
    """Return a page of sections: what the functions below return, or sequences of that."""
    parts = [[one] if isinstance(one, str) else one for one in sections]
    body = ''.join(part for one in parts for part in one)
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<style>{STYLE}{style}</style></head><body>{body}</body></html>\n'
    )


def top(title: str, verdict: str = '', note: str = '', **subjects: str) -> Html:
    """Return what a page begins with: title, note, of what it is (names by kind), and verdict."""
    of = [f'{kind} <code>{escaped(name)}</code>' for kind, name in subjects.items()]
    words = ', '.join(filter(None, (escaped(note), *of)))
    return Html(
        f'<h1>{escaped(title)}</h1>{paragraph(Html(words), "note")}{paragraph(verdict, "verdict")}'
    )


def heading(title: str, words: str = '', *, level: int = 2) -> Html:
    """Return a heading with a paragraph below it, where that is not empty."""
    return Html(f'<h{level}>{escaped(title)}</h{level}>{paragraph(words)}')


def paragraph(words: str, kind: str = '') -> Html:
    """Return a paragraph, also a ``note`` or a ``verdict``; nothing where there are no words."""
    mark = f' class="{kind}"' if kind else ''
    return Html(f'<p{mark}>{escaped(words)}</p>' if words else '')


def listed(items: Iterable[str]) -> Html:
    return Html(f'<ul>{"".join(f"<li>{escaped(item)}</li>" for item in items)}</ul>')


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> Html:
    """Return a table of texts; numbers stand to the right."""
    cells = ''.join(f'<th>{escaped(cell)}</th>' for cell in head)
    body = ''.join(f'<tr>{"".join(map(_cell, row))}</tr>' for row in rows)
    return Html(f'<table><tr>{cells}</tr>{body}</table>')


def _cell(text: str) -> str:
    kind = ' class="n"' if NUMBER.fullmatch(text) else ''
    return f'<td{kind}>{escaped(text)}</td>'


def details(summary: str, *parts: str, is_open: bool = False) -> Html:
    """Return parts that are shown on demand."""
    state = ' open' if is_open else ''
    return Html(f'<details{state}><summary>{escaped(summary)}</summary>{"".join(parts)}</details>')


def picture(figure: Figure | Path) -> Html:
    """Return a figure, which is closed, or a file of one inside the page."""
    if isinstance(figure, Path):
        content = figure.read_bytes()
    else:
        save(figure, buffer := io.BytesIO())
        content = buffer.getvalue()
    data = base64.b64encode(content).decode('ascii')
    return Html(f'<img alt="figure" src="data:image/png;base64,{data}">')


def legend_under(panel: Axes, down: float = 0.16, size: float = 8, columns: int = 3) -> None:
    """Put a panel's legend below it, where it covers nothing; ``down`` in heights of the panel."""
    panel.legend(fontsize=size, loc='upper center', bbox_to_anchor=(0.5, -down), ncols=columns)
