"""Simulated tag reads from the detection model of a rig, with faults."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.sensors.rfid.settings import RfidSettings
from factorgraph_loc.sensors.rfid.simulation_settings import ClockJump, Fading, FaultSettings
from factorgraph_loc.sensors.rfid.stream import RfidStream
from factors.rfid.detection import RfidLikelihood, TagArray
from factors.se2 import Array

Hits = NDArray[np.bool_]


def read_probabilities(rfid: RfidSettings, tags: TagArray, poses: Array) -> Array:
    """Probability (N, A, T), floor included, that a round of each antenna at poses (N, 3) reads each tag."""
    model = rfid.model()
    likelihood = RfidLikelihood(model, tags)
    return np.stack([likelihood.probabilities(poses, a) for a in range(len(model.antennas))], axis=1)


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
    t = _jumped(times, faults.clock_jump)[n]
    labels = [*epcs, ""]
    read = tag < len(epcs)
    columns = {name: np.full(len(n), np.nan) for name in ("rssi", "phase", "frequency")}
    for name, values in signals.items():
        columns[name][read] = values[n[read], a[read], tag[read]]
    return RfidStream(
        t=t,
        round=a.astype(np.int64),
        antenna=[names[i] for i in a.tolist()],
        epc=[labels[i] for i in tag.tolist()],
        age=np.zeros(len(n)),
        **columns,
    )


def _jumped(times: Array, jump: ClockJump | None) -> Array:
    return times if jump is None else times + np.where(times >= jump.time, jump.jump, 0.0)


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
