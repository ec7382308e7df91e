"""A picture that several tests look at, and a small camera that moves over one."""

import cv2
import numpy as np
import pytest

from factorgraph_loc.sensors.camera.settings import CameraSettings

SMALL = CameraSettings(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5)


@pytest.fixture(scope="session")
def picture() -> np.ndarray:
    """Coloured blobs of several sizes, (240, 320, 3)."""
    rng = np.random.default_rng(3)
    noise = rng.normal(size=(240, 320, 3))
    layers = [cv2.GaussianBlur(noise, (0, 0), s) * s for s in (1.5, 3.0, 6.0)]
    return np.clip(128 + 45 * sum(layers), 0, 255).astype(np.uint8)


def moved_over(folder, count):
    """Files of so many images of the small camera, which moves over a picture by 4 px from one to the next."""
    rng = np.random.default_rng(1)
    blobs = cv2.GaussianBlur(rng.integers(0, 256, (120, 160 + 4 * count), dtype=np.uint8), (0, 0), 1.5)
    files = [folder / f"{k}.png" for k in range(count)]
    for k, file in enumerate(files):
        cv2.imwrite(str(file), blobs[:, 4 * k : 4 * k + 160])
    return files
