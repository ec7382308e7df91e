"""The sections of scripts/bench_rfid. They have what only a benchmark needs; what may be of use elsewhere is in the library."""
