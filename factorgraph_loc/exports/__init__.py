"""Results for other programs: viewers (Rerun, Foxglove), trajectories (TUM, KITTI) and pose graphs (g2o)."""

__all__ = ["foxglove", "points", "rerun_scene", "runs", "trajectories"]
