"""How often things were detected in a run, against how often they should have been."""

from collections.abc import Sequence
from dataclasses import dataclass

from factors.se2 import Array


@dataclass(frozen=True, eq=False)
class Reliability:
    """Detections of one sensor that were observed and predicted, in G groups of measurements.

    ``what``: plural of the detections; ``groups`` (G,): their names; ``observed``, ``predicted`` and ``spread`` (G,): counts, and
    the standard deviation of the observed one for a correct model, with the correlation of successive measurements. ``together``:
    number of successive measurements that are worth one independent one. ``doubts``: what does not agree, one line each.
    """

    what: str
    groups: Sequence[str]
    observed: Array
    predicted: Array
    spread: Array
    together: float
    doubts: tuple[str, ...] = ()
