"""Random textures of a simulated building: walls, furniture, floor and ceiling. ``texel`` [m] is the size of a texel."""

import cv2
import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.simulation import pictures
from factorgraph_loc.simulation.pictures import Canvas, Draw

# objects on walls: function that draws the object, probability, ranges of width, of height, and of the height of the centre [m]
HANGING: tuple[tuple[Draw, float, tuple[float, float], tuple[float, float], tuple[float, float]], ...] = (
    (pictures.poster, 0.28, (0.4, 0.9), (0.5, 1.1), (1.2, 1.7)),
    (pictures.painting, 0.2, (0.4, 1.2), (0.35, 0.9), (1.2, 1.8)),
    (pictures.page, 0.14, (0.21, 0.42), (0.3, 0.42), (1.0, 1.8)),
    (pictures.board, 0.12, (0.8, 1.6), (0.6, 1.1), (1.2, 1.6)),
    (pictures.whiteboard, 0.08, (1.0, 1.8), (0.8, 1.1), (1.3, 1.5)),
    (pictures.books, 0.08, (0.8, 1.6), (1.0, 1.9), (1.0, 1.3)),
    (pictures.sign, 0.06, (0.2, 0.4), (0.1, 0.25), (1.4, 2.3)),
    (pictures.extinguisher, 0.04, (0.22, 0.25), (0.5, 0.6), (0.7, 0.9)),
)
GAP = (0.05, 0.35)  # m between adjacent objects
SKIRTING = 0.1  # m: height of the skirting board
SMALL = (0.03, 0.12)  # m: range of the sizes of sockets, switches, stickers and stains
TILE = 0.6  # m: size of the tiles of floor and ceiling


def wall(rng: np.random.Generator, height: int, width: int, texel: float, *, windows: bool) -> Canvas:
    """Return the texture of a painted wall with objects, most of them at eye level. ``height``, ``width``: the size in
    texels (pixels of a texture). ``texel`` [m]: the size of a texel. ``windows``: True if some objects are windows."""
    out = _painted(rng, height, width, texel)
    tall = height * texel
    x = rng.uniform(*GAP)
    shares = np.array([chance for _, chance, *_ in HANGING])
    while x < width * texel - 0.25:
        draw, _, wide, high, middle = HANGING[int(rng.choice(len(HANGING), p=shares / shares.sum()))]
        if windows and rng.random() < 0.35:
            draw, wide, high, middle = pictures.window, (1.0, 2.2), (1.1, 1.4), (1.5, 1.6)
        w, h = min(rng.uniform(*wide), width * texel - x - 0.05), rng.uniform(*high)
        top = tall - rng.uniform(*middle) - h / 2.0
        picture = draw(rng, max(round(h / texel), 16), max(round(w / texel), 16))
        _paste_with_shadow(out, picture, round(x / texel), round(max(top, 0.05) / texel))
        x += w + rng.uniform(*GAP)
    _draw_low_furniture(out, rng, texel)
    _draw_fixtures(out, rng, texel)
    out[height - round(SKIRTING / texel) :] = pictures.wood(rng)
    return _lighted(out, rng, texel)


