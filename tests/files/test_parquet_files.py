"""None"""

import io
import os
import re
import struct
import subprocess
import sys
import time
import zlib
from contextlib import nullcontext, suppress

import cv2
import numpy as np
import polars as pl
import pytest

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import tables
from factorgraph_loc.files.tables import parse_parquet, text_column
from factorgraph_loc.files.yaml import read_yaml
from factorgraph_loc.vision import images
from factorgraph_loc.vision.images import as_image, read_image


def table(rows: int = 2000) -> pl.DataFrame:
    rng = np.random.default_rng(1)
    return pl.DataFrame(
        {
            "t_ns": 10**18 + np.arange(rows) * 10**7,
            "v": rng.normal(size=rows),
            "name": [f"tag-{i % 7}" for i in range(rows)],
            "seldom": [None if i % 3 else float(i) for i in range(rows)],
            "several": [[1, 2]] * rows,
        }
    )


def content(frame: pl.DataFrame, **options) -> bytes:
    stream = io.BytesIO()
    frame.write_parquet(stream, **options)
    return stream.getvalue()


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": "gzip"},
        {"row_group_size": 100},
        {"statistics": "full"},
    ],
)
@pytest.mark.parametrize("rows", [0, 1, 2000])
def test_whole_files_pass(rows, options):
    frame = table(rows)
    assert parse_parquet(content(frame, **options), "a.parquet").equals(frame)


def test_more_rows_and_columns_than_any_log_has_are_refused(monkeypatch):
    monkeypatch.setattr(tables, "CELLS", 9_999)
    with pytest.raises(InputError, match=r"a.parquet: its number of values is 10,000, expected at most 9,999"):
        parse_parquet(content(table(2000)), "a.parquet")


