"""YAML and JSON from outside are read, or refused in one sentence, quickly and whatever the text."""

import json
from pathlib import Path

import pytest
import yaml

from finssim.core.yaml_file import DEEPEST, json_value, read_json, read_mapping, yaml_text

BOMB = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 10)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


def read(folder, text):
    path = folder / "file.yaml"
    path.write_text(text, encoding="utf-8")
    return read_mapping(path, KeyError, such_as="mass: 11.2")


def test_what_is_written_reads_back_as_it_was(tmp_path):
    """Numbers, and words that look like numbers to a YAML 1.2 or 1.1 reader such as digests, survive a round trip."""
    words = [
        "12e34",
        "1e5",
        "0123",
        "42",
        ".5",
        "on",
        "yes",
        "null",
        "~",
        "true",
        "2001-01-01",
        "1:30",
        "é",
        "=",
        ".inf",
    ]
    tree = {"words": words, "numbers": [12e34, 1e-5, 42, 0.1, float("inf"), True, None]}
    assert read(tmp_path, yaml_text(tree)) == tree
    assert yaml.safe_load(yaml_text(tree)) == tree


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-5", 1e-5),
        ("on", "on"),
        ("2001-99-99", "2001-99-99"),
        (".inf", float("inf")),
        ("!!int 5", 5),
        ("!!float 5", 5.0),
        ("!!bool true", True),
        (str(2**63 - 1), 2**63 - 1),
        (str(2**63), 2.0**63),
        ("9" * 5000, float("inf")),
    ],
)
def test_scalars_are_those_of_yaml_1_2_and_of_64_bits(tmp_path, text, value):
    found = read(tmp_path, f"a: {text}")["a"]
    assert found == value and type(found) is type(value)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("a: !!int abc", "line 1: not valid YAML: 'abc' is no int"),
        ("a: !!float x", "'x' is no float"),
        ("a: !!bool x", "'x' is no bool"),
        ("a: !!int [1]", "'' is no int"),
        ("a: !!map 3", "expected a mapping node"),
        ("a: !!timestamp 2001-99-99", "could not determine a constructor"),
        ("a: !!binary x", "could not determine a constructor"),
        ("a: !!python/object:os.system x", "could not determine a constructor"),
        ("a: " + "[" * 100_000, "inside one another"),
        ("a: " + "[" * (DEEPEST + 1) + "]" * (DEEPEST + 1), "inside one another"),
        (BOMB, "line 6: not valid YAML: more than 200000 values, repeated ones included"),
        ("a: &a [*a]", "'*a' refers to no anchor that is complete"),
        ("? [1, 2]\n: 3", "a key is a list, expected a word"),
        ("mass: 1\nmass: 2", "line 2: not valid YAML: key 'mass' is given twice"),
        ("a: \0", "not a text file"),
        ("- 1", "expected keys such as 'mass: 11.2', found a list"),
    ],
)
def test_what_is_no_mapping_of_bounded_size_is_refused_in_a_sentence(tmp_path, text, sentence):
    with pytest.raises(KeyError) as error:
        read(tmp_path, text)
    assert sentence in error.value.args[0] and str(tmp_path / "file.yaml") in error.value.args[0]


def test_a_file_without_end_is_refused():
    with pytest.raises(KeyError, match="longer than 32 MiB"):
        read_mapping(Path("/dev/zero"), KeyError, such_as="mass: 11.2")


def test_aliases_within_bounds_are_values(tmp_path):
    assert read(tmp_path, "a: &a [1, 2]\nb: {c: *a, d: *a}") == {"a": [1, 2], "b": {"c": [1, 2], "d": [1, 2]}}


@pytest.mark.parametrize("text", ["{", "[" * 100_000, '{"a":' * 500 + "1" + "}" * 500, b"\xff", "nonsense"])
def test_json_is_refused_in_a_sentence(text):
    with pytest.raises(KeyError, match="run.json: (not valid JSON|more than 100 lists and mappings)"):
        json_value(text, KeyError, "run.json")


def test_json_numbers_are_of_64_bits():
    assert json_value(f"[{'9' * 5000}, {2**63 - 1}, 1e999]", KeyError, "") == [
        float("inf"),
        2**63 - 1,
        float("inf"),
    ]


@pytest.mark.parametrize("value", [[], {}, {"b": 1}, "a"])
def test_a_json_file_holds_the_key(tmp_path, value):
    path = tmp_path / "fit.json"
    path.write_text(json.dumps(value))
    with pytest.raises(KeyError, match="expected a JSON object with the key 'a'"):
        read_json(path, KeyError, such_as="a")
    with pytest.raises(KeyError, match="nowhere.json: cannot be read"):
        read_json(tmp_path / "nowhere.json", KeyError, such_as="a")
