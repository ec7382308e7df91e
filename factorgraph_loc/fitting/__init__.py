"""Maximum a posteriori estimates of shared parameters, and intervals of shares."""

__all__ = ["posterior", "shares"]
