"""Small files of our own formats for the fuzzer: each function writes into an empty folder."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

import factorgraph_loc as fgloc
from factorgraph_loc.experiments.experiment import prepare, run_experiment
from factorgraph_loc.model.log import Log
from factors.rfid.model import GridModel

WORLD_TABLES = """
walls = "hall.yaml"
[tags]
file = "tags.csv"
separator = ";"
decimal = ","
epc_case = "upper"
columns = { epc = "Tag ID", x = "X [cm]", y = "Y [cm]", z = "Height [cm]", facing = "Faces [deg]" }
units = { x = "cm", y = "cm", z = "cm", facing = "deg" }
[markers]
"tag36h11-7" = { x = 4.0, y = 1.0, z = 1.2, size = 0.16, facing = 3.1416, sigma = 0.005 }
[landmarks]
door = { x = 4.0, y = 1.0, sigma = 0.02 }
beacon = { x = 1.0, y = -2.0, covariance = [0.0025, 0.0004, 0.0009] }
"""
TAGS = "Tag ID;X [cm];Y [cm];Height [cm];Faces [deg]\nE2 01;100,0;-50,5;150,0;90,0\ne202;310,5;80,0;120,0;-45,0\n"
YAML = "image: hall.{}\nresolution: 0.25\norigin: [-1.0, -3.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
EXPERIMENT = """\
name = "e"
logs = ["log", { simulate = "office", seeds = "0:2", settings = { drive = { duration = 2.0 } } }]
estimators = ["dead_reckoning", { name = "particle_filter", label = "pf", settings = { particles = 50 } }]
sensors = [["odometry", "bearing_range"], ["odometry"]]
seeds = [0]
max_gap = 1.0
[sweep]
"pf.particles" = [20, 30]
[limits]
time = 60
memory = 2000
[report]
baseline = "dead_reckoning"
"""
SIMULATION = """\
preset = "office"
rounds_per_second = 4
[world]
density = 0.1
surfaces = ["wall", "floor"]
landmarks = 4
[drive]
speed = 0.8
duration = 2.0
[faults]
misplaced = 0.1
misplaced_by = 1.0
[rig.rfid]
tempering = 0.5
"""


def drive(seconds: float = 3.0, seed: int = 3, **world: int) -> Log:
    """A short drive in a small world, with every sensor that needs no images."""
    log = fgloc.simulate(
        "office",
        seed,
        changes={
            "drive": {"duration": seconds},
            "world": {"tags": 8, "landmarks": 8, "points": 20, **world},
            "sightings": {"max_range": 20.0, "rate": 4.0},
            "rssi": {},
            "phase": {},
            "rig": {"rfid": {"phase": {}}},
        },
    )
    moved = log.streams["odometry"]
    assert isinstance(moved, fgloc.IncrementStream)
    gyro = fgloc.YawRateStream(moved.t[1:], moved.dtheta[1:] / np.diff(moved.t))
    return replace(log, name="sim", streams={**log.streams, "imu": gyro})


def csv(folder: Path) -> None:
    shutil.rmtree(folder)
    fgloc.write_native(drive(), folder)


def parquet(folder: Path) -> None:
    shutil.rmtree(folder)
    fgloc.write_native(drive(), folder, format="parquet")


def images(folder: Path) -> None:
    """A log with two images of any content."""
    csv(folder)
    _camera_rig(folder / "sim.rig.toml")
    (folder / "camera").mkdir()
    rng = np.random.default_rng(0)
    first, last = 0, int(drive().streams["odometry"].t[-1] * 1e9)
    names = {first: "a.png", last: "b.jpg"}
    for name in names.values():
        cv2.imwrite(str(folder / "camera" / name), rng.integers(0, 255, (24, 32, 3), dtype=np.uint8))
    (folder / "camera.csv").write_text("t_ns,file\n" + "".join(f"{t},{name}\n" for t, name in names.items()))


def _camera_rig(path: Path) -> None:
    rig = fgloc.read_rig(path).model_dump(exclude_unset=True)
    lens = {"width": 32, "height": 24, "fx": 20.0, "fy": 20.0, "cx": 16.0, "cy": 12.0, "z": 1.0}
    fgloc.write_rig(fgloc.Rig.model_validate({**rig, "camera": lens}), path)


def world(folder: Path) -> None:
    """A map with tags in a table of a spreadsheet, an occupancy map as PGM, landmarks and markers."""
    (folder / "hall.world.toml").write_text('name = "hall"' + WORLD_TABLES)
    (folder / "tags.csv").write_text(TAGS)
    occupancy(folder, "pgm")


def occupancy(folder: Path, suffix: str = "png") -> None:
    """An occupancy map of a room, as map_server reads it."""
    cells = np.full((24, 32), 254, dtype=np.uint8)
    cells[4, 3:28] = cells[19, 3:28] = cells[4:20, 3] = cells[4:20, 27] = 0
    cv2.imwrite(str(folder / f"hall.{suffix}"), cells)
    (folder / "hall.yaml").write_text(YAML.format(suffix))
    (folder / "w.world.toml").write_text('name = "w"\nwalls = "hall.yaml"\n')


def rig(folder: Path) -> None:
    fgloc.write_rig(drive().rig, folder / "r.rig.toml")


def points(folder: Path) -> None:
    fgloc.write_world(drive().world, folder / "w.world.toml")


def grid(folder: Path) -> None:
    logits = np.random.default_rng(0).normal(-2.0, 1.0, (2, 6, 5, 5))
    fgloc.write_grid(GridModel(logits, -2.5, -2.5, 1.0, np.array([0.0, 1.0])), folder / "g.default.npz")
    (folder / "g.rig.toml").write_text(
        'name="g"\nsensors=["odometry","rfid"]\n[rfid.antennas]\nleft={y=0.2,z=1.0,yaw=1.57}\n'
        '[rfid.models.default]\nkind="grid"\nfile="g.default.npz"\n'
    )


def simulation(folder: Path) -> None:
    (folder / "sim.toml").write_text(SIMULATION)


def result(folder: Path) -> None:
    """A log, and the results of a run on it."""
    fgloc.write_native(drive(2.0), folder / "log")
    fgloc.run(str(folder / "log"), "ekf", out=folder / "run")
    shutil.rmtree(folder / "run" / "plots", ignore_errors=True)


def experiment(folder: Path) -> None:
    """An experiment file without any runs."""
    fgloc.write_native(drive(2.0), folder / "log")
    (folder / "e.toml").write_text(EXPERIMENT)


def store(folder: Path) -> None:
    """An experiment and its results."""
    fgloc.write_native(drive(2.0), folder / "log")
    text = 'name = "e"\nlogs = ["log"]\nestimators = ["dead_reckoning", "ekf"]\nseeds = [0]\n'
    (folder / "e.toml").write_text(text)
    prepared = prepare(folder / "e.toml", out=folder / "out")
    run_experiment(prepared, jobs=1)
