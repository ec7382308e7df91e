"""Settings of RFID readers: antennas, models of detection, strength and phase, and files of detection grids."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, PrivateAttr, model_validator

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.bounded import GRID, foreign, opened, require_size
from factorgraph_loc.files.models import Coordinate, FileModel, InUnit, inside, replacing
from factorgraph_loc.model.settings import Angle, Estimated, Offset, SensorSettings
from factorgraph_loc.text import listed, quoted
from factors import se2
from factors.rfid.model import Antenna, BeamModel, DetectionModel, GridModel, LogisticModel, RfidModel
from factors.rfid.parameters import OF_MODEL
from factors.rfid.signals import PhaseModel, RssiModel
from factors.se2 import Array

Weight = Annotated[float, Field(ge=-1e6, le=1e6)]
Share = Annotated[float, Field(ge=0.0, lt=0.5)]


class PriorSettings(FileModel):
    """Standard deviations of two parameters of a detection model before a run (:mod:`factors.rfid.parameters`).
    Parameters with a value above 0 are estimated."""

    range_scale: Annotated[float, Field(ge=0.0, le=1.0)] = 0.1
    """standard deviation of the logarithm of the model's range"""
    read_rate: Annotated[float, Field(ge=0.0, le=3.0)] = 1.0
    """standard deviation of the logit of the model's largest probability"""


class RfidUncertainty(FileModel):
    """Standard deviations of the yaws of antennas and of the time offset before a run. A constant is estimated if its
    value is above 0. The defaults are proportional to the largest ``prior.range_scale`` of the detection models."""

    yaw: Annotated[float, Field(ge=0.0, le=1.0), InUnit("rad")] | None = None
    """standard deviation of a yaw that all antennas share; by default 0.35 times the largest prior.range_scale"""
    antenna_yaw: Annotated[float, Field(ge=0.0, le=1.0), InUnit("rad")] | None = None
    """standard deviation of an additional yaw of each of several antennas; by default 0.25 times the largest prior.range_scale"""
    time_offset: Annotated[float, Field(ge=0.0, le=1.0), InUnit("s")] | None = None
    """standard deviation of the time offset; by default 0.4 times the largest prior.range_scale"""


BY_RANGE = {"yaw": 0.35, "antenna_yaw": 0.25, "time_offset": 0.4}  # rad, rad, s; defaults for range_scale = 1


class BeamSettings(FileModel):
    """A detection model of a directional antenna. The probability of a read at distance r and bearing phi is
    p0 sigmoid((r_max - r) / s_r) exp(-(phi / sigma_phi)^2 / 2). See :class:`factors.rfid.model.BeamModel`."""

    kind: Literal["beam"] = "beam"
    """kind of model: beam falls off with distance and bearing, logistic has eleven coefficients, grid is a table"""
    prior: PriorSettings = Field(default_factory=PriorSettings)
    """standard deviations of the model's parameters before a run"""
    p0: Annotated[float, Field(ge=1e-6, le=1.0 - 1e-6)] = 0.9
    """beam: largest probability of a read"""
    r_max: Annotated[float, Field(ge=0.01, le=50.0), InUnit("m")] = 4.5
    """beam: distance at which the probability has fallen to a half"""
    s_r: Annotated[float, Field(ge=1e-3, le=10.0), InUnit("m")] = 0.3
    """beam: length scale of the fall at r_max"""
    sigma_phi: Annotated[float, Field(ge=1e-3, le=10.0), InUnit("rad")] = 0.698
    """beam: width of the beam, as standard deviation of the bearing"""
    behind: Annotated[float, Field(ge=1e-3, le=1.0)] = 1.0
    """beam: read probability from behind a tag, relative to that from its front"""

    def model(self) -> DetectionModel:
        return BeamModel(self.p0, self.r_max, self.s_r, self.sigma_phi, self.behind)


