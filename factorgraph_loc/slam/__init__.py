"""Simultaneous localization and mapping with images: monoSLAM, unknown points, and loop closure."""

__all__ = ["monoslam", "point_mapper"]
