"""Localization and mapping at once: unknown landmarks and points, loop closure, and robots in space."""

__all__ = ["monoslam", "point_mapper", "space_batch", "space_smoother"]
