"""Mechanisms of the estimators that ``scripts/baseline ablate`` can switch off. :data:`MECHANISMS` has a function for each."""

from collections.abc import Callable
from typing import Any

from factorgraph_loc.fusion import tracking
from factorgraph_loc.sensors.rfid import known_tags, monitor
from factorgraph_loc.slam import keyframe_cameras, loop_closure, moving_things, slipping, unknown_points
from factors.rfid import tag_states


def constant(owner: Any, name: str, value: Any) -> Callable[[], None]:
    """Return a function that replaces the function ``name`` of ``owner`` by one that always returns ``value``."""
    return lambda: setattr(owner, name, lambda *_, **__: value)


def attribute(owner: Any, name: str, value: Any) -> Callable[[], None]:
    """Return a function that replaces the attribute or property ``name`` of ``owner`` by one that always has ``value``."""
    return lambda: setattr(owner, name, property(lambda _: value, lambda _, __: None))


def number(owner: Any, name: str, value: float) -> Callable[[], None]:
    """Return a function that sets the constant ``name`` of ``owner`` to ``value``."""
    return lambda: setattr(owner, name, value)


def without_state(place: int) -> Callable[[], None]:
    """Return a function that sets the prior probability of one state of a tag to zero. ``place``: 0 dead, 1 weak, 2 moved."""

    def switch() -> None:
        make = tag_states.TagStates.__init__

        def made(states: tag_states.TagStates, count: int, *shares: float) -> None:
            make(states, count, *(0.0 if i == place else share for i, share in enumerate(shares)))

        tag_states.TagStates.__init__ = made  # type: ignore[method-assign]

    return switch


MECHANISMS: dict[str, Callable[[], None]] = {
    "dead_tags": without_state(0),
    "weak_tags": without_state(1),
    "moved_tags": without_state(2),
    "learnt_share": constant(tag_states, "_raised", 0.0),
    "final_tags": lambda: setattr(known_tags.KnownTags, "without_doubtful", lambda _, reads: reads),
    "bursts": attribute(monitor.BurstMonitor, "overdispersion", 1.0),
    "silence": constant(monitor.SilenceMonitor, "add", False),
    "consistency": constant(monitor.ConsistencyMonitor, "add", None),
    "dead_antennas": constant(monitor.ConsistencyMonitor, "dead_antennas", []),
    "suspicion": attribute(monitor.ScanMonitor, "suspicious_since", None),
    "confirmed": number(known_tags, "CONFIRMED", 0.0),
    "trust": constant(known_tags, "trust", 1.0),
    "slips": constant(tracking.SlipMonitor, "add", None),
    "probation": number(tracking, "PROBATION", 0.0),
    "bundle": constant(keyframe_cameras, "bundled", None),
    "moving_things": constant(moving_things.MovingThings, "_compare", None),
    "camera_slips": number(slipping, "ENOUGH", 10**9),
    "loop_closure": constant(loop_closure.LoopClosure, "is_due", False),
    "found_again": constant(unknown_points.PointViews, "refound", []),
}
