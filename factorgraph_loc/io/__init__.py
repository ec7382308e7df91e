"""Logs and results in files: formats of others, the native one, ROS bags."""

__all__ = ["bags", "native", "readers", "results", "write"]
