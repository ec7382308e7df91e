"""Calibration of wheel odometry from logs with a reference."""

__all__ = ["calibrator", "constants"]
