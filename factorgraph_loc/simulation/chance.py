"""Generators of random numbers by the names of what is drawn, so that to change one thing leaves the others as they are."""

import hashlib

import numpy as np

# the numbers of the first ones stay what they are: more may follow
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


def generator(seed: int, name: str) -> np.random.Generator:
    """The generator of what is called ``name``, from the start; one of another package's has the number of its name's hash."""
    other = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8])
    key = NAMES.index(name) if name in NAMES else other
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(key,)))
