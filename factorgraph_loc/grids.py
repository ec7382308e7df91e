"""Learnt detection grids on disk: ``.npz`` without pickles."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files import replacing
from factors.rfid import GridModel

LARGEST = 20.0  # of a logit: beyond it a probability is 0 or 1 to nine digits, and nothing could ever move it


def read_grid(path: str | Path) -> GridModel:
    """Read a grid; logits that are infinite (a probability of exactly 0 or 1) are taken as very large ones.

    InputError names what is missing or has a wrong shape.
    """
    try:
        with np.load(path, allow_pickle=False) as content:
            found = {name: np.asarray(content[name], dtype=float) for name in content.files}
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (ValueError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: is not a grid as calibration writes it (.npz of numbers)") from error
    for name in ("logits", "origin", "cell", "heights"):
        if name not in found:
            raise InputError(f"{path}: {name} is missing, expected logits, origin, cell, heights")
    logits, origin, heights = found["logits"], found["origin"], np.atleast_1d(found["heights"])
    if logits.ndim != 4 or min(logits.shape[2:]) < 2 or logits.shape[0] != len(heights):
        raise bad_field(path, "logits", f"an array of shape {logits.shape}", "(heights, facings, x, y)")
    if origin.shape != (2,) or found["cell"].size != 1 or not np.all(np.isfinite(origin)) or not found["cell"] > 0.0:
        raise bad_field(path, "origin, cell", "no place", "two numbers and one above 0, in metres")
    steps = np.diff(heights)
    if not np.all(np.isfinite(heights)) or (len(steps) and not (np.all(steps > 0.0) and np.allclose(steps, steps[0]))):
        raise bad_field(path, "heights", heights.tolist(), "finite, rising in even steps")
    if np.any(np.isnan(logits)):
        raise bad_field(path, "logits", "NaN", "numbers")
    bounded = np.clip(logits, -LARGEST, LARGEST)
    return GridModel(bounded, float(origin[0]), float(origin[1]), float(found["cell"].item()), heights)


def write_grid(grid: GridModel, path: str | Path) -> None:
    """Write a grid at once or not at all."""
    with replacing(Path(path)) as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file,
            logits=grid.logits,
            origin=np.array((grid.x0, grid.y0)),
            cell=np.array(grid.cell),
            heights=grid.heights,
        )
