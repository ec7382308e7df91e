"""The report of an RFID calibration: a table, plain values, and a plot of the field of a detection model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.drawing.figures import COLOURS, grid, png
from factorgraph_loc.drawing.pages import Picture, Rows
from factorgraph_loc.sensors.rfid.calibration.learn import RfidFit
from factors.rfid.model import probability
from factors.se2 import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh


def models_table(found: RfidFit) -> Rows:
    """Detection models by their likelihood on held-out reads."""
    header = ("model of detection", "smoothness", "held-out nats per round and tag", "worst fold", "")
    rows: list[tuple[str, ...]] = [
        (
            t.kind.label(),
            f"{t.kind.smoothness:g}" if t.kind.smoothness else "-",
            f"{t.nll:.4f}",
            f"{max(t.by_fold):.4f}",
            "best" if t.kind == found.kind else "",
        )
        for t in found.trials
    ]
    return header, rows


def rfid_document(found: RfidFit) -> dict[str, Any]:
    """All figures as plain values."""
    return {
        "models": [
            {
                "model": t.kind.label(),
                "smoothness": t.kind.smoothness,
                "held_out_nll": t.nll,
                "by_fold": list(t.by_fold),
                "best": t.kind == found.kind,
            }
            for t in found.trials
        ],
        "phase_agreement": None if found.phase is None else [found.phase.before, found.phase.after],
        "independent_share": found.share,
    }


VIEW = 6.0  # m around the antenna
_STEP = 0.1  # m


def field_figure(found: RfidFit) -> Picture:
    """Probability of a read around the antenna: observed, and by each model for tags facing towards and away from it."""
    facings = (1.0, 0.0, -1.0) if any(model.uses_facing for model in found.models) else (0.0,)
    figure, axes = grid(len(found.models), 1 + len(facings), 5.0 * len(found.models))
    axis = np.arange(-VIEW, VIEW + 1e-9, _STEP)
    image = None
    for row, model in enumerate(found.models):
        mine = np.asarray(found.which)[found.pairs.antenna] == row
        owners = ", ".join(a for a, w in zip(found.antennas, found.which, strict=True) if w == row)
        heights = found.pairs.points[mine, 2]
        z = float(np.median(heights)) if len(heights) else 0.0
        image = _draw(axes[row, 0], axis, _observed(found, mine, axis))
        axes[row, 0].set_title(f"share of rounds with a read ({owners})")
        x, y = np.meshgrid(axis, axis, indexing="ij")
        points = np.column_stack((x.ravel(), y.ravel(), np.full(x.size, z)))
        for panel, facing in zip(axes[row, 1:], facings, strict=True):
            image = _draw(panel, axis, probability(model, points, facing).reshape(x.shape))
            panel.set_title(f"model, tag {z:+.1f} m high" + (f", facing {facing:+.0f}" if len(facings) > 1 else ""))
    if image is not None:
        for panel in axes[:, -1]:
            figure.colorbar(image, ax=panel, label="probability of a read in a round")
    return png(figure)


def _observed(found: RfidFit, mine: NDArray[np.bool_], axis: Array) -> Array:
    """Observed frequency of reads at each position; NaN without rounds."""
    edges = np.append(axis - 0.5 * _STEP, axis[-1] + 0.5 * _STEP)
    x, y, _ = found.pairs.points[mine].T
    bins = [edges, edges]
    count = np.histogram2d(x, y, bins, weights=found.pairs.count[mine])[0]
    hits = np.histogram2d(x, y, bins, weights=found.pairs.hits[mine])[0]
    return np.asarray(np.where(count > 0.0, hits / np.maximum(count, 1e-9), np.nan))


def _draw(panel: Axes, axis: Array, values: Array) -> QuadMesh:
    image = panel.pcolormesh(axis, axis, values.T, vmin=0.0, vmax=1.0, cmap="viridis", shading="nearest")
    panel.plot(0.0, 0.0, ">", color=COLOURS[1], markersize=9)
    panel.set_aspect("equal")
    panel.set(xlabel="x, along the boresight [m]", ylabel="y, to the left [m]")
    return image
