"""`trials check` finds what is wrong with a log, and reports what it can and cannot identify."""

import json
import re
from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from finssim.identification.excitation import excited
from finssim.identification.programme import programmes
from finssim.identification.simulation_error import prepare
from finssim.identification.synthetic import simulate_programme
from finssim.trials.check import check, check_trials
from finssim.trials.findings import CalibrationError
from finssim.trials.free_motion import compared_columns
from finssim.trials.trial import TAU, Header, Trial
from finssim.trials.trial_files import write_trial
from finssim.trials.trial_report import print_reports, set_findings
from finssim.vehicles import load_vehicle

VEHICLE = load_vehicle("bluerov2_heavy")
NAMES = ("surge_plus_70", "heave_dive_55", "roll_plus_3.2", "yaw_minus_8.8")
COLUMNS = ("u", "v", "w", "p", "q", "r", "ax", "ay", "az", "roll", "pitch", "yaw", "x", "y", "z", "depth")


@pytest.fixture(scope="module")
def simulated():
    """Simulated trials with the noise of the vehicle's sensors, by axis."""
    every = {
        p.name: p
        for p in programmes(
            ["surge", "heave", "roll", "yaw"], VEHICLE, seed=3, levels={"surge": (41.0, 70.0, 123.0)}
        )
    }
    trials = simulate_programme(
        [every[name] for name in NAMES], VEHICLE, seed=3, columns=COLUMNS, inputs=("wrench",)
    )
    return {trial.name.split("_")[0]: trial for trial in trials}


def changed(trial, header=None, **columns):
    """Return the trial with columns replaced by functions of them, or removed by None."""
    channels = dict(trial.channels)
    for name, change in columns.items():
        if change is None:
            del channels[name]
        else:
            channels[name] = change(channels[name])
    new = trial.header.model_copy(update=header) if header else trial.header
    return replace(trial, channels=channels, header=new)


REPORTS = {}
"""Reports of checked trials by identity; the trials are kept so that no identity is reused."""


def report(trial, vehicle=VEHICLE):
    """Return the report of a trial, computed once."""
    key = (id(trial), vehicle.sha256)
    if key not in REPORTS:
        REPORTS[key] = trial, check_trials([trial], vehicle)[0]
    return REPORTS[key][1]


def axis(trial, name, vehicle=VEHICLE):
    return next(a for a in report(trial, vehicle).axes if a.axis == name)


def said(findings, code, severity=None):
    """Return the values of the findings with a code, and with a severity if given."""
    return [one.values for one in findings if one.code == code and severity in (None, one.severity)]


def told(trial, code, severity=None, vehicle=VEHICLE):
    return said(report(trial, vehicle).findings, code, severity)


def negative(x):
    return -x


@pytest.mark.slow
@pytest.mark.parametrize("name", ["surge", "heave", "roll", "yaw"])
def test_a_good_trial_is_usable_and_tells_its_axis(simulated, name):
    """There are no complaints; mass and both dampings are identifiable on the driven axis, nothing on an axis
    at rest."""
    found = report(simulated[name])
    assert found.verdict == "usable", found.findings
    mine = axis(simulated[name], name)
    assert mine.excited and all(mine.identifiability[p].identifiable for p in ("m_eff", "d1", "d2"))
    idle = axis(simulated[name], "sway")
    assert not idle.excited and not any(told.identifiable for told in idle.identifiability.values())


def test_a_dive_and_coast_tells_buoyancy_and_a_roll_pulse_the_restoring_moment(simulated):
    """Only these trials can identify them."""
    assert axis(simulated["heave"], "heave").identifiability["buoyancy"].identifiable
    assert axis(simulated["roll"], "roll").identifiability["k"].identifiable
    assert "k" not in axis(simulated["yaw"], "yaw").identifiability


