"""The compiled draw of ancestors against its plain twin."""

import numpy as np

from factorgraph_loc.estimators.ancestors import draw_ancestors, transition_log_density


def test_each_draw_is_the_one_that_its_uniform_number_names():
    rng = np.random.default_rng(5)
    predicted, after = rng.normal(size=(300, 3)), rng.normal(size=(40, 3))
    predicted[:, 2] *= 3.0  # headings that wrap
    log_weights = np.log(rng.dirichlet(np.ones(300)))
    root = rng.normal(size=(3, 3)) * 0.3 + np.eye(3)
    covariance, uniform = root @ root.T, rng.random(40)

    log_density = transition_log_density(predicted, after, covariance) + log_weights
    weights = np.exp(log_density - log_density.max(axis=1, keepdims=True))
    cumulative = np.cumsum(weights / weights.sum(axis=1, keepdims=True), axis=1)
    expected = [int(np.searchsorted(c, u, side="right")) for c, u in zip(cumulative, uniform, strict=True)]

    assert draw_ancestors(predicted, log_weights, after, covariance, uniform).tolist() == expected
