"""Programmes in the virtual pool, with the robot's whole software: trials that identify the plant."""

import json

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.evaluation.excitation import PoolRun, play_programme, record_programmes, trimmed
from finssim.identification.programme import Programme, programmes
from finssim.identification.simulation_error import fit_by_simulation
from finssim.identification.vehicle_file import write_vehicle
from finssim.trials.findings import CalibrationError
from finssim.trials.trial_files import load_trials
from finssim.vehicles import load_vehicle

pytestmark = pytest.mark.slow

FINSROV = load_vehicle("finsrov")


def step(level, axis="surge"):
    return next(iter(programmes((axis,), FINSROV, levels=[level])))


def run_of(programme, **settings):
    return PoolRun(
        row="fit",
        target=programme.name,
        programme=programme,
        vehicle="finsrov",
        pool_vehicle="finsrov",
        severity="nominal",
        **settings,
    )


@pytest.fixture(scope="module")
def surge(tmp_path_factory):
    """The trial of one step of 12 N in a nominal pool."""
    folder = tmp_path_factory.mktemp("surge")
    run = run_of(step(12.0))
    assert play_programme(run, folder)["fault"] == ""
    return load_trials([folder / run.target])[0]


def test_a_record_becomes_a_trial_with_phases_axis_and_role(surge):
    assert surge.header.axis == ["surge"] or tuple(surge.header.axis) == ("surge",)
    assert surge.header.role == "fit"
    assert {"baseline", "excitation", "coast", "rest"} >= set(surge.phase) - {""}
    assert (surge.phase == "excitation").any() and (surge.phase == "coast").any()
    assert {"u", "r", "ax", "x", "depth", *(f"rpm_{name}" for name in FINSROV.thruster_names)} <= set(
        surge.channels
    )


def test_the_way_stays_in_the_pool_and_the_other_axes_where_they_were(surge):
    x, y, yaw = (surge.channels[name] for name in ("x", "y", "qz"))
    assert np.nanmax(np.abs(x)) < 1.72  # half the envelope's length from the wall
    assert np.nanmax(np.abs(y)) < 0.1 and np.nanmax(np.abs(yaw)) < 0.1


def test_the_trial_tells_damping_and_mass_of_the_plant(surge):
    """In the nominal plant, one trial gives the file's 27.1 kg with added mass and 39.1 N s/m, within 5 %."""
    fit = fit_by_simulation([surge], FINSROV, axes=["surge"], damping="linear")
    assert fit.estimates["surge.d1"].estimate == pytest.approx(39.07, rel=0.05)
    assert fit.estimates["surge.m_eff"].estimate == pytest.approx(27.14, rel=0.1)


def test_equal_runs_have_equal_keys_and_every_setting_counts():
    first = run_of(step(6.0))
    assert first.key() == run_of(step(6.0)).key()
    for other in (
        run_of(step(9.0)),
        run_of(step(6.0), seed=2),
        run_of(step(6.0), plant=2),
        run_of(step(6.0), hold=None),
    ):
        assert other.key() != first.key()


def test_a_programme_that_the_bridge_stops_is_left_out(tmp_path):
    """A persistent hard roll is ended by the tilt watchdog. Finished trials beside it are kept; alone it is refused.

    Trials that were finished before Ctrl-C are kept too.
    """
    n = 300
    tau = np.zeros((n, 6))
    tau[50:, 3] = FINSROV.wrench_limits[3]
    phase = np.array(["baseline"] * 50 + ["excitation"] * (n - 50))
    hard = Programme(name="roll_hard", axes=("roll",), rate=50.0, tau_desired=tau, phase=phase)
    still = Programme(name="still", axes=("roll",), rate=50.0, tau_desired=np.zeros((n, 6)), phase=phase)
    write_vehicle(FINSROV.replace({"safety.max_tilt": 0.05}), tmp_path / "light.yaml")
    faults = {}

    def show(run, result):
        faults[run.target] = result["fault"]
        if len(faults) == 2 and not (tmp_path / "interrupted").exists():
            (tmp_path / "interrupted").touch()
            raise KeyboardInterrupt

    def recorded(plan, out):
        return record_programmes(
            {"fit": plan},
            {"fit": tmp_path / out},
            str(tmp_path / "light.yaml"),
            pool_vehicle="finsrov",
            severity="nominal",
            processes=1,
            show=show,
        )

    with pytest.raises(KeyboardInterrupt):
        recorded([still, hard], "both")
    assert sorted(path.name for path in (tmp_path / "both").iterdir()) == ["records", "still"]
    assert recorded([hard, still], "both") == {"fit": [tmp_path / "both" / "still"]}
    assert "tilt" in faults["roll_hard"] and not faults["still"]
    with pytest.raises(CalibrationError, match="stopped every fit trial in the virtual pool: .*tilt"):
        recorded([hard], "alone")


