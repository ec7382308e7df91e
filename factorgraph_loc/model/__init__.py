"""Types shared by all packages: logs, rigs, worlds, trajectories, beliefs, diagnostics."""

__all__ = [
    "belief",
    "diagnostics",
    "log",
    "measurement",
    "planar",
    "pose_path",
    "result",
    "rig",
    "scoring",
    "sections",
    "settings",
    "setup",
    "trajectory",
    "world",
]
