"""Point features of images (the paper's colour features, SIFT, ORB), their matching, tracking and localization in a map."""

__all__ = [
    "association",
    "consensus",
    "feature_cache",
    "features",
    "fiducials",
    "frame",
    "image_turn",
    "images",
    "keypoints",
    "matching",
    "relocalization",
    "settings",
    "tracks",
]
