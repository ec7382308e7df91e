"""Runs: single ones, comparisons, and experiments of many runs that are stored, resumed and reported."""

__all__ = [
    "active",
    "cluster",
    "colmap",
    "compare",
    "experiment",
    "experiment_file",
    "image_localization",
    "learning",
    "maps",
    "output",
    "particles",
    "plan",
    "reporting",
    "result_table",
    "run",
    "seeds",
    "store",
    "trajectory_score",
]
