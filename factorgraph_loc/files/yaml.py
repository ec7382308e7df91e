"""YAML files of other programs, such as maps and calibrations: keys, texts, numbers, lists and blocks, parsed by PyYAML.

What YAML 1.1 would make of plain texts besides is not wanted: ``on``, ``no`` and dates stay text, and 5e-2 is a number. A tag
such as ``!!opencv-matrix`` is passed over. Aliases are refused: a small file of them may stand for gigabytes.
"""

import re
from pathlib import Path
from typing import Any

import yaml

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.bounded import YAML, foreign
from factorgraph_loc.files.models import read_text
from factorgraph_loc.text import quoted

DEEPEST = 20  # blocks within blocks
_DIRECTIVE = re.compile(r"\A(\s*)%YAML[: ][^\n]*")  # OpenCV writes %YAML:1.0, which is none
_INTEGER = re.compile(r"[-+]?\d+")
_NUMBER = re.compile(r"[-+]?(\.\d+|\d+\.?\d*)([eE][-+]?\d+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|Nan|NAN)")
_NOTHING = ("", "~", "null")


class _Loader(yaml.SafeLoader):
    """Composes the nodes of a file; aliases and blocks that are too deep are an InputError."""

    def __init__(self, path: Path) -> None:
        super().__init__(_DIRECTIVE.sub(r"\1", read_text(path, YAML)))
        self.path, self.depth = path, 0

    def fetch_flow_collection_start(self, TokenClass: Any) -> None:  # noqa: N803 - as PyYAML names it
        if self.flow_level == DEEPEST:  # the time that PyYAML takes grows with the square of the depth
            raise InputError(f"{self.path}:{self.line + 1}: more than {DEEPEST} blocks are within each other")
        super().fetch_flow_collection_start(TokenClass)

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        where = f"{self.path}:{event.start_mark.line + 1}: "
        if isinstance(event, yaml.AliasEvent):
            raise InputError(f"{where}*{event.anchor} is an alias, expected what it stands for")
        if self.depth == DEEPEST:
            raise InputError(f"{where}more than {DEEPEST} blocks are within each other")
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


def read_yaml(path: Path) -> dict[str, Any]:
    """The values of a YAML file by key: texts, numbers, lists, and blocks as dicts; keys without a value are left out.

    InputError names file and row of what is not YAML.
    """
    with foreign(path, "is not YAML that can be read"):
        try:
            node = _Loader(path).get_single_node()
        except yaml.MarkedYAMLError as error:
            mark = error.context_mark or error.problem_mark
            what = ", ".join(part for part in (error.context, error.problem) if part)
            raise InputError(f"{path}:{mark.line + 1 if mark else 1}: is not YAML that can be read: {what}") from error
    if node is None:
        return {}
    if not isinstance(node, yaml.MappingNode):
        raise InputError(f"{path}:{node.start_mark.line + 1}: is not YAML that can be read: expected key: value")
    return {key: value for key, value in _value(node, path).items() if value is not None}


def _value(node: yaml.Node, path: Path) -> Any:
    if isinstance(node, yaml.MappingNode):
        found: dict[str, Any] = {}
        for key, value in node.value:
            where = f"{path}:{key.start_mark.line + 1}"
            if not isinstance(key, yaml.ScalarNode):
                raise InputError(f"{where}: a key is no text, expected key: value")
            if key.value in found:
                raise InputError(f"{where}: the key {quoted(key.value)} is there twice")
            found[key.value] = _value(value, path)
        return found
    if isinstance(node, yaml.SequenceNode):
        return [_value(value, path) for value in node.value]
    assert isinstance(node, yaml.ScalarNode)
    return node.value if node.style is not None else _scalar(node.value)


def _scalar(text: str) -> Any:
    """What is written without quotes: a number where it is one, nothing, else text."""
    if text in _NOTHING:
        return None
    if _INTEGER.fullmatch(text):
        return int(text) if len(text) < 20 else float(text)
    return float(re.sub(r"\.([iInN])", r"\1", text)) if _NUMBER.fullmatch(text) else text
