"""Runs: one, several that are compared, and experiments of many that are kept, resumed and reported."""

__all__ = [
    "active",
    "cluster",
    "compare",
    "experiment",
    "experiment_file",
    "image_localization",
    "index",
    "maps",
    "output",
    "particles",
    "plan",
    "reporting",
    "run",
    "seeds",
    "store",
]
