"""The registry of readers: modules with a model of ``Options`` and a function ``read(path, options)``."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import FileModel, nearest
from factorgraph_loc.files.settings import first_sentence
from factorgraph_loc.model.log import Log
from factorgraph_loc.plugins import READERS
from factorgraph_loc.text import quoted


@dataclass(frozen=True)
class Reader:
    """A reader: the model of its options, ``read(path, options)``, which returns the log, and one sentence ``about`` its format."""

    options: type[FileModel]
    read: Callable[[Path | None, Any], Log]
    about: str


def reader(name: str) -> Reader:
    """The reader of a format; InputError with the most similar name if it is unknown."""
    if name not in READERS:
        raise InputError(f"there is no reader {quoted(name)}{nearest(name, list(READERS))}")
    module = READERS[name]
    return Reader(module.Options, module.read, first_sentence(module))
