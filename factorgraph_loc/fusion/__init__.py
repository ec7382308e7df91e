"""The estimators, behind one interface (:mod:`factorgraph_loc.fusion.base`)."""

__all__ = [
    "base",
    "cloud",
    "cloud_view",
    "dead_reckoning",
    "ekf",
    "graph",
    "guarded",
    "kld",
    "mapping",
    "particle_filter",
    "registry",
    "switching",
    "timeline",
]
