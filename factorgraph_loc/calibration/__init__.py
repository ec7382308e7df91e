"""Calibration of a robot's sensors (constants and noise) from logs with a reference trajectory."""

__all__ = ["calibrate", "report"]
