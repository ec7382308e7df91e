"""The weights of the 35 values: what they are learnt to do."""

from pathlib import Path

import numpy as np
import pytest
from weight_learning import SHARE, learn, learn_weights

from factorgraph_loc.evaluation.features.sequences import find_sequences
from factorgraph_loc.vision.colour_features import shipped_weights
from factorgraph_loc.vision.descriptor import OWN_SCALE, VALUES


@pytest.fixture(scope="module")
def seen_twice() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(6)
    points = rng.normal(size=(4000, VALUES))
    noise = rng.normal(size=(2, 4000, VALUES)) @ (0.3 * rng.normal(size=(VALUES, VALUES)))
    return points + noise[0], points + noise[1]


def test_differences_of_the_same_point_become_alike_in_all_directions(
    seen_twice: tuple[np.ndarray, np.ndarray],
) -> None:
    first, second = seen_twice
    weights = learn(first, second)
    used = np.delete(np.arange(VALUES), OWN_SCALE)

    def spectrum(differences: np.ndarray) -> np.ndarray:
        return np.linalg.eigvalsh(np.cov(differences[:, used].T))

    before, after = spectrum(first - second), spectrum((first - second) @ weights.map.astype(float))
    # what little is added to all variances keeps the smallest ones from becoming large
    assert before.max() / before.min() > 100.0
    share = 2.0 * SHARE * before.mean()
    expected = 2.0 * before / (before + share / 2.0)
    assert np.allclose(after, np.sort(expected), rtol=0.02)


def test_descriptors_have_length_one_and_nothing_is_nan() -> None:
    weights = shipped_weights()
    values = np.vstack([np.random.default_rng(8).normal(size=(5, VALUES)).astype(np.float32), weights.mean])
    descriptors = weights(values)
    assert descriptors.dtype == np.float32
    assert np.allclose(np.linalg.norm(descriptors, axis=1), [1, 1, 1, 1, 1, 0], atol=1e-5)


def test_the_shipped_weights_are_those_of_bark_and_graf(data_root: Path) -> None:
    folders = [data_root / "oxford_affine" / name for name in ("bark", "graf")]
    learnt, stored = learn_weights(find_sequences(folders)), shipped_weights()
    assert np.allclose(learnt.mean, stored.mean, atol=1e-3)
    assert np.allclose(learnt.map, stored.map, atol=0.02 * np.abs(stored.map).max())
