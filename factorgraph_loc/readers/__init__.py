"""Readers: one module per log format, and ``load``, which finds the right one."""

from factorgraph_loc.readers.load import load, read_log
from factorgraph_loc.readers.manifests import Dataset, Manifest, describe, read_manifest, verify
from factorgraph_loc.readers.native import write_native
from factorgraph_loc.readers.registry import READERS
from factorgraph_loc.readers.write import write_log
from factorgraph_loc.shipped import manifests

__all__ = [
    "READERS",
    "Dataset",
    "Manifest",
    "describe",
    "load",
    "manifests",
    "read_log",
    "read_manifest",
    "verify",
    "write_log",
    "write_native",
]
