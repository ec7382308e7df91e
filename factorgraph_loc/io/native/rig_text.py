"""A rig as text for people: each key with its meaning beside it."""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from factorgraph_loc.files.settings import Setting, settings_in
from factorgraph_loc.model.rig import Rig

_BARE = re.compile(r"[A-Za-z0-9_-]+")


def rig_text(rig: Rig, remarks: Sequence[str] = ()) -> str:
    """The content of a ``NAME.rig.toml``, with the meaning and the unit of each key as a comment; ``remarks`` come first."""
    meanings = {setting.key: setting for setting in settings_in(Rig)}
    lines = [f"# {remark}" for remark in remarks]
    lines += _lines(rig.model_dump(mode="json", exclude_none=True), (), (), meanings)
    return "\n".join(lines).lstrip("\n") + "\n"


def _lines(
    table: Mapping[str, Any], path: tuple[str, ...], pattern: tuple[str, ...], meanings: Mapping[str, Setting]
) -> Iterator[str]:
    """The lines of a table. ``pattern``: its path, with ``*`` for names of the user's own."""
    tables = {key: value for key, value in table.items() if isinstance(value, Mapping)}
    own = {key: value for key, value in table.items() if key not in tables}
    if path and (own or not tables):
        yield from ("", f"[{'.'.join(map(_key, path))}]{_comment(meanings.get('.'.join(pattern)))}")
    for key, value in own.items():
        comment = _comment(meanings.get(".".join((*pattern, key))))
        yield f"{_key(key)} = {json.dumps(value, ensure_ascii=False)}{comment}"
    for key, value in tables.items():
        known = any(name.startswith(".".join((*pattern, key))) for name in meanings)
        yield from _lines(value, (*path, key), (*pattern, key if known else "*"), meanings)


def _key(name: str) -> str:
    return name if _BARE.fullmatch(name) else json.dumps(name, ensure_ascii=False)


def _comment(setting: Setting | None) -> str:
    if setting is None or not setting.meaning:
        return ""
    return f"  # {setting.meaning}" + (f" [{setting.unit}]" if setting.unit else "")
