"""The native format: run folders, rigs and worlds."""

__all__ = ["default_rig", "native", "new_rig", "rig_file", "rig_text", "world_file"]
