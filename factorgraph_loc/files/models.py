"""Base class of settings (pydantic models), parsing of TOML and JSON, and atomic writing of files."""

import difflib
import hashlib
import json
import math
import os
import re
import tomllib
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date, time
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar, get_args, get_origin

import tomli_w
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import bounded
from factorgraph_loc.files.temporary import temporary_file
from factorgraph_loc.text import LISTED, NAME, error_text, listed, plain, quoted, well_formed

LONGEST_FILE = 100  # maximum bytes of a generated file name
DEEPEST = 64  # maximum nesting levels of tables or lists, and maximum parts of a key
MOST_NAMES = 1000  # maximum number of names that are compared with a misspelt name
MOST_ENTRIES = 1_000_000  # maximum number of values in a TOML or JSON file
MOST_DIGITS = 40  # maximum number of digits of an integer in JSON; an EPC of 96 bits has 29
_PART = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(rf"(?<![\w-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{DEEPEST}}}")


class FileModel(BaseModel):
    """Base class of the models of TOML files and settings. Instances are immutable, and unknown keys are errors.

    The docstring below a field is its description in the documentation; see :mod:`factorgraph_loc.files.settings`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return a copy with the values of ``update``. Numbers are clipped to the bounds of their fields."""
        return super().model_copy(update={k: _within(type(self), k, v) for k, v in (update or {}).items()}, deep=deep)

    @classmethod
    def bounded(cls, **values: Any) -> Self:
        """Return an instance with the field values ``values``. Numbers are clipped to the bounds of their fields."""
        return cls(**{key: _within(cls, key, value) for key, value in values.items()})


@dataclass(frozen=True)
class InUnit:
    """The unit of a numeric field. It is part of the field's annotation: ``Annotated[float, InUnit("m")]``."""

    name: str


def add_fields(model: type[BaseModel], fields: Mapping[str, tuple[Any, Any]], *, after: str) -> None:
    """Add fields to the pydantic class ``model``, in place. Use this for fields that depend on the installed sensors.

    ``fields``: type and default of each new field by name. ``after``: name of the field that they follow.
    """
    old = dict(model.model_fields)
    later = list(old)[list(old).index(after) + 1 :]
    added = {name: FieldInfo.from_annotated_attribute(kind, default) for name, (kind, default) in fields.items()}
    model.model_fields.clear()
    model.model_fields.update({name: old[name] for name in old if name not in later} | added)
    model.model_fields.update({name: old[name] for name in later})
    model.model_rebuild(force=True)


Model = TypeVar("Model", bound=BaseModel)
FARTHEST = 1e7  # m; the maximum of UTM northings
Coordinate = Annotated[float, Field(ge=-FARTHEST, le=FARTHEST), InUnit("m")]


def bounds(metadata: Sequence[Any]) -> tuple[float, float]:
    """Return the inclusive lower and upper bound of a numeric field. A missing bound is -inf or inf.

    ``metadata``: the attribute ``metadata`` of a pydantic ``FieldInfo``.
    """
    low, high = -math.inf, math.inf
    for entry in metadata:
        for part in getattr(entry, "metadata", (entry,)):
            low = max(low, getattr(part, "ge", low), math.nextafter(getattr(part, "gt", -math.inf), math.inf))
            high = min(high, getattr(part, "le", high), math.nextafter(getattr(part, "lt", math.inf), -math.inf))
    return low, high


def _within(kind: type[BaseModel], name: str, value: Any) -> Any:
    """Return ``value`` clipped to the bounds of the field ``name`` of the model ``kind``. Texts and NaN are not changed."""
    field = kind.model_fields.get(name)
    if field is None or isinstance(value, bool) or not isinstance(value, (int, float)):
        return value
    low, high = bounds(field.metadata)
    return low if value < low else high if value > high else value


def read_text(path: Path, limit: int = bounded.DATA) -> str:
    """Return the content of a text file of at most ``limit`` bytes. Line ends are not converted.

    Raises InputError if the file is missing, too large, not a regular file, or not in UTF-8.
    """
    try:
        return bounded.read_bytes(path, limit).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text in UTF-8") from error


def read_toml(path: Path) -> dict[str, Any]:
    """Return the content of a TOML file.

    Raises InputError if the file cannot be read, is not TOML, or is nested deeper than :data:`DEEPEST` levels. The
    file may not contain more than :data:`MOST_ENTRIES` values, a date, or an integer of more than 64 bits.
    """
    return parse_toml(read_text(path, bounded.SETTINGS), path)


def parse_toml(text: str, source: object) -> dict[str, Any]:
    """Return the content of a TOML text. ``source``: the file or option, for errors. Raises InputError if invalid."""
    for row, line in enumerate(text.split("\n"), start=1):
        # the time that tomllib needs grows with the square of the number of parts
        if line.count(".") >= DEEPEST and _LONG_KEY.search(line):
            raise InputError(f"{plain(source)}:{row}: a key has more than {DEEPEST} parts")
    with bounded.foreign(source, "is not TOML"):
        content = tomllib.loads(text)
    check_content(content, source)
    return content


