"""The particles of a run, as viewers show them."""

from dataclasses import dataclass

from factors.se2 import Array


@dataclass(frozen=True)
class Particles:
    """``t`` (N,) [s of the log] and ``poses``: N arrays (K, 3), of equal weight, none where the estimator has no particles then.
    ``difference`` [m]: the largest between the causal positions of the run and of the one that was made again."""

    t: Array
    poses: tuple[Array, ...]
    difference: float
