"""Procedural textures of a furnished room: RGB images of 8 bits."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

Image = np.ndarray
DENSITY = 160  # px/m


def noise(shape: tuple[int, int], rng: np.random.Generator, sizes: Sequence[int] = (4, 12, 40, 120)) -> np.ndarray:
    """Values (H, W) of mean 0 and standard deviation 1 that vary over ``sizes`` [px]."""
    total = np.zeros(shape)
    for size in sizes:
        coarse = rng.standard_normal((shape[0] // size + 3, shape[1] // size + 3))
        total += cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
    return np.asarray((total - total.mean()) / total.std())


def plain(
    width: float, height: float, colour: Sequence[float] | np.ndarray, grain: float, rng: np.random.Generator
) -> Image:
    """A surface of one colour [m, m] with a grain of that many grey levels."""
    shape = (max(int(height * DENSITY), 8), max(int(width * DENSITY), 8))
    return painted(np.array(colour) + grain * noise(shape, rng)[..., None])


def painted(values: np.ndarray) -> Image:
    return np.asarray(np.clip(values, 0.0, 255.0).astype(np.uint8))


def planks(width: float, height: float, rng: np.random.Generator) -> Image:
    """A wooden floor."""
    picture = plain(width, height, (150.0, 115.0, 80.0), 9.0, rng)
    for top in range(0, len(picture), 22):
        left = -int(rng.integers(0, 200))
        while left < picture.shape[1]:
            right = left + int(rng.integers(120, 260))
            board = picture[top : top + 22, max(left, 0) : right].astype(float) * rng.uniform(0.75, 1.15)
            board[:1], board[:, :1] = 50.0, 50.0
            picture[top : top + 22, max(left, 0) : right] = painted(board)
            left = right
    return picture


def poster(width: float, height: float, rng: np.random.Generator) -> Image:
    """Shapes and lines of text on a coloured sheet with a frame."""
    picture = plain(width, height, rng.uniform(90.0, 250.0, 3), 4.0, rng)
    high, wide = picture.shape[:2]
    for _ in range(int(rng.integers(6, 14))):
        colour = rng.integers(0, 256, 3).tolist()
        a, b = (rng.random((2, 2)) * (wide, high)).astype(int).tolist()
        if rng.random() < 0.5:
            cv2.rectangle(picture, a, b, colour, -1 if rng.random() < 0.5 else 3)
        else:
            cv2.circle(picture, a, int(rng.uniform(0.05, 0.25) * min(high, wide)) + 2, colour, -1)
    for row in range(int(high * rng.uniform(0.3, 0.7)), high - 12, 14):
        text = "".join(rng.choice(list("abcdefghij kmnoprstuvwxyz "), wide // 10))
        cv2.putText(picture, text, (8, row), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (20, 20, 30), 1, cv2.LINE_AA)
    cv2.rectangle(picture, (0, 0), (wide - 1, high - 1), rng.integers(0, 90, 3).tolist(), 5)
    return picture


def books(width: float, height: float, rng: np.random.Generator) -> Image:
    """Shelves full of books."""
    picture = plain(width, height, (110.0, 80.0, 55.0), 5.0, rng)
    high, wide = picture.shape[:2]
    shelf = 54
    for top in range(6, high - shelf, shelf):
        left = 6
        while left < wide - 12:
            right = left + int(rng.integers(4, 13))
            if rng.random() < 0.85:
                crown = top + int(rng.integers(2, 18))
                colour = rng.integers(20, 235, 3)
                picture[crown : top + shelf - 6, left:right] = colour
                picture[crown : top + shelf - 6, right - 1] = colour // 2
                label = crown + int(rng.integers(4, 14))
                picture[label : label + 6, left + 1 : right - 1] = rng.integers(0, 256, 3)
            left = right
    return picture


def doors(width: float, height: float, colour: Sequence[float] | np.ndarray, rng: np.random.Generator) -> Image:
    """The front of a cupboard: panels, gaps, handles, scratches and labels."""
    picture = plain(width, height, colour, 5.0, rng)
    high, wide = picture.shape[:2]
    columns, rows = max(round(width / 0.5), 1), max(round(height / 0.6), 1)
    for i in range(columns):
        for j in range(rows):
            a = (i * wide // columns, j * high // rows)
            b = ((i + 1) * wide // columns - 1, (j + 1) * high // rows - 1)
            cv2.rectangle(picture, a, b, (40, 40, 40), 2)
            handle = (b[0] - 16, (a[1] + b[1]) // 2)
            cv2.rectangle(picture, handle, (handle[0] + 5, handle[1] + 22), (190, 190, 200), -1)
            if rng.random() < 0.6:
                label = poster(0.15, 0.1, rng)
                x, y = a[0] + 12 + int(rng.integers(0, 12)), a[1] + 12 + int(rng.integers(0, 12))
                room = picture[y : y + len(label), x : x + label.shape[1]]
                room[:] = label[: room.shape[0], : room.shape[1]]
    return picture


def wall(width: float, height: float, decorations: int, missing: int, rng: np.random.Generator) -> Image:
    """Plaster with posters, of which the one with the number ``missing`` was taken away; a skirting board and sockets."""
    picture = plain(width, height, (196.0, 198.0, 190.0), 6.0, rng)
    wide = picture.shape[1]
    step = wide / decorations
    for i in range(decorations):
        sheet = poster(rng.uniform(0.4, min(1.2, 0.85 * width / decorations)), rng.uniform(0.4, 1.1), rng)
        x = int(step * i + rng.uniform(0.0, 1.0) * max(step - sheet.shape[1], 1.0))
        y = int(rng.uniform(0.25, 1.0) * DENSITY)
        if i != missing:
            room = picture[y : y + len(sheet), x : x + sheet.shape[1]]
            room[:] = sheet[: room.shape[0], : room.shape[1]]
    picture[-14:] = (90, 75, 60)
    for x in rng.integers(0, wide - 20, 5).tolist():
        picture[-66:-50, x : x + 14] = (235, 235, 235)
        picture[-60:-56, x + 4 : x + 10] = (30, 30, 30)
    return picture


def tiles(width: float, height: float, rng: np.random.Generator) -> Image:
    """A suspended ceiling with lamps."""
    picture = plain(width, height, (205.0, 205.0, 200.0), 7.0, rng)
    side = int(0.6 * DENSITY)
    picture[::side], picture[:, ::side] = 120, 120
    for y in range(2 * side, len(picture) - side, 4 * side):
        for x in range(side, picture.shape[1] - 2 * side, 4 * side):
            picture[y + 4 : y + side - 4, x + 4 : x + 2 * side - 4] = 255
    return picture


def lit(picture: Image, patches: Sequence[Sequence[float]], tint: Sequence[float]) -> Image:
    """The picture with sunlight on quadrilaterals, each as x, y, width, height, slant in shares of the picture."""
    high, wide = picture.shape[:2]
    light = np.zeros((high, wide), np.float32)
    for x, y, across, along, slant in patches:
        corners = np.array(((x, y), (x + across, y), (x + across + slant, y + along), (x + slant, y + along)))
        cv2.fillPoly(light, [(corners * (wide, high)).astype(np.int32)], 1.0)
    blurred = cv2.GaussianBlur(light, (0, 0), 3.0)
    return painted(picture * (np.array(tint) + 0.6 * blurred[..., None]))
