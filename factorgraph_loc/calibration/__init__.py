"""Calibration of a robot's sensors (constants and noise), from logs with a reference trajectory or a smoothed one."""

__all__ = ["calibrate", "learn", "report"]
