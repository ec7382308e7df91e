"""Reading of foreign YAML files, such as maps and calibrations, with PyYAML.

Only a subset of YAML 1.1 is used: ``on``, ``no`` and dates remain text, and 5e-2 is a number. Tags such as ``!!opencv-matrix`` are
ignored. Aliases are rejected, because they can expand to gigabytes.
"""

import re
from pathlib import Path
from typing import Any

import yaml

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.bounded import YAML, foreign
from factorgraph_loc.files.models import read_text
from factorgraph_loc.text import quoted

DEEPEST = 20  # nesting levels of blocks
_DIRECTIVE = re.compile(r"\A(\s*)%YAML[: ][^\n]*")  # OpenCV writes %YAML:1.0, which is invalid
_INTEGER = re.compile(r"[-+]?\d+")
_NUMBER = re.compile(r"[-+]?(\.\d+|\d+\.?\d*)([eE][-+]?\d+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|Nan|NAN)")
_NOTHING = ("", "~", "null")


class _Loader(yaml.SafeLoader):
    """Composes the nodes of a file; InputError for aliases and deep nesting."""

    def __init__(self, path: Path) -> None:
        super().__init__(_DIRECTIVE.sub(r"\1", read_text(path, YAML)))
        self.path, self.depth = path, 0

    def fetch_flow_collection_start(self, TokenClass: Any) -> None:  # noqa: N803 - as PyYAML names it
        if self.flow_level == DEEPEST:  # the time that PyYAML needs grows with the square of the depth
            raise InputError(f"{self.path}:{self.line + 1}: blocks are nested more than {DEEPEST} deep")
        super().fetch_flow_collection_start(TokenClass)

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        where = f"{self.path}:{event.start_mark.line + 1}: "
        if isinstance(event, yaml.AliasEvent):
            raise InputError(f"{where}*{event.anchor} is an alias, expected the value itself")
        if self.depth == DEEPEST:
            raise InputError(f"{where}blocks are nested more than {DEEPEST} deep")
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


def read_yaml(path: Path) -> dict[str, Any]:
    """The values of a YAML file by key: texts, numbers, lists, and blocks as dicts; keys without a value are omitted.

    InputError names file and row of invalid content.
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
                raise InputError(f"{where}: a key is not text, expected key: value")
            if key.value in found:
                raise InputError(f"{where}: the key {quoted(key.value)} is duplicate")
            found[key.value] = _value(value, path)
        return found
    if isinstance(node, yaml.SequenceNode):
        return [_value(value, path) for value in node.value]
    assert isinstance(node, yaml.ScalarNode)
    return node.value if node.style is not None else _scalar(node.value)


def _scalar(text: str) -> Any:
    """An unquoted scalar: a number, None, or text."""
    if text in _NOTHING:
        return None
    if _INTEGER.fullmatch(text):
        return int(text) if len(text) < 20 else float(text)
    return float(re.sub(r"\.([iInN])", r"\1", text)) if _NUMBER.fullmatch(text) else text
