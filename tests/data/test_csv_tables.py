"""CSV tables: separators, units, comments, and complaints that name row and column."""

import math

import numpy as np
import pytest

from calib import files
from calib.data.csv_table import read_header, read_table
from calib.errors import MeasurementError


@pytest.mark.parametrize("separator", [",", ";", "\t", ", "])
def test_separators_give_the_same_table(write, separator):
    path = write(separator.join(("a", "b [mm]", "c")), separator.join(("1", "2", "text")))
    table = read_table(path)
    assert table.header == ("a", "b", "c") and table.units == ("", "mm", "")
    assert table.numbers("b", "length")[0] == pytest.approx(0.002)
    assert table.texts("c") == ["text"]


@pytest.mark.parametrize(
    ("heading", "dimension", "factor"),
    [
        ("v [deg]", "angle", math.pi / 180),
        ("v (deg)", "angle", math.pi / 180),
        ("v[°]", "angle", math.pi / 180),
        ("v [mrad]", "angle", 1e-3),
        ("v [rad]", "angle", 1.0),
        ("v", "angle", 1.0),
        ("v [mm]", "length", 1e-3),
        ("v(um)", "length", 1e-6),
        ("v [µm]", "length", 1e-6),
        ("v [in]", "length", 0.0254),
        ("v [MM]", "joint", 1e-3),
        ("v", "length", 1.0),
    ],
)
def test_a_unit_in_the_header_is_converted(write, heading, dimension, factor):
    table = read_table(write(f"{heading},w", "3,0"))
    np.testing.assert_allclose(table.numbers("v", dimension), 3 * factor, rtol=1e-15)


def test_byte_order_mark_blanks_and_quotes(tmp_path):
    """Byte order mark, comments, blank lines and quotes."""
    path = tmp_path / "bom.csv"
    path.write_bytes(
        '\ufeff# by hand\n\n"a, first",b\r\n1,2\r\n# no row\r\n\r\n3,4\r\n,,\r\n'.replace(",,", ",").encode()
    )
    table = read_table(path)
    assert table.header == ("a, first", "b")
    np.testing.assert_array_equal(table.numbers("b"), [2, 4])
    np.testing.assert_array_equal(table.rows, [1, 2])


def test_comment_may_name_columns(tmp_path):
    """A comment names the columns where nothing else does."""
    path = tmp_path / "savetxt.csv"
    np.savetxt(path, [[1.0, 2.0], [3.0, 4.0]], delimiter=",", header="q1,x [mm]")
    table = read_table(path)
    assert table.header == ("q1", "x") and len(table) == 2
    np.testing.assert_allclose(table.numbers("x", "length"), [0.002, 0.004])


def test_large_table_is_read_in_chunks(write):
    """A large table is read in chunks without loss."""
    values = np.random.default_rng(1).normal(size=(50_000, 2))
    path = write(
        "a,b,c", "\n".join(f"{a!r},{b!r},{'' if i == 49_999 else 1}" for i, (a, b) in enumerate(values.tolist()))
    )
    table = read_table(path)
    np.testing.assert_array_equal(np.stack([table.numbers("a"), table.numbers("b")], axis=1), values)
    assert np.isnan(table.numbers("c", gaps=True)).sum() == 1
    with pytest.raises(MeasurementError) as error:
        table.numbers("c")
    assert (error.value.row, error.value.column) == (50_000, "c")


def test_ragged_rows_keep_their_numbers(write):
    """Text and ragged rows far down keep their numbers."""
    table = read_table(write("a,b", "\n".join(["1,2"] * 25_000 + ["x,2"])))
    assert table.texts("a")[0] == "1" and table.texts("a")[-1] == "x"
    with pytest.raises(MeasurementError, match="'x' where a number is needed") as error:
        table.numbers("a")
    assert error.value.row == 25_001
    with pytest.raises(MeasurementError, match="1 cells, the header has 2") as error:
        read_table(write("a,b", "1,2\n" * 40_002 + "3\n"))
    assert error.value.row == 40_003


@pytest.mark.slow
def test_damaged_cells_told_over_all_columns(write):
    """Damaged cells are told over all columns from the first row."""
    rows = [["1", "2", "3"] for _ in range(45_000)]
    rows[30_000][0], rows[700][1], rows[700][2], rows[44_000][2] = "ERR", "", "nan", "n/a"
    table = read_table(write("a,b,c", "\n".join(map(",".join, rows))))
    with pytest.raises(MeasurementError, match=r"an empty or NaN cell .*; leave such rows out") as error:
        table.check(("a", "b", "c"))
    assert (error.value.row, error.value.column) == (701, "b")
    assert str(error.value).endswith("(and in 2 more rows; of all, 1 in a, 1 in b, 2 in c)")
    with pytest.raises(MeasurementError, match=r"'ERR' .* 1 more row; of all, 1 in a, 1 in c") as error:
        table.check(("a", "b", "c"), ("b", "c"))
    assert error.value.row == 30_001
    keep = np.isin(np.arange(45_000), [700, 30_000, 44_000], invert=True)
    assert sum(column.sum() for column in table.where(keep).check(("a", "b", "c"))) == 6 * 44_997


