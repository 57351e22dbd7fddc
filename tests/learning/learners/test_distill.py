"""A teacher and a student with a camera: training, its policy directory, and running the policy."""

from dataclasses import replace

import minari
import numpy as np
import onnxruntime
import pytest
import torch

pytest.importorskip("newton")
pytest.importorskip("finssim.extensions.perception")

from finssim.agents.agent import NOWHERE, agent_for
from finssim.control.guidance import Known
from finssim.control.policy import Policy, PolicyError
from finssim.evaluation.plants import load_plant
from finssim.evaluation.trials import TrialSettings, run_episodes
from finssim.extensions.perception.camera_docking import CameraDocking
from finssim.learning.demonstrations import CollectSettings, Episode, collect, load, save
from finssim.learning.export import write_seeing
from finssim.learning.learners import LearningError, learner_named
from finssim.learning.learners.distill import LEAST_DEVIATION
from finssim.learning.resume import ResumeError
from finssim.learning.torch_networks import SeeingNetwork
from finssim.learning.train import TrainingSettings, train
from finssim.tasks import Environment, make
from finssim.tasks.picture import ObservedPicture
from finssim.vehicles import load_vehicle

pytestmark = pytest.mark.slow
TINY = {"worlds": 8, "teacher_worlds": 64, "teacher_steps": 2048, "steps": 400, "batch": 64, "kept": 300}
TASK = CameraDocking(time_limit=2.0)


def test_a_network_that_sees_is_the_same_in_onnx():
    torch.manual_seed(0)
    network = SeeingNetwork(5, {"left": (9, 14, 3), "right": (6, 6, 3), "sonar": (12, 9, 1)}, 4)
    torch.nn.init.normal_(network.layers[-1].weight, std=0.2)
    network.mean[:], network.scale[:] = torch.linspace(-1.0, 1.0, 5), torch.linspace(0.5, 8.0, 5)
    random = np.random.default_rng(1)
    row = random.normal(size=(7, 5)).astype(np.float32)
    pictures = {
        name: random.integers(0, 256, (7, *shape), np.uint8) for name, shape in network.shapes.items()
    }
    session = onnxruntime.InferenceSession(write_seeing(network, 5, 4))
    (action,) = session.run(["action"], {"observation": row, **pictures})
    expected = network(torch.from_numpy(row), **{k: torch.from_numpy(p) for k, p in pictures.items()})
    np.testing.assert_allclose(action, expected.detach().clamp(-1.0, 1.0), atol=1e-5)
    assert action.std() > 0.01


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return train(
        TASK, TrainingSettings(seed=1, settings=TINY), out=tmp_path_factory.mktemp("seen") / "policy"
    )


def test_a_policy_directory_says_what_it_sees_and_runs_in_episodes(trained):
    policy = Policy.load(trained)
    ((name, about),) = policy.description.pictures.items()
    assert name == "front_camera" and about["shape"] == [27, 48, 3] and about["rate"] == 10.0
    assert policy.description.training["learner"] == "distill"
    vehicle = load_vehicle("finsrov")
    agent = agent_for(trained, vehicle, TASK)
    rows = run_episodes(agent, TASK, vehicle, load_plant("nominal"), TrialSettings(trials=3, seed=5))
    assert all(row["return"] is not None for row in rows)


def test_a_policy_refuses_to_act_blind(trained):
    policy, row = Policy.load(trained), np.zeros((2, 10))
    with pytest.raises(PolicyError, match="requires picture front_camera: it received nothing"):
        policy.step(None, row)
    with pytest.raises(PolicyError, match="expected uint8"):
        policy.step(None, row, {"front_camera": np.zeros((2, 36, 64, 3), np.uint8)})


def test_learners_of_rows_refuse_tasks_that_see_and_the_other_way_round():
    with pytest.raises(LearningError, match="observes pictures: use bc, distill"):
        learner_named("ppo").check(CameraDocking())
    with pytest.raises(LearningError, match="observes no pictures"):
        learner_named("distill").check(CameraDocking().for_teacher())


def test_a_training_goes_on_from_its_state_bit_for_bit():
    kind = learner_named("distill")
    learners = []
    for _ in range(2):
        environment = Environment(TASK, worlds=8, seed=3)
        learners.append(kind(environment, kind.settings(TASK, changes=TINY), seed=3))
    one, other = learners
    one.update()
    state = one.state()
    row = one.update()
    other.load(state)
    assert other.update() == row
    for a, b in zip(one.student.parameters(), other.student.parameters(), strict=True):
        assert torch.equal(a, b)
    del state["learner"]["student"]["mean"]  # as an earlier version wrote it
    with pytest.raises(ResumeError, match="earlier version: leave out --resume"):
        other.load(state)


