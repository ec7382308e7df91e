"""What ``scripts/fuzz`` tries: damaged files of every format, calls of ``Localizer`` in any order, runs on logs with faults."""
