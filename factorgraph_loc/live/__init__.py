"""Online localization of a driving robot."""

__all__ = ["localizer"]
