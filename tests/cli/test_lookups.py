"""What there is to choose from, and its settings."""

import json

import pytest

from factorgraph_loc.fusion.registry import settings_of
from factorgraph_loc.plugins import ESTIMATORS


def test_the_list_names_all_estimators(fgloc):
    found = json.loads(fgloc("estimators", "--json").stdout)
    assert [one["name"] for one in found] == list(ESTIMATORS)
    assert all(one["about"].endswith(".") for one in found)
    printed = fgloc("estimators")
    assert printed.exit_code == 0
    assert all(one["about"] in printed.stdout for one in found)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_every_setting_of_an_estimator_is_told(fgloc, name):
    found = json.loads(fgloc("estimators", name, "--json").stdout)
    defaults = settings_of(name, {}).model_dump(mode="json")
    assert {one["key"]: one["default"] for one in found["settings"]} == defaults
    assert all(one["meaning"] for one in found["settings"])
    printed = fgloc("estimators", name)
    assert all(one["meaning"] in printed.stdout for one in found["settings"])


def test_a_bad_name_is_told_with_the_nearest(fgloc):
    done = fgloc("estimators", "smother")
    assert done.exit_code == 2
    assert done.stderr == "error: no estimator is called 'smother': did you mean smoother?\n"
    assert "known: batch, dead_reckoning, ekf" in fgloc("estimators", "zzz").stderr
