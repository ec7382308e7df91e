"""RFID settings of a rig: antennas, detection models, and the transform of the tags' survey.

See :mod:`factors.rfid.model` for the models. Learnt grids are ``.npz`` files next to the rig's file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, PrivateAttr, model_validator

from factorgraph_loc.files.models import Coordinate, FileModel, InUnit, inside
from factorgraph_loc.model.settings import SensorSettings
from factorgraph_loc.model.variable import Estimated
from factorgraph_loc.sensors.rfid.grids import read_grid, write_grid
from factorgraph_loc.text import listed, quoted
from factors import se2
from factors.rfid.adjustment import PARAMETERS
from factors.rfid.model import Antenna, BeamModel, DetectionModel, GridModel, LogisticModel, RfidModel
from factors.rfid.phase import PhaseModel
from factors.rfid.strength import RssiModel
from factors.se2 import Array

Angle = Annotated[float, Field(ge=-math.pi, le=math.pi), InUnit("rad")]
Offset = Annotated[float, Field(ge=-10.0, le=10.0), InUnit("m")]
Weight = Annotated[float, Field(ge=-1e6, le=1e6)]
Share = Annotated[float, Field(ge=0.0, lt=0.5)]


class PriorSettings(FileModel):
    """How well a detection model is known, as standard deviations (:mod:`factors.rfid.adjustment`): ``range_scale`` of the
    logarithm of a factor of its range, ``read_rate`` of the logit of its largest probability. What is above zero is learnt on the
    way by every estimator that uses tags."""

    range_scale: Annotated[float, Field(ge=0.0, le=1.0)] = 0.1
    read_rate: Annotated[float, Field(ge=0.0, le=3.0, description="of a logit")] = 0.5


class BeamSettings(FileModel):
    """See :class:`factors.rfid.model.BeamModel`; ``prior``: how well it is known."""

    kind: Literal["beam"] = "beam"
    prior: PriorSettings = Field(default_factory=PriorSettings)
    p0: Annotated[float, Field(ge=1e-6, le=1.0 - 1e-6)] = 0.9
    r_max: Annotated[float, Field(ge=0.01, le=50.0), InUnit("m")] = 4.5
    s_r: Annotated[float, Field(ge=1e-3, le=10.0), InUnit("m")] = 0.3
    sigma_phi: Annotated[float, Field(ge=1e-3, le=10.0), InUnit("rad")] = 0.698

    def model(self) -> DetectionModel:
        return BeamModel(self.p0, self.r_max, self.s_r, self.sigma_phi)


class LogisticSettings(FileModel):
    """See :class:`factors.rfid.model.LogisticModel`; ``coefficients`` in the order of ``factors.rfid.model.FEATURES``."""

    kind: Literal["logistic"] = "logistic"
    prior: PriorSettings = Field(default_factory=PriorSettings)
    coefficients: Annotated[tuple[Weight, ...], Field(min_length=11, max_length=11)]

    def model(self) -> DetectionModel:
        return LogisticModel(self.coefficients)


class GridSettings(FileModel):
    """A learnt detection grid: the name of an ``.npz`` in the folder of the rig's file."""

    kind: Literal["grid"] = "grid"
    prior: PriorSettings = Field(default_factory=PriorSettings)
    file: str
    _folder: Path = PrivateAttr(default=Path())

    def model(self) -> GridModel:
        """Read the grid; InputError if the file is invalid."""
        return read_grid(self.path())

    def path(self) -> Path:
        return inside(self._folder, self.file, "grid")

    def placed(self, folder: Path) -> GridSettings:
        """A copy whose file reference is relative to ``folder``, which holds the rig's file."""
        out = self.model_copy()
        out._folder = folder
        return out


ModelSettings = Annotated[BeamSettings | LogisticSettings | GridSettings, Field(discriminator="kind")]


