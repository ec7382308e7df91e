"""Scores of a trajectory against any other trajectory: association, alignment, absolute and relative errors, and their report."""

__all__ = ["association", "page", "score"]
