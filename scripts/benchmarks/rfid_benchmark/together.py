"""Unknown starts and kidnappings with tags, with landmarks, and with both in the same logs."""

from __future__ import annotations

from benchmarking.report import Options, Report

from factorgraph_loc.simulation.settings import preset
from rfid_benchmark.simulated_trials import Kind, SimulatedTrial, SimulatedTrialJob, run_simulated_trials
from rfid_benchmark.starts import CHUNK, FIRST, SEEDS, row

SCENE = {"world": {"tags": 25, "landmarks": 6}}
SENSORS = {
    "tags": ("odometry", "rfid"),
    "landmarks": ("odometry", "bearing_range"),
    "both": ("odometry", "rfid", "bearing_range"),
}
KINDS: tuple[Kind, ...] = ("unknown start", "kidnapping")
DEADLINE = 30.0  # s


def section(options: Options) -> Report:
    report = Report("together", options)
    seeds = range(FIRST, FIRST + options.count(SEEDS))
    chunks = [tuple(seeds[i : i + CHUNK]) for i in range(0, len(seeds), CHUNK)]
    jobs = {
        (kind, name, chunk): SimulatedTrialJob(
            kind, preset("office", SCENE), chunk, "smoother", DEADLINE, sensors=sensors
        )
        for kind in KINDS
        for name, sensors in SENSORS.items()
        for chunk in chunks
    }
    labels = [f"{kind}, {name}, from seed {chunk[0]}" for kind, name, chunk in jobs]
    outcomes = report.collect(run_simulated_trials, list(jobs.values()), labels)
    found: dict[tuple[str, str], list[SimulatedTrial]] = {}
    for i, (kind, name, _) in enumerate(jobs):
        found.setdefault((kind, name), []).extend(outcomes.get(i, []))
    report.say(f"{len(seeds)} trials of each kind in an office of 25 tags and 6 landmarks; columns as above")
    heads = ("", "sensors", "estimator", "within", "right in time", "median [s]", "called so in time", "false claims")
    report.table(heads, [row((kind, name, "smoother", DEADLINE), trials) for (kind, name), trials in found.items()])
    single = [(*key, t.seed, t.seconds, t.claimed, t.false) for key, trials in found.items() for t in trials]
    report.figures("trials", ("kind", "sensors", "seed", "seconds", "claimed", "false"), single)
    return report
