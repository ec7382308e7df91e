"""Intervals of shares, against published ones."""

import pytest

from factorgraph_loc.fitting.shares import wilson


def test_wilson_agrees_with_its_published_figures():
    """Newcombe, Statistics in Medicine 17(8), 1998, table I: 81 of 263, 15 of 148, 0 of 20, 1 of 29."""
    for counts, expected in (
        ((81, 263), (0.2553, 0.3662)),
        ((15, 148), (0.0624, 0.1605)),
        ((0, 20), (0.0, 0.1611)),
        ((1, 29), (0.0061, 0.1718)),
    ):
        assert wilson(*counts) == pytest.approx(expected, abs=6e-5)
