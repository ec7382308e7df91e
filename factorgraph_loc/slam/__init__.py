"""Localization and mapping at once: unknown landmarks and points, and loop closure."""

__all__ = ["monoslam", "point_mapper"]
