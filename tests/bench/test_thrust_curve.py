"""Thrust curves: tables of benches and manufacturers, c± with valid intervals, and the resulting vehicle."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from finssim.bench.curves import dead_zone, fit_side
from finssim.bench.tables import read_table
from finssim.bench.thruster import fit_thruster
from finssim.trials.findings import CalibrationError
from finssim.vehicles import check_vehicle, load_vehicle

T200 = Path(__file__).parents[1] / "data" / "t200"
AT_16_V = T200 / "t200_16V_bluerobotics_2019.csv"
ALL_VOLTAGES = T200 / "t200-thrust-2019.csv"
FINSROV, BLUEROV2 = load_vehicle("finsrov"), load_vehicle("bluerov2")
RPM = math.pi / 30.0


def made(c_plus=1.1e-4, c_minus=0.9e-4, fastest=2600.0, slowest=300.0, rows=40, noise=0.05, seed=0):
    """Return speeds [rpm] and thrusts [N] of a synthetic thruster, in both directions and at standstill."""
    rng = np.random.default_rng(seed)
    speeds = np.linspace(slowest, fastest, rows)
    rpm = np.concatenate([-speeds[::-1], [0.0, 0.0, 0.0], speeds])
    omega = rpm * RPM
    force = np.where(omega >= 0.0, c_plus, c_minus) * omega * np.abs(omega)
    return rpm, force + noise * rng.standard_normal(len(rpm)) * (rpm != 0.0)


def write(path, header, *columns):
    lines = [header, *(",".join(repr(float(x)) for x in row) for row in zip(*columns, strict=True))]
    path.write_text("\n".join(lines))
    return path


# -- reading ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("header", "speed_unit", "force_unit"),
    [
        ("RPM,Thrust (kgf)", RPM, 9.80665),
        ("speed_rpm,thrust_N", RPM, 1.0),
        ("omega [rad/s],force [N]", 1.0, 1.0),
        ("Shaft speed (1/min),Load (g)", RPM, 9.80665e-3),
        ("Motor Optical Speed (RPM),Thrust (lbf)", RPM, 4.4482216),
        ("rotation rev/s,force kgf", 2 * math.pi, 9.80665),
        ("shaft_speed_rad_s,thrust_force_N", 1.0, 1.0),
        ("motor_shaft_speed_rpm,measured_thrust_kgf", RPM, 9.80665),
    ],
)
def test_units_are_read_from_the_headers(tmp_path, header, speed_unit, force_unit):
    rpm, force = made(noise=0.0)
    table = read_table(write(tmp_path / "a.csv", header, rpm * RPM / speed_unit, force / force_unit))
    np.testing.assert_allclose(table.speed, rpm * RPM, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(table.force, force, rtol=1e-6, atol=1e-9)


def test_the_unit_is_the_last_word_of_a_header(tmp_path):
    rpm, force = made(noise=0.0)
    table = read_table(
        write(
            tmp_path / "a.csv",
            "log_time_s,rpm,thrust_N,battery_voltage_mV",
            np.arange(len(rpm)),
            rpm,
            force,
            0 * rpm + 7400.0,
        )
    )
    np.testing.assert_allclose(table.voltage, 7.4)


def test_an_empty_pulse_leaves_the_sign_to_the_force(tmp_path):
    rpm, force = made(noise=0.0)
    pulse = np.where(np.arange(len(rpm)) % 3 == 0, 1500.0 + rpm / 8.0, np.nan)
    table = read_table(write(tmp_path / "a.csv", "RPM,Thrust (N),PWM (µs)", np.abs(rpm), force, pulse))
    np.testing.assert_allclose(table.speed, rpm * RPM, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("path", [AT_16_V, ALL_VOLTAGES], ids=lambda path: path.stem)
def test_the_published_t200_tables_are_read_with_signs(path):
    """Speeds, printed by the manufacturer without sign, get signs: forward pulses give forward thrust."""
    table = read_table(path)
    turning = table.speed != 0.0
    np.testing.assert_array_equal(np.sign(table.speed[turning]), np.sign(table.pulse[turning] - 1500.0))
    assert table.force.max() == pytest.approx(51.48 if path == AT_16_V else 65.92, abs=0.01)


@pytest.mark.parametrize("unsigned", ["speed", "force", "both"])
def test_signs_come_from_what_has_them(tmp_path, unsigned):
    """Speeds without sign follow the forces, forces without sign the speeds, and both together the pulse."""
    rpm, force = made(noise=0.0)
    pulse = 1500.0 + rpm / 8.0
    shown = {
        "speed": (np.abs(rpm), force),
        "force": (rpm, np.abs(force)),
        "both": (np.abs(rpm), np.abs(force)),
    }
    columns = (*shown[unsigned], pulse) if unsigned == "both" else shown[unsigned]
    header = "RPM,Thrust (N)" + (",PWM (µs)" if unsigned == "both" else "")
    table = read_table(write(tmp_path / "a.csv", header, *columns))
    order = np.argsort(table.speed)
    large = np.abs(table.force[order]) > 0.2
    np.testing.assert_array_equal(np.sign(table.force[order])[large], np.sign(table.speed[order])[large])
    assert table.force.min() == pytest.approx(force.min()) and table.force.max() == pytest.approx(force.max())


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("RPM,Thrust\n1,2\n2,3\n3,4\n", r"'Thrust' has no unit.*one of N, kgf.*'Thrust \(N\)'"),
        ("a,b\n1,2\n2,3\n", "no column of force among a, b: rename one"),
        ("1,2\n2,3\n3,4\n", "expected a header line"),
        ("RPM (rpm),RPM 2 (rpm),Thrust (N)\n1,1,2\n2,2,3\n3,3,4\n", "speed could be .*: rename the column"),
        (
            "RPM,Thrust (N)\n500,-1\n-600,2\n700,-3\n",
            "force is negative where speed is positive: turn the sign of the column 'Thrust",
        ),
        ("RPM,Thrust (N)\n1,2\n", "1 rows hold numbers, expected at least 3"),
        ("PWM,Thrust (N)\n-1,-9\n0,0\n0.5,2\n1,9\n", "expected 500 to 2500 µs"),
        (
            "RPM,Thrust (N)\n500,1\n600,1e300\n700,3\n",
            r"forces run from 1 to 1e\+300 N, expected -1e\+06 to 1e\+06 N",
        ),
        (
            "RPM,Voltage (V),Thrust (N)\n500,1e300,1\n600,16,2\n700,16,3\n",
            r"voltages run .*expected 0 to 10000 V",
        ),
    ],
)
def test_what_can_be_read_in_two_ways_is_refused(tmp_path, text, said):
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(CalibrationError, match=said):
        read_table(path)


@pytest.mark.parametrize("separator", [";", "\t"])
def test_decimal_commas_and_a_line_of_units_are_understood(tmp_path, separator):
    rows = [["speed", "force"], ["[rpm]", "[N]"], ["500,5", "0,25"], ["1000,0", "1,0"], ["2000,0", "4,0"]]
    (tmp_path / "a.csv").write_text(
        "# bench 3\n" + "\n".join(separator.join(row) for row in rows), encoding="latin-1"
    )
    table = read_table(tmp_path / "a.csv")
    np.testing.assert_allclose(table.speed / RPM, [500.5, 1000.0, 2000.0])


def test_a_log_of_held_levels_gives_its_settled_parts(tmp_path):
    """The last 2 s of levels of 5 s count (facts §19), with an offset load cell and a motor that needs 0.3 s."""
    rng = np.random.default_rng(1)
    levels = np.repeat([0, 800, 1400, 2000, 2600, 0, -800, -1400, -2000, -2600, 0], 100).astype(float)
    rpm = np.zeros_like(levels)
    for i in range(1, len(rpm)):
        rpm[i] = rpm[i - 1] + (levels[i] - rpm[i - 1]) * (1 - math.exp(-0.05 / 0.3))
    omega = rpm * RPM
    force = 1.1e-4 * omega * np.abs(omega) + 0.4
    lagged = np.convolve(
        np.r_[np.full(9, 0.4), force], np.full(10, 0.1), "valid"
    )  # the load cell averages over 0.5 s
    path = write(
        tmp_path / "log.csv",
        "time (s),rpm,force (N)",
        np.arange(len(rpm)) * 0.05,
        rpm + 5 * rng.standard_normal(len(rpm)),
        lagged,
    )
    table = read_table(path)
    assert len(table.speed) == 11
    fit = fit_thruster([replace(table, name="V_LF")], FINSROV)
    assert fit.estimates["V_LF.c_plus"].estimate == pytest.approx(1.1e-4, rel=5e-3)
    assert [one.values["offset"] for one in fit.findings if one.code == "load_cell_offset"] == [
        pytest.approx(0.4, abs=0.005)
    ]


def test_a_slow_sweep_is_used_row_by_row(tmp_path):
    rng = np.random.default_rng(2)
    rpm = np.concatenate([np.linspace(0, 2600, 900), np.linspace(2600, 0, 900)])
    force = 1.1e-4 * (rpm * RPM) ** 2 + 0.1 * rng.standard_normal(1800)
    path = write(
        tmp_path / "V_LF.csv",
        "t,rpm,force (N)",
        np.arange(1800) * 0.2,
        rpm + 5 * rng.standard_normal(1800),
        force,
    )
    fit = fit_thruster([path], FINSROV)
    assert fit.estimates["V_LF.c_plus"].estimate == pytest.approx(1.1e-4, rel=0.01)
    dead = fit.estimates["V_LF.dead_rpm_plus"]
    assert not dead.identifiable, "a continuous sweep shows no gap"


# -- the curve ----------------------------------------------------------------------------------------------------


@given(c=st.floats(1e-5, 1e-2), slowest=st.floats(5.0, 50.0), rows=st.integers(5, 60))
def test_an_exact_curve_is_recovered_exactly(c, slowest, rows):
    omega = np.linspace(slowest, 280.0, rows)
    side = fit_side([(omega, c * omega**2)])
    assert side.c == pytest.approx(c, rel=1e-9) and side.half_width < 1e-6 * c


@pytest.mark.parametrize(("alike", "least"), [(0.0, 0.92), (0.9, 0.85)], ids=["white", "neighbours alike"])
def test_the_interval_covers_the_truth(alike, least):
    """95 % intervals cover the truth in 300 tables of 80 rows, even where neighbouring residuals are correlated."""
    rng, omega, hits = np.random.default_rng(3), np.linspace(30.0, 280.0, 80), 0
    for _ in range(300):
        error = rng.standard_normal(80)
        for i in range(1, 80):
            error[i] = alike * error[i - 1] + math.sqrt(1.0 - alike**2) * error[i]
        side = fit_side([(omega, 1.1e-4 * omega**2 + 0.1 * error)])
        hits += abs(side.c - 1.1e-4) < side.half_width
    assert least <= hits / 300 <= 0.995


def test_tables_that_disagree_widen_the_interval():
    """Four thrusters, each consistent but 5 % apart from each other, widen the interval of their group."""
    rng, omega = np.random.default_rng(4), np.linspace(30.0, 280.0, 60)
    tables = [
        (omega, c * omega**2 + 0.02 * rng.standard_normal(60))
        for c in np.array([1.0, 1.05, 1.1, 1.15]) * 1e-4
    ]
    alone, together = fit_side(tables[:1]), fit_side(tables)
    assert together.half_width > 5.0 * alone.half_width
    assert together.c - together.half_width < 1.0e-4 < 1.15e-4 < together.c + together.half_width + 1e-6


def test_a_handful_of_rows_is_a_table():
    """Three rows with 2 % of noise give an interval of about a fifth, by t of two degrees of freedom; one row
    gives none."""
    omega = np.array([50.0, 100.0, 150.0])
    side = fit_side([(omega, 1.1e-4 * omega**2 * np.array([1.02, 0.98, 1.01]))])
    assert abs(side.c - 1.1e-4) < side.half_width < 0.5 * 1.1e-4
    assert fit_side([(omega[:1], omega[:1])]).half_width == np.inf


def test_a_stray_row_is_left_out():
    omega = np.linspace(30.0, 280.0, 40)
    force = 1.1e-4 * omega**2
    force[20] = 30.0
    side = fit_side([(omega, force)])
    assert side.rejected == 1 and side.c == pytest.approx(1.1e-4)


def test_a_dead_zone_shows_only_where_the_table_goes_there():
    """A gap between standstill and the slowest speed is a dead zone if the speeds above it are much closer together."""
    above = np.linspace(32.0, 280.0, 80)
    seen = dead_zone(np.r_[0.0, 0.0, above])
    assert seen.measured and seen.speed == 32.0 and seen.interval[0] < 32.0
    assert not dead_zone(above).measured, "no standstill in the table"
    assert not dead_zone(np.linspace(0.0, 280.0, 10)).measured, "the next speed is as far again"


# -- the fit ------------------------------------------------------------------------------------------------------


def test_the_published_t200_table_is_described_by_two_numbers():
    """R² >= 0.996; reverse is about 0.8 of forward; the shaft starts at about 300 rpm, 30 µs from neutral."""
    fit = fit_thruster([AT_16_V], BLUEROV2)
    assert fit.quality["T200"]["r2"] >= 0.996
    assert min(fit.quality["T200"]["r2_forward"], fit.quality["T200"]["r2_reverse"]) >= 0.996
    assert fit.estimates["T200.reverse_ratio"].estimate == pytest.approx(0.80, abs=0.01)
    assert fit.estimates["T200.dead_rpm_plus"].estimate == pytest.approx(308.0)
    assert fit.estimates["T200.dead_rpm_minus"].estimate == pytest.approx(-317.0)
    assert fit.estimates["T200.esc.dead_plus"].ci95 == (1528.0, 1532.0)
    assert fit.estimates["T200.esc.dead_minus"].ci95 == (1468.0, 1472.0)
    c = BLUEROV2.thrusters["T1"].c_plus
    assert fit.estimates["T200.c_plus"].estimate == pytest.approx(c, rel=2e-3), "the catalogue holds this fit"


def test_the_fit_at_16_v_predicts_the_other_voltages_with_the_error_it_states():
    """Thrust from speed is within 1.7 % of the largest; speed from pulse and voltage within 3.3 % to 16 V, 6
    % to 20 V."""
    fit = fit_thruster([ALL_VOLTAGES], BLUEROV2, voltage=16.0)
    for volts, speed_error in ((10, 0.033), (12, 0.026), (14, 0.014), (16, 0.005), (18, 0.029), (20, 0.060)):
        figures = fit.quality[f"T200 at {volts} V"]
        assert figures["nrmse_thrust_from_speed"] < 0.017 and figures["r2_thrust_from_speed"] > 0.996
        assert figures["nrmse_speed_from_pulse"] < speed_error
    assert [one.values["others"] for one in fit.findings if one.code == "voltage_chosen"] == [
        ("10", "12", "14", "18", "20")
    ]
    alone = fit_thruster([AT_16_V], BLUEROV2)
    assert fit.estimates["T200.c_plus"].estimate == pytest.approx(
        alone.estimates["T200.c_plus"].estimate, rel=1e-3
    )


@pytest.mark.parametrize("name", ["bluerov2", "bluerov2_heavy", "finsrov"])
def test_the_fitted_vehicle_passes_its_checks(name):
    """Force limits follow the curve; the changes load and apply to every thruster of the group."""
    vehicle = load_vehicle(name)
    fitted = vehicle.replace(fit_thruster([AT_16_V], vehicle).changes)
    failed = {f.name for f in check_vehicle(fitted) if not f.passed} - {
        f.name for f in check_vehicle(vehicle) if not f.passed
    }
    assert not failed
    for thruster in fitted.thrusters.values():
        assert thruster.force_max == pytest.approx(float(thruster.thrust(thruster.rpm_max * RPM)), rel=1e-6)
        assert thruster.esc.shaft_speed(1900.0, 16.0) == pytest.approx(thruster.rpm_max * RPM, rel=0.01)


def test_groups_and_thrusters_are_told_by_file_names(tmp_path):
    """Two propeller groups of one vehicle get separate curves."""
    paths = [
        write(
            tmp_path / f"run1_{name}.csv",
            "RPM,Thrust (N)",
            *made(c_plus=c, c_minus=0.8 * c, seed=int(1e7 * c)),
        )
        for name, c in (("CC", 0.9e-4), ("CCW", 1.2e-4))
    ]
    fit = fit_thruster(paths, FINSROV)
    fitted = FINSROV.replace(fit.changes)
    for name, thruster in fitted.thrusters.items():
        c = 0.9e-4 if FINSROV.thrusters[name].group == "CC" else 1.2e-4
        assert thruster.c_plus == pytest.approx(c, rel=0.01) and thruster.c_minus == pytest.approx(
            0.8 * c, rel=0.01
        )
    assert fit.estimates["CC.c_plus"].path == "thruster_groups.CC.c_plus"
    low, high = fit.estimates["CCW.reverse_ratio"].ci95
    assert low < 0.8 < high
    for path, name in zip(paths, ("CC", "CCW"), strict=True):
        (tmp_path / name).mkdir()
        (tmp_path / name / "sweep.csv").write_bytes(path.read_bytes())
    again = fit_thruster([tmp_path / "CC/sweep.csv", tmp_path / "CCW/sweep.csv"], FINSROV)
    assert again.changes == fit.changes and set(again.trials) == {"CC/sweep", "CCW/sweep"}
    one = fit_thruster([paths[0].rename(tmp_path / "H_LF.csv")], FINSROV)
    assert set(one.changes) and all(path.startswith("thrusters.H_LF.") for path in one.changes)


def test_tables_that_name_no_group_warn_on_a_vehicle_with_several():
    fit = fit_thruster([AT_16_V], FINSROV)
    assert "all.c_plus" in fit.estimates and any(
        one.values.get("groups") == ("CC", "CCW") for one in fit.findings
    )


def test_force_and_pulse_without_speed_fit_the_speed_controller_alone(tmp_path):
    """Speeds are those of the vehicle file's curve; pulse -> thrust is right whatever their scale."""
    table = read_table(AT_16_V)
    path = write(
        tmp_path / "a.csv", "PWM (µs),Thrust (N),Voltage (V)", table.pulse, table.force, table.voltage
    )
    fit = fit_thruster([path], BLUEROV2)
    assert "T200.c_plus" not in fit.estimates and any(one.code == "no_shaft_speeds" for one in fit.findings)
    thruster = BLUEROV2.replace(fit.changes).thrusters["T1"]
    error = thruster.thrust(thruster.shaft_speed(table.pulse, 16.0)) - table.force
    assert np.sqrt(np.mean(error**2)) < 0.02 * 51.4
    assert "another_thruster" not in {one.code for one in fit.findings}


