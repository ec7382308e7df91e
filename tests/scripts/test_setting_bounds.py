"""Settings keep to bounds: all numbers have them, what lies outside is refused in one line, what is computed stays inside."""

import math
from pathlib import Path

import pytest
from limits_tables import ESTIMATORS, FILES, OTHERS, numbers_of, tables

from factorgraph_loc import InputError, Rig
from factorgraph_loc.fusion import registry
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeSettings
from factorgraph_loc.sensors.motion import odometry_model
from factorgraph_loc.sensors.odometry.settings import (
    GrowthSettings,
    OdometryNoise,
    OdometrySettings,
    OdometryUncertainty,
)

ALL = FILES | ESTIMATORS | OTHERS


@pytest.mark.parametrize("file", list(ALL))
def test_every_number_of_settings_has_bounds(file):
    without = [number.key for number in numbers_of(ALL[file]) if not math.isfinite(number.high - number.low)]
    assert not without


def test_the_page_of_limits_is_up_to_date():
    page = (Path(__file__).parents[2] / "docs" / "limits.md").read_text()
    assert page.partition("<!-- tables -->")[2].strip() == "\n".join(tables()).strip(), (
        "scripts/limits --docs docs/limits.md"
    )


def test_uncertain_constants_beside_noise_at_its_bound_make_a_model():
    """What is added to the noise is of the model, which has no bound."""
    most = GrowthSettings(per_distance=5.0, per_rotation=5.0, per_time=5.0)
    sure = OdometryUncertainty(scale_distance=1.0, scale_rotation=1.0, heading_rate_bias=1.0, heading_drift=1.0)
    noise = OdometryNoise(along=most, lateral=most, heading=most)
    model = odometry_model(Rig(odometry=OdometrySettings(noise=noise, uncertainty=sure)), constants_as_noise=True)
    assert model.along.per_distance == pytest.approx(math.hypot(5.0, 2.0))
    assert model.heading.per_distance == pytest.approx(math.hypot(5.0, 2.0))
    assert model.heading.per_rotation == pytest.approx(math.hypot(5.0, 2.0))
    assert model.heading.per_time == pytest.approx(math.hypot(5.0, math.sqrt(8.0)))
    assert model.lateral == most.model()


@pytest.mark.parametrize("value", [1e-12, 1e12])
def test_computed_settings_are_bounded(value):
    assert GrowthSettings.bounded(per_distance=value, per_time=-value).per_time == 0.0
    assert BearingRangeSettings.bounded(range_sigma=value).range_sigma == (1e-4 if value < 1.0 else 10.0)


@pytest.mark.parametrize("name", list(registry.ESTIMATORS))
def test_settings_of_estimators_are_refused_in_one_line(name):
    for number in numbers_of(ESTIMATORS[f"settings of {name}"]):
        for value in (number.low - 1.0, number.high + 1.0):
            with pytest.raises(InputError, match=f"settings of {name}: {number.key} is ") as caught:
                registry.settings_of(name, {number.key: value if number.kind == "number" else math.floor(value)})
            assert "\n" not in str(caught.value)
