"""Files of detection grids: read as written, and refused in one line where they are none."""

import io

import numpy as np
import pytest

from factorgraph_loc import InputError, read_grid
from factorgraph_loc.sensors.rfid import settings as grids
from factors.rfid.model import GridModel

GRID = GridModel(np.zeros((2, 3, 4, 5)), -1.0, -2.0, 0.5, np.array((0.0, 1.0)))
ARRAYS = {"logits": GRID.logits, "origin": np.zeros(2), "cell": np.array(0.5), "heights": GRID.heights}


def test_pickles_are_not_opened(tmp_path):
    np.savez(tmp_path / "a.npz", **ARRAYS | {"cell": np.array([{}], dtype=object)})
    with pytest.raises(InputError, match=r"a.npz: is not a file of arrays .*: Object arrays cannot be loaded"):
        read_grid(tmp_path / "a.npz")


def test_no_more_is_unpacked_than_the_limit(tmp_path, monkeypatch):
    np.savez_compressed(tmp_path / "a.npz", **ARRAYS | {"logits": np.zeros((1, 1, 1000, 1000))})
    assert (tmp_path / "a.npz").stat().st_size < 20_000
    monkeypatch.setattr(grids, "GRID", 2**20)
    with pytest.raises(InputError, match=r"its size in bytes when unpacked is 8,000,\d+, expected at most 1,048,576"):
        read_grid(tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"cell": np.array(np.inf)}, "cell is inf, expected 0.001 to 1000 m"),
        ({"origin": np.array((0.0, np.nan))}, "origin is"),
        ({"heights": np.zeros((2, 1))}, "heights is"),
        ({"logits": np.empty((2, 0, 4, 5))}, "logits is"),
    ],
)
def test_a_grid_that_is_none_is_one_line(tmp_path, changed, words):
    stream = io.BytesIO()
    np.savez(
        stream,
        **ARRAYS | changed,
    )
    (tmp_path / "grid.npz").write_bytes(stream.getvalue())
    with pytest.raises(InputError, match=f"grid.npz: {words}"):
        read_grid(tmp_path / "grid.npz")
