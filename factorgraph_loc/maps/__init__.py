"""Points, markers, walls and free space."""
