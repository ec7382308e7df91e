"""The streams of cameras: named points, images and their features."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.measurement import Measurement, Stream
from factorgraph_loc.sensors.camera.measurement import PixelSightings
from factorgraph_loc.vision.frame import CameraFrame
from factors.se2 import Array

APART = 0.02  # s between an image and its depth image


@dataclass(frozen=True)
class SightingStream(Stream):
    """Rows of named points in images: name and pixel (``u``, ``v``) [px]. Rows with equal timestamps form one measurement."""

    point: Sequence[str]
    u: Array
    v: Array

    def measurements(self, offset: float) -> Iterator[Measurement]:
        for i, j in self.scans():
            pixels = np.column_stack((self.u[i:j], self.v[i:j]))
            yield PixelSightings(float(self.t[i]) + offset, tuple(self.point[i:j]), pixels)


@dataclass(frozen=True)
class ImageStream(Stream):
    """Image files (N,), and the depth image (N,) of each, or None; by default all None.
    :mod:`factorgraph_loc.sensors.camera.frontend` turns them into features."""

    file: Sequence[Path]
    depth: Sequence[Path | None] = ()

    def __post_init__(self) -> None:
        if not self.depth:
            object.__setattr__(self, "depth", [None] * len(self.file))

    def with_depths(self, depths: "ImageStream") -> "ImageStream":
        """The images with the depth image of each: the one nearest in time, at most :data:`APART` from it."""
        near = [int(np.abs(depths.t - t).argmin()) if len(depths.t) else -1 for t in self.t]
        files = [
            depths.file[i] if i >= 0 and abs(depths.t[i] - t) <= APART else None
            for i, t in zip(near, self.t, strict=True)
        ]
        return replace(self, depth=files)

    def measurements(self, offset: float) -> Iterator[Measurement]:
        raise InputError("images have no measurements before feature detection")


@dataclass(frozen=True)
class FeatureStream(Stream):
    """Features of images: ``frame`` (N,), whose own timestamps are ignored."""

    frame: Sequence[CameraFrame]

    def measurements(self, offset: float) -> Iterator[Measurement]:
        for t, frame in zip((self.t + offset).tolist(), self.frame, strict=True):
            yield replace(frame, t=t)
