"""Calibration of a robot's sensors (constants and noise) along a reference or a smoothed trajectory."""

__all__ = ["calibrate", "learn", "report"]
