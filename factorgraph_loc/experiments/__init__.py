"""Runs: single ones, comparisons, and experiments of many runs that are stored, resumed and reported."""

__all__ = [
    "active",
    "active_results",
    "compare",
    "experiment",
    "experiment_file",
    "maps",
    "output",
    "preparation",
    "reporting",
    "result_table",
    "run",
    "store",
]
