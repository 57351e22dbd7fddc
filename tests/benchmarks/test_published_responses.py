"""Simulated and published steady speeds."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.published_responses import ValidationError, simulate_responses, validate
from finssim.vehicles import load_vehicle

ROOT = Path(__file__).resolve().parents[2]
FINSROV = load_vehicle("finsrov")


@pytest.fixture(scope="module")
def responses() -> dict[str, dict]:
    """Responses of the calibrated model by name."""
    return {r["name"]: r for r in simulate_responses(FINSROV)["responses"]}


@pytest.mark.parametrize(
    ("name", "axis"),
    [("surge +18 N", 0), ("sway 18 N", 1), ("yaw 1 N m", 5), ("yaw 8 N m", 5), ("heave -12 N", 2)],
)
def test_simulated_speeds_solve_the_published_drag(responses: dict[str, dict], name: str, axis: int) -> None:
    """d1 v + d2 v² = applied force at the steady speed, with the coefficients of the file.

    Tolerance: 1 %; net buoyancy (0.084 N of 12 N) in heave, and the last 0.02 % of the approach after 8 time constants.
    """
    r, hydro = responses[name], FINSROV.hydrodynamics["calibrated"]
    d1, d2 = hydro.linear_damping[axis, axis], hydro.quadratic_damping[axis, axis]
    v = abs(r["simulated"])
    assert d1 * v + d2 * v * v == pytest.approx(abs(r["applied"]), rel=0.01)


def test_what_agrees_and_what_does_not(responses: dict[str, dict]) -> None:
    """Forward surge, sway and fast yaw agree with the pool within 15 %; heave is several times too fast, with
    a reason."""
    agreeing = {name for name, r in responses.items() if r["agrees"]}
    assert agreeing == {"surge +18 N", "sway 18 N", "yaw 8 N m"}
    heave = responses["heave -12 N"]
    assert abs(heave["simulated"]) > 2.0 * heave["measured"][1] and "do not say why" in heave["why"]


def test_applied_is_what_the_thrusters_give(responses: dict[str, dict]) -> None:
    """8 N m of yaw exceeds the weaker direction's 6.95 N m (published capability); 18 N of surge is within reach."""
    assert responses["yaw 8 N m"]["applied"] == pytest.approx(6.9477, abs=2e-3)
    assert responses["surge +18 N"]["applied"] == pytest.approx(18.0, rel=1e-3)


def test_another_model_gives_other_speeds(responses: dict[str, dict]) -> None:
    """Another model gives other speeds, and the result names it."""
    result = validate("finsrov", hydrodynamics="simplified")
    assert result["hydrodynamics"] == "simplified"
    assert [r["simulated"] for r in result["responses"]] != [r["simulated"] for r in responses.values()]


def script(*words: str) -> subprocess.CompletedProcess[str]:
    """Run the script in a separate process."""
    command = [sys.executable, "benchmarks/published_responses.py", *words]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


@pytest.mark.slow
def test_the_script_prints_one_object() -> None:
    """--json prints one JSON object with every response, its verdict and the vehicle's hash."""
    out = json.loads(script("--json").stdout)
    assert out["vehicle"]["sha256"] == FINSROV.sha256
    assert len(out["responses"]) == 6 and all(np.isfinite(r["simulated"]) for r in out["responses"])
    assert {"yaw", "surge", "sway", "heave"} == {response["axis"] for response in out["responses"]}
    assert all({"simulated", "measured", "agrees"} <= response.keys() for response in out["responses"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("rexrov",), "no published responses of 'rexrov' to compare with; available: finsrov"),
        (("finsrov", "--hydrodynamics", "fosen"), "unknown hydrodynamic model 'fosen'"),
    ],
)
def test_the_script_refuses_in_a_sentence(words: tuple[str, ...], sentence: str) -> None:
    """A refusal has exit status 2 and one line on standard error."""
    done = script(*words)
    assert done.returncode == 2 and done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"finssim: {sentence}")


def test_a_vehicle_without_published_responses_is_refused() -> None:
    """The sentence names the vehicles with published responses."""
    with pytest.raises(ValidationError, match="no published responses of 'lauv'.*finsrov"):
        validate("lauv")
