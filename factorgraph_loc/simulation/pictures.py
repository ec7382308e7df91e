"""Random pictures of objects on the walls of a simulated building, as BGR arrays. Their size is given in texels (texture pixels).

Like print, frames and coloured objects in a real office, they have corners at several scales.
"""

import colorsys
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Canvas = NDArray[np.uint8]
Colour = tuple[int, int, int]
Draw = Callable[[np.random.Generator, int, int], Canvas]

INK: Colour = (45, 40, 40)
PAPER: Colour = (232, 238, 238)


def vivid(rng: np.random.Generator) -> Colour:
    """Return a random saturated colour, as BGR."""
    return _colour(rng.random(), rng.uniform(0.3, 0.85), rng.uniform(0.3, 0.9))


def pale(rng: np.random.Generator) -> Colour:
    """Return a random colour of painted walls, as BGR."""
    return _colour(rng.random(), rng.uniform(0.04, 0.2), rng.uniform(0.66, 0.88))


def wood(rng: np.random.Generator) -> Colour:
    """Return a random colour of wood, as BGR."""
    return _colour(rng.uniform(0.04, 0.11), rng.uniform(0.3, 0.65), rng.uniform(0.4, 0.8))


def filled(height: int, width: int, colour: Colour) -> Canvas:
    """Return a picture of one colour, with ``height`` and ``width`` in texels (pixels of a texture)."""
    return np.full((height, width, 3), colour, dtype=np.uint8)


def clouds(rng: np.random.Generator, height: int, width: int, cell: float) -> NDArray[np.float32]:
    """Return smooth noise (height, width) of about unit variance. ``cell``: the correlation length in texels."""
    coarse = rng.standard_normal((2 + int(height / cell), 2 + int(width / cell))).astype(np.float32)
    return np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC), dtype=np.float32)


def shaded(canvas: Canvas, factor: NDArray[np.float32]) -> Canvas:
    """Return a picture with each pixel multiplied by a ``factor`` of its own. ``factor`` (height, width)."""
    out = np.empty_like(canvas)
    for i in range(0, len(canvas), 256):  # in strips, to limit the memory
        out[i : i + 256] = np.clip(canvas[i : i + 256] * factor[i : i + 256, :, None], 0.0, 255.0)
    return out


def paste(canvas: Canvas, picture: Canvas, x: int, y: int) -> None:
    """Paste a picture into ``canvas`` with its upper left corner at texel (x, y). Parts outside are clipped."""
    height, width = canvas.shape[:2]
    x0, y0 = max(x, 0), max(y, 0)
    x1, y1 = min(x + picture.shape[1], width), min(y + picture.shape[0], height)
    if x1 > x0 and y1 > y0:
        canvas[y0:y1, x0:x1] = picture[y0 - y : y1 - y, x0 - x : x1 - x]


def write(canvas: Canvas, rng: np.random.Generator, box: tuple[int, int, int, int], size: int, colour: Colour) -> None:
    """Draw lines of random letters into ``box`` (x1, y1, x2, y2) [texels] of a picture, in one ``colour`` (BGR). A
    letter has 5 x 3 dots of ``size`` texels. A texel is a pixel of a texture."""
    x1, y1, x2, y2 = box
    letters, lines = (x2 - x1) // (4 * size), (y2 - y1) // (8 * size)
    for line in range(lines):
        used = int(letters * rng.uniform(0.55, 1.0))
        if used < 1:
            continue
        dots = (rng.random((5, used, 4)) < 0.62) & (np.arange(4) < 3) & (rng.random((1, used, 1)) > 0.16)
        rows = np.kron(dots.reshape(5, -1), np.ones((size, size), dtype=bool))
        y = y1 + line * 8 * size
        canvas[y : y + rows.shape[0], x1 : x1 + rows.shape[1]][rows] = colour


