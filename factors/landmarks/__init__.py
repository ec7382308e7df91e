"""Ranges and bearings of landmarks: model and factor."""

__all__ = ["factor", "model", "update_kernels"]
