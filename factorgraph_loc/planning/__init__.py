"""Active localization: candidate paths, their expected information, and policies that choose among them."""

__all__ = ["active_run", "closed_loop", "information", "policies", "settings"]
