"""Computes the elements of a log that all viewers draw: mapped objects, covariance ellipses and paths."""

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.drawing import figures as drawing_figures
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.interfaces import Marks, marks
from factors.se2 import Array

LIT_FOR = 0.5  # s for which a tag or landmark is highlighted after an observation
GAP = 1.0  # s between poses above which the path is interrupted
SCALE_95 = math.sqrt(-2.0 * math.log(0.05))  # radius in standard deviations that contains 95 % of a planar Gaussian
Colour = tuple[int, int, int]  # red, green, blue from 0 to 255
REFERENCE, DARK, DETECTION, SIGHTING = (128, 128, 128), (160, 160, 160), (230, 159, 0), (0, 158, 115)


@dataclass(frozen=True)
class Lights:
    """Lists which objects of a map are highlighted at which time. ``names[i]``: names of all objects that are
    highlighted from ``t[i]`` to ``t[i + 1]`` [s]."""

    t: Array
    names: tuple[tuple[str, ...], ...]


def colours() -> Iterator[Colour]:
    """Yield distinct colours of plots as (red, green, blue) from 0 to 255, repeating after the last colour."""
    # without the last colour, black, because the background of viewers is black
    for colour in itertools.cycle(drawing_figures.COLOURS[:-1]):
        red, green, blue = bytes.fromhex(colour[1:])
        yield red, green, blue


def layers(log: Log) -> list[tuple[Marks, dict[str, Array], Lights]]:
    """Return (objects, positions, highlights) for each kind of mapped object, such as landmarks.

    The positions are arrays (3,) [m] by name. An object is highlighted for :data:`LIT_FOR` seconds after each
    observation.
    """
    drawn = sorted(marks(log), key=lambda layer: layer.order)
    return [
        (layer, dict(zip(layer.names, layer.positions, strict=True)), _lights(layer.t.tolist(), layer.seen))
        for layer in drawn
    ]


def ellipses(trajectory: Trajectory) -> tuple[Array, Array]:
    """Return the times (K,) [s] of poses that have a covariance, and their 95 % ellipses (K, L, 2) [m].

    An ellipse is a polygon with L corners."""
    if trajectory.covariances is None:
        return np.empty(0), np.empty((0, drawing_figures.CORNERS + 1, 2))
    covariances = trajectory.covariances[:, :2, :2]
    known = np.isfinite(covariances).all(axis=(1, 2))
    return trajectory.t[known], drawing_figures.ellipses(trajectory.poses[known, :2], covariances[known], SCALE_95)


def _lights(t: Iterable[float], names: Sequence[str]) -> Lights:
    """Return when objects are highlighted. ``t``, ``names``: the time [s] and the object of each observation."""
    switches = sorted(
        s for start, name in zip(t, names, strict=True) for s in ((start, 1, name), (start + LIT_FOR, -1, name))
    )
    lit: dict[str, int] = {}
    stamps: list[float] = []
    shown: list[tuple[str, ...]] = []
    for i, (at, change, name) in enumerate(switches):
        lit[name] = lit.get(name, 0) + change
        if not lit[name]:
            del lit[name]
        if i + 1 == len(switches) or switches[i + 1][0] > at:
            now = tuple(lit)
            if not shown or set(shown[-1]) != set(now):
                stamps.append(at)
                shown.append(now)
    return Lights(np.array(stamps), tuple(shown))


def segments(trajectory: Trajectory) -> list[Array]:
    """Return the positions (K, 2) [m] of each part of a trajectory. It is split at gaps longer than :data:`GAP`."""
    breaks = [0, *(np.flatnonzero(np.diff(trajectory.t) > GAP) + 1).tolist(), len(trajectory)]
    return [trajectory.poses[i:j, :2] for i, j in itertools.pairwise(breaks) if j - i > 1]
