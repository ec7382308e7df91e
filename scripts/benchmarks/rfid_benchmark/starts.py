"""Unknown starts and kidnappings in simulated offices, with a new world in each trial."""

from __future__ import annotations

import math

import numpy as np
from benchmarking.report import Options, Report, share_text

from factorgraph_loc.simulation.settings import preset
from rfid_benchmark.simulated_trials import Kind, SimulatedTrial, run_simulated_trials

SEEDS = 100
CHUNK = 10  # trials per process
FIRST = 1000  # first seed, not used by other sections
KINDS: tuple[tuple[Kind, str, float], ...] = (
    ("unknown start", "office", 5.0),
    ("unknown start", "sparse", 10.0),
    ("kidnapping", "office", 15.0),
)


def section(options: Options) -> Report:
    report = Report("starts", options)
    seeds = range(FIRST, FIRST + options.count(SEEDS))
    chunks = [tuple(seeds[i : i + CHUNK]) for i in range(0, len(seeds), CHUNK)]
    jobs = {
        (kind, name, estimator, deadline, chunk[0]): (kind, preset(name), estimator, deadline, chunk)
        for kind, name, deadline in KINDS
        for estimator in ("smoother", "particle_filter")
        for chunk in chunks
    }
    found: dict[tuple[str, str, str, float], list[SimulatedTrial]] = {}
    for (*key, _), trials in report.collect(run_simulated_trials, jobs).items():
        found.setdefault(tuple(key), []).extend(trials)
    report.say(
        f"Each row has {len(seeds)} trials. Shares have 95 % intervals. *Right in time*: the error falls below 0.5 m and "
        "15 degrees before the deadline *within*, and stays below for 10 s. *Localized in time*: before the deadline the "
        "status is `localized` and the pose is right (in brackets: the median time). *False claims*: the first pose with "
        "the status `localized` is wrong (in brackets: the share of wrong poses that the covariances predict). After a "
        "kidnapping, a false claim is a wrong pose with the status `localized` at the deadline."
    )
    report.table(
        ("", "preset", "estimator", "within", "right in time", "median [s]", "localized in time", "false claims"),
        [row(key, trials) for key, trials in found.items()],
    )
    late = [
        f"{kind}, {name}, {estimator}: " + ", ".join(str(t.seed) for t in trials if not t.seconds <= deadline)
        for (kind, name, estimator, deadline), trials in found.items()
        if any(not t.seconds <= deadline for t in trials)
    ]
    report.say("Seeds of trials that were not right in time: " + ("; ".join(late) or "none") + ".")
    return report


def row(key: tuple[str, str, str, float], trials: list[SimulatedTrial]) -> tuple[str, ...]:
    kind, name, estimator, deadline = key
    count = len(trials)
    in_time = share_text(sum(t.seconds <= deadline for t in trials), count)
    called = share_text(sum(t.claimed <= deadline and not t.false for t in trials), count)
    median, claimed = (middle([getattr(t, what) for t in trials]) for what in ("seconds", "claimed"))
    false = share_text(sum(t.false for t in trials), count)
    doubts = [t.doubt for t in trials if not math.isnan(t.doubt)]
    if doubts:
        false += f" (stated {100 * np.mean(doubts):.1f} %)"
    return kind, name, estimator, f"{deadline:.0f} s", in_time, median, f"{called} ({claimed} s)", false


def middle(seconds: list[float]) -> str:
    """Return the median of times as a text. Failed trials (NaN) have infinite times. Returns "never" for an infinite median."""
    median = np.median(np.where(np.isnan(seconds), np.inf, seconds))
    return f"{median:.1f}" if np.isfinite(median) else "never"
