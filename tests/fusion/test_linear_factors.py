import numpy as np
import pytest

from factorgraph_loc.fusion.graph.solver import unaware
from factors.graph import constants_key, frame_motions, is_place, landmark_key, point_key, pose_key

VALUES = {
    pose_key(3): np.array((4.0, -2.0, 2.1)),
    constants_key(0): np.array((0.3, 0.2)),
    point_key(5): np.array((-1.0, 6.0, 0.8)),
    landmark_key(1): np.array((7.0, 3.0)),
}


@pytest.mark.parametrize("away", [0.0, 1e6], ids=["near the origin", "far from the origin"])
def test_a_constrained_jacobian_tells_nothing_of_the_frame_and_is_the_nearest(away):
    values = {key: value + away * (np.arange(len(value)) < 2) * is_place(key) for key, value in VALUES.items()}
    rng, (motions, _) = np.random.default_rng(0), frame_motions(values)
    jacobian = rng.normal(size=(2, len(motions)))
    nearest = unaware(jacobian, motions)
    assert np.abs(nearest @ frame_motions(VALUES)[0]).max() < 1e-8  # about a point nearby
    for _ in range(20):
        other = nearest + 0.1 * unaware(rng.normal(size=jacobian.shape), motions)
        assert np.linalg.norm(other - jacobian) > np.linalg.norm(nearest - jacobian)
