"""Ranges and bearings of landmarks: model and factor."""

__all__ = ["factor", "kernels", "model"]
