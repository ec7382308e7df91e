"""One package per sensor: its measurement, stream, settings, map layer, simulation, calibration and summary."""

__all__ = [
    "base",
    "binding",
    "calibrating",
    "camera",
    "forecast",
    "known_position",
    "landmarks",
    "marks",
    "measurements",
    "odometry",
    "pushed",
    "registry",
    "rfid",
    "simulated",
    "summary",
    "tables",
    "twist",
    "usage",
]
