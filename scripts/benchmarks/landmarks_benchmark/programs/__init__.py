"""Programs that localize by other means, as a user of these would write them: each knows only :mod:`.plain` and its package."""
