"""Results for other programs: viewers (Rerun, Foxglove, RViz), trajectories (TUM, KITTI) and pose graphs (g2o)."""

__all__ = ["rerun_scene", "rerun_viewer", "ros", "runs", "trajectories"]
