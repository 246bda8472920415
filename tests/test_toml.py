import re

import pytest

from kpbench.errors import DataError
from kpbench.toml import TomlTable, name_source, read_toml


@pytest.mark.parametrize(
    ("read", "value", "problem"),
    [
        (lambda t: t.number("key", 0, 9), "1", "key is '1', expected a number from 0 to 9"),
        (lambda t: t.number("key", 0), float("inf"), "key is inf, expected a finite number from 0"),
        (lambda t: t.whole_number("key", 0, 1e6), 2.5, "key is 2.5, expected a whole number from 0 to 1000000"),
        (lambda t: t.numbers("key", 0, 9), [1, True], "key[1] is True, expected a number from 0 to 9"),
        (lambda t: t.numbers("key", 0, 9, 3), [1, 2], "key is [1, 2], expected a list of 3 numbers"),
        (lambda t: t.span("key", 0, 9), [2, 1], "key is [2, 1], expected [least, most]"),
        (lambda t: t.choice("key", ("a", "b")), ["a"], "key is ['a'], expected one of: a, b"),
        (lambda t: t.flag("key"), 1, "key is 1, expected true or false"),
        (lambda t: t.text("key"), "", "key is '', expected a non-empty text"),
        (lambda t: t.table("key", ("a",)), 3, "key is 3, expected a table with: a"),
        (lambda t: t.tables("key", ("a",)), [{}, 3], "key[1] is 3, expected a table with: a"),
    ],
)
def test_a_wrong_value_is_one_line_with_file_place_and_expectation(read, value, problem):
    table = TomlTable({"key": value}, ("key",), DataError, "place[2]")
    with (
        pytest.raises(DataError, match=f"^{re.escape(f'file.toml: place[2].{problem}')}$"),
        name_source("file.toml", DataError),
    ):
        read(table)


def test_values_are_numbers_of_the_kind_that_was_asked_for():
    table = TomlTable({"a": 2.0, "b": 3, "c": [1, 2.0]}, ("a", "b", "c", "d"), DataError)
    assert type(table.whole_number("a", 0)) is int
    assert type(table.number("b", 0)) is float
    assert table.numbers("c", 0, whole=True) == (1, 2)
    assert table.span("b", 0, 9) == (3.0, 3.0)
    assert table.number("d", 0, 9, 7.0) == 7.0
    assert "d" not in table


def test_a_key_of_many_parts_is_refused_before_it_takes_all_memory(tmp_path):
    (tmp_path / "a.toml").write_text("a." * 100_000 + "b = 1")
    with pytest.raises(DataError, match="a key of over 50 parts"):
        read_toml(tmp_path / "a.toml", DataError)
