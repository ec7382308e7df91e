"""Calibration of RFID readers: survey of the tags, mounting of the antennas, and models of detection, strength and phase."""

__all__ = ["calibrator", "rounds", "signals"]
