"""Scores of any trajectory against any other: association, alignment, absolute and relative errors, and their report."""

__all__ = ["association", "page", "score"]
