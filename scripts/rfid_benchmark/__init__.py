"""The sections of scripts/bench_rfid."""
