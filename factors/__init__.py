"""Sensor models on plain arrays, and GTSAM factors made of them. All estimators use them; they do not depend on logs, rigs or
files."""

__all__ = [
    "between",
    "camera",
    "chain",
    "chi_squared",
    "compiled",
    "compressed",
    "graph",
    "landmarks",
    "loops",
    "marginal",
    "motion",
    "odometry",
    "positive",
    "positive_kernels",
    "rfid",
    "robust",
    "rts_kernels",
    "se2",
    "se2_kernels",
    "small_kernels",
    "update",
]