class LogisticSettings(FileModel):
    """A detection model by logistic regression on 11 features of the tag's pose in the antenna frame. See
    :class:`factors.rfid.model.LogisticModel`."""

    kind: Literal["logistic"] = "logistic"
    prior: PriorSettings = Field(default_factory=PriorSettings)
    coefficients: Annotated[tuple[Weight, ...], Field(min_length=11, max_length=11)]
    """logistic: coefficients of the logit of the probability of a read, in the order of factors.rfid.model.FEATURES"""

    def model(self) -> DetectionModel:
        return LogisticModel(self.coefficients)


class GridSettings(FileModel):
    """A detection model that consists of read probabilities on a grid around the antenna, stored in a file."""

    kind: Literal["grid"] = "grid"
    prior: PriorSettings = Field(default_factory=PriorSettings)
    file: str
    """grid: name of an .npz file in the folder of the rig's file"""
    _folder: Path = PrivateAttr(default=Path())

    def model(self) -> GridModel:
        """Return the grid in the file. Raises InputError if the file is invalid."""
        return read_grid(self.path())

    def path(self) -> Path:
        return inside(self._folder, self.file, "grid")

    def placed(self, folder: Path) -> GridSettings:
        """Return a copy that reads its file from ``folder``, the folder of the rig's file."""
        out = self.model_copy()
        out._folder = folder
        return out


ModelSettings = Annotated[BeamSettings | LogisticSettings | GridSettings, Field(discriminator="kind")]


class AntennaSettings(FileModel):
    """Mounting and detection model of an antenna on the robot."""

    x: Offset = 0.0
    """position of the antenna, forward"""
    y: Offset = 0.0
    """position of the antenna, to the left"""
    z: Offset = 0.0
    """height of the antenna"""
    yaw: Angle = 0.0
    """direction of the antenna's boresight; left is positive"""
    pitch: Annotated[float, Field(ge=-1.6, le=1.6), InUnit("rad")] = 0.0
    """elevation of the antenna's boresight; up is positive"""
    model: str = "default"
    """name of the antenna's detection model in models"""


class FixedAntenna(AntennaSettings):
    """Pose and detection model of an antenna that is fixed in the building. It is part of the map."""

    x: Coordinate
    """position of the antenna"""
    y: Coordinate
    """position of the antenna"""


class CarriedTag(FileModel):
    """Position and facing of a tag on the robot, for antennas that are fixed in the building."""

    x: Offset = 0.0
    """position of the tag, forward"""
    y: Offset = 0.0
    """position of the tag, to the left"""
    z: Offset = 0.0
    """height of the tag"""
    facing: Angle | None = None
    """direction of the tag's front; left is positive"""


class RssiSettings(FileModel):
    """A model of the signal strength of reads. See :class:`factors.rfid.signals.RssiModel`."""

    coefficients: Annotated[tuple[Weight, ...], Field(min_length=6, max_length=6)]
    """coefficients of the RSSI [dBm] for the features 1, -10 log10 of the distance, w, w^2, c and c^2; w is 1 minus the
    cosine of the bearing, c is the cosine of the angle between the tag's facing and the direction to the antenna"""
    sigma: Annotated[float, Field(ge=0.01, le=30.0), InUnit("dB")]
    """scale of the Student-t noise"""
    dof: Annotated[float, Field(ge=0.1, le=1000.0)]
    """degrees of freedom of the Student-t noise"""
    tempering: Annotated[float, Field(ge=1e-6, le=1.0)] = 0.005
    """exponent of the likelihood, below 1 for correlated reads"""

    def model(self, antennas: tuple[Antenna, ...]) -> RssiModel:
        """Return the model of signal strength for ``antennas``."""
        return RssiModel(antennas, self.coefficients, self.sigma, self.dof, self.tempering)


