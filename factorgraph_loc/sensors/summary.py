"""What ``fgloc info`` says of a sensor, in the form in which each sensor's package says it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Paragraph:
    """A line, and the table below it where it has a ``header``: cells (R, C) of text."""

    line: str
    header: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()


@dataclass(frozen=True)
class Summary:
    """What a log holds of one sensor.

    ``found``: what ``fgloc info --json`` lists, by its keys; ``in_map``: how many things of each layer of the map it can find;
    ``problems``: what looks wrong, as lines for people; ``text``: what is printed.
    """

    found: Mapping[str, Any] = field(default_factory=dict)
    in_map: Mapping[str, int] = field(default_factory=dict)
    problems: Sequence[str] = ()
    text: Sequence[Paragraph] = ()
