"""Evaluation of point features: repeatability and matching."""

__all__ = ["feature_evaluation", "repeatability", "scores", "sequences"]
