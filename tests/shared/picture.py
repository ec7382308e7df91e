"""A picture that several tests look at."""

import cv2
import numpy as np
import pytest


@pytest.fixture(scope="session")
def picture() -> np.ndarray:
    """Coloured blobs of several sizes, (240, 320, 3)."""
    rng = np.random.default_rng(3)
    noise = rng.normal(size=(240, 320, 3))
    layers = [cv2.GaussianBlur(noise, (0, 0), s) * s for s in (1.5, 3.0, 6.0)]
    return np.clip(128 + 45 * sum(layers), 0, 255).astype(np.uint8)
