"""One package per sensor: its measurement, stream, settings, map layer, simulation, calibration and summary."""

__all__ = [
    "base",
    "binding",
    "calibrating",
    "camera",
    "interfaces",
    "known_position",
    "landmarks",
    "loops",
    "measurements",
    "motion",
    "odometry",
    "pushed",
    "registry",
    "rfid",
    "smoothed",
    "tables",
]
