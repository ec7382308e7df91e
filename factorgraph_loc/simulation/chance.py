"""Independent random generators by name, so that a change to one part of a simulation does not affect the others."""

import hashlib
from typing import Any

import numpy as np

# of a log; append only, as their numbers determine the sequences
NAMES = (
    "world",
    "drive",
    "odometry",
    "reads",
    "landmarks",
    "survey",
    "start",
    "strengths",
    "phases",
    "points",
    "look",
    "exposure",
)


def generator(seed: int | Any, name: str, names: tuple[str, ...] = NAMES) -> np.random.Generator:
    """A generator for ``name``, seeded by its index among ``names`` or else by its hash.

    ``seed``: a number, or the seed sequence of another generator.
    """
    other = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8])
    key = names.index(name) if name in names else other
    parent = np.random.SeedSequence(seed) if isinstance(seed, int) else seed
    return np.random.default_rng(np.random.SeedSequence(parent.entropy, spawn_key=(*parent.spawn_key, key)))
