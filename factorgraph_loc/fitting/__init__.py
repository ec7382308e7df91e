"""Robust fits of constants, used by the calibration of sensors."""
