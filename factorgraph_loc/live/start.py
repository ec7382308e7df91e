"""Validation of the arguments of :class:`~factorgraph_loc.live.localizer.Localizer`."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.columns import POSES
from factorgraph_loc.files.models import FARTHEST
from factorgraph_loc.files.values import numbers, seconds_of
from factorgraph_loc.model.belief import HEADING_SIGMA, POSITION_SIGMA, PosePrior
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.interfaces import lacking_section
from factorgraph_loc.sensors.registry import sensor_of
from factorgraph_loc.text import quoted

# bounds of standard deviations in m and rad: a wider one means an unknown pose, a narrower one is implausible
NARROWEST, WIDEST, WIDEST_TURN = 1e-6, 1e4, 100.0
RATIO = 1e14  # largest ratio of eigenvalues of a covariance; a double has 16 digits


def require_options(rig: object, world: object, settings: object, history: object, seed: object) -> None:
    """InputError if an argument is invalid."""
    for name, value, kind in (
        ("rig", rig, Rig),
        ("world", world, World | None),
        ("settings", settings, Mapping | None),
    ):
        if not isinstance(value, kind):
            raise bad_field("Localizer()", name, value, f"a {getattr(kind, '__name__', kind)}")
    if isinstance(settings, Mapping) and (odd := [key for key in settings if not isinstance(key, str)]):
        raise bad_field("Localizer()", "settings", odd[0], "names of settings")
    if isinstance(history, bool) or not isinstance(history, (int, float, np.integer, np.floating)) or not history > 0.0:
        raise InputError(f"history is {quoted(history)}, expected more than 0 s")
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or not 0 <= seed < 2**128:
        raise bad_field("Localizer()", "seed", seed, "a whole number from 0 to 2^128")


def usable_sensors(rig: Rig, asked: Sequence[str] | None) -> tuple[str, ...]:
    """The usable sensors: without those whose section the rig lacks. InputError if one is unknown."""
    if asked is None:
        asked = rig.sensors
    if isinstance(asked, str) or not isinstance(asked, Sequence):
        raise bad_field("Localizer()", "sensors", asked, "names of sensors")
    for name in asked:
        sensor_of(name if isinstance(name, str) else quoted(name))
    return tuple(name for name in asked if not lacking_section(rig, name))


def prior_of(pose: ArrayLike, covariance: ArrayLike | None, t: float | None) -> PosePrior:
    """The Gaussian prior of the start; its time is NaN if ``t`` is None. InputError if an argument is invalid."""
    mean = numbers("initialize()", "pose", pose)
    known = mean[: 2 if mean.shape == (3,) and np.isnan(mean[2]) else 3] if mean.shape == (3,) else mean
    if mean.shape != (3,) or any(POSES[n].outside(v) for n, v in zip(("x", "y", "heading"), known, strict=False)):
        expected = f"finite x, y [m] and heading [rad] (may be NaN), at most {FARTHEST:g} in size"
        raise InputError(f"pose is {quoted(mean.tolist())}, expected {expected}")
    size = len(known)
    if covariance is None:
        covariance = np.diag(np.square((POSITION_SIGMA, POSITION_SIGMA, HEADING_SIGMA))[:size])
    spread = numbers("initialize()", "covariance", covariance)
    if not _is_covariance(spread, size):
        expected = (
            f"({size}, {size}), symmetric and positive definite, standard deviations of {NARROWEST:g} to {WIDEST:g} m"
        )
        turn = f" and up to {WIDEST_TURN:g} rad" if size == 3 else ""
        raise InputError(f"covariance is {quoted(spread.tolist())}, expected {expected}{turn}")
    at = math.nan if t is None else seconds_of("initialize()", t)
    return PosePrior(at, mean, spread) if size == 3 else PosePrior.at_position(at, mean[:2], spread)


def _is_covariance(spread: Any, size: int) -> bool:
    if spread.shape != (size, size) or not np.all(np.isfinite(spread)) or not np.allclose(spread, spread.T):
        return False
    if np.any(np.diag(spread) > np.square((WIDEST, WIDEST, WIDEST_TURN)[:size])):
        return False
    variances = np.linalg.eigvalsh(spread)
    return bool(variances[0] >= max(NARROWEST**2, variances[-1] / RATIO))
