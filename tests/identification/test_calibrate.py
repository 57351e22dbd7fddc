"""From a fit to a vehicle: only parameters that the data determine are written, with interval and trials."""

import dataclasses
import io
import json
import math

import numpy as np
import pytest
from rich.console import Console

from finssim.identification.report import fit_json, fit_report, state_text
from finssim.identification.vehicle_file import (
    all_findings,
    calibrated,
    number_in,
    number_origins,
    retained_values,
    write_vehicle,
)
from finssim.trials.findings import CalibrationError
from finssim.vehicles import load_vehicle
from identification.made_fits import SET, made_fit


def test_only_what_the_data_determine_is_written():
    """All other values and origins are kept, including those that could not be identified."""
    fit = made_fit()
    before, after = fit.before, calibrated(fit)
    assert after.hydrodynamic_set("calibrated").linear_damping[0, 0] == 39.1
    assert after.hydrodynamic_set("calibrated").quadratic_damping[5, 5] == 0.47763214
    assert retained_values(fit, after) == {"yaw.d2": 0.47763214, "heave.d1": 80.09677}
    old, new = number_origins(before), number_origins(after)
    moved = {".".join(path) for path in new if new[path] != old[path]}
    assert moved == {
        f"{SET}.added_mass.0",
        f"{SET}.linear_damping.0",
        *(f"thrusters.{name}.time_constant" for name in before.thrusters),
    }
    origin = after.origin_of(f"{SET}.linear_damping.0")
    assert origin == (
        "measured",
        "calibration 1: hydrodynamics by simulation on 2 trials",
        "95 % interval 37.9 to 40.2",
    )
    assert after.origin_of(f"{SET}.linear_damping.0.0") == origin
    assert after.origin_of("thrusters.V_LB.time_constant").note == "95 % interval 0.1 to 0.2"
    assert before.calibrations == ()


def test_a_matrix_given_whole_marks_the_entries_that_moved():
    """A fit may return a full matrix: entries that it did not change keep their origin."""
    D1 = np.array(load_vehicle("finsrov").hydrodynamic_set("calibrated").linear_damping)
    D1[0, 0], D1[1, 5], D1[5, 1] = 39.1, 0.5, 0.25
    after = calibrated(made_fit(changes={f"{SET}.linear_damping": D1}))
    for entry in ("0.0", "1.5", "5.1"):
        assert after.origin_of(f"{SET}.linear_damping.{entry}").origin == "measured"
    assert after.origin_of(f"{SET}.linear_damping.1.1").origin == "published"
    assert after.origin_of(f"{SET}.linear_damping.3.3").note == "unmeasured placeholder"


def test_groups_may_name_their_thrusters():
    """An estimate for a propeller group appears in the note of each of its thrusters, and of no other."""
    fit = made_fit()
    one = dataclasses.replace(
        fit.estimates["surge.d1"],
        name="CC.c_plus",
        estimate=9.5e-5,
        ci95=(9.4e-5, 9.6e-5),
        path="thruster_groups.CC.c_plus",
    )
    thrusters = [name for name, t in fit.before.thrusters.items() if t.group == "CC"]
    fit = dataclasses.replace(
        fit,
        kind="thruster",
        estimates={"CC.c_plus": one},
        changes={f"thrusters.{n}.c_plus": 9.5e-5 for n in thrusters},
    )
    after = calibrated(fit)
    assert after.origin_of("thrusters.V_LB.c_plus").note == "95 % interval 9.4e-05 to 9.6e-05"
    assert after.origin_of("thrusters.V_LF.c_plus").origin == "published"
    assert "2 tables" in after.calibrations[0].sentence()


def test_calibrations_follow_each_other(tmp_path):
    """Thruster, motor and hydrodynamics in sequence, through files: all records are kept, oldest first."""
    vehicle = load_vehicle("finsrov")
    for i, kind in enumerate(("thruster", "motor", "hydrodynamics")):
        fit = made_fit(vehicle, kind=kind, trials={f"trial {i}": f"{i}" * 64})
        write_vehicle(calibrated(fit), tmp_path / f"{kind}.yaml")
        vehicle = load_vehicle(tmp_path / f"{kind}.yaml")
    assert [record.kind for record in vehicle.calibrations] == ["thruster", "motor", "hydrodynamics"]
    assert all(vehicle.fitted_on(f"{i}" * 64) for i in range(3)) and not vehicle.fitted_on("3" * 64)
    assert vehicle.origin_of(f"{SET}.linear_damping.0").source.startswith("calibration 3: hydrodynamics")
    assert vehicle.calibrations[1].start == load_vehicle(tmp_path / "thruster.yaml").sha256


def test_equal_fits_make_equal_files(tmp_path):
    """Files of equal fits are equal, since they contain no clock time."""
    for name in ("a.yaml", "b.yaml"):
        write_vehicle(calibrated(made_fit()), tmp_path / name)
    assert (tmp_path / "a.yaml").read_bytes() == (tmp_path / "b.yaml").read_bytes()


def test_an_interrupted_fit_says_so(tmp_path):
    """The interruption is noted in the record and in the origin of every number."""
    write_vehicle(calibrated(made_fit(interrupted=True)), tmp_path / "v.yaml")
    vehicle = load_vehicle(tmp_path / "v.yaml")
    assert vehicle.calibrations[0].interrupted
    assert "(interrupted)" in vehicle.origin_of(f"{SET}.linear_damping.0").source


