"""`finssim evaluate`: published trials in every plant, for policies and PIDs, as table, JSON and files."""

import json
import math
import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import nn

from finssim.agents.agent import AgentError, PidAgent
from finssim.cli import boundary
from finssim.cli.command_line import read
from finssim.cli.commands import app
from finssim.control.modes import action_mode
from finssim.control.policy import PolicyDescription, PolicyError, VehicleIdentity
from finssim.control.trajectories import TRAJECTORIES
from finssim.core.files import OutputError
from finssim.evaluation import trials as trials_module
from finssim.evaluation.evaluate import EvaluationError, evaluate, evaluate_controller
from finssim.evaluation.metrics import PAPER_T1, T1_SETPOINTS, T1_START
from finssim.evaluation.plants import PlantChanges, PlantError, available_plants, load_plant
from finssim.evaluation.trials import TrialSettings, run_trials
from finssim.learning.export import export_policy
from finssim.sim import read_run
from finssim.tasks import Environment, EnvironmentSetupError, StationKeeping
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")
KEYS = {"trials", "success", "e_p_m", "e_y_m", "e_psi_deg", "t_s_s", "J_p_m", "J_psi_deg", "per_trial"}
NOMINAL = load_plant("nominal")


def proportional(folder, vehicle=FINSROV, action="wrench6"):
    """Write a policy without training: thrust towards the goal and against velocity, as one layer."""
    layer = nn.Linear(16, 6)
    with torch.no_grad():
        layer.weight.zero_()
        layer.bias.zero_()
        for axis in range(3):
            layer.weight[axis, axis], layer.weight[axis, 9 + axis] = 6.0, -3.0
        # Index 4 is the sine of the yaw error; index 14 the yaw rate.
        layer.weight[5, 4], layer.weight[5, 14] = 0.3, -0.3
    task = StationKeeping()
    description = PolicyDescription(
        task="t1",
        observation=task.schema,
        action=action_mode(action, vehicle).describe(),
        control_period=task.control_step,
        vehicle=VehicleIdentity(name=vehicle.name, sha256=vehicle.sha256),
        hydrodynamics="calibrated",
        seed=0,
        training={"randomization": None},
    )
    return export_policy(nn.Sequential(layer), folder, description)


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    return proportional(tmp_path_factory.mktemp("policies") / "by_hand")


def test_the_tuned_pid_holds_all_setpoints_in_the_nominal_plant():
    result = evaluate_controller("pid", NOMINAL).result
    assert (result["success"], result["trials"]) == (8, 8)
    assert result["e_p_m"] < 0.02 and result["e_psi_deg"] < 1.5


def test_a_policy_directory_is_flown(policy):
    """A hand-written feedback holds the setpoints that need no half turn."""
    result = evaluate_controller(policy, NOMINAL).result
    held = {trial["setpoint"]: trial["success"] for trial in result["per_trial"]}
    assert held["P01"] and held["P05"] and held["P06"]
    assert result["controller"]["name"] == "by_hand" and result["controller"]["kind"] == "policy"


def test_trials_are_those_of_the_protocol():
    """Trials last 60 s from the published start, level and at rest, over the eight setpoints in turn, at the
    controller's rate."""
    player = PidAgent("pid", FINSROV)
    done = run_trials(player, StationKeeping(), FINSROV, NOMINAL, TrialSettings(trials=10))
    assert [trial.name for trial in done] == [*T1_SETPOINTS, "P01", "P02"]
    motions = [trial.motion for trial in done]
    for motion in motions:
        np.testing.assert_allclose(motion.position[0], T1_START[:3], atol=1e-6)
        np.testing.assert_allclose(motion.yaw[0], 0.0, atol=1e-6)
        assert motion.t[-1] == pytest.approx(60.0) and motion.t[1] == player.period
    np.testing.assert_allclose(done[3].goal, T1_SETPOINTS["P04"])
    # In an undisturbed plant, trials with equal goals are equal.
    np.testing.assert_array_equal(motions[0].position, motions[8].position)


