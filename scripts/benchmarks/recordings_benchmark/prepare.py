"""Download of public recordings, and their conversion to logs."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from urllib.request import urlretrieve

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import replacing, write_toml
from factorgraph_loc.io.native.native import write_native
from factorgraph_loc.io.native.rig_file import DEFAULT_RIG
from factorgraph_loc.io.readers import load
from factorgraph_loc.io.readers.pose_file import read_kitti, read_pose_file
from factorgraph_loc.model.log import Log, cut
from factorgraph_loc.model.measurement import Stream
from factorgraph_loc.model.pose_path import PosePath
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeStream, Landmark
from factorgraph_loc.sensors.odometry.measurement import IncrementStream, VelocityStream
from factorgraph_loc.sensors.odometry.simulation import wheel_odometry
from factors import se2
from factors.se2 import Array
from recordings_benchmark.listed import Recording

ODOMETRY_SEED = 1
# recording of a trolley: positions of the anchors [m], and of tag 0 in the body frame. This frame is upside down, with y to the
# right
ANCHORS = (
    (-3.4203, 3.0053),
    (0.0016, 3.0110),
    (3.6056, 2.9795),
    (3.6011, -0.0008),
    (3.5674, -3.0087),
    (-0.0072, -2.9652),
    (-3.4673, -2.9587),
    (-3.4858, -0.0098),
)
TAG = (-0.0689, 0.1423)
TAGS, THINNED = 3, 10  # number of tags in a row; every tenth row is used, which results in 10 Hz


def prepare(recording: Recording, folder: Path, out: Path) -> Log:
    """Convert a recording to a log, and write the log to ``out``. Missing files are downloaded to ``folder``.

    Raises InputError for damaged files, and for files that cannot be downloaded.
    """
    paths = [folder / name for name in recording.files]
    for path, url in zip(paths, recording.files.values(), strict=True):
        try:
            if not path.is_file():
                with replacing(path) as temporary:
                    urlretrieve(url, temporary)
        except OSError as error:
            raise InputError(f"{path}: cannot be downloaded from {url}: {error}") from error
    if recording.kind == "bag":
        return _bag(recording, paths[0], out)
    log = KINDS[recording.kind](recording, paths)
    if recording.seconds is not None:
        log = cut(log, 0.0, recording.seconds)
    target = out / recording.name
    if not target.exists():
        write_native(log, target)
    # return the log as read from its files
    return load(target)[0]


def _bag(recording: Recording, path: Path, out: Path) -> Log:
    manifest = out / f"{recording.name}.toml"
    content = {"title": recording.title, "reader": "rosbag", "path": path.name, "licence": recording.licence}
    content |= {"origin": recording.origin}
    out.mkdir(parents=True, exist_ok=True)
    write_toml(manifest, content | {"options": recording.options})
    log = load(manifest, data_root=path.parent)[0]
    return replace(log, name=recording.name)


def _librsf(recording: Recording, paths: list[Path]) -> Log:
    """Convert files in the text format of libRSF. A line has a name, a stamp and numbers."""
    rows: dict[str, list[list[float]]] = {}
    for path in paths:
        for line in path.read_text(encoding="utf-8").splitlines():
            name, *numbers = line.split()
            rows.setdefault(name, []).append([float(number) for number in numbers])
    tables = {name: np.array(values) for name, values in rows.items() if name != "loop"}
    landmarks: dict[str, Landmark] = {}
    streams: dict[str, Stream] = {}
    if "odom2diff" in tables:
        # columns as in libRSF's factor (OdometryFactor2DDifferential.h): left and right speed, unused, half of the track width
        t, left, right, _, half = tables["odom2diff"].T[:5]
        streams["odometry"] = VelocityStream(t, (left + right) / 2.0, (right - left) / (2.0 * half))
    else:
        t, *velocity = tables["odom2"].T[:4]
        # a row contains the velocity from the previous stamp to its stamp
        moves = np.stack(velocity, axis=-1) * np.diff(t, prepend=t[0])[:, None]
        streams["odometry"] = IncrementStream(t, *np.ascontiguousarray(moves.T))
    if "range2" in tables:
        ranges = tables["range2"]
        names = [f"{number:.0f}" for number in ranges[:, 5]]
        landmarks = {name: Landmark(x=row[3], y=row[4]) for name, row in zip(names, ranges.tolist(), strict=True)}
        streams["bearing_range"] = BearingRangeStream(ranges[:, 0], names, ranges[:, 1], np.full(len(ranges), np.nan))
    places = tables["point2"]
    angles = tables["angle"][:, 1] if "angle" in tables else np.zeros(len(places))
    poses = np.column_stack((places[:, 1:3], se2.wrap(angles)))
    reference = Trajectory(places[:, 0], poses, has_heading="angle" in tables)
    return _log(recording, streams, reference, World(name=recording.name, landmarks=landmarks))


def _trajectory(recording: Recording, paths: list[Path]) -> Log:
    """Convert files of poses. The first file is the reference. The odometry is the motion between the poses of the second file.
    If there is no second file, the odometry is simulated."""
    axis = "xyz".index(recording.options.get("axis", "x"))
    if recording.options["format"] == "kitti":
        times = paths.pop(1)
        truth, *others = (_planar(read_kitti(path, times), axis) for path in paths)
    else:
        truth, *others = (_planar(read_pose_file(path), axis) for path in paths)
    t0 = truth.t[0]
    reference = Trajectory(truth.t - t0, truth.poses)
    if not others:
        return _log(recording, {"odometry": wheel_odometry(reference, ODOMETRY_SEED)}, reference, World())
    seen = others[0]
    moves = np.vstack((np.zeros((1, 3)), se2.between(seen.poses[:-1], seen.poses[1:])))
    return _log(
        recording, {"odometry": IncrementStream(seen.t - t0, *np.ascontiguousarray(moves.T))}, reference, World()
    )


def _planar(path: PosePath, axis: int) -> Trajectory:
    """Project poses in space to the plane. ``axis``: the body axis whose direction is the heading. It is z for a camera and for
    the IMU of EuRoC."""
    ahead = path.rotations[:, :, axis]
    poses = np.column_stack((path.positions[:, :2], np.arctan2(ahead[:, 1], ahead[:, 0])))
    return Trajectory(path.seconds(), poses)


def _trolley(recording: Recording, paths: list[Path]) -> Log:
    """Convert the recording of a trolley with radio ranges and motion capture. The ranges of one of its three tags are used. Its
    wheel odometry is simulated from the motion capture."""
    capture, ranges = (_dated(path) for path in paths)
    t0 = float(max(capture[0, 0], ranges[0, 0]))
    x, y, qw, qx, qy, qz = capture[:, (1, 2, 4, 5, 6, 7)].T
    heading = np.arctan2(2.0 * (qx * qy + qw * qz), 1.0 - 2.0 * (qy**2 + qz**2))
    kept = (np.diff(capture[:, 0], prepend=-np.inf) > 0.0) & (capture[:, 0] >= t0)
    reference = Trajectory(capture[kept, 0] - t0, np.column_stack((x, y, heading))[kept])
    rows = ranges[::THINNED]
    rows = rows[(rows[:, 0] > t0) & np.isfinite(rows).all(axis=1)]
    names = [str(i) for i in range(len(ANCHORS))]
    told = rows[:, 1::TAGS]
    stream = BearingRangeStream(
        np.repeat(rows[:, 0] - t0, len(ANCHORS)), names * len(rows), told.ravel(), np.full(told.size, np.nan)
    )
    landmarks = {name: Landmark(x=place[0], y=place[1]) for name, place in zip(names, ANCHORS, strict=True)}
    streams: dict[str, Stream] = {"odometry": wheel_odometry(reference, ODOMETRY_SEED), "bearing_range": stream}
    log = _log(recording, streams, reference, World(name=recording.name, landmarks=landmarks))
    assert log.rig.bearing_range is not None
    mounted = log.rig.bearing_range.model_copy(update={"x": TAG[0], "y": TAG[1]})
    return replace(log, rig=log.rig.model_copy(update={"bearing_range": mounted}))


def _dated(path: Path) -> Array:
    """Read a CSV file whose rows have a date and numbers. Returns rows of the seconds of the day and the numbers, NaN for empty
    cells."""
    out = []
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.reader(file):
            if not row[0][:1].isdigit():
                continue
            moment = datetime.strptime(row[0], "%Y-%m-%d %H:%M:%S.%f")
            seconds = 3600.0 * moment.hour + 60.0 * moment.minute + moment.second + moment.microsecond / 1e6
            out.append([seconds, *(float(cell) if cell else np.nan for cell in row[1:])])
    return np.array(out)


def _log(recording: Recording, streams: dict[str, Stream], reference: Trajectory, world: World) -> Log:
    sensors = tuple(streams)
    rig = DEFAULT_RIG.model_copy(update={"sensors": sensors})
    return Log(name=recording.name, rig=rig, world=world, streams=streams, reference=reference)


KINDS: dict[str, Callable[[Recording, list[Path]], Log]] = {
    "librsf": _librsf,
    "trajectory": _trajectory,
    "trolley": _trolley,
}
