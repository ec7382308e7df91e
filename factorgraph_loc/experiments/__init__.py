"""Execution of runs: single runs, comparisons, and experiments of many runs, with stored results and reports."""

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