def check_content(content: dict[str, Any], source: object) -> None:
    """Raise InputError if ``content`` of the file ``source`` is nested too deeply, or has too many or invalid values.

    Invalid values are dates, integers of more than 64 bits, text that is not UTF-8, and types that TOML does not have.
    """
    for key, value in _leaves(content, source):
        if isinstance(value, int) and abs(value) >= 2**63:
            raise InputError(f"{plain(source)}: {plain(key)} is a whole number of more than 64 bits")
        if isinstance(value, date | time):
            raise InputError(f"{plain(source)}: {plain(key)} is a date or time, expected a number or quoted text")
        if not isinstance(value, str | int | float):
            raise InputError(f"{plain(source)}: {plain(key)} is {quoted(value)}, expected a number or text")
        if isinstance(value, str) and value != well_formed(value):
            raise InputError(f"{plain(source)}: {plain(key)} is {quoted(value)}, which is not text in UTF-8")


def read_json(path: Path) -> Any:
    """Return the content of a JSON file.

    Raises InputError if the file cannot be read, is not JSON, is nested deeper than :data:`DEEPEST` levels, has more
    than :data:`MOST_ENTRIES` values, or contains NaN, infinity or a duplicate key.
    """
    return parse_json(read_text(path, bounded.SETTINGS), path)


def parse_json(text: str, source: object) -> Any:
    """Return the content of a JSON text. ``source``: the file, for errors. Raises InputError if the text is invalid."""
    try:  # faster than bounded.foreign, which matters for a million lines
        content = _JSON.decode(text)
    except RecursionError as error:
        raise InputError(f"{source}: is not JSON: it is nested too deeply") from error
    except ValueError as error:
        raise InputError(f"{source}: is not JSON: {error_text(error)}") from error
    if text.count("[") + text.count("{") > DEEPEST or len(text) > MOST_ENTRIES:
        deque(_leaves(content, source), maxlen=0)
    return content


def parse_model(kind: type[Model], content: Mapping[str, Any], source: object) -> Model:
    """Return ``content``, keys and values, as an instance of the class ``kind``. ``source``: the file, for errors.

    Raises InputError at the first invalid value, with its key, the value, and what is expected.
    """
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        # a misspelt key is also reported as missing; the spelling error is more useful
        first = min(error.errors(include_url=False), key=lambda e: e["type"] != "extra_forbidden")
        key = plain(".".join(str(part) for part in first["loc"]))
        more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
        if first["type"] == "extra_forbidden":
            hint = nearest(str(first["loc"][-1]), known_keys(kind, first["loc"][:-1]))
            raise InputError(f"{source}: unknown key {key}{hint}{more}") from error
        if first["type"] == "missing":
            raise InputError(f"{source}: {key} is missing{more}") from error
        # a table is too long for the message
        if first["type"] == "value_error" and isinstance(first["input"], (Mapping, BaseModel)):
            table = f"{key}: " if key else ""
            raise InputError(f"{source}: {table}{first['ctx']['error']}{more}") from error
        expected = first["msg"][0].lower() + first["msg"][1:]
        raise InputError(f"{source}: {key} is {quoted(first['input'])}: {expected}{more}") from error


def known_keys(kind: type[BaseModel], path: tuple[int | str, ...]) -> list[str]:
    """Return the field names of a nested model, for hints on misspelt keys. Return [] if ``path`` leads to no model.

    ``kind``: the outermost model. ``path``: the keys and list indices that lead from it to the nested model.
    """
    parts = iter(path)
    for part in parts:
        if isinstance(part, int):  # index in a list of models
            continue
        field = kind.model_fields.get(str(part))
        if field is None:  # the user has given this name to a sensor
            continue
        nested = field.annotation
        if get_origin(nested) is dict:
            next(parts, None)  # the next part is a key of the dict
        options = [nested, *get_args(nested)]
        models = [o for o in options if isinstance(o, type) and issubclass(o, BaseModel)]
        if not models:
            return []
        kind = models[0]
    return list(kind.model_fields)


def nearest(word: str, known: list[str]) -> str:
    """Return the end of a message about an unknown ``word``: the most similar known word, or else all known words."""
    if matches := similar(word, known):
        return f": did you mean {plain(matches[0])}?"
    return f"; known: {listed(sorted(known), 2 * LISTED)}" if known else ""


def similar(word: str, known: list[str]) -> list[str]:
    """Return a list with the word of ``known`` that is most similar to ``word``, or an empty list."""
    short = [name for name in known if len(name) <= NAME][:MOST_NAMES]
    return difflib.get_close_matches(word, short, n=1, cutoff=0.5) if len(word) <= NAME else []


