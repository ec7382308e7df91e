"""The descriptions of the tables' columns: bounds that hold what is measured, and what an error says of them."""

import math

import numpy as np
import pytest

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.columns import POINTS, POSES
from factorgraph_loc.sensors.landmarks.measurement import BEARING_RANGE
from factorgraph_loc.sensors.odometry.measurement import VELOCITIES
from factorgraph_loc.sensors.tables import all_tables

COLUMNS = [
    pytest.param(column, id=f"{table.name}.{column.name}")
    for table in (*all_tables(), POSES, POINTS)
    for column in table.columns
]


@pytest.mark.parametrize("column", COLUMNS)
def test_the_first_unit_is_that_of_the_bounds(column):
    assert next(iter(column.units.values()), 1.0) == 1.0
    assert column.low < column.high
    assert column.doc


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_only_what_may_lack_may_be_no_number(value):
    with pytest.raises(InputError):
        VELOCITIES["w"].require("a.csv", [2], np.array((value,)))
    bearing = BEARING_RANGE["bearing"]
    if math.isnan(value):
        bearing.require("a.csv", [2], np.array((value,)))
    else:
        with pytest.raises(InputError, match=r"radians, not degrees, in -6.28319 to 6.28319, or nothing"):
            bearing.require("a.csv", [2], np.array((value,)))


def test_a_measured_range_is_above_zero():
    assert BEARING_RANGE["range"].measured.outside(np.array((0.0, 1e-300, 1e-3, 1e5, 2e5))).tolist() == [
        True,
        True,
        False,
        False,
        True,
    ]
