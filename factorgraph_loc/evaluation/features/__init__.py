"""How well points of images are found again."""
