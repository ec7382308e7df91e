"""Parsing of seeds: ``0:10``, ``3``."""

from factorgraph_loc.errors import InputError
from factorgraph_loc.text import quoted

MOST_SEEDS = 10_000
LARGEST_SEED = 2**63 - 1  # as in tables


def parse_seeds(text: str, source: object = "--seeds") -> range:
    """Parse ``0:10`` as the seeds 0 to 9, ``3`` as the seed 3. Raises InputError with ``source``."""
    first, colon, end = text.partition(":")
    try:
        seeds = range(int(first), int(end) if colon else int(first) + 1)
    except ValueError:
        seeds = range(0)
    if not seeds or seeds[0] < 0 or seeds[-1] > LARGEST_SEED:
        raise InputError(f"{source} is {quoted(text)}, expected a number such as 3, or a range such as 0:10")
    if seeds[-1] - seeds[0] >= MOST_SEEDS:
        raise InputError(f"{source} is {quoted(text)}, expected at most {MOST_SEEDS:,} seeds")
    return seeds
