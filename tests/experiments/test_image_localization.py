"""Errors of located images as figures, and a few real images."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from factorgraph_loc.experiments.image_localization import ImageErrors, evaluate_images, table, write_results
from factorgraph_loc.io.readers import load


def outcome(position, degrees):
    count = len(position)
    return ImageErrors(
        "sift", "A", "graph", range(count), np.array(position), np.radians(degrees), np.zeros((count, 3))
    )


def test_an_image_is_located_if_both_errors_are_small():
    found = outcome([0.01, 0.049, 0.051, 0.01, np.inf], [1.0, 4.9, 1.0, 5.1, np.inf])
    assert found.success == pytest.approx(0.4)


def test_the_row_of_a_table():
    cells = outcome([0.01, 0.02, 0.04], [1.0, 2.0, 3.0]).cells()
    assert cells == ["sift", "A", "graph", "100 %", "0.0200", "2.00", "0.040", "3.0"]
    assert outcome([0.01, np.inf, np.inf], [1.0, np.inf, np.inf]).cells()[4] == "inf"


def test_some_real_images(data_root, tmp_path, monkeypatch):
    """Images between those of the map: a hand's breadth of motion, so that a centimetre is asked for."""
    if not (data_root / "sevenscenes").is_dir():
        pytest.skip("the folder of recorded data has no sevenscenes")
    monkeypatch.setenv("FGLOC_CACHE", str(tmp_path / "cache"))
    (log,) = load("sevenscenes", data_root=data_root)
    stream = log.streams["camera"]
    short = type(stream)(stream.t[:50:5], stream.file[:50:5])
    few = evaluate_images(
        replace(log, streams={"camera": short}),
        ["sift"],
        600,
        range(0, 10, 2),
        {"A": range(1, 9, 2)},
    )
    for found in few.outcomes:
        assert found.success == 1.0
        assert np.median(found.position) < 0.02
        assert np.median(found.angle) < np.radians(1.0)
    assert few.maps["sift"].points > 100
    write_results("short", few, tmp_path)
    rows = pl.read_csv(tmp_path / "images.csv")
    assert rows["position_error"].to_list() == [e for one in few.outcomes for e in one.position.tolist()]
    assert [row[2] for row in table(few)[1]] == ["image by image", "graph"]
