"""Pixels of points in space: model, kernels, factors."""

__all__ = [
    "factor",
    "inverse_depth",
    "kernels",
    "model",
    "point",
    "triangulation_kernels",
    "update_kernels",
]
