"""Figure 5 of the paper (Raoui, Bouyakhf, Devy, ICINCO 2011), for any log."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from factorgraph_loc.drawing.figures import COLOURS, dress, empty, legend, styles
from factorgraph_loc.evaluation.figures import Track, gapped_path, with_pauses
from factorgraph_loc.evaluation.metrics import errors
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.rfid.known_tags import tag_map

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def fusion(log: Log, tracks: Mapping[str, Track]) -> Figure:
    """Figure 5: the trajectories from prediction, from single sensors and fused, and with a reference their errors over time.

    Causal trajectories, or the final one of an estimator without, with a label that says so.
    """
    figure = empty(8.0, f"{log.name}: trajectories from each sensor and fused")
    axes = figure.subplot_mosaic([["map", "errors"]], width_ratios=(1.1, 1.0))
    dress(axes.values())
    _map(axes["map"], log)
    for (name, track), style in zip(tracks.items(), styles(), strict=False):
        trajectory = track.final if track.causal is None else track.causal
        label = f"{name} (final)" if track.causal is None else name
        if not len(trajectory):
            continue
        axes["map"].plot(*gapped_path(trajectory).T, label=label, linewidth=1.3, zorder=3, **style)
        if log.reference is not None:
            e = errors(trajectory, log.reference, track.max_gap)
            t, error = with_pauses(e.t, np.maximum(e.position, 1e-4))
            axes["errors"].semilogy(t, error, linewidth=1.0, **style)
    axes["errors"].set_xlabel("time [s]")
    axes["errors"].set_ylabel("position error [m]")
    legend(figure, [axes["map"]])
    return figure


def _map(axis: Axes, log: Log) -> None:
    """Walls, tags and reference."""
    for i, (x1, y1, x2, y2) in enumerate(log.world.walls):
        axis.plot((x1, x2), (y1, y2), color="0.45", linewidth=1.0, label=None if i else "walls", zorder=1)
    tags = tag_map(log.world, log.rig.survey).tags.points
    if len(tags):
        axis.plot(*tags[:, :2].T, "s", color=COLOURS[-1], markersize=5, markerfacecolor="none", label="tags", zorder=2)
    if log.reference is not None:
        axis.plot(*gapped_path(log.reference).T, color="0.75", linewidth=4.0, label="reference", zorder=1)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel("x [m]")
    axis.set_ylabel("y [m]")
