"""Maps made from logs: landmarks, tags, and 3-D points from images."""
