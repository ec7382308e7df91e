"""Fields of settings that contain the settings of one sensor, or the named settings of several sensors of the same kind."""

import re
from collections.abc import Mapping
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, SerializeAsAny, TypeAdapter, ValidatorFunctionWrapHandler, WrapValidator

from factorgraph_loc.files.models import known_keys, similar
from factorgraph_loc.text import listed, quoted

Model = TypeVar("Model", bound=BaseModel)


def one_or_several(kind: type[BaseModel]) -> Any:
    """Return a type annotation for a pydantic field: the settings of one sensor, {name: settings} of several, or None.

    ``kind``: class of the settings of a sensor. In TOML, field ``gps`` is a table ``[gps]``, or tables ``[gps.NAME]``.
    """
    several = TypeAdapter(dict[str, kind])  # type: ignore[valid-type]

    def parse(value: Any, parse_one: ValidatorFunctionWrapHandler) -> Any:
        if not isinstance(value, Mapping) or not value:
            return parse_one(value)
        tables = [name for name, part in value.items() if isinstance(part, Mapping | kind)]
        if own := [name for name in value if name in kind.model_fields]:
            inner = [name for name in kind.model_fields if known_keys(kind, (name,))]
            if extra := [name for name in tables if name not in own and not similar(name, inner)]:
                raise ValueError(f"has settings and named tables ({listed(extra)}), expected one of the two")
        if own or len(tables) < len(value):
            return parse_one(value)
        for name in tables:
            if not is_name(name):
                raise ValueError(f"{quoted(name)} is no name, expected letters, digits, _ and -")
        if len({name.casefold() for name in tables}) < len(tables):
            raise ValueError(f"{listed(tables)} differ only in capital letters, expected other names")
        return several.validate_python(value)

    return Annotated[kind | None, SerializeAsAny(), WrapValidator(parse)]  # type: ignore[type-arg]


def is_name(name: str) -> bool:
    """True if a text can be the name of one of several sensors: letters, digits, ``_`` and ``-``."""
    return re.fullmatch(r"[\w-]+", name) is not None


def by_name(section: str, value: Model | Mapping[str, Model] | None) -> dict[str, Model]:
    """Return the settings of one or several sensors of a kind as {section: settings}. Returns {} if ``value`` is None.

    ``value``: the settings of one sensor, or {name: settings} of several. ``section``: the section of one sensor, such
    as "gps". The sections of several sensors are "gps.NAME".
    """
    if isinstance(value, Mapping):
        return {f"{section}.{name}": model for name, model in value.items()}
    return {} if value is None else {section: value}
