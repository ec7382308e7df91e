"""What maps while it localizes: unknown landmarks and points, loop closure, robots in space."""

__all__ = ["monoslam", "point_mapper", "space_batch"]
