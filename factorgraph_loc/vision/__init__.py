"""Point features of images (colour features, SIFT, ORB): matching, tracking, localization in a map."""

__all__ = [
    "association",
    "consensus",
    "feature_cache",
    "features",
    "fiducials",
    "frame",
    "images",
    "keypoints",
    "matching",
    "relocalization",
    "tracks",
]
