"""The estimators with factor graphs: keyframes, incremental solution by iSAM2, and the batch solution of a whole run."""

__all__ = ["estimator", "graph", "problem", "settings"]
