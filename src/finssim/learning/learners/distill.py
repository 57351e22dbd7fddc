"""Teacher and student: PPO on privileged observations, then DAgger by a student that observes only the pictures.

The teacher learns the task without pictures, on `Task.teacher`, in worlds that are not rendered. The student then acts
in rendered worlds; each step is labelled with the teacher's action (Ross et al. 2011). The student's encoder also
learns to predict the teacher's observation, which needs fewer pictures than actions alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import nn

from finssim.learning.adapter import age_episodes
from finssim.learning.learners.base import ActingLearner
from finssim.learning.learners.ppo import Ppo
from finssim.learning.network import Activation, Linear, Network
from finssim.learning.resume import ResumeError
from finssim.learning.tensors import Tensors
from finssim.learning.torch_networks import SeeingNetwork
from finssim.tasks import Environment

LEAST_DEVIATION = 0.02
"""Least standard deviation by which an observed number is divided [-], so that nearly constant numbers stay small."""


@dataclass(frozen=True, kw_only=True)
class DistillSettings:
    """Settings of teacher and student."""

    worlds: int = 64
    """Number of the student's worlds."""
    steps: int = 100_000
    """Control steps of the student, summed over all worlds."""
    teacher_worlds: int = 256
    teacher_steps: int = 2_000_000
    """Control steps of the teacher, which is trained before the student."""
    rollout: int = 25
    """Control steps of each world between two rounds of learning."""
    expert_rounds: int = 4
    """Initial rounds in which the teacher acts; after them the student does."""
    kept: int = 60_000
    """Size of the sample buffer, with the newest samples; a picture of 48 x 27 takes 4 kB."""
    passes: float = 6.0
    """Ratio of the samples that are drawn from the buffer in each round to the new samples."""
    batch: int = 256
    learning_rate: float = 1.0e-3
    """Initial learning rate; it decreases linearly to zero."""
    auxiliary: float = 0.3
    """Weight of the squared error of the predicted teacher's observation."""
    colour: float = 0.3
    """Strength of the colour and brightness augmentation of pictures, since waters differ much in both."""
    hidden: tuple[int, ...] = (128, 64)
    """Units of the layers behind the encoder, ELU."""


def varied(pictures: torch.Tensor, amount: float) -> torch.Tensor:
    """Augment pictures as in other water, light and cameras, each with its own change of colours.

    Channels are mixed, a brightness gradient is added from top to bottom, for a sonar from left to right, contrast is
    changed by a power, and noise is added.

    Args:
        pictures: Pictures, uint8 (N, height, width, channels).
        amount: Standard deviation of the changes [-].

    Returns:
        Pictures, float32 of the same shape, 0 to 255.
    """
    n, rows, _, channels = pictures.shape
    draw = {"device": pictures.device, "dtype": torch.float32}
    mix = torch.eye(channels, **draw) + amount * torch.randn(n, channels, channels, **draw)
    slope = (
        amount
        * torch.randn(n, 1, 1, channels, **draw)
        * torch.linspace(-0.5, 0.5, rows, **draw)[:, None, None]
    )
    x = (pictures.flatten(1, 2) / 255.0 @ mix).view(pictures.shape) + slope
    x = x.clamp(1e-3, 1.0) ** torch.exp(amount * torch.randn(n, 1, 1, 1, **draw))
    return 255.0 * (x + 0.1 * amount * torch.randn(pictures.shape, **draw)).clamp(0.0, 1.0)


