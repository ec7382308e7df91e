"""Robust fits of constants, used by the calibration of sensors."""

__all__ = ["constants", "robust", "shares"]
