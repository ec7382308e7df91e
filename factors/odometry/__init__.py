"""Increments of wheel odometry: model, integration, kernels."""

__all__ = ["chain", "factor", "kernels", "model"]
