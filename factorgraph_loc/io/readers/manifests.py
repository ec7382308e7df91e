"""Manifests: files that describe a log, its reader, rig and map. Shipped data sets have manifests, too."""

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from factorgraph_loc.files.columns import LATEST
from factorgraph_loc.files.data_root import DATA_ROOT, find_data_root
from factorgraph_loc.files.models import Coordinate, FileModel, InUnit, inside, parse_model, read_toml
from factorgraph_loc.files.shipped import manifests
from factorgraph_loc.maps.markers import MarkerSettings
from factorgraph_loc.model.log import StartPose


class StartSettings(FileModel):
    """A known start: pose, standard deviations of position and heading, and absolute time, by default t = 0 of the log."""

    x: Coordinate
    y: Coordinate
    heading: Annotated[float, Field(ge=-7.0, le=7.0), InUnit("rad")]
    sigma_position: Annotated[float, Field(ge=1e-6, le=1000.0), InUnit("m")]
    sigma_heading: Annotated[float, Field(ge=1e-6, le=10.0), InUnit("rad")]
    t_ns: Annotated[int, Field(ge=-LATEST, le=LATEST), InUnit("ns")] | None = None

    def pose(self, t0_ns: int) -> StartPose:
        """Return the start pose, with its time [s] since ``t0_ns`` [ns], the absolute time of the log's t = 0."""
        t = 0.0 if self.t_ns is None else (self.t_ns - t0_ns) / 1e9
        sigmas = np.array((self.sigma_position, self.sigma_position, self.sigma_heading))
        return StartPose(t, np.array((self.x, self.y, self.heading)), sigmas)


class Manifest(FileModel):
    """A manifest, the description of one or several logs. ``title``, ``licence``, ``origin``: texts about the data.

    ``reader``: name of the reader of the log. ``options``: its options; a list of values gives several logs.
    ``path``, ``rig``, ``world``: the data, the rig and the map, below the folder of the manifest or the data folder.
    ``start``: a known start of the log.
    ``markers``: the family of the markers to detect in the images of the log.
    ``checksums``: the sha256 of each file by name.
    """

    title: str
    reader: str
    licence: str = "none stated"
    origin: str = ""
    path: str | None = None
    rig: str | None = None
    world: str | None = None
    options: Mapping[str, Any] = Field(default_factory=dict)
    start: StartSettings | None = None
    markers: MarkerSettings | None = None
    checksums: Mapping[str, Annotated[str, Field(pattern="^[0-9a-f]{64}$")]] = Field(default_factory=dict)


@dataclass(frozen=True)
class Dataset:
    """A shipped data set. ``present``: True if its files exist. The other fields are from its manifest."""

    name: str
    title: str
    reader: str
    licence: str
    origin: str
    present: bool


def read_manifest(file: Path) -> Manifest:
    """Return the manifest in ``file``. Raises InputError with the file, the key and the expected value."""
    return parse_model(Manifest, read_toml(file), file)


def describe(data_root: str | Path | None = None) -> list[Dataset]:
    """Return the shipped data sets, sorted by name. ``data_root``: the folder of their files, by default FGLOC_DATA.

    Raises InputError if the folder does not exist."""
    datasets = []
    for name, file in manifests().items():
        m = read_manifest(file)
        datasets.append(Dataset(name, m.title, m.reader, m.licence, m.origin, is_present(m, file, data_root)))
    return datasets


def is_present(manifest: Manifest, file: Path, data_root: str | Path | None) -> bool:
    names = [*manifest.checksums, *([] if manifest.path is None else [manifest.path])]
    if not names:
        return True
    if data_root is None and not os.environ.get(DATA_ROOT):
        return False
    root = find_data_root(data_root, file)
    return all(inside(root, name, file).exists() for name in names)


def verify(manifest: Manifest, data_root: str | Path | None = None) -> list[str]:
    """Return a line of text about each file that is missing or differs from its sha256 in ``manifest.checksums``.

    ``data_root``: the folder of the files, by default the environment variable FGLOC_DATA."""
    if not manifest.checksums:
        return []
    root = find_data_root(data_root, manifest.title)
    faults = []
    for name, expected in manifest.checksums.items():
        file = inside(root, name, manifest.title)
        if not file.is_file():
            faults.append(f"{file}: is missing")
            continue
        with file.open("rb") as content:
            if hashlib.file_digest(content, "sha256").hexdigest() != expected:
                faults.append(f"{file}: is not the file that the manifest describes (its sha256 differs)")
    return faults
