"""Calibration of a robot's sensors (constants and noise) from logs with a reference trajectory, or from smoothed ones."""

__all__ = ["calibrate", "learn", "report", "turns"]
