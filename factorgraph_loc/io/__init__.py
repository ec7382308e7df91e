"""Files of logs and results: the native format, foreign formats, ROS bags."""

__all__ = ["bags", "checks", "colmap", "native", "readers", "results", "trajectories"]