WRONG = {
    "gravity downwards": ("surge", {"ax": negative, "ay": negative, "az": negative}, "gravity_wrong_way", {}),
    "in g": (
        "surge",
        {a: (lambda y: y / 9.80665) for a in ("ax", "ay", "az")},
        "acceleration_unit",
        {"unit": "g"},
    ),
    "pitch rate turned": ("surge", {"q": negative}, "rate_sign", {"column": "q", "other": "pitch"}),
    "yaw turned": ("yaw", {"yaw": negative}, "rate_sign", {"column": "r", "other": "yaw"}),
    "speed in mm/s": ("surge", {"u": lambda y: 1000.0 * y}, "speed_unit", {"column": "u"}),
    "rate in degrees": ("yaw", {"r": np.degrees}, "degrees", {"column": "r"}),
    "roll in degrees": ("roll", {"roll": np.degrees}, "degrees", {"column": "roll"}),
    "heave turned": ("heave", {"w": negative}, "rate_sign", {"column": "w", "other": "z"}),
    "z downwards": ("heave", {"z": negative}, "z_down", {}),
    "force turned": ("surge", {"tau_x": negative}, "energy_taken", {"wrench": "tau_x", "velocity": "u"}),
    "moment turned": ("yaw", {"tau_n": negative}, "energy_taken", {"wrench": "tau_n", "velocity": "r"}),
    "roll of the accelerometer turned": (
        "roll",
        {"ay": negative},
        "acceleration_sign",
        {"column": "ay", "angle": "roll"},
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", WRONG)
def test_wrong_signs_and_units_are_refused(simulated, case):
    """One changed convention in a good trial is found and named, and the trial is unusable."""
    name, columns, code, values = WRONG[case]
    trial = changed(simulated[name], **columns)
    assert report(trial).verdict == "refused"
    assert any(values.items() <= given.items() for given in told(trial, code, "refused")), report(
        trial
    ).findings


def test_a_heading_that_is_turned_against_the_position_is_found(simulated):
    """The x axis of the motion capture and the compass differ by 90 degrees."""
    trial = changed(simulated["surge"], yaw=lambda y: y + np.pi / 2)
    (disagreement,) = told(trial, "heading_disagrees", "care")
    assert disagreement["angle"] == pytest.approx(-90.0, abs=2.0)


def test_noise_of_the_heading_is_not_taken_for_a_wrong_sign():
    """With 1.4 degrees of noise on a heading that hardly moves, changes of the smoothed heading are mostly
    noise."""
    for seed in (7, 15, 26, 27, 47, 53, 117):
        rng = np.random.default_rng(seed)
        t = np.arange(0.0, 8.0, 0.2)
        r = 0.004 * np.sin(2.0 * np.pi * (t / rng.uniform(4.0, 12.0) + rng.random()))
        yaw = 0.2 * np.cumsum(r) + 0.025 * rng.standard_normal(len(t))
        channels = {"r": r + 0.001 * rng.standard_normal(len(t)), "yaw": yaw}
        assert not told(Trial(name=f"drift_{seed}", t=t, channels=channels), "rate_sign")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bluerov2_einarsson", "bluerov2_heavy_morgan"])
def test_the_buoyancy_of_the_vehicle_file_is_not_taken_for_a_wrong_sign(name):
    """Pushes of 2 % against a buoyancy of 4 N and against a weight of 7 N: the inputs remove energy from
    heave."""
    vehicle = load_vehicle(name)
    weak = programmes(["heave"], vehicle, levels={"heave": (0.02 * vehicle.wrench_limits[2],)})
    trials = simulate_programme(weak, vehicle, seed=3, columns=COLUMNS, inputs=("wrench",))
    found = [told(trial, "energy_taken", vehicle=vehicle) for trial in trials]
    assert not any(found)


def test_a_depth_in_another_unit_is_told(simulated):
    """Feet and centimetres are detected, against z and against w."""
    trial = simulated["heave"]
    (against_z,) = told(changed(trial, depth=lambda d: d / 0.3048), "speed_ratio", "care")
    assert against_z["ratio"] == pytest.approx(0.3048, abs=0.02)
    (against_w,) = told(changed(trial, z=None, depth=lambda d: 100.0 * d), "speed_ratio", "care")
    assert against_w["ratio"] == pytest.approx(100.0, rel=0.1) and against_w["velocity"] == "w"


def test_a_heading_that_samples_slowly_or_a_vehicle_on_its_nose_has_no_drift():
    """A turn of 4 rad/s with a heading at 1 Hz, and a somersault, in which the heading jumps by half a turn."""
    t = np.arange(0.0, 20.0, 0.02)
    spin = Trial(
        name="spin",
        t=t,
        channels={"r": np.full(len(t), 4.0), "yaw": np.where(np.arange(len(t)) % 50, np.nan, 4.0 * t % 6.28)},
    )
    assert not told(spin, "heading_drift")
    angle = 0.5 * t
    flip = {"qy": np.sin(0.5 * angle), "qw": np.cos(0.5 * angle), "qx": 0.0 * t, "qz": 0.0 * t}
    rates = {"p": 0.0 * t, "q": 0.0 * t + 0.5, "r": 0.0 * t}
    assert not told(Trial(name="somersault", t=t, channels=flip | rates), "heading_drift")


def test_a_vehicle_that_rolls_without_a_measured_tilt_is_not_taken_as_level():
    """On its back it rises while w is negative; only the gyro shows that it turned over."""
    t = np.arange(0.0, 20.0, 0.05)
    rate = np.where((t > 2.0) & (t < 4.0), 0.5 * np.pi, 0.0)
    roll = 0.05 * np.cumsum(rate)
    rising = 0.2 * np.sin(1.5 * t)
    channels = {"w": rising * np.cos(roll), "z": 0.05 * np.cumsum(rising) - 5.0, "yaw": 0.0 * t}
    trial = Trial(name="over", t=t, channels=channels)
    assert told(trial, "rate_sign")
    turning = replace(trial, channels={**channels, "p": rate, "q": 0.0 * t})
    assert not told(turning, "rate_sign")


def test_five_hertz_with_wrench_and_velocity_only(simulated):
    """With every tenth row and two columns, surge is still identifiable; the lag is not, and other axes have
    no velocity."""
    trial = simulated["surge"]
    rows = slice(None, None, 10)
    trial = replace(
        trial, t=trial.t[rows], phase=None, channels={c: trial.channels[c][rows] for c in ("u", "tau_x")}
    )
    trial = changed(trial, header={"inputs": "commanded"})
    assert report(trial).verdict == "usable", report(trial).findings
    told = axis(trial, "surge").identifiability
    assert told["m_eff"].identifiable and told["d2"].identifiable
    assert "no velocity: neither v nor x, y" in axis(trial, "sway").identifiability["m_eff"].reason


def test_gyro_without_velocity_tells_the_turns_only(simulated):
    """Without u, v, w and position, yaw is identifiable from the gyroscope, surge is not."""
    gone = dict.fromkeys(("u", "v", "w", "x", "y", "z", "depth", "roll", "pitch", "yaw"))
    assert axis(changed(simulated["yaw"], **gone), "yaw").identifiability["d1"].identifiable
    trial = changed(simulated["surge"], **gone)
    assert not any(told.identifiable for told in axis(trial, "surge").identifiability.values())


def test_one_level_without_a_coast_cannot_part_linear_and_quadratic_drag(simulated):
    """The steady part of a step alone is one speed and gives one number, and no mass."""
    trial = simulated["surge"]
    u = trial.series("u")[1]
    steady = np.flatnonzero(np.abs(trial.channels["tau_x"]) > 0.9 * np.abs(trial.channels["tau_x"]).max())[
        200:
    ]
    trial = replace(
        trial,
        t=trial.t[steady],
        phase=None,
        channels={c: v[steady] for c, v in trial.channels.items()},
    )
    told = axis(trial, "surge").identifiability
    assert np.ptp(trial.series("u")[1]) < 0.2 * np.ptp(u)
    assert not told["d1"].identifiable and not told["d2"].identifiable and not told["m_eff"].identifiable
    assert "only their sum" in told["d2"].reason


def test_a_passive_trial_tells_against_the_restoring_moment_only(simulated):
    """The trial is a decaying swing with thrusters off."""
    t = np.arange(0.0, 12.0, 0.02)
    roll = 0.3 * np.exp(-0.3 * t) * np.cos(3.0 * t)
    channels = {"roll": roll, "pitch": 0.0 * t, "p": np.gradient(roll, t), "q": 0.0 * t, "r": 0.0 * t}
    trial = Trial(name="swing", t=t, channels=channels, header=Header(passive=True))
    told = axis(trial, "roll").identifiability
    assert told["m_eff"].identifiable and "restoring moment" in told["m_eff"].reason
    assert not told["k"].identifiable
    assert not axis(trial, "surge").identifiability["m_eff"].identifiable


def test_the_check_of_a_passive_trial_agrees_with_the_fit():
    """Twelve speeds at 1 Hz are enough for both; both reject a spin that does not slow down."""
    t = np.arange(0.0, 12.0)
    for rate, reason in (
        (0.6 / (1.0 + 0.4 * t), ""),
        (np.full(12, 0.6), "yaw does not coast to a lower speed"),
    ):
        trial = Trial(name="spin", t=t, channels={"r": rate}, header=Header(passive=True))
        assert axis(trial, "yaw").identifiability["d1"].reason.startswith(reason)
        assert axis(trial, "yaw").excited is not bool(reason)
        if reason:
            with pytest.raises(CalibrationError, match=reason):
                prepare([trial], VEHICLE, ["yaw"])
        else:
            assert prepare([trial], VEHICLE, ["yaw"])[0][0].released == {"yaw"}


def test_the_check_agrees_with_the_fit_on_swings_and_on_inputs_that_are_zero(simulated):
    """A surge trial with an IMU alone identifies the pitch that it excites; inputs without thrust identify
    nothing."""
    columns = {name: None for name in COLUMNS if name not in ("p", "q", "r", "ax", "ay", "az")}
    for header, swinging in (({"axis": ()}, ("roll", "pitch")), ({"axis": ("surge",)}, ())):
        imu = changed(simulated["surge"], header=header, **columns)
        fitted = excited(prepare([imu], VEHICLE)[0], VEHICLE)
        found = tuple(a.axis for a in report(imu).axes if a.excited)
        assert found == fitted and set(found) <= set(swinging) and bool(found) == bool(swinging)
        assert (report(imu).verdict == "refused") != bool(swinging)
    still = changed(simulated["surge"], **dict.fromkeys(TAU, np.zeros_like))
    (sentence,) = [str(one) for one in report(still).findings if one.code == "inputs_zero"]
    with pytest.raises(CalibrationError, match=re.escape(sentence)):
        prepare([still], VEHICLE)
    used, remarks = prepare([still, simulated["yaw"]], VEHICLE)
    assert len(used) == 1 and sentence in str(remarks[0])


def test_no_inputs_pulses_without_a_controller_and_strange_thrusters_are_refused(simulated):
    """Each is refused with the reason, and the motion is still checked."""
    gone = {c: None for c in simulated["surge"].channels if c.startswith("tau")}
    bare = changed(simulated["surge"], **gone)
    assert "no input columns" in told(bare, "unusable", "refused")[0]["reason"]
    assert axis(bare, "surge").fastest > 0.3
    for prefix, thrusters, vehicle, words in (
        ("pwm_", VEHICLE.thrusters, VEHICLE.replace({"thrusters.*.esc": None}), "esc"),
        ("rpm_", ("T1", "T2"), VEHICLE, "missing"),
        ("rpm_", ("front",), VEHICLE, "no thruster 'front'"),
    ):
        pulses = {f"{prefix}{name}": np.full(len(bare.t), 1600.0) for name in thrusters}
        trial = replace(bare, channels={**bare.channels, **pulses})
        assert words in told(trial, "unusable", "refused", vehicle)[0]["reason"]


def test_no_vehicle_is_refused_but_the_sampling_is_reported(simulated):
    """Nothing names the vehicle."""
    found = check_trials([changed(simulated["surge"], header={"vehicle": None})])[0]
    assert found.verdict == "refused" and found.streams and not found.axes
    assert said(found.findings, "no_vehicle", "refused")


def test_gaps_rates_and_jitter_are_measured(simulated):
    """Velocity is missing for four of fourteen seconds; depth has its own rate."""
    trial = simulated["surge"]
    missing = (trial.t > 5.0) & (trial.t < 9.0)
    trial = changed(trial, **{c: (lambda y: np.where(missing, np.nan, y)) for c in ("u", "v", "w")})
    (velocity,) = [s for s in report(trial).streams if "u" in s.columns]
    assert velocity.gaps == 1 and velocity.longest_gap == pytest.approx(4.0, abs=0.05)
    assert velocity.rate == pytest.approx(50.0) and velocity.missing == pytest.approx(4.0 / 13.98, abs=0.01)
    (gap,) = (one for one in report(trial).findings if one.code == "gap" and one.severity == "care")
    assert gap.subject == "u, v, w" and gap.values["longest"] == pytest.approx(4.0, abs=0.05)
    jittered = replace(trial, t=trial.t + np.where(np.arange(len(trial.t)) % 2, 0.008, 0.0))
    assert [s for s in report(jittered).streams if "p" in s.columns][0].jitter == pytest.approx(0.4, abs=0.02)


def test_heights_above_the_surface_are_told(simulated):
    """Motion capture counts from the floor, and some logs count depth upwards."""
    trial = simulated["yaw"]
    raised = changed(trial, z=lambda z: z - z.min() + 1.0)
    assert told(raised, "above_surface", "care")[0]["height"] > 1.0
    assert told(changed(trial, depth=np.negative), "depth_above_surface", "care")
    assert not told(trial, "above_surface") and not told(trial, "depth_above_surface")


def test_stuck_held_and_clipped_sensors_are_found(simulated):
    """A gyroscope stops, a velocity has a fifth of the rate, and a rate exceeds the sensor's range."""
    trial = simulated["yaw"]
    i = np.arange(len(trial.t))
    stuck = changed(trial, r=lambda y: np.where((trial.t > 4.0) & (trial.t < 7.0), y[200], y))
    assert told(stuck, "stuck", "care")[0]["span"] == pytest.approx(3.0, abs=0.1)
    held = changed(trial, u=lambda y: y[5 * (i // 5)])
    assert told(held, "values_held")[0] == {
        "rows": 5.0,
        "rate": pytest.approx(10.0),
        "row_rate": pytest.approx(50.0),
    }
    clipped = changed(trial, r=lambda y: np.maximum(y, -1.5))
    assert told(clipped, "clipped_below", "care")[0]["value"] == -1.5


def test_speeds_that_no_vehicle_has_are_told_and_left_out(simulated):
    """This applies to rare ones; if they are many, the unit is wrong and the trial is refused."""

    def spiked(y):
        return np.where(np.arange(len(y)) % 100 == 50, 50.0, y)

    spikes = changed(simulated["surge"], u=spiked, r=spiked)
    found = told(spikes, "wild", "care")
    assert [one["value"] for one in found] == [50.0, 50.0] and report(spikes).verdict != "refused"
    columns = compared_columns(spikes)
    assert max(np.abs(columns[name][1]).max() for name in ("u", "r")) < 15.0
    assert not told(simulated["surge"], "wild")


def test_saturation_is_found(simulated):
    """A commanded wrench exceeds the thrusters, and thrusters are at their limits."""
    commanded = changed(simulated["surge"], header={"inputs": "commanded"}, tau_x=lambda y: 10.0 * y)
    assert told(commanded, "command_beyond", "care")[0]["column"] == "tau_x"
    bare = changed(
        simulated["surge"], **{c: None for c in simulated["surge"].channels if c.startswith("tau")}
    )
    top = {f"rpm_{n}": np.where(bare.t > 3.0, t.rpm_max, 0.0) for n, t in VEHICLE.thrusters.items()}
    saturated = replace(bare, channels={**bare.channels, **top})
    assert set(told(saturated, "saturated", "care")[0]["thrusters"]) == set(VEHICLE.thrusters)


def test_an_axis_that_the_header_names_but_nothing_drives_is_told(simulated):
    """trial.yaml names sway."""
    assert told(changed(simulated["surge"], header={"axis": ("sway",)}), "axis_still") == [{"axis": "sway"}]


@pytest.mark.slow
def test_between_trials(simulated):
    """Checks between trials find duplicates and compare roles and vehicles."""
    surge, yaw = simulated["surge"], simulated["yaw"]
    twice = check_trials([surge, replace(surge, name="again")], VEHICLE)
    assert [r.verdict for r in twice] == ["usable", "refused"]
    assert said(twice[1].findings, "duplicate") == [{"other": surge.name}]
    out = [changed(trial, header={"role": "held-out"}) for trial in (surge, yaw)]
    assert said(set_findings(check_trials(out, VEHICLE)), "all_held_out")
    mixed = check_trials(
        [changed(surge, header={"vehicle": "bluerov2"}), changed(yaw, header={"vehicle": "finsrov"})]
    )
    assert said(set_findings(mixed), "several_vehicles") == [{"vehicles": ("bluerov2", "finsrov")}]
    good = set_findings(check_trials([surge, changed(yaw, header={"role": "held-out"})], VEHICLE))
    assert {"sway", "yaw"} <= set(said(good, "axes_undetermined")[0]["axes"])


@pytest.mark.slow
def test_the_report_is_json_and_fits_a_hundred_columns(simulated):
    """JSON contains plain finite values; the printed lines do not wrap."""
    reports = check_trials(list(simulated.values()), VEHICLE)
    text = json.dumps({"trials": [one.as_json() for one in reports]}, allow_nan=False)
    assert json.loads(text)["trials"][0]["axes"]["surge"]["identifiability"]["m_eff"]["identifiable"] is True
    for width in (100, 80):
        page = StringIO()
        print_reports(reports, Console(file=page, width=width), set_findings(reports))
        lines = page.getvalue().split("\n")
        assert max(map(len, lines)) <= width and any(line.startswith("surge") for line in lines)
        assert any(" velocity " in line and " rest" in line for line in lines)


def test_the_command_reads_folders_and_reports_broken_ones(simulated, tmp_path, capsys):
    """A good trial and a file that is not a table both appear in the report."""
    write_trial(simulated["surge"], tmp_path / "a")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "data.csv").write_text("nothing\n")
    check([tmp_path], vehicle="bluerov2_heavy", as_json=True)
    found = {trial["name"]: trial["verdict"] for trial in json.loads(capsys.readouterr().out)["trials"]}
    assert found == {"a": "usable", "b": "refused"}
    check([tmp_path / "a"], vehicle="bluerov2_heavy")
    assert "usable" in capsys.readouterr().out


def test_of_many_columns_with_one_remark_four_are_named():
    """A gap in six columns gives one finding, which names four of them and counts the others."""
    t = np.arange(0.0, 20.0, 0.05)
    t[100:] += 5.0
    channels = {name: 0.1 * np.sin(t + i) for i, name in enumerate(("p", "q", "r", "u", "v", "w"))}
    found = check_trials([Trial(name="a", t=t, channels=channels)], VEHICLE)[0].findings
    assert [one.subject for one in found if one.code == "gap"] == ["p, q, r, u and 2 more"]
