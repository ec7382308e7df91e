"""The library for a robot that drives."""

__all__ = ["localizer"]
