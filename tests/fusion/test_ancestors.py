"""The compiled draw of ancestors against its plain twin."""

import numpy as np
import pytest

from factorgraph_loc.fusion.ancestors import draw_ancestors
from factors import positive


def transition_log_density(predicted, constants, after, constants_after, covariance):
    """Log-density (M, N), up to a constant, of states ``after`` (M, 3), (M, P) given noise-free predictions (N, 3), (N, P).

    The body-frame error is taken to first order: log(p^-1 * a) is the difference, turned into the frame of p.
    """
    whitener = np.linalg.inv(positive.root(covariance))
    c, s = np.cos(predicted[:, 2]), np.sin(predicted[:, 2])
    dx = after[:, None, 0] - predicted[:, 0]
    dy = after[:, None, 1] - predicted[:, 1]
    heading = np.mod(after[:, None, 2] - predicted[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    pose = np.stack((c * dx + s * dy, c * dy - s * dx, heading), axis=-1)
    error = np.concatenate((pose, constants_after[:, None] - constants), axis=-1) @ whitener.T
    return -0.5 * np.sum(error**2, axis=-1)


@pytest.mark.parametrize("size", [0, 2])
def test_each_draw_is_the_one_that_its_uniform_number_names(size):
    rng = np.random.default_rng(5)
    predicted, after = rng.normal(size=(300, 3)), rng.normal(size=(40, 3))
    predicted[:, 2] *= 3.0  # headings that wrap
    constants, constants_after = rng.normal(size=(300, size)), rng.normal(size=(40, size))
    log_weights = np.log(rng.dirichlet(np.ones(300)))
    root = rng.normal(size=(3 + size, 3 + size)) * 0.3 + np.eye(3 + size)
    covariance, uniform = root @ root.T, rng.random(40)

    log_density = transition_log_density(predicted, constants, after, constants_after, covariance) + log_weights
    weights = np.exp(log_density - log_density.max(axis=1, keepdims=True))
    cumulative = np.cumsum(weights / weights.sum(axis=1, keepdims=True), axis=1)
    expected = [int(np.searchsorted(c, u, side="right")) for c, u in zip(cumulative, uniform, strict=True)]

    drawn = draw_ancestors(predicted, constants, log_weights, after, constants_after, covariance, uniform)
    assert drawn.tolist() == expected


def test_a_state_that_no_particle_explains_has_an_ancestor_by_the_weights():
    predicted, after = np.zeros((3, 3)), np.array(((1e200, 0.0, 0.0),) * 200)
    log_weights = np.log((0.5, 1e-9, 0.5))
    uniform = np.random.default_rng(1).random(200)
    # singular as numbers go
    covariance = np.outer((1e-3, 1e3, 1.0), (1e-3, 1e3, 1.0))
    none = np.empty((3, 0)), np.empty((200, 0))
    drawn = draw_ancestors(predicted, none[0], log_weights, after, none[1], covariance, uniform)
    assert drawn.tolist() == np.where(uniform < 0.5, 0, 2).tolist()
