"""Meta-reinforcement learning as a baseline: MAML-TRPO, on the simulator's own states.

    python rl.py --suite ml10               # trains for 20 million steps of the simulator, measures
    python rl.py --suite ml10 --resume      # goes on where an interrupted run stopped

The paper's row "Meta-World" is most probably this method, as Meta-World's benchmark has it (Yu et
al. 2019); the paper does not say. No demonstration, no cloud, no instruction: a small network maps
a state to a Gaussian of actions, and learns from rewards. The state lacks the goal's coordinates.
In a task such as reach nothing else in it depends on the goal, so that only rewards tell the goal.

An iteration does this for each of some goals (`goal_job`), with L as in `GaussianPolicy.loss`:

    1. rollouts with theta: the support set
    2. theta' = theta - alpha * grad L(theta, support)
    3. rollouts with theta': the query set

It ends with one step of TRPO (Schulman et al. 2015) on theta, through the inner step
(`trpo_step`). Both gradients are maml.py's, which works for any loss.

Letters: R rollouts to a goal, T steps of a rollout, S state dim, A action dim, F features of the
baseline, B = R * T.
"""

import argparse
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.sparse.linalg import LinearOperator, cg
from torch import Tensor, nn
from torch.distributions import Normal
from torch.func import functional_call, jvp, vjp, vmap

from common import (
    StopRequest,
    UserError,
    WorkerPool,
    add_settings,
    append_json,
    check_settings,
    command_line,
    locked,
    print_settings,
    progress_bar,
    provenance,
    read_json_lines,
    report_progress,
    run_jobs,
    setting,
    with_flags,
)
from data import write_atomically, write_text
from maml import Params, adapt, meta_gradient
from report import Outcomes, paper_columns, write_report
from simulator import EPISODE_SEEDS, Simulator, episode_seed, evaluation_seed, simulator_of

Batch = dict[str, Tensor]  # "states" (B, S), "actions" (B, A), "advantages" (B,)
# Processes exchange arrays: each tensor would take a file in shared memory.
Arrays = dict[str, np.ndarray]


@dataclass(frozen=True)
class Settings:
    """What a training is made of.

    The defaults come from two baselines that others have written for Meta-World's benchmark, and
    that differ. From Garage's come layers of 128; it has an inner rate of 1e-4, advantages that are
    not normalized, and a bounded standard deviation. From a later one, whose layers have 512, come
    a rate of 0.1, normalized advantages, and a deviation that begins at 1 and is free. Two things
    are ours: an episode has 200 steps, as elsewhere in this project, where both have 500; and goals
    are drawn anew in each iteration, where the benchmark has 50 of each task.
    """

    seed: int = setting(0, "of weights, goals and actions in training", least=0, most=999)
    evaluation_seed: int = setting(0, "of the goals that are measured", least=0, most=999)
    steps: int = setting(20_000_000, "of the simulator, in all rollouts", least=1)
    goals: int = setting(20, "goals of an iteration", least=1)
    rollouts: int = setting(10, "rollouts to a goal, before the inner step and after it", least=1)
    hidden: int = setting(128, "width of the two hidden layers", least=1)
    inner_lr: float = setting(0.1, "learning rate of the inner step", least=0)
    discount: float = setting(0.99, "of rewards, for each step", least=0, most=1)
    gae_lambda: float = setting(1.0, "of generalized advantage estimation", least=0, most=1)
    max_kl: float = setting(0.01, "bound on the mean KL divergence of one iteration", least=0)
    cg_iterations: int = setting(10, "of conjugate gradients", least=1)
    damping: float = setting(1e-5, "added to the Fisher matrix's diagonal", least=0)
    backtracks: int = setting(15, "steps that the line search tries", least=1)
    backtrack_ratio: float = setting(
        0.8, "the line search multiplies the step by this each time", least=0, most=1
    )
    episodes: int = setting(20, "goals of each task that are measured", least=1)

    def __post_init__(self) -> None:
        check_settings(self)


