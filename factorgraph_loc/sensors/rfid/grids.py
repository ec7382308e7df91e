"""Files of learnt detection grids: ``.npz`` without pickles."""

import zipfile
from pathlib import Path

import numpy as np

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.bounded import GRID, foreign, opened, require_size
from factorgraph_loc.files.models import replacing
from factors.rfid.model import GridModel
from factors.se2 import Array

ARRAYS = ("logits", "origin", "cell", "heights")
FARTHEST = 1000.0  # m from the antenna
FINEST = 1e-3  # m; minimum distance of knots
LARGEST = 20.0  # of a logit; the probability is 0 or 1 to nine digits


def read_grid(path: str | Path) -> GridModel:
    """Read a grid; infinite logits are clipped. InputError names what is missing or has a wrong shape."""
    found = _read_arrays(Path(path))
    logits, origin, heights = found["logits"], found["origin"], np.atleast_1d(found["heights"])
    if logits.ndim != 4 or min(logits.shape[2:]) < 2 or min(logits.shape) < 1 or logits.shape[0] != len(heights):
        raise bad_field(path, "logits", f"an array of shape {logits.shape}", "(heights, facings, x, y)")
    cell = found["cell"]
    if origin.shape != (2,) or not np.all(np.abs(origin) <= FARTHEST):
        raise bad_field(path, "origin", origin.tolist(), f"two numbers in {-FARTHEST:g} to {FARTHEST:g} m")
    if cell.size != 1 or not FINEST <= cell.item() <= FARTHEST:
        raise bad_field(path, "cell", cell.tolist(), f"{FINEST:g} to {FARTHEST:g} m")
    if heights.ndim != 1 or not np.all(np.abs(heights) <= FARTHEST):
        raise bad_field(path, "heights", heights.tolist(), f"numbers in {-FARTHEST:g} to {FARTHEST:g} m")
    steps = np.diff(heights)
    if len(steps) and not (np.all(steps >= FINEST) and np.allclose(steps, steps[0])):
        raise bad_field(path, "heights", heights.tolist(), f"even steps upwards of {FINEST:g} m or more")
    if np.any(np.isnan(logits)):
        raise bad_field(path, "logits", "NaN", "numbers")
    bounded = np.clip(logits, -LARGEST, LARGEST)
    return GridModel(bounded, float(origin[0]), float(origin[1]), float(cell.item()), heights)


def _read_arrays(path: Path) -> dict[str, Array]:
    """The arrays of a grid by name; the unpacked size that the archive declares is checked first."""
    with opened(path, GRID) as file, foreign(path, "is not a file of arrays (.npz)"):
        with zipfile.ZipFile(file) as archive:
            require_size(path, "its size in bytes when unpacked", sum(m.file_size for m in archive.infolist()), GRID)
        file.seek(0)
        with np.load(file, allow_pickle=False) as stored:
            if missing := [name for name in ARRAYS if name not in stored]:
                raise InputError(f"{path}: {missing[0]} is missing, expected {', '.join(ARRAYS)}")
            return {name: stored[name].astype(float, casting="same_kind") for name in ARRAYS}


def write_grid(grid: GridModel, path: str | Path) -> None:
    """Write a grid atomically."""
    with replacing(Path(path)) as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file,
            logits=grid.logits,
            origin=np.array((grid.x0, grid.y0)),
            cell=np.array(grid.cell),
            heights=grid.heights,
        )
