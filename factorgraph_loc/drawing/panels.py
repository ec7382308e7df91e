"""Figures of several panels as PNG."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

from factorgraph_loc.drawing.figures import drawing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def axes_of(rows: int, columns: int, height: float = 3.2) -> tuple[Figure, Any]:
    """A figure and its axes (rows, columns), rows ``height`` inches high."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(13.0, height * rows + 0.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.flat:
        axis.grid(color="0.9")
        axis.set_axisbelow(True)
    return figure, axes


def name_axes(axis: Axes, x: str, y: str) -> None:
    """What an axis shows, with units."""
    axis.set_xlabel(x)
    axis.set_ylabel(y)


def legend(figure: Figure, axes: Any) -> None:
    """One legend below the axes, of all that is drawn in any of them."""
    entries: dict[str, Any] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    figure.legend(
        entries.values(), entries.keys(), loc="outside lower center", ncols=max(1, len(entries)), markerscale=3
    )


def png(figure: Figure) -> bytes:
    """The figure as a PNG image."""
    out = io.BytesIO()
    with drawing(figure):
        figure.savefig(out, format="png", dpi=80)
    return out.getvalue()
