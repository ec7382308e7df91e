"""Damaged files of each format are read, or refused in one short line."""

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest
import sound_files
from damage import damaged, write
from hypothesis import given
from hypothesis import strategies as st
from refusals import examples, require_line, taken_or_refused

import factorgraph_loc as fgloc
from factorgraph_loc.experiments.experiment import prepare
from factorgraph_loc.exports.runs import find_runs, read_runs
from factorgraph_loc.model.scoring import ALIGNMENTS
from factorgraph_loc.vision.images import read_image

pytestmark = pytest.mark.filterwarnings("ignore")


def use_log(folder, draw, path="", **options):
    """Read a log, and inspect it, write it again, or drive it."""
    for log in fgloc.load(str(folder / path), **options):
        for warning in log.warnings:
            require_line(str(warning), 600)
        assert all(math.isfinite(t) for stream in log.streams.values() for t in stream.t)
        match draw(st.sampled_from(("info", "run", "convert"))):
            case "info":
                fgloc.info(log)
            case "run":
                fgloc.run(log, "dead_reckoning")
            case "convert":
                fgloc.convert(log, folder / "made", format=draw(st.sampled_from(("csv", "parquet"))))
                fgloc.load(str(folder / "made"))


def use_images(folder, _):
    (log,) = fgloc.load(str(folder))
    for file in log.streams["camera"].file if "camera" in log.streams else ():
        if file is not None:
            read_image(Path(file))


def use_rig(folder, _):
    rig = fgloc.read_rig(folder / "g.rig.toml")
    fgloc.write_rig(rig, folder / "made.rig.toml")
    for model in rig.rfid.models.values() if rig.rfid is not None else ():
        model.model()


def use_world(folder, _):
    fgloc.write_world(fgloc.read_world(folder / "hall.world.toml"), folder / "made.world.toml")


def use_result(folder, _):
    read_runs(find_runs(folder / "run"), fgloc.read_log(folder / "log"))


def use_experiment(folder, _):
    prepare(folder / "e.toml", out=folder / "out")


def use_proposal(folder, draw):
    """Propose a manifest for tables, and read the log with it."""
    proposal = fgloc.manifest(folder / "run")
    for remark in proposal.remarks:
        require_line(remark, 600)
    (folder / "made.toml").write_text(proposal.text)
    use_log(folder, draw, path="made.toml")


def use_poses(folder, draw):
    suffix = draw(st.sampled_from((".tum", ".csv", ".kitti")))
    files = [folder / f"{name}{suffix}" for name in ("estimate", "reference")]
    found = fgloc.score(*files, align=draw(st.sampled_from(ALIGNMENTS)), max_gap=2.0)
    assert all(value is None or math.isfinite(value) for value in found.figures.values())


@dataclass(frozen=True)
class Format:
    """``make`` writes sound files, ``use`` reads them; files with other ``endings`` are left as they are."""

    make: object
    use: object
    endings: tuple[str, ...] = ("",)


use_bag = partial(use_log, reader="rosbag", options={"odometry": {"topic": "/odom"}})
BAGS = ("ros1.bag", "ros2.mcap", "ros2.db3")
FORMATS = {
    "csv": Format(sound_files.csv, use_log),
    "toml": Format(sound_files.csv, use_log, (".toml",)),
    "parquet": Format(sound_files.parquet, use_log, (".parquet",)),
    "several": Format(sound_files.several, use_log, (".csv",)),
    "pyfg": Format(sound_files.pyfg, partial(use_log, path="p.pyfg")),
    "proposal": Format(sound_files.tables, use_proposal, (".csv",)),
    "images": Format(sound_files.images, use_images, ("png", "jpg", "camera.csv", "rig.toml")),
    "grid": Format(sound_files.grid, use_rig),
    "world": Format(sound_files.world, use_world),
    "result": Format(sound_files.result, use_result, ("json", "events.csv", "run.toml", "run/estimates.parquet")),
    "experiment": Format(sound_files.experiment, use_experiment, ("e.toml",)),
    "tables": Format(sound_files.tables, partial(use_log, path="m.toml"), (".csv", "m.toml")),
    **{name: Format(sound_files.bag(name), partial(use_bag, path=name)) for name in BAGS},
    "poses": Format(sound_files.poses, use_poses),
    "plaza": Format(sound_files.plaza, partial(use_log, path="p.mat", reader="plaza", options={"run": 1})),
}


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """The sound files of a format by their paths; made once."""
    made, root = {}, tmp_path_factory.mktemp("sound")

    def files(kind):
        if kind not in made:
            FORMATS[kind].make(root / kind)
            paths = [path for path in sorted((root / kind).rglob("*")) if path.is_file()]
            made[kind] = {path.relative_to(root / kind).as_posix(): path.read_bytes() for path in paths}
        return made[kind]

    return files


@pytest.mark.parametrize("kind", FORMATS)
def test_the_sound_files_are_read(kind, sound, tmp_path):
    """Otherwise each damaged file might be refused for the same reason."""
    write(tmp_path / "case", sound(kind))
    FORMATS[kind].use(tmp_path / "case", lambda strategy: strategy.elements[-1])


@pytest.mark.parametrize("kind", FORMATS)
@examples(cost=12)
@given(data=st.data())
def test_a_damaged_file_is_read_or_refused(kind, data, sound, tmp_path_factory):
    files, folder = sound(kind), tmp_path_factory.getbasetemp() / "case"
    some = {name: content for name, content in files.items() if name.endswith(FORMATS[kind].endings)}
    write(folder, files | data.draw(damaged(some)))
    with taken_or_refused():
        FORMATS[kind].use(folder, data.draw)
