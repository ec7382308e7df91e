"""The common style of all plots.

Colour-blind readers can distinguish the colours (Okabe and Ito, "Color Universal Design", 2008).
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from factorgraph_loc.drawing.pages import Picture
from factorgraph_loc.text import plain
from factors.se2 import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from PIL.Image import Image


COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
CORNERS = 32  # number of corners of the polygon that approximates an ellipse
_ANGLES = np.linspace(0.0, 2.0 * np.pi, CORNERS + 1)
_CIRCLE = np.column_stack((np.cos(_ANGLES), np.sin(_ANGLES)))
_STYLES = ("-", "--", ":", "-.")  # line styles, which distinguish curves in print without colour
_WIDTH, _DPI = 16.0, 100  # width of a figure in units of 100 px, and pixels per unit
_TITLE, _LINES = 80, 3  # maximum length of a line of text, and number of lines
_LABEL, _LEGEND, _SIGN = 60, 190, 13  # characters: maximum of a label, of a line of the legend, width of a line sample


def empty(height: float, title: str = "") -> Figure:
    """Return a figure without axes. ``height``: its height in units of 100 px. ``title``: the text above the figure."""
    # Figure without pyplot: no global state, no display, and matplotlib is imported only when something is plotted
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(_WIDTH, height))
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title, fontsize=16)
    return figure


def grid(rows: int, columns: int, height: float, title: str = "", *, shared: bool = False) -> tuple[Figure, Any]:
    """Return a figure and its array of axes (rows, columns). ``height``: of the figure, in units of 100 px.

    ``shared``: whether all axes in a column have the same x range, and all axes in a row the same y range.
    """
    figure = empty(height, title)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=shared and "col", sharey=shared and "row")
    dress(axes.flat)
    return figure, axes


def dress(axes: Iterable[Axes]) -> None:
    """Apply the common style to ``axes``: a pale grid behind the data, and readable font sizes."""
    for axis in axes:
        axis.grid(color="0.9")
        axis.set_axisbelow(True)
        axis.tick_params(labelsize=12)
        axis.xaxis.label.set_fontsize(13)
        axis.yaxis.label.set_fontsize(13)
        axis.title.set_fontsize(14)


def styles() -> Iterator[dict[str, Any]]:
    """Yield distinct line styles without end. Each is a dict of the keyword arguments ``color`` and ``linestyle``."""
    for colour, line in zip(cycle(COLOURS), cycle(_STYLES), strict=False):
        yield {"color": colour, "linestyle": line}


def ellipses(centres: Array, covariances: Array, scale: float) -> Array:
    """Return the covariance ellipses of K planar Gaussians as closed polygons (K, CORNERS + 1, 2).

    ``centres`` (K, 2): means. ``covariances`` (K, 2, 2). ``scale``: number of standard deviations from the mean.
    """
    variances, axes = np.linalg.eigh(covariances)
    lengths = scale * np.sqrt(np.maximum(variances, 0.0))
    return np.asarray(centres[:, None] + np.einsum("kij,kj,cj->kci", axes, lengths, _CIRCLE))


def legend(figure: Figure, axes: Iterable[Axes], markers: float = 1.0) -> None:
    """Add one legend below all ``axes``. ``markers``: size of its markers relative to the markers in the axes."""
    entries: dict[str, Any] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if entries:
        labels = [plain(label, _LABEL) for label in entries]
        columns = min(len(labels), max(1, _LEGEND // (max(map(len, labels)) + _SIGN)))
        style = {"ncols": columns, "fontsize": 13, "markerscale": markers}
        figure.legend(entries.values(), labels, loc="lower center", **style)


@contextmanager
def drawing(figure: Figure) -> Iterator[None]:
    """Prepare the texts of a figure for drawing in this block, and suppress warnings meanwhile.

    A ``$`` in a text is drawn and does not start a formula. Long lines are shortened. The suppressed warnings are about
    missing glyphs and about labels that leave no room for the axes.
    """
    named = [text for axis in figure.axes for text in (axis.title, axis.xaxis.label, axis.yaxis.label, *axis.texts)]
    for text in (*figure.texts, *named, *(text for legend in figure.legends for text in legend.get_texts())):
        text.set_parse_math(False)
        text.set_text("\n".join(plain(line, _TITLE) for line in text.get_text().split("\n")[:_LINES]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


def png(figure: Figure) -> Picture:
    """Return the figure as a PNG image that can be embedded in an HTML page."""
    return Picture.of("image/png", png_bytes(figure))


def svg(figure: Figure) -> Picture:
    """Return the figure as an SVG image that can be embedded in an HTML page. Equal figures give equal bytes."""
    from matplotlib import rc_context  # noqa: PLC0415

    out = io.BytesIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "factorgraph-loc"}), drawing(figure):
        _lay_out(figure)
        figure.savefig(out, format="svg", metadata={"Creator": None, "Date": None, "Format": None, "Type": None})
    return Picture.of("image/svg+xml", out.getvalue())


def png_bytes(figure: Figure) -> bytes:
    """Return the bytes of a PNG file of the figure, with 256 colours."""
    from PIL.Image import Dither, Quantize  # noqa: PLC0415

    out = io.BytesIO()
    _drawn(figure).quantize(256, method=Quantize.FASTOCTREE, dither=Dither.NONE).save(out, format="PNG")
    return out.getvalue()


def _drawn(figure: Figure) -> Image:
    """Return the figure as an image in full colour."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from PIL.Image import fromarray  # noqa: PLC0415

    figure.set_dpi(_DPI)
    canvas: Any = FigureCanvasAgg(figure)
    with drawing(figure):
        _lay_out(figure)
        canvas.draw()
    return fromarray(np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[:, :, :3]))


def _lay_out(figure: Figure) -> None:
    """Place the axes of a figure between its title and its legend. Matplotlib's constrained layout is much slower."""
    aspects = [(axis, axis.get_aspect()) for axis in figure.axes]
    for axis in figure.axes:
        axis.set_aspect("auto")  # tight_layout makes room for labels only if the axes fill their cells
    figure.tight_layout()
    for axis, aspect in aspects:
        axis.set_aspect(aspect)
    places = figure.subplotpars
    specs = [spec.get_topmost_subplotspec() for axis in figure.axes if (spec := axis.get_subplotspec())]
    rows = max((spec.get_gridspec().nrows for spec in specs), default=1)
    height = (places.top - places.bottom) / (rows + places.hspace * (rows - 1))
    below = sum(legend.get_window_extent().height for legend in figure.legends) / figure.bbox.height
    lower = height - below / rows
    if lower > 0.0:
        figure.subplots_adjust(bottom=places.bottom + below, hspace=places.hspace * height / lower)
