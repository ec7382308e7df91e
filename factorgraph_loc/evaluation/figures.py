"""Common parts of all plots: the plotted data of a run, colours, legends, and PNG files 1600 px wide.

Colours: Okabe and Ito, "Color Universal Design", 2008, distinguishable by colour-blind readers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from factorgraph_loc.drawing.figures import COLOURS
from factorgraph_loc.evaluation.pairing import pauses
from factorgraph_loc.model.result import RunResult
from factorgraph_loc.model.scoring import MAX_GAP
from factorgraph_loc.model.trajectory import Trajectory
from factors.se2 import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class Track:
    """The plotted data of one run.

    ``causal`` (None if never localized), ``final`` (may be empty); ``update_ms`` (M,) of each update; ``nis``: by sensor, rows
    (K, 3) of time, normalised innovation squared and degrees of freedom; ``events``: time and text; ``max_gap`` [s]: largest
    interval between estimates that is interpolated for errors.
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
        """Both trajectories by name, None if there is nothing to plot."""
        return ("causal", self.causal), ("final", self.final if len(self.final) else None)


def mark_events(axis: Axes, events: Sequence[tuple[float, str]]) -> None:
    """Mark events by dashed vertical lines."""
    for i, (t, _) in enumerate(events):
        label = "event (see events.csv)" if i == 0 else None
        axis.axvline(t, color=COLOURS[3], linestyle="--", linewidth=1.0, label=label, zorder=1.5)


def with_pauses(t: Array, values: Array) -> tuple[Array, Array]:
    """Times (N,) and values (N, ...) with a row of NaN in each gap, which interrupts the line."""
    breaks = pauses(t)
    return np.insert(t, breaks, np.nan), np.insert(values, breaks, np.nan, axis=0)


def way(trajectory: Trajectory) -> Array:
    """The positions (N, 2) of a trajectory, with a row of NaN in each gap."""
    return with_pauses(trajectory.t, trajectory.poses[:, :2])[1]
