"""The estimators, behind one interface (:mod:`factorgraph_loc.fusion.base`)."""

__all__ = [
    "base",
    "batch",
    "cloud",
    "dead_reckoning",
    "ekf",
    "graph_parts",
    "guarded",
    "kld",
    "least_squares",
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