def test_thrusters_carry_what_a_vehicle_is_too_light():
    """Thrusters balance missing weight all the time, and add nothing if ballasted or not controlled in heave."""
    programme = step(6.0)
    light = FINSROV.replace({"body.displaced_volume": FINSROV.body.displaced_volume + 2e-4})
    carried = trimmed(programme, light).tau_desired - programme.tau_desired
    np.testing.assert_allclose(carried[:, 2], light.weight - light.buoyancy)
    assert carried[0, 2] < -1.5 and not np.delete(carried, 2, axis=1).any()
    assert trimmed(programme, FINSROV) is programme


def test_excite_in_a_pool_by_command(tmp_path):
    """The command writes trials, records and their description; pool, vehicle and severity are those of the options."""
    command = ["excite", "roll", "--vehicle", "finsrov", "--levels", "1.0", "--out", str(tmp_path / "t")]
    pool = ["--pool", "3", "--severity", "nominal", "--pool-vehicle", "finsrov_sim7", "--json"]
    done = CliRunner().invoke(app, [*command, *pool])
    assert done.exit_code == 0, done.output
    folders = json.loads(done.output.splitlines()[-1])["trials"]
    assert folders == [str(tmp_path / "t" / f"roll_{word}_1") for word in ("plus", "minus")]
    assert {p.name for p in (tmp_path / "t" / "records").iterdir()} == {
        "roll_plus_1.mcap",
        "roll_minus_1.mcap",
    }
    assert len(load_trials([tmp_path / "t"])) == 2
    about = yaml.safe_load((tmp_path / "t" / "programmes.yaml").read_text(encoding="utf-8"))
    assert about["pool"] == {"vehicle": "finsrov_sim7", "plant": 3, "severity": "nominal"}


def test_excite_plays_the_dive_that_a_report_recommends(tmp_path, capsys):
    """The command plays the recommended dive; other kinds and levels beside it are refused."""
    legs = [{"axis": "yaw", "level": 2.0, "hold": 1.5, "times": 2}]
    (tmp_path / "fit.json").write_text(json.dumps({"next_dive": {"legs": legs}}))
    command = ["excite", "all", "--vehicle", "finsrov", "--out", str(tmp_path / "t"), "--from", str(tmp_path)]
    assert boundary.run(app, [*command, "--levels", "1.0"]) == 2
    assert "--from excludes" in capsys.readouterr().err
    assert boundary.run(app, command) == 0
    assert {p.name for p in (tmp_path / "t").iterdir()} == {"yaw_2_1.5s_1", "yaw_2_1.5s_2", "programmes.yaml"}


def test_a_pool_goes_with_no_other_simulation(tmp_path):
    command = ["excite", "roll", "--vehicle", "finsrov", "--out", str(tmp_path / "t"), "--pool", "1"]
    assert boundary.run(app, [*command, "--simulate"]) == 2


@pytest.mark.parametrize("option", [["--severity", "hard"], ["--pool-vehicle", "bluerov2"]])
def test_what_tells_of_a_pool_needs_one(tmp_path, option, capsys):
    """Options of a pool are refused without one, not ignored."""
    command = ["excite", "roll", "--vehicle", "finsrov", "--out", str(tmp_path / "t"), *option]
    assert boundary.run(app, command) == 2 and not (tmp_path / "t").exists()
    assert "--pool SEED" in capsys.readouterr().err
