"""The tables of cameras."""

from factorgraph_loc.files.columns import LARGEST_PIXEL, PIXELS, PURE, STAMP, Column, Table, named, number, within

CAMERA = Table("camera", (STAMP, named("file", "the name of an image", "file")), "one each")
SIGHTINGS = Table(
    "sightings",
    (
        STAMP,
        named("landmark", "the name of a landmark", field="point"),
        within("u", PIXELS, LARGEST_PIXEL, "to the right; may lie outside of the image"),
        within("v", PIXELS, LARGEST_PIXEL, "down"),
    ),
    "one measurement",
    stream="factorgraph_loc.sensors.camera.stream:SightingStream",
)
# features of images, as pushed by a program
FEATURES = Table(
    "features",
    (
        STAMP,
        within("pixels", PIXELS, LARGEST_PIXEL, "position of the feature"),
        number("sizes", PIXELS, 1e-3, LARGEST_PIXEL, "size of the feature"),
        within("descriptors", PURE, 1e6, "descriptor of the feature"),
        Column("tracks", "whole", PURE, -(2.0**53), 2.0**53, False, "number of the track that the feature belongs to"),
    ),
    "one measurement",
)
