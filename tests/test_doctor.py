"""The doctor reports the true state of this machine."""

import json
import re
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

import pytest

from finssim.cli import doctor
from finssim.cli.doctor import EXTRAS, examine


def test_a_working_machine_is_called_healthy():
    """A machine with the core installed, as for these tests, is reported as healthy; its CPU runs Warp's kernels."""
    found = examine()
    assert found["healthy"]
    assert found["core"]["numpy"] == metadata.version("numpy")
    assert {"name": "cpu", "works": True} == {key: found["devices"][0][key] for key in ("name", "works")}


def test_a_missing_core_package_is_reported(monkeypatch, capsys):
    """A missing core package is named, and the result is not healthy."""
    monkeypatch.setattr(doctor, "CORE", (*doctor.CORE, "no-such-distribution"))
    assert doctor.doctor() == 1
    out = capsys.readouterr().out
    assert "no-such-distribution" in out and "not ready" in out


def test_a_missing_extra_is_named_with_what_it_enables(monkeypatch, capsys):
    """An incomplete extra shows the package to install and the purpose."""
    monkeypatch.setitem(EXTRAS, "learn", doctor.Extra({"no-such-learner": "nsl"}, "train policies"))
    found = examine()["extras"]["learn"]
    assert found == {
        "complete": False,
        "versions": {},
        "missing": ["no-such-learner"],
        "enables": "train policies",
    }
    assert doctor.doctor() == 0
    assert "no-such-learner" in capsys.readouterr().out


def test_json_is_one_object(capfd):
    """--json prints only JSON on standard output, with the same content as the text."""
    assert doctor.doctor(as_json=True) == 0
    keys = {"healthy", "machine", "core", "devices", "extras", "registered", "failures"}
    assert json.loads(capfd.readouterr().out).keys() == keys


def test_extras_are_those_of_the_package():
    """The doctor's extras, and the distributions of each, are those that the package declares."""
    project = pytest.importorskip("tomllib").loads(
        (Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8")
    )["project"]
    declared = {
        extra: {re.split(r"[<>=\[;]", requirement)[0].lower() for requirement in requirements}
        for extra, requirements in project["optional-dependencies"].items()
        if extra not in ("all", "dev")
    }
    assert declared == {name: {d.lower() for d in extra.distributions} for name, extra in EXTRAS.items()}


@pytest.mark.parametrize("name", EXTRAS)
def test_distributions_and_modules_belong_together(name):
    """Where an extra's distribution is installed, the module that the doctor names for it can be found."""
    for distribution, module in EXTRAS[name].distributions.items():
        try:
            metadata.version(distribution)
        except metadata.PackageNotFoundError:
            continue
        assert find_spec(module) is not None
