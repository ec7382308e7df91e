"""Simulates reads of tags with signal strength, phase and faults, for simulated logs and for active localization."""

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
from factorgraph_loc.sensors.rfid.installation import installed, is_fixed
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
    """Settings of simulated phases of RFID reads."""

    frequency: Annotated[float, Field(ge=3e8, le=6e9), InUnit("Hz")] = 920.625e6
    """frequency of the carrier"""
    sigma: Annotated[float, Field(ge=0.0, le=3.0), InUnit("rad")] = 0.1
    """standard deviation of the phase noise"""
    flips: Share = 0.2
    """fraction of reads whose phase is off by pi, as with most readers"""


class SimulatedRssiSettings(FileModel):
    """Settings of simulated signal strengths of RFID reads. The noise has a Student-t distribution."""

    coefficients: Annotated[tuple[Weight, ...], Field(min_length=6, max_length=6)] = (-50.0, 2.0, -8.0, 0.0, 2.0, 0.0)
    """coefficients of the strength, as rfid.rssi.coefficients of a rig"""
    sigma: Annotated[float, Field(ge=0.0, le=30.0), InUnit("dB")] = 2.0
    """scale of the noise"""
    dof: Annotated[float, Field(ge=0.1, le=100.0)] = 4.0
    """degrees of freedom of the noise"""


class Fading(FileModel):
    """Settings of fades: time intervals without reads of a tag by an antenna. They are independent for each pair of an
    antenna and a tag."""

    duration: Annotated[float, Field(ge=1e-3, le=1000.0), InUnit("s")] = 2.0
    """mean duration of a fade"""
    share: Annotated[float, Field(ge=0.0, le=0.9)] = 0.0
    """fraction of the time that an antenna misses a tag because of fades"""


class AntennaStop(FileModel):
    """The failure of an antenna at some time. After this time the antenna reads nothing."""

    model_config = ConfigDict(coerce_numbers_to_str=True)  # names of antennas are often numbers

    antenna: str
    """name of the antenna"""
    time: Duration
    """time of the failure"""
    rounds_go_on: bool = False
    """the antenna still has inventory rounds, but without reads, as with a broken cable"""


class ClockJump(FileModel):
    """A jump of the reader's clock."""

    time: Duration
    """time of the jump"""
    jump: Annotated[float, Field(ge=-60.0, le=60.0), InUnit("s")]
    """change of the reader's timestamps after the jump"""


class Silence(FileModel):
    """A time interval without reads by any antenna."""

    time: Duration
    """start of the interval without reads"""
    duration: Duration
    """duration of the interval"""


class FaultSettings(FileModel):
    """Faults of a simulated RFID reader, its tags and its map."""

    fading: Fading = Fading()
    false_reads: Share = 0.0
    """fraction of all reads that are of random tags, in addition to the model's false_read"""
    dead: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """fraction of tags that are never read"""
    misplaced: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """fraction of tags that have a wrong position in the map"""
    misplaced_by: Metres = 1.0
    """distance of the wrong positions from the true ones"""
    antenna_stop: AntennaStop | None = None
    clock_jump: ClockJump | None = None
    silence: Silence | None = None


Hits = NDArray[np.bool_]


def read_probabilities(likelihood: RfidLikelihood, poses: Array) -> Array:
    """Return the probability (N, A, T) that antenna a reads tag t in one inventory round at robot pose n, including
    false reads. ``poses`` (N, 3): the robot poses."""
    antennas = range(len(likelihood.model.antennas))
    return np.stack([likelihood.probabilities(poses, a) for a in antennas], axis=1)


