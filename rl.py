"""The paper's reinforcement-learning baseline: MAML-TRPO, on the simulator's own states.

    python rl.py --suite ml10               # trains for 20 million steps of the simulator, measures
    python rl.py --suite ml10 --resume      # goes on where an interrupted run stopped

It is the method of Meta-World's benchmark (Yu et al. 2019), which is most probably what the paper's
row "Meta-World" is. No demonstration, no cloud, no instruction: a small network maps a state to a
Gaussian of actions, and rewards are what it learns from. A task is one goal of one skill, and the
state does not show the goal: only the rewards of a few rollouts tell it.

In each iteration, for each of some tasks (`task_job`)

    1. rollouts with theta: the support set
    2. theta' = theta - alpha * the policy gradient on these rollouts
    3. rollouts with theta': the query set

and then one step of TRPO (Schulman et al. 2015) on theta, through the inner step (`trpo_step`).
Both gradients are maml.py's, which never learns what a loss is about.

Letters: R rollouts of a task, T steps of a rollout, S state dim, A action dim, F features of the
baseline, B = R * T.
"""

import argparse
import json
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache
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


@dataclass(frozen=True)
class Settings:
    """What a training is made of; the defaults are those of Meta-World's benchmark."""

    seed: int = setting(0, "of weights, goals and actions", least=0, most=999)
    steps: int = setting(20_000_000, "of the simulator, in all rollouts", least=1)
    tasks: int = setting(20, "tasks of an iteration", least=1)
    rollouts: int = setting(10, "rollouts of a task, before and after the inner step", least=1)
    hidden: int = setting(128, "width of the two hidden layers", least=1)
    inner_lr: float = setting(0.1, "learning rate of the inner step", least=0)
    discount: float = setting(0.99, "of rewards, for each step", least=0, most=1)
    gae_lambda: float = setting(1.0, "of generalized advantage estimation", least=0, most=1)
    max_kl: float = setting(0.01, "how far an iteration moves the adapted policies", least=0)
    cg_iterations: int = setting(10, "of conjugate gradients", least=1)
    damping: float = setting(1e-5, "added to the Fisher matrix's diagonal", least=0)
    backtracks: int = setting(15, "how often the line search shortens a step", least=1)
    backtrack_ratio: float = setting(0.8, "how much it does each time", least=0, most=1)
    episodes: int = setting(20, "goals of each task that are measured", least=1)

    def __post_init__(self) -> None:
        check_settings(self)


# ---- Policy --------------------------------------------------------------------------------------


