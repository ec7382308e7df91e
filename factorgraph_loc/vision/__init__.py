"""Point features of images: the paper's colour features, OpenCV's beside them, their matching and how well they
repeat."""

__all__ = [
    "association",
    "consensus",
    "feature_cache",
    "features",
    "fiducials",
    "found",
    "frame",
    "frame_motion",
    "images",
    "keypoints",
    "matching",
    "relocalization",
    "settings",
    "spread",
    "tracks",
]
