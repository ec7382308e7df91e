"""How well points of images are found again."""

__all__ = ["feature_evaluation", "repeatability", "scores", "sequences"]
