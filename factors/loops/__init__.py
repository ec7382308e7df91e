"""Loops: a place that is met again, as a robust factor on two poses."""

__all__ = ["factor"]
