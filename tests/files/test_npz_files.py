import io
import struct
import zipfile

import numpy as np
import pytest

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.npz import read_npz
from factorgraph_loc.sensors.rfid.grids import read_grid, write_grid
from factors.rfid.model import GridModel

GRID = GridModel(np.zeros((2, 3, 4, 5)), -1.0, -2.0, 0.5, np.array((0.0, 1.0)))


def member(kind: str = "<f8", shape: str = "(3,)", data: bytes = bytes(24), version: bytes = b"\x01\0") -> bytes:
    """An array as ``.npy`` with the header that is given."""
    header = f"{{'descr': {kind!r}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    length = struct.pack("<H" if version == b"\x01\0" else "<I", len(header))
    return b"\x93NUMPY" + version + length + header + data


def packed(path, members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> None:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)


def test_arrays_come_back(tmp_path):
    given = {
        "a": np.arange(12.0).reshape(3, 4),
        "b": np.asfortranarray(np.arange(12, dtype=np.int16).reshape(3, 4)),
        "c": np.array(1.5),
        "d": np.empty((0, 3)),
        "e": np.arange(3, dtype=">f4"),
    }
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", **given)
        found = read_npz(tmp_path / "a.npz", 10_000)
        assert list(found) == list(given)
        for name, values in given.items():
            np.testing.assert_array_equal(found[name], values)
            assert found[name].dtype == values.dtype


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (member(shape="(1000000, 1000000)"), "declares the shape"),
        (member(shape="(-3,)"), "declares the shape"),
        (member(shape="(3, -1, -1)"), "declares the shape"),
        (member(shape="(2,)"), "declares the shape"),
        (member(shape="(" + "(" * 150), "is not a file of arrays"),
        (member(shape="('3',)"), "is not a file of arrays"),
        (member(shape="9" * 5000), "is not a file of arrays"),
        (member(kind="|O"), "expected numbers"),
        (member(kind="<c16"), "expected numbers"),
        (member(kind="<U6"), "expected numbers"),
        (member(kind="<M8[ns]"), "expected numbers"),
        (member(kind="nonsense"), "is not a file of arrays"),
        (member(version=b"\x07\0"), "is not a file of arrays"),
        (b"\x93NUMPY\x01\0\xff\xff{", "is not a file of arrays"),
        (b"", "is not a file of arrays"),
    ],
)
def test_what_is_no_array_of_numbers_is_one_line(tmp_path, content, words):
    packed(tmp_path / "a.npz", {"a": content})
    with pytest.raises(InputError, match=words) as caught:
        read_npz(tmp_path / "a.npz", 2**20)
    assert "a.npz: " in str(caught.value)


def test_pickles_are_not_opened(tmp_path):
    np.savez(tmp_path / "a.npz", a=np.array([{}], dtype=object))
    with pytest.raises(InputError, match=r"expected numbers"):
        read_npz(tmp_path / "a.npz", 2**20)


def test_no_more_is_unpacked_than_the_limit(tmp_path):
    packed(tmp_path / "a.npz", {"a": member(shape="(10000000,)", data=bytes(80_000_000))})
    assert (tmp_path / "a.npz").stat().st_size < 200_000
    with pytest.raises(InputError, match=r"its size in bytes when unpacked is 80,000,"):
        read_npz(tmp_path / "a.npz", 2**20)
    np.savez(tmp_path / "b.npz", **{f"a{i}": np.zeros(1) for i in range(200)})
    with pytest.raises(InputError, match=r"its number of arrays is 200, expected at most 100"):
        read_npz(tmp_path / "b.npz", 2**20)


def test_a_grid_with_a_damaged_stream_or_without_its_end_is_one_line(tmp_path):
    path = tmp_path / "grid.npz"
    write_grid(GRID, path)
    whole = path.read_bytes()
    at = whole.index(b"logits.npy") + 60
    path.write_bytes(whole[:at] + b"\xff" * 8 + whole[at + 8 :])
    with pytest.raises(InputError, match=r"grid.npz: is not a file of arrays"):
        read_grid(path)
    path.write_bytes(whole[:-30])
    with pytest.raises(InputError, match=r"grid.npz: is not a file of arrays"):
        read_grid(path)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"cell": np.array(np.inf)}, "cell is inf, expected 0.001 to 1000 m"),
        ({"cell": np.array(1e-300)}, "cell is 1e-300"),
        ({"cell": np.array((1.0, 1.0))}, "cell is"),
        ({"origin": np.array((0.0, 1e308))}, "origin is"),
        ({"origin": np.array((0.0, np.nan))}, "origin is"),
        ({"heights": np.array((0.0, 1e-300))}, "heights is"),
        ({"heights": np.array((0.0, 1e300))}, "heights is"),
        ({"heights": np.zeros((2, 1))}, "heights is"),
        ({"heights": np.empty(0), "logits": np.empty((0, 3, 4, 5))}, "logits is"),
        ({"logits": np.empty((2, 0, 4, 5))}, "logits is"),
        ({"logits": np.zeros((2, 3, 4))}, "logits is"),
    ],
)
def test_a_grid_that_is_none_is_one_line(tmp_path, changed, words):
    stream = io.BytesIO()
    np.savez(
        stream,
        **{"logits": GRID.logits, "origin": np.zeros(2), "cell": np.array(0.5), "heights": GRID.heights} | changed,
    )
    (tmp_path / "grid.npz").write_bytes(stream.getvalue())
    with pytest.raises(InputError, match=f"grid.npz: {words}"):
        read_grid(tmp_path / "grid.npz")
