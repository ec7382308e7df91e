"""Benchmark of localization by RFID: the sections of docs/rfid-results.md."""

from rfid_benchmark import aisle, blind, faults, hall, maps, office, optimum, speed, starts, wrong

SECTIONS = {
    "aisle": aisle.section,
    "office": office.section,
    "optimum": optimum.section,
    "starts": starts.section,
    "speed": speed.section,
    "faults": faults.section,
    "blind": blind.section,
    "wrong": wrong.section,
    "maps": maps.section,
    "hall": hall.section,
}
