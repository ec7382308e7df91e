"""The style of plots, and helpers for HTML pages."""

__all__ = ["figures", "markup"]
