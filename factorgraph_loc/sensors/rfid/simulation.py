"""Simulated reads of tags, on a drive and by an active robot: settings, faults, reads, strength and phase."""

import math
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import FileModel, InUnit
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.settings import Duration, Metres, Share
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.interfaces import Ride, Simulated
from factorgraph_loc.sensors.rfid.known_tags import tag_map
from factorgraph_loc.sensors.rfid.map import Tag
from factorgraph_loc.sensors.rfid.settings import RfidSettings, SurveySettings, Weight
from factorgraph_loc.sensors.rfid.stream import RfidScan, RfidStream
from factorgraph_loc.text import listed, quoted
from factors import se2
from factors.rfid.detection import RfidLikelihood, TagArray
from factors.rfid.signals import SPEED_OF_LIGHT, RssiReads
from factors.rfid.signals import features as strength_features
from factors.se2 import Array


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
    """time of its failure"""
    rounds_go_on: bool = False
    """whether its rounds go on, without reads, as with a broken cable"""


class ClockJump(FileModel):
    """A jump of the reader's clock."""

    time: Duration
    """time of the jump"""
    jump: Annotated[float, Field(ge=-60.0, le=60.0), InUnit("s")]
    """how much later the reader's timestamps are from then on"""


class Silence(FileModel):
    """An interval without reads."""

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


Hits = NDArray[np.bool_]


def read_probabilities(likelihood: RfidLikelihood, poses: Array) -> Array:
    """Probability (N, A, T), floor included, that a round of each antenna at poses (N, 3) reads each tag."""
    antennas = range(len(likelihood.model.antennas))
    return np.stack([likelihood.probabilities(poses, a) for a in antennas], axis=1)


