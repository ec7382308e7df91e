"""What all plots share: the data of a run that is plotted, colours, legends, and PNG files 1600 px wide.

Colours: Okabe and Ito, "Color Universal Design", 2008, which colour-blind readers can tell apart.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from factorgraph_loc.evaluation.pairing import pauses
from factorgraph_loc.evaluation.result import RunResult
from factorgraph_loc.evaluation.scoring import MAX_GAP
from factorgraph_loc.text import plain
from factorgraph_loc.trajectory import Trajectory
from factors.se2 import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_STYLES = ("-", "--", ":", "-.")  # a second cue beside colour; also tells apart more estimators than there are colours
_WIDTH, _DPI = 16.0, 100
_TITLE, _LINES = 80, 3  # characters and lines of a text at most
_LABEL, _LEGEND = 60, 160  # characters of a label, and of a line of the legend


@dataclass(frozen=True)
class Track:
    """What is plotted of one run.

    ``causal`` (None if it never was localized), ``final`` (empty if nothing told the pose); ``update_ms`` (M,) of each update;
    ``nis``: by sensor, rows (K, 3) of time, normalised innovation squared and degrees of freedom; ``events``: time and text;
    ``max_gap`` [s]: between estimates that are interpolated where errors are shown.
    """

    causal: Trajectory | None
    final: Trajectory
    update_ms: Array
    nis: Mapping[str, Array] = field(default_factory=dict)
    events: Sequence[tuple[float, str]] = ()
    max_gap: float = MAX_GAP

    @classmethod
    def of(cls, result: RunResult) -> Track:
        """The data of a run."""
        nis = {s: np.array(rows, dtype=float).reshape(-1, 3) for s, rows in result.diagnostics.nis.items()}
        events = tuple(result.diagnostics.events)
        return cls(result.causal(), result.final, result.timings.update_ms, nis, events, result.max_gap)

    def kinds(self) -> tuple[tuple[str, Trajectory | None], tuple[str, Trajectory | None]]:
        """Both trajectories by name, None where there is nothing to plot."""
        return ("causal", self.causal), ("final", self.final if len(self.final) else None)


def empty(height: float, title: str) -> Figure:
    """A figure without axes, ``height`` in units of 100 px."""
    # Figure without pyplot: no global state, no display, and matplotlib is loaded only where something is plotted
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(_WIDTH, height), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=16)
    return figure


def grid(rows: int, columns: int, height: float, title: str) -> tuple[Figure, Any]:
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


def mark_events(axis: Axes, events: Sequence[tuple[float, str]]) -> None:
    """Events as dashed vertical lines over the time axis."""
    for i, (t, _) in enumerate(events):
        label = "event (see events.csv)" if i == 0 else None
        axis.axvline(t, color=COLOURS[3], linestyle="--", linewidth=1.0, label=label, zorder=1.5)


def with_pauses(t: Array, values: Array) -> tuple[Array, Array]:
    """Times (N,) and values (N, ...) with a row of NaN in each pause, so that no line is drawn across it."""
    breaks = pauses(t)
    return np.insert(t, breaks, np.nan), np.insert(values, breaks, np.nan, axis=0)


def way(trajectory: Trajectory) -> Array:
    """The places (N, 2) of a trajectory as one line, broken in each pause by a row of NaN."""
    return with_pauses(trajectory.t, trajectory.poses[:, :2])[1]


def legend(figure: Figure, axes: Iterable[Axes]) -> None:
    """One legend below the axes, of all that is drawn in any of them."""
    entries: dict[str, Any] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if entries:
        labels = [plain(label, _LABEL) for label in entries]
        columns = min(len(labels), max(1, _LEGEND // max(map(len, labels))))
        figure.legend(entries.values(), labels, loc="outside lower center", ncols=columns, fontsize=13)


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
