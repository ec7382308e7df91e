"""ROS bags: a drive of ten minutes to a bag and back, small messages per second, images in MB per second, and memory."""

from __future__ import annotations

import os
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from benchmarking.report import Options, Report

from factorgraph_loc.files.models import parse_model
from factorgraph_loc.io.bags import rosbag
from factorgraph_loc.io.bags.export import write_bag
from factorgraph_loc.io.bags.file import open_bag
from factorgraph_loc.io.bags.manifest import propose
from factorgraph_loc.io.native.native import write_native
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.stream import ImageStream
from factorgraph_loc.sensors.odometry.measurement import IncrementStream, VelocityStream
from factorgraph_loc.sensors.rfid.stream import RfidStream

KINDS = {"ROS 1": "bag", "ROS 2, mcap": "mcap", "ROS 2, sqlite3": "db3"}
SECONDS, MESSAGES, MEGABYTES = 10.0, 20_000, 50.0  # largest time; least throughputs
IMAGES, IMAGE_BYTES = 400, 1_000_000
T0 = 1_700_000_000 * 10**9


def section(options: Options) -> Report:
    report = Report("bags", options)
    drive, rows = ten_minutes(), []
    with tempfile.TemporaryDirectory(dir=options.out) as folder:
        os.environ["FGLOC_CACHE"] = folder
        for name, suffix in KINDS.items():
            rows.append([name, *small(drive, Path(folder) / f"drive-{suffix}.{suffix}", report)])
        heads = (
            "bag",
            "messages",
            "written [s]",
            "read and as tables [s]",
            "the same on the processor [s]",
            "messages a second",
        )
        report.table(heads, rows)
        report.say(
            "Ten minutes of odometry at 50 Hz, rounds of RFID at 16 Hz with four reads each, a reference at 30 Hz."
        )
        images = photographs(Path(folder))
        rows = [
            [name, *large(images, Path(folder) / f"film-{suffix}.{suffix}", report)] for name, suffix in KINDS.items()
        ]
        report.table(
            (
                "bag",
                "images [MB]",
                "read [s]",
                "MB a second",
                "MB a second of the processor",
                "most memory so far [MB]",
            ),
            rows,
        )
        report.say(
            f"{IMAGES} images of {IMAGE_BYTES / 1e6:g} MB, written to files undecoded, in a process that grew by no more."
        )
    return report


def small(drive: Log, bag: Path, report: Report) -> list[str]:
    written, _, _ = timed(lambda: write_bag(drive, bag))
    options, count = proposed(bag)
    clock, processor, log = timed(lambda: rosbag.read(bag, options))
    tables, more, _ = timed(lambda: write_native(log, bag.with_suffix("")))
    if count / processor < MESSAGES:
        report.failed.append(f"{bag.name}: fewer than {MESSAGES} messages a second")
    if clock + tables > SECONDS:
        report.failed.append(f"{bag.name}: takes more than {SECONDS:g} s")
    whole = (f"{written:.1f}", f"{clock + tables:.1f}", f"{processor + more:.1f}")
    return [str(count), *whole, f"{count / processor:.0f}"]


def large(film: Log, bag: Path, report: Report) -> list[str]:
    write_bag(film, bag)
    options, _ = proposed(bag)
    megabytes = bag.stat().st_size / 1e6
    clock, processor, _ = timed(lambda: rosbag.read(bag, options))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    if megabytes / clock < MEGABYTES:
        report.failed.append(f"{bag.name}: fewer than {MEGABYTES:g} MB a second")
    bag.unlink()
    return [
        f"{megabytes:.0f}",
        f"{clock:.1f}",
        f"{megabytes / clock:.0f}",
        f"{megabytes / processor:.0f}",
        f"{peak:.0f}",
    ]


def ten_minutes() -> Log:
    t, pose_t = np.arange(0.0, 600.0, 0.02), np.arange(0.0, 600.0, 1.0 / 30.0)
    rounds = np.repeat(np.arange(600 * 16), 4)
    count = len(rounds)
    reads = RfidStream(
        (rounds + 1) / 16.0,
        rounds,
        [str(1 + i % 8) for i in rounds.tolist()],
        [f"E2{i % 40:04d}" for i in range(count)],
        np.zeros(count),
        np.full(count, -60.0),
        np.full(count, 1.0),
        np.full(count, 866e6),
    )
    odometry = IncrementStream(t, np.full(len(t), 0.01), np.zeros(len(t)), np.full(len(t), 0.001))
    way = Trajectory(pose_t, np.column_stack((0.5 * pose_t, 0.0 * pose_t, 0.0 * pose_t)))
    return Log("drive", Rig(), World(), {"odometry": odometry, "rfid": reads}, way, t0_ns=T0)


def photographs(folder: Path) -> Log:
    """Files that begin as JPEG does, which is all that is checked."""
    rng = np.random.default_rng(0)
    files = []
    for i in range(8):
        files.append(folder / f"{i}.jpg")
        files[-1].write_bytes(b"\xff\xd8\xff" + rng.bytes(IMAGE_BYTES - 3))
    t = np.arange(IMAGES) / 10.0
    film = ImageStream(t, [files[i % len(files)] for i in range(IMAGES)])
    return Log("film", Rig(), World(), {"odometry": VelocityStream(t, t, t), "camera": film}, t0_ns=T0)


def proposed(bag: Path) -> tuple[rosbag.Options, int]:
    """The proposed options for a bag, and its number of messages."""
    with open_bag(bag) as opened:
        count = sum(topic.count for topic in opened.topics.values())
        return parse_model(rosbag.Options, propose(opened).options, bag), count


def timed(work: Callable[[], Any]) -> tuple[float, float, Any]:
    """Wall-clock and processor seconds, and the result."""
    clock, processor = time.perf_counter(), time.process_time()
    result = work()
    return time.perf_counter() - clock, time.process_time() - processor, result
