"""Evaluation of results: metrics, statistics, tables and plots."""

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