def set_key(content: dict[str, Any], key: str, value: Any, source: object) -> None:
    """Set the value at ``key``, a path such as ``a.b.c``, in the nested tables ``content``. Missing tables are created.

    Raises InputError, with the file ``source``, if a part of the path is not a table or the path is too long.
    """
    *tables, last = key.split(".")
    if len(tables) >= DEEPEST:
        raise InputError(f"{source}: {plain(key)} has {len(tables) + 1} parts, expected at most {DEEPEST}")
    for i, name in enumerate(tables, start=1):
        content = content.setdefault(name, {})
        if not isinstance(content, dict):
            table = plain(".".join(tables[:i]))
            raise InputError(f"{source}: no key {plain(key)}, because {table} is {quoted(content)}, not a table")
    content[last] = value


def flattened(content: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (path, value) for each value in the nested tables ``content``.

    A path is ``prefix`` and the keys that lead to the value, joined by dots: ``a.b.c``.
    """
    for key, value in content.items():
        if isinstance(value, Mapping):
            yield from flattened(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def inside(root: Path, name: str, source: object, *others: Path, expected: str = "a path below it") -> Path:
    """Return the absolute path that ``name`` refers to. Raises InputError if it leaves the permitted folders.

    ``name``: a path in the file ``source``. ``root`` and ``others``: the permitted folders. ``expected``: end of the
    error.

    A relative path is taken from the first of the folders that contains it, or else from ``root``. Links are resolved.
    The path need not exist. Raises InputError also if the path is neither a regular file nor a folder. Raises
    NoFileNameError if no file can have that name.
    """
    try:
        folders = [os.path.realpath(folder) for folder in (root, *others)]
        paths = [Path(os.path.realpath(folder / name)) for folder in (root, *others)]
    except (OSError, ValueError) as error:  # a NUL character, or half of a UTF-16 surrogate pair
        raise bounded.NoFileNameError(f"{source}: path {quoted(name)} cannot be the name of a file") from error
    path = next((path for path in paths if len(paths) == 1 or bounded.kind(path, source)), paths[0])
    if not any(path.is_relative_to(folder) for folder in folders):
        plain_path = Path(os.path.normpath(root.absolute() / name))
        link = f" by a link, to {quoted(str(path))}" if plain_path.is_relative_to(root.absolute()) else ""
        raise InputError(f"{source}: path {quoted(name)} leaves its folder {root}{link}, expected {expected}")
    kind = bounded.kind(path, source)
    if kind not in ("", "a file", "a folder"):
        raise InputError(f"{source}: path {quoted(name)} is {kind}, expected a regular file")
    return path


def file_name(name: str) -> str:
    """Return a name as a file name. Characters other than letters, digits, dots, dashes and underscores become
    underscores.

    Names above :data:`LONGEST_FILE` bytes are truncated and end with a hash of the whole name.
    """
    safe = re.sub(r"[^\w.-]", "_", name).lstrip(".") or "_"
    if len(safe.encode()) <= LONGEST_FILE:
        return safe
    digest = hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()[:8]
    return f"{safe.encode()[: LONGEST_FILE - 9].decode(errors='ignore')}-{digest}"


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary file next to ``path``. It is moved to ``path`` when the block ends without an error.

    An OSError in the block is raised with ``path`` as its file name.
    """
    try:
        with temporary_file(path) as temporary:
            yield temporary
            umask = os.umask(0)
            os.umask(umask)
            temporary.chmod(0o666 & ~umask)
            temporary.replace(path)
    except OSError as error:
        raise OSError(error.errno or 0, error_text(error), str(path)) from error


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file atomically. Raises OSError if that fails, for example because the disk is full."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    write_bytes(path, text.encode("utf-8", "backslashreplace"))  # file names need not be UTF-8


def write_toml(path: Path, content: Mapping[str, Any]) -> None:
    """Write a TOML file atomically."""
    write_text(path, re.sub("[\ud800-\udfff]", lambda match: f"\\{match[0]}", tomli_w.dumps(content)))


def _leaves(content: Any, source: object) -> Iterator[tuple[str, Any]]:
    """Yield (key, value) for each value in the nested tables and lists ``content``. Floats are omitted.

    Raises InputError if there are more than :data:`MOST_ENTRIES` values, or they are nested deeper than
    :data:`DEEPEST`."""
    waiting = [("", content, 0)]
    count = 0
    while waiting:
        key, value, depth = waiting.pop()
        if not isinstance(value, dict | list):
            yield key, value
        elif depth == DEEPEST:
            raise InputError(f"{source}: {plain(key)} is nested more than {DEEPEST} tables or lists deep")
        else:
            count += len(value)
            bounded.require_size(source, "the number of its values", count, MOST_ENTRIES)
            entries = value.items() if isinstance(value, dict) else ((key, entry) for entry in value)
            waiting += [(name, entry, depth + 1) for name, entry in entries if type(entry) is not float]


def _integer(digits: str) -> int:
    if len(digits) > MOST_DIGITS:
        raise ValueError(f"a number has {len(digits)} digits, expected at most {MOST_DIGITS}")
    return int(digits)


def _constant(name: str) -> float:
    raise ValueError(f"{name} is not a number in JSON")


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        twice = Counter(name for name, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"the key {quoted(twice)} is duplicate")
    return table


_JSON = json.JSONDecoder(parse_int=_integer, parse_constant=_constant, object_pairs_hook=_object)
