"""Sensor models on plain arrays, and the GTSAM factors made of them.

Everything that we believe about a sensor is written here once; particle filter, EKF and smoother all call it.
This package knows nothing of logs, rigs or files.
"""

__all__ = [
    "camera",
    "compressed",
    "graph",
    "landmarks",
    "marginal",
    "motion",
    "odometry",
    "positive",
    "rfid",
    "rts_kernels",
    "se2",
    "update",
]
