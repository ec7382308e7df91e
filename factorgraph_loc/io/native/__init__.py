"""The native format: run folders, rigs and worlds."""

__all__ = ["kalibr", "native", "rig_file", "world_file"]