def draw_dead(faults: FaultSettings, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """The tags, of ``count``, that are never read."""
    return np.asarray(rng.permutation(count)[: round(faults.dead * count)])


def draw_reads(
    rfid: RfidSettings,
    probabilities: Array,
    times: Array,
    faults: FaultSettings,
    dead: NDArray[np.int64],
    rng: np.random.Generator,
) -> Hits:
    """Reads (N, A, T) of rounds at ``times`` (N,), with all faults except those of the map and the clock. ``dead``: tags that are
    never read.

    In a fade a tag has false reads only. Outside of fades the probability is raised to preserve the model's overall probability,
    as far as possible: a rig whose ``miss`` is at least the share of fades allows it.
    """
    shape = probabilities.shape
    share = faults.fading.share
    p = probabilities
    if share > 0.0:
        faded = _fades(faults.fading, times, (shape[1], shape[2]), rng)
        p = np.where(faded, rfid.false_read, (p - share * rfid.false_read) / (1.0 - share))
    hits = rng.random(shape) < p
    if faults.false_reads > 0.0:
        hits |= _false(int(hits.sum()), faults.false_reads, shape, rng)
    hits[:, :, dead] = False
    if faults.silence is not None:
        since = times - faults.silence.time
        hits[(since >= 0.0) & (since < faults.silence.duration)] = False
    if faults.antenna_stop is not None:
        which = list(rfid.all_antennas()).index(faults.antenna_stop.antenna)
        hits[times >= faults.antenna_stop.time, which] = False
    return hits


def rfid_stream(
    names: list[str], epcs: list[str], times: Array, hits: Hits, faults: FaultSettings, signals: Mapping[str, Array]
) -> RfidStream:
    """The stream of reads (N, A, T) of antennas ``names`` (A) and tags ``epcs`` (T). All antennas end a round at ``times`` (N,),
    which are also the times of the reads. ``signals``: the available columns of rssi, phase and frequency (N, A, T)."""
    listened = np.ones(hits.shape[:2], dtype=bool)
    stop = faults.antenna_stop
    if stop is not None and not stop.rounds_go_on:
        listened[times >= stop.time, names.index(stop.antenna)] = False
    empty = listened & ~hits.any(axis=2)
    # an additional column for rounds without reads
    n, a, tag = np.nonzero(np.concatenate((hits & listened[:, :, None], empty[:, :, None]), axis=2))
    if (jump := faults.clock_jump) is not None:
        times = times + np.where(times >= jump.time, jump.jump, 0.0)
    labels = [*epcs, ""]
    read = tag < len(epcs)
    columns: dict[str, Any] = {name: np.full(len(n), np.nan) for name in ("rssi", "phase", "frequency")}
    for name, values in signals.items():
        columns[name][read] = values[n[read], a[read], tag[read]]
    return RfidStream(
        t=times[n],
        round=a.astype(np.int64),
        antenna=[names[i] for i in a.tolist()],
        epc=[labels[i] for i in tag.tolist()],
        age=np.zeros(len(n)),
        **columns,
    )


def _fades(fading: Fading, times: Array, shape: tuple[int, int], rng: np.random.Generator) -> Hits:
    """Whether each tag is in a fade for each antenna, (N, A, T): a stationary two-state Markov chain.

    Fades end with the rate 1 / duration and start with the rate that gives the share (Gilbert, Bell System Technical Journal 39,
    1960).
    """
    out = np.empty((len(times), *shape), dtype=bool)
    rate = 1.0 / (fading.duration * (1.0 - fading.share))
    state = rng.random(shape) < fading.share
    for i in range(len(times)):
        if i:
            # probability that the chain has forgotten its state after dt; then it is in a fade with probability share
            forgotten = rng.random(shape) < -np.expm1(-rate * (times[i] - times[i - 1]))
            state = np.where(forgotten, rng.random(shape) < fading.share, state)
        out[i] = state
    return out


def _false(count: int, share: float, shape: tuple[int, ...], rng: np.random.Generator) -> Hits:
    """Random false reads (N, A, T), whose expected share of all reads is ``share``, given ``count`` others."""
    out = np.zeros(shape, dtype=bool)
    size = out.size
    extra = min(rng.poisson(count * share / (1.0 - share)), size)
    out.ravel()[rng.choice(size, extra, replace=False)] = True
    return out


def strengths(
    rfid: RfidSettings,
    tags: TagArray,
    poses: Array,
    hits: Hits,
    settings: SimulatedRssiSettings,
    rng: np.random.Generator,
) -> Array:
    """RSSI [dBm] (N, A, T) of the reads ``hits`` (N, A, T) at poses (N, 3), NaN elsewhere: :mod:`factors.rfid.signals`."""
    n, a, tag = np.nonzero(hits)
    reads = RssiReads(poses[n], a, tag, np.full(len(n), np.nan))
    features = strength_features(rfid.model().antennas, tags, np.zeros(3), reads)
    out = np.full(hits.shape, np.nan)
    out[hits] = features @ np.array(settings.coefficients) + settings.sigma * rng.standard_t(settings.dof, len(n))
    return out


def phases(
    rfid: RfidSettings, tags: TagArray, poses: Array, settings: SimulatedPhaseSettings, rng: np.random.Generator
) -> Array:
    """Phase (N, A, T) in [0, 2 pi) of a read of each tag by each antenna at poses (N, 3).

    ``offset - 4 pi f d / c`` (Nikitin et al., IEEE RFID 2010, eq. 4) with a random offset for each antenna and tag, noise, and an
    additional pi for a share of the reads.
    """
    at = np.array([(antenna.x, antenna.y, antenna.z) for antenna in rfid.all_antennas().values()])
    planar = se2.transform_from(poses[:, None], at[None, :, :2])[:, :, None] - tags.points[:, :2]
    height = at[:, None, 2] - tags.points[:, 2]
    distance = np.sqrt((planar**2).sum(axis=-1) + height**2)
    offset = rng.uniform(0.0, 2.0 * np.pi, distance.shape[1:])
    phase = offset - 4.0 * np.pi * settings.frequency / SPEED_OF_LIGHT * distance
    phase += settings.sigma * rng.standard_normal(phase.shape)
    phase += np.pi * (rng.random(phase.shape) < settings.flips)
    return np.asarray(np.mod(phase, 2.0 * np.pi))


def simulate(ride: Ride) -> Simulated:
    """The reads of a simulated drive, with all faults."""
    settings, rfid, rng = ride.settings, ride.rig.of(RfidSettings), ride.rng("reads")
    tags = tag_map(ride.world, ride.rig.of(SurveySettings))
    times = ride.times(settings.rounds_per_second)
    poses = ride.truth.at(times)
    p = read_probabilities(RfidLikelihood(rfid.model(), tags.tags), poses)
    names, epcs = list(rfid.all_antennas()), list(tags.names)
    dead = draw_dead(settings.faults, len(epcs), rng)
    hits = draw_reads(rfid, p, times, settings.faults, dead, rng)
    signals: dict[str, Array] = {}
    if settings.rssi is not None:
        signals["rssi"] = strengths(rfid, tags.tags, poses, hits, settings.rssi, ride.rng("strengths"))
    if settings.phase is not None:
        signals["phase"] = phases(rfid, tags.tags, poses, settings.phase, ride.rng("phases"))
        signals["frequency"] = np.full(hits.shape, settings.phase.frequency)
    stream = rfid_stream(names, epcs, times, hits, settings.faults, signals)
    surveyed, misplaced = _surveyed(ride.world.tags, settings.faults, ride.rng_of_world("survey"))
    metadata = {}
    if len(dead):
        metadata["dead"] = ", ".join(epcs[i] for i in sorted(dead.tolist()))
    if misplaced:
        metadata["misplaced"] = ", ".join(misplaced)
    return Simulated({"rfid": stream}, {"tags": surveyed}, metadata)


def looks(settings: Any) -> dict[str, float]:
    """Rate [Hz] of the simulated rounds; ValueError if rig and faults are inconsistent."""
    if settings.rig.find(RfidSettings) is None:
        raise ValueError("the rig has no rfid, expected antennas")
    stop, names = settings.faults.antenna_stop, list(settings.rig.of(RfidSettings).all_antennas())
    if stop is not None and stop.antenna not in names:
        raise ValueError(f"antenna {quoted(stop.antenna)} stops, expected one of {listed(names)}")
    return {"tags": settings.rounds_per_second * len(names) * settings.world.tag_count()}


def _surveyed(
    tags: Mapping[str, Tag], faults: FaultSettings, rng: np.random.Generator
) -> tuple[dict[str, Tag], list[str]]:
    """The tags of the surveyed map, and the names of misplaced ones."""
    names = list(tags)
    chosen = sorted(rng.permutation(len(names))[: round(faults.misplaced * len(names))].tolist())
    surveyed = dict(tags)
    for i in chosen:
        tag, direction = surveyed[names[i]], rng.uniform(-math.pi, math.pi)
        x, y = tag.x + faults.misplaced_by * math.cos(direction), tag.y + faults.misplaced_by * math.sin(direction)
        surveyed[names[i]] = tag.model_copy(update={"x": x, "y": y})
    return surveyed, [names[i] for i in chosen]


class SimulatedReader:
    """A :class:`~factorgraph_loc.sensors.interfaces.LiveSensor`: all antennas measure one round at a time."""

    channel, decides = "rfid", True

    def __init__(self, world: World, rig: Rig, rate: float, rng: np.random.Generator) -> None:
        self.rate, self._rng = rate, rng
        self._antennas = tuple(rig.of(RfidSettings).all_antennas())
        self._map = tag_map(world, rig.of(SurveySettings))
        self._likelihood = RfidLikelihood(rig.of(RfidSettings).model(), self._map.tags)

    def measure(self, t: float, pose: Array) -> RfidScan:
        """A round that ends at ``t``."""
        chance = read_probabilities(self._likelihood, pose[None])[0]
        antenna, tag = np.nonzero(self._rng.random(chance.shape) < chance)
        unknown = np.full(len(tag), np.nan)
        names = tuple(self._map.names[i] for i in tag.tolist())
        return RfidScan(
            t, self._antennas, antenna.astype(np.int64), names, np.zeros(len(tag)), unknown, unknown, unknown
        )


def on_robot(world: World, rig: Rig, settings: Any, rng: np.random.Generator) -> SimulatedReader:
    """The antennas of a rig; InputError if the settings have faults."""
    if settings.faults != FaultSettings():
        raise InputError(f"{settings.name}: has faults, which active runs do not support")
    return SimulatedReader(world, rig, settings.rounds_per_second, rng)
