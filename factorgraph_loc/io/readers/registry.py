"""The log formats by name: modules with a model of their ``Options``, and ``read(path, options)``, which makes the log."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import FileModel, nearest
from factorgraph_loc.model.log import Log
from factorgraph_loc.plugins import READERS
from factorgraph_loc.text import quoted


@dataclass(frozen=True)
class Reader:
    """A format: the model of its options, and ``read(path, options)``, which makes the log."""

    options: type[FileModel]
    read: Callable[[Path | None, Any], Log]


def reader(name: str) -> Reader:
    """The reader of a format; InputError with the nearest name if there is none."""
    if name not in READERS:
        raise InputError(f"there is no reader {quoted(name)}{nearest(name, list(READERS))}")
    module = READERS[name]
    return Reader(module.Options, module.read)
