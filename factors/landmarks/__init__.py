"""Ranges and bearings of landmarks: measurement model and factor."""

__all__ = ["factor", "kernels", "late", "model"]
