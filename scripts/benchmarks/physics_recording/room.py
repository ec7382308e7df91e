"""A furnished room, as it is drawn: textured meshes of our own, and those that come with pybullet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pybullet_data

from physics_recording import textures

WIDTH, DEPTH, HEIGHT = 11.0, 8.0, 2.8  # m


@dataclass(frozen=True)
class Day:
    """What is different from day to day: the light, and a few things that were moved or taken away.

    ``light``: direction to it; ``colour``: of it; ``ambient``, ``diffuse``: coefficients; ``tint`` of all surfaces; ``patches`` of
    sunlight on the floor; ``missing``: the poster taken from each wall; ``moved``: of some furniture [m]; ``exposure`` [s].
    """

    light: tuple[float, float, float]
    colour: tuple[float, float, float]
    ambient: float
    diffuse: float
    tint: tuple[float, float, float]
    patches: tuple[tuple[float, ...], ...]
    missing: tuple[int, int, int, int]
    moved: float
    exposure: float


DAYS = (
    Day(
        light=(2.0, 1.0, 4.0),
        colour=(1.0, 1.0, 0.97),
        ambient=0.62,
        diffuse=0.4,
        tint=(0.85, 0.85, 0.87),
        patches=((0.1, 0.1, 0.1, 0.25, 0.05), (0.6, 0.6, 0.12, 0.2, 0.05)),
        missing=(-1, -1, -1, -1),
        moved=0.0,
        exposure=0.012,
    ),
    Day(
        light=(-1.0, -2.0, 2.5),
        colour=(1.0, 0.88, 0.74),
        ambient=0.45,
        diffuse=0.5,
        tint=(0.8, 0.76, 0.7),
        patches=((0.3, 0.5, 0.15, 0.3, -0.08), (0.75, 0.1, 0.1, 0.3, -0.08)),
        missing=(2, 0, 4, 1),
        moved=0.25,
        exposure=0.024,
    ),
)


@dataclass(frozen=True)
class Room:
    """Draws the room of a ``day`` into the pybullet client ``engine``, with files in ``folder``."""

    engine: Any
    day: Day
    folder: Path

    def build(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self._shell(rng)
        self._shelves(rng)
        self._desks(rng)
        self._small(rng)

    def _shell(self, rng: np.random.Generator) -> None:
        floor = textures.lit(textures.planks(WIDTH, DEPTH, rng), self.day.patches, self.day.tint)
        self._panel(((0, 0, 0), (WIDTH, 0, 0), (WIDTH, DEPTH, 0), (0, DEPTH, 0)), floor)
        ceiling = self._shaded(textures.tiles(WIDTH, DEPTH, rng))
        self._panel(((0, DEPTH, HEIGHT), (WIDTH, DEPTH, HEIGHT), (WIDTH, 0, HEIGHT), (0, 0, HEIGHT)), ceiling)
        corners = ((0.0, 0.0), (WIDTH, 0.0), (WIDTH, DEPTH), (0.0, DEPTH))
        for i in range(4):
            (ax, ay), (bx, by) = corners[(i + 1) % 4], corners[i]
            across = float(np.hypot(bx - ax, by - ay))
            picture = textures.wall(across, HEIGHT, 7 if i % 2 == 0 else 5, self.day.missing[i], rng)
            self._panel(((ax, ay, 0), (bx, by, 0), (bx, by, HEIGHT), (ax, ay, HEIGHT)), self._shaded(picture))

    def _shelves(self, rng: np.random.Generator) -> None:
        """Along the walls: x, y of the middle, size across, deep, high, books or doors."""
        for x, y, across, deep, high, kind in (
            (2.0, 0.2, 1.6, 0.36, 2.0, "books"),
            (6.5, 0.2, 1.2, 0.4, 1.1, "doors"),
            (10.8, 2.2, 0.4, 1.5, 1.9, "books"),
            (10.75, 6.2, 0.5, 1.0, 1.4, "doors"),
            (4.0, 7.8, 1.8, 0.36, 1.8, "doors"),
            (8.2, 7.8, 1.4, 0.36, 2.1, "books"),
            (0.2, 5.0, 0.36, 1.6, 2.0, "books"),
            (0.25, 2.2, 0.46, 0.9, 0.8, "doors"),
        ):
            front = max(across, deep)
            colour = rng.uniform(70.0, 220.0, 3)
            picture = textures.books(front, high, rng) if kind == "books" else textures.doors(front, high, colour, rng)
            self._box((x, y, high / 2), (across, deep, high), self._shaded(picture))
        for x, y, side in ((0.6, 0.6, 0.5), (10.3, 0.7, 0.6), (10.2, 7.4, 0.5), (0.8, 7.3, 0.7), (5.2, 7.5, 0.4)):
            carton = textures.doors(side, side, (175.0, 140.0, 95.0), rng)
            self._box(
                (x + self.day.moved, y, side / 2), (side, side, side), self._shaded(carton), float(rng.uniform(0, 1.5))
            )

    def _desks(self, rng: np.random.Generator) -> None:
        """An island of desks with screens in the middle, and partitions."""
        for x, y in ((4.4, 4.0), (6.0, 4.0), (7.4, 4.0)):
            wood = self._shaded(textures.plain(1.3, 1.3, (160.0, 125.0, 85.0), 14.0, rng))
            self._box((x, y, 0.73), (1.3, 1.5, 0.04), wood)
            for dx in (-0.6, 0.6):
                self._box((x + dx, y, 0.36), (0.04, 1.4, 0.7), wood)
            for dy, turn in ((0.35, 0.2), (-0.35, -0.15)):
                screen = self._shaded(textures.poster(0.55, 0.34, rng))
                self._box((x + float(rng.uniform(-0.3, 0.3)), y + dy, 0.98), (0.55, 0.05, 0.36), screen, turn)
            seat = self._shaded(textures.plain(0.45, 0.45, rng.uniform(30.0, 160.0, 3), 10.0, rng))
            away = 1.0 + self.day.moved
            self._box((x + 0.1, y - away, 0.45), (0.45, 0.45, 0.08), seat, 0.3 + self.day.moved)
            self._box((x + 0.1, y - away - 0.22, 0.75), (0.42, 0.06, 0.5), seat, 0.3 + self.day.moved)
            self._box((x + 0.1, y - away, 0.22), (0.08, 0.08, 0.44), seat)
        self._box((5.2, 4.0, 0.95), (0.05, 1.6, 0.6), self._shaded(textures.poster(1.6, 0.6, rng)))
        self._box((8.2, 4.0, 0.8), (0.06, 1.6, 1.6), self._shaded(textures.poster(1.6, 1.6, rng)))

    def _small(self, rng: np.random.Generator) -> None:
        """Things that come with pybullet."""
        engine = self.engine
        engine.setAdditionalSearchPath(pybullet_data.getDataPath())
        for name, place, turn, scale in (
            ("table/table.urdf", (2.6, 7.3, 0.0), 0.0, 0.8),
            ("table_square/table_square.urdf", (9.2, 0.7, 0.0), 0.4, 0.8),
            ("r2d2.urdf", (10.4, 4.4, 0.5), 2.0, 1.0),
            ("soccerball.urdf", (1.0, 4.0 - 3.0 * self.day.moved, 0.2), 0.0, 0.4),
            ("duck_vhacd.urdf", (4.5, 4.1, 0.75), 1.0, 4.0),
            ("teddy_large.urdf", (9.2, 0.7, 0.5), 2.2, 0.04),
        ):
            angles = engine.getQuaternionFromEuler((0.0, 0.0, turn))
            engine.loadURDF(name, place, angles, useFixedBase=True, globalScaling=scale)

    def _shaded(self, picture: np.ndarray) -> np.ndarray:
        return textures.painted(picture * np.array(self.day.tint))

    def _box(self, middle: Sequence[float], size: Sequence[float], picture: np.ndarray, turn: float = 0.0) -> None:
        """A box with the picture on all sides."""
        x, y, z = np.array(size) / 2.0
        c, s = np.cos(turn), np.sin(turn)
        rotation = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
        faces = (
            ((-x, -y, -z), (x, -y, -z), (x, -y, z), (-x, -y, z)),
            ((x, -y, -z), (x, y, -z), (x, y, z), (x, -y, z)),
            ((x, y, -z), (-x, y, -z), (-x, y, z), (x, y, z)),
            ((-x, y, -z), (-x, -y, -z), (-x, -y, z), (-x, y, z)),
            ((-x, -y, z), (x, -y, z), (x, y, z), (-x, y, z)),
            ((-x, y, -z), (x, y, -z), (x, -y, -z), (-x, -y, -z)),
        )
        self._mesh([np.array(face) @ rotation.T + np.array(middle) for face in faces], picture)

    def _panel(self, corners: Sequence[Sequence[float]], picture: np.ndarray) -> None:
        self._mesh([np.array(corners, dtype=float)], picture)

    def _mesh(self, faces: Sequence[np.ndarray], picture: np.ndarray) -> None:
        """Quadrilaterals, counter-clockwise from outside, beginning at the lower left of the picture."""
        engine = self.engine
        number = len(list(self.folder.glob("*.obj")))
        lines = ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"]
        for k, face in enumerate(faces):
            normal = np.cross(face[1] - face[0], face[3] - face[0])
            normal /= np.linalg.norm(normal)
            lines += [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in face]
            lines.append("vn {:.5f} {:.5f} {:.5f}".format(*normal))
            a, b, c, d = (f"{4 * k + i}/{i}/{k + 1}" for i in (1, 2, 3, 4))
            lines += [f"f {a} {b} {c}", f"f {a} {c} {d}"]
        path = self.folder / f"{number:03d}.obj"
        path.write_text("\n".join(lines) + "\n")
        cv2.imwrite(str(path.with_suffix(".png")), picture[..., ::-1])
        shape = engine.createVisualShape(engine.GEOM_MESH, fileName=str(path))
        body = engine.createMultiBody(baseVisualShapeIndex=shape)
        texture = engine.loadTexture(str(path.with_suffix(".png")))
        engine.changeVisualShape(body, -1, textureUniqueId=texture, rgbaColor=(1, 1, 1, 1))
