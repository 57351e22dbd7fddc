"""The files that publish the project refer to things that exist."""

import re
from pathlib import Path

import pytest
import yaml

from finssim import __version__
from finssim.cli.doctor import EXTRAS

ROOT = Path(__file__).resolve().parents[1]
FILES = sorted((ROOT / ".github").rglob("*.y*ml")) + [ROOT / ".pre-commit-config.yaml", ROOT / "CITATION.cff"]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_it_is_yaml(path):
    """A workflow has jobs of steps, an issue form a body; paths and extras in either exist."""
    text = path.read_text(encoding="utf-8")
    data = yaml.safe_load(text)
    if path.parent.name == "workflows":
        for job in data["jobs"].values():
            assert job["runs-on"] and all({"uses", "run"} & set(step) for step in job["steps"])
    elif path.parent.name == "ISSUE_TEMPLATE" and path.stem != "config":
        assert data["name"] and all(part["type"] == "textarea" for part in data["body"])
    for name in re.findall(r"(?<![\w/])(?:tests|benchmarks|tools|\.ci)/[\w/.]+", text):
        assert (ROOT / name).exists(), name
    for extras in re.findall(r'"\.\[([\w,-]+)\]"', text):
        assert set(extras.split(",")) <= {*EXTRAS, "dev", "all"}
    for target in re.findall(r"run: make (\w+)", text):
        assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)


def test_the_citation_is_of_this_version():
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))["version"] == __version__


def test_a_container_gets_what_its_image_copies():
    """.dockerignore lets through every path that the image copies."""
    seen = re.findall(r"^!(.+)", (ROOT / ".dockerignore").read_text(encoding="utf-8"), re.MULTILINE)
    copied = re.findall(r"^COPY (.+) \S+$", (ROOT / "Dockerfile").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(seen) == sorted(" ".join(copied).split())
    assert all((ROOT / name).exists() for name in seen)
