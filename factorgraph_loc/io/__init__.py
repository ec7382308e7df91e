"""Files of logs and results: the native format, foreign formats, ROS bags."""

__all__ = ["bags", "checks", "native", "readers", "results", "trajectories"]
