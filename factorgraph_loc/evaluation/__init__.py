"""Evaluation of results: metrics, statistics, tables and plots."""

__all__ = [
    "active",
    "features",
    "figures",
    "inference",
    "inspect",
    "metrics",
    "pairing",
    "plots",
    "report",
    "statistics",
    "tables",
    "trajectories",
    "warned",
]
