"""Types shared by all packages: logs, rigs, worlds, trajectories, beliefs, diagnostics."""

__all__ = [
    "belief",
    "diagnostics",
    "log",
    "measurement",
    "motion",
    "planar",
    "result",
    "rig",
    "scoring",
    "sections",
    "settings",
    "setup",
    "ticks",
    "trajectory",
    "trajectory3",
    "world",
]
