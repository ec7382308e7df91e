"""What scripts/bench_rfid and scripts/bench_camera share: their command line, their tables, and jobs in processes."""
