"""Maps made from logs: landmarks, tags, and points that a camera sees."""
