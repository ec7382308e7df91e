"""The logs of scripts/baseline: their names, and the functions that make them."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from recorded_logs import recorded_log

import factorgraph_loc as fgloc
from factors import se2

sys.path.insert(0, str(Path(__file__).resolve().parent / "benchmarks"))
from field_benchmark.cases import CASES

CARRIED, FOUND = 60.0, 80.0  # s: between these times the robot is carried and its wheels stand still

ROBOTS = ("mrclam6-robot1", "mrclam6-robot3", "mrclam6-robot5", "woods-r5")
RECORDED = (*ROBOTS, "woods-r1", "woods-r3", "plaza1", "plaza2")
AISLES = ("rfid-aisle-run13", "rfid-aisle-run16")
MOVED = ("mrclam6-robot3-carried", "woods-r5-carried")
OFFICES, CAMERAS = ("office-1", "office-2"), ("camera-1", "camera-2")
HALLS = tuple(f"field-hall-{site}-{day}" for site in (1, 2) for day in (1, 2))
LIFTED = tuple(f"field-carried-{seed}" for seed in (1, 2, 3, 4))
FAULTS = ("clean", "antenna_common", "antenna", "map", "offset0.15", "latency0.15", "slip200-400", "weak0.2-0.5")
FAULTS += ("deadantenna3", "lostreads0.2", "scale1.03")
FAULTY = tuple(f"field-office-1-{fault}" for fault in FAULTS)
BROKEN = tuple(f"fault-{case}-{seed}" for case in ("wall", "plaza", "moved") for seed in (1, 2, 3))

# Each of the following functions makes the logs ``names`` in the folder ``logs``. ``programs`` is the folder of the program
# field.py.


def recorded(names: tuple[str, ...], logs: Path, _: Path) -> None:
    log = recorded_log(names[0].removesuffix("-carried"))
    fgloc.write_native(carried(log) if names[0].endswith("-carried") else log, logs / names[0])


def carried(log: fgloc.Log) -> fgloc.Log:
    """Return the log of a robot that is carried for some time: its odometry reports no motion, and its sensors still measure."""
    odometry, start = log.streams["odometry"], log.span()[0]
    moves = ~((odometry.t > start + CARRIED) & (odometry.t <= start + FOUND))
    motion = [name for name in ("v", "w", "dx", "dy", "dtheta") if hasattr(odometry, name)]
    still = replace(odometry, **{name: getattr(odometry, name) * moves for name in motion})
    return replace(log, streams={**log.streams, "odometry": still})


def office(names: tuple[str, ...], logs: Path, _: Path) -> None:
    """Make four logs of a simulated office: with all sensors except images, with bearings but no ranges, with ranges but no
    bearings, and with a robot that is carried."""
    seed = int(names[0].rpartition("-")[2])
    world = {"tags": 30, "landmarks": 12, "points": 150}
    changes = {"drive": {"duration": 200.0}, "world": world, "rssi": {}, "phase": {}}
    log = fgloc.simulate("office", seed, changes=changes)
    rig = log.rig.model_dump(mode="json", exclude_none=True) | {"imu": {}}
    strength = {"coefficients": (-50.0, 2.0, -8.0, 0.0, 2.0, 0.0), "sigma": 2.0, "dof": 4.0, "tempering": 0.3}
    rig["rfid"] |= {"rssi": strength, "phase": {"tempering": 0.5, "max_range": 4.0}}
    wheels, seen = log.streams["odometry"], log.streams["bearing_range"]
    t = np.arange(0.0, wheels.t[-1], 0.05)
    rate = np.interp(t, wheels.t[1:], wheels.dtheta[1:] / np.diff(wheels.t)) + 0.01
    own = {"imu": fgloc.YawRateStream(t, rate), "loops": loops(log.reference, np.random.default_rng(seed))}
    log = replace(log, rig=fgloc.Rig.model_validate(rig), streams={**log.streams, **own})
    for name, column in zip(names[1:3], ("bearing", "range"), strict=True):
        some = replace(seen, **{column: np.full(len(seen.t), np.nan)})
        fgloc.write_native(
            replace(log, streams={"odometry": wheels, "bearing_range": some}), logs / name, overwrite=True
        )
    fgloc.write_native(carried(log), logs / names[3], overwrite=True)
    fgloc.write_native(log, logs / names[0], overwrite=True)


def loops(reference: fgloc.Trajectory, rng: np.random.Generator) -> fgloc.LoopStream:
    """Return simulated loop closures. Every ten seconds the pose is measured relative to the nearest pose that is at least 30 s
    older, if its distance is below 2 m."""
    rows = []
    for t, pose in zip(reference.t[::100], reference.poses[::100], strict=True):
        away = np.hypot(*(reference.poses[:, :2] - pose[:2]).T) + np.where(reference.t < t - 30.0, 0.0, np.inf)
        before = int(np.argmin(away))
        if away[before] < 2.0:
            relative = se2.between(reference.poses[before], pose)
            rows.append((t, t - reference.t[before], *(relative + rng.standard_normal(3) * (0.05, 0.05, 0.02)), 1.0))
    return fgloc.LoopStream(*np.array(rows).T)


def camera(names: tuple[str, ...], logs: Path, _: Path) -> None:
    """Make the log of a second drive through a rendered office. Its map is made from the images of the first drive."""
    seed = int(names[0].rpartition("-")[2])
    changes = {"drive": {"duration": 60.0}, "world_seed": 2 + seed}
    with tempfile.TemporaryDirectory(dir=logs) as temporary:
        first, second, world = (Path(temporary) / name for name in ("first", "second", "seen.world.toml"))
        for drive, folder in enumerate((first, second)):
            fgloc.simulate("office", 10 * seed + drive, changes=changes, images=True, out=folder)
        fgloc.build_map(first, world)
        fgloc.write_native(fgloc.read_log(second, world=world), logs / names[0])


def halls(names: tuple[str, ...], logs: Path, programs: Path) -> None:
    with tempfile.TemporaryDirectory(dir=logs) as temporary:
        run_field(programs, "hall", "--sites", "1,2", "--days", "1,2", "--out", temporary)
        for name in names:
            site, day = name.split("-")[2:]
            log = fgloc.read_log(Path(temporary) / f"site{site}/day{day}.toml")
            fgloc.write_native(log, logs / name, overwrite=True)


def faulty(names: tuple[str, ...], logs: Path, programs: Path) -> None:
    with tempfile.TemporaryDirectory(dir=logs) as temporary:
        run_field(programs, "office", "--seeds", "1", "--faults", ",".join(FAULTS), "--out", temporary)
        for name, fault in zip(names, FAULTS, strict=True):
            (Path(temporary) / ("clean-office-1" if fault == "clean" else f"1-{fault}")).rename(logs / name)


def broken(names: tuple[str, ...], logs: Path, _: Path) -> None:
    """Make the log of a case of the benchmark of faults, ``scripts/bench field``."""
    _, case, seed = names[0].split("-")
    fgloc.write_native(CASES[case](int(seed))[0], logs / names[0])


def run_field(programs: Path, *arguments: str) -> None:
    """Run field.py, which makes its logs. It also runs an estimator, which is the fastest one."""
    if not (programs / "field.py").is_file():
        raise FileNotFoundError(f"{programs}: contains no field.py: name its folder by --field")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    command = [sys.executable, str(programs / "field.py"), *arguments, "-e", "dead_reckoning"]
    subprocess.run(command, env={**os.environ, "PATH": path}, stdout=subprocess.DEVNULL, check=True)


SOURCES: tuple[tuple[Callable[[tuple[str, ...], Path, Path], None], tuple[str, ...]], ...] = (
    *((recorded, (name,)) for name in (*RECORDED, *AISLES, *MOVED)),
    *((office, tuple(f"{name}{part}" for part in ("", "-ranges", "-bearings", "-carried"))) for name in OFFICES),
    *((camera, (name,)) for name in CAMERAS),
    (halls, HALLS),
    (faulty, FAULTY),
    *((broken, (name,)) for name in (*LIFTED, *BROKEN)),
)
