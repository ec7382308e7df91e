"""The native format: run folders, rigs and worlds."""

__all__ = ["default_rig", "native", "rig_file", "world_file"]
