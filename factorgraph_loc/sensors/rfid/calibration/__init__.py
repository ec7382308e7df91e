"""Calibration of RFID readers and tags from logs with a reference."""

__all__ = ["calibrator", "rounds", "signals"]
