"""Images and camera descriptions of a ROS bag.

A log refers to images as files. The images of a bag are therefore extracted to the user's cache folder. Compressed
images are written unchanged, other images as PGM or PPM without loss.
"""

import hashlib
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import checks
from factorgraph_loc.files.models import parse_model
from factorgraph_loc.files.temporary import locked, sweep, temporary_folder, writing
from factorgraph_loc.io.bags.file import Bag, Stamped
from factorgraph_loc.io.bags.topics import Stamper, TopicSettings, as_nanoseconds
from factorgraph_loc.sensors.camera.measurement import ImageStream
from factorgraph_loc.sensors.camera.settings import COUNTS, CameraSettings
from factorgraph_loc.sensors.tables import Reading
from factorgraph_loc.text import quoted
from factorgraph_loc.vision.feature_cache import cache_folder
from factors.se2 import Array

RAW = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
INFO = "sensor_msgs/msg/CameraInfo"
MAGIC = {b"\xff\xd8\xff": ".jpg", b"\x89PNG": ".png", b"RIFF": ".webp", b"BM": ".bmp", b"P5": ".pgm", b"P6": ".ppm"}
LOCK = ".lock"  # file that a process locks while it moves a folder of images into the cache
Pixels = NDArray[Any]
# an extracted image: number of its message, timestamp of the header [ns], time of receipt [ns], name of the image file
_Row = tuple[int, int, int, str]


# by the encoding of a raw image: type of its numbers, number of channels, conversion to grey or to red, green, blue
ENCODINGS: dict[str, tuple[type, int, Callable[[Pixels], Pixels]]] = {
    "mono8": (np.uint8, 1, lambda p: p),
    "8UC1": (np.uint8, 1, lambda p: p),
    "mono16": (np.uint16, 1, lambda p: p),
    "16UC1": (np.uint16, 1, lambda p: p),
    "rgb8": (np.uint8, 3, lambda p: p),
    "bgr8": (np.uint8, 3, lambda p: p[:, :, ::-1]),
    "8UC3": (np.uint8, 3, lambda p: p[:, :, ::-1]),
    "rgba8": (np.uint8, 4, lambda p: p[:, :, :3]),
    "bgra8": (np.uint8, 4, lambda p: p[:, :, 2::-1]),
    "bayer_rggb8": (np.uint8, 1, lambda p: cv2.cvtColor(p, cv2.COLOR_BayerRGGB2RGB)),
    "bayer_bggr8": (np.uint8, 1, lambda p: cv2.cvtColor(p, cv2.COLOR_BayerBGGR2RGB)),
    "bayer_gbrg8": (np.uint8, 1, lambda p: cv2.cvtColor(p, cv2.COLOR_BayerGBRG2RGB)),
    "bayer_grbg8": (np.uint8, 1, lambda p: cv2.cvtColor(p, cv2.COLOR_BayerGRBG2RGB)),
}


class CameraTopic(TopicSettings):
    """The settings of a ROS topic with the images of a camera."""

    info: str | None = None
    """topic of the CameraInfo messages: lens, image size and frame of the camera"""


class Images:
    """Collects the images of a ROS topic while its bag is read.

    ``name``: the topic. ``stamper``: chooses the timestamps of its messages. ``known``: True if the cache folder
    already has all images. The messages are then not needed. New images are in a temporary folder, which is deleted
    when ``stack`` is closed.
    """

    def __init__(self, bag: Bag, name: str, stamper: Stamper, stack: ExitStack) -> None:
        self._source = f"{bag.path} {name}"
        topic = bag.topic(name, RAW, COMPRESSED)
        self._compressed, self._count = topic.type == COMPRESSED, topic.count
        self._folder = cache_folder() / "bags" / _key(bag.path, name)
        self._stamper = stamper
        self._written: Path | None = None  # folder of newly extracted images
        self._stack = stack
        sweep(self._folder.parent)
        self._rows = _images_in(self._folder, self._count)
        self.known = bool(self._rows)
        self._t_ns = [stamper.choose(header, received) for _, header, received, _ in self._rows]

    def add(self, item: Stamped, t_ns: int) -> None:
        if self._written is None:
            with writing(self._folder):
                self._folder.parent.mkdir(parents=True, exist_ok=True)
                self._written = self._stack.enter_context(temporary_folder(self._folder)) / "images"
                self._written.mkdir()
        where = f"{self._source}:{item.row}"
        if self._compressed:
            content = item.message.data.tobytes()
            suffix = next((suffix for magic, suffix in MAGIC.items() if content.startswith(magic)), None)
            if suffix is None:
                raise InputError(f"{where}: format is {quoted(item.message.format)}, expected JPEG, PNG, WebP or BMP")
        else:
            content, suffix = netpbm(item.message, where)
        header = as_nanoseconds(item.message.header.stamp, 1)
        file = f"{item.row:06d}_{header}_{item.received}{suffix}"
        with writing(self._folder):
            (self._written / file).write_bytes(content)
        self._rows.append((item.row, header, item.received, file))
        self._t_ns.append(t_ns)

    def stream(self, reading: Reading) -> ImageStream:
        """Return the times and files of the collected images. Newly extracted images are moved to the cache folder.

        ``reading``: has the absolute time of t = 0 in the stream, and a list that receives warnings.
        """
        if self._written is not None:
            with writing(self._folder), locked(self._folder.parent / LOCK):
                # keep a complete folder that another process wrote meanwhile: that process may use its files
                if not _images_in(self._folder, self._count):
                    if self._folder.exists():
                        self._folder.rename(self._written.with_name("damaged"))
                    self._written.rename(self._folder)
        rows, t_ns = np.array([row[0] for row in self._rows], dtype=np.int64), np.array(self._t_ns, dtype=np.int64)
        keep = checks.last_in_order(self._source, rows, t_ns, reading.warnings)
        return ImageStream(
            checks.seconds(t_ns[keep], reading.t0_ns), [self._folder / self._rows[i][-1] for i in keep.tolist()]
        )


