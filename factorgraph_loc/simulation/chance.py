"""Generators of random numbers by the names of what is drawn, so that to change one thing leaves the others as they are."""

import hashlib
from typing import Any

import numpy as np

# of a log; the numbers of the first ones stay what they are: more may follow
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
    """The generator of what is called ``name``, from the start: that of its number among ``names``, or of its name's hash.

    ``seed``: a number, or the sequence of seeds of another generator.
    """
    other = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8])
    key = names.index(name) if name in names else other
    parent = np.random.SeedSequence(seed) if isinstance(seed, int) else seed
    return np.random.default_rng(np.random.SeedSequence(parent.entropy, spawn_key=(*parent.spawn_key, key)))