def page(rng: np.random.Generator, height: int, width: int) -> Canvas:
    """Return a picture (height, width, 3) of a printed sheet with a headline, lines and possibly a figure."""
    out = filled(height, width, PAPER if rng.random() < 0.6 else pale(rng))
    edge = max(2, width // 12)
    top = height // 5
    write(out, rng, (edge, edge, width - edge, top), max(1, min(width // 40, (top - edge) // 8)), vivid(rng))
    if rng.random() < 0.6:
        figure = abstract(rng, height // 3, max(width - 2 * edge, 8))
        paste(out, figure, edge, top)
        top += height // 3 + edge
    write(out, rng, (edge, top, width - edge, height - edge), max(1, width // 120), INK)
    return out


def abstract(rng: np.random.Generator, height: int, width: int) -> Canvas:
    """Return a picture (height, width, 3) of overlapping shapes of many sizes."""
    out = filled(height, width, vivid(rng))
    for scale in (0.5, 0.5, *([0.3] * 4), *([0.15] * 6), *([0.08] * 8)):
        at, radius = rng.uniform((0, 0), (width, height)), scale * min(width, height) * rng.uniform(0.6, 1.2) + 1.0
        colour, kind = vivid(rng), int(rng.integers(4))
        if kind == 0:
            cv2.circle(out, (int(at[0]), int(at[1])), max(1, int(0.7 * radius)), colour, -1, cv2.LINE_AA)
            continue
        if kind == 1:
            box = cv2.boxPoints(((float(at[0]), float(at[1])), (1.6 * radius, radius), float(rng.uniform(0.0, 90.0))))
            corners = box
        else:
            angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, kind + 1))
            corners = at + radius * np.column_stack((np.cos(angles), np.sin(angles)))
        cv2.fillConvexPoly(out, np.asarray(corners).astype(np.int32), colour, cv2.LINE_AA)
    return out


def poster(rng: np.random.Generator, height: int, width: int) -> Canvas:
    """Return a picture (height, width, 3) of a poster: shapes in a frame, with a title below."""
    out = filled(height, width, PAPER if rng.random() < 0.5 else vivid(rng))
    edge, foot = max(3, width // 14), height // 5
    paste(out, abstract(rng, max(height - foot - edge, 8), max(width - 2 * edge, 8)), edge, edge)
    write(out, rng, (edge, height - foot + edge // 2, width - edge, height), max(1, foot // 18), INK)
    cv2.rectangle(out, (0, 0), (width - 1, height - 1), INK, max(1, width // 80))
    return out


def landscape(rng: np.random.Generator, height: int, width: int) -> Canvas:
    """Return a picture (height, width, 3) of sky, hills and houses."""
    sky, far = np.array(vivid(rng), dtype=float), np.array(PAPER, dtype=float)
    share = np.linspace(0.0, 1.0, height)[:, None, None]
    out = np.broadcast_to((1.0 - share) * sky + share * far, (height, width, 3)).astype(np.uint8)
    for level in (0.45, 0.6, 0.75):
        ridge = height * (level + 0.08 * clouds(rng, 1, width, width / 5.0)[0])
        colour = _colour(rng.uniform(0.2, 0.45), rng.uniform(0.3, 0.8), rng.uniform(0.25, 0.7))
        out[np.arange(height)[:, None] > ridge] = colour
    for _ in range(7):
        w, h = (max(4, int(rng.uniform(0.05, 0.16) * side)) for side in (width, height))
        x, y = int(rng.uniform(0, width - w)), int(rng.uniform(0.45, 0.9) * height)
        house = filled(h, w, vivid(rng))
        house[h // 4 :: max(3, h // 4), w // 5 :: max(3, w // 4)] = PAPER
        paste(out, house, x, y - h // 2)
    return out


def painting(rng: np.random.Generator, height: int, width: int) -> Canvas:
    """Return a picture (height, width, 3) of a landscape or shapes in a wooden frame."""
    frame = max(3, min(height, width) // 14)
    out = filled(height, width, wood(rng))
    inner = landscape if rng.random() < 0.6 else abstract
    paste(out, inner(rng, max(height - 2 * frame, 8), max(width - 2 * frame, 8)), frame, frame)
    cv2.rectangle(out, (frame, frame), (width - frame, height - frame), INK, 1)
    return out


def board(rng: np.random.Generator, height: int, width: int) -> Canvas:
    """Return a picture (height, width, 3) of a pin board with sheets on it."""
    out = shaded(filled(height, width, wood(rng)), 1.0 + 0.05 * clouds(rng, height, width, 2.0))
    for _ in range(max(4, height * width // 5000)):
        h = int(rng.uniform(30, 62))
        sheet = page(rng, h, int(h * rng.uniform(0.65, 1.4)))
        x, y = int(rng.uniform(4, max(width - 40, 5))), int(rng.uniform(4, max(height - 40, 5)))
        paste(out, sheet, x, y)
        cv2.circle(out, (x + sheet.shape[1] // 2, y + 3), 2, vivid(rng), -1, cv2.LINE_AA)
    cv2.rectangle(out, (0, 0), (width - 1, height - 1), wood(rng), 6)
    return out


def whiteboard(rng: np.random.Generator, height: int, width: int) -> Canvas:
    """Return a picture (height, width, 3) of a whiteboard with curves, boxes and words in a few colours."""
    out = filled(height, width, (238, 240, 238))
    for _ in range(6):
        colour, at = vivid(rng), rng.uniform((10, 10), (max(width - 50, 11), max(height - 40, 11))).astype(int)
        x, y = at.tolist()
        w, h = rng.integers(30, 90), rng.integers(20, 50)
        kind = int(rng.integers(3))
        if kind == 0:
            cv2.rectangle(out, (x, y), (x + int(w), y + int(h)), colour, 2, cv2.LINE_AA)
        elif kind == 1:
            steps = np.cumsum(rng.normal((4.0, 0.0), 9.0, (14, 2)), axis=0)
            cv2.polylines(out, [(at + steps).astype(np.int32)], False, colour, 2, cv2.LINE_AA)
        else:
            write(out, rng, (x, y, min(x + 110, width), min(y + 50, height)), 2, colour)
    cv2.rectangle(out, (0, 0), (width - 1, height - 1), (150, 150, 150), 6)
    return out


def window(rng: np.random.Generator, height: int, width: int) -> Canvas:
    """Return a picture (height, width, 3) of a window and the landscape behind it. The picture has no parallax."""
    out = filled(height, width, (225, 228, 228))
    frame, panes = 10, max(1, width // 180)
    view = shaded(landscape(rng, height, width), np.full((height, width), 1.15, dtype=np.float32))
    for i in range(panes):
        x1, x2 = i * width // panes + frame, (i + 1) * width // panes - frame
        out[frame : height - frame, x1:x2] = view[frame : height - frame, x1:x2]
        cv2.rectangle(out, (x1, frame), (x2, height - frame), (120, 120, 120), 1)
        cv2.rectangle(out, (x2 - 14, height // 2), (x2 - 4, height // 2 + 26), INK, -1)
    return out


def books(rng: np.random.Generator, height: int, width: int) -> Canvas:
    """Return a picture (height, width, 3) of shelves of books."""
    side = wood(rng)
    out = filled(height, width, (int(0.4 * side[0]), int(0.4 * side[1]), int(0.4 * side[2])))
    levels = max(1, round(height / 70.0))
    for level in range(levels):
        bottom = (level + 1) * height // levels
        room = height // levels - 8
        x = 6
        while x < width - 10:
            if rng.random() < 0.06:
                x += int(rng.integers(10, 40))  # gap
                continue
            thick, tall = int(rng.integers(4, 12)), int(room * rng.uniform(0.6, 0.95))
            spine = filled(tall, thick, vivid(rng))
            band = int(rng.uniform(0.1, 0.6) * tall)
            spine[band : band + max(2, tall // 8)] = PAPER if rng.random() < 0.6 else vivid(rng)
            spine[:, -1] = (30, 30, 30)
            paste(out, spine, x, bottom - 6 - tall)
            x += thick
        out[bottom - 6 : bottom] = side
    out[:, :6] = side
    out[:, -6:] = side
    return out


def cupboard(rng: np.random.Generator, height: int, width: int) -> Canvas:
    """Return a picture (height, width, 3) of a cupboard with doors or drawers, handles and stickers."""
    grain = 1.0 + 0.06 * cv2.resize(clouds(rng, max(height // 12, 2), width, 2.0), (width, height))
    out = shaded(filled(height, width, wood(rng) if rng.random() < 0.7 else pale(rng)), grain.astype(np.float32))
    columns, rows = max(1, round(width / 90.0)), int(rng.integers(1, 5))
    for i in range(columns):
        for j in range(rows):
            x1, x2 = i * width // columns, (i + 1) * width // columns
            y1, y2 = j * height // rows, (j + 1) * height // rows
            cv2.rectangle(out, (x1 + 2, y1 + 2), (x2 - 2, y2 - 2), INK, 1)
            at = (x2 - 14, (y1 + y2) // 2) if rows == 1 else ((x1 + x2) // 2 - 8, y1 + 10)
            cv2.rectangle(out, at, (at[0] + (4 if rows == 1 else 16), at[1] + (24 if rows == 1 else 4)), INK, -1)
    for _ in range(int(rng.integers(1, 5))):
        h = int(rng.uniform(16, 50))
        sheet = (page if rng.random() < 0.6 else abstract)(rng, h, int(h * rng.uniform(0.7, 1.4)))
        paste(out, sheet, int(rng.uniform(4, max(width - 30, 5))), int(rng.uniform(0.05, 0.6) * height))
    return out


def sign(rng: np.random.Generator, height: int, width: int) -> Canvas:
    """Return a picture (height, width, 3) of a door plate with large print."""
    out = filled(height, width, vivid(rng))
    write(out, rng, (width // 8, height // 5, width, height), max(1, height // 14), PAPER)
    return out


def extinguisher(rng: np.random.Generator, height: int, width: int) -> Canvas:
    """Return a picture (height, width, 3) of a fire extinguisher: a red bottle on a plate."""
    out = filled(height, width, PAPER)
    cv2.rectangle(out, (width // 4, height // 3), (3 * width // 4, height - 3), (30, 30, 200), -1)
    cv2.circle(out, (width // 2, height // 3), width // 4, (30, 30, 200), -1, cv2.LINE_AA)
    cv2.rectangle(out, (width // 3, height // 10), (2 * width // 3, height // 5), INK, -1)
    write(out, rng, (width // 3, height // 2, 2 * width // 3, height - 6), 1, PAPER)
    return out


def _colour(hue: float, saturation: float, value: float) -> Colour:
    red, green, blue = colorsys.hsv_to_rgb(hue, saturation, value)
    return int(255.0 * blue), int(255.0 * green), int(255.0 * red)
