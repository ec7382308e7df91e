"""Exports of logs and results for the viewers Rerun, Foxglove and RViz."""

__all__ = ["rerun_scene", "rerun_viewer", "ros", "runs"]
