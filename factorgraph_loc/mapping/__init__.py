"""Maps made from logs: landmarks, tags, and 3-D points from images."""

__all__ = [
    "map_figure",
    "mapping",
    "point_mapping",
    "point_maps",
    "tag_mapping",
]