class Distill(ActingLearner):
    """A teacher, and a student that observes pictures."""

    Settings = DistillSettings
    settings: DistillSettings

    def __init__(
        self, environment: Environment, settings: DistillSettings, *, seed: int, device: str = "cpu"
    ) -> None:
        """Set up the student; the teacher is trained in the first update."""
        super().__init__(environment, settings)
        torch.manual_seed(seed)
        age_episodes(environment)
        self._seed, self.device, self._tensors = seed, device, Tensors(environment)
        assert environment.sight is not None  # the catalogue refuses other tasks
        self._taught = wp.to_torch(environment.arrays.taught)
        self._pictures = {name: wp.to_torch(x) for name, x in environment.sight.pictures.items()}
        shapes = {name: tuple(x.shape[1:]) for name, x in self._pictures.items()}
        n, m, taught = environment.observation_size, environment.action_size, self._taught.shape[1]
        self.student = SeeingNetwork(n, shapes, m, hidden=settings.hidden).to(device)
        self._predictor = nn.Linear(self.student.layers[0].in_features - n, taught).to(device)
        self._parameters = [*self.student.parameters(), *self._predictor.parameters()]
        self.optimizer = torch.optim.Adam(self._parameters, lr=settings.learning_rate)
        columns = {"row": (n,), "taught": (taught,), "action": (m,)}
        self._kept = {
            **{name: torch.empty(settings.kept, *shape, device=device) for name, shape in columns.items()},
            **{
                name: torch.empty(settings.kept, *shape, dtype=torch.uint8, device=device)
                for name, shape in shapes.items()
            },
        }
        self._count = self._rounds = 0
        self.teacher: Network | None = None
        self.teacher_held = 0.0
        """Success rate of the teacher's last episodes, during its exploration."""

    def _train_teacher(self) -> None:
        """Train the teacher by PPO on the task's `teacher` observation."""
        e, s = self.environment, self.settings
        environment = Environment(
            e.task.for_teacher(), e.simulator.vehicles, nominal=e.nominal, worlds=s.teacher_worlds,
            hydrodynamics=e.simulator.hydrodynamics, action=e.action_mode, wrench_scale=e.wrench_scale,
            randomization=e.randomization, noise=e.noise, device=str(e.device), seed=e.seed,
        )  # fmt: skip
        settings = Ppo.settings_for(environment.task, {}, s.teacher_worlds, s.teacher_steps)
        ppo = Ppo(environment, settings, seed=self._seed, device=self.device)
        while ppo.steps < settings.steps:
            environment.set_progress(ppo.steps / settings.steps)
            row = ppo.update()
        self.teacher, self.teacher_held = ppo.network(), row["held"]

    def update(self) -> dict[str, float]:
        """Run one rollout, labelled by the teacher, and regression on the sample buffer.

        The result is a row of the training curve, in the units of the curve.
        """
        if self.teacher is None:
            self._train_teacher()
        s, fresh = self.settings, self.environment.worlds * self.settings.rollout
        with torch.no_grad():
            self._roll_out()
        if self._rounds == 0:
            rows = self._kept["row"][: self._count]
            self.student.mean[:] = rows.mean(0)
            self.student.scale[:] = 1.0 / rows.std(0, correction=0).clamp(min=LEAST_DEVIATION)
        self._rounds += 1
        self.steps += fresh
        loss, prediction = self._fit(max(1, round(s.passes * fresh / s.batch)))
        row = {"imitation_loss": loss, "prediction_loss": prediction, "teacher_held": self.teacher_held}
        return {**self.tally.row(), **row}

    def _roll_out(self) -> None:
        teacher_drives = self._rounds < self.settings.expert_rounds
        worlds = self.environment.worlds
        for _ in range(self.settings.rollout):
            row = self._tensors.observation[:, 0]
            label = self._labels()
            first = self._count % self.settings.kept
            index = (first + torch.arange(worlds)) % self.settings.kept
            samples = {"row": row, "taught": self._taught, "action": label, **self._pictures}
            for name, values in samples.items():
                self._kept[name][index] = values
            self._count += worlds
            action = label if teacher_drives else self.student(row, **self._pictures).clamp(-1.0, 1.0)
            self._tensors.step(action)
            self.tally.look()

    def _labels(self) -> torch.Tensor:
        """Return the teacher's actions, (worlds, m)."""
        assert self.teacher is not None
        rows = self._taught.numpy() if self.device == "cpu" else self._taught
        action, _ = self.teacher.step(rows, None)
        return torch.as_tensor(action).clamp(-1.0, 1.0)

    def _fit(self, batches: int) -> tuple[float, float]:
        """Fit batches drawn with replacement; return mean squared errors of the action and of the teacher's
        observation."""
        s, total = self.settings, torch.zeros(2, device=self.device)
        for group in self.optimizer.param_groups:
            group["lr"] = s.learning_rate * max(self.remaining, 0.02)
        for _ in range(batches):
            index = torch.randint(min(self._count, s.kept), (s.batch,), device=self.device)
            batch = {name: values[index] for name, values in self._kept.items()}
            batch |= {name: varied(batch[name], s.colour) for name in self._pictures}
            features = self.student.encode(batch)
            loss = nn.functional.mse_loss(self.student.act(batch["row"], features), batch["action"])
            prediction = nn.functional.mse_loss(self._predictor(features), batch["taught"])
            self.optimizer.zero_grad()
            (loss + s.auxiliary * prediction).backward()
            self.optimizer.step()
            total += torch.stack([loss, prediction]).detach()
        return tuple((total / batches).tolist())  # type: ignore[return-value]

    def network(self) -> nn.Module:
        """Return the map from numbers and pictures to the student's action."""
        return self.student

    def learned(self) -> dict[str, Any]:
        """Return networks, optimiser, sample buffer, and the teacher."""
        return {
            "student": self.student.state_dict(),
            "predictor": self._predictor.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "kept": {name: values[: self._count] for name, values in self._kept.items()},
            "counts": [self._count, self._rounds],
            "teacher": [
                [layer.weight, layer.bias] for layer in self.teacher.layers if isinstance(layer, Linear)
            ]
            if self.teacher
            else None,
            "teacher_held": self.teacher_held,
        }

    def load_learned(self, state: dict[str, Any]) -> None:
        """Restore the state that `learned` returned.

        Raises:
            ResumeError: The state is of a version whose students did not scale their numbers.
        """
        if "mean" not in state["student"]:
            raise ResumeError("the checkpoint is of an earlier version: leave out --resume")
        self.student.load_state_dict(state["student"])
        self._predictor.load_state_dict(state["predictor"])
        self.optimizer.load_state_dict(state["optimizer"])
        for name, values in state["kept"].items():
            self._kept[name][: len(values)] = values
        self._count, self._rounds = state["counts"]
        if state["teacher"] is not None:
            layers = [part for W, b in state["teacher"] for part in (Linear(W, b), Activation("Tanh"))]
            self.teacher = Network(tuple(layers[:-1]))
        self.teacher_held = state["teacher_held"]
