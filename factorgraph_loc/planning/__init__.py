"""Active localization: candidate paths, their expected information, and policies that choose among them."""

__all__ = ["closed_loop", "information", "settings"]
