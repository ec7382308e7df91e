"""Results of active localization: summaries of policies, paired comparisons on the same seeds, and plots.

A run that failed, or whose robot is not localized at the end, has an infinite distance. ``rows`` are the runs:
dictionaries with world, estimator, policy, seed and figures.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from factorgraph_loc.drawing.figures import COLOURS, dress, empty, grid, legend, styles
from factorgraph_loc.evaluation.statistics import mcnemar, median_difference, median_ratio, quantile
from factorgraph_loc.evaluation.warned import Row
from factorgraph_loc.fitting.shares import wilson
from factorgraph_loc.planning.closed_loop import ActiveRun, PlanningStep
from factorgraph_loc.text import number
from factors.se2 import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Case = tuple[str, str]  # world, estimator

# columns of the table of differences and their types; the types are needed if the table is empty
DIFFERENCES: dict[str, type] = {
    **dict.fromkeys(("world", "estimator", "a", "b"), str),
    "pairs": int,
    **dict.fromkeys(("difference", "low", "high", "ratio", "ratio_low", "ratio_high"), float),
    **dict.fromkeys(("failed_only_a", "failed_only_b"), int),
    "p": float,
}
NEVER = "never"  # text of an infinite distance
SHOWN = 6  # number of decisions of a run that are plotted
COLUMNS = 3  # number of plotted decisions in a row
ARROW = 0.7  # m; length of the line that shows the robot's heading


def cases(rows: Sequence[Row]) -> list[Case]:
    """Return the distinct pairs (world, estimator) in the rows of a table of runs, in the order of the rows."""
    return list(dict.fromkeys((row["world"], row["estimator"]) for row in rows))


def policies(rows: Sequence[Row]) -> list[str]:
    """Return the names of the distinct policies in the rows of a table of runs, in the order of the rows."""
    return list(dict.fromkeys(row["policy"] for row in rows))


def runs_of(rows: Sequence[Row], case: Case, policy: str) -> list[Row]:
    """Return the rows of the runs with one ``case`` (world, estimator) and one policy."""
    return [row for row in rows if (row["world"], row["estimator"]) == case and row["policy"] == policy]


def metres(rows: Sequence[Row]) -> Array:
    """Return the distances (N,) [m] that the robots drove in N runs until they were localized, infinite if never."""
    return np.array([row["metres"] if row.get("localized") else math.inf for row in rows], dtype=float)


def summaries(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return statistics of the runs as dictionaries, for each ``world``, ``estimator`` and ``policy``. Further keys:

    - ``runs``: number of runs.
    - ``median``, ``p90``: median and 90th percentile of the distance [m] until the robot is localized.
    - ``failures``: number of runs that did not end localized. ``failures_low``, ``failures_high``: 95 % interval of
      their fraction.
    - ``claimed_wrong``: number of runs that at any time reported a wrong pose as localized.
    - ``error_position`` [m], ``error_heading`` [rad], ``seconds`` (simulated): medians over runs that ended localized.
    - ``planning_ms``: median over runs of the median computing time of a planning step.
    """
    results = []
    for case in cases(rows):
        for policy in policies(rows):
            runs = runs_of(rows, case, policy)
            if not runs:
                continue
            driven = metres(runs)
            ended = [row for row in runs if row.get("localized")]
            failures = len(runs) - len(ended)
            low, high = wilson(failures, len(runs))
            results.append(
                {
                    "world": case[0],
                    "estimator": case[1],
                    "policy": policy,
                    "runs": len(runs),
                    "median": float(np.median(driven)),
                    "p90": quantile(driven, 0.9),
                    "failures": failures,
                    "failures_low": low,
                    "failures_high": high,
                    "claimed_wrong": sum(bool(row.get("claimed_wrong")) for row in runs),
                    **{key: _median(ended, key) for key in ("error_position", "error_heading", "seconds")},
                    "planning_ms": _median(runs, "planning_ms"),
                }
            )
    return results