def draw_dead(faults: FaultSettings, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return the indices of randomly chosen dead tags among ``count`` tags. ``faults.dead`` is their fraction."""
    return np.asarray(rng.permutation(count)[: round(faults.dead * count)])


def draw_reads(
    rfid: RfidSettings,
    probabilities: Array,
    times: Array,
    faults: FaultSettings,
    dead: NDArray[np.int64],
    rng: np.random.Generator,
) -> Hits:
    """Return a mask (N, A, T) of random reads of T tags by A antennas in inventory rounds at ``times`` (N,) [s].

    ``rfid``: the antennas. ``probabilities`` (N, A, T): the mean probability of a read over time. ``faults``: the
    faults to simulate, except those of map and clock. In a fade, tags have only false reads. Outside of fades, their
    probability is therefore higher. ``dead``: indices of tags that are never read.
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
    """Return simulated reads as a stream. ``hits`` (N, A, T): a mask of the reads, see :func:`draw_reads`.

    ``names`` (A): antennas. ``epcs`` (T): tags. ``times`` (N,): the times [s] of the reads. A round of every antenna
    ends at each time. ``faults``: stops antennas, and shifts the clock. ``signals``: values (N, A, T) of "rssi",
    "phase" and "frequency", if they are simulated.
    """
    listened = np.ones(hits.shape[:2], dtype=bool)
    stop = faults.antenna_stop
    if stop is not None and not stop.rounds_go_on:
        listened[times >= stop.time, names.index(stop.antenna)] = False
    empty = listened & ~hits.any(axis=2)
    # the last column is True for rounds without reads
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
    """Return a mask (N, A, T) that is True while antenna a cannot read tag t, for random fades at ``times`` (N,) [s].

    ``shape``: (A, T). Each pair of an antenna and a tag has a stationary Markov chain with two states (Gilbert, Bell
    System Technical Journal 39, 1960).
    """
    out = np.empty((len(times), *shape), dtype=bool)
    rate = 1.0 / (fading.duration * (1.0 - fading.share))
    state = rng.random(shape) < fading.share
    for i in range(len(times)):
        if i:
            # the state is drawn again with the probability that it is independent of the previous state
            forgotten = rng.random(shape) < -np.expm1(-rate * (times[i] - times[i - 1]))
            state = np.where(forgotten, rng.random(shape) < fading.share, state)
        out[i] = state
    return out


def _false(count: int, share: float, shape: tuple[int, ...], rng: np.random.Generator) -> Hits:
    """Return a mask of random false reads, with the shape ``shape``. With ``count`` true reads, the expected fraction
    of false reads among all reads is ``share``."""
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
    """Return the simulated RSSI (N, A, T) [dBm] of reads by the model of :mod:`factors.rfid.signals`, NaN without a
    read. ``rfid``: the A antennas. ``tags``: the T tags. ``poses`` (N, 3): the robot poses. ``hits`` (N, A, T): a mask
    of the reads."""
    n, a, tag = np.nonzero(hits)
    reads = RssiReads(poses[n], a, tag, np.full(len(n), np.nan))
    features = strength_features(rfid.model().antennas, tags, np.zeros(3), reads)
    out = np.full(hits.shape, np.nan)
    out[hits] = features @ np.array(settings.coefficients) + settings.sigma * rng.standard_t(settings.dof, len(n))
    return out


def phases(
    rfid: RfidSettings, tags: TagArray, poses: Array, settings: SimulatedPhaseSettings, rng: np.random.Generator
) -> Array:
    """Return the simulated phase (N, A, T), from 0 to 2 pi, of a read of each tag by each antenna at ``poses`` (N, 3).

    The phase is ``offset - 4 pi f d / c`` (Nikitin et al., IEEE RFID 2010, eq. 4), with frequency f, distance d and
    speed of light c. The offset is random for each antenna and tag. Noise is added, and pi for a fraction of the reads.
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
    """Return the simulated reads of a drive, with all faults. Also return the map with survey errors, and metadata that
    lists dead and misplaced tags."""
    world, ride = ride.world, installed(ride)
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
    surveyed, misplaced = _surveyed(world.tags, settings.faults, ride.rng_of_world("survey"))
    metadata = {}
    if len(dead):
        metadata["dead"] = ", ".join(epcs[i] for i in sorted(dead.tolist()))
    if misplaced:
        metadata["misplaced"] = ", ".join(misplaced)
    return Simulated({"rfid": stream}, {"tags": surveyed}, metadata)


def looks(settings: Any) -> dict[str, float]:
    """Return {"tags": N}, where N is rounds per second times antennas times tags. ``settings``: settings of the
    simulation. Raises ValueError if rig and world do not fit together, or if a fault names an unknown antenna."""
    if settings.rig.find(RfidSettings) is None:
        raise ValueError("the rig has no section [rfid], expected one with antennas")
    rfid, fixed = settings.rig.of(RfidSettings), settings.world.antenna_names()
    if bool(rfid.tags) != bool(fixed):
        raise ValueError(
            "world.antennas and rig.rfid.tags require each other, as in the preset gates: expected both or neither"
        )
    if fixed and (settings.rssi is not None or settings.phase is not None):
        raise ValueError("rssi and phase need antennas on the robot, but world.antennas are fixed: remove them")
    stop, names = settings.faults.antenna_stop, fixed or list(rfid.all_antennas())
    if stop is not None and stop.antenna not in names:
        raise ValueError(
            f"faults.antenna_stop names the antenna {quoted(stop.antenna)}, expected one of {listed(names)}"
        )
    return {"tags": settings.rounds_per_second * len(names) * (len(rfid.tags) or settings.world.tag_count())}


def _surveyed(
    tags: Mapping[str, Tag], faults: FaultSettings, rng: np.random.Generator
) -> tuple[dict[str, Tag], list[str]]:
    """Return a copy of ``tags`` with some wrong positions, and the names of these tags."""
    names = list(tags)
    chosen = sorted(rng.permutation(len(names))[: round(faults.misplaced * len(names))].tolist())
    surveyed = dict(tags)
    for i in chosen:
        tag, direction = surveyed[names[i]], rng.uniform(-math.pi, math.pi)
        x, y = tag.x + faults.misplaced_by * math.cos(direction), tag.y + faults.misplaced_by * math.sin(direction)
        surveyed[names[i]] = tag.model_copy(update={"x": x, "y": y})
    return surveyed, [names[i] for i in chosen]


class SimulatedReader:
    """A simulated RFID reader on a robot. A measurement has one round of each antenna. It implements
    :class:`~factorgraph_loc.sensors.interfaces.LiveSensor`."""

    channel, decides = "rfid", True

    def __init__(self, world: World, rig: Rig, rate: float, rng: np.random.Generator) -> None:
        self.rate, self._rng = rate, rng
        self._antennas = tuple(rig.of(RfidSettings).all_antennas())
        self._map = tag_map(world, rig.of(SurveySettings))
        self._likelihood = RfidLikelihood(rig.of(RfidSettings).model(), self._map.tags)

    def measure(self, t: float, pose: Array) -> RfidScan:
        """Return a simulated scan with one round of each antenna, at ``t`` [s] and the robot's ``pose`` (3,)."""
        chance = read_probabilities(self._likelihood, pose[None])[0]
        antenna, tag = np.nonzero(self._rng.random(chance.shape) < chance)
        unknown = np.full(len(tag), np.nan)
        names = tuple(self._map.names[i] for i in tag.tolist())
        return RfidScan(
            t, self._antennas, antenna.astype(np.int64), names, np.zeros(len(tag)), unknown, unknown, unknown
        )


def on_robot(world: World, rig: Rig, settings: Any, rng: np.random.Generator) -> SimulatedReader:
    """Return the simulated reader of a rig for active localization. ``settings``: settings of the simulation. Raises
    InputError if they have faults, or if the antennas are fixed in the building, because this is not supported."""
    if is_fixed(rig):
        raise InputError(f"{settings.name}: has antennas in the map, expected antennas on the robot for active runs")
    if settings.faults != FaultSettings():
        raise InputError(f"{settings.name}: has faults, which active runs do not support: remove the section [faults]")
    return SimulatedReader(world, rig, settings.rounds_per_second, rng)
