"""Summarises RFID reads of a log, and reviews a finished run: warnings, and the reliability of the detection models.

The reliability compares observed with predicted reads along the final trajectory, by distance and antenna (a
reliability diagram: DeGroot and Fienberg, "The comparison and evaluation of forecasters", The Statistician 32, 1983).
Successive reads are correlated. The variances of all counts are therefore multiplied by the overdispersion of reads in
time blocks (McCullagh and Nelder, "Generalized linear models", 1989, section 4.5).
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from factorgraph_loc.files.column_mapping import text_of_hex
from factorgraph_loc.model.belief import Learnt
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.result import Reliability
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.interfaces import Ending, Paragraph, Review, Summary, Use, in_other_case, line
from factorgraph_loc.sensors.rfid.calibration.rounds import overdispersion
from factorgraph_loc.sensors.rfid.installation import installed, is_fixed
from factorgraph_loc.sensors.rfid.known_tags import tag_map
from factorgraph_loc.sensors.rfid.monitor import BAND, BLOCK, DIFFERENT, FEWEST, POSSIBLE, ReadGroups
from factorgraph_loc.sensors.rfid.settings import RfidSettings, SurveySettings
from factorgraph_loc.sensors.rfid.stream import RfidStream
from factorgraph_loc.sensors.smoothed import possible_poses
from factorgraph_loc.text import Notice, listed, notice, quoted
from factors.rfid import kernels
from factors.rfid.detection import ExpectedReads, RfidLikelihood
from factors.rfid.parameters import MOST_CERTAIN, rate_of
from factors.se2 import Array, Integers, wrap_scalar

STOPPED = 10.0  # s; an antenna has stopped if its last round or read is more than this before the end of the log
CLOCK_STEP = 1.0  # s; larger steps back of timestamps, and larger offsets from the odometry, cause warnings
SHOWN = 5  # maximum number of names in a line or a warning
UNKNOWN_ANTENNA = "antenna {antenna} is not {place}: {reads} reads, {rounds} rounds"
IN_MAP, ON_ROBOT = "tags of the map", "tags on the robot"


@dataclass(frozen=True)
class AntennaSummary:
    """A summary of one antenna in a log.

    ``reads``, ``rounds``: the numbers of reads and of rounds. ``rate``: rounds per second. ``silent``: the number of
    rounds without reads. ``last``: time [s] of the last round. ``last_read``: time [s] of the last read, or None.
    """

    reads: int
    rounds: int
    rate: float
    silent: int
    last: float
    last_read: float | None


@dataclass(frozen=True)
class RfidSummary:
    """A summary of all RFID reads of a log.

    ``reads``, ``scans``, ``rounds``: the numbers of reads, scans and rounds. ``antennas``: the summaries of antennas by
    name. ``known``: the number of tags of the map that are read. ``unread``: the tags of the map that are never read.
    ``unknown``: the number of reads of each EPC that is not in the map. ``late``: the number of rounds with an earlier
    timestamp than a previous round, and the largest such difference [s].
    """

    reads: int
    scans: int
    rounds: int
    antennas: Mapping[str, AntennaSummary]
    known: int
    unread: tuple[str, ...]
    unknown: Mapping[str, int]
    late: tuple[int, float]


def summarize(log: Log) -> Summary:
    """Return the summary of the reads in a log, with warnings. Its entry "rfid" is an :class:`RfidSummary` or None."""
    in_map = {"antennas": len(log.world.antennas)} if is_fixed(log.rig) else {"tags": len(log.world.tags)}
    log = installed(log)
    summary = summarize_rfid(log)
    if summary is None:
        return Summary({"rfid": None}, in_map)
    return Summary({"rfid": summary}, in_map, rfid_problems(log, summary), (_paragraph(log, summary),))


def _paragraph(log: Log, summary: RfidSummary) -> Paragraph:
    unknown = f"{len(summary.unknown)} others" if summary.unknown else "no others"
    header = ("antenna", "reads", "rounds", "rounds per s", "without a read", "last [s]")
    rows = [
        (name, str(a.reads), str(a.rounds), f"{a.rate:.2f}", str(a.silent), f"{a.last:.1f}")
        for name, a in summary.antennas.items()
    ]
    known = f"{summary.known} {ON_ROBOT if is_fixed(log.rig) else IN_MAP}"
    return Paragraph(
        f"RFID: {summary.reads} reads of {known} and of {unknown}, in {summary.rounds} rounds, {summary.scans} scans",
        header,
        tuple(rows),
    )


def summarize_rfid(log: Log) -> RfidSummary | None:
    """Return a summary of the RFID reads of a log, or None if the log has no stream "rfid"."""
    stream = log.streams.get("rfid")
    if not isinstance(stream, RfidStream):
        return None
    first, antenna = stream.first_rows, np.array(stream.antenna, dtype=str)
    is_read = np.array([bool(epc) for epc in stream.epc], dtype=bool)
    silent = np.bincount(stream.number[is_read], minlength=len(first)) == 0
    antennas = {}
    for name in dict.fromkeys(stream.antenna):
        mine = antenna[first] == name
        t, reads = stream.t[first[mine]], stream.t[is_read & (antenna == name)]
        span = float(t.max() - t.min())
        antennas[name] = AntennaSummary(
            reads=len(reads),
            rounds=len(t),
            rate=(len(t) - 1) / span if span > 0.0 else 0.0,
            silent=int(np.count_nonzero(silent & mine)),
            last=float(t.max()),
            last_read=float(reads.max()) if len(reads) else None,
        )
    counts = Counter(epc for epc in stream.epc if epc)
    t = stream.t[first]
    late = np.maximum.accumulate(t) - t if len(t) else t
    return RfidSummary(
        reads=int(np.count_nonzero(is_read)),
        scans=len(list(stream.scans())),
        rounds=len(first),
        antennas=antennas,
        known=sum(epc in counts for epc in log.world.tags),
        unread=tuple(epc for epc in log.world.tags if epc not in counts),
        unknown={epc: count for epc, count in counts.most_common() if epc not in log.world.tags},
        late=(int(np.count_nonzero(late)), float(late.max(initial=0.0))),
    )


def rfid_problems(log: Log, summary: RfidSummary) -> list[Notice]:
    """Return warnings about the tags, the antennas and the clock of the reader in a log. ``summary``: the summary of
    the log."""
    out, fixed = list[Notice](), is_fixed(log.rig)
    if summary.unread:
        sentence = f"{{unread}} of {{tags}} {ON_ROBOT if fixed else IN_MAP} are never read: {{names}}"
        names = listed(summary.unread, SHOWN)
        out.append(notice("unread_tags", sentence, len(summary.unread), len(log.world.tags), names))
    if summary.unknown and not fixed:  # fixed antennas usually also read tags of goods and of other robots
        reads = sum(summary.unknown.values())
        sentence, names = "{reads} reads are of {tags} tags that the map lacks: {names}", listed(summary.unknown, SHOWN)
        out.append(notice("unknown_tags", sentence, reads, len(summary.unknown), names))
    if misspelt := in_other_case(summary.unknown, summary.unread):
        sentence = "tags are in the map with other capital letters: {names}: set epc_case for reads or map"
        out.append(notice("other_case", sentence, listed(misspelt, SHOWN)))
    if coded := [epc for epc in summary.unknown if text_of_hex(epc) in log.world.tags]:
        sentence = 'reads have the text of tags as hexadecimal digits: {names}: set epc_case = "ascii-hex"'
        out.append(notice("coded_epcs", sentence, listed(coded, SHOWN)))
    place = "in the map" if fixed else "on the rig"
    carried = log.rig.of(RfidSettings).all_antennas() if log.rig.find(RfidSettings) else {}
    out += [
        notice("unknown_antenna", UNKNOWN_ANTENNA, name, place, antenna.reads, antenna.rounds)
        for name, antenna in summary.antennas.items()
        if name not in carried
    ]
    idle = f"antenna {{antenna}} of the {'map' if fixed else 'rig'} is never active"
    out += [notice("idle_antenna", idle, name) for name in carried if name not in summary.antennas]
    last = max((antenna.last for antenna in summary.antennas.values()), default=0.0)
    for name, antenna in summary.antennas.items():
        if antenna.last < last - STOPPED:
            stops = "antenna {antenna} stops at {t:.1f} s, {before:.1f} s before the last antenna"
            out.append(notice("antenna_stops", stops, name, antenna.last, last - antenna.last))
        elif fixed:  # the robot may be elsewhere
            continue
        elif antenna.last_read is None:
            out.append(notice("silent", "antenna {antenna} reads nothing", name))
        elif antenna.last_read < last - STOPPED:
            out.append(notice("silent", "antenna {antenna} reads nothing after {t:.1f} s", name, antenna.last_read))
    return out + _clock_trouble(log, summary)


def _clock_trouble(log: Log, summary: RfidSummary) -> list[Notice]:
    out = []
    count, step = summary.late
    if step > CLOCK_STEP:
        jump = "{rounds} rounds have timestamps up to {step:.1f} s before an earlier round: did the clock of the reader jump?"
        out.append(notice("late_rounds", jump, count, step))
    odometry = log.streams.get("odometry")
    if odometry is None or not len(odometry.t) or not summary.rounds:
        return out
    t = log.streams["rfid"].t + log.rig.time_offset("rfid")
    wheels = odometry.t + log.rig.time_offset("odometry")
    for side, excess in (("before", wheels.min() - t.min()), ("after", t.max() - wheels.max())):
        if excess > CLOCK_STEP:
            apart = "the reads extend {excess:.1f} s {side} the odometry: do the clocks of reader and odometry agree?"
            out.append(notice("clocks_differ", apart, excess, side))
    return out


CLEARLY = 3.0  # minimum change of a parameter that causes a warning, in standard deviations
CHANGED = 0.1  # minimum relative change of a range, and minimum change of a probability, that causes a warning
TURNED, LATE = math.radians(3.0), 0.05  # minimum change of a yaw [rad] and of a time offset [s] that causes a warning


def review(use: Use, ending: Ending) -> Review:
    """Return warnings after a run, and the reliability of the RFID detection models. ``ending``: the results of the
    run."""
    use = replace(use, log=installed(use.log)) if "rfid" in use.sensors else use
    models = reliability(use, ending.final_diagnostics, ending.learnt, ending.final)
    return Review((*doubts(use, ending.diagnostics, ending.learnt), *models.warnings), models.reliability)


def doubts(use: Use, diagnostics: Diagnostics, learnt: Learnt) -> Iterator[Notice]:
    """Yield warnings after a run about reads that are not used, and about tags that are probably dead, weak or moved.
    Yield warnings about estimated constants that differ from the rig. ``diagnostics``: the diagnostics of the causal
    estimates. ``learnt``: the estimated constants."""
    log, rounds = use.log, diagnostics.ignored.get("rfid", 0)
    if rounds and use.estimator != "dead_reckoning":  # no warning, because dead reckoning uses only odometry
        ignored = "{log}: {estimator} does not use RFID: all {rounds} inventory rounds are ignored"
        yield notice("unused_rfid", ignored, log.name, use.estimator, rounds)
    if "rfid" not in use.sensors:
        return
    stream, tags, kind_of_tags = log.streams.get("rfid"), log.world.tags, ON_ROBOT if is_fixed(log.rig) else IN_MAP
    if isinstance(stream, RfidStream) and not any(epc in tags for epc in stream.epc):
        if tags:
            yield notice("unread_map", f"{{log}}: none of the {{tags}} {kind_of_tags} is read", log.name, len(tags))
        else:
            yield notice("no_map", "{log}: reads are not used, because the map has no tags", log.name)
        return
    for kind, why in (
        ("dead_tags", "are probably dead, because they were not read where reads were expected"),
        ("weak_tags", "are probably weak, because they were read much less than the antennas' models predict"),
        ("moved_tags", "have probably moved, because they were read from other positions than expected"),
    ):
        if suspects := diagnostics.doubted.get(kind):
            ranked = sorted(suspects.items(), key=lambda row: -row[1])
            names = listed((f"{name} ({_percent(probability)})" for name, probability in ranked), SHOWN)
            sentence = f"{{log}}: {{count}} of {{tags}} {kind_of_tags} {why}: {{suspects}}"
            yield notice(kind, sentence, log.name, len(suspects), len(tags), names)
    settings = log.rig.find(RfidSettings)
    if settings is not None:
        yield from (what.about(log.name) for what in _differences(settings, learnt))


def _differences(settings: RfidSettings, learnt: Learnt) -> Iterator[Notice]:
    """Yield warnings if estimated constants of the RFID reader clearly differ from the rig. ``settings``: the values in
    the rig. ``learnt``: the estimates of the run."""
    names = settings.parameter_names()
    for name, parameters in names.items():
        peak = min(settings.models[name].model().peak, MOST_CERTAIN)
        of = "the antennas" if len(names) == 1 else f"the antennas of model {quoted(name)}"
        ranges, rate = (learnt.values.get(f"rfid.{parameter}", (0.0, 0.0)) for parameter in parameters)
        factor = math.exp(ranges[0])
        if abs(ranges[0]) > CLEARLY * ranges[1] and abs(factor - 1.0) > CHANGED:
            sentence = "{antennas} reach {percent:.0f} % {direction} than the rig says"
            direction = "farther" if factor > 1.0 else "less far"
            yield notice("range", sentence, of, 100.0 * abs(factor - 1.0), direction)
        share = peak * rate_of(peak, rate[0])
        if abs(rate[0]) > CLEARLY * rate[1] and abs(share - peak) > CHANGED:
            sentence = "{antennas} read nearby tags in {percent:.0f} % of the rounds, but the rig's models predict {expected:.0f} %"
            yield notice("read_rate", sentence, of, 100.0 * share, 100.0 * peak)
    yield from _mounting(settings, learnt)


def _mounting(settings: RfidSettings, learnt: Learnt) -> Iterator[Notice]:
    """Yield warnings if the estimated yaws of antennas or the time offset clearly differ from ``settings``. The
    warnings contain the values to set."""
    common, turned = learnt.values.get("rfid.yaw", (0.0, 0.0)), dict[str, float]()
    for name in settings.all_antennas():
        own = learnt.values.get(f"rfid.antennas.{name}.yaw", (0.0, 0.0))
        turn = common[0] + own[0]
        if abs(turn) > max(CLEARLY * math.hypot(common[1], own[1]), TURNED):
            turned[name] = turn
    if turned:
        turns = ", ".join(f"{name} by {math.degrees(turn):+.1f} degrees" for name, turn in turned.items())
        yaws = {name: wrap_scalar(settings.all_antennas()[name].yaw + turn) for name, turn in turned.items()}
        section, file = ("antennas", "map") if settings.tags else ("rfid.antennas", "rig")
        lines = ", ".join(f"{section}.{name}.yaw = {yaw:.3f}" for name, yaw in yaws.items())
        sentence = f"antennas are turned from the yaw in the {file} ({{turns}}): set {{settings}} in the {file}"
        yield notice("antenna_yaw", sentence, turns, lines)
    later, sigma = learnt.values.get("rfid.time_offset", (0.0, 0.0))
    if abs(later) > max(CLEARLY * sigma, LATE):
        yield line("rfid", -later, "the odometry", "rfid", settings.time_offset + later)


def _percent(probability: float) -> str:
    return "> 99 %" if probability > 0.99 else f"{100.0 * probability:.0f} %"


MOST_ROUNDS = 6000  # maximum number of rounds of a log that are compared, evenly selected
OFF = 4.0  # minimum difference of observed and predicted reads that is reported, in standard deviations
TOGETHER = 2.0  # an overdispersion above this multiple of 1 / tempering causes a warning


@dataclass(frozen=True, eq=False)
class _Trials:
    """M trials. A trial is one round of one antenna that may read one tag.

    ``p`` (M,): predicted probability of a read. ``hit`` (M,): 1 for a read, otherwise 0. ``antenna``, ``tag`` (M,):
    indices of antenna and tag. ``block`` (M,): index of the time block. ``distance`` (M,): from antenna to tag [m].
    """

    p: Array
    hit: Array
    antenna: Integers
    tag: Integers
    block: Integers
    distance: Array


def reliability(use: Use, diagnostics: Diagnostics, learnt: Learnt, final: Trajectory) -> Review:
    """Return the reliability of the detection models, and warnings, from reads along the trajectory ``final``.

    Observed reads are compared with predicted reads of all tags, except tags that are probably dead. The review is
    empty without reads, antennas or covariances. ``diagnostics``: the diagnostics of ``final``. ``learnt``: the
    estimated parameters of the models.
    """
    log, settings = use.log, use.log.rig.find(RfidSettings)
    stream = log.streams.get("rfid")
    if settings is None or "rfid" not in use.sensors or not isinstance(stream, RfidStream) or not len(stream.t):
        return Review()
    if not log.world.tags or len(final) < 2 or final.covariances is None or "rfid" not in use.modalities:
        return Review()
    dead = diagnostics.doubted.get("dead_tags", {})
    kept = [name for name in log.world.tags if name not in dead]
    trials = _observed(use, stream, settings, learnt, final, kept)
    names = list(settings.all_antennas())
    return _counted(log.name, trials, names, settings.tempering)


def _observed(
    use: Use, stream: RfidStream, settings: RfidSettings, learnt: Learnt, final: Trajectory, kept: list[str]
) -> _Trials:
    log, tags = use.log, tag_map(use.log.world, use.log.rig.of(SurveySettings), kept)
    likelihood = RfidLikelihood(settings.model(), tags.tags)
    estimated = settings.estimated()
    changes = np.array([learnt.values.get(f"rfid.{name}", (0.0, 0.0))[0] for name in estimated.names])
    likelihood = likelihood.adjusted(estimated.full(changes, len(likelihood.parameters)))
    first, hits = stream.first_rows, stream.hits(tags.index)
    t = stream.t[first] + log.rig.time_offset("rfid") + likelihood.packed.delay[0]
    block = ((t - t.min()) // BLOCK).astype(np.int64)
    is_read = np.isin(block, block[hits.any(axis=1)])
    numbers = {name: i for i, name in enumerate(settings.all_antennas())}
    antenna = np.array([numbers.get(stream.antenna[i], -1) for i in first.tolist()], dtype=np.int64)
    poses = possible_poses(final, t)
    used = np.flatnonzero(np.isfinite(poses[:, 0]) & (antenna >= 0) & is_read)
    if len(used) > MOST_ROUNDS:
        used = used[np.linspace(0, len(used) - 1, MOST_ROUNDS).astype(np.int64)]
    survey = tags.tags.points, tags.tags.normals
    p, distance = kernels.probabilities(likelihood.packed, antenna[used], poses[used], *survey)
    n, tag = np.nonzero(p > POSSIBLE)
    rows = used[n]
    return _Trials(p[n, tag], hits[rows, tag].astype(float), antenna[rows], tag, block[rows], distance[n, tag])


def _counted(log: str, trials: _Trials, antennas: list[str], tempering: float) -> Review:
    """Return the reliability and warnings from observed and predicted reads by intervals of distance and by
    ``antennas``. The review is empty if too few reads are predicted. ``log``: the name of the log. ``tempering``: the
    exponent of the likelihood in the rig."""
    if trials.p.sum() < FEWEST:
        return Review()
    groups = ReadGroups(antennas)
    ones = np.ones(len(trials.p), dtype=np.int64)
    reads = ExpectedReads(trials.tag, trials.hit.astype(np.int64)[:, None], trials.p[:, None], trials.distance[:, None])
    groups.add(trials.antenna, ones, reads, ones[:, None] > 0)
    ratio, chosen = _overdispersion(trials, (trials.distance // BAND).astype(np.int64)), groups.large()
    if not len(chosen):
        return Review()
    observed, predicted, variance = groups.sums[:, chosen]
    # a tempering below 1 already assumes correlated rounds: 1 / tempering is the minimum overdispersion
    sigma = np.sqrt(max(ratio, 1.0 / tempering) * variance)
    off = (np.abs(observed - predicted) > OFF * sigma) & (np.abs(observed / predicted - 1.0) > DIFFERENT)
    doubts = []
    if np.any(off):
        shares = groups.shares(chosen[off])
        sentence = (
            "{log}: the ratio of observed to predicted reads is far from 1 at these distances and antennas: {shares}"
        )
        doubts.append(notice("detection_model", sentence, log, shares))
    if ratio * tempering > TOGETHER:
        sentence = (
            "{log}: reads are correlated, {rounds:.0f} rounds have the information of one: set rfid.tempering = "
            "{tempering:.2g} in the rig (now {present:g})"
        )
        doubts.append(notice("bursts", sentence, log, ratio, 1.0 / ratio, tempering))
    return Review(tuple(doubts), Reliability("reads", groups.names(chosen), observed, predicted, sigma, ratio))


def _overdispersion(trials: _Trials, band: Integers) -> float:
    """Return the overdispersion (:func:`.overdispersion`) of ``trials``. The probabilities are scaled first, so that
    they predict the number of reads in each distance interval. ``band`` (M,): the index of the interval of each
    trial."""
    share = np.ones(int(band.max(initial=0)) + 1)
    predicted, observed = np.bincount(band, trials.p), np.bincount(band, trials.hit)
    np.divide(observed, predicted, out=share, where=predicted > 0.0)
    p = np.clip(trials.p * share[band], 0.0, 1.0 - 1e-3)
    return overdispersion(trials.hit, np.ones(len(p)), p, trials.antenna, trials.tag, trials.block)[0]
