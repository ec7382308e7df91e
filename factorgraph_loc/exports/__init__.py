"""Results for other programs: viewers (Rerun, Foxglove), trajectories (TUM, KITTI) and pose graphs (g2o)."""
