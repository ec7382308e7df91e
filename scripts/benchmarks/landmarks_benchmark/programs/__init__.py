"""Programs that localize by numpy, filterpy or GTSAM, without this project. They use only :mod:`.plain` and their package."""
