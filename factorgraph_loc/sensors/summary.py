"""The parts of a sensor's summary for ``fgloc info``."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

STEP = 0.05  # s between compared times and between shifts
FARTHEST = 2.5  # s; largest shift
SHIFTS = np.arange(-round(FARTHEST / STEP), round(FARTHEST / STEP) + 1)  # in steps
LARGE = 0.15  # s; smallest shift that is reported
BETTER = 0.7  # largest ratio of the residual at a reported shift to that without a shift
FEWEST = 200  # minimum number of times and sightings
SLOWEST = 1.0  # s; longest interval between reference poses that still gives rates


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


def line(name: str, shift: float, than: str, setting: str, offset: float) -> str:
    """The message that ``name`` is stamped ``shift`` [s] later than ``than``, with the ``time_offset`` [s] that corrects it."""
    late = "later" if shift > 0.0 else "earlier"
    mends = f"{setting}.time_offset = {offset:+.2f}"
    return f"{name} is stamped about {abs(shift):.2f} s {late} than {than}: set {mends} in the rig"
