"""What maps while it localizes: unknown landmarks and points, loop closure, robots in space."""
