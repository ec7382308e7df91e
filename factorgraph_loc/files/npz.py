"""Arrays of numbers in numpy's ``.npz`` files, without pickles; declared sizes are checked before memory is allocated."""

import io
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from factorgraph_loc.files.bounded import foreign, opened, require_size

MEMBERS = 100  # maximum number of arrays in a file
SUFFIX = ".npy"


def read_npz(path: Path, limit: int) -> dict[str, NDArray[Any]]:
    """The arrays by name, of at most ``limit`` bytes in total; InputError if the file is invalid, or contains other than
    numbers."""
    with opened(path, limit) as file, foreign(path, "is not a file of arrays (.npz)"), zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        require_size(path, "its number of arrays", len(members), MEMBERS)
        require_size(path, "its size in bytes when unpacked", sum(m.file_size for m in members), limit)
        # no more than file_size is unpacked of each member
        return {m.filename.removesuffix(SUFFIX): _array(archive.read(m)) for m in members}


def _array(content: bytes) -> NDArray[Any]:
    """The array in an ``.npy`` file; ValueError if its declared size differs from its content."""
    file = io.BytesIO(content)
    version = npy.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"an array is of version {version}, expected 1.0 or 2.0")
    read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, by_columns, kind = read_header(file)
    if kind.kind not in "fiub" or kind.itemsize > 8:
        raise ValueError(f"an array is of {kind}, expected numbers")
    start = file.tell()
    if len(shape) > 32 or any(n < 0 for n in shape) or math.prod(shape) * kind.itemsize != len(content) - start:
        raise ValueError(f"an array declares the shape {shape} and holds {len(content) - start} bytes")
    values = np.frombuffer(content, dtype=kind, offset=start)
    return values.reshape(shape, order="F" if by_columns else "C").copy()