class AntennaSettings(FileModel):
    """An antenna: position and boresight in the robot frame (``pitch``: up is positive), and the name of its model."""

    x: Offset = 0.0
    y: Offset = 0.0
    z: Offset = 0.0
    yaw: Angle = 0.0
    pitch: Annotated[float, Field(ge=-1.6, le=1.6), InUnit("rad")] = 0.0
    model: str = "default"


class RssiSettings(FileModel):
    """See :class:`factors.rfid.strength.RssiModel`; ``coefficients`` in the order of ``factors.rfid.strength.FEATURES``."""

    coefficients: Annotated[tuple[Weight, ...], Field(min_length=6, max_length=6)]
    sigma: Annotated[float, Field(ge=0.01, le=30.0), InUnit("dB")]
    dof: Annotated[float, Field(ge=0.1, le=1000.0, description="degrees of freedom of the Student density")]
    tempering: Annotated[float, Field(ge=1e-6, le=1.0)] = 0.005

    def model(self, antennas: tuple[Antenna, ...]) -> RssiModel:
        """The model for the given antennas."""
        return RssiModel(antennas, self.coefficients, self.sigma, self.dof, self.tempering)


class PhaseSettings(FileModel):
    """See :class:`factors.rfid.phase.PhaseModel`. Windows of ``window`` [s] begin every ``step`` [s]. Reads in overlapping windows
    are weighted by ``step`` / ``window``."""

    kappa: Annotated[float, Field(ge=1e-6, le=100.0)] = 1.0
    tempering: Annotated[float, Field(ge=1e-6, le=1.0)] = 0.05
    max_range: Annotated[float, Field(ge=0.01, le=50.0), InUnit("m")] = 1.5
    min_reads: Annotated[int, Field(ge=2, le=1000)] = 3
    window: Annotated[float, Field(ge=1e-3, le=60.0), InUnit("s")] = 2.0
    step: Annotated[float, Field(ge=1e-3, le=60.0), InUnit("s")] = 1.0

    @model_validator(mode="after")
    def _has_no_gaps(self) -> PhaseSettings:
        if self.step > self.window * (1.0 + 1e-9):
            raise ValueError(f"step {self.step:g} s leaves gaps between windows, expected at most {self.window:g} s")
        return self

    def model(self, antennas: tuple[Antenna, ...]) -> PhaseModel:
        """The model of one window for the given antennas."""
        return PhaseModel(
            antennas, self.kappa, self.tempering * self.step / self.window, self.max_range, self.min_reads
        )


RACKHAM_RADIUS = 0.25  # m


def rackham(z: float = 1.0) -> dict[str, AntennaSettings]:
    """Eight antennas around the body at height ``z`` [m], as on the robot of the paper."""
    out = {}
    for i in range(8):
        yaw = se2.wrap_scalar(i * math.pi / 4.0)
        out[str(i + 1)] = AntennaSettings(
            x=round(RACKHAM_RADIUS * math.cos(yaw), 6), y=round(RACKHAM_RADIUS * math.sin(yaw), 6), z=z, yaw=yaw
        )
    return out


def default_models() -> dict[str, BeamSettings | LogisticSettings | GridSettings]:
    """The default model of uncalibrated antennas."""
    return {"default": BeamSettings()}