# ---- Policy --------------------------------------------------------------------------------------


class GaussianPolicy(nn.Module):
    """States to a Gaussian of actions, whose standard deviation is the same everywhere.

    Weights begin as those of Glorot and Bengio (2010), as in other implementations. PyTorch's own
    are smaller, most of all in the last layer, and then an inner step hardly changes the actions.
    """

    def __init__(self, state_dim: int, action_dim: int, hidden: int):
        super().__init__()
        self.shape = (state_dim, action_dim, hidden)
        self.mean = nn.Sequential(
            nn.Linear(state_dim, hidden),
            nn.Tanh(),
            nn.Linear(hidden, hidden),
            nn.Tanh(),
            nn.Linear(hidden, action_dim),
        )
        for layer in self.mean:
            if isinstance(layer, nn.Linear):
                nn.init.xavier_uniform_(layer.weight)
                nn.init.zeros_(layer.bias)
        self.log_std = nn.Parameter(torch.zeros(action_dim))

    def forward(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """(..., S) -> means (..., A) and the logarithm of the standard deviation (A,)."""
        return self.mean(states), self.log_std

    def loss(self, params: Params, batch: Batch) -> Tensor:
        """The loss (), -E[log p(a | s) A], whose negative gradient is the policy gradient.

        The inner step descends it, and the outer gradient is taken of it, too. TRPO's outer loss is
        -E[r A], where r is the ratio of the action's probabilities under the new and the old
        policy. Its gradient is needed only at the old policy, and there, where r = 1, it is that
        of this loss. The line search uses TRPO's loss itself (`surrogate_loss_and_kl`).
        """
        mean, log_std = functional_call(self, params, batch["states"])
        return -(log_probability(mean, log_std, batch["actions"]) * batch["advantages"]).mean()


def to_arrays(params: Params) -> Arrays:
    """Parameters as arrays of their own."""
    return {name: p.detach().numpy().copy() for name, p in params.items()}


def policy_of(weights: Arrays) -> GaussianPolicy:
    """The policy that has these weights."""
    hidden, state_dim = weights["mean.0.weight"].shape
    policy = GaussianPolicy(state_dim, len(weights["log_std"]), hidden)
    policy.load_state_dict({name: torch.from_numpy(x) for name, x in weights.items()})
    return policy


def mean_action(weights: Arrays, state: np.ndarray) -> np.ndarray:
    """`GaussianPolicy.mean` of a state (S,): the action (A,). For one state NumPy is quicker."""
    x = state
    for layer in ("mean.0", "mean.2"):
        x = np.tanh(weights[f"{layer}.weight"] @ x + weights[f"{layer}.bias"])
    return weights["mean.4.weight"] @ x + weights["mean.4.bias"]


def log_probability(mean: Tensor, log_std: Tensor, actions: Tensor) -> Tensor:
    """(..., A) each -> (...): of actions under Gaussians."""
    gaussian = Normal(mean, log_std.exp(), validate_args=False)
    return gaussian.log_prob(actions).sum(-1)


# ---- Rollouts and advantages ---------------------------------------------------------------------


@dataclass
class Rollouts:
    """R rollouts to one goal."""

    states: np.ndarray  # (R, T, S)
    actions: np.ndarray  # (R, T, A)
    rewards: np.ndarray  # (R, T)
    successes: np.ndarray  # (R, T) bool


@lru_cache(maxsize=16)  # one takes 0.1 GB, and a suite can have hundreds of tasks
def environment(simulator: Simulator, task: str) -> Any:
    """The environment of a task. Each process keeps the 16 that it used last."""
    env = simulator.make(task, simulator.recipe["num_points"])
    if not hasattr(env, "state_without_goal"):
        raise UserError(
            f"{simulator.name} has no low-dimensional states: use one of Meta-World's suites, such "
            "as ml10"
        )
    return env


@dataclass(frozen=True)
class Goal:
    """A goal of a task, with the seeds of its episode and of the actions."""

    task: str
    seed: int  # of the episode: its start and its goal
    noise_seed: tuple[int, ...]  # of the actions


def draw_noise(goal: Goal, rollouts: int, steps: int, action_dim: int) -> np.ndarray:
    """The standard normal numbers (R, T, A) float32 that actions are drawn with."""
    rng = np.random.default_rng(goal.noise_seed)
    return rng.standard_normal((rollouts, steps, action_dim), dtype=np.float32)


def roll_out(env: Any, weights: Arrays, goal: Goal, noise: np.ndarray) -> Rollouts:
    """Rolls a policy out, always from the same start to the same goal.

    Args:
        env: an environment that has `state_without_goal`.
        weights: the policy's.
        goal: where to.
        noise: (R, T, A), see `draw_noise`; zeros give the means.
    """
    std = np.exp(weights["log_std"])
    states, actions, rewards, successes = [], [], [], []  # of all steps, one after the other
    for noise_of_rollout in noise:
        env.begin(goal.seed)
        for noise_of_step in noise_of_rollout:
            state = env.state_without_goal()
            action = mean_action(weights, state) + std * noise_of_step
            reward, _, info = env.advance(action)
            states.append(state)
            actions.append(action)
            rewards.append(reward)
            successes.append(info["success"])
    R, T, A = noise.shape
    return Rollouts(
        states=np.array(states).reshape(R, T, -1),
        actions=np.array(actions).reshape(R, T, A),
        rewards=np.array(rewards).reshape(R, T),
        successes=np.array(successes).reshape(R, T),
    )


def discounted_sums(x: np.ndarray, discount: float) -> np.ndarray:
    """y with y[:, t] = x[:, t] + discount * y[:, t + 1]; (R, T) -> (R, T)."""
    sums = np.zeros_like(x)
    later = np.zeros(len(x))
    for t in reversed(range(x.shape[1])):
        later = x[:, t] + discount * later
        sums[:, t] = later
    return sums


def baseline_values(rollouts: Rollouts, returns: np.ndarray) -> np.ndarray:
    """What a linear function of state and time says of the returns it is fitted to, (R, T).

    The features are those of Duan et al. (2016): the state, its squares, and time to the power of
    0, 1, 2 and 3.
    """
    states = np.clip(rollouts.states.astype(np.float64), -10, 10)  # (R, T, S)
    time_of_step = np.broadcast_to(np.arange(states.shape[1]) / 100, states.shape[:2])  # (R, T)
    powers = np.stack([time_of_step**n for n in range(4)], axis=-1)
    features = np.concatenate([states, states**2, powers], axis=-1)  # (R, T, F)
    x = features.reshape(-1, features.shape[-1])  # (B, F)
    ridge = 1e-5 * np.eye(x.shape[1])
    weights = np.linalg.solve(x.T @ x + ridge, x.T @ returns.reshape(-1))
    return features @ weights


def to_batch(rollouts: Rollouts, settings: Settings) -> Arrays:
    """The states and actions of rollouts, with the advantages of the actions.

    Those are of generalized advantage estimation (Schulman et al. 2016), with mean 0 and standard
    deviation 1.
    """
    rewards = rollouts.rewards
    values = baseline_values(rollouts, discounted_sums(rewards, settings.discount))
    # The end of an episode counts as terminal, as in the benchmark: the baseline knows the time.
    next_values = np.concatenate([values[:, 1:], np.zeros((len(values), 1))], axis=1)
    deltas = rewards + settings.discount * next_values - values
    advantages = discounted_sums(deltas, settings.discount * settings.gae_lambda)
    advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    batch = {
        "states": rollouts.states.reshape(-1, rollouts.states.shape[-1]),
        "actions": rollouts.actions.reshape(-1, rollouts.actions.shape[-1]),
        "advantages": advantages.reshape(-1),
    }
    return {name: x.astype(np.float32) for name, x in batch.items()}


def to_tensors(batch: Arrays) -> Batch:
    """A batch that a process returned."""
    return {name: torch.from_numpy(x) for name, x in batch.items()}


def adapted_weights(weights: Arrays, support: Arrays, settings: Settings) -> Arrays:
    """The weights after one inner step on rollouts to a goal."""
    policy = policy_of(weights)
    params = {name: p.detach() for name, p in policy.named_parameters()}
    return to_arrays(adapt(policy.loss, params, to_tensors(support), lr=settings.inner_lr))


# ---- One iteration -------------------------------------------------------------------------------


# What random numbers are for: streams of different purposes never have the same seed.
ORDER, TRAINING, MEASURING = range(3)


@dataclass
class Sample:
    """The batch that rollouts to a goal make, with their mean return and success."""

    batch: Arrays
    mean_return: float
    success: float  # the share of rollouts that were a success at any step


def to_sample(rollouts: Rollouts, settings: Settings) -> Sample:
    """What `trpo_step` and the log need of rollouts."""
    return Sample(
        batch=to_batch(rollouts, settings),
        mean_return=float(rollouts.rewards.sum(axis=1).mean()),
        success=float(rollouts.successes.any(axis=1).mean()),
    )


def goal_job(
    goal: Goal, simulator: Simulator, weights: Arrays, settings: Settings
) -> tuple[Sample, Sample]:
    """Rollouts to one goal before and after the inner step: support and query."""
    R, T, A = settings.rollouts, simulator.episode_steps, len(weights["log_std"])
    env = environment(simulator, goal.task)
    noise = draw_noise(goal, 2 * R, T, A)
    support = to_sample(roll_out(env, weights, goal, noise[:R]), settings)
    report_progress(goal.task, R * T)
    adapted = adapted_weights(weights, support.batch, settings)
    query = to_sample(roll_out(env, adapted, goal, noise[R:]), settings)
    report_progress(goal.task, R * T)
    return support, query


def stack(batches: Sequence[Batch]) -> Batch:
    """Batches of several goals as one: "states" (goals, B, S) ..."""
    return {name: torch.stack([batch[name] for batch in batches]) for name in batches[0]}


def flatten(params: Params) -> Tensor:
    """All parameters as one vector."""
    return torch.cat([p.reshape(-1) for p in params.values()])


def unflatten(vector: Tensor, like: Params) -> Params:
    """The parameters that `flatten` made a vector of; `like` has their names and shapes."""
    parts = vector.split([p.numel() for p in like.values()])
    return {name: part.view_as(p) for (name, p), part in zip(like.items(), parts)}


class AdaptedPolicies:
    """The policies of several goals after their inner steps, as functions of theta.

    Args:
        policy: its parameters are not read.
        support, query: the batches of the goals, stacked: "states" (goals, B, S) ...
        inner_lr: of the inner step.
    """

    def __init__(self, policy: GaussianPolicy, support: Batch, query: Batch, inner_lr: float):
        self.policy = policy
        self.support = support
        self.query = query
        self.inner_lr = inner_lr

    def gaussians(self, params: Params) -> tuple[Tensor, Tensor]:
        """theta -> the Gaussians that the adapted policies predict for the query states.

        Returns means (goals, B, A) and logarithms of standard deviations (goals, 1, A).
        """

        def of_goal(support: Batch, states: Tensor) -> tuple[Tensor, Tensor]:
            adapted = adapt(self.policy.loss, params, support, lr=self.inner_lr)
            return functional_call(self.policy, adapted, states)

        mean, log_std = vmap(of_goal)(self.support, self.query["states"])
        return mean, log_std[:, None]

    def fisher_vector_product(self, params: Params, damping: float) -> Callable[[Tensor], Tensor]:
        """The function v -> H v, vectors as `flatten` makes them.

        H is the second derivative, in theta, of the mean KL divergence between the adapted
        policies at theta and at `params`; it is taken at `params`. There the divergence's first
        derivatives are zero, so that H = J^T M J. J is the derivative of the Gaussians in theta.
        M is the divergence's second derivative in the Gaussians, and diagonal: 1 / std^2 for a
        mean, 2 for a log deviation, each divided by how many the mean is taken over.
        """
        (_, log_std), backward = vjp(self.gaussians, params)
        goals, B = self.query["advantages"].shape

        def product(v: Tensor) -> Tensor:
            direction = unflatten(v, params)
            _, (d_mean, d_log_std) = jvp(self.gaussians, (params,), (direction,))  # J v
            d_mean = d_mean * torch.exp(-2 * log_std) / (goals * B)
            (result,) = backward((d_mean, 2 * d_log_std / goals))
            return flatten(result) + damping * v

        return product

    def surrogate_loss_and_kl(
        self, params: Params, old: tuple[Tensor, Tensor]
    ) -> tuple[float, float]:
        """TRPO's outer loss at theta, and the mean KL divergence from `old` to its Gaussians.

        `old` is what `gaussians` gave for the theta that the query actions were drawn with.
        """
        mean, log_std = self.gaussians(params)
        old_mean, old_log_std = old
        actions = self.query["actions"]
        log_p = log_probability(mean, log_std, actions)  # (goals, B)
        old_log_p = log_probability(old_mean, old_log_std, actions)
        ratio = torch.exp(log_p - old_log_p)
        loss = -(ratio * self.query["advantages"]).mean()
        kl = torch.distributions.kl_divergence(
            Normal(old_mean, old_log_std.exp(), validate_args=False),
            Normal(mean, log_std.exp(), validate_args=False),  # the line search refuses NaN
        )
        return loss.item(), kl.sum(-1).mean().item()


def trpo_step(
    policy: GaussianPolicy, support: list[Batch], query: list[Batch], settings: Settings
) -> dict[str, float]:
    """Changes the policy's parameters so that it is better after the inner step.

    The natural gradient H^-1 g gives the direction. The step goes as far as `max_kl` allows, and is
    shortened until the loss falls and the divergence is at most that. If it never does, nothing is
    changed.

    Args:
        policy: it is changed in place.
        support, query: the batches of the goals, of the same goal at the same place.

    Returns:
        Figures of the step: its divergence, "kl" (0 if nothing was changed); how often it was
        shortened, "backtracks"; and TRPO's outer loss before and after it.
    """
    params = {name: p.detach() for name, p in policy.named_parameters()}
    gradient, _, _ = meta_gradient(
        policy.loss, params, list(zip(support, query)), lr=settings.inner_lr, vectorize=len(support)
    )
    adapted = AdaptedPolicies(policy, stack(support), stack(query), settings.inner_lr)
    product = adapted.fisher_vector_product(params, settings.damping)

    g = flatten(gradient).numpy()
    fisher_matrix = LinearOperator(
        shape=(g.size, g.size), matvec=lambda v: product(torch.from_numpy(v)).numpy(), dtype=g.dtype
    )
    direction, _ = cg(fisher_matrix, g, rtol=1e-10, maxiter=settings.cg_iterations)
    curvature = float(direction @ fisher_matrix.matvec(direction))
    # The divergence of a step x is about x H x / 2: this one has max_kl.
    full_step = math.sqrt(2 * settings.max_kl / max(curvature, 1e-12)) * torch.from_numpy(direction)

    with torch.no_grad():
        old = adapted.gaussians(params)
        old_loss = -adapted.query["advantages"].mean().item()  # all ratios are 1
        for n in range(settings.backtracks):
            change = unflatten(settings.backtrack_ratio**n * full_step, params)
            candidate = {name: p - change[name] for name, p in params.items()}
            loss, kl = adapted.surrogate_loss_and_kl(candidate, old)
            if loss < old_loss and kl <= settings.max_kl:
                policy.load_state_dict(candidate)
                return {"kl": kl, "backtracks": n, "loss_before": old_loss, "loss_after": loss}
    return {
        "kl": 0.0,
        "backtracks": settings.backtracks,
        "loss_before": old_loss,
        "loss_after": old_loss,
    }


# ---- Training ------------------------------------------------------------------------------------


def tasks_of_iteration(tasks: Sequence[str], iteration: int, settings: Settings) -> list[str]:
    """The task of each goal of an iteration. How often two tasks come differs by one at most."""
    rng = np.random.default_rng((ORDER, settings.seed, iteration))
    return np.resize(rng.permutation(tasks), settings.goals).tolist()


def iterate(
    pool: WorkerPool,
    simulator: Simulator,
    tasks: Sequence[str],
    policy: GaussianPolicy,
    iteration: int,
    settings: Settings,
    bar: Any,
) -> dict[str, Any]:
    """One iteration: rollouts to all its goals, then a step of TRPO. Returns its figures."""
    goals = [
        Goal(
            task,
            seed=episode_seed(settings.seed, (iteration * settings.goals + i) % EPISODE_SEEDS),
            noise_seed=(TRAINING, settings.seed, iteration, i),
        )
        for i, task in enumerate(tasks_of_iteration(tasks, iteration, settings))
    ]
    weights = to_arrays(dict(policy.named_parameters()))
    jobs = [
        {"goal": goal, "simulator": simulator, "weights": weights, "settings": settings}
        for goal in goals
    ]
    support, query = zip(*pool.run(goal_job, jobs, bar))
    figures_of_step = trpo_step(
        policy,
        support=[to_tensors(sample.batch) for sample in support],
        query=[to_tensors(sample.batch) for sample in query],
        settings=settings,
    )
    success_of_tasks: dict[str, list[float]] = {}
    for goal, sample in zip(goals, query):
        success_of_tasks.setdefault(goal.task, []).append(sample.success)
    return {
        "return_before": float(np.mean([sample.mean_return for sample in support])),
        "return_after": float(np.mean([sample.mean_return for sample in query])),
        "success_before": float(np.mean([sample.success for sample in support])),
        "success_after": float(np.mean([sample.success for sample in query])),
        "success_of_tasks": {task: float(np.mean(x)) for task, x in success_of_tasks.items()},
        "std": np.exp(weights["log_std"]).tolist(),  # of the actions' numbers
        **figures_of_step,
    }


FREE_TO_CHANGE = ("steps", "episodes", "evaluation_seed")  # when a run is resumed


@dataclass
class Run:
    """A training: what is kept of it, so that it can go on."""

    policy: GaussianPolicy
    iteration: int = 0  # iterations that are done
    seconds: float = 0.0  # that they took


SAVED = {"suite", "settings", "shape", "weights", "iteration", "seconds"}


def save(path: Path, run: Run, settings: Settings, suite: str) -> None:
    """Writes all that a run needs to go on."""
    content = {
        "suite": suite,
        "settings": asdict(settings),
        "shape": run.policy.shape,
        "weights": run.policy.state_dict(),
        "iteration": run.iteration,
        "seconds": run.seconds,
    }
    write_atomically(path, lambda temporary: torch.save(content, temporary))


def restore(path: Path, settings: Settings, suite: str) -> Run:
    """The run that `save` wrote.

    Raises UserError if there is none, or one of another suite or other settings than those of
    FREE_TO_CHANGE.
    """
    if not path.exists():
        raise UserError(f"there is no run to resume in {path.parent}: look at --out")
    try:
        saved = torch.load(path, weights_only=True)
    except Exception as error:  # torch.load raises many kinds for a damaged file
        raise UserError(f"{path} is damaged: train again, with another --out") from error
    if not isinstance(saved, dict) or not SAVED <= saved.keys():
        raise UserError(f"{path} is of no run of rl.py: look at --out")
    policy = GaussianPolicy(*saved["shape"])
    policy.load_state_dict(saved["weights"])
    then = {"suite": saved["suite"], **saved["settings"]}
    now = {"suite": suite, **asdict(settings)}
    changed = [
        f"{name} {then.get(name)} -> {value}"
        for name, value in now.items()
        if name not in FREE_TO_CHANGE and then.get(name) != value
    ]
    if changed:
        raise UserError(
            f"{path} was trained with other settings ({', '.join(changed)}): use those, or another "
            "--out"
        )
    return Run(policy, saved["iteration"], saved["seconds"])


def start(simulator: Simulator, suite: str, settings: Settings) -> Run:
    """A run at its beginning."""
    tasks, _ = simulator.tasks(suite)
    env = environment(simulator, tasks[0])
    env.begin(0)
    torch.manual_seed(settings.seed)
    state_dim, action_dim = len(env.state_without_goal()), env.action_space.shape[0]
    return Run(GaussianPolicy(state_dim, action_dim, settings.hidden))


def count_steps(settings: Settings, simulator: Simulator) -> int:
    """The steps of the simulator in one iteration: rollouts before and after the inner step."""
    return 2 * settings.goals * settings.rollouts * simulator.episode_steps


def train(
    run: Run,
    simulator: Simulator,
    suite: str,
    settings: Settings,
    folder: Path,
    workers: int | None,
) -> int:
    """Trains until at least `settings.steps` steps of the simulator are taken; returns how many.

    `run` is changed in place, and saved into `folder` after each iteration.
    """
    tasks, _ = simulator.tasks(suite)
    steps_of_iteration = count_steps(settings, simulator)
    iterations = math.ceil(settings.steps / steps_of_iteration)
    log = folder / "metrics.jsonl"
    kept = [line for line in read_json_lines(log) if line["iteration"] <= run.iteration]
    write_text(log, "".join(f"{json.dumps(line)}\n" for line in kept))

    bar = progress_bar(
        desc="training",
        unit="step",
        unit_scale=True,
        total=iterations * steps_of_iteration,
        initial=run.iteration * steps_of_iteration,
    )
    with StopRequest() as stop, WorkerPool(workers) as pool, bar:
        while run.iteration < iterations:
            began = time.monotonic()
            figures = iterate(pool, simulator, tasks, run.policy, run.iteration, settings, bar)
            run.seconds += time.monotonic() - began
            run.iteration += 1
            append_json(
                log,
                iteration=run.iteration,
                steps=run.iteration * steps_of_iteration,
                seconds=round(run.seconds, 1),
                **figures,
            )
            save(folder / "last.pt", run, settings, suite)
            if stop.requested:
                raise KeyboardInterrupt(
                    f"saved after iteration {run.iteration}, add --resume to go on"
                )
    return run.iteration * steps_of_iteration


# ---- Measuring -----------------------------------------------------------------------------------


def measure_job(
    goal: Goal, simulator: Simulator, weights: Arrays, settings: Settings
) -> tuple[np.ndarray, np.ndarray]:
    """The successes (T,) of one rollout before the inner step, and of one after it.

    Both take the means of the Gaussians. The inner step learns from `rollouts` others with the same
    start and goal.
    """
    env = environment(simulator, goal.task)
    T, A = simulator.episode_steps, len(weights["log_std"])
    noise = draw_noise(goal, settings.rollouts, T, A)
    no_noise = np.zeros((1, T, A), dtype=np.float32)
    before = roll_out(env, weights, goal, no_noise)
    support = to_batch(roll_out(env, weights, goal, noise), settings)
    after = roll_out(env, adapted_weights(weights, support, settings), goal, no_noise)
    report_progress(goal.task, 1)
    return before.successes[0], after.successes[0]


def measure(
    simulator: Simulator,
    tasks: Sequence[str],
    policy: GaussianPolicy,
    settings: Settings,
    workers: int | None,
) -> dict[str, Outcomes]:
    """Rolls the policy out on new goals of each task, before and after an inner step."""
    seed = settings.evaluation_seed
    goals = [
        Goal(task, seed=evaluation_seed(seed, i), noise_seed=(MEASURING, seed, number, i))
        for number, task in enumerate(tasks)
        for i in range(settings.episodes)
    ]
    weights = to_arrays(dict(policy.named_parameters()))
    jobs = [
        {"goal": goal, "simulator": simulator, "weights": weights, "settings": settings}
        for goal in goals
    ]
    results = run_jobs(
        measure_job, jobs, workers=workers, total=len(jobs), description="evaluating", unit="goal"
    )
    outcomes = {}
    for label, successes in zip(("before", "after one inner step"), zip(*results)):
        outcome = Outcomes(
            any_step={task: [] for task in tasks}, at_end={task: [] for task in tasks}
        )
        for goal, steps in zip(goals, successes):
            outcome.any_step[goal.task].append(bool(steps.any()))
            outcome.at_end[goal.task].append(bool(steps[-1]))
        outcomes[label] = outcome
    return outcomes


# ---- Command line --------------------------------------------------------------------------------


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Trains MAML-TRPO on a suite and measures it.")
    parser.add_argument("--suite", default="ml10", help="of Meta-World, such as ml10 (ml10)")
    parser.add_argument("--out", help="folder of the run (runs/rl-SUITE-seedN)")
    parser.add_argument("--resume", action="store_true", help="go on with the run in --out")
    parser.add_argument("--overwrite", action="store_true", help="replace the results in --out")
    parser.add_argument("--workers", type=int, help="processes that roll out (one a core)")
    add_settings(parser, Settings, {"default": Settings()})
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    args = parse(argv)
    settings = with_flags(Settings(), args)
    simulator = simulator_of(args.suite)
    folder = Path(args.out or f"runs/rl-{args.suite}-seed{settings.seed}")
    checkpoint = folder / "last.pt"

    with locked(folder):
        if (folder / "success.json").exists() and not args.overwrite:
            raise UserError(
                f"{folder} already holds results: add --resume --overwrite to go on with its "
                "training, or another --out"
            )
        if args.resume:
            run = restore(checkpoint, settings, args.suite)
        elif checkpoint.exists():
            raise UserError(f"{folder} already holds a run: add --resume, or another --out")
        else:
            run = start(simulator, args.suite, settings)
        steps_of_iteration = count_steps(settings, simulator)
        if run.iteration > math.ceil(settings.steps / steps_of_iteration):
            taken = run.iteration * steps_of_iteration
            raise UserError(f"--steps is {settings.steps}: {taken} are taken already")
        for name in ("success.json", "success.md", "success.png"):
            (folder / name).unlink(missing_ok=True)  # without them, --resume alone goes on
        print_settings(asdict(settings), asdict(Settings()))
        steps = train(run, simulator, args.suite, settings, folder, args.workers)
        base_tasks, novel_tasks = simulator.tasks(args.suite)
        try:
            outcomes = measure(
                simulator, [*base_tasks, *novel_tasks], run.policy, settings, args.workers
            )
        except KeyboardInterrupt:
            advice = "the training is saved, add --resume to measure it"
            raise KeyboardInterrupt(advice) from None
        parts = {"mean of base": base_tasks, "mean of novel": novel_tasks}
        table = write_report(
            folder,
            outcomes,
            {
                "title": f"MAML-TRPO, {args.suite}",
                "steps": steps,
                "training seconds": round(run.seconds),
                "goals a task": settings.episodes,
                "seed": settings.evaluation_seed,
                "training seed": settings.seed,
                **provenance("rl.py", argv, "cpu"),
            },
            parts={name: tasks for name, tasks in parts.items() if tasks},
            paper=paper_columns(args.suite, ["rl"]),
        )
    print(table)


if __name__ == "__main__":
    command_line(main)