@pytest.mark.parametrize("times", [2.0, 0.5])
def test_pulses_of_another_thruster_invent_no_shaft_speeds(tmp_path, times):
    """With twice and half the forces at the same pulses, the thrust is recovered and no speed counts as determined."""
    table = read_table(AT_16_V)
    header = "PWM (µs),Thrust (N),Voltage (V)"
    fit = fit_thruster(
        [write(tmp_path / "a.csv", header, table.pulse, times * table.force, table.voltage)], BLUEROV2
    )
    (found,) = (one for one in fit.findings if one.code == "another_thruster")
    assert found.severity == "care" and found.values["times"] == pytest.approx(times, rel=0.05)
    speeds = [e for name, e in fit.estimates.items() if "rpm_" in name or "emf" in name or "load" in name]
    assert len(speeds) >= 6 and not any(one.identifiable for one in speeds)
    thruster = BLUEROV2.replace(fit.changes).thrusters["T1"]
    error = thruster.thrust(thruster.shaft_speed(table.pulse, 16.0)) - times * table.force
    assert np.sqrt(np.mean(error**2)) < 0.02 * 51.4 * times


def test_a_limit_of_the_vehicle_file_stays_where_the_table_does_not_reach_it(tmp_path):
    """Speeds up to half the limit do not determine the limit; the force there follows the new curve."""
    path = write(tmp_path / "a.csv", "RPM,Thrust (N)", *made(fastest=1300.0))
    fit = fit_thruster([path], FINSROV, group="CCW")
    assert not fit.estimates["CCW.rpm_max"].identifiable
    thruster = FINSROV.replace(fit.changes).thrusters["V_LF"]
    assert thruster.rpm_max == FINSROV.thrusters["V_LF"].rpm_max
    assert thruster.force_max == pytest.approx(1.1e-4 * (thruster.rpm_max * RPM) ** 2, rel=0.02)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"group": "XL"}, "no propeller group 'XL': it has CC, CCW"),
        ({"voltage": 25.0}, "no table at 25 V; there are 16 V"),
    ],
)
def test_names_that_the_vehicle_does_not_have_are_refused(arguments, said):
    with pytest.raises(CalibrationError, match=said):
        fit_thruster([AT_16_V], FINSROV, **arguments)


def test_the_same_table_twice_is_refused():
    with pytest.raises(CalibrationError, match="same numbers are given twice"):
        fit_thruster([AT_16_V, AT_16_V], BLUEROV2)
