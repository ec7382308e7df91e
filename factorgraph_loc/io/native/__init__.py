"""The native format: run folders, rigs and worlds."""

__all__ = ["native", "rig_file", "world_file"]
