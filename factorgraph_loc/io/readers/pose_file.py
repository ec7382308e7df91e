"""Files of poses alone: TUM, KITTI and EuRoC, told apart by their first row."""

from pathlib import Path
from typing import Literal

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files import checks
from factorgraph_loc.files.models import read_text
from factorgraph_loc.io.readers import euroc, tum_rgbd
from factorgraph_loc.io.readers.space_poses import MATRIX, read_matrices, read_poses
from factorgraph_loc.model.planar import rotations_of
from factorgraph_loc.model.trajectory import read_tum_rows
from factorgraph_loc.model.trajectory3 import PosePath

Format = Literal["tum", "kitti", "euroc"]
EXPECTED = (
    "8 values (TUM: t x y z qx qy qz qw), 12 (KITTI), or 8 or more with commas (EuRoC: t, x, y, z, qw, qx, qy, qz)"
)


def read_pose_file(path: Path) -> PosePath:
    """The poses in a file of TUM, KITTI or EuRoC format. InputError names file and row."""
    row, first = _first_row(path)
    kind = _format(first)
    warnings: list[str] = []
    if kind is None:
        raise bad_field(path, "row", first, EXPECTED, row=row)
    if kind == "euroc":
        t_ns, poses = read_poses(path, euroc.STATE, unit="ns", separator=",", warnings=warnings)
        return PosePath(str(path), poses.positions, poses.rotations, t_ns, warnings=tuple(warnings))
    if kind == "kitti":
        _, matrices = read_matrices(path)
        return PosePath(str(path), matrices[:, :, 3], matrices[:, :, :3], None)
    rows, t_ns, table = read_tum_rows(path)
    rotations = rotations_of(path, rows, table[:, 3:])
    keep = checks.in_order(path, rows, t_ns, warnings)
    return PosePath(str(path), table[:, :3], rotations, t_ns, warnings=tuple(warnings)).rows(keep)


def is_pose_file(path: Path) -> bool:
    """Whether the first row of a file has numbers alone, as many as one of the formats has."""
    try:
        _, first = _first_row(path)
        return _format(first) is not None and all(map(_is_number, first.replace(",", " ").split()))
    except InputError:
        return False


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _format(first: str) -> Format | None:
    """The format of a file whose first row this is."""
    if "," in first:
        return "euroc" if first.count(",") + 1 >= len(euroc.STATE) else None
    count = len(first.split())
    return "tum" if count == len(tum_rgbd.POSES) else "kitti" if count == len(MATRIX) else None


def _first_row(path: Path) -> tuple[int, str]:
    for row, line in enumerate(read_text(path).splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            return row, line.strip()
    raise InputError(f"{path}: contains no poses, expected at least one row")
