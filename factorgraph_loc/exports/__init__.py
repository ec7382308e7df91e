"""Results for other programs: viewers (Rerun, Foxglove, RViz) and trajectories (TUM, KITTI)."""

__all__ = ["rerun_scene", "rerun_viewer", "ros", "runs", "trajectories"]
