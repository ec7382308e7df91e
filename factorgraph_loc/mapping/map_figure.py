"""Plots of a map of landmarks, tags or points, with the given map and the trajectory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from factorgraph_loc.drawing.figures import COLOURS, ellipses, grid, legend
from factorgraph_loc.mapping.mapping import LandmarkMap
from factorgraph_loc.mapping.tag_mapping import MadeTags
from factorgraph_loc.maps.points import PointMap
from factors.se2 import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FAR = 10.0  # points are drawn up to this distance from the median, in median absolute deviations
LABEL = 4  # last characters of a tag's EPC that are shown


def tag_figure(log: str, made: MadeTags) -> Figure:
    """Return a plot of a new map of tags, the map of the log, and the trajectory.

    It also shows the candidate positions of ambiguous tags, and the tags of the log's map that were not located. Labels
    are the last characters of EPCs. ``log``: the name of the log. ``made``: the new map.
    """
    out = figure(log, made.made, made.poses, LABEL)
    axis = out.axes[0]
    for name, modes in made.modes.items():
        places = np.array([mode.position for mode in modes])
        axis.plot(*places.T, ":o", color=COLOURS[4], markersize=6, label="ambiguous: one of these", zorder=3)
        axis.annotate(name[-LABEL:], tuple(places[0]), (7, 7), textcoords="offset points", fontsize=10, zorder=5)
    lost = [e.given for e in made.made.entries if e.given is not None and e.landmark in made.open]
    if lost and made.made.judged:
        axis.plot(*np.array(lost).T, "s", color=COLOURS[3], markersize=12, markerfacecolor="none", label="not located")
    for text in list(out.legends):
        text.remove()
    legend(out, [axis])
    return out


def dropped_figure(
    log: str,
    places: Mapping[str, Array],
    dead: Mapping[str, float],
    poses: Array,
    walls: Sequence[tuple[float, ...]] = (),
) -> Figure:
    """Return a plot of a map of tags with crosses over tags that are probably dead.

    ``places``: the position (2,) of each tag by EPC. ``dead``: the EPCs of the dead tags, with the probability that the
    tag is dead. ``poses`` (N, 3): the trajectory. ``walls``: (x1, y1, x2, y2) of each wall.
    """
    kept = np.array([place for name, place in places.items() if name not in dead]).reshape(-1, 2)
    out, axis = _from_above(f"{log}: dead tags of the map", (np.array(list(places.values())), poses[:, :2]), walls)
    axis.plot(*poses[:, :2].T, color="0.75", linewidth=1.0, label="trajectory", zorder=1)
    axis.plot(*kept.T, "+", color=COLOURS[0], markersize=9, label="kept", zorder=3)
    for name in dead:
        x, y = places[name]
        axis.plot(x, y, "x", color=COLOURS[1], markersize=9, label="believed dead, dropped", zorder=4)
        axis.annotate(name[-LABEL:], (x, y), (7, 7), textcoords="offset points", fontsize=12, zorder=5)
    legend(out, [axis])
    return out


def figure(log: str, made: LandmarkMap, poses: Array, label: int = 0) -> Figure:
    """Return a plot of a new map of landmarks with 2-sigma ellipses, the map of the log, and the trajectory.

    ``log``: the name of the log. ``made``: the new map. ``poses`` (N, 3): the trajectory in the frame of the new map.
    ``label``: the number of last characters of a landmark's name to show, or 0 for the whole name.
    """
    # other given positions are in another frame than the new map
    drawn = [e for e in made.entries if made.judged or e.verdict == "given"]
    given = np.array([e.given for e in drawn if e.given is not None])
    learnt = [e for e in made.entries if e.learnt is not None]
    places = np.array([e.learnt.position for e in learnt if e.learnt is not None]).reshape(-1, 2)
    out, axis = _from_above(f"{log}: map", (given.reshape(-1, 2), places, poses[:, :2]))
    axis.plot(*poses[:, :2].T, color="0.75", linewidth=1.0, label="trajectory", zorder=1)
    if len(given):
        axis.plot(*given.T, "k^", markersize=9, markerfacecolor="none", label="given map", zorder=3)
    for entry in learnt:
        assert entry.learnt is not None
        colour = COLOURS[1] if entry.flagged else COLOURS[0]
        kind = "wrong in the given map" if entry.flagged else "learnt"
        x, y = entry.learnt.position
        axis.plot(x, y, "x" if entry.flagged else "+", color=colour, markersize=9, label=kind, zorder=4)
        (rim,) = ellipses(entry.learnt.position[None], entry.learnt.covariance[None], 2.0)
        axis.plot(*rim.T, color=colour, label="2 sigma", zorder=4)
        axis.annotate(entry.landmark[-label:], (x, y), (7, 7), textcoords="offset points", fontsize=12, zorder=5)
        if entry.flagged and entry.given is not None:
            axis.plot(*np.stack((entry.given, entry.learnt.position)).T, ":", color=colour, zorder=2)
    legend(out, [axis])
    return out


def point_figure(log: str, points: PointMap, cameras: Array, walls: Sequence[tuple[float, ...]] = ()) -> Figure:
    """Return a plot of a map of points from above, coloured by height.

    ``log``: the name of the log. ``cameras`` (F, 3): the camera positions. ``walls``: (x1, y1, x2, y2) of each wall.
    """
    off = np.abs(points.positions - np.median(points.positions, axis=0))
    # a few distant points would make the scale of the plot too small
    shown = points.positions[np.all(off <= np.maximum(FAR * np.median(off, axis=0), 1.0), axis=1)]
    out, axis = _from_above(f"{log}: map of {len(points)} points", (shown[:, :2], cameras[:, :2]), walls)
    axis.plot(*cameras[:, :2].T, color=COLOURS[1], linewidth=1.0, label="camera", zorder=3)
    dots = axis.scatter(shown[:, 0], shown[:, 1], c=shown[:, 2], s=6.0, cmap="viridis", label="point", zorder=2)
    out.colorbar(dots, ax=axis, label="height [m]")
    legend(out, [axis])
    return out


def _from_above(title: str, places: Sequence[Array], walls: Sequence[tuple[float, ...]] = ()) -> tuple[Figure, Axes]:
    """Return a new figure and its axes, which contain the positions ``places``, each (N, 2), and show the walls."""
    width, depth = np.maximum(np.ptp(np.concatenate(places), axis=0), 1.0)
    out, axes = grid(1, 1, float(np.clip(14.0 * depth / width + 2.0, 6.0, 16.0)), title)
    axis: Axes = axes[0, 0]
    for x1, y1, x2, y2 in walls:
        axis.plot((x1, x2), (y1, y2), color="0.4", linewidth=2.0, label="wall", zorder=1)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set(xlabel="x [m]", ylabel="y [m]")
    return out, axis
