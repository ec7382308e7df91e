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
    """Image files (N,). :mod:`factorgraph_loc.sensors.camera.frontend` turns them into features."""

    file: Sequence[Path]

    def measurements(self, offset: float) -> Iterator[Measurement]:
        raise InputError("images have no measurements before feature detection")


@dataclass(frozen=True)
class FeatureStream(Stream):
    """Features of images: ``frame`` (N,), whose own timestamps are ignored."""

    frame: Sequence[CameraFrame]

    def measurements(self, offset: float) -> Iterator[Measurement]:
        for t, frame in zip((self.t + offset).tolist(), self.frame, strict=True):
            yield replace(frame, t=t)
