"""Known physical events have FinsSim's signs, whatever frame they were logged in."""

import numpy as np
import pytest

from finssim.core.frames import TO_FOSSEN
from finssim.core.rotations import quat_from_euler, quat_multiply, quat_rotate, quat_to_euler
from finssim.trials.conversion import factor
from finssim.trials.findings import CalibrationError
from finssim.trials.importers.assemble import Stream, merge, moved_in_time
from finssim.trials.importers.dispatch import read_trials
from trials.importers.tables import read

NED = "frame: {body: FRD, world: NED}"


def log(folder, columns, how=NED):
    """Return a trial imported from these columns, values constant over three rows or given as lists."""
    n = 3
    filled = {"t": [0.0, 1.0, 2.0]} | {k: np.broadcast_to(v, n).tolist() for k, v in columns.items()}
    folder.mkdir(exist_ok=True)
    named = "" if "columns" in how else f"columns: [{', '.join(columns)}]\n"
    return read(folder, filled, f"time: t\n{named}{how}", "data.csv")


def test_a_dive_with_the_nose_down_in_ned(tmp_path):
    """In NED z grows, pitch is negative and w points down; here z falls and pitch is positive (z is up)."""
    trial = log(
        tmp_path / "a",
        {"z": [1.0, 2.0, 3.0], "pitch": -0.3, "roll": 0.0, "yaw": 0.1, "w": 0.2, "depth": [1, 2, 3]},
    )
    assert np.all(np.diff(trial.channels["z"]) < 0.0)
    assert trial.channels["pitch"][0] == pytest.approx(0.3)
    assert trial.channels["w"][0] == pytest.approx(-0.2)
    np.testing.assert_array_equal(trial.channels["depth"], [1, 2, 3])  # depth is the same in all frames
    ahead = quat_rotate(quat_from_euler(0.0, trial.channels["pitch"][0], 0.0), [1.0, 0.0, 0.0])
    assert ahead[2] < 0.0


def test_a_right_turn_in_ned(tmp_path):
    """In NED yaw and r grow to the right, sway to starboard; here the opposite; surge and roll keep their
    signs."""
    columns = {
        "yaw": [0.0, 0.1, 0.2],
        "r": 0.1,
        "v": 0.3,
        "u": 0.5,
        "p": 0.2,
        "q": 0.4,
        "tau_n": 2.0,
        "tau_x": 7.0,
        "ay": 1.0,
    }
    c = log(tmp_path / "a", columns).channels
    np.testing.assert_allclose(c["yaw"], [0.0, -0.1, -0.2])
    got = {name: c[name][0] for name in ("r", "v", "u", "p", "q", "tau_n", "tau_x", "ay")}
    assert got == pytest.approx(
        {"r": -0.1, "v": -0.3, "u": 0.5, "p": 0.2, "q": -0.4, "tau_n": -2.0, "tau_x": 7.0, "ay": -1.0}
    )


def test_an_accelerometer_at_rest_reads_up_in_every_frame(tmp_path):
    """FRD logs -9.81 on z at rest; FinsSim uses +9.81."""
    c = log(tmp_path / "a", {"ax": 0.0, "ay": 0.0, "az": -9.81}).channels
    assert c["az"][0] == pytest.approx(9.81)


@pytest.mark.parametrize("body", ["FLU", "FRD"])
@pytest.mark.parametrize("world", ["z_up", "NED"])
@pytest.mark.parametrize("form", ["quaternion", "euler"])
def test_one_attitude_in_four_pairs_of_frames(tmp_path, body, world, form):
    """The same attitude logged with either body and either world axes reads as one attitude."""
    q = quat_from_euler([0.1, -0.4, 0.7], [0.2, 0.5, -0.9], [0.3, 2.0, -2.5])
    half_turn = np.array([1.0, 0.0, 0.0, 0.0])  # R = A: FinsSim's to Fossen's and back
    logged = q
    if world == "NED":
        logged = quat_multiply(half_turn, logged)
    if body == "FRD":
        logged = quat_multiply(logged, half_turn)
    if body == "FRD" and world == "NED":
        np.testing.assert_allclose(
            quat_rotate(logged, [1, 0, 0]), quat_rotate(TO_FOSSEN.quaternion(q), [1, 0, 0])
        )
    names = ("qx", "qy", "qz", "qw") if form == "quaternion" else ("roll", "pitch", "yaw")
    values = logged.T if form == "quaternion" else quat_to_euler(logged)
    trial = log(
        tmp_path / "a", dict(zip(names, values, strict=True)), f"frame: {{body: {body}, world: {world}}}"
    )
    c = [trial.channels[name] for name in names]
    back = np.stack(c, axis=-1) if form == "quaternion" else quat_from_euler(*c)
    for v in np.eye(3):
        np.testing.assert_allclose(quat_rotate(back, v), quat_rotate(q, v), atol=1e-12)