PLANTS = [name for name in available_plants() if not load_plant(name).held_out]
"""Plants of tasks without perception."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("controller", "name"), [*(("pid", name) for name in PLANTS), ("pid-paper", "nominal")]
)
def test_every_plant_can_be_flown_in(name, controller, monkeypatch):
    """Results are finite in every plant that ships (short trials)."""
    monkeypatch.setattr(trials_module, "DURATION", 2.0)
    result = evaluate_controller(controller, load_plant(name), TrialSettings(trials=3)).result
    assert (result["controller"]["name"], result["plant"]["name"]) == (controller, name)
    assert result["success"] == 0
    assert all(trial["e_p_m"] is None for trial in result["per_trial"])  # the window was never reached


def positions(plant, **options):
    """Return the positions of all trials of the tuned PID, (T, n, 3)."""
    played = evaluate_controller("pid", plant, TrialSettings(**options)).trials
    return np.stack([trial.motion.position for trial in played], axis=1)


@pytest.mark.slow
def test_plants_make_a_difference(monkeypatch):
    """With a current, noise or lag, each path differs from the nominal one."""
    monkeypatch.setattr(trials_module, "DURATION", 5.0)
    nominal = positions(NOMINAL, trials=2)
    for name in set(PLANTS) - {"nominal"}:
        other = positions(load_plant(name), trials=2)
        assert np.abs(other - nominal).max() > 1e-3, name


def test_seeds_decide_what_is_drawn(monkeypatch):
    """Equal seeds give equal trials, other seeds others, and a trial does not depend on the number of trials."""
    monkeypatch.setattr(trials_module, "DURATION", 3.0)
    plant = load_plant("randomised")
    one, again, other, many = (
        positions(plant, trials=trials, seed=seed) for trials, seed in ((4, 1), (4, 1), (4, 2), (70, 1))
    )
    np.testing.assert_array_equal(one, again)
    np.testing.assert_array_equal(one, many[:, :4])
    assert np.abs(one - other).max() > 1e-4


def test_json_is_one_object_with_the_agreed_keys(capsys, policy):
    """Standard output contains only the object, and every trial has its setpoint and measures."""
    assert boundary.run(app, ["evaluate", str(policy), "--trials", "9", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed.keys() >= KEYS | {"provenance", "vehicle", "plant", "seed"}
    assert printed["trials"] == len(printed["per_trial"]) == 9
    assert printed["vehicle"]["sha256"] == FINSROV.sha256
    for trial in printed["per_trial"]:
        assert trial.keys() >= (KEYS - {"trials", "per_trial"}) | {"setpoint", "goal", "trial"}
    assert printed["per_trial"][1]["goal"][3] == pytest.approx(math.degrees(T1_SETPOINTS["P02"][3]))


def test_the_table_has_a_row_per_setpoint_all_and_the_papers(capsys):
    assert boundary.run(app, ["evaluate", "pid"]) == 0
    out = capsys.readouterr().out
    assert all(f"{name} " in out for name in [*T1_SETPOINTS, "all", "paper, PID"])
    assert "8/8" in out and "44.08" in out and "its vehicle in its pool, PID, for orientation" in out


@pytest.mark.slow
def test_a_directory_holds_result_figure_and_trajectories(tmp_path, monkeypatch):
    """All files open, agree with each other, and may be replaced by the next evaluation."""
    monkeypatch.setattr(trials_module, "DURATION", 5.0)
    for _ in range(2):
        result = evaluate("pid", out=tmp_path / "e")
    stored = json.loads((tmp_path / "e" / "evaluation.json").read_text(encoding="utf-8"))
    assert stored == json.loads(json.dumps(result))
    assert (tmp_path / "e" / "error_envelope.png").read_bytes().startswith(b"\x89PNG")
    table = read_run(tmp_path / "e" / "trajectories")
    path = table[table.world == 4].sort_values("t")
    motion = evaluate_controller("pid", load_plant("nominal")).trials[4].motion
    np.testing.assert_allclose(path[["x", "y", "z"]], motion.position, atol=1e-6)
    np.testing.assert_allclose(path.t, motion.t, atol=1e-6)


@pytest.mark.slow
def test_several_plants_are_one_table_one_object_and_one_directory(tmp_path, capsys, monkeypatch):
    """Each plant has a row, its own object under `plants`, and a folder of trajectories with its name."""
    plants = ["nominal", "simplified"]
    words = ["evaluate", "pid", *(word for name in plants for word in ("--plant", name))]
    assert boundary.run(app, [*words, "--out", str(tmp_path / "e")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines if "8/8" in line] == plants
    assert any("paper, PID" in line for line in lines)
    assert sorted(path.name for path in (tmp_path / "e" / "trajectories").iterdir()) == plants
    assert len(read_run(tmp_path / "e" / "trajectories" / "simplified")) > 0
    assert (tmp_path / "e" / "error_envelope.png").stat().st_size > 0

    monkeypatch.setattr(trials_module, "DURATION", 5.0)
    assert boundary.run(app, [*words, "--out", str(tmp_path / "e"), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((tmp_path / "e" / "evaluation.json").read_text(encoding="utf-8"))
    assert list(printed) == ["plants"]
    assert printed["plants"] == [evaluate_controller("pid", load_plant(name)).result for name in plants]


def test_a_world_that_breaks_fails_its_trial_alone(tmp_path, monkeypatch):
    """After it breaks, a world has no numbers and no success; the other trials are unaffected."""
    step, calls = Environment.step, []

    def breaking(self, action):
        calls.append(None)
        if len(calls) == 100:
            velocity = self.simulator.state.velocity.numpy().copy()
            velocity[2, 0, 0] = np.nan
            self.simulator.state.velocity.assign(velocity)
        return step(self, action)

    monkeypatch.setattr(Environment, "step", breaking)
    settings = TrialSettings(trials=8, crash_directory=tmp_path)
    done = run_trials(PidAgent("pid", FINSROV), StationKeeping(), FINSROV, NOMINAL, settings)
    position = np.stack([trial.motion.position for trial in done], axis=1)
    assert np.isfinite(position[:100]).all()
    assert np.isnan(position[100:, 2]).all() and np.isfinite(np.delete(position, 2, axis=1)).all()
    measures = [trial.measures("t1", FINSROV.force_limits) for trial in done]
    assert [m["success"] for m in measures] == [i != 2 for i in range(8)] and measures[2]["e_p_m"] is None
    assert len(list(tmp_path.iterdir())) == 1


def test_a_policy_for_another_vehicle_is_refused(tmp_path):
    policy = proportional(tmp_path / "p", FINSROV.replace({"body.mass": 12.5}))
    with pytest.raises(PolicyError, match="trained for vehicle finsrov .*, but this is finsrov"):
        evaluate_controller(policy, NOMINAL)


def test_a_plant_may_change_what_a_policy_was_trained_for(policy, monkeypatch):
    """A policy is checked against the vehicle's file, not against the plant, which may differ on purpose."""
    monkeypatch.setattr(trials_module, "DURATION", 1.0)
    heavy = PlantChanges(name="heavy", vehicle={"body.mass": 12.5})
    assert evaluate_controller(policy, heavy, TrialSettings(trials=1)).result["plant"]["vehicle"] == {
        "body.mass": 12.5
    }


