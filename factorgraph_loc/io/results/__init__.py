"""Files of a result folder."""

__all__ = ["estimates", "layout"]
