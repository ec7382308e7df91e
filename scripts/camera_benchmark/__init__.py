"""The sections of scripts/bench_camera. They have what only a benchmark needs; what may be of use elsewhere is in the library."""
