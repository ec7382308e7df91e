"""A recording made by a physics engine (pybullet) that is not part of this project, for scripts/benchmarks/record_physics."""
