"""The graph estimators: keyframes, the solver iSAM2, and the batch solution of a whole run."""

__all__ = ["estimator", "graph", "problem", "settings"]
