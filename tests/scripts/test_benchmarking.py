import pytest
from benchmarking.command import with_tables

PAGE = "# Title\n\n## first\n\nProse.\n\n<!-- tables -->\n\n| old |\n\n## second\n\n<!-- tables -->\n"


def test_tables_of_a_section_take_the_place_of_its_old_ones_alone():
    page = with_tables(PAGE, "first", ["| new |", ""])

    assert page == PAGE.replace("| old |", "| new |")
    assert with_tables(page, "first", ["| new |"]) == page


def test_the_last_section_gets_its_tables():
    assert with_tables(PAGE, "second", ["| new |"]) == PAGE + "\n| new |\n"


def test_a_page_without_the_section_is_refused():
    with pytest.raises(SystemExit, match="third"):
        with_tables(PAGE, "third", [])
