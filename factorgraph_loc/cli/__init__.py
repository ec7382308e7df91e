"""The command ``fgloc``: options, what is printed, exit codes."""

__all__ = ["main"]
