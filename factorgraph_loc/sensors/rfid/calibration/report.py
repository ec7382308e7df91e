"""The report of an RFID calibration: tables, plain values, and plots of the reliability and the field of a detection model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.drawing.figures import COLOURS, grid, legend, png
from factorgraph_loc.drawing.pages import Picture, Rows
from factorgraph_loc.fitting.shares import wilson
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.rfid.calibration.learn import RfidKnowledge
from factors.rfid.model import probability
from factors.se2 import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh


def offsets_table(found: RfidKnowledge) -> Rows:
    """Changes of survey and mounting."""
    header = ("survey and mounting", "change", "standard error", "why")
    rows: list[tuple[str, ...]] = [
        (
            f"{o.what}.{o.name} [{'rad' if o.name in ('heading', 'yaw') else 'm'}]",
            f"{o.change:.4f}",
            f"{o.error:.4f}",
            o.why,
        )
        for o in found.offsets
    ]
    return header, rows


def models_table(found: RfidKnowledge, *, accepted: bool) -> Rows:
    """Detection models by their likelihood on held-out reads. ``accepted``: whether the rig has the best one."""
    header = ("model of detection", "smoothness", "held-out nats per round and tag", "worst fold", "")
    rows: list[tuple[str, ...]] = [
        (
            t.kind.label(),
            f"{t.kind.smoothness:g}" if t.kind.smoothness else "-",
            f"{t.nll:.4f}",
            f"{max(t.by_fold):.4f}",
            "" if t is not found.choice.best else "in the rig" if accepted else "rejected",
        )
        for t in found.choice.trials
    ]
    return header, rows


def tags_table(found: RfidKnowledge) -> Rows:
    """Tags that seem to be misplaced."""
    header = ("tag", "distance [m]", "x [m]", "y [m]", "chance in a correct map")
    rows: list[tuple[str, ...]] = [
        (d.name, f"{d.distance:.2f}", f"{d.shift[0]:.2f}", f"{d.shift[1]:.2f}", f"{d.p:.1g}") for d in found.doubts
    ]
    return header, rows


def tempering_text(found: RfidKnowledge, rig: Rig) -> str:
    """The correlation of reads, in two sentences."""
    assert rig.rfid is not None
    return (
        f"By their scatter along the reference, {1.0 / found.share:.0f} consecutive reads are worth one independent read. "
        f"The smoother is consistent with a tempering of {rig.rfid.tempering:.3g}, which the rig has."
    )


def dead_text(found: RfidKnowledge) -> str:
    """The share of dead tags, in a sentence."""
    return (
        f"The prior share of dead tags in the maps is {100.0 * found.dead.share:.1f} %; "
        f"{len(found.dead.tags)} were never read, of which {len(found.dead.believed)} should have been."
    )


def rfid_document(found: RfidKnowledge, *, accepted: bool) -> dict[str, Any]:
    """All figures as plain values; ``accepted``: see :func:`models_table`."""
    return {
        "offsets": [
            {
                "what": o.what,
                "name": o.name,
                "change": o.change,
                "standard_error": o.error,
                "kept": o.kept,
                "why": o.why,
            }
            for o in found.offsets
        ],
        "models": [
            {
                "model": t.kind.label(),
                "smoothness": t.kind.smoothness,
                "held_out_nll": t.nll,
                "by_fold": list(t.by_fold),
                "kept": accepted and t is found.choice.best,
            }
            for t in found.choice.trials
        ],
        "phase_agreement": None if found.phase is None else [found.phase.before, found.phase.after],
        "independent_share": found.share,
        "misplaced_tags": [{"tag": d.name, "x": d.shift[0], "y": d.shift[1], "p": d.p} for d in found.doubts],
        "silent_tags": list(found.dead.tags),
        "dead_share": found.dead.share,
        "dead_tags": dict(found.dead.tags),
    }


BINS = 12
VIEW = 6.0  # m around the antenna
_STEP = 0.1  # m


def reliability_figure(found: RfidKnowledge) -> Picture:
    """Held-out predictions against observed frequencies of reads, and the number of reads per bin."""
    figure, axes = grid(1, 2, 4.5)
    predicted, observed, low, high, count = reliability(found)
    panel, amounts = axes[0]
    panel.plot((0.0, 1.0), (0.0, 1.0), color="0.3", linestyle="--", label="ideal")
    panel.errorbar(
        predicted,
        observed,
        yerr=(observed - low, high - observed),
        fmt=".-",
        color=COLOURS[0],
        capsize=3,
        label="held-out reads, Wilson's 95 % interval",
    )
    panel.set(xlabel="predicted probability of a read", ylabel="share of rounds with a read")
    amounts.bar(predicted, count, width=0.7 / BINS, color=COLOURS[0])
    amounts.set_yscale("log")
    amounts.set(xlabel="predicted probability of a read", ylabel="rounds times tags")
    legend(figure, axes.flat, markers=3.0)
    return png(figure)


def field_figure(found: RfidKnowledge) -> Picture:
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


def reliability(found: RfidKnowledge) -> tuple[Array, Array, Array, Array, Array]:
    """Mean prediction, observed frequency, Wilson's interval (low, high) and rounds of each non-empty bin."""
    q, pairs = found.choice.best.predicted, found.pairs
    bins = np.minimum((q * BINS).astype(np.int64), BINS - 1)
    count, weighted, hits = (
        np.bincount(bins, values, BINS).astype(float) for values in (pairs.count, pairs.count * q, pairs.hits)
    )
    used = count > 0.0
    n: Array = count[used]
    mean, share = weighted[used] / n, hits[used] / n
    low, high = wilson(hits[used], n)
    return mean, share, low, high, n


def _observed(found: RfidKnowledge, mine: NDArray[np.bool_], axis: Array) -> Array:
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
