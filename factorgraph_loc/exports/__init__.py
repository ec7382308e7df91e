"""Results for viewers: Rerun, Foxglove, RViz."""

__all__ = ["rerun_scene", "rerun_viewer", "ros", "runs"]
