"""Simulation settings of an RFID reader and its faults."""

from typing import Annotated

from pydantic import ConfigDict, Field

from factorgraph_loc.files.models import FileModel, InUnit
from factorgraph_loc.model.settings import Duration, Metres, Share
from factorgraph_loc.sensors.rfid.settings import Weight


class SimulatedPhaseSettings(FileModel):
    """Phase of reads: carrier ``frequency``, noise ``sigma``, and the share ``flips`` of reads that are off by pi, as with most
    readers."""

    frequency: Annotated[float, Field(ge=3e8, le=6e9), InUnit("Hz")] = 920.625e6
    sigma: Annotated[float, Field(ge=0.0, le=3.0), InUnit("rad")] = 0.1
    flips: Share = 0.2


class SimulatedRssiSettings(FileModel):
    """Strength of reads: ``coefficients`` of :data:`factors.rfid.strength.FEATURES`, and Student noise of scale ``sigma`` with
    ``dof`` degrees of freedom."""

    coefficients: Annotated[tuple[Weight, ...], Field(min_length=6, max_length=6)] = (-50.0, 2.0, -8.0, 0.0, 2.0, 0.0)
    sigma: Annotated[float, Field(ge=0.0, le=30.0), InUnit("dB")] = 2.0
    dof: Annotated[float, Field(ge=0.1, le=100.0)] = 4.0


class Fading(FileModel):
    """Persistent misses: each antenna misses each tag for times of mean ``duration``, a ``share`` of all time."""

    duration: Annotated[float, Field(ge=1e-3, le=1000.0), InUnit("s")] = 2.0
    share: Annotated[float, Field(ge=0.0, le=0.9)] = 0.0


class AntennaStop(FileModel):
    """From ``time`` on an antenna reads nothing. Its rounds end too, unless ``rounds_go_on``, as with a broken cable."""

    model_config = ConfigDict(coerce_numbers_to_str=True)  # antennas are often named by numbers

    antenna: str
    time: Duration
    rounds_go_on: bool = False


class ClockJump(FileModel):
    """From ``time`` on the reader's timestamps are ``jump`` seconds late."""

    time: Duration
    jump: Annotated[float, Field(ge=-60.0, le=60.0), InUnit("s")]


class Silence(FileModel):
    """For ``duration`` seconds no tag is read."""

    time: Duration
    duration: Duration


class FaultSettings(FileModel):
    """Faults of RFID. ``false_reads``: share of random reads, in addition to those of the model's floor. ``dead``: share of tags
    that are never read. ``misplaced``: share of tags that are ``misplaced_by`` metres off in the map."""

    fading: Fading = Fading()
    false_reads: Share = 0.0
    dead: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    misplaced: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    misplaced_by: Metres = 1.0
    antenna_stop: AntennaStop | None = None
    clock_jump: ClockJump | None = None
    silence: Silence | None = None
