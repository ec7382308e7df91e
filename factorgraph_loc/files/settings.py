"""Descriptions of settings: keys, defaults, bounds, units and meanings, read from the models that define them.

The bounds of a field of a :class:`~factorgraph_loc.files.models.FileModel` come from ``Field`` in its annotation, the
unit from :class:`~factorgraph_loc.files.models.InUnit` there, and the meaning from the docstring below the field.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from factorgraph_loc.files.models import InUnit, bounds

TABLE = "table"
_KINDS = {float: "number", int: "whole number", bool: "true or false", str: "text"}


@dataclass(frozen=True)
class Setting:
    """Description of one setting.

    ``key``: path of keys, such as ``a.b``. A part ``*`` stands for a name that the user chooses.
    ``kind``: "number", "whole number", "true or false", "text", "choice" or "table", or several of them joined by "or".
    ``count``: 1 if the setting is no list, or else the length of the list; 0 if any length is valid.
    ``default``: None if there is none. ``low``, ``high``: inclusive bounds, infinite if there is none.
    ``choices``: the valid texts if ``kind`` is "choice".
    """

    key: str
    kind: str
    count: int
    default: Any
    required: bool
    low: float
    high: float
    choices: tuple[str, ...]
    unit: str
    meaning: str


@dataclass(frozen=True)
class _Part:
    """One alternative of the type annotation of a field, such as ``float`` in ``list[float] | None``.

    ``metadata``: bounds and units, as pydantic objects. ``path``: end of the key, with ".*" for each enclosing dict.
    ``count``: 1 if the type is no list, or else the length of the list; 0 if any length is valid."""

    type: Any
    metadata: tuple[Any, ...]
    path: str = ""
    count: int = 1


def settings_in(model: type[BaseModel], prefix: str = "", default: BaseModel | None = None) -> list[Setting]:
    """Return the settings of a model and of the models nested in it, in the order of their definition.

    ``prefix``: start of all keys. ``default``: a model with the default values, None for the defaults of the fields.
    """
    settings: dict[str, Setting] = {}
    for name, field in model.model_fields.items():
        key = f"{prefix}{name}"
        value = field.get_default(call_default_factory=True) if default is None else getattr(default, name)
        required = value is PydanticUndefined
        value = None if required else value
        parts = list(_parts(_Part(field.annotation, tuple(field.metadata))))
        meaning = " ".join((field.description or "").split())
        for setting in (
            *_own(key, parts, Setting(key, "", 1, value, required, -math.inf, math.inf, (), "", meaning)),
            *_nested(key, parts, value),
        ):
            known = settings.get(setting.key)
            if known is None:
                settings[setting.key] = setting
            elif known.choices and setting.choices:  # alternative models share this key
                choices = dict.fromkeys((*known.choices, *setting.choices))
                settings[setting.key] = replace(known, choices=tuple(choices))
    return list(settings.values())


def bound_text(value: float) -> str:
    """Return a bound as a text: a multiple of pi such as "2 pi", or a number with 6 digits. Infinity is ""."""
    if not math.isfinite(value):
        return ""
    for times, name in ((2.0, "2 pi"), (1.0, "pi"), (0.5, "pi / 2")):
        if math.isclose(abs(value), times * math.pi, rel_tol=1e-12):
            return name if value > 0.0 else f"-{name}"
    if 0.0 < abs(value) < 1e-300:
        return "above 0"
    return f"{value:.6g}".replace("e+0", "e").replace("e-0", "e-").replace("e+", "e")


def default_text(setting: Setting) -> str:
    """Return the default of a setting in TOML, "required" if the user must set it, or "-" if there is none."""
    return "required" if setting.required else _toml(setting.default)


def values_text(setting: Setting) -> str:
    """Return the valid values of a setting as a text, such as ``0 to 5 s``, ``known, extended, unknown`` or ``text``."""
    low, high = bound_text(setting.low), bound_text(setting.high)
    between = f"{low} to {high}" if low and high else f"{low} or more" if low else f"at most {high}" if high else ""
    bounded = f"{between} {setting.unit}".strip() or setting.kind
    if setting.kind == "whole number" and between:
        bounded = f"{between}, whole"
    text = ", ".join(setting.choices) or bounded
    return text if setting.count == 1 else f"a list of {setting.count or 'any number'}: {text}"


def first_sentence(documented: Any) -> str:
    """Return the first sentence of the docstring of an object, on one line. Return "" if it has no docstring."""
    text = " ".join((inspect.getdoc(documented) or "").split()).replace("``", "")
    return text.partition(". ")[0].rstrip(".") + "." if text else ""


def _parts(part: _Part) -> Iterator[_Part]:
    """Yield the alternatives in the type annotation ``part.type``, such as both types of a union. None is omitted."""
    origin, arguments = get_origin(part.type), get_args(part.type)
    if origin is Annotated:
        yield from _parts(replace(part, type=arguments[0], metadata=(*part.metadata, *arguments[1:])))
    elif origin in (Union, UnionType):
        for argument in arguments:
            yield from _parts(replace(part, type=argument))
    elif origin is dict:
        yield from _parts(_Part(arguments[1], (), f"{part.path}.*", part.count))
    elif origin in (tuple, list) and arguments:
        least, most = ({getattr(entry, f"{side}_length", 0) for entry in part.metadata} for side in ("min", "max"))
        any_number = max(least & most, default=0)
        count = any_number if origin is list or Ellipsis in arguments else len(arguments)
        for argument in dict.fromkeys(arguments):
            if argument is not Ellipsis:
                yield from _parts(_Part(argument, (), part.path, count))
    elif part.type is not NoneType:
        yield part


def _is_model(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _own(key: str, parts: list[_Part], setting: Setting) -> Iterator[Setting]:
    """Yield the description of the setting ``key``. A table is described only if its field has a docstring.

    ``parts``: the alternatives of its type. ``setting``: a description with key, default and meaning, to complete."""
    own = [part for part in parts if not _is_model(part.type)]
    if not own:
        if setting.meaning:
            yield replace(setting, kind=TABLE, default=None)
        return
    choices = tuple(str(a) for part in own if get_origin(part.type) is Literal for a in get_args(part.type))
    kinds = [
        "choice" if get_origin(part.type) is Literal else _KINDS.get(part.type, TABLE if part.path else "value")
        for part in own
    ]
    numbers = [part for part in own if part.type in (float, int)]
    metadata = numbers[0].metadata if numbers else ()
    low, high = bounds(metadata)
    unit = next((entry.name for entry in metadata if isinstance(entry, InUnit)), "")
    yield replace(
        setting,
        key=key + own[0].path,
        kind=" or ".join(dict.fromkeys(kinds)),
        count=own[0].count,
        low=low,
        high=high,
        choices=choices,
        unit=unit,
    )


def _nested(key: str, parts: list[_Part], value: Any) -> Iterator[Setting]:
    """Yield the settings of the models among the types ``parts`` of the field ``key``. ``value``: its default."""
    for part in parts:
        if _is_model(part.type):
            yield from settings_in(part.type, f"{key}{part.path}.", value if isinstance(value, part.type) else None)


def _toml(value: Any) -> str:
    if value is None or (isinstance(value, Mapping) and not value):
        return "-"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return bound_text(value)
    if isinstance(value, (tuple, list)):
        return f"[{', '.join(map(_toml, value))}]"
    return str(value)
