"""Makes self-contained pages of HTML: their frame, their style and their tables."""

import html
from collections.abc import Iterable, Sequence

STYLE = """
body { font: 15px/1.5 sans-serif; max-width: 60em; margin: 2em auto; padding: 0 1em; color: #222 }
table { border-collapse: collapse; margin: 1em 0 } td, th { padding: .25em .8em; text-align: left;
border-bottom: 1px solid #ddd; vertical-align: top } th { background: #f4f4f4 }
img { max-width: 100% }
.verdict { background: #eef3fa; padding: 1em; border-left: 4px solid #4c72b0 }
td.n { text-align: right; font-variant-numeric: tabular-nums } code { background: #f4f4f4 }
.note { color: #666 }
"""


def page(title: str, sections: Iterable[str], style: str = STYLE) -> str:
    """Return a page of sections that are HTML already."""
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<style>{style}</style></head><body>{"".join(sections)}</body></html>\n'
    )


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table of plain texts."""
    cells = ''.join(f'<th>{html.escape(cell)}</th>' for cell in head)
    body = ''.join(
        '<tr>' + ''.join(f'<td>{html.escape(cell)}</td>' for cell in row) + '</tr>' for row in rows
    )
    return f'<table><tr>{cells}</tr>{body}</table>'
