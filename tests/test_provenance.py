"""The origin of an artefact can be read back from it."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import finssim
from finssim.core.provenance import provenance

ROOT = Path(__file__).resolve().parents[1]


def test_provenance_survives_json_and_yaml():
    """Provenance consists of plain values."""
    origin = provenance()
    assert json.loads(json.dumps(origin)) == origin == yaml.safe_load(yaml.safe_dump(origin))
    assert origin["finssim"] == finssim.__version__ and "numpy" in origin["packages"]


def test_the_revision_is_the_checkout_s_commit():
    """In a checkout the revision is HEAD, marked if the source differs from it."""
    head = subprocess.run(["git", "-C", ROOT, "rev-parse", "HEAD"], capture_output=True, text=True)
    revision = provenance()["revision"]
    if head.returncode:  # an unpacked archive
        assert revision is None
    else:
        assert revision.removesuffix("+modified") == head.stdout.strip()


@pytest.mark.slow
def test_an_installed_copy_does_not_claim_another_project_s_revision(tmp_path):
    """A package installed inside someone else's repository reports no revision."""
    package = tmp_path / "site-packages" / "finssim"
    (package / "core").mkdir(parents=True)
    for name in ("__init__.py", "core/__init__.py", "core/lazy.py", "core/provenance.py"):
        (package / name).write_text((ROOT / "src" / "finssim" / name).read_text())
    git = ["git", "-C", tmp_path, "-c", "user.name=a", "-c", "user.email=a@b"]
    subprocess.run([*git, "init", "-q"], check=True)
    subprocess.run([*git, "commit", "-q", "--allow-empty", "-m", "x"], check=True)
    script = "import sys; sys.path.insert(0, sys.argv[1]); from finssim.core.provenance import *; print(provenance())"
    run = subprocess.run(
        [sys.executable, "-B", "-c", script, package.parent],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
    )
    assert "'revision': None" in run.stdout
