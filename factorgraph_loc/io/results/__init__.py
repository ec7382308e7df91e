"""The files of a result folder."""
