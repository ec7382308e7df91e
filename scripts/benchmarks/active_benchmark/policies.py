"""Distance until localized: policies in three worlds, with the filter of the paper."""

from __future__ import annotations

from benchmarking.report import Options, Report

from active_benchmark.runs import compared, goal

SEEDS = 200
POLICIES = ("information", "random", "patrol", "nearest_tags", "paper_literal")


def section(options: Options) -> Report:
    seeds = range(options.count(SEEDS))
    return compared("policies", options, {"active_mcl": POLICIES}, seeds, goal(seeds))
