"""Measured positions of a point of the robot."""

__all__ = ["factor"]
