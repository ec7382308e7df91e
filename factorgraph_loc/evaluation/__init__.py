"""Evaluation of results: metrics, statistics, tables and plots."""

__all__ = [
    "active",
    "active_figures",
    "alignment",
    "estimates_file",
    "features",
    "figures",
    "inference",
    "inspect",
    "metrics",
    "paired",
    "pairing",
    "plots",
    "report",
    "statistics",
    "tables",
    "trajectories",
    "warned",
]
