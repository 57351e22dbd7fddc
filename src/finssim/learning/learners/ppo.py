"""PPO (Schulman et al. 2017), the learner of `finssim train`: one file, with hand-written gradients.

It uses NumPy on a CPU, without torch, and the same code with torch on a GPU, on the environment's own memory. Several
agents of a world are separate rows and share the networks.

    rollout     every row acts for T control steps: a ~ N(μ(x), σ²)
    advantage   A_t = Σ (γ λ)^k δ_(t+k),  δ_t = r_t + γ V(x_(t+1)) - V(x_t)                     (Schulman et al. 2016)
    policy      minimise -E min(ρ A, clip(ρ, 1 ± ε) A) - c H,  ρ = π(a|x) / π_old(a|x)
    value       minimise E (V(x) - A - V_old(x))² / 2

An optional teacher is imitated first: for a fraction of the steps the policy learns the teacher's action for every
observation (DAgger, Ross et al. 2011), while the value learns the resulting returns:

    policy      minimise E |μ(x) - a_teacher|² / 2

If the time limit ends an episode, the return includes the value of its last observation; if the task ends it, nothing
follows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from finssim.agents.agent import NOWHERE
from finssim.agents.memory import memory_from, memory_leaves, restarted
from finssim.control.guidance import Known
from finssim.learning.adapter import age_episodes
from finssim.learning.layers import Adam, Array, Arrays, FreeRow, Gru, NetworkParameters, TanhLayers
from finssim.learning.learners.base import ActingLearner, expert_in
from finssim.learning.network import Activation, Cell, Linear, Network, advance_history, with_integrals
from finssim.tasks import Environment

ROLLOUT_SAMPLES = 4096
"""Fewest samples between two updates: with few worlds, rollouts are longer."""


@dataclass(frozen=True, kw_only=True)
class PpoSettings:
    """Default settings; task-specific ones are in `task_settings`."""

    worlds: int = 256
    steps: int = 400_000
    """Control steps, summed over all worlds."""
    rollout: int = 16
    """T, control steps of each world between two updates."""
    batch: int = 512
    """Samples in a gradient step. For equal computation, many small steps learn faster here than few large ones."""
    epochs: int = 3
    """Passes over a rollout."""
    learning_rate: float = 4.0e-3
    """Initial learning rate; it decreases linearly to zero, which yields the last centimetres."""
    discount: float = 0.98
    """Discount factor γ per control step: 5 s of foresight at 10 Hz, a few time constants of the vehicle."""
    gae_lambda: float = 0.95
    """Factor λ of the generalised advantage."""
    clip: float = 0.2
    """Bound ε on the ratio of probabilities, less 1."""
    largest_gradient: float = 0.5
    """Norm to which larger gradients of policy and value are clipped, so that an outlier batch does not undo many
    others."""
    entropy_weight: float = 0.0
    """Weight c of the entropy; 0 by default, because rewarded noise would keep the vehicle from settling."""
    log_std: float = -1.0
    """Logarithm of the initial standard deviation of the action noise; more noise hides the goal's last
    centimetres."""
    hidden: tuple[int, ...] = (64, 64)
    """Units of the hidden layers, tanh, of policy and value each."""
    normalize: bool = False
    """True to scale observations by their running mean and standard deviation, which become part of the policy."""
    history: int = 0
    """Number of previous observations in the policy's input, besides the newest."""
    last_action: bool = False
    """True if the policy observes its last action."""
    integral: bool = True
    """True to add the integrals of the task's `errors`, if it names any, to these errors, so that no error
    persists."""
    memory: int = 0
    """Units of a GRU in front of the policy's hidden layers, as a memory of unobserved quantities; 0: none."""
    asymmetric: bool = True
    """True if the value observes the randomised parameters, which the policy does not."""
    teacher: str = ""
    """Controller to imitate first: a baseline of the task by name, or a policy directory; none if empty."""
    taught: float = 0.2
    """Fraction of the steps with imitation; in the first third of these the teacher also acts."""
    recorded: bool = True
    """True if a GPU replays recordings of its kernels (CUDA graphs), except with a teacher or several processes."""


