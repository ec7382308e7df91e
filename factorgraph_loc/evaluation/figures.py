"""The plotted data of a run, common parts of its plots, and the plot of its consistency.

The consistency of an estimator is judged by the normalised estimation error squared (NEES) of the poses and the
normalised innovation squared (NIS) of the predicted measurements. Both are chi-square distributed for a consistent
estimator (Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, section 5.4).
Errors of consecutive poses are correlated, so the NEES is compared with the interval of a single value. Innovations are
independent, so the running mean of the NIS is compared with the interval of the mean.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from factorgraph_loc.drawing.figures import COLOURS, dress, empty, legend, png_bytes
from factorgraph_loc.evaluation.metrics import errors
from factorgraph_loc.evaluation.pairing import CONFIDENCE, pauses
from factorgraph_loc.files.models import write_bytes
from factorgraph_loc.io.results import ResultFiles
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.result import Reliability, RunResult
from factorgraph_loc.model.scoring import MAX_GAP
from factorgraph_loc.model.trajectory import Trajectory
from factors import chi_squared
from factors.se2 import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WINDOW = 20.0  # s; duration of the window of running means
_TAILS = ((1.0 - CONFIDENCE) / 2.0, (1.0 + CONFIDENCE) / 2.0)
_BAND: dict[str, Any] = {
    "color": COLOURS[5],
    "alpha": 0.3,
    "linewidth": 0.0,
    "label": f"{100 * CONFIDENCE:g} % band (of the single NEES, of the mean NIS)",
}
_IDEAL: dict[str, Any] = {"color": "black", "linewidth": 1.0, "label": "ideal"}


@dataclass(frozen=True)
class Track:
    """The data of one run of an estimator that are plotted.

    ``causal``: poses that were estimated online, None if the robot was never localized. ``final``: poses after all
    measurements, which may be empty. ``nis``: by sensor, rows (K, 3) of time [s], normalised innovation squared, and
    degrees of freedom. ``events``: time [s] and description of each event. ``max_gap`` [s]: errors are not interpolated
    across longer gaps. ``reliability``: by sensor, the observed and the predicted numbers of detections.
    """

    causal: Trajectory | None
    final: Trajectory
    nis: Mapping[str, Array] = field(default_factory=dict)
    events: Sequence[tuple[float, str]] = ()
    max_gap: float = MAX_GAP
    reliability: Mapping[str, Reliability] = field(default_factory=dict)

    @classmethod
    def of(cls, result: RunResult) -> Track:
        """Return the plotted data of a run from its result in memory."""
        nis = {s: np.array(rows, dtype=float).reshape(-1, 3) for s, rows in result.diagnostics.nis.items()}
        events = tuple((event.t, str(event)) for event in result.diagnostics.events)
        return cls(result.causal(), result.final, nis, events, result.max_gap, result.reliability)

    @classmethod
    def read(cls, files: ResultFiles, max_gap: float = MAX_GAP) -> Track:
        """Return the plotted data of a run from its result files. ``reliability`` is empty: no file contains it.
        ``max_gap`` [s]: errors are not interpolated across longer gaps between estimates."""
        causal, final = (estimates.trajectory for estimates in files.estimates().values())
        return cls(causal if len(causal) else None, final, files.innovations(), files.events(), max_gap)

    def kinds(self) -> tuple[tuple[str, Trajectory | None], tuple[str, Trajectory | None]]:
        """Return ("causal", its trajectory) and ("final", its trajectory). A trajectory without poses is None."""
        return ("causal", self.causal), ("final", self.final if len(self.final) else None)


def write_picture(figure: Figure, path: Path) -> None:
    """Write a figure as a PNG file, atomically."""
    write_bytes(path, png_bytes(figure))


def mark_events(axis: Axes, events: Sequence[tuple[float, str]]) -> None:
    """Draw a dashed vertical line at the time of each of ``events``, pairs of a time [s] and a description."""
    for i, (t, _) in enumerate(events):
        label = "event (see events.csv)" if i == 0 else None
        axis.axvline(t, color=COLOURS[3], linestyle="--", linewidth=1.0, label=label, zorder=1.5)


def with_pauses(t: Array, values: Array) -> tuple[Array, Array]:
    """Return ``t`` (N,) [s] and ``values`` (N, ...) with a row of NaN inserted in each gap, to interrupt a plotted
    line. A gap is an interval between timestamps above 1 s and above three times the median interval."""
    breaks = pauses(t)
    return np.insert(t, breaks, np.nan), np.insert(values, breaks, np.nan, axis=0)


def gapped_path(trajectory: Trajectory) -> Array:
    """Return the positions (M, 2) [m] of a trajectory, with a row of NaN in each long gap, which interrupts a plotted
    line."""
    return with_pauses(trajectory.t, trajectory.poses[:, :2])[1]


def consistency(log: Log, estimator: str, track: Track) -> Figure | None:
    """Return a figure of the NEES of the causal and final poses, and of the NIS per degree of freedom of each sensor.

    ``estimator``: its name for the title. ``track``: the data of its run on the ``log``. The NEES is plotted only if
    the log has a reference. Returns None if there is neither NEES nor NIS.
    """
    # innovations without any component have no degrees of freedom and are omitted
    innovations = {s: rows[(rows[:, 2] > 0.0) & np.isfinite(rows[:, 1])] for s, rows in track.nis.items()}
    sensors = sorted(sensor for sensor, values in innovations.items() if len(values))
    rows: list[Any] = [["causal", "final"]] if log.reference is not None else []
    rows += [[f"nis.{sensor}"] * 2 for sensor in sensors]
    if not rows:
        return None
    figure = empty(3.5 * len(rows) + 1.0, f"{log.name}, {estimator}: consistency")
    axes = figure.subplot_mosaic(rows)
    dress(axes.values())
    if log.reference is not None:
        for kind, trajectory in track.kinds():
            _nees(axes[kind], kind, trajectory, log.reference, track.max_gap)
        limits = np.array([axes[kind].get_ylim() for kind in ("causal", "final")])
        for kind in ("causal", "final"):
            axes[kind].set_ylim(limits[:, 0].min(), limits[:, 1].max())
    for sensor in sensors:
        _nis(axes[f"nis.{sensor}"], sensor, innovations[sensor])
    start, end = track.final.t[0], track.final.t[-1]
    for axis in axes.values():
        mark_events(axis, track.events)
        axis.set(xlim=(start, max(end, start + 0.001)), xlabel="time [s]")
    legend(figure, axes.values())
    return figure


def running_mean(t: Array, values: Array, weights: Array) -> tuple[Array, Array]:
    """Return weighted means (N,) in windows of :data:`WINDOW` seconds around each time, and the sums of weights (N,).

    ``t`` (N,): ascending times [s]. ``values`` (N,): values that are already multiplied by their ``weights`` (N,). The
    mean is NaN if the sum of weights in a window is 0.
    """
    first = np.searchsorted(t, t - WINDOW / 2.0, side="left")
    last = np.searchsorted(t, t + WINDOW / 2.0, side="right")
    sums = [
        np.diff(np.concatenate(([0.0], np.cumsum(x)))[np.stack((first, last))], axis=0)[0] for x in (values, weights)
    ]
    with np.errstate(invalid="ignore", divide="ignore"):
        return sums[0] / sums[1], sums[1]


def _nees(axis: Axes, kind: str, trajectory: Trajectory | None, reference: Trajectory, max_gap: float) -> None:
    """Plot the NEES of a trajectory. ``kind``: "causal" or "final", for labels. ``max_gap`` [s]: errors are not
    interpolated across longer gaps."""
    dof = 3 if reference.has_heading else 2
    axis.set(title=f"{kind} poses", ylabel="NEES of x, y, heading" if dof == 3 else "NEES of x, y", yscale="log")
    low, high = chi_squared.quantile(_TAILS, dof)
    axis.axhspan(low, high, **_BAND)
    axis.axhline(dof, **_IDEAL)
    e = None if trajectory is None else errors(trajectory, reference, max_gap)
    known = np.empty(0, dtype=bool) if e is None else np.isfinite(e.nees)
    if e is None or not known.any():
        axis.text(0.5, 0.9, f"no {kind} estimate to score", ha="center", transform=axis.transAxes, color="0.4")
        return
    t, nees = e.t[known], e.nees[known]
    mean, _ = running_mean(t, nees, np.ones(len(t)))
    _draw(axis, t, nees, with_pauses(t, mean), low)


def _nis(axis: Axes, sensor: str, rows: Array) -> None:
    """Plot the NIS of a sensor. ``rows`` (K, 3): time [s], NIS, and degrees of freedom."""
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    t, nis, dof = rows.T
    mean, total = running_mean(t, nis, dof)
    axis.set(title=f"innovations of {sensor}", ylabel="NIS per degree of freedom", yscale="log")
    mean[np.diff(t, append=t[-1]) > WINDOW] = np.nan  # interrupts the line in a gap
    low, high = (np.where(np.isnan(mean), np.nan, chi_squared.quantile(tail, total) / total) for tail in _TAILS)
    axis.fill_between(t, low, high, **_BAND)
    axis.axhline(1.0, **_IDEAL)
    _draw(axis, t, nis / dof, (t, mean), 0.1)


def _draw(axis: Axes, t: Array, single: Array, mean: tuple[Array, Array], low: float) -> None:
    """Draw single values and their running mean over time. ``t`` (N,): times [s]. ``single`` (N,): the values at these
    times. ``mean``: the times and the values of the running mean. The y axis starts at ``low`` / 4."""
    axis.plot(t, single, ".", color="0.6", markersize=2.5, label="single values", zorder=2)
    axis.plot(*mean, color=COLOURS[1], linewidth=2.0, label=f"mean over {WINDOW:g} s", zorder=3)
    # the smallest values are not in the range of the axis
    axis.set_ylim(low / 4.0, 2.0 * max(float(np.nanmax(single)), 20.0 * low))
