"""Simultaneous localization and mapping: unknown landmarks and points, and loop closure."""

__all__ = ["monoslam", "point_mapper"]