def test_truncated_file_says_so(write):
    """A file that ends within a line says so."""
    with pytest.raises(MeasurementError, match=r"ends here, in the middle of a line .* delete its last line") as error:
        read_table(write("a,b,c", "1,2,3\n" * 100 + "4,5"))
    assert error.value.row == 101
    with pytest.raises(MeasurementError, match=r"2 cells, the header has 3 columns$"):
        read_table(write("a,b,c", "1,2,3\n4,5\n6,7,8\n"))


def test_spreadsheet_error_is_no_comment(write):
    """A spreadsheet's error is a cell and no comment."""
    table = read_table(write("a,b", "1,2\n#REF!,3\n# note, 4\n5,6"))
    assert table.texts("a") == ["1", "#REF!", "5"]


@pytest.mark.parametrize(
    ("text", "words", "row", "column"),
    [
        ("", "is empty", None, None),
        ("# only a comment\n", "is empty", None, None),
        ("a,b\n", "no data rows", None, None),
        ("a,b,a\n1,2,3\n", r"more than once in the header \(columns 1 and 3\)", None, "a"),
        ("a,b\n1,2\n1,2,3\n", "3 cells, the header has 2", 2, None),
        ("a,b\n1,2\n1\n", "1 cells, the header has 2", 2, None),
        ("a,b\n1,5,2,5\n", "decimal commas", 1, None),
        ("1,2\n3,4\n", "has no header.*format", None, None),
        ("left,1,2\nright,3,4\n", "has no header", None, None),
        ("1,5;2,5\n3,5;4,5\n", "'1,5', with a decimal comma", 1, None),
        ("a,b [µm]\n1,\x81\n", r"is not UTF-8 text.*0x81", None, None),
        (None, "cannot be read: No such file", None, None),
    ],
)
def test_a_file_that_is_no_table_is_refused(tmp_path, text, words, row, column):
    path = tmp_path / "bad.csv"
    if text is not None:
        path.write_text(text, encoding="latin-1")
    with pytest.raises(MeasurementError, match=words) as error:
        read_table(path)
    assert (error.value.file, error.value.row, error.value.column) == (path, row, column)


@pytest.mark.parametrize(
    ("cell", "words"),
    [
        ("12,5", "decimal comma"),
        ("abc", "'abc' where a number is needed"),
        ("", "empty or NaN"),
        ("NaN", "empty or NaN"),
        ("-inf", "-inf"),
    ],
)
def test_a_cell_that_is_no_number_is_named(write, cell, words):
    table = read_table(write("a;b", f"1;2\n3;{cell}"))
    with pytest.raises(MeasurementError, match=words) as error:
        table.numbers("b")
    assert (error.value.row, error.value.column) == (2, "b")


@pytest.mark.parametrize(
    ("heading", "dimension", "unit", "words"),
    [
        ("x [furlong]", "length", "", "is not one of"),
        ("x [deg]", "length", "", "is not one of"),
        ("x [m]", "angle", "", "is not one of"),
        ("x [mm]", "length", "m", r"header states \[mm\], the options state m"),
        ("xx", "length", "", r"'x' is missing"),
    ],
)
def test_unfit_column_is_refused(write, heading, dimension, unit, words):
    """A column that is not what it should be is refused."""
    with pytest.raises(MeasurementError, match=words) as error:
        read_table(write(f"{heading},y", "1,2")).numbers("x", dimension, unit)
    assert error.value.column == (None if heading == "xx" else "x")


def test_table_without_rows_has_columns(write):
    """As what remains of a table when none of its rows holds a position."""
    table = read_table(write("x [mm],y [deg]", ",1\n,2")).where(np.zeros(2, dtype=bool))
    assert table.numbers("x", "length", gaps=True).shape == table.numbers("y", "angle").shape == (0,)


def test_what_a_header_says(write):
    assert read_table(write("x,T [furlong]", "1,2")).numbers("x", "length")[0] == 1  # of an ignored column nothing
    assert read_table(write("a,b,", "1,2,\n3,4,")).header == ("a", "b")  # each line ends with a separator
    assert read_header(write("q1 [deg];x", "1;2")) == (("q1", "x"), ("deg", ""))


def test_numbers_are_written_as_rows_are(tmp_path):
    values = np.random.default_rng(0).normal(size=(40, 3)) * 10.0 ** np.arange(-60, 60).reshape(40, 3)
    values[0] = [0.0, -0.0, 5.0]
    header = ["# t", 'a, "b"', "c;d"]
    plain = files.write_table(tmp_path / "rows.csv", header, values.tolist()).read_bytes()
    assert files.write_numbers(tmp_path / "numbers.csv", header, values).read_bytes() == plain


def test_formula_name_is_text_and_reads_back(tmp_path):
    """A name that is a formula is text in a spreadsheet, and itself when read back."""
    names = ["=1+1", "+a", "-b", "@c", "'=d", "'", "e", "-1.5"]
    path = files.write_table(
        tmp_path / "t.csv", ["=x [mm]", "name"], [[float(k), name] for k, name in enumerate(names)]
    )
    cells = [line.split(",") for line in path.read_text().splitlines()]
    assert cells[0][0] == "'=x [mm]"
    assert [row[1] for row in cells[1:]] == ["'=1+1", "'+a", "'-b", "'@c", "''=d", "''", "e", "-1.5"]
    table = read_table(path)
    assert table.header == ("=x", "name") and table.units == ("mm", "") and table.texts("name") == names
