"""Images that come one after the other."""

import numpy as np
import pytest
from picture import SMALL

from factorgraph_loc.errors import InputError
from factorgraph_loc.sensors.camera.frontend import LiveFrontend
from factorgraph_loc.sensors.camera.settings import FrontendSettings

CAMERA = SMALL.model()


@pytest.mark.parametrize("feature", ["orb", "sift"])
def test_tracks_go_on_over_an_image_without_features(picture, feature):
    images = [picture[20:140, 4 * k : 4 * k + 160] for k in range(6)]
    images[3] = np.zeros_like(images[3])  # what is seen before and after it goes on over it
    live = LiveFrontend(FrontendSettings(feature=feature, count=100), CAMERA)
    frames = [live.frame(0.1 * k, image) for k, image in enumerate(images)]
    assert len(set(frames[2].tracks) & set(frames[4].tracks)) > 20
    assert [f.t for f in frames] == [0.1 * k for k in range(6)]


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((10, 10), dtype=np.uint8), "CameraImage at 2.000 s: has 10 x 10 px, expected 160 x 120"),
        ("photo.png", "CameraImage at 2.000 s: is str, expected an array of pixels"),
    ],
)
def test_what_is_no_image_of_the_camera_is_refused(image, message):
    with pytest.raises(InputError, match=message.replace(".", r"\.")):
        LiveFrontend(FrontendSettings(feature="orb"), CAMERA).frame(2.0, image)
