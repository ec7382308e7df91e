"""Point features of images: the paper's colour features, OpenCV's beside them, their matching and how well they
repeat."""