class PhaseSettings(FileModel):
    """A model of the phase of reads in time windows. See :class:`factors.rfid.signals.PhaseModel`. A read has the
    weight ``step`` / ``window``, because windows may overlap."""

    kappa: Annotated[float, Field(ge=1e-6, le=100.0)] = 1.0
    """concentration of the phases (parameter of the von Mises distribution)"""
    tempering: Annotated[float, Field(ge=1e-6, le=1.0)] = 0.05
    """exponent of the likelihood, below 1 for correlated reads"""
    max_range: Annotated[float, Field(ge=0.01, le=50.0), InUnit("m")] = 1.5
    """largest distance of a tag from the antenna at which its phase is used"""
    min_reads: Annotated[int, Field(ge=2, le=1000)] = 3
    """smallest number of reads of a tag by an antenna in a window"""
    window: Annotated[float, Field(ge=1e-3, le=60.0), InUnit("s")] = 2.0
    """length of the windows; phases of one tag and antenna are compared in a window"""
    step: Annotated[float, Field(ge=1e-3, le=60.0), InUnit("s")] = 1.0
    """time between the beginnings of two windows"""

    @model_validator(mode="after")
    def _has_no_gaps(self) -> PhaseSettings:
        if self.step > self.window * (1.0 + 1e-9):
            raise ValueError(f"step {self.step:g} s leaves gaps between windows, expected at most {self.window:g} s")
        return self

    def model(self, antennas: tuple[Antenna, ...]) -> PhaseModel:
        """Return the model of the phases in one window for ``antennas``."""
        return PhaseModel(
            antennas, self.kappa, self.tempering * self.step / self.window, self.max_range, self.min_reads
        )


RACKHAM_RADIUS = 0.25  # m; distance of the antennas from the centre of the robot


def rackham(z: float = 1.0) -> dict[str, AntennaSettings]:
    """Return the mounting of eight antennas, "1" to "8", on a circle around the robot at the height ``z`` [m]."""
    out = {}
    for i in range(8):
        yaw = se2.wrap_scalar(i * math.pi / 4.0)
        out[str(i + 1)] = AntennaSettings(
            x=round(RACKHAM_RADIUS * math.cos(yaw), 6), y=round(RACKHAM_RADIUS * math.sin(yaw), 6), z=z, yaw=yaw
        )
    return out


def default_models() -> dict[str, BeamSettings | LogisticSettings | GridSettings]:
    """Return the detection model of uncalibrated antennas, by its name "default"."""
    return {"default": BeamSettings()}


