"""The style of all plots.

Colours: Okabe and Ito, "Color Universal Design", 2008, which colour-blind readers can tell apart.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from factorgraph_loc.text import plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_STYLES = ("-", "--", ":", "-.")  # a second cue beside colour; also tells apart more estimators than there are colours
_WIDTH, _DPI, _PAGE_DPI = 16.0, 100, 80
_TITLE, _LINES = 80, 3  # characters and lines of a text at most
_LABEL, _LEGEND = 60, 160  # characters of a label, and of a line of the legend


def empty(height: float, title: str = "") -> Figure:
    """A figure without axes, ``height`` in units of 100 px."""
    # Figure without pyplot: no global state, no display, and matplotlib is loaded only where something is plotted
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(_WIDTH, height), layout="constrained")
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title, fontsize=16)
    return figure


def grid(rows: int, columns: int, height: float, title: str = "") -> tuple[Figure, Any]:
    """A figure and its axes (rows, columns)."""
    figure = empty(height, title)
    axes = figure.subplots(rows, columns, squeeze=False)
    dress(axes.flat)
    return figure, axes


def dress(axes: Iterable[Axes]) -> None:
    """The common look: a pale grid behind the data, and letters that can be read."""
    for axis in axes:
        axis.grid(color="0.9")
        axis.set_axisbelow(True)
        axis.tick_params(labelsize=12)
        axis.xaxis.label.set_fontsize(13)
        axis.yaxis.label.set_fontsize(13)
        axis.title.set_fontsize(14)


def styles() -> Iterator[dict[str, Any]]:
    """Colour and line style of the first, second, ... estimator."""
    i = 0
    while True:
        yield {"color": COLOURS[i % len(COLOURS)], "linestyle": _STYLES[i % len(_STYLES)]}
        i += 1


def legend(figure: Figure, axes: Iterable[Axes], markers: float = 1.0) -> None:
    """One legend below the axes, of all that is drawn in any of them; its ``markers`` are so many times as large."""
    entries: dict[str, Any] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if entries:
        labels = [plain(label, _LABEL) for label in entries]
        columns = min(len(labels), max(1, _LEGEND // max(map(len, labels))))
        look = {"ncols": columns, "fontsize": 13, "markerscale": markers}
        figure.legend(entries.values(), labels, loc="outside lower center", **look)


@contextmanager
def drawing(figure: Figure) -> Iterator[None]:
    """While a figure is drawn: names in it are shown as they are written, a ``$`` as one, on a line of bounded length; and of
    characters that the font lacks, or of names that leave no room, nobody is warned."""
    named = [text for axis in figure.axes for text in (axis.title, axis.xaxis.label, axis.yaxis.label, *axis.texts)]
    for text in (*figure.texts, *named, *(text for legend in figure.legends for text in legend.get_texts())):
        text.set_parse_math(False)
        text.set_text("\n".join(plain(line, _TITLE) for line in text.get_text().split("\n")[:_LINES]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


def lay_out(figure: Figure) -> None:
    """Lay a figure out once before it is saved: with a fixed aspect the layout needs a second pass."""
    with drawing(figure):
        figure.draw_without_rendering()


def png(figure: Figure) -> bytes:
    """The figure as a PNG image, for a page."""
    out = io.BytesIO()
    with drawing(figure):
        figure.savefig(out, format="png", dpi=_PAGE_DPI)
    return out.getvalue()


def save(figure: Figure, path: Path) -> None:
    """Write a PNG with a palette: few colours are used, and the file is a third of what it is in full colour.

    An octree keeps the colours of thin lines, which the default, the median cut, mixes.
    """
    from PIL import Image  # noqa: PLC0415

    full = io.BytesIO()
    with drawing(figure):
        figure.savefig(full, format="png", dpi=_DPI)
    with Image.open(full) as image:
        image.convert("RGB").quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(
            path, format="PNG", optimize=True
        )