def test_the_student_scales_its_row_by_what_the_first_rollout_saw():
    """Velocities of centimetres a second weigh as much as features; inputs that hardly vary are not amplified."""
    kind = learner_named("distill")
    learner = kind(Environment(TASK, worlds=8, seed=3), kind.settings(TASK, changes=TINY), seed=3)
    learner.update()
    rows, network = learner._kept["row"][:200].clone(), learner.network()
    scaled = (rows - network.mean) * network.scale
    small = rows.std(0, correction=0) < LEAST_DEVIATION
    assert 0 < small.sum() < len(small)
    assert torch.allclose(scaled[:, ~small].std(0, correction=0), torch.ones(1), atol=1e-3)
    assert torch.all(scaled[:, small].abs() <= (rows - rows.mean(0))[:, small].abs() / LEAST_DEVIATION + 1e-3)
    assert torch.allclose(scaled.mean(0), torch.zeros(1), atol=1e-3)
    learner.update()
    assert torch.equal((rows - network.mean) * network.scale, scaled)


def test_the_student_learns_what_the_teacher_does():
    """The teacher goes straight ahead: after a few rounds the student does too, and its buffer has not grown."""
    kind = learner_named("distill")
    changes = {**TINY, "expert_rounds": 1, "steps": 2000, "learning_rate": 3e-3}
    learner = kind(Environment(TASK, worlds=8, seed=3), kind.settings(TASK, changes=changes), seed=3)
    learner.update()
    learner._labels = lambda: torch.tensor([0.5, 0.0, 0.0, 0.0, 0.0, 0.0]).repeat(8, 1)
    for _ in range(8):
        row = learner.update()
    assert row["imitation_loss"] < 0.02 and len(learner._kept["action"]) == 300


def test_demonstrations_keep_what_was_seen(tmp_path):
    """Data are bit-identical to the environment's, read by us and by Minari; the last picture is the episode's own."""
    task = CameraDocking(time_limit=0.5)
    told = collect("light-servo", task, episodes=3, out=tmp_path / "set", settings=CollectSettings(seed=4))
    assert told["episodes"] == 3 and told["steps"] == 15
    found, environment = load(tmp_path / "set"), make(task, worlds=3, seed=4, observe="training")
    seen, agent = environment.reset(seed=4), agent_for("light-servo", load_vehicle("finsrov"), task)
    memory, pictures = agent.reset(3), []
    for _ in range(5):
        views = {name: x.copy() for name, x in seen.items() if name != "state"}
        pictures.append(views["front_camera"])
        action, memory = agent.act(memory, Known(seen["state"], pictures=views), NOWHERE)
        step = environment.step(action)
        seen = step.observation
    by_episode = found.pictures["front_camera"].reshape(3, 5, 27, 48, 3)
    assert np.array_equal(by_episode, np.stack(pictures, axis=1))
    (first, *_) = minari.MinariDataset(tmp_path / "set").iterate_episodes()
    assert np.array_equal(first.observations["front_camera"][:-1], by_episode[0])
    assert np.array_equal(first.observations["front_camera"][-1], step.final_observation["front_camera"][0])


def shown_spots(folder, rows=400):
    """Write a set with known truth: the action is the position of a bright spot in a dark picture."""
    random = np.random.default_rng(0)
    picture = random.integers(0, 60, (rows + 1, 27, 48, 3), np.uint8)
    column = random.integers(4, 44, rows + 1)
    for one, x in zip(picture, column, strict=True):
        one[8:20, x - 4 : x + 4] = 230
    action = np.repeat(((column[:-1, None] - 24) / 24).astype(np.float32), 6, axis=1)
    state = random.normal(size=(rows + 1, 10)).astype(np.float32)
    episode = Episode(
        state, action, np.zeros(rows, np.float32), False, {"return": 0.0}, {"front_camera": picture}
    )
    vehicle = {"name": "finsrov", "sha256": load_vehicle("finsrov").sha256}
    about = {"task": TASK.name, "expert": "spots", "vehicle": vehicle, "action": {"mode": TASK.action}}
    return str(save(folder, [episode], about))


def test_cloning_learns_from_pictures(tmp_path):
    """Where the picture alone determines the action, a tenth of the variance is left; another size is refused."""
    place = shown_spots(tmp_path / "set")
    changes = {
        "demonstrations": place,
        "worlds": 2,
        "steps": 16_000,
        "rollout": 4000,
        "batch": 64,
        "colour": 0.1,
    }
    settings = learner_named("bc").settings(TASK, changes=changes)
    learner = learner_named("bc")(make(TASK, worlds=2, seed=1), settings, seed=1)
    losses = []
    while learner.steps < settings.steps:
        losses.append(learner.update()["imitation_loss"])
    assert losses[-1] < 0.1 * np.var((np.arange(4, 44) - 24) / 24)
    wide = replace(TASK, pictures=(ObservedPicture("front_camera", 32),))
    with pytest.raises(LearningError, match="is of pictures .*27, 48.*expected .*18, 32"):
        learner_named("bc")(make(wide, worlds=2, seed=1), settings, seed=1)
