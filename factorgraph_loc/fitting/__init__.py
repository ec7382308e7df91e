"""Maximum a posteriori estimates of parameters that several logs have in common, and confidence intervals of proportions."""

__all__ = ["posterior", "shares"]
