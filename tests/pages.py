"""Numbers that pages of the documentation print in tables, for the tests that compute them again; CSV files."""

import csv
import re
from decimal import Decimal
from pathlib import Path

PAGES = Path(__file__).parents[1] / "docs"
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e-?\d+)?")


def printed_tables(page):
    """Return the tables of a page: for each its rows, the cells by the label in the first column."""
    blocks = re.findall(r"(?:^\|.*\n)+", (PAGES / page).read_text(encoding="utf-8"), re.M)
    rows = [
        [[cell.strip() for cell in line.strip("|\n").split("|")] for line in re.split(r"\n(?!$)", block)]
        for block in blocks
    ]
    return [{label: cells for label, *cells in table[2:]} for table in rows]


def assert_printed(cell, *values, round_off=0.0):
    """Assert that a cell prints `values` to 0.6 units of the last digit; some may be the errors of `round_off`.

    A single number stands for several values that round to it.
    """
    numbers = NUMBER.findall(cell)
    for text, value in zip(numbers * (len(values) // len(numbers)), values, strict=True):
        unit = float(Decimal(1).scaleb(Decimal(text).as_tuple().exponent))
        assert abs(float(text) - value) <= 0.6 * unit or max(abs(value), float(text)) <= round_off, (cell, values)


def read_rows(file):
    """Return the rows of a CSV file as dictionaries."""
    return list(csv.DictReader(file.read_text(encoding="utf-8").splitlines()))
