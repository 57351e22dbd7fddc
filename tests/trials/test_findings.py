"""Every code of a finding has one sentence and is used, and a sentence names only values that its producers
give."""

import ast
import string
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

import finssim
from finssim.trials.findings import SEVERITIES, finding, sentences, wordings

SOURCE = Path(finssim.__file__).parent


def producers() -> dict[str, list[tuple[str, set[str] | None]]]:
    """Return code -> location and value names of every call of `finding`; None where a mapping gives them."""
    found = defaultdict(list)
    for path in SOURCE.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        if "finding(" not in text:
            continue
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "finding":
                code = node.args[0]
                named = {keyword.arg for keyword in node.keywords}
                place = f"{path.name}:{node.lineno}"
                for one in [code.body, code.orelse] if isinstance(code, ast.IfExp) else [code]:
                    given = None if None in named else named - {"severity"}
                    found[ast.literal_eval(one)].append((place, given))
    return found


def fields(code: str) -> set[str]:
    """Return the names that the sentence of a code fills in."""
    return {name for _, name, _, _ in string.Formatter().parse(wordings()[code][1]) if name}


def test_every_code_is_worded_and_used():
    assert set(producers()) == set(wordings())
    assert {severity for severity, _ in wordings().values()} == set(SEVERITIES)


def test_a_sentence_names_exactly_what_its_producers_give():
    """`edges_empty` is exempt: its sides are for programs, its shares for people."""
    for code, calls in producers().items():
        for place, given in calls:
            extra = {"sides"} if code == "edges_empty" else set()
            assert given is None or given - extra == fields(code), f"{place}: {code}"


def test_what_holds_for_several_subjects_is_one_sentence():
    found = [finding("taken_level", f"run{i}") for i in (1, 2, 3, 4, 4)]
    found += [finding("axis_still", "run1", axis="surge"), finding("axis_still", "run2", axis="sway")]
    assert sentences(found) == [
        f"run1, run2, run3 and 1 more: {found[0].text}",
        f"run1: {found[-2].text}",
        f"run2: {found[-1].text}",
    ]


def test_json_has_code_values_and_sentence():
    """Numbers of NumPy become plain, and non-finite ones None."""
    record = finding("stuck", "u", value=np.float64(0.5), span=np.nan, start=np.float32(2.0)).as_json()
    assert record["values"] == {"value": 0.5, "span": None, "start": 2.0}
    assert (record["code"], record["severity"], record["subject"]) == ("stuck", "care", "u")
    assert record["sentence"] == "u: constant at 0.5 for nan s from 2 s: stuck?"


def test_a_part_keeps_its_subject():
    whole = finding("zero_bytes", "imu.csv").about("run1")
    assert str(whole) == f"run1: imu.csv: {whole.text}"
    with pytest.raises(KeyError):
        finding("no_such_code")
