"""Simulation settings of an RFID reader and its faults."""

from typing import Annotated

from pydantic import ConfigDict, Field

from factorgraph_loc.files.models import FileModel, InUnit
from factorgraph_loc.model.settings import Duration, Metres, Share
from factorgraph_loc.sensors.rfid.settings import Weight


class SimulatedPhaseSettings(FileModel):
    """Phase of reads."""

    frequency: Annotated[float, Field(ge=3e8, le=6e9), InUnit("Hz")] = 920.625e6
    """frequency of the carrier"""
    sigma: Annotated[float, Field(ge=0.0, le=3.0), InUnit("rad")] = 0.1
    """noise"""
    flips: Share = 0.2
    """share of reads that are off by pi, as with most readers"""


class SimulatedRssiSettings(FileModel):
    """Strength of reads, with Student noise."""

    coefficients: Annotated[tuple[Weight, ...], Field(min_length=6, max_length=6)] = (-50.0, 2.0, -8.0, 0.0, 2.0, 0.0)
    """weights of the features of the strength, as rfid.rssi.coefficients of a rig"""
    sigma: Annotated[float, Field(ge=0.0, le=30.0), InUnit("dB")] = 2.0
    """scale of the noise"""
    dof: Annotated[float, Field(ge=0.1, le=100.0)] = 4.0
    """degrees of freedom of the noise"""


class Fading(FileModel):
    """Persistent misses: each antenna misses each tag for a while."""

    duration: Annotated[float, Field(ge=1e-3, le=1000.0), InUnit("s")] = 2.0
    """mean time for which an antenna misses a tag"""
    share: Annotated[float, Field(ge=0.0, le=0.9)] = 0.0
    """share of all time for which it does"""


class AntennaStop(FileModel):
    """An antenna that reads nothing any more."""

    model_config = ConfigDict(coerce_numbers_to_str=True)  # antennas are often named by numbers

    antenna: str
    """name of the antenna"""
    time: Duration
    """time from which on it reads nothing"""
    rounds_go_on: bool = False
    """whether its rounds go on, without reads, as with a broken cable"""


class ClockJump(FileModel):
    """A jump of the reader's clock."""

    time: Duration
    """time of the jump"""
    jump: Annotated[float, Field(ge=-60.0, le=60.0), InUnit("s")]
    """how much later the reader's timestamps are from then on"""


class Silence(FileModel):
    """A while in which no tag is read."""

    time: Duration
    """begin of it"""
    duration: Duration
    """duration of it"""


class FaultSettings(FileModel):
    """Faults of RFID."""

    fading: Fading = Fading()
    false_reads: Share = 0.0
    """share of all reads that are of random tags, in addition to the model's false_read"""
    dead: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """share of tags that are never read"""
    misplaced: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """share of tags that are misplaced in the map"""
    misplaced_by: Metres = 1.0
    """how far these are off"""
    antenna_stop: AntennaStop | None = None
    clock_jump: ClockJump | None = None
    silence: Silence | None = None
