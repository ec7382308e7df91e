"""Points, markers, walls and free space."""

__all__ = ["common_error", "free_space", "markers", "occupancy", "points"]
