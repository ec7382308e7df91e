"""A package for each sensor: its measurement, stream, settings, map, simulation, calibration and summary."""
