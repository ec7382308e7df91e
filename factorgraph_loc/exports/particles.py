"""The particles of a run, for viewers."""

from dataclasses import dataclass

from factors.se2 import Array


@dataclass(frozen=True)
class Particles:
    """``t`` (N,) [s of the log] and ``poses``: N arrays (K, 3) of equally weighted particles, empty where there are none.
    ``difference`` [m]: the largest difference between the causal positions of the stored run and of the repeated run.
    """

    t: Array
    poses: tuple[Array, ...]
    difference: float
