"""Evaluation of point features of images: repeatability and matching."""

__all__ = ["feature_evaluation", "repeatability", "scores", "sequences"]
