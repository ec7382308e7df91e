"""Writes proposed manifests (descriptions of logs) as TOML, with remarks on their assumptions."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomli_w

from factorgraph_loc.files.several import by_name
from factorgraph_loc.model.sections import several
from factorgraph_loc.text import plain

COMPANIONS = {
    "rig": 'no rig is given: set rig = "NAME.rig.toml" to a file next to this one; `fgloc rigs new` writes one',
    "world": 'no map is given: set world = "NAME.world.toml" to a file next to this one with tags and landmarks',
}


@dataclass(frozen=True)
class Proposal:
    """A proposed manifest, which is a TOML file that describes how to read a log.

    ``content``: its keys and values. ``text``: the manifest as TOML, with ``remarks`` as comments. ``folder``: the
    folder to save it in; paths in the manifest are relative to this folder.
    """

    content: Mapping[str, Any]
    remarks: tuple[str, ...]
    text: str
    folder: Path


def proposal_of(
    reader: str, path: Path, folder: Path, options: Mapping[str, Any], remarks: Sequence[str], *, with_map: bool = True
) -> Proposal:
    """Return a proposed manifest of the log at ``path``. A manifest is a TOML file that describes how to read a log.

    ``reader``, ``options``: the reader of the log and its options. ``remarks``: comments for the manifest. ``folder``:
    the folder to save the manifest in. If the log is not below it, the folder that contains the log is used. A rig file
    and a world file next to the log are named in the manifest. If one is missing, a remark asks for it. ``with_map``:
    False if ``options`` describe the map, so that no world file is needed.
    """
    root = folder if path.is_relative_to(folder) else path.parent
    kind = "bag" if reader == "rosbag" else "folder"
    content: dict[str, Any] = {"title": f"The {kind} {path.name}", "reader": reader}
    content["path"] = path.relative_to(root).as_posix()
    stem, notes = path.with_suffix("") if path.is_file() else path, list(remarks)
    for companion, advice in COMPANIONS.items():
        beside = sorted(path.parent.glob(f"*.{companion}.toml"))
        own = stem.with_name(f"{stem.name}.{companion}.toml")
        file = own if own in beside or len(beside) != 1 else beside[0]
        if file in beside:
            content[companion] = file.relative_to(root).as_posix()
        elif companion != "world" or with_map:
            notes.append(advice)
    ordered = dict(sorted(options.items(), key=lambda item: isinstance(item[1], dict)))  # tables last
    comments = "".join(f"# {plain(line, None)}\n" for line in notes)
    text = f"{tomli_w.dumps(content)}{comments}\n{toml_of(ordered, 'options')}"
    return Proposal(content | {"options": ordered}, tuple(notes), text, root)


def toml_of(content: Mapping[str, Any], name: str = "") -> str:
    """Return the settings ``content`` as TOML: first the values, then the tables. Tables within tables are in braces.

    With a ``name``, the settings are written as the table of that name.
    """
    content = {each: settings for key, value in content.items() for each, settings in _sensors(key, value).items()}
    tables = {key: value for key, value in content.items() if isinstance(value, dict)}
    values = [_line(key, value) for key, value in content.items() if key not in tables]
    parts = ["\n".join([f"[{name}]", *values] if name else values)] if values else []
    for key, table in tables.items():
        header = f"[{name}.{key}]" if name else f"[{key}]"
        parts.append("\n".join([header, *(_line(*entry) for entry in table.items())]))
    return "\n\n".join(parts) + "\n"


def _sensors(key: str, value: Any) -> dict[str, Any]:
    """Return ``{key: value}``, or ``{key.NAME: settings}`` if ``value`` has the settings of several sensors by name."""
    if key in several() and all(isinstance(settings, dict) for settings in value.values()):
        return by_name(key, value)
    return {key: value}


def distinct(names: Sequence[str]) -> list[str]:
    """Return short distinct names of several sensors.

    ``names``: topics or files. Words that all names contain are omitted: ``/uwb/left``, ``/uwb/right`` give ``left``,
    ``right``. If that gives an empty name or equal names, the sensors are numbered: ``sensor_1``, ``sensor_2``.
    """
    words = [re.findall(r"[^\W_]+", name) for name in names]
    common = set.intersection(*map(set, words))
    short = ["_".join(word for word in own if word not in common) for own in words]
    are_clear = all(short) and len({name.casefold() for name in short}) == len(short)
    return short if are_clear else [f"sensor_{number}" for number in range(1, len(names) + 1)]


def _line(key: str, value: Any) -> str:
    if isinstance(value, dict):
        return f"{key} = {{ {', '.join(_line(*entry) for entry in value.items())} }}"
    return tomli_w.dumps({key: value}).strip()
