"""Strategies for damaged files: their bytes, words, cells or keys change, or something else lies in their place."""

import io
import os
import shutil
import tomllib
from pathlib import Path

import numpy as np
import polars as pl
import tomli_w
from hypothesis import strategies as st
from scipy.io import loadmat, savemat

ABSURD = r"""
nan inf -inf null None true x - # // ' " [ { } 0 -0 -1 00 +5 1. .5 1,5 1_000 0x10 1e ١٢ ½ 1e308 1e309 1e-320 1e12 -1e6 1e1000000
1e-1000000 2147483648 9223372036854775808 -9223372036854775809 1700000000 1700000000000000000 1970-01-01 12:00:00 é 日本 $$ %s {0}
2026-02-30T00:00:00Z 9999-12-31T23:59:59.999999999999Z <b> =1+1 * ? ~ . .. ../x /etc/passwd /dev/zero a/b [[]] {} 0o7 &a *a ,,
"""
LONG = ("9" * 400, "9" * 5000, "0." + "3" * 5000, "a" * 300, "c" * 100_000, "[" * 3000, "{a=" * 500 + "1" + "}" * 500)
texts = st.sampled_from([*ABSURD.split(), *LONG, "", " ", "a\x00b", "\x1b[31m", "\ufeff", "\r", "a\nb"]) | st.text(
    max_size=8
)
numbers = st.floats() | st.integers(-(2**63), 2**63 - 1) | st.sampled_from((0.0, -1.0, 1e-9, 1e6, 1e12, 5e-324))
LENGTHS = [n.to_bytes(8, "little")[:size] for n in (0, 1, 2**31 - 1, 2**62, 2**64 - 1) for size in (1, 2, 4, 8)]


def encoded(text):
    return text.encode("utf-8", "surrogateescape")


@st.composite
def of_bytes(draw, content):
    """Bytes are changed, cut out, inserted or repeated."""
    begin = draw(st.integers(0, len(content)))
    end = draw(st.integers(begin, min(begin + 4096, len(content))) | st.sampled_from((begin, len(content))))
    new = draw(
        st.binary(max_size=16) | st.sampled_from((*LENGTHS, content[begin : begin + 64] * 3)) | texts.map(encoded)
    )
    return content[:begin] + new + content[end:]


@st.composite
def of_cells(draw, content):
    """A cell, row or column of a table is replaced, removed, repeated or moved."""
    text = content.decode("utf-8", "surrogateescape")
    mark = max((" ", ",", ";", "\t"), key=text.count)
    rows = [line.split(mark) for line in text.splitlines()]
    i = draw(st.integers(0, len(rows) - 1))
    j = draw(st.integers(0, len(rows[i]) - 1))
    new = draw(texts | numbers.map(str))
    match draw(st.sampled_from(("cell", "cell", "rows", "order", "column", "no column"))):
        case "cell":
            rows[i][j] = new
        case "rows":
            rows[i : i + 1] = [rows[i]] * draw(st.sampled_from((0, 2, 500)))
        case "order":
            rows[i:] = rows[:i:-1]
        case change:
            for row in rows[1:]:
                row[j : j + 1] = [new] if change == "column" else []
    return encoded("\n".join(mark.join(row) for row in rows))


def places(tree):
    """All (container, key) of a tree of dicts and lists."""
    for key in list(tree if isinstance(tree, dict) else range(len(tree))):
        yield tree, key
        if isinstance(tree[key], (dict, list)):
            yield from places(tree[key])


@st.composite
def changed(draw, tree):
    """A key of a tree is removed or renamed, or its value replaced."""
    inside, key = draw(st.sampled_from(list(places(tree))))
    old = inside.pop(key)
    value = draw(st.sampled_from((old, True, [], {}, [old], [[old]], {"x": old}, [old] * 50)) | numbers | texts)
    if isinstance(inside, list):
        inside.insert(key, value)
    elif draw(st.integers(0, 7)):
        inside[key if draw(st.integers(0, 7)) else draw(texts)] = value
    return tree


@st.composite
def of_toml(draw, content):
    return tomli_w.dumps(draw(changed(tomllib.loads(content.decode())))).encode()


@st.composite
def of_parquet(draw, content):
    """A column is removed, renamed, replaced, or gets another type."""
    frame = pl.read_parquet(io.BytesIO(content))
    name = draw(st.sampled_from(frame.columns))
    kind = draw(st.sampled_from((pl.Int8, pl.UInt64, pl.Float32, pl.Boolean, pl.String, pl.Binary, pl.Duration("ns"))))
    column = draw(st.sampled_from((pl.lit(draw(numbers)), pl.col(name).cast(kind, strict=False), pl.concat_list(name))))
    others = (frame.drop(name), frame.clear(), frame.reverse(), frame.rename({name: draw(texts)}))
    out = io.BytesIO()
    draw(st.sampled_from((*others, *[frame.with_columns(column.alias(name))] * 4))).write_parquet(out)
    return out.getvalue()


@st.composite
def of_arrays(draw, content, read=np.load, write=lambda out, arrays: np.savez(out, **arrays)):
    """An array of a file of numpy is removed, or gets another shape, type or value."""
    arrays = {name: np.asarray(a) for name, a in read(io.BytesIO(content)).items() if not name.startswith("__")}
    name = draw(st.sampled_from(sorted(arrays)))
    old = arrays.pop(name)
    flat = old.ravel()
    parts = (old[:0], old[:1]) if old.ndim else (flat[:0], flat)
    others = (old[..., None], flat, *parts, old.T, np.array("x"), np.array([{"a": 1}], dtype=object))
    kinds = [old.astype(kind) for kind in ("f4", "i1", "c16", "U8")]
    if (
        new := draw(st.none() | st.sampled_from((*others, *kinds)) | numbers.map(lambda v: np.full(old.shape, v)))
    ) is not None:
        arrays[name] = new
    out = io.BytesIO()
    write(out, arrays)
    return out.getvalue()


def of_matlab(content):
    return of_arrays(content, loadmat, savemat)


BY_SUFFIX = {
    ".toml": (of_toml, of_toml, of_bytes),
    **dict.fromkeys((".csv", ".tum", ".kitti"), (of_cells, of_cells, of_bytes)),
    **{".parquet": (of_parquet, of_bytes), ".npz": (of_arrays, of_bytes), ".mat": (of_matlab, of_bytes)},
}
UNWRITABLE = ValueError, TypeError, OverflowError, pl.exceptions.PolarsError  # what the writers of formats raise
INSTEAD = ("missing", "folder", "pipe", "/etc/passwd", "/dev/zero", "nowhere", ".")  # the last ones are links


@st.composite
def damaged(draw, files):
    """Replacements for one or two of ``files``: bytes, or one of :data:`INSTEAD`."""
    made = {}
    for name in draw(st.lists(st.sampled_from(sorted(files)), min_size=1, max_size=2, unique=True)):
        change = draw(st.sampled_from(BY_SUFFIX.get(Path(name).suffix, (of_bytes,))))
        try:
            made[name] = draw(change(files[name])) if draw(st.integers(0, 15)) else draw(st.sampled_from(INSTEAD))
        except UNWRITABLE:
            made[name] = draw(of_bytes(files[name]))
    return made


def write(folder, files):
    """Write files into ``folder``, which is made anew."""
    shutil.rmtree(folder, ignore_errors=True)
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(content, bytes):
            path.write_bytes(content)
        elif content in ("folder", "pipe"):
            (os.mkdir if content == "folder" else os.mkfifo)(path)
        elif content != "missing":
            path.symlink_to(content)
