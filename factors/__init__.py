"""Sensor models on plain arrays, and GTSAM factors made of them. All estimators use them; they do not depend on logs, rigs or
files."""

__all__ = [
    "between",
    "camera",
    "chain",
    "chi_squared",
    "compiled",
    "compressed",
    "gaussian_kernels",
    "graph",
    "landmarks",
    "least_squares",
    "loops",
    "marginal",
    "motion",
    "odometry",
    "positive",
    "rfid",
    "robust",
    "se2",
    "se2_kernels",
    "small_kernels",
    "update",
]
