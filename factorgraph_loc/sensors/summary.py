"""The parts of a sensor's summary for ``fgloc info``."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Paragraph:
    """A line, and a table below it if it has a ``header``: cells (R, C) of text."""

    line: str
    header: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()


@dataclass(frozen=True)
class Summary:
    """The summary of one sensor in a log.

    ``found``: entries of ``fgloc info --json``; ``in_map``: number of detectable elements by map layer; ``problems``: warnings, one
    line each; ``text``: printed paragraphs.
    """

    found: Mapping[str, Any] = field(default_factory=dict)
    in_map: Mapping[str, int] = field(default_factory=dict)
    problems: Sequence[str] = ()
    text: Sequence[Paragraph] = ()