@pytest.mark.parametrize(
    ("controller", "options", "error", "sentence"),
    [
        (
            "no/such/policy",
            {},
            AgentError,
            "neither a policy directory nor a controller of task 't1'; controllers: pid, ",
        ),
        ("pid", {"task": "gate"}, AgentError, "controller of task 'gate'; controllers: post-servo"),
        ("pid", {"task": "t9"}, EnvironmentSetupError, "unknown task 't9'; available: t1"),
        ("pid", {"trials": 0}, EvaluationError, "trials is 0, expected 1 or more"),
        ("pid", {"plant": "pool"}, PlantError, "no plant 'pool'"),
        ("pid", {"plant": ["lag", "pool"]}, PlantError, "no plant 'pool'"),
        ("pid", {"plant": ["lag", "lag"]}, EvaluationError, "two plants are named 'lag'"),
        ("pid", {"plant": []}, EvaluationError, "no plant is given"),
        ("pid", {"hydrodynamics": "fosen"}, ValueError, "unknown hydrodynamic model 'fosen'"),
    ],
)
def test_what_cannot_be_evaluated_gets_its_sentence(controller, options, error, sentence, tmp_path):
    with pytest.raises(error, match=sentence):
        evaluate(controller, out=tmp_path / "e", **options)
    assert list(tmp_path.iterdir()) == []


