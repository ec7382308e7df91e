"""Cases of ``scripts/fuzz``: damaged files of every format, random calls of ``Localizer``, runs on logs with faults."""
