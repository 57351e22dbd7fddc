"""Train TorchRL's PPO to hold a pose, in less than twenty seconds."""

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss

from finssim.learning import TorchRlEnv

torch.manual_seed(1)
torch.set_num_threads(1)  # a second thread gains nothing on so small a network
ROLLOUTS, STEPS, WORLDS, BATCH = 60, 32, 256, 2048
worlds = TorchRlEnv("t1", worlds=WORLDS, vehicle="finsrov", seed=1, stagger=True)
seen, acts = worlds.observation_spec["observation"].shape[-1], worlds.action_spec.shape[-1]


def layers(outputs: int) -> nn.Sequential:
    """Return a small network."""
    return nn.Sequential(nn.Linear(seen, 64), nn.ELU(), nn.Linear(64, 64), nn.ELU(), nn.Linear(64, outputs))


class Gaussian(nn.Module):
    """Gaussian policy: a mean that depends on the observation, and one standard deviation per action."""

    def __init__(self) -> None:
        super().__init__()
        self.mean, self.log_std = layers(acts), nn.Parameter(torch.full((acts,), -1.0))

    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mean = self.mean(observation)
        return mean, self.log_std.exp().expand_as(mean)


actor = ProbabilisticActor(
    TensorDictModule(Gaussian(), in_keys=["observation"], out_keys=["loc", "scale"]),
    in_keys=["loc", "scale"],
    distribution_class=IndependentNormal,
    return_log_prob=True,
)
loss = ClipPPOLoss(
    actor, ValueOperator(layers(1)), normalize_advantage=True, entropy_bonus=False, loss_critic_type="l2"
)
loss.make_value_estimator(gamma=0.98, lmbda=0.95)
optimizer = torch.optim.Adam(loss.parameters(), lr=1.5e-3)
schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, total_iters=ROLLOUTS)


def held() -> float:
    """Return the success rate in 64 new episodes, without action noise: the pose is held for ten seconds at
    the end."""
    trial = TorchRlEnv("t1", worlds=64, vehicle="finsrov", seed=2)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        trial.rollout(200, actor, break_when_any_done=False)
    return trial.environment.task.metrics(trial.environment.arrays)["success"].mean()


before = held()
collector = Collector(
    worlds,
    actor,
    frames_per_batch=STEPS * WORLDS,
    total_frames=ROLLOUTS * STEPS * WORLDS,
    auto_register_policy_transforms=False,
)
for data in collector:
    with torch.no_grad():
        loss.value_estimator(data)
    samples = data.reshape(-1)
    for _ in range(5):
        for batch in torch.randperm(len(samples)).split(BATCH):
            parts = loss(samples[batch])
            optimizer.zero_grad()
            (parts["loss_objective"] + parts["loss_critic"]).backward()
            nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
            optimizer.step()
    schedule.step()
print(f"held before: {before:.0%}, after {ROLLOUTS * STEPS * WORLDS:,} control steps: {held():.0%}")
