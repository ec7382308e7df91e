"""Pixels of points in space: camera model, compiled functions, factors."""

__all__ = [
    "factor",
    "inverse_depth",
    "kernels",
    "model",
    "point",
    "triangulation_kernels",
    "update_kernels",
]
