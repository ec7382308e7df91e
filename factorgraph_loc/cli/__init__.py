"""The command line ``fgloc``."""

__all__ = ["main"]
