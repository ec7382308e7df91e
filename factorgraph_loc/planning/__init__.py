"""Where to drive in order to know where one is: candidate paths, what they would tell, and policies that choose among them."""

__all__ = ["active_run", "closed_loop", "information", "policies", "settings"]