def test_a_heading_alone_turns_with_the_world_only(tmp_path):
    """The x axis is forward in both body conventions, so a heading depends only on the world frame."""
    how = "frame: {{body: {}, world: {}}}"
    for body, world, sign in [("FRD", "z_up", 1), ("FLU", "NED", -1), ("FRD", "NED", -1)]:
        trial = log(tmp_path / (body + world), {"yaw": [0.1, 3.0, 4.0]}, how.format(body, world))
        np.testing.assert_allclose(trial.channels["yaw"], sign * np.array([0.1, 3.0, 4.0 - 2.0 * np.pi]))


def test_a_forgotten_convention_is_noticed(tmp_path):
    """With body axes that are not those of the attitude, the vehicle appears upside down, and a note says so."""
    trial = log(tmp_path / "a", {"roll": 0.1, "pitch": 0.0, "yaw": 0.0}, "frame: {body: FRD, world: z_up}")
    assert "upside_down" in {one.code for one in trial.findings}
    upright = log(tmp_path / "b", {"roll": 0.1, "pitch": 0.0, "yaw": 0.0})
    assert "upside_down" not in {one.code for one in upright.findings}


@pytest.mark.parametrize(
    "unit, column, si",
    [
        ("deg", "roll", np.pi / 180.0),
        ("deg/s", "p", np.pi / 180.0),
        ("rpm", "r", np.pi / 30.0),
        ("rad/s", "rpm_T1", 30.0 / np.pi),
        ("rps", "rpm_T1", 60.0),
        ("kgf", "tau_x", 9.80665),
        ("lbf", "force_T1", 4.4482216),
        ("g", "az", 9.80665),
        ("mm/s", "u", 1e-3),
        ("kn", "u", 0.514444),
        ("mm", "x", 1e-3),
        ("mV", "voltage", 1e-3),
        ("ms", "pwm_T1", 1e3),
        ("dbar", "pressure", 1e4),
        ("N mm", "tau_k", 1e-3),
    ],
)
def test_units_become_si(unit, column, si):
    """One unit of the column is this many canonical units."""
    assert factor(unit, column) == pytest.approx(si, rel=1e-6)


@pytest.mark.parametrize(
    "unit, column, sentence",
    [
        ("rad", "u", "unit of u is 'rad', an angle, expected one of m/s"),
        ("Pa", "tau_x", "unit of tau_x is 'Pa', a pressure, expected one of N"),
        ("kgff", "tau_x", "did you mean 'kgf'?"),
    ],
)
def test_a_unit_of_the_wrong_kind_is_refused(unit, column, sentence):
    with pytest.raises(CalibrationError) as refused:
        factor(unit, column)
    assert sentence in str(refused.value)


def test_units_names_and_offsets_come_first(tmp_path):
    """Scale, offset and unit are applied before frames: degrees in NED with a compass error of 10° to the
    right."""
    how = "columns: {yaw: {column: hdg, offset: 10, unit: deg}, force_T1: {column: T1, unit: kgf}}\n" + NED
    c = log(tmp_path / "a", {"hdg": 90.0, "T1": 2.0}, how).channels
    assert np.rad2deg(c["yaw"][0]) == pytest.approx(-100.0)
    assert c["force_T1"][0] == pytest.approx(19.6133)


def test_a_time_offset_moves_one_stream():
    """A group is shifted, and one of its columns by its own offset; nothing is interpolated, rows are a
    union."""
    t = np.arange(4) * 0.1
    stream = Stream(source="log", t=t, channels={name: np.arange(4.0) for name in ("u", "roll", "yaw")})
    table = merge(moved_in_time([stream], {"attitude": 0.05, "yaw": -0.1}))
    np.testing.assert_allclose(table.t, [0.0, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45], atol=1e-9)
    for name, by in (("u", 0.1), ("roll", 0.15), ("yaw", 0.0)):
        good = np.isfinite(table.channels[name])
        np.testing.assert_allclose(table.t[good], t + by, atol=1e-9)
        np.testing.assert_array_equal(table.channels[name][good], np.arange(4.0))


def test_phases_stay_with_the_clock(tmp_path):
    """Shifting a stream in time does not move the phases."""
    (tmp_path / "data.csv").write_text("t,u,r,phase\n0,1,1,baseline\n1,2,2,excitation\n2,3,3,coast\n")
    (tmp_path / "map.yaml").write_text("time: t\ncolumns: [u, r]\nphase: phase\ntime_offsets: {r: 0.5}")
    (trial,) = read_trials([tmp_path / "data.csv"], column_map=tmp_path / "map.yaml")
    np.testing.assert_allclose(trial.t, [0.0, 0.5, 1.0, 1.5, 2.0, 2.5])
    assert trial.phase.tolist() == ["baseline"] * 2 + ["excitation"] * 2 + ["coast"] * 2


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("time_offsets: {atitude: 2}", "'atitude' .* did you mean 'attitude'"),
        ("columns: {u: vx}", "no column 'vx'"),
        ("columns: {uu: u}", "names 'uu'"),
    ],
)
def test_a_map_of_what_the_log_has_not_is_refused(tmp_path, how, message):
    """The refusal is one sentence that lists what exists."""
    with pytest.raises(CalibrationError, match=message):
        log(tmp_path / "a", {"u": 1.0}, how)
