"""Files of logs and results: the native format, foreign formats, ROS bags."""

__all__ = ["bags", "checks", "folder_manifest", "native", "proposals", "readers", "results", "trajectories"]
