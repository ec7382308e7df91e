"""RFID tags: detection, strength and phase."""

from factors.rfid.model import BeamModel, DetectionModel, GridModel, LogisticModel

__all__ = [
    "BeamModel",
    "DetectionModel",
    "GridModel",
    "LogisticModel",
    "detection",
    "factor",
    "kernels",
    "knots",
    "model",
    "parameters",
    "signals",
    "tag_states",
]
