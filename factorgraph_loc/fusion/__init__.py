"""The estimators except monoSLAM and active localization, with one interface (:mod:`factorgraph_loc.fusion.base`)."""

__all__ = [
    "base",
    "cloud",
    "dead_reckoning",
    "ekf",
    "filter",
    "graph",
    "guarded",
    "particle_filter",
    "registry",
    "search",
    "switching",
]
