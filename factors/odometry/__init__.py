"""Wheel odometry: noise model, integration to relative poses, factors."""

__all__ = ["chain", "factor", "kernels", "model"]
