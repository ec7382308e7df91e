"""The optional mechanisms of the estimators, and how each is switched off in a process."""

from collections.abc import Callable
from typing import Any

from factorgraph_loc.fusion import tracking
from factorgraph_loc.sensors.rfid import known_tags, monitor
from factorgraph_loc.slam import keyframe_cameras, loop_closure, moving_things, slipping, unknown_points
from factors.rfid import tag_states


def constant(owner: Any, name: str, value: Any) -> Callable[[], None]:
    """Replace a method by one that returns ``value``, whatever it is called with."""
    return lambda: setattr(owner, name, lambda *_, **__: value)


def attribute(owner: Any, name: str, value: Any) -> Callable[[], None]:
    """Replace an attribute or a property by one that is always ``value``."""
    return lambda: setattr(owner, name, property(lambda _: value, lambda _, __: None))


def number(owner: Any, name: str, value: float) -> Callable[[], None]:
    """Replace a constant."""
    return lambda: setattr(owner, name, value)


def without_state(place: int) -> Callable[[], None]:
    """Give dead, weak or moved tags no prior probability."""

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