class Ppo(ActingLearner):
    """PPO on a batched environment. Arrays are (time, rows, ...), with a row for each agent of each world."""

    Settings = PpoSettings
    rollout_samples = ROLLOUT_SAMPLES
    gpu_factor = 64

    def __init__(
        self,
        environment: Environment,
        settings: PpoSettings,
        *,
        seed: int,
        device: str = "cpu",
        arrays: Arrays | None = None,
    ) -> None:
        """Set up networks and optimisers, and age the first episodes.

        Args:
            environment: Environment, whose episodes the learner controls from now on.
            settings: Settings of the training.
            seed: Seed of initial weights, action noise and the order of samples.
            device: cpu or cuda.
            arrays: Library of arrays; by default NumPy on a CPU and torch on a GPU; required with several processes.
        """
        self.arrays = A = arrays or Arrays(seed, None if device == "cpu" else device)
        super().__init__(environment, settings, A)
        age_episodes(environment)
        s, e = settings, environment
        self._rows, n, m = e.worlds * e.agents, e.observation_size, e.action_size
        self._observation, self._final = self._views("observation"), self._views("final_observation")
        self._action, self._reward = self._views("action"), self._views("agent_reward").reshape(-1)
        self._terminated, self._truncated = A.view(e.arrays.terminated), A.view(e.arrays.truncated)
        has_privileged = s.asymmetric and e.arrays.privileged.size > 0
        self._drawn, self._final_drawn = (
            self._views(name) if has_privileged else None for name in ("privileged", "final_privileged")
        )
        self._window = s.history * n + (m if s.last_action else 0)
        drawn = 0 if self._drawn is None else self._drawn.shape[1]
        inputs = n + self._window
        judged = inputs + s.memory + drawn
        self.gru = Gru(A, inputs, s.memory) if s.memory else None
        self.actor, self.noise = TanhLayers(A, [s.memory or inputs, *s.hidden, m]), FreeRow(m)
        self.critic = TanhLayers(A, [judged, *s.hidden, 1])
        self._policy = NetworkParameters(A, self.actor, self.noise, *([self.gru] if self.gru else []))
        self._value = NetworkParameters(A, self.critic)
        self.actor.initialize(last_gain=0.01)  # begin at action 0 for any observation
        self.critic.initialize(last_gain=1.0)
        self.noise.values[:] = s.log_std
        if self.gru:
            self.gru.initialize()
        self._optimizers = [Adam(p, A, s.largest_gradient) for p in (self._policy, self._value)]
        self._mean, self._variance, self._seen = A.zeros(n), A.zeros(n) + 1.0, 0
        self._memory = A.zeros(self._rows, self._window + s.memory)
        self._errors = e.task.errors if s.integral else ()
        self._integral = A.zeros(self._rows, len(self._errors))
        self._x = A.empty(s.rollout + 1, self._rows, inputs)
        """Inputs of the policy."""
        self._c = self._x if judged == inputs else A.empty(s.rollout + 1, self._rows, judged)
        """Inputs of the critic."""
        self._u, self._noise = A.empty(s.rollout, self._rows, m), A.empty(self._rows, m)
        self._teacher = expert_in(environment, s.teacher) if s.teacher else None
        self._fresh = self._teacher.reset(self._rows) if self._teacher else None
        self._remembered = self._fresh
        """Memory of the teacher."""
        self._label = A.empty(s.rollout, self._rows, m) if self._teacher else None
        """Actions of the teacher."""
        self._r, self._go, self._density = (A.empty(s.rollout, self._rows) for _ in range(3))
        """Rewards; 0 where an episode ended, otherwise 1; log densities of the actions, without the term common to
        all."""
        self._advantage, self._target = (A.empty(s.rollout, self._rows) for _ in range(2))
        """Advantages, and targets of the value."""
        self._before, self._old_log_std = A.zeros(self._rows, s.memory), A.zeros(m)
        """Memory of the GRU before the rollout, and the action noise at that time."""
        self._losses = A.zeros(4)
        """Sums over the gradient steps of an update."""
        # A teacher acts on the host, which cannot be recorded.
        recorded = A.recorded if s.recorded and self._teacher is None else lambda function: function
        self._decide = [recorded(partial(self._act, t)) for t in range(s.rollout)]
        self._conclude = [recorded(partial(self._close, t)) for t in range(s.rollout)]
        self._judge, self._take_step = recorded(self._advantages), recorded(self._gradient_step)

    def _views(self, name: str) -> Array:
        """Return an array of the environment, with a row for each agent."""
        return self.arrays.view(getattr(self.environment.arrays, name)).reshape(self._rows, -1)

    def update(self) -> dict[str, float]:
        """Run one rollout, and `epochs` passes over it; return a row of the training curve.

        The row has the units of the curve.
        """
        rate = self.settings.learning_rate * self.remaining
        with self.arrays.plain():
            self._before[:] = self._memory[:, self._window :]
            self._roll_out()
            self._judge()
            losses = self._learn(rate)
            if self.settings.normalize:
                self._rescale()
        self.steps += self.environment.worlds * self.arrays.processes * self.settings.rollout
        return {**self.tally.row(), **losses}

    # Rollout

    def _roll_out(self) -> None:
        """Act for `rollout` control steps, and store observations, actions and rewards."""
        for decide, conclude in zip(self._decide, self._conclude, strict=True):
            self.arrays.noise(self._noise)
            decide()
            self.environment.advance()
            conclude()
        self._c[-1] = self._encode(self._integrated(self._observation)[0], self._drawn)[3]

    def _act(self, t: int) -> None:
        """Compute the action of every row in step t."""
        A = self.arrays
        observation, integral = self._integrated(self._observation)
        x, self._x[t], h, judged = self._encode(observation, self._drawn)
        if self._c is not self._x:
            self._c[t] = judged
        action, noise = self._u[t], self._noise
        self._density[t] = -0.5 * (noise * noise).sum(1)
        A.xp.multiply(noise, A.xp.exp(self.noise.values), out=action)
        action += self.actor(self._x[t] if h is None else h)
        if self._taught:
            self._ask(t)
        self._action[:] = action
        self._remember(x, action, h)
        self._integral[:] = integral

    @property
    def _taught(self) -> bool:
        """Return whether the teacher is imitated in this update."""
        return self._teacher is not None and 1.0 - self.remaining < self.settings.taught

    def _ask(self, t: int) -> None:
        """Store the teacher's action in step t, and at first execute it."""
        reading = Known(self.arrays.numpy(self._observation))
        answer, self._remembered = self._teacher.act(self._remembered, reading, NOWHERE)  # type: ignore[union-attr]
        label = self._label[t] = self.arrays.array(answer)  # type: ignore[index]
        if 1.0 - self.remaining < self.settings.taught / 3.0:
            self._u[t] = label

    def _integrated(self, observation: Array) -> tuple[Array, Array]:
        """Return the observation with the integrals added to the errors, and the integrals after the step."""
        if not self._errors:
            return observation, self._integral
        return with_integrals(self.arrays.xp, observation, self._integral, self._errors)

    def _encode(self, observation: Array, drawn: Array | None) -> tuple[Array, Array, Array | None, Array]:
        """Return the scaled observation, the policy's input, the output of its GRU, and the critic's input."""
        xp, k = self.arrays.xp, self._window
        x = (observation - self._mean) * self._scale if self.settings.normalize else observation
        policy_input = xp.concatenate([x, self._memory[:, :k]], 1) if k else x
        h = self._cell_of().step(policy_input, self._memory[:, k:]) if self.gru else None
        parts = [part for part in (policy_input, h, drawn) if part is not None]
        return x, policy_input, h, xp.concatenate(parts, 1) if len(parts) > 1 else policy_input

    def _remember(self, x: Array, action: Array, h: Array | None) -> None:
        s, xp, k = self.settings, self.arrays.xp, self._window
        if k:
            last = xp.clip(action, -1.0, 1.0) if s.last_action else None
            self._memory[:, :k] = advance_history(xp, self._memory[:, :k], x, last, s.history)
        if h is not None:
            self._memory[:, k:] = h

    def _close(self, t: int) -> None:
        """Store the result of step t; if the time limit ended an episode, add the value of its last observation to the
        reward."""
        A, e = self.arrays, self.environment
        self.tally.look()
        self._r[t], self._go[t] = self._reward, 1.0
        terminated, truncated = self._terminated != 0, self._truncated != 0
        done = terminated | truncated
        if A.device is None and not done.any():
            return  # on a GPU, the test takes longer than continuing
        late, done = (
            A.xp.broadcast_to(mask[:, None], (e.worlds, e.agents)).reshape(-1)
            for mask in (truncated & ~terminated, done)
        )
        value = self.critic(self._encode(self._integrated(self._final)[0], self._final_drawn)[3])[:, 0]
        self._r[t] += self.settings.discount * A.xp.where(late, value, 0.0 * value)
        self._go[t] = A.xp.where(done, 0.0 * value, 0.0 * value + 1.0)
        if self._taught:
            ended = A.numpy(done)
            self._remembered = restarted(self._remembered, self._fresh, ended)
        self._memory *= self._go[t][:, None]
        self._integral *= self._go[t][:, None]

    # Advantage

    def _advantages(self) -> None:
        """Compute the advantages and the targets of the value."""
        s = self.settings
        value = self.critic(self._c.reshape(-1, self._c.shape[2])).reshape(s.rollout + 1, self._rows)
        after = self.arrays.zeros(self._rows)
        for t in reversed(range(s.rollout)):
            delta = self._r[t] + s.discount * self._go[t] * value[t + 1] - value[t]
            after = self._advantage[t] = delta + s.discount * s.gae_lambda * self._go[t] * after
        self._target[:] = self._advantage + value[:-1]

    # Learning

    def _learn(self, rate: float) -> dict[str, float]:
        """Make gradient steps on samples in random order; with a GRU, on complete rows in random order."""
        A, s, T = self.arrays, self.settings, self.settings.rollout
        n, size = (self._rows, s.batch // T) if self.gru else (T * self._rows, s.batch)
        size = max(1, size // A.processes)
        edges = [n * k // max(1, n // size) for k in range(max(1, n // size) + 1)]
        self._old_log_std[:] = self.noise.values
        self._losses[:] = 0.0
        steps = s.epochs * (len(edges) - 1)
        schedules = [optimizer.schedule(rate, steps) for optimizer in self._optimizers]
        rates = zip(*schedules, strict=True)
        for _ in range(s.epochs):
            order = A.order(n)
            for first, last in zip(edges, edges[1:], strict=False):
                self._take_step(order[first:last], *next(rates))
        means = A.numpy(self._losses / float(steps)).tolist()
        names = ("policy_gradient_loss", "approx_kl", "clip_fraction", "value_loss")
        std = float(A.numpy(A.xp.exp(self.noise.values)).mean())
        return {"action_std": std, **dict(zip(names, means, strict=True))}

    def _gradient_step(self, i: Array, policy_rate: Array, value_rate: Array) -> None:
        """Make one gradient step of policy and value.

        Args:
            i: Indices of the samples; with a GRU, of the rows.
            policy_rate: Row of `Adam.schedule` for the policy.
            value_rate: Row of `Adam.schedule` for the value.
        """
        s, T = self.settings, self.settings.rollout
        actions = self._label if self._taught else self._u
        samples = (self._x[:T], self._c[:T], actions, self._advantage, self._target, self._density)
        if self.gru is None:
            x, c, u, a, v, density = (part.reshape(T * self._rows, *part.shape[2:])[i] for part in samples)
            y = self.actor(x)
        else:
            x, c, u, a, v, density = (part[:, i] for part in samples)
            y = self.actor(self.gru(x, self._before[i], self._keep()[:, i]).reshape(-1, s.memory))
            c, u, a, v, density = (part.reshape(-1, *part.shape[2:]) for part in (c, u, a, v, density))
        if self._taught:
            self._losses[0] += self._imitate(y, u, policy_rate)
        else:
            self._losses[:3] += self._improve_policy(y, u, a, density - self._old_log_std.sum(), policy_rate)
        self._losses[3] += self._improve_value(c, v, value_rate)

    def _improve_policy(self, mean: Array, u: Array, advantage: Array, old: Array, rate: Array) -> Array:
        """Make one gradient step of the policy, from the actor's outputs `mean` for a batch.

        Args:
            mean: μ, (N, m).
            u: Executed actions, (N, m).
            advantage: A, (N,).
            old: log π_old(u|x) without its constant, (N,).
            rate: Row of `Adam.schedule`.

        Returns:
            The loss, the mean divergence from the old policy, and the clipped fraction of the batch.
        """
        s, xp, log_std = self.settings, self.arrays.xp, self.noise.values
        advantage = advantage - advantage.mean()
        advantage /= xp.sqrt((advantage * advantage).mean()) + 1e-8
        inverse = xp.exp(-log_std)
        z = (u - mean) * inverse
        log_ratio = -0.5 * (z * z).sum(1) - log_std.sum() - old
        ratio = xp.exp(log_ratio)
        free = xp.where(advantage >= 0.0, ratio < 1.0 + s.clip, ratio > 1.0 - s.clip)
        slope = (ratio * advantage * free / -float(len(u)))[:, None]  # derivative of the loss by log π
        self.noise.gradient[:] = (slope * (z * z - 1.0)).sum(0) - s.entropy_weight
        self._step_policy(slope * z * inverse, rate)
        limited = xp.where(free, ratio, xp.clip(ratio, 1.0 - s.clip, 1.0 + s.clip))
        numbers = self.arrays.empty(3)
        numbers[0] = -(limited * advantage).mean()
        numbers[1] = (ratio - 1.0 - log_ratio).mean()
        numbers[2] = xp.where(free, 0.0 * ratio, 0.0 * ratio + 1.0).mean()
        return numbers

    def _step_policy(self, slope: Array, rate: Array) -> None:
        """Make one step of the policy's optimiser, from the derivative of the loss by the actor's outputs, (N, m)."""
        s = self.settings
        slope = self.actor.backward(slope, inputs=self.gru is not None)
        if self.gru:
            self.gru.backward(slope.reshape(s.rollout, -1, s.memory))
        self._optimizers[0].step(rate)

    def _imitate(self, mean: Array, label: Array, rate: Array) -> Array:
        """Make one gradient step towards the teacher's actions, (N, m); return the loss."""
        error = mean - label
        self.noise.gradient[:] = 0.0
        self._step_policy(error / float(len(error)), rate)
        return 0.5 * (error * error).sum(1).mean()

    def _improve_value(self, judged: Array, target: Array, rate: Array) -> Array:
        """Make one gradient step of the value; return the loss."""
        error = self.critic(judged)[:, 0] - target
        self.critic.backward((error / float(len(error)))[:, None])
        self._optimizers[1].step(rate)
        return 0.5 * (error * error).mean()

    def _keep(self) -> Array:
        """Return 0 where an episode starts with a step of the rollout, otherwise 1; the initial memory is already
        correct."""
        keep = self.arrays.zeros(*self._go.shape) + 1.0
        keep[1:] = self._go[:-1]
        return keep

    def _rescale(self) -> None:
        """Update the running mean and variance with the rollout's observations (Chan et al. 1979)."""
        A, n = self.arrays, self.environment.observation_size
        x = self._x[:-1, :, :n].reshape(-1, n)
        centre = A.average(x.mean(0))
        variance = A.average(((x - centre) ** 2).mean(0)) / self._scale**2
        shift = centre / self._scale
        new = len(x) * A.processes
        total = self._seen + new
        self._mean += shift * (new / total)
        self._variance *= self._seen / total
        self._variance += variance * (new / total) + shift**2 * (self._seen * new / total**2)
        self._seen = total

    @property
    def _scale(self) -> Array:
        return 1.0 / self.arrays.xp.sqrt(self._variance + 1e-6)

    def _cell_of(self, take: Callable[[Array], Array] = lambda array: array) -> Cell:
        """Return the GRU's weights, each transformed by `take`."""
        W_x, b_x, W_h, b_h = map(take, self.gru.weights)  # type: ignore[union-attr]
        return Cell(Linear(W_x, b_x), Linear(W_h, b_h))

    # Interface of a learner

    def network(self) -> Network:
        """Return a copy of the policy with its memory, from observation to mean action; in NumPy after training on
        a CPU."""
        A, s = self.arrays, self.settings
        copy = A.numpy if A.group is not None and A.device == "cpu" else A.copy
        weights = [copy(x) for x in self.actor.weights]
        layers: list[Linear | Activation] = []
        for W, b in zip(weights[::2], weights[1::2], strict=True):
            layers += [Linear(W, b), Activation("Tanh")]
        scaling = {"mean": copy(self._mean), "scale": copy(self._scale)} if s.normalize else {}
        return Network(
            tuple(layers[:-1]),
            errors=self._errors,
            history=s.history,
            last_action=self.environment.action_size if s.last_action else 0,
            observation_size=self.environment.observation_size,
            cell=self._cell_of(copy) if self.gru else None,
            **scaling,
        )

    def _numbers(self) -> dict[str, Array]:
        """Return the arrays of the training's state."""
        numbers = {"mean": self._mean, "variance": self._variance, "memory": self._memory}
        numbers["integral"] = self._integral
        for name, optimizer in zip(("policy", "value"), self._optimizers, strict=True):
            numbers[name] = optimizer.parameters.values
            numbers |= {f"{name}_mean": optimizer.mean, f"{name}_square": optimizer.square}
        return numbers

    def learned(self) -> dict[str, Any]:
        """Return networks, optimisers, scales, memories and random streams."""
        return {
            "teacher": memory_leaves(self._remembered) if self._teacher else None,
            "numbers": {name: self.arrays.numpy(array) for name, array in self._numbers().items()},
            "counts": [self._seen, *(optimizer.count for optimizer in self._optimizers)],
            "streams": self.arrays.state(),
        }

    def load_learned(self, state: dict[str, Any]) -> None:
        """Restore the arrays that `learned` returned."""
        for name, array in self._numbers().items():
            array[...] = self.arrays.array(state["numbers"][name])
        self._seen, *counts = (int(count) for count in state["counts"])
        for optimizer, count in zip(self._optimizers, counts, strict=True):
            optimizer.count = count
        if self._teacher:
            self._remembered = memory_from(state["teacher"], self._fresh)
        self.arrays.load(state["streams"])
