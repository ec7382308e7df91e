"""The numerical core on plain arrays: sensor models, factors, Gaussian corrections, least squares, planar poses. It
does not depend on logs, rigs or files."""

__all__ = [
    "camera",
    "chain",
    "chi_squared",
    "compiled",
    "gaussian",
    "graph",
    "landmarks",
    "least_squares",
    "loops",
    "motion",
    "odometry",
    "positions",
    "positive",
    "rfid",
    "robust",
    "se2",
    "sighting",
    "update",
]