def differences(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return comparisons of the first policy ``a`` with each other policy ``b``, for each world and estimator.

    ``rows``: the runs. The first policy is that of the first row. Only seeds of both policies are used; ``pairs`` is
    their number. Distance means the distance [m] until the robot is localized. The other keys of a comparison are:

    - ``difference``, ``low``, ``high`` [m]: median distance of a minus that of b, and its 95 % interval.
    - ``ratio``, ``ratio_low``, ``ratio_high``: median distance of a divided by that of b, and its 95 % interval.
    - ``failed_only_a``, ``failed_only_b``: number of seeds with a failure of a only, and of b only.
    - ``p``: p value of McNemar's exact test for equal failure rates.
    """
    results = []
    first, *further = policies(rows)
    for case in cases(rows):
        ours = {row["seed"]: row for row in runs_of(rows, case, first)}
        for policy in further:
            theirs = {row["seed"]: row for row in runs_of(rows, case, policy)}
            seeds = sorted(ours.keys() & theirs.keys())
            if not seeds:
                continue
            a, b = (metres([of[seed] for seed in seeds]) for of in (ours, theirs))
            difference, ratio = median_difference(a, b), median_ratio(a, b)
            failed = mcnemar(np.isinf(a), np.isinf(b))
            values = (
                *(*case, first, policy, len(seeds)),
                *(difference.value, difference.low, difference.high, ratio.value, ratio.low, ratio.high),
                *(failed.only_a, failed.only_b, failed.p),
            )
            results.append(dict(zip(DIFFERENCES, values, strict=True)))
    return results


def summary_cells(rows: Sequence[Row]) -> tuple[list[str], list[list[str]]]:
    """Return the header and the rows of a table of statistics as text. A row has a world, an estimator and a policy."""
    header = ["world", "policy", "estimator", "runs", "median [m]", "90 % [m]", "failed (95 %)", "claimed wrongly"]
    header += ["error [m]", "[rad]", "time [s]", "planning [ms]"]
    lines = []
    for summary in summaries(rows):
        low, high = 100.0 * summary["failures_low"], 100.0 * summary["failures_high"]
        lines.append(
            [
                *(summary["world"], summary["policy"], summary["estimator"], str(summary["runs"])),
                *(metres_text(summary["median"]), metres_text(summary["p90"])),
                f"{summary['failures']} ({low:.0f} % to {high:.0f} %)",
                str(summary["claimed_wrong"]),
                *(number(summary["error_position"], 2), number(summary["error_heading"], 3)),
                *(number(summary["seconds"], 0), number(summary["planning_ms"], 1)),
            ]
        )
    return header, lines


def difference_cells(rows: Sequence[Row]) -> tuple[list[str], list[list[str]]]:
    """Return the header and the rows of a table of differences as text. A row compares two policies."""
    header = ["world", "policies", "estimator", "pairs", "difference [m] (95 %)", "ratio (95 %)"]
    header += ["failed only first / second", "p (McNemar)"]
    lines = []
    for compared in differences(rows):
        difference = [compared[key] for key in ("difference", "low", "high")]
        ratio = [compared[key] for key in ("ratio", "ratio_low", "ratio_high")]
        lines.append(
            [
                *(
                    compared["world"],
                    f"{compared['a']} / {compared['b']}",
                    compared["estimator"],
                    str(compared["pairs"]),
                ),
                *(_interval_text(difference, 1), _interval_text(ratio, 2)),
                *(f"{compared['failed_only_a']} / {compared['failed_only_b']}", f"{compared['p']:.3f}"),
            ]
        )
    return header, lines


def metres_text(value: float) -> str:
    """Return a distance [m] as text, or "never" if it is infinite."""
    return NEVER if math.isinf(value) else number(value, 1)


def _interval_text(interval: Sequence[float], digits: int) -> str:
    """Return an interval as text. ``interval``: the value, the lower and the upper bound, which may be infinite."""
    value, low, high = (
        f"{bound:.{digits}f}".replace("inf", "∞") if math.isinf(bound) else number(bound, digits) for bound in interval
    )
    return f"{value} ({low} to {high})"


def _median(rows: Sequence[Row], key: str) -> float:
    """Return the median of the result ``key`` over the runs that have it, or NaN if no run has it."""
    known = [row[key] for row in rows if row.get(key) is not None]
    return float(np.median(known)) if known else math.nan


def comparison(rows: Sequence[Row]) -> Figure:
    """Return a figure of the distances until localization (a box for each policy), and of the fraction of localized
    runs. The fraction is over the driven distance. There is a row of plots for each world and estimator."""
    panels = cases(rows)
    seeds = len({row["seed"] for row in rows})
    figure, axes = grid(len(panels), 2, 4.2 * len(panels) + 1.0, f"metres driven until localized, {seeds} runs of each")
    for (world, estimator), (boxes, shares) in zip(panels, axes, strict=True):
        for axis in (boxes, shares):
            axis.set_title(f"{world}, {estimator}")
        _boxes(boxes, rows, (world, estimator))
        _shares(shares, rows, (world, estimator))
    legend(figure, [axes[0, 1]])
    return figure


def run_picture(run: ActiveRun) -> Figure:
    """Return a figure of some decisions of a run, and of the standard deviation of the belief over distance. A decision
    is drawn as the estimated distribution of the pose (belief), the candidate paths and the chosen path."""
    chosen = np.unique(np.linspace(0, len(run.steps) - 1, SHOWN).round().astype(int)) if run.steps else ()
    rows = max(math.ceil(len(chosen) / COLUMNS), 1)
    width, depth = np.ptp(_outline(run).reshape(-1, 2), axis=0)
    height = float(np.clip(rows * (16.0 / COLUMNS * depth / max(width, 1e-9) + 0.9), 4.0, 14.0)) + 3.5
    ended = "localized" if run.localized else "not localized"
    title = f"{run.preset}, seed {run.seed}: {run.policy} with {run.estimator}, {ended} after {run.metres:.1f} m"
    figure = empty(height, title)
    names: list[Any] = [[f"{COLUMNS * row + column}" for column in range(COLUMNS)] for row in range(rows)]
    axes = figure.subplot_mosaic([*names, ["belief"] * COLUMNS], height_ratios=(*[(height - 3.5) / rows] * rows, 2.5))
    dress(axes.values())
    for panel in range(rows * COLUMNS):
        axis = axes[str(panel)]
        if panel < len(chosen):
            _step(axis, run, int(chosen[panel]))
        else:
            axis.set_axis_off()
    driven, sigmas = [step.metres for step in run.steps], [_belief_sigma(step) for step in run.steps]
    axes["belief"].semilogy(driven, np.maximum(sigmas, 1e-3), "o-", color=COLOURS[0], markersize=4)
    axes["belief"].axvline(run.metres, color="0.5", linestyle="--", label="end of the run")
    axes["belief"].set(xlabel="metres driven", ylabel="standard deviation of the belief [m]")
    legend(figure, axes.values())
    return figure


def _boxes(axis: Axes, rows: Sequence[Row], case: tuple[str, str]) -> None:
    """Plot the distances until localization of the runs of ``case`` (world, estimator), with a box for each policy.

    A dot is a run. Runs that never localized the robot are drawn at the largest distance, with their number.
    """
    names = policies(rows)
    top = _farthest(rows, case)
    rng = np.random.default_rng(0)  # horizontal jitter, so that dots do not cover each other
    for i, policy in enumerate(names):
        driven = metres(runs_of(rows, case, policy))
        shown = np.minimum(driven, top)
        if len(shown):
            style = {"color": COLOURS[i % len(COLOURS)], "linewidth": 1.6}
            props: dict[str, Any] = {f"{part}props": style for part in ("box", "whisker", "cap", "median")}
            axis.boxplot([shown], positions=[i], widths=0.6, showfliers=False, whis=(10, 90), **props)
            axis.plot(i + rng.uniform(-0.2, 0.2, len(shown)), shown, ".", color="0.6", markersize=4, zorder=1)
        never = int(np.sum(np.isinf(driven)))
        if never:
            text = f"{never} of {len(driven)}\nnever"
            axis.text(i, 0.98, text, ha="center", va="top", fontsize=11, transform=axis.get_xaxis_transform())
    axis.set_xticks(range(len(names)), names)
    axis.set_xlim(-0.6, len(names) - 0.4)
    axis.set_ylim(-0.02 * top, 1.25 * top)  # space for the counts
    axis.set_ylabel("metres (box: quartiles, 10 and 90 %)")


def _shares(axis: Axes, rows: Sequence[Row], case: tuple[str, str]) -> None:
    """Plot the fraction of localized runs of ``case`` (world, estimator) over the driven distance, by policy."""
    longest = _farthest(rows, case)
    for policy, style in zip(policies(rows), styles(), strict=False):
        driven = np.sort(metres(runs_of(rows, case, policy)))
        known = driven[np.isfinite(driven)]
        share = np.arange(len(known) + 1) / max(len(driven), 1)
        x = np.concatenate((np.zeros(1), known, (longest,)))
        axis.step(x, np.append(share, share[-1]), where="post", label=policy, linewidth=2.0, **style)
    axis.set(ylim=(0.0, 1.0), xlim=(0.0, longest), xlabel="metres driven", ylabel="fraction of localized runs")


def _farthest(rows: Sequence[Row], case: tuple[str, str]) -> float:
    """Return the largest distance [m] driven in a run of ``case`` (world, estimator), or 1 if there is no run."""
    return (
        max((row.get("metres") or 0.0 for row in rows if (row["world"], row["estimator"]) == case), default=0.0) or 1.0
    )


def _step(axis: Axes, run: ActiveRun, index: int) -> None:
    """Plot one decision of a run. ``index``: index of the decision in ``run.steps``."""
    step = run.steps[index]
    for i, (x1, y1, x2, y2) in enumerate(run.world.walls):
        axis.plot((x1, x2), (y1, y2), color="0.35", linewidth=1.0, label=None if i else "walls", zorder=1)
    tags = np.array([(tag.x, tag.y) for tag in run.world.tags.values()]).reshape(-1, 2)
    axis.plot(*tags.T, "s", color=COLOURS[-1], markersize=4, markerfacecolor="none", label="tags", zorder=2)
    axis.plot(*step.particles[:, :2].T, ".", color=COLOURS[4], markersize=2, label="belief", zorder=3)
    for i, path in enumerate(step.candidates):
        axis.plot(*path[:, :2].T, color="0.7", linewidth=0.6, label=None if i else "candidates", zorder=2)
    if step.chosen is not None:
        axis.plot(*step.chosen[:, :2].T, color=COLOURS[1], linewidth=2.2, label="chosen", zorder=6)
    x, y, heading = step.truth.tolist()
    along = (x, x + ARROW * math.cos(heading)), (y, y + ARROW * math.sin(heading))
    axis.plot(*along, color=COLOURS[0], linewidth=2.0, zorder=5)
    axis.plot(x, y, "o", color=COLOURS[0], markersize=6, label="robot (true)", zorder=5)
    truth = run.truth.poses
    driven = np.concatenate((np.zeros(1), np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T))))
    last = index == len(run.steps) - 1
    so_far = truth if last else truth[driven <= step.metres + 1e-6]
    axis.plot(*so_far[:, :2].T, color=COLOURS[0], linewidth=1.2, label="path (true)", zorder=4)
    low, high = _outline(run).min(axis=0), _outline(run).max(axis=0)
    axis.set(xlim=(low[0] - 0.5, high[0] + 0.5), ylim=(low[1] - 0.5, high[1] + 0.5))
    axis.set_aspect("equal", adjustable="box")
    axis.set_title(f"after {step.metres:.1f} m" + (f", path to the end at {run.metres:.1f} m" if last else ""))


def _belief_sigma(step: PlanningStep) -> float:
    """Return the standard deviation [m] of the belief: the root of the sum of the variances in x and y."""
    return float(np.sqrt(np.sum(np.var(step.particles[:, :2], axis=0))))


def _outline(run: ActiveRun) -> Array:
    """Return points (K, 2) that the plot must show: the ends of all walls, or without walls the robot's positions."""
    walls = np.array(run.world.walls).reshape(-1, 2)
    return walls if len(walls) else run.truth.poses[:, :2]
