"""Loop closures as robust factors on two poses."""

__all__ = ["factor"]
