"""Readers of log formats, one module each, and ``load``, which selects the reader."""

from factorgraph_loc.io.readers.load import load, read_log, reader
from factorgraph_loc.io.readers.manifests import Dataset, Manifest, describe, read_manifest, verify
from factorgraph_loc.plugins import READERS

__all__ = [
    "READERS",
    "Dataset",
    "Manifest",
    "describe",
    "load",
    "manifests",
    "mapped",
    "mrclam",
    "plaza",
    "pose_file",
    "read_log",
    "read_manifest",
    "reader",
    "verify",
]