class RfidSettings(SensorSettings):
    """The RFID reader. ``antennas`` by name, or a ``preset`` of them at height ``preset_z``.

    ``false_read`` and ``miss``: lower and upper bounds of the read probability (the latter as 1 - miss). ``tempering``: exponent of
    the likelihood, below 1 for correlated reads. ``round_gap`` [s]: gap between reads that separates inventory rounds if the log
    has none. ``pass_sigma`` [m]: accuracy of the pose from one pass of a tag, for tags with an inexact survey
    (:func:`~factorgraph_loc.sensors.rfid.known_tags.trust`). ``dead_tags``: prior share of broken, hidden or missing tags of a map;
    ``fgloc calibrate`` learns it. ``rssi``, ``phase``: models used if an estimator uses these sensors.
    """

    preset: Literal["rackham"] | None = None
    preset_z: Offset = 1.0
    antennas: dict[str, AntennaSettings] = Field(default_factory=dict)
    models: dict[str, ModelSettings] = Field(default_factory=default_models)
    false_read: Share = 1e-3
    miss: Share = 0.0
    tempering: Annotated[float, Field(ge=1e-6, le=1.0)] = 1.0
    round_gap: Annotated[float, Field(ge=1e-4, le=10.0), InUnit("s")] = 0.05
    pass_sigma: Annotated[float, Field(ge=0.01, le=10.0), InUnit("m")] = 0.1
    dead_tags: Share = 0.03
    rssi: RssiSettings | None = None
    phase: PhaseSettings | None = None

    @model_validator(mode="after")
    def _is_complete(self) -> RfidSettings:
        if (self.preset is None) == (not self.antennas):
            raise ValueError("expected either antennas or a preset")
        for name, antenna in self.all_antennas().items():
            if antenna.model not in self.models:
                raise ValueError(
                    f"antenna {name} has the model {quoted(antenna.model)}, expected one of {listed(self.models)}"
                )
        return self

    def all_antennas(self) -> Mapping[str, AntennaSettings]:
        return self.antennas if self.preset is None else rackham(self.preset_z)

    def placed(self, folder: Path) -> RfidSettings:
        """A copy whose grids are files in ``folder``."""
        models = {k: m.placed(folder) if isinstance(m, GridSettings) else m for k, m in self.models.items()}
        return self.model_copy(update={"models": models})

    def write_beside(self, folder: Path) -> None:
        """Write the grids into ``folder``."""
        for model in self.models.values():
            if isinstance(model, GridSettings) and model.path().resolve() != (folder / model.file).resolve():
                write_grid(model.model(), folder / model.file)

    def estimated(self) -> Estimated:
        """The parameters of the models of the antennas that are not known exactly, among those of all models."""
        used = self.parameter_names()
        names = [used[model][i] if model in used else "" for model in self.models for i in range(len(PARAMETERS))]
        sigmas = [getattr(m.prior, name) * (k in used) for k, m in self.models.items() for name in PARAMETERS]
        return Estimated.among(names, np.array(sigmas))

    def parameter_names(self) -> dict[str, tuple[str, ...]]:
        """The names of the parameters of each model that an antenna has; with the model's name where there are several."""
        used = {antenna.model for antenna in self.all_antennas().values()}
        prefixes = {model: "" if len(used) == 1 else f"{model}." for model in self.models if model in used}
        return {model: tuple(prefix + name for name in PARAMETERS) for model, prefix in prefixes.items()}

    def model(self) -> RfidModel:
        """The model of all antennas, in the order of :meth:`all_antennas`. InputError if a grid cannot be read."""
        names = list(self.models)
        return RfidModel(
            antennas=tuple(
                Antenna(a.x, a.y, a.z, a.yaw, a.pitch, names.index(a.model)) for a in self.all_antennas().values()
            ),
            models=tuple(settings.model() for settings in self.models.values()),
            false_read=self.false_read,
            miss=self.miss,
            tempering=self.tempering,
        )


class SurveySettings(FileModel):
    """The transform from the tags' survey frame to the world: rotation by ``heading`` about the point (``about_x``, ``about_y``) of
    the survey, then translation by ``x`` and ``y``."""

    x: Annotated[float, Field(ge=-1000.0, le=1000.0), InUnit("m")] = 0.0
    y: Annotated[float, Field(ge=-1000.0, le=1000.0), InUnit("m")] = 0.0
    heading: Angle = 0.0
    about_x: Coordinate = 0.0
    about_y: Coordinate = 0.0

    def transform(self) -> Array:
        """The pose (3,) of the survey's origin in the world."""
        pivot = np.array((self.about_x, self.about_y))
        turned = se2.transform_from(np.array((0.0, 0.0, self.heading)), pivot)
        origin = pivot + np.array((self.x, self.y)) - turned
        return np.array((origin[0], origin[1], self.heading))
