"""The weights that are shipped are what is learnt."""

from pathlib import Path

import numpy as np
from weight_learning import learn_weights

from factorgraph_loc.evaluation.features.sequences import find_sequences
from factorgraph_loc.vision.weights import shipped


def test_the_shipped_weights_are_those_of_bark_and_graf(data_root: Path) -> None:
    folders = [data_root / "oxford_affine" / name for name in ("bark", "graf")]
    learnt, stored = learn_weights(find_sequences(folders)), shipped()
    assert np.allclose(learnt.mean, stored.mean, atol=1e-3)
    assert np.allclose(learnt.map, stored.map, atol=0.02 * np.abs(stored.map).max())
