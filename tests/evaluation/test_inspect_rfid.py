"""What `inspect` says about reads of tags."""

import dataclasses
import json

import numpy as np
import pytest
from by_hand import reads

from factorgraph_loc import Log, RfidStream, Rig, Tag, VelocityStream, World
from factorgraph_loc.evaluation.inspect import inspect
from factorgraph_loc.model.measurement import columns_of
from factorgraph_loc.sensors.rfid.settings import AntennaSettings, RfidSettings

ANTENNAS = ("left", "right")


def make_log(**changes) -> Log:
    """A minute with two rounds per second of two antennas that end together; left reads A and B, right nothing in every other."""
    rows = [
        (0.5 * k, a, name, tag, 0.0)
        for k in range(120)
        for a, name in enumerate(ANTENNAS)
        for tag in ("AB" if name == "left" else ("" if k % 2 else "A",))
    ]
    wheels = np.arange(600) * 0.1
    settings = RfidSettings(antennas={name: AntennaSettings() for name in ANTENNAS})
    return Log(
        name="minute",
        rig=Rig(sensors=("odometry", "rfid"), rfid=settings),
        world=World(tags={name: Tag(x=0.0, y=0.0) for name in "AB"}),
        streams={
            "odometry": VelocityStream(wheels, wheels, wheels),
            "rfid": dataclasses.replace(reads(*rows), **changes),
        },
    )


def stream_of(log: Log) -> RfidStream:
    stream = log.streams["rfid"]
    assert isinstance(stream, RfidStream)
    return stream


def only(keep: np.ndarray) -> dict[str, object]:
    """The columns of the rows to keep."""
    stream = stream_of(make_log())
    columns = {name: np.asarray(column)[keep] for name, column in columns_of(stream).items()}
    return {name: column.tolist() if name in {"antenna", "epc"} else column for name, column in columns.items()}


def test_counts() -> None:
    found = inspect(make_log())
    rfid = found.found["rfid"]
    assert rfid is not None
    assert (rfid.reads, rfid.rounds, rfid.scans, rfid.known, found.problems) == (300, 240, 120, 2, ())
    right = rfid.antennas["right"]
    assert (right.reads, right.rounds, right.silent, right.last, right.last_read) == (60, 120, 60, 59.5, 59.0)
    assert right.rate == pytest.approx(2.0)
    json.dumps(dataclasses.asdict(rfid), allow_nan=False)


def test_a_log_without_reads() -> None:
    log = make_log()
    assert inspect(dataclasses.replace(log, streams={"odometry": log.streams["odometry"]})).found["rfid"] is None
    none = inspect(make_log(**only(np.zeros(360, dtype=bool)[: len(stream_of(log).t)])))
    assert none.found["rfid"] is not None
    assert none.found["rfid"].reads == none.found["rfid"].rounds == 0
    assert "antenna left of the rig is never active" in map(str, none.problems)


def test_tags_that_do_not_match_the_map() -> None:
    world = World(tags={name: Tag(x=0.0, y=0.0) for name in ("A", "C", "D")})
    found = inspect(dataclasses.replace(make_log(), world=world))
    assert found.found["rfid"] is not None
    assert (found.found["rfid"].unread, found.found["rfid"].unknown) == (("C", "D"), {"B": 120})
    assert tuple(map(str, found.problems)) == (
        "2 of 3 tags of the map are never read: C, D",
        "120 reads are of 1 tags that the map lacks: B",
    )


def test_an_antenna_that_stops() -> None:
    stream = stream_of(make_log())
    right = np.array(stream.antenna) == "right"
    (problem,) = inspect(make_log(**only(~right | (stream.t < 30.0)))).problems
    assert str(problem) == "antenna right stops at 29.5 s, 30.0 s before the last antenna"
    # its rounds go on, without a read
    epc = ["" if r and t >= 30.0 else e for r, t, e in zip(right, stream.t, stream.epc, strict=True)]
    (problem,) = inspect(make_log(epc=epc)).problems
    assert str(problem) == "antenna right reads nothing after 29.0 s"
    epc = ["" if r else e for r, e in zip(right, stream.epc, strict=True)]
    (problem,) = inspect(make_log(epc=epc)).problems
    assert str(problem) == "antenna right reads nothing"


def test_clocks_that_do_not_agree() -> None:
    t = stream_of(make_log()).t
    (problem,) = inspect(make_log(t=t + 3.0)).problems
    assert str(problem) == "the reads extend 2.6 s after the odometry: do the clocks of reader and odometry agree?"
    (problem,) = inspect(make_log(t=np.where(t >= 30.0, t - 10.0, t))).problems
    assert (
        str(problem)
        == "38 rounds have timestamps up to 9.5 s before an earlier round: did the clock of the reader jump?"
    )