class RfidSettings(SensorSettings):
    """An RFID reader. It has either ``antennas`` or a ``preset`` on the robot, or antennas in the building that read
    ``tags`` on the robot."""

    preset: Literal["rackham"] | None = None
    """replaces antennas; rackham has eight antennas around the body, named 1 to 8 counter-clockwise from the front"""
    preset_z: Offset = 1.0
    """height of the antennas of the preset"""
    antennas: dict[str, AntennaSettings] = Field(default_factory=dict)
    """antennas by name; names are as in the reads"""
    tags: dict[str, CarriedTag] = Field(default_factory=dict)
    """instead of antennas: tags on the robot by EPC, which the antennas of the map read"""
    models: dict[str, ModelSettings] = Field(default_factory=default_models)
    """detection models of antennas by name; the default is a beam"""
    false_read: Share = 1e-3
    """lower bound of the probability of a read, at any position"""
    miss: Share = 0.0
    """lower bound of the probability of a miss, at any position"""
    tempering: Annotated[float, Field(ge=1e-6, le=1.0)] = 1.0
    """exponent of the likelihood, below 1 for correlated reads"""
    round_gap: Annotated[float, Field(ge=1e-4, le=10.0), InUnit("s")] = 0.05
    """gap between reads that ends an inventory round, if the log has no rounds"""
    dead_tags: Share = 0.03
    """prior probability that a tag of the map is broken, hidden or missing"""
    weak_tags: Share = 0.03
    """prior probability that a tag is read much less than its antenna's model predicts, for example on metal"""
    moved_tags: Share = 0.03
    """prior probability that a tag is half a metre or more from its position in the map"""
    uncertainty: RfidUncertainty = Field(default_factory=RfidUncertainty)
    """standard deviations of the antennas' yaw and of the time offset"""
    rssi: RssiSettings | None = None
    """model of the signal strength of reads, required by the sensor rssi"""
    phase: PhaseSettings | None = None
    """model of the phase of reads, required by the sensor phase"""

    @model_validator(mode="after")
    def _is_complete(self) -> RfidSettings:
        if (self.preset is not None) + bool(self.antennas) + bool(self.tags) != 1:
            raise ValueError("expected exactly one of antennas, preset and tags")
        for name, antenna in self.all_antennas().items():
            if antenna.model not in self.models:
                raise ValueError(
                    f"antenna {name} has the model {quoted(antenna.model)}, expected one of {listed(self.models)}"
                )
        return self

    def all_antennas(self) -> Mapping[str, AntennaSettings]:
        return self.antennas if self.preset is None else rackham(self.preset_z)

    def placed(self, folder: Path) -> RfidSettings:
        """Return a copy that reads the files of detection grids from ``folder``."""
        models = {k: m.placed(folder) if isinstance(m, GridSettings) else m for k, m in self.models.items()}
        return self.model_copy(update={"models": models})

    def write_beside(self, folder: Path) -> None:
        """Copy the files of detection grids to ``folder``."""
        for model in self.models.values():
            if isinstance(model, GridSettings) and model.path().resolve() != (folder / model.file).resolve():
                write_grid(model.model(), folder / model.file)

    def estimated(self, *, mounting: bool = True) -> Estimated:
        """Return the names and standard deviations of the parameters of the likelihood that are estimated in a run. The
        parameters are those of :mod:`factors.rfid.parameters`. ``mounting``: False to exclude yaws and time offset."""
        used, known, antennas = self.parameter_names(), self.uncertainties(), list(self.all_antennas())
        names = [used[model][i] if model in used else "" for model in self.models for i in range(len(OF_MODEL))]
        sigmas = [getattr(m.prior, name) * (k in used) for k, m in self.models.items() for name in OF_MODEL]
        names += ["yaw", *(f"antennas.{antenna}.yaw" for antenna in antennas), "time_offset"]
        sigmas += [known["yaw"], *(known["antenna_yaw"] * (len(antennas) > 1) for _ in antennas), known["time_offset"]]
        if not mounting:
            sigmas = [*sigmas[: len(OF_MODEL) * len(self.models)], *(0.0 for _ in antennas), 0.0, 0.0]
        return Estimated.among(names, np.array(sigmas))

    def uncertainties(self) -> dict[str, float]:
        """Return the standard deviations of ``uncertainty`` by name. Missing values are replaced by their defaults."""
        largest = max(self.models[antenna.model].prior.range_scale for antenna in self.all_antennas().values())
        given = self.uncertainty.model_dump(exclude_none=True)
        return {name: share * largest for name, share in BY_RANGE.items()} | given

    def parameter_names(self) -> dict[str, tuple[str, ...]]:
        """Return the names of the parameters of each detection model that an antenna uses, by the name of the model. If
        several models are used, the names of parameters have the prefix ``MODEL.``."""
        used = {antenna.model for antenna in self.all_antennas().values()}
        prefixes = {model: "" if len(used) == 1 else f"{model}." for model in self.models if model in used}
        return {model: tuple(prefix + name for name in OF_MODEL) for model, prefix in prefixes.items()}

    def model(self) -> RfidModel:
        """Return the model of all antennas, ordered as in :meth:`all_antennas`. Raises InputError for invalid grids."""
        names = list(self.models)
        return RfidModel(
            antennas=tuple(
                Antenna(a.x, a.y, a.z, a.yaw, a.pitch, names.index(a.model)) for a in self.all_antennas().values()
            ),
            models=tuple(settings.model() for settings in self.models.values()),
            false_read=self.false_read,
            miss=self.miss,
            tempering=self.tempering,
            fixed=bool(self.tags),
        )


