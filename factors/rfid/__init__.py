"""Likelihoods and factors of RFID measurements: reads and misses, signal strength, phase."""

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
