"""The same policy on top of other estimators."""

from __future__ import annotations

from benchmarking.report import Options, Report

from active_benchmark.runs import compared, goal

SEEDS = 10
ESTIMATORS = ("active_mcl", "particle_filter", "smoother")
POLICIES = ("information", "random", "patrol")
WORLDS = ("symmetric", "warehouse")


def section(options: Options) -> Report:
    seeds = range(options.count(SEEDS))
    return compared("estimators", options, dict.fromkeys(ESTIMATORS, POLICIES), seeds, goal(seeds), WORLDS)
