"""What a reader of a fixed format leaves out of its files, for the metadata of the log."""

from collections.abc import Iterable
from pathlib import Path

from factorgraph_loc.files.models import read_text
from factorgraph_loc.model.log import NOT_READ
from factorgraph_loc.text import listed


def not_read(names: Iterable[str]) -> dict[str, str]:
    """The entry of the metadata; none without ``names``."""
    told = listed(names)
    return {NOT_READ: told} if told else {}


def columns_after(path: Path, count: int) -> list[str]:
    """The columns of a table with commas after the first ``count``: their names in the comment above the rows, or numbers."""
    names: list[str] = []
    for line in read_text(path).splitlines():
        if line.lstrip().startswith("#"):
            names = [name.strip(" #") for name in line.split(",")]
        elif line.strip():
            width = line.count(",") + 1
            known = names if len(names) == width else [f"column {i}" for i in range(1, width + 1)]
            return [f"{path.name}: {name}" for name in known[count:]]
    return []