def test_reading_a_small_file_with_a_huge_text_ends_a_command_with_one_line(tmp_path):
    """The limit is made small here: a file of 3 kB unpacks to 100 MB."""
    pl.DataFrame({"name": ["a" * 100_000_000]}).write_parquet(tmp_path / "a.parquet")
    code = (
        "from factorgraph_loc.files import bounded, tables\n"
        "bounded.MEMORY = 50_000_000\n"
        "bounded.limit_memory()\n"
        "tables.read_parquet(tables.Path('a.parquet'))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert re.fullmatch(r"error: a.parquet: reading it takes more than 5\d MB of memory\n", done.stderr)


def test_structures_within_structures_do_not_end():
    deep = b"\x1c" * 10_000
    with pytest.raises(InputError, match=r"a.parquet: is not a Parquet file that can be read"):
        parse_parquet(b"PAR1" + deep + len(deep).to_bytes(4, "little") + b"PAR1", "a.parquet")


def test_texts_may_be_numbers_and_categories_but_no_lists():
    frame = pl.DataFrame({"a": [1, None], "b": pl.Series(["x", "y"], dtype=pl.Categorical), "c": [None, None]})
    assert text_column(frame, "a", "log") == ["1", ""]
    assert text_column(frame, "b", "log") == ["x", "y"]
    assert text_column(frame, "c", "log") == ["", ""]
    for column in ([["a"], ["b"]], [{"a": 1}, {"a": 2}], [b"a", b"b"], [0.5, 1.5], [True, False]):
        with pytest.raises(InputError, match=r"log: x is of type .*, expected texts"):
            text_column(pl.DataFrame({"x": column}), "x", "log")


def test_a_long_text_that_is_referred_to_very_often_is_refused(monkeypatch):
    monkeypatch.setattr(tables, "DATA", tables.DATA // 100)
    whole = content(pl.DataFrame({"x": pl.Series(["a" * 100_000]).repeat_by(200).explode()}))
    assert len(whole) < 200_000
    with pytest.raises(InputError, match=r"the length of all texts of x is 20,000,000, expected at most"):
        text_column(parse_parquet(whole, "log"), "x", "log")


def png(width: int, height: int) -> bytes:
    """The head of a PNG of that size, and nothing else."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def jpeg(width: int, height: int) -> bytes:
    small = bytes(cv2.imencode(".jpg", np.zeros((16, 16, 3), dtype=np.uint8))[1])
    at = small.index(b"\xff\xc0") + 5
    return small[:at] + struct.pack(">HH", height, width) + small[at + 4 :]


IMAGES = {
    "a.png": png(60_000, 60_000),
    "e.png": png(10_000, 10_000),
    "b.jpg": jpeg(60_000, 60_000),
    "c.pgm": b"P5 60000 60000 255\n" + bytes(100),
    "d.bmp": b"BM"
    + struct.pack("<IHHIIiiHHIIiiII", 154, 0, 0, 54, 40, 60_000, 60_000, 1, 24, 0, 0, 0, 0, 0, 0)
    + bytes(100),
}


@pytest.mark.parametrize("name", IMAGES)
def test_the_size_in_a_head_is_checked_before_memory_is_taken(tmp_path, name):
    (tmp_path / name).write_bytes(IMAGES[name])
    with pytest.raises(InputError, match=rf"{name}: has too many pixels, expected at most 67,108,864"):
        read_image(tmp_path / name)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".ppm", ".bmp", ".tiff", ".webp"])
def test_the_formats_of_cameras_are_read(tmp_path, suffix):
    image = np.random.default_rng(1).integers(0, 255, (24, 40, 3)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / f"a{suffix}"), image)
    assert read_image(tmp_path / f"a{suffix}").shape == (24, 40, 3)


def test_a_part_of_a_png_that_is_longer_than_the_file_takes_no_memory(tmp_path):
    whole = bytes(cv2.imencode(".png", np.zeros((24, 40, 3), dtype=np.uint8))[1])
    at = whole.index(b"IDAT")
    (tmp_path / "a.png").write_bytes(whole[: at - 4] + struct.pack(">I", 2**30) + whole[at:])
    with pytest.raises(InputError, match=r"a.png: is not an image that can be decoded"):
        read_image(tmp_path / "a.png")


def test_sixteen_bits_become_eight():
    values = np.arange(2**16, dtype=np.uint16).reshape(256, 256)
    np.testing.assert_array_equal(as_image(values), np.round(values / 257.0).astype(np.uint8))


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_what_libraries_write_of_damaged_images_stays_unseen(suffix, capfd, monkeypatch):
    pixels = np.random.default_rng(0).integers(0, 255, (40, 60), dtype=np.uint8)
    damaged = bytearray(cv2.imencode(suffix, pixels)[1].tobytes())
    damaged[len(damaged) // 2 : len(damaged) // 2 + 40] = bytes(40)

    def written():
        with suppress(InputError):  # JPEG images decode as far as they can
            images.decoded(bytes(damaged), "a", cv2.IMREAD_UNCHANGED)
        return capfd.readouterr().err

    assert written() == ""
    os.write(2, b"seen")
    assert capfd.readouterr().err == "seen"
    monkeypatch.setattr(images, "quiet", nullcontext)
    assert written() != ""


@pytest.fixture
def read(tmp_path):
    def of(text):
        (tmp_path / "a.yaml").write_text(text)
        return read_yaml(tmp_path / "a.yaml")

    return of


def test_a_file_of_map_server(read):
    text = """# made by a map saver
image: "floor #2.pgm"
resolution: 0.05
origin: [-10.0, -5., 0]
negate: 0
mode:
"""
    assert read(text) == {"image": "floor #2.pgm", "resolution": 0.05, "origin": [-10.0, -5.0, 0], "negate": 0}


def test_an_empty_file_has_no_keys(read):
    assert read("") == read("# nothing\n") == {}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: 1\nb: [1, 2\nc: 3\n", "a.yaml:2: is not YAML that can be read: while parsing a flow sequence"),
        ("a: &x 1\nb: *x\n", "a.yaml:2: .*: [*]x is an alias, expected the value itself"),
        ("a: 1\nb: " + "[" * 1000 + "]" * 1000, "a.yaml: is not YAML that can be read: it is nested too deeply"),
        ("a: !!python/object:os.system x\n", "a.yaml:1: .*: could not determine a constructor"),
    ],
)
def test_what_is_wrong_is_one_line(read, text, said):
    with pytest.raises(InputError, match=said) as caught:
        read(text)
    assert "\n" not in str(caught.value)


def test_a_file_that_would_grow_is_refused_at_once(read):
    grown = "".join(f"{chr(98 + i)}: &{chr(98 + i)} [{', '.join([f'*{chr(97 + i)}'] * 9)}]\n" for i in range(12))
    began = time.perf_counter()
    with pytest.raises(InputError, match="is an alias"):
        read(f"a: &a [1, 1]\n{grown}")
    assert time.perf_counter() - began < 1.0
