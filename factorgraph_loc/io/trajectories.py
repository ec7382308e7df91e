"""Trajectories by name, from whatever holds one: files of poses, topics of bags, results of runs, references of logs."""

from dataclasses import replace
from pathlib import Path

from factorgraph_loc.errors import InputError
from factorgraph_loc.io.bags import trajectory as bag_trajectory
from factorgraph_loc.io.bags.file import is_bag
from factorgraph_loc.io.readers import read_log
from factorgraph_loc.io.readers.pose_file import read_pose_file
from factorgraph_loc.io.results.layout import FILES
from factorgraph_loc.model.trajectory3 import PosePath, path_of

FINAL = FILES[0]
TOPIC = ":"  # between a bag and a topic
LOG = ".toml"


def read_trajectory(source: str | Path) -> PosePath:
    """The trajectory that ``source`` names.

    A file in TUM, KITTI or EuRoC format, which its first row tells; ``BAG:TOPIC`` or ``BAG:/tf:PARENT.CHILD``; the folder of a
    run, whose final trajectory it is; or a log, whose reference it is. InputError describes what is invalid in one line.
    """
    path, text = Path(source), str(source)
    if (found := _in_bag(text)) is not None:
        return replace(bag_trajectory.read_trajectory(*found), name=text)
    if path.is_file() and path.suffix != LOG:
        return read_pose_file(path)
    if (path / FINAL).is_file():
        return replace(read_pose_file(path / FINAL), name=text)
    if path.is_dir() and (runs := sorted(path.glob(f"runs/*/*/seed*/{FINAL}"))):
        raise InputError(f"{path}: holds {len(runs)} runs, expected the folder of one, such as {runs[0].parent}")
    return _reference(text)


def _in_bag(text: str) -> tuple[Path, str] | None:
    """The bag and the topic that ``text`` names, the topic empty where it is left out; None if it names no bag."""
    parts = text.split(TOPIC)
    for i in range(len(parts), 0, -1):
        path = Path(TOPIC.join(parts[:i]))
        if is_bag(path) and (i < len(parts) or path.exists()):
            return path, TOPIC.join(parts[i:])
    return None


def _reference(log: str) -> PosePath:
    found = read_log(log)
    reference = found.reference if found.reference3 is None else found.reference3
    if reference is None:
        raise InputError(f"{log}: is a log without a reference, expected one with a reference, or a trajectory")
    return path_of(reference, log, found.t0_ns)
