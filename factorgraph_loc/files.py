"""Reading what people write, and writing so that nothing is half-written."""

import difflib
import os
import tempfile
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

import tomli_w
from pydantic import BaseModel, ConfigDict, ValidationError

from factorgraph_loc.errors import InputError
from factorgraph_loc.text import plain, quoted


class FileModel(BaseModel):
    """Base of everything that people write in TOML: frozen, and no key that we do not know."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


Model = TypeVar("Model", bound=BaseModel)


def read_toml(path: Path) -> dict[str, Any]:
    """The content of a TOML file; InputError if it is missing or not TOML."""
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: is not TOML: {error}") from error


def read_text(path: Path) -> str:
    """The content of a text file, its line ends as they are; InputError if it is missing or not UTF-8."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            return file.read()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text in UTF-8") from error


def parse_model(kind: type[Model], content: Mapping[str, Any], source: object) -> Model:
    """``content`` as a model of ``kind``; InputError names ``source``, the key, the value and what is expected."""
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        # a misspelt key is also a missing one: the spelling is what the user can act on
        first = min(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
        key = plain(".".join(str(part) for part in first["loc"]))
        more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
        if first["type"] == "extra_forbidden":
            hint = nearest(str(first["loc"][-1]), known_keys(kind, first["loc"][:-1]))
            raise InputError(f"{source}: unknown key {key}{hint}{more}") from error
        if first["type"] == "missing":
            raise InputError(f"{source}: {key} is missing{more}") from error
        if first["type"] == "value_error" and isinstance(first["input"], (Mapping, BaseModel)):  # too much for a line
            table = f"{key}: " if key else ""
            raise InputError(f"{source}: {table}{first['ctx']['error']}{more}") from error
        expected = first["msg"][0].lower() + first["msg"][1:]
        raise InputError(f"{source}: {key} is {quoted(first['input'])}: {expected}{more}") from error


def known_keys(kind: type[BaseModel], path: tuple[int | str, ...]) -> list[str]:
    """The keys that the model below ``path`` takes; empty where that is not a model."""
    parts = iter(path)
    for part in parts:
        if isinstance(part, int):  # the place in a list of models
            continue
        field = kind.model_fields.get(str(part))
        nested = field.annotation if field is not None else None
        if get_origin(nested) is dict:
            next(parts, None)  # the key within the dict
        options = [nested, *get_args(nested)]
        models = [o for o in options if isinstance(o, type) and issubclass(o, BaseModel)]
        if not models:
            return []
        kind = models[0]
    return list(kind.model_fields)


def nearest(word: str, known: list[str]) -> str:
    """A hint for a misspelt word: the nearest known one, else all of them."""
    matches = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    if matches:
        return f": did you mean {matches[0]}?"
    return f"; known: {', '.join(sorted(known))}" if known else ""


def inside(root: Path, name: str, source: object) -> Path:
    """The path ``name`` below ``root``; InputError if it leaves ``root``, by dots, as an absolute path or by a link."""
    path = (root / name).resolve()
    if not path.is_relative_to(root.resolve()):
        raise InputError(f"{source}: path {name!r} leaves its folder {root}")
    return path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name beside ``path``; what is written to it takes the place of ``path`` when the block ends well."""
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file at once or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_toml(path: Path, content: Mapping[str, Any]) -> None:
    """Write a TOML file at once or not at all."""
    write_text(path, tomli_w.dumps(content))
