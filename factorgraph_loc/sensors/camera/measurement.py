"""Measurements of cameras: named points in images, and the streams of these, of images and of their features."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.measurement import Measurement, Stream
from factorgraph_loc.vision.frame import CameraFrame
from factors.se2 import Array


@dataclass(frozen=True, slots=True)
class PixelSightings:
    """Named points seen in one image: ``points``: K names; ``pixels`` (K, 2) [px], x right, y down."""

    sensor: ClassVar[str] = "sightings"
    modality: ClassVar[str] = "camera"
    is_motion: ClassVar[bool] = False
    frame: ClassVar[None] = None  # there are no features
    t: float
    points: tuple[str, ...]
    pixels: Array

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the points."""
        return self.points

    @property
    def count(self) -> int:
        """Number of points."""
        return len(self.pixels)


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
