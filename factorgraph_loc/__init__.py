"""Indoor localization from wheel odometry and landmarks: a GTSAM smoother and the filters that it is compared with."""

__version__ = "0.1.0"
