"""Robust fits of constants, and intervals of shares."""

__all__ = ["constants", "robust", "shares"]
