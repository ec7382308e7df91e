"""Increments of wheel odometry: model, chain of states, kernels."""

__all__ = ["chain", "kernels", "model"]
