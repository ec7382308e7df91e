"""Sensor models on plain arrays, and GTSAM factors made of them. All estimators use them; they do not depend on logs, rigs or
files."""

__all__ = [
    "camera",
    "chain",
    "chi_squared",
    "compiled",
    "compressed",
    "gaussian",
    "graph",
    "landmarks",
    "least_squares",
    "loops",
    "motion",
    "odometry",
    "positive",
    "rfid",
    "robust",
    "se2",
    "sighting",
    "update",
]
