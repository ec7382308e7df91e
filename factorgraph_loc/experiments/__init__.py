"""Runs: single ones, comparisons, and experiments of many runs that are stored, resumed and reported."""

__all__ = [
    "active",
    "active_results",
    "compare",
    "experiment",
    "experiment_file",
    "learning",
    "maps",
    "output",
    "plan",
    "reporting",
    "result_table",
    "run",
    "seeds",
    "store",
]