class GaussianPolicy(nn.Module):
    """States to a Gaussian of actions, whose standard deviation is the same everywhere."""

    def __init__(self, state_dim: int, action_dim: int, hidden: int):
        super().__init__()
        self.mean = nn.Sequential(
            nn.Linear(state_dim, hidden),
            nn.Tanh(),
            nn.Linear(hidden, hidden),
            nn.Tanh(),
            nn.Linear(hidden, action_dim),
        )
        self.log_std = nn.Parameter(torch.zeros(action_dim))

    def forward(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """(..., S) -> means (..., A) and the logarithm of the standard deviation (A,)."""
        return self.mean(states), self.log_std

    def loss(self, params: Params, batch: Batch) -> Tensor:
        """The loss () whose gradient is the policy gradient, of the policy with these parameters.

        It serves the inner and the outer loop. TRPO's outer loss weighs each action by the ratio of
        its probabilities under the new and the old policy, but where the two are the same, which
        is where a gradient is taken, its gradient is this one.
        """
        mean, log_std = functional_call(self, params, batch["states"])
        return -(log_probability(mean, log_std, batch["actions"]) * batch["advantages"]).mean()


def log_probability(mean: Tensor, log_std: Tensor, actions: Tensor) -> Tensor:
    """(..., A) each -> (...): of actions under Gaussians."""
    gaussian = Normal(mean, log_std.exp(), validate_args=False)
    return gaussian.log_prob(actions).sum(-1)


# ---- Rollouts and advantages ---------------------------------------------------------------------


@dataclass
class Rollouts:
    """R rollouts of one task: arrays (R, T, ...)."""

    states: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    successes: np.ndarray  # bool


@cache
def environment(simulator: Simulator, task: str) -> Any:
    """The environment of a task, which is made once in each process."""
    env = simulator.make(task, simulator.recipe["num_points"])
    if not hasattr(env, "hidden_goal_state"):
        raise UserError(
            f"{simulator.name} tells no states without a goal: use --suite ml10 or ml45"
        )
    return env


def roll_out(env: Any, policy: GaussianPolicy, seed: int, noise: np.ndarray) -> Rollouts:
    """Rolls a policy out, always from the same start to the same goal.

    Args:
        env: an environment of a simulator that has `hidden_goal_state`.
        seed: of the episode: start and goal.
        noise: (R, T, A) standard normal numbers that actions are drawn with; zeros give the means.
    """
    std = policy.log_std.exp().detach().numpy()
    rows = []  # of each step: state, action, reward, success
    for noise_of_rollout in noise:
        env.begin(seed)
        for noise_of_step in noise_of_rollout:
            state = env.hidden_goal_state()
            with torch.inference_mode():
                mean, _ = policy(torch.from_numpy(state))
            action = mean.numpy() + std * noise_of_step
            reward, _, info = env.advance(action)
            rows.append((state, action, reward, info["success"]))
    columns = [np.array(column) for column in zip(*rows)]
    states, actions, rewards, successes = (
        x.reshape(*noise.shape[:2], *x.shape[1:]) for x in columns
    )
    return Rollouts(states, actions, rewards, successes)


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


def to_batch(rollouts: Rollouts, settings: Settings) -> Batch:
    """The states and actions of rollouts, with how much better than usual each action was.

    Generalized advantage estimation (Schulman et al. 2016), made to have mean 0 and deviation 1.
    """
    rewards = rollouts.rewards
    values = baseline_values(rollouts, discounted_sums(rewards, settings.discount))
    next_values = np.concatenate([values[:, 1:], np.zeros((len(values), 1))], axis=1)
    surprises = rewards + settings.discount * next_values - values
    advantages = discounted_sums(surprises, settings.discount * settings.gae_lambda)
    advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    batch = {
        "states": rollouts.states.reshape(-1, rollouts.states.shape[-1]),
        "actions": rollouts.actions.reshape(-1, rollouts.actions.shape[-1]),
        "advantages": advantages.reshape(-1),
    }
    return {name: torch.from_numpy(x.astype(np.float32)) for name, x in batch.items()}


def adapted_policy(policy: GaussianPolicy, support: Batch, settings: Settings) -> GaussianPolicy:
    """The policy after one inner step on the rollouts of a task."""
    params = dict(policy.named_parameters())
    adapted = GaussianPolicy(*policy_shape(policy))
    with torch.no_grad():
        adapted.load_state_dict(adapt(policy.loss, params, support, lr=settings.inner_lr))
    return adapted


def policy_shape(policy: GaussianPolicy) -> tuple[int, int, int]:
    """The arguments of the constructor: state_dim, action_dim, hidden."""
    first, last = policy.mean[0], policy.mean[-1]
    return first.in_features, last.out_features, first.out_features


# ---- One iteration -------------------------------------------------------------------------------


def task_job(
    simulator: Simulator,
    task: str,
    goal_seed: int,
    noise_seed: tuple[int, ...],
    policy: GaussianPolicy,
    settings: Settings,
) -> tuple[Rollouts, Rollouts]:
    """The rollouts of one task before and after the inner step."""
    env = environment(simulator, task)
    _, action_dim, _ = policy_shape(policy)
    shape = (2, settings.rollouts, simulator.episode_steps, action_dim)
    noise = np.random.default_rng(noise_seed).standard_normal(shape, dtype=np.float32)
    before = roll_out(env, policy, goal_seed, noise[0])
    report_progress(task, before.rewards.size)
    adapted = adapted_policy(policy, to_batch(before, settings), settings)
    after = roll_out(env, adapted, goal_seed, noise[1])
    report_progress(task, after.rewards.size)
    return before, after


def flatten(params: Params) -> Tensor:
    """All parameters as one vector."""
    return torch.cat([p.reshape(-1) for p in params.values()])


def unflatten(vector: Tensor, like: Params) -> Params:
    """The parameters that `flatten` made a vector of; `like` has their names and shapes."""
    parts = vector.split([p.numel() for p in like.values()])
    return {name: part.view_as(p) for (name, p), part in zip(like.items(), parts)}


class AdaptedPolicies:
    """The policies of several tasks after their inner steps, as functions of theta.

    Args:
        policy: its parameters are not read.
        support, query: the batches of the tasks, stacked: "states" (tasks, B, S) ...
        inner_lr: of the inner step.
    """

    def __init__(self, policy: GaussianPolicy, support: Batch, query: Batch, inner_lr: float):
        self.policy = policy
        self.support = support
        self.query = query
        self.inner_lr = inner_lr

    def gaussians(self, params: Params) -> tuple[Tensor, Tensor]:
        """theta -> what the adapted policies say at the query states.

        Returns means (tasks, B, A) and logarithms of standard deviations (tasks, 1, A).
        """

        def of_task(support: Batch, states: Tensor) -> tuple[Tensor, Tensor]:
            adapted = adapt(self.policy.loss, params, support, lr=self.inner_lr)
            return functional_call(self.policy, adapted, states)

        mean, log_std = vmap(of_task)(self.support, self.query["states"])
        return mean, log_std[:, None]

    def fisher_product(self, params: Params, damping: float) -> Any:
        """The function v -> H v, vectors as `flatten` makes them.

        H is the second derivative, in theta, of the mean KL divergence between the adapted
        policies at theta and at `params`; it is taken at `params`. There the first derivatives of
        the divergence are zero, so that H = J^T M J: J is the derivative of means and log
        deviations in theta, and M that of the divergence in those: 1 / std^2 and 2.
        """
        (_, log_std), backward = vjp(self.gaussians, params)
        tasks, steps = self.query["advantages"].shape

        def product(v: Tensor) -> Tensor:
            direction = unflatten(v, params)
            _, (d_mean, d_log_std) = jvp(self.gaussians, (params,), (direction,))  # J v
            d_mean = d_mean * torch.exp(-2 * log_std) / (tasks * steps)
            (result,) = backward((d_mean, 2 * d_log_std / tasks))
            return flatten(result) + damping * v

        return product

    def loss_and_divergence(
        self, params: Params, old: tuple[Tensor, Tensor]
    ) -> tuple[float, float]:
        """TRPO's outer loss at theta, and how far its adapted policies are from the old ones.

        `old` is what `gaussians` gave for the theta that the query actions were drawn with.
        """
        mean, log_std = self.gaussians(params)
        actions = self.query["actions"]
        ratio = torch.exp(
            log_probability(mean, log_std, actions) - log_probability(*old, actions)
        )  # (tasks, B)
        loss = -(ratio * self.query["advantages"]).mean()
        old_mean, old_log_std = old
        divergence = torch.distributions.kl_divergence(
            Normal(old_mean, old_log_std.exp()), Normal(mean, log_std.exp())
        )
        return loss.item(), divergence.sum(-1).mean().item()


def trpo_step(
    policy: GaussianPolicy, support: list[Batch], query: list[Batch], settings: Settings
) -> dict[str, float]:
    """Changes the policy's parameters so that it is better after the inner step.

    The natural gradient H^-1 g gives the direction; the step goes as far as `max_kl` allows, and is
    shortened until the loss falls and the divergence is at most that. If it never does, nothing is
    changed. Returns how far it went: "kl", and "backtracks".
    """
    params = {name: p.detach() for name, p in policy.named_parameters()}
    gradient, _, _ = meta_gradient(
        policy.loss, params, list(zip(support, query)), lr=settings.inner_lr, vectorize=len(support)
    )
    adapted = AdaptedPolicies(
        policy,
        support={name: torch.stack([batch[name] for batch in support]) for name in support[0]},
        query={name: torch.stack([batch[name] for batch in query]) for name in query[0]},
        inner_lr=settings.inner_lr,
    )
    product = adapted.fisher_product(params, settings.damping)

    g = flatten(gradient).numpy()
    fisher_matrix = LinearOperator(
        (g.size, g.size), matvec=lambda v: product(torch.from_numpy(v).float()).numpy()
    )
    direction, _ = cg(fisher_matrix, g, rtol=1e-10, maxiter=settings.cg_iterations)
    curvature = float(direction @ fisher_matrix.matvec(direction))
    longest = math.sqrt(2 * settings.max_kl / max(curvature, 1e-12)) * torch.from_numpy(direction)

    with torch.no_grad():
        old = adapted.gaussians(params)
        old_loss, _ = adapted.loss_and_divergence(params, old)
        for n in range(settings.backtracks):
            change = unflatten(settings.backtrack_ratio**n * longest.float(), params)
            candidate = {name: p - change[name] for name, p in params.items()}
            loss, kl = adapted.loss_and_divergence(candidate, old)
            if loss < old_loss and kl <= settings.max_kl:
                policy.load_state_dict(candidate)
                return {"kl": kl, "backtracks": n}
    return {"kl": 0.0, "backtracks": settings.backtracks}


# ---- Training ------------------------------------------------------------------------------------


def tasks_of_iteration(tasks: Sequence[str], iteration: int, settings: Settings) -> list[str]:
    """The skills of an iteration, in an order of its own; each as often as any, or once more."""
    rng = np.random.default_rng((settings.seed, iteration))
    return np.resize(rng.permutation(tasks), settings.tasks).tolist()


def iterate(
    pool: WorkerPool,
    simulator: Simulator,
    tasks: Sequence[str],
    policy: GaussianPolicy,
    iteration: int,
    settings: Settings,
    bar: Any,
) -> dict[str, float]:
    """One iteration: rollouts of all its tasks, then a step of TRPO. Returns its figures."""
    jobs = [
        {
            "simulator": simulator,
            "task": task,
            "goal_seed": episode_seed(
                settings.seed, (iteration * settings.tasks + i) % EPISODE_SEEDS
            ),
            "noise_seed": (settings.seed, iteration, i),
            "policy": policy,
            "settings": settings,
        }
        for i, task in enumerate(tasks_of_iteration(tasks, iteration, settings))
    ]
    results = pool.run(task_job, jobs, bar)
    figures: dict[str, float] = {}
    for when, rollouts in zip(("before", "after"), zip(*results)):
        figures[f"return_{when}"] = float(np.mean([r.rewards.sum(1).mean() for r in rollouts]))
        figures[f"success_{when}"] = float(np.mean([r.successes.any(1) for r in rollouts]))
    support, query = ([to_batch(r, settings) for r in rollouts] for rollouts in zip(*results))
    return {**figures, **trpo_step(policy, support, query, settings)}


def save(
    path: Path, policy: GaussianPolicy, settings: Settings, suite: str, **progress: Any
) -> None:
    """Writes all that a run needs to go on."""
    content = {
        "suite": suite,
        "settings": asdict(settings),
        "shape": policy_shape(policy),
        "weights": policy.state_dict(),
        **progress,
    }
    write_atomically(path, lambda temporary: torch.save(content, temporary))


def restore(path: Path, settings: Settings, suite: str) -> tuple[GaussianPolicy, dict[str, Any]]:
    """The policy of a run, and what else `save` wrote.

    Raises UserError if there is none, or one of another suite or other settings; `steps` and
    `episodes` may differ.
    """
    if not path.exists():
        raise UserError(f"there is no run to resume in {path.parent}: look at --out")
    try:
        saved = torch.load(path, weights_only=True)
        policy = GaussianPolicy(*saved["shape"])
        policy.load_state_dict(saved["weights"])
    except Exception as error:  # torch.load raises many kinds for a damaged file
        raise UserError(f"{path} is damaged: remove its folder and train again") from error
    free = {"steps": settings.steps, "episodes": settings.episodes}
    if saved["suite"] != suite or {**saved["settings"], **free} != asdict(settings):
        raise UserError(f"{path} was trained with other settings: use those, or another --out")
    return policy, saved


def train(
    simulator: Simulator,
    suite: str,
    policy: GaussianPolicy | None,
    settings: Settings,
    folder: Path,
    saved: dict[str, Any],
    workers: int | None,
) -> tuple[GaussianPolicy, float]:
    """Trains until `settings.steps` steps are taken; returns the policy and the seconds.

    `policy` and `saved` are those of `restore`, or None and an empty dictionary.
    """
    tasks, _ = simulator.tasks(suite)
    steps_of_iteration = 2 * settings.tasks * settings.rollouts * simulator.episode_steps
    iterations = math.ceil(settings.steps / steps_of_iteration)
    if policy is None:
        env = environment(simulator, tasks[0])
        env.begin(0)
        torch.manual_seed(settings.seed)
        policy = GaussianPolicy(
            state_dim=len(env.hidden_goal_state()),
            action_dim=len(env.expert_action()),
            hidden=settings.hidden,
        )
    first, seconds = saved.get("iteration", 0), saved.get("seconds", 0.0)
    log = folder / "metrics.jsonl"
    kept = [line for line in read_json_lines(log) if line["iteration"] <= first]
    write_text(log, "".join(f"{json.dumps(line)}\n" for line in kept))

    bar = progress_bar(
        desc="training",
        unit="step",
        unit_scale=True,
        total=iterations * steps_of_iteration,
        initial=first * steps_of_iteration,
    )
    with StopRequest() as stop, WorkerPool(workers) as pool, bar:
        for iteration in range(first, iterations):
            began = time.monotonic()
            figures = iterate(pool, simulator, tasks, policy, iteration, settings, bar)
            seconds += time.monotonic() - began
            done = iteration + 1
            append_json(
                log,
                iteration=done,
                steps=done * steps_of_iteration,
                seconds=round(seconds, 1),
                **figures,
            )
            save(folder / "last.pt", policy, settings, suite, iteration=done, seconds=seconds)
            if stop.requested:
                raise KeyboardInterrupt(f"saved after iteration {done}, add --resume to go on")
    return policy, seconds


# ---- Measuring -----------------------------------------------------------------------------------


def measure_job(
    simulator: Simulator,
    task: str,
    goal_seed: int,
    noise_seed: tuple[int, ...],
    policy: GaussianPolicy,
    settings: Settings,
) -> tuple[np.ndarray, np.ndarray]:
    """The successes (T,) of one rollout before the inner step, and of one after it.

    Both take the means of the Gaussians. The inner step learns from rollouts to the same goal.
    """
    env = environment(simulator, task)
    _, action_dim, _ = policy_shape(policy)
    shape = (settings.rollouts, simulator.episode_steps, action_dim)
    noise = np.random.default_rng(noise_seed).standard_normal(shape, dtype=np.float32)
    no_noise = np.zeros_like(noise[:1])
    before = roll_out(env, policy, goal_seed, no_noise)
    support = to_batch(roll_out(env, policy, goal_seed, noise), settings)
    after = roll_out(env, adapted_policy(policy, support, settings), goal_seed, no_noise)
    report_progress(task, 1)
    return before.successes[0], after.successes[0]


def measure(
    simulator: Simulator,
    tasks: Sequence[str],
    policy: GaussianPolicy,
    settings: Settings,
    workers: int | None,
) -> dict[str, Outcomes]:
    """Rolls the policy out on new goals of each task, before and after an inner step."""
    jobs = [
        {
            "simulator": simulator,
            "task": task,
            "goal_seed": evaluation_seed(settings.seed, i),
            "noise_seed": (settings.seed, i),
            "policy": policy,
            "settings": settings,
        }
        for task in tasks
        for i in range(settings.episodes)
    ]
    results = run_jobs(
        measure_job, jobs, workers=workers, total=len(jobs), description="evaluating", unit="goal"
    )
    outcomes = {}
    for label, successes in zip(("before", "after one inner step"), zip(*results)):
        outcome = Outcomes(any_step={}, at_end={})
        for n, task in enumerate(tasks):
            of_task = successes[n * settings.episodes : (n + 1) * settings.episodes]
            outcome.any_step[task] = [bool(steps.any()) for steps in of_task]
            outcome.at_end[task] = [bool(steps[-1]) for steps in of_task]
        outcomes[label] = outcome
    return outcomes


# ---- Command line --------------------------------------------------------------------------------


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Trains MAML-TRPO on a suite and measures it.")
    parser.add_argument("--suite", default="ml10", help="ml10 or ml45 (ml10)")
    parser.add_argument("--out", help="folder of the run (runs/rl-SUITE-seedN)")
    parser.add_argument("--resume", action="store_true", help="go on with the run in --out")
    parser.add_argument("--workers", type=int, help="processes that roll out (one a core)")
    add_settings(parser, Settings, {"default": Settings()})
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    args = parse(argv)
    settings = with_flags(Settings(), args)
    simulator = simulator_of(args.suite)
    folder = Path(args.out or f"runs/rl-{args.suite}-seed{settings.seed}")
    checkpoint = folder / "last.pt"
    torch.set_num_threads(1)  # the other cores have workers

    with locked(folder):
        policy, saved = None, {}
        if args.resume:
            policy, saved = restore(checkpoint, settings, args.suite)
        elif checkpoint.exists():
            raise UserError(f"{folder} already holds a run: add --resume, or another --out")
        print_settings(asdict(settings), asdict(Settings()))
        policy, seconds = train(
            simulator, args.suite, policy, settings, folder, saved, args.workers
        )
        base_tasks, novel_tasks = simulator.tasks(args.suite)
        outcomes = measure(simulator, [*base_tasks, *novel_tasks], policy, settings, args.workers)
        table = write_report(
            folder,
            outcomes,
            {
                "title": f"MAML-TRPO, {args.suite}",
                "steps": settings.steps,
                "training seconds": round(seconds),
                "goals a task": settings.episodes,
                "seed": settings.seed,
                **provenance("rl.py", argv, "cpu"),
            },
            parts={"mean of base": base_tasks, "mean of novel": novel_tasks},
            paper=paper_columns(args.suite, ["rl"]),
        )
    print(table)


if __name__ == "__main__":
    command_line(main)
