"""Evaluation of logs and of results of runs: metrics, statistics, tables, plots and reports."""

__all__ = [
    "features",
    "figures",
    "inference",
    "inspect",
    "metrics",
    "pairing",
    "plots",
    "report",
    "scores",
    "statistics",
    "tables",
    "trajectories",
    "warned",
]