class Info:
    """Collects the first CameraInfo message of a topic: image size, lens and frame of the camera."""

    def __init__(self, bag: Bag, name: str) -> None:
        bag.topic(name, INFO)
        self._source = f"{bag.path} {name}"
        self._content: dict[str, Any] = {}
        self.frame = ""

    def add(self, item: Stamped, t_ns: int) -> None:
        if self._content:
            return
        info = item.message
        k: Array = np.asarray(info.k if hasattr(info, "k") else info.K, dtype=float)
        d: Array = np.asarray(info.d if hasattr(info, "d") else info.D, dtype=float)
        kind = info.distortion_model or "plumb_bob"
        if kind not in COUNTS:
            raise InputError(
                f"{self._source}:{item.row}: distortion_model is {quoted(kind)}, expected one of {', '.join(COUNTS)}"
            )
        count = COUNTS[kind][-1]
        if np.any(d[count:]):
            raise InputError(f"{self._source}:{item.row}: d has {len(d)} numbers, expected {count} for {kind}")
        self.frame = str(info.header.frame_id)
        self._content = {
            "width": int(info.width),
            "height": int(info.height),
            "fx": float(k[0]),
            "fy": float(k[4]),
            "cx": float(k[2]),
            "cy": float(k[5]),
            "distortion_model": kind,
            "distortion": tuple(np.pad(d[:count], (0, count - len(d[:count]))).tolist()),
        }

    def settings(self, mounting: dict[str, float]) -> CameraSettings:
        """Return the settings of the camera: image size, lens and mounting.

        ``mounting``: by name, the position x, y, z [m] and roll, pitch, yaw [rad] of the camera in the robot frame.
        """
        return parse_model(CameraSettings, self._content | mounting, self._source)


def netpbm(image: Any, where: str) -> tuple[bytes, str]:
    """Return an uncompressed ``sensor_msgs/Image`` as the content and the suffix of a Netpbm file.

    ``where``: names the message in errors. Raises InputError if the encoding is not supported or pixels are missing.
    """
    if image.encoding not in ENCODINGS:
        raise InputError(f"{where}: encoding is {quoted(image.encoding)}, expected one of {', '.join(ENCODINGS)}")
    kind, channels, convert = ENCODINGS[image.encoding]
    width, height, step = int(image.width), int(image.height), int(image.step)
    used = width * channels * np.dtype(kind).itemsize
    data = np.asarray(image.data, dtype=np.uint8)
    if len(data) != step * height or step < used:
        raise InputError(f"{where}: has {len(data)} bytes, expected {height} rows of {max(step, used)} bytes")
    order = np.dtype(kind).newbyteorder(">" if image.is_bigendian else "<")
    packed: Pixels = np.ascontiguousarray(data.reshape(height, step)[:, :used]).view(order)
    packed = packed.reshape(height, width, channels)
    pixels = np.ascontiguousarray(convert(packed[:, :, 0] if channels == 1 else packed))
    mark, suffix = ("P5", ".pgm") if pixels.ndim == 2 else ("P6", ".ppm")
    head = f"{mark}\n{width} {height}\n{np.iinfo(pixels.dtype).max}\n".encode()
    return head + pixels.astype(pixels.dtype.newbyteorder(">")).tobytes(), suffix  # Netpbm is big-endian


def _key(path: Path, topic: str) -> str:
    """Return the name of the cache folder for the images of a topic. The name changes when a file of the bag changes."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    facts = [(str(f.resolve()), f.stat().st_size, f.stat().st_mtime_ns) for f in files]
    return hashlib.sha256(repr((facts, topic)).encode()).hexdigest()[:24]


def _images_in(folder: Path, count: int) -> list[_Row]:
    """Return message number, header timestamp [ns], time of receipt [ns] and file name of each image in a cache folder.

    They are sorted by number. Returns [] if the folder does not have exactly ``count`` images, or has other files."""
    rows = []
    try:
        for file in folder.iterdir():
            row, header, received = map(int, file.stem.split("_"))
            rows.append((row, header, received, file.name))
    except (OSError, ValueError):
        return []
    return sorted(rows) if len(rows) == count else []
