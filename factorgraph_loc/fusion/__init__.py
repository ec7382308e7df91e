"""The estimators, behind one interface (:mod:`factorgraph_loc.fusion.base`)."""

__all__ = [
    "base",
    "batch",
    "cloud",
    "cloud_view",
    "dead_reckoning",
    "ekf",
    "graph_parts",
    "guarded",
    "kld",
    "map_frame",
    "mapping",
    "marginals",
    "particle_filter",
    "problem",
    "registry",
    "smoother",
    "switching",
    "timeline",
    "variables",
]
