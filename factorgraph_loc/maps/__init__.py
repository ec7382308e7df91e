"""Points, markers, walls and free space."""

__all__ = ["free_space", "markers", "occupancy", "points", "tag_file"]