class SurveySettings(FileModel):
    """The transform from the survey frame of the tags to the world frame: a rotation about the point (``about_x``,
    ``about_y``), followed by a translation."""

    x: Annotated[float, Field(ge=-1000.0, le=1000.0), InUnit("m")] = 0.0
    """translation of the map's tags along x, after the rotation"""
    y: Annotated[float, Field(ge=-1000.0, le=1000.0), InUnit("m")] = 0.0
    """translation of the map's tags along y, after the rotation"""
    heading: Angle = 0.0
    """rotation of the map's tags"""
    about_x: Coordinate = 0.0
    """centre of the rotation, in the frame of the survey"""
    about_y: Coordinate = 0.0
    """centre of the rotation, in the frame of the survey"""

    def transform(self) -> Array:
        """Return the pose (3,) of the survey frame in the world frame."""
        pivot = np.array((self.about_x, self.about_y))
        turned = se2.transform_from(np.array((0.0, 0.0, self.heading)), pivot)
        origin = pivot + np.array((self.x, self.y)) - turned
        return np.array((origin[0], origin[1], self.heading))


ARRAYS = ("logits", "origin", "cell", "heights")
FARTHEST = 1000.0  # m; maximum distance of a grid point from the antenna
FINEST = 1e-3  # m; minimum distance between grid points
LARGEST = 20.0  # maximum absolute logit; the probability is then 0 or 1 to nine digits


def read_grid(path: str | Path) -> GridModel:
    """Return the detection grid in the .npz file ``path``. Raises InputError if an array is missing or invalid."""
    arrays = _read_arrays(Path(path))
    logits, origin, heights = arrays["logits"], arrays["origin"], np.atleast_1d(arrays["heights"])
    if logits.ndim != 4 or min(logits.shape[2:]) < 2 or min(logits.shape) < 1 or logits.shape[0] != len(heights):
        raise bad_field(path, "logits", f"an array of shape {logits.shape}", "(heights, facings, x, y)")
    cell = arrays["cell"]
    if origin.shape != (2,) or not np.all(np.abs(origin) <= FARTHEST):
        raise bad_field(path, "origin", origin.tolist(), f"two numbers in {-FARTHEST:g} to {FARTHEST:g} m")
    if cell.size != 1 or not FINEST <= cell.item() <= FARTHEST:
        raise bad_field(path, "cell", cell.tolist(), f"{FINEST:g} to {FARTHEST:g} m")
    if heights.ndim != 1 or not np.all(np.abs(heights) <= FARTHEST):
        raise bad_field(path, "heights", heights.tolist(), f"numbers in {-FARTHEST:g} to {FARTHEST:g} m")
    steps = np.diff(heights)
    if len(steps) and not (np.all(steps >= FINEST) and np.allclose(steps, steps[0])):
        raise bad_field(path, "heights", heights.tolist(), f"even steps upwards of {FINEST:g} m or more")
    if np.any(np.isnan(logits)):
        raise bad_field(path, "logits", "NaN", "numbers")
    bounded = np.clip(logits, -LARGEST, LARGEST)
    return GridModel(bounded, float(origin[0]), float(origin[1]), float(cell.item()), heights)


def _read_arrays(path: Path) -> dict[str, Array]:
    """Return the arrays of a grid file by name. Raises InputError if the unpacked arrays would be too large."""
    with opened(path, GRID) as file, foreign(path, "is not a file of arrays (.npz)"):
        with zipfile.ZipFile(file) as archive:
            require_size(path, "its size in bytes when unpacked", sum(m.file_size for m in archive.infolist()), GRID)
        file.seek(0)
        with np.load(file, allow_pickle=False) as stored:
            if missing := [name for name in ARRAYS if name not in stored]:
                raise InputError(f"{path}: {missing[0]} is missing, expected {', '.join(ARRAYS)}")
            return {name: stored[name].astype(float, casting="same_kind") for name in ARRAYS}


def write_grid(grid: GridModel, path: str | Path) -> None:
    """Write a detection grid to the .npz file ``path``. If writing fails, an existing file is not changed."""
    with replacing(Path(path)) as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file,
            logits=grid.logits,
            origin=np.array((grid.x0, grid.y0)),
            cell=np.array(grid.cell),
            heights=grid.heights,
        )