def lintel(rng: np.random.Generator, height: int, width: int, texel: float) -> Canvas:
    """Return the texture of the wall above a door, with a plate and the upper edge of the door frame. ``height``,
    ``width``: in texels (pixels of a texture). ``texel`` [m]: their size."""
    out = _painted(rng, height, width, texel)
    plate = pictures.sign(rng, max(height // 3, 8), max(width // 2, 16))
    _paste_with_shadow(out, plate, width // 4, height // 3)
    out[height - round(0.06 / texel) :] = pictures.wood(rng)
    return _lighted(out, rng, texel)


def furniture(rng: np.random.Generator, height: int, width: int) -> Canvas:
    """Return the texture (height, width, 3) of one side of a cupboard or book shelf."""
    draw = pictures.books if rng.random() < 0.5 else pictures.cupboard
    return draw(rng, height, width)


def floor(rng: np.random.Generator, height: int, width: int, texel: float) -> Canvas:
    """Return the texture (height, width, 3) of a floor: carpet tiles of a few shades, with threads and stains.
    ``texel`` [m]: the size of a pixel of the texture."""
    shade = np.array(_dull(rng))
    shades = shade * rng.uniform(0.75, 1.25, (4, 1)) + rng.uniform(-8.0, 8.0, (4, 3))
    side = round(TILE / texel)
    rows, columns = -(-height // side), -(-width // side)
    small = shades[rng.choice(4, (rows, columns), p=(0.55, 0.25, 0.12, 0.08))].astype(np.uint8)
    tiled = small.repeat(side, axis=0).repeat(side, axis=1)[:height, :width]
    out = pictures.shaded(tiled, 1.0 + 0.05 * _grain(rng, height, width))
    out[::side] = (out[::side] * 0.7).astype(np.uint8)
    out[:, ::side] = (out[:, ::side] * 0.7).astype(np.uint8)
    for _ in range(int(3.0 * height * width * texel * texel)):
        x, y, r = (
            int(rng.uniform(0, width)),
            int(rng.uniform(0, height)),
            max(1, int(rng.uniform(*SMALL) / texel / 2.0)),
        )
        if rng.random() < 0.5:
            cv2.circle(out, (x, y), r, pictures.vivid(rng) if rng.random() < 0.3 else _dull(rng), -1, cv2.LINE_AA)
        else:
            box = cv2.boxPoints(((x, y), (2.0 * r + 1.0, r + 1.0), float(rng.uniform(0.0, 90.0))))
            cv2.fillConvexPoly(out, box.astype(np.int32), pictures.pale(rng), cv2.LINE_AA)
    return out


def ceiling(rng: np.random.Generator, height: int, width: int, texel: float) -> Canvas:
    """Return the texture (height, width, 3) of a ceiling: panels, some with stains, lamps and vents. ``texel`` [m]: the
    size of a pixel of the texture."""
    out = pictures.shaded(pictures.filled(height, width, (196, 202, 202)), 1.0 + 0.02 * _grain(rng, height, width))
    side = round(TILE / texel)
    for y in range(0, height, side):
        for x in range(0, width, side):
            kind, panel = rng.random(), out[y + 2 : y + side - 2, x + 2 : x + side - 2]
            if kind < 0.1:
                panel[:] = (250, 252, 252)
                panel[:: max(side // 4, 2)] = (205, 205, 205)
            elif kind < 0.15:
                panel[side // 6 : -side // 6 : 6] = (90, 90, 90)
            elif kind < 0.3:
                at = (x + int(rng.uniform(0.2, 0.8) * side), y + int(rng.uniform(0.2, 0.8) * side))
                cv2.circle(out, at, int(rng.uniform(4, 14)), _dull(rng), -1, cv2.LINE_AA)
    out[::side] = (140, 140, 140)
    out[:, ::side] = (140, 140, 140)
    return out


def label(rng: np.random.Generator, texel: float) -> Canvas:
    """Return the texture of an RFID tag: a white label with its antenna. ``texel`` [m]: the size of its pixels."""
    width, height = round(0.1 / texel), round(0.04 / texel)
    out = pictures.filled(height, width, pictures.PAPER)
    out[height // 2, 2:-2] = pictures.INK
    out[2:-2, 2:-2:4] = pictures.INK
    out[1:-1, width // 2 - 1 : width // 2 + 2] = pictures.vivid(rng)
    return out


def _painted(rng: np.random.Generator, height: int, width: int, texel: float) -> Canvas:
    """Return the texture of a wall in one colour, or in two colours with a border at about table height."""
    out = pictures.filled(height, width, pictures.pale(rng))
    if rng.random() < 0.4:
        below = height - round(rng.uniform(0.7, 1.1) / texel)
        if below > 0:
            out[below:] = pictures.pale(rng)
            out[below : below + 6] = pictures.vivid(rng)
    return pictures.shaded(out, 1.0 + 0.012 * _grain(rng, height, width))


def _paste_with_shadow(canvas: Canvas, picture: Canvas, x: int, y: int) -> None:
    """Paste ``picture`` on ``canvas`` at texel (x, y), with a shadow to the right and below."""
    height, width = picture.shape[:2]
    shadow = canvas[y + 3 : y + height + 3, x + 3 : x + width + 3]
    shadow[:] = (shadow * 0.7).astype(np.uint8)
    pictures.paste(canvas, picture, x, y)


def _draw_low_furniture(canvas: Canvas, rng: np.random.Generator, texel: float) -> None:
    """Draw sideboards and low shelves at the foot of the wall ``canvas``. ``texel`` [m]: the size of a texel."""
    height, width = canvas.shape[:2]
    x = rng.uniform(0.0, 1.0)
    while x < width * texel - 0.4:
        w, h = min(rng.uniform(0.5, 1.5), width * texel - x - 0.05), rng.uniform(0.35, 0.75)
        picture = furniture(rng, round(h / texel), round(w / texel))
        _paste_with_shadow(canvas, picture, round(x / texel), height - picture.shape[0] - 4)
        x += w + rng.uniform(0.2, 1.5)


def _draw_fixtures(canvas: Canvas, rng: np.random.Generator, texel: float) -> None:
    """Draw sockets, switches, vents and stickers at random positions of a wall, five per metre."""
    height, width = canvas.shape[:2]
    for _ in range(int(5.0 * width * texel)):
        h, w = (max(3, round(rng.uniform(*SMALL) / texel)) for _ in range(2))
        picture = pictures.filled(h, w, pictures.PAPER if rng.random() < 0.5 else pictures.vivid(rng))
        cv2.rectangle(picture, (0, 0), (w - 1, h - 1), pictures.INK, 1)
        picture[h // 3 : 2 * h // 3, w // 3 : 2 * w // 3] = pictures.INK
        _paste_with_shadow(canvas, picture, int(rng.uniform(0, width)), int(rng.uniform(0, height)))


def _lighted(canvas: Canvas, rng: np.random.Generator, texel: float) -> Canvas:
    """Return the texture of a wall in the light of the ceiling: bright spots, dark corners, darker near the floor."""
    height, width = canvas.shape[:2]
    factor = 1.0 + 0.05 * pictures.clouds(rng, height, width, 1.5 / texel)
    factor *= np.linspace(1.05, 0.85, height, dtype=np.float32)[:, None]
    edge = np.minimum(np.arange(width), np.arange(width)[::-1]).astype(np.float32) * np.float32(texel)
    factor *= 1.0 - 0.25 * np.exp(-edge / np.float32(0.15))
    return pictures.shaded(canvas, (rng.uniform(0.85, 1.05) * factor).astype(np.float32))


def _grain(rng: np.random.Generator, height: int, width: int) -> NDArray[np.float32]:
    """Return fine noise (height, width) of unit variance. It repeats every 512 texels, which is hardly visible."""
    tile = rng.standard_normal((512, 512)).astype(np.float32)
    return np.asarray(np.tile(tile, (height // 512 + 1, width // 512 + 1))[:height, :width])


def _dull(rng: np.random.Generator) -> pictures.Colour:
    """Return a random colour of carpets."""
    share = rng.uniform(0.3, 0.6)
    blue, green, red = pictures.pale(rng)
    return int(share * blue), int(share * green), int(share * red)
