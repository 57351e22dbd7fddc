"""One reader of text tables: the cells are the same in every format, and each records its line."""

import math

import pytest

from finssim.core.text_table import read_text_table, text_table


class Refused(ValueError):
    """Error of a layer."""


@pytest.mark.parametrize("mark", [",", ";", "\t", " , "])
def test_separators_and_line_ends_make_no_difference(mark):
    rows = [["t", "u"], ["0", "1.5"], ["1", ""]]
    table = text_table("# made by hand\r\n\r\n" + "".join(mark.join(row) + "\r\n" for row in rows))
    assert (table.names, table.rows) == (rows[0], rows[1:])
    assert table.lines == [4, 5] and table.comments == ["# made by hand"] and not table.unfinished


def test_a_comma_is_a_point_only_where_it_separates_nothing():
    assert text_table("t;u\n0;1,5\n").number("1,5") == 1.5
    assert text_table("t,u\n0,1\n").number("1,5") is None
    assert math.isnan(text_table("t,u\n").number(" N/A ")) and text_table("t,u\n").number("−2") == -2.0


def test_blanks_separate_where_nothing_else_does():
    assert text_table("t  u\n0 1\n", spaces=None).rows == [["0", "1"]]
    assert text_table("t,a b\n0,1\n", spaces=None).names == ["t", "a b"]


def test_lines_before_the_table_and_names_from_elsewhere():
    table = text_table("logger 7\n3,4\n5,6\n", skip=1, names=("t", "u"))
    assert table.names == ["t", "u"] and table.rows == [["3", "4"], ["5", "6"]] and table.lines == [2, 3]


def test_what_a_crash_leaves_is_told(tmp_path):
    path = tmp_path / "cut.csv"
    path.write_bytes(b"\xef\xbb\xbft,u\n0,1\n1,0.\0\0\0")
    table = read_text_table(path, Refused)
    assert table.zeros and table.unfinished and table.rows[-1] == ["1", "0."]
    with pytest.raises(Refused, match="none.csv: cannot be read: No such file"):
        read_text_table(tmp_path / "none.csv", Refused)


def test_old_spreadsheets_and_files_that_are_no_text(tmp_path):
    """A one-byte µ is read; binary bytes do not become column names."""
    (tmp_path / "old.csv").write_bytes("pulse (µs)\n1500\n".encode("latin-1"))
    assert read_text_table(tmp_path / "old.csv", Refused).names == ["pulse (µs)"]
    (tmp_path / "binary.csv").write_bytes(b"\xff\x01\x02\x80,\x81\n")
    assert "\ufffd" in read_text_table(tmp_path / "binary.csv", Refused).names[0]
