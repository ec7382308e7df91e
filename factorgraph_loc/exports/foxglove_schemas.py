"""JSON schemas of the Foxglove messages that are written.

Fields: https://docs.foxglove.dev/docs/sdk/schemas. Only ``fgloc.Estimate`` is our own.
"""

from typing import Any

Schema = dict[str, Any]

NUMBER: Schema = {"type": "number"}
INTEGER: Schema = {"type": "integer"}
TEXT: Schema = {"type": "string"}
TRUTH: Schema = {"type": "boolean"}


def _object(title: str, **properties: Schema) -> Schema:
    return {"title": title, "type": "object", "properties": properties}


def _list(items: Schema) -> Schema:
    return {"type": "array", "items": items}


TIME = _object("time", sec=INTEGER, nsec=INTEGER)
DURATION = _object("duration", sec=INTEGER, nsec=INTEGER)
POINT3 = _object("foxglove.Point3", x=NUMBER, y=NUMBER, z=NUMBER)
VECTOR3 = _object("foxglove.Vector3", x=NUMBER, y=NUMBER, z=NUMBER)
QUATERNION = _object("foxglove.Quaternion", x=NUMBER, y=NUMBER, z=NUMBER, w=NUMBER)
POSE = _object("foxglove.Pose", position=VECTOR3, orientation=QUATERNION)
COLOUR = _object("foxglove.Color", r=NUMBER, g=NUMBER, b=NUMBER, a=NUMBER)
POINT2 = _object("foxglove.Point2", x=NUMBER, y=NUMBER)
LINE = _object(
    "foxglove.LinePrimitive",
    type=INTEGER,
    pose=POSE,
    thickness=NUMBER,
    scale_invariant=TRUTH,
    points=_list(POINT3),
    color=COLOUR,
    colors=_list(COLOUR),
    indices=_list(INTEGER),
)
SPHERE = _object("foxglove.SpherePrimitive", pose=POSE, size=VECTOR3, color=COLOUR)
LABEL = _object(
    "foxglove.TextPrimitive",
    pose=POSE,
    billboard=TRUTH,
    font_size=NUMBER,
    scale_invariant=TRUTH,
    color=COLOUR,
    text=TEXT,
)
OTHERS = ("arrows", "cubes", "cylinders", "triangles", "models")  # fields of a scene that are left empty
ENTITY = _object(
    "foxglove.SceneEntity",
    timestamp=TIME,
    frame_id=TEXT,
    id=TEXT,
    lifetime=DURATION,
    frame_locked=TRUTH,
    metadata=_list({"type": "object"}),
    spheres=_list(SPHERE),
    lines=_list(LINE),
    texts=_list(LABEL),
    **{name: _list({"type": "object"}) for name in OTHERS},
)

SCHEMAS: tuple[Schema, ...] = (
    _object("foxglove.PoseInFrame", timestamp=TIME, frame_id=TEXT, pose=POSE),
    _object("foxglove.PosesInFrame", timestamp=TIME, frame_id=TEXT, poses=_list(POSE)),
    _object(
        "foxglove.FrameTransform",
        timestamp=TIME,
        parent_frame_id=TEXT,
        child_frame_id=TEXT,
        translation=VECTOR3,
        rotation=QUATERNION,
    ),
    _object("foxglove.SceneUpdate", deletions=_list({"type": "object"}), entities=_list(ENTITY)),
    _object(
        "foxglove.CompressedImage",
        timestamp=TIME,
        frame_id=TEXT,
        data={"type": "string", "contentEncoding": "base64"},
        format=TEXT,
    ),
    _object(
        "foxglove.ImageAnnotations",
        circles=_list({"type": "object"}),
        points=_list(
            _object(
                "foxglove.PointsAnnotation",
                timestamp=TIME,
                type=INTEGER,
                points=_list(POINT2),
                outline_color=COLOUR,
                outline_colors=_list(COLOUR),
                fill_color=COLOUR,
                thickness=NUMBER,
            )
        ),
        texts=_list(
            _object(
                "foxglove.TextAnnotation",
                timestamp=TIME,
                position=POINT2,
                text=TEXT,
                font_size=NUMBER,
                text_color=COLOUR,
                background_color=COLOUR,
            )
        ),
    ),
    _object("foxglove.Log", timestamp=TIME, level=INTEGER, message=TEXT, name=TEXT, file=TEXT, line=INTEGER),
    _object(
        "fgloc.Estimate",
        timestamp=TIME,
        x=NUMBER,
        y=NUMBER,
        heading=NUMBER,
        covariance=_list(NUMBER),
        sigma_position=NUMBER,
        sigma_heading=NUMBER,
        error_position=NUMBER,
        error_heading=NUMBER,
        nees=NUMBER,
    ),
)
