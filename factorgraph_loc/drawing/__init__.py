"""The style of plots, and HTML pages from templates."""

__all__ = ["figures", "pages"]
