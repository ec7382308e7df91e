"""Readers of RFID tags: detection, strength and phase."""
