"""Detection models: gradients, baking, interpolation."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numerical import derivative

from factors.rfid.model import BeamModel, GridModel, LogisticModel, bake, logits, probability

COEFFICIENTS = (3.9, -1.5, 0.06, -1.7, 0.25, -0.06, -0.6, -0.1, 1.9, 0.23, -0.16)


def wavy(facings: int = 5) -> GridModel:
    rng = np.random.default_rng(3)
    return GridModel(rng.normal(size=(3, facings, 12, 14)), -1.5, -2.0, 0.25, np.array((-0.5, 0.0, 0.5)))


MODELS = {
    "beam": BeamModel(),
    "logistic": LogisticModel(COEFFICIENTS),
    "grid": wavy(),
    "flat grid": bake(BeamModel(), 6.0, 0.2),
}


@pytest.mark.parametrize("name", MODELS)
@given(
    x=st.floats(-1.2, 1.2).filter(lambda v: abs(v) > 0.05),
    y=st.floats(-1.4, 1.0).filter(lambda v: abs(v) > 0.05),
    z=st.floats(-0.45, 0.45).filter(lambda v: abs(v) > 0.01),
    c=st.floats(-0.95, 0.95),
)
def test_gradient_is_that_of_the_logit(name: str, x: float, y: float, z: float, c: float) -> None:
    at = np.array((x, y, z, c))
    numeric = derivative(lambda d: logits(MODELS[name], at[:3] + d[:3], at[3] + d[3])[0][0], 4)
    found = logits(MODELS[name], at[:3], at[3])[1][0]
    # across a knot the second derivative of a grid jumps
    assert found == pytest.approx(numeric, abs=2e-4 * (1.0 + np.abs(numeric).max()))


def test_beam_is_the_formula() -> None:
    r, phi = 3.0, 0.5
    point = np.array((r * math.cos(phi), r * math.sin(phi), 0.0))
    expected = 0.9 / (1.0 + math.exp(-(4.5 - r) / 0.3)) * math.exp(-0.5 * (phi / 0.698) ** 2)
    assert probability(BeamModel(), point)[0] == pytest.approx(expected, rel=1e-5)


def test_a_certain_beam_has_finite_logits() -> None:
    value, gradient = logits(BeamModel(p0=1.0 - 1e-15), np.array(((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))))
    assert np.all(np.isfinite(value))
    assert np.all(np.isfinite(gradient))


def test_logistic_is_linear_in_its_features() -> None:
    x, y, z, c = 1.2, -0.8, -0.4, 0.6
    r, w = math.hypot(x, y), 1.0 - x / math.hypot(x, y)
    features = (1.0, r, r * r, w, w * w, r * w, abs(z), c, c * c, r * c, w * c)
    assert logits(MODELS["logistic"], np.array((x, y, z)), c)[0][0] == pytest.approx(
        np.dot(COEFFICIENTS, features), abs=1e-3
    )


def test_grid_goes_through_its_knots() -> None:
    grid = wavy()
    for h, f, i, j in ((0, 0, 0, 0), (1, 2, 5, 7), (2, 4, 11, 13)):
        point = np.array((grid.x0 + i * grid.cell, grid.y0 + j * grid.cell, grid.heights[h]))
        facing = -1.0 + 2.0 * f / 4.0
        assert logits(grid, point, facing)[0][0] == pytest.approx(grid.logits[h, f, i, j], abs=1e-9)


def test_grid_keeps_a_plane() -> None:
    """Cubic convolution is exact for what is linear (inside: at the edge knots are repeated)."""
    x, y = np.meshgrid(np.arange(8) * 0.5, np.arange(9) * 0.5, indexing="ij")
    grid = GridModel((2.0 * x - 3.0 * y)[None, None], 0.0, 0.0, 0.5, np.zeros(1))
    rng = np.random.default_rng(0)
    points = np.column_stack((rng.uniform(0.5, 3.0, (50, 2)), np.zeros(50)))
    assert logits(grid, points)[0] == pytest.approx(2.0 * points[:, 0] - 3.0 * points[:, 1], abs=1e-9)


def test_beyond_its_knots_a_grid_has_the_value_of_the_edge() -> None:
    grid = wavy(1)
    inside, outside = np.array((-1.5, 0.3, 0.0)), np.array((-9.0, 0.3, 0.0))
    value, gradient = logits(grid, np.array((inside, outside)))
    assert value[1] == pytest.approx(value[0])
    assert gradient[1, 0] == 0.0


def test_baked_model_is_near_the_model() -> None:
    rng = np.random.default_rng(1)
    for model, facings in ((BeamModel(), 1), (LogisticModel(COEFFICIENTS), 9)):
        grid = bake(model, 4.0, 0.1, heights=(-0.6, -0.3, 0.0, 0.3, 0.6), facings=facings)
        # in front of the antenna and not beside it, where the field has a peak
        points = np.column_stack((rng.uniform(0.5, 3.5, 200), rng.uniform(-3.0, 3.0, 200), rng.uniform(-0.6, 0.6, 200)))
        c = rng.uniform(-1.0, 1.0, 200)
        assert np.abs(probability(grid, points, c) - probability(model, points, c)).max() < 0.03