def test_a_policy_of_a_task_of_ones_own_asks_for_its_file(tmp_path, monkeypatch):
    """Its description holds the task's name alone."""
    monkeypatch.setattr(
        "finssim.evaluation.evaluate.read_description", lambda _: SimpleNamespace(task="keep-depth")
    )
    with pytest.raises(
        EvaluationError, match="a task 'keep-depth' of your own: name it with --task FILE.py:CLASS"
    ):
        evaluate(str(tmp_path))


def test_a_plant_that_cannot_name_a_folder_is_refused_among_several(tmp_path):
    """A plant whose trajectories would be written outside the output folder is refused."""
    for name in ("../x", "..", "", "/tmp/x", "a\\b", "c:", "a" * 300):
        (tmp_path / "plant.yaml").write_text(f"name: '{name}'\n", encoding="utf-8")
        with pytest.raises(EvaluationError, match="^plant '.*expected the plain name of a file or folder"):
            evaluate("pid", plant=["lag", tmp_path / "plant.yaml"], out=tmp_path / "e")
    assert [path.name for path in tmp_path.iterdir()] == ["plant.yaml"]


def test_the_help_names_every_plant_and_every_trajectory():
    """The names are those of the catalogue; `run` names the trajectories too."""
    pages = {
        "evaluation.evaluate:evaluate": [*available_plants(), *TRAJECTORIES],
        "robot.run:run": TRAJECTORIES,
    }
    for path, names in pages.items():
        helps = " ".join(option.help for option in read(f"finssim.{path}").all_options())
        words = set(re.findall(r"\w+", helps))
        assert not set(names) - words


def test_an_unknown_controller_is_refused_with_those_there_are():
    with pytest.raises(AgentError, match="'pidd' is neither .*; controllers: pid, "):
        evaluate_controller("pidd", NOMINAL)


def test_somebodys_files_are_not_replaced(policy):
    """Even a policy's directory is refused: an evaluation needs its own."""
    with pytest.raises(OutputError, match="already holds files"):
        evaluate(policy, out=policy)


def test_the_papers_rows_are_the_published_table():
    """The table of T1 has eight trials each, the best at 7 of 8."""
    assert {row[4] for row in PAPER_T1.values()} == {8} and max(row[3] for row in PAPER_T1.values()) == 7
    assert PAPER_T1["calibrated + DR"][:3] == [0.092, 0.043, 5.42]


def test_a_policys_own_task_and_vehicle_are_the_defaults(tmp_path, monkeypatch):
    """A policy trained for a BlueROV2 flies a BlueROV2; one trained for a user's file requires that file."""
    monkeypatch.setattr(trials_module, "DURATION", 1.0)
    bluerov2 = load_vehicle("bluerov2_heavy")
    policy = proportional(tmp_path / "policy", bluerov2)
    result = evaluate(policy, trials=1)
    assert (result["task"], result["vehicle"]["name"]) == ("t1", "bluerov2_heavy")
    changed = proportional(tmp_path / "changed", bluerov2.replace({"body.mass": 14.0}))
    with pytest.raises(
        EvaluationError, match="trained for a vehicle 'bluerov2_heavy' .* give its file with --vehicle"
    ):
        evaluate(changed, trials=1)
    assert evaluate("pid", trials=1)["vehicle"]["name"] == "finsrov"
