"""What is told of a robot that was carried elsewhere."""

import math

import numpy as np

from factorgraph_loc.fusion.tracking import is_known
from factorgraph_loc.model.scoring import MAX_GAP

T = 0.1 * np.arange(100)


def test_nothing_is_told_between_two_places():
    known = is_known(T, [(3.05, 5.15)])
    assert not known[(T > 3.05) & (T < 5.15)].any()
    assert known[(T < 3.05) | (T > 5.15)].all()


def test_scoring_does_not_go_across():
    told = T[is_known(T, [(3.05, 3.15), (7.0, 7.0)])]
    assert np.sum(np.diff(told) > MAX_GAP) == 2
    assert np.all(np.diff(told) < MAX_GAP + 0.2)


def test_a_place_where_the_robot_never_was_is_not_told():
    assert T[is_known(T, [(-math.inf, 2.0)])].min() == 2.0