def test_estimates_that_no_vehicle_can_have_are_refused():
    """A mass matrix that is not positive definite is refused in a sentence."""
    with pytest.raises(CalibrationError, match="do not form a valid vehicle: .*not positive definite"):
        calibrated(made_fit(changes={f"{SET}.added_mass.0.0": -400.0}))


def test_an_unphysical_vehicle_is_reported():
    """Damping that adds energy is a finding, which the parent vehicle did not have."""
    fit = made_fit(
        changes={f"{SET}.linear_damping.1.1": -4.0}, quality={"sway": {"r2": -0.5}, "surge": {"r2": 0.9}}
    )
    *own, damping, quality = all_findings(fit, calibrated(fit))
    assert own == list(fit.findings)
    assert (damping.code, damping.values["check"]) == ("check_failed", "damping (calibrated)")
    assert (quality.code, quality.subject) == ("further_than_mean", "sway")
    nothing = made_fit(changes={})
    *own, last = all_findings(nothing, calibrated(nothing))
    assert (own, last.code) == (list(nothing.findings), "nothing_determined")
    assert calibrated(nothing).sha256 == nothing.vehicle.sha256


def test_json_has_the_keys_of_the_contract():
    """Every parameter has estimate, ci95, unit, identifiable and note; non-finite values are null."""
    fit = made_fit()
    found = json.loads(json.dumps(fit_json(fit, calibrated(fit), findings=fit.findings), allow_nan=False))
    assert found.keys() >= {
        "kind", "method", "vehicle", "parameters", "quality", "correlation", "findings", "trials", "out", "provenance",
    }  # fmt: skip
    assert list(found["parameters"]) == list(fit.estimates)
    for parameter in found["parameters"].values():
        assert parameter.keys() == {"estimate", "ci95", "unit", "identifiable", "note"}
    assert found["parameters"]["surge.d1"]["ci95"] == [37.9, 40.2]
    assert found["parameters"]["heave.d1"]["ci95"] == [None, None]
    assert found["settings"]["seed"] == 4


def test_the_table_fits_a_hundred_columns():
    """Every parameter, its interval, the file's value and the outcome are on lines of 100 columns at most."""
    fit = made_fit()
    text = io.StringIO()
    fit_report(fit, calibrated(fit), fit.findings).show(Console(file=text, width=100))
    lines = text.getvalue().splitlines()
    assert max(map(len, lines)) <= 100
    (row,) = (line for line in lines if line.strip().startswith("surge.d1"))
    assert all(word in row for word in ("39.1", "37.9 to 40.2", "N s/m", "39.07", "written"))
    (row,) = (line for line in lines if line.strip().startswith("yaw.d2 "))
    assert "file kept" in row and "0.4776" in row
    assert "heave.d1: no speed" in text.getvalue() and math.isnan(fit.estimates["heave.d1"].ci95[1])


def test_a_thrust_scale_is_the_note_of_what_it_multiplies():
    """The notes of coefficients and limits of every thruster state their scale."""
    vehicle = load_vehicle("finsrov")
    changes = {f"thrusters.{name}.c_plus": 0.97 * t.c_plus for name, t in vehicle.thrusters.items()}
    fit = made_fit(changes=changes)
    after = calibrated(fit)
    note = after.origin_of("thrusters.V_LB.c_plus").note
    assert note == "from thrust_scale 0.97 -, 95 % interval 0.95 to 0.99"
    assert after.origin_of("thrusters.V_LB.c_minus").origin == "published"
    assert state_text(fit.estimates["thrust_scale"], fit, after) == "written"
    unsure = dataclasses.replace(fit.estimates["thrust_scale"], identifiable=False)
    assert state_text(unsure, fit, after) == "unsure"


def test_a_coupling_of_a_diagonal_matrix_was_zero(tmp_path):
    """The file's missing entry counts as zero; its row is readable however long the notes are."""
    fit = made_fit(changes={f"{SET}.linear_damping.1.5": 0.5})
    after = calibrated(fit)
    assert number_in(fit.before, f"{SET}.linear_damping.1.5") == 0.0
    assert number_in(after, f"{SET}.linear_damping.1.5") == 0.5
    write_vehicle(after, tmp_path / "v.yaml")
    assert max(map(len, (tmp_path / "v.yaml").read_text("utf-8").splitlines())) < 250
    assert load_vehicle(tmp_path / "v.yaml").sha256 == after.sha256


def test_a_part_of_the_drag_is_written_as_unsure():
    """Linear and quadratic damping are written together where only their sum is identifiable."""
    fit = made_fit(
        changes={f"{SET}.linear_damping.5.5": 0.4, f"{SET}.quadratic_damping.5.5": 0.1},
    )
    after = calibrated(fit)
    assert after.hydrodynamic_set("calibrated").quadratic_damping[5, 5] == 0.1
    assert state_text(fit.estimates["yaw.d2"], fit, after) == "unsure"
    assert after.origin_of(f"{SET}.quadratic_damping.5").note == "95 % interval 0 to 9; is at its bound"
    assert "yaw.d2" not in retained_values(fit, after)
