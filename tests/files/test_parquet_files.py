import io
import re
import subprocess
import sys

import numpy as np
import polars as pl
import pytest

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import tables
from factorgraph_loc.files.tables import parse_parquet, text_column


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
