"""Results of the fit of each constant, with its uncertainty."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.fitting.robust import Constant, Fit, is_worth
from factors.se2 import Array


@dataclass(frozen=True)
class FittedConstant:
    """The result for one constant.

    ``gain``: improvement of the loss on held-out data [nats]; ``kept``: whether the rig takes the value ``fitted``, rather than
    keeping ``before``. ``error``: standard error of ``fitted``. ``per_log``: values fitted to each log alone, or to the halves
    of a single log. ``uncertainty``: standard deviation between logs, None where it is unknown or the rig has no field for it.
    """

    sensor: str
    name: str
    before: float
    fitted: float
    error: float
    gain: float
    kept: bool
    why: str
    per_log: tuple[float, ...]
    uncertainty: float | None

    @property
    def value(self) -> float:
        return self.fitted if self.kept else self.before


def describe(
    sensor: str,
    everything: Fit,
    pooled: Fit | None,
    alone: Sequence[Mapping[str, float]],
    gain: Array,
    logs: int,
    denied: Collection[str],
    uncertain: Collection[str],
) -> list[FittedConstant]:
    """Return the results for the constants of one sensor. ``alone``: fits to each log, or to the halves of one log;
    ``uncertain``: names of the constants that an estimator can learn during a run.
    """
    values, errors = everything.as_dict(), everything.errors_as_dict()
    kept = [] if pooled is None else [c.name for c in pooled.constants]
    if pooled is not None:
        values |= pooled.as_dict()
        errors |= pooled.errors_as_dict()
    out = []
    for c, gained in zip(everything.constants, gain, strict=True):
        parts = np.array([found[c.name] for found in alone if c.name in found])
        value = values[c.name] if c.name in kept else c.neutral
        spread = 0.0
        if len(parts) > 1:  # about their fitted mean, or about a value that was not fitted
            spread = float(np.sqrt(np.sum((parts - value) ** 2) / (len(parts) - (c.name in kept))))
        error = max(errors[c.name], spread / np.sqrt(len(parts)) if len(parts) and c.name in kept else 0.0)
        uncertainty = None
        if c.name in uncertain and logs > 1:
            uncertainty = max(spread, error) / (abs(value) if "scale" in c.name else 1.0)
        out.append(
            FittedConstant(
                sensor,
                c.name,
                before=c.neutral,
                fitted=values[c.name],
                error=error,
                gain=float(np.sum(gained)),
                kept=c.name in kept,
                why="not kept: windows in which the robot stood deny it"
                if c.name in denied
                else _why(c, values[c.name], gained),
                per_log=tuple(parts.tolist()),
                uncertainty=uncertainty,
            )
        )
    return out


def _why(constant: Constant, value: float, gain: Array) -> str:
    if not constant.is_inside(value):
        return f"not kept: the fit stopped at its bound {value:.3g}"
    if is_worth(gain):
        return "kept: it predicts data it was not fitted to better"
    return "not kept: without it, data it was not fitted to are predicted as well or better"
