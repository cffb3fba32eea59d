"""Makes files and page elements of figures, with the legends and axes that several of them have.

Who imports this draws without a window.
"""

import base64
import io
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


def image(figure: Figure | Path) -> str:
    """Return a figure, which is closed, or a file of one as an HTML element that holds it."""
    if isinstance(figure, Path):
        content = figure.read_bytes()
    else:
        save(figure, buffer := io.BytesIO())
        content = buffer.getvalue()
    data = base64.b64encode(content).decode('ascii')
    return f'<img alt="figure" src="data:image/png;base64,{data}">'


def legend_below(figure: Figure, panel: Axes, markers: float = 1.0) -> None:
    """Put one legend below all panels, where it covers nothing, with what one of them labels.

    Its markers are larger than the panel's by a factor, as dots are too small to tell apart.
    """
    handles, labels = panel.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc='outside lower center', ncols=min(len(labels), 5), fontsize=8,
        markerscale=markers,
    )  # fmt: skip


def legend_beside(figure: Figure) -> None:
    """Put one legend beside all panels, with an entry for each label of any of them."""
    unique: dict[str, Artist] = {}
    for panel in figure.axes:
        handles, labels = panel.get_legend_handles_labels()
        unique |= dict(zip(labels, handles, strict=True))
    figure.legend(list(unique.values()), list(unique), loc='outside right upper', fontsize=8)


def spell_out(axis: Axis) -> None:
    """Label a logarithmic axis with numbers at 1, 2 and 5 of each power, which have room."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FormatStrFormatter('%g'))
    axis.set_minor_formatter(NullFormatter())
