"""Readers of log formats, one module for each format, and ``load``, which selects the reader of a log."""

from factorgraph_loc.io.readers.load import LogLike, RigLike, WorldLike, load, load_all, read_log, reader
from factorgraph_loc.io.readers.manifests import Dataset, Manifest, describe, read_manifest, verify
from factorgraph_loc.plugins import READERS

__all__ = [
    "READERS",
    "Dataset",
    "LogLike",
    "Manifest",
    "RigLike",
    "WorldLike",
    "describe",
    "load",
    "load_all",
    "manifests",
    "mapped",
    "mapped_motion",
    "mrclam",
    "plaza",
    "pose_file",
    "pyfg",
    "read_log",
    "read_manifest",
    "reader",
    "verify",
]
