"""One package per sensor: its measurement, stream, settings, map layer, simulation, calibration and summary."""

__all__ = [
    "base",
    "calibrating",
    "camera",
    "interfaces",
    "known_position",
    "landmarks",
    "loops",
    "motion",
    "odometry",
    "positions",
    "registry",
    "rfid",
    "smoothed",
    "tables",
]
