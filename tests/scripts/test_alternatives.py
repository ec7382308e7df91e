"""The benchmark of factors of RFID: each of them solves the same problem."""

import pytest
from rfid_benchmark import alternatives


def test_the_compressed_factor_is_as_near_as_the_stacked_one(monkeypatch):
    monkeypatch.setattr(alternatives, "DURATION", 8.0)
    found = alternatives.solve_all(1)
    compressed, stacked, gaussian = (one.final.position_rmse() for one in found.values())
    assert compressed == pytest.approx(stacked, rel=0.1)
    assert compressed < 0.3
    assert gaussian < 1.0
