"""Tests of rl.py: its gradients against finite differences, and that it learns."""

import json
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import gymnasium
import numpy as np
import pytest
import torch

import common
import rl
from rl import AdaptedPolicies, GaussianPolicy, Rollouts, Settings
from simulator import SIMULATORS


class PointEnvironment:
    """A point in the plane that moves to a goal which its state does not show."""

    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def begin(self, seed):
        self.steps, self.position = 0, np.zeros(2)
        angle = np.random.default_rng(seed).uniform(0, 2 * np.pi)
        self.goal = np.array([np.cos(angle), np.sin(angle)])

    def state_without_goal(self):
        return self.position.astype(np.float32)

    def advance(self, action):
        self.position = self.position + 0.2 * np.clip(action, -1, 1)
        self.steps += 1
        away = np.linalg.norm(self.goal - self.position)
        return float(-away), self.steps >= 10, {"success": bool(away < 0.3)}


@dataclass(frozen=True)
class PointSimulator:
    """A `simulator.Simulator` as far as rl.py needs one."""

    episode_steps: int = 10
    name: ClassVar[str] = "point"
    recipe: ClassVar[dict] = {"num_points": 1}

    def tasks(self, suite):
        return ["move"], ["move-again"]

    def make(self, task, num_points):
        return PointEnvironment()


class InProcessPool:
    """In place of `common.WorkerPool`: it calls jobs in this process."""

    def __init__(self, workers=None):
        pass

    def run(self, job, jobs, bar=None):
        return [job(**arguments) for arguments in jobs]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


POINT = Settings(goals=5, rollouts=5, hidden=32, cg_iterations=5)


def random_batches(n, policy, seed=0):
    """(support, query) of n tasks, in float64."""
    generator = torch.Generator().manual_seed(seed)
    state_dim, action_dim, _ = policy.shape

    def batch():
        def draw(*shape):
            return torch.randn(shape, generator=generator, dtype=torch.float64)

        return {
            "states": draw(30, state_dim),
            "actions": draw(30, action_dim),
            "advantages": draw(30),
        }

    return [batch() for _ in range(n)], [batch() for _ in range(n)]


@pytest.fixture
def adapted():
    """Three adapted policies, their parameters and batches, all of float64."""
    torch.manual_seed(0)
    policy = GaussianPolicy(3, 2, hidden=5).double()
    support, query = random_batches(3, policy)
    params = {name: p.detach() for name, p in policy.named_parameters()}
    policies = AdaptedPolicies(policy, rl.stack(support), rl.stack(query), inner_lr=0.3)
    return policies, params, support, query


# ---- Gradients -----------------------------------------------------------------------------------


def test_the_outer_gradient_is_that_of_trpos_loss_through_the_inner_step(adapted):
    policies, params, support, query = adapted
    old = policies.gaussians(params)
    gradient, _, _ = rl.meta_gradient(
        policies.policy.loss, params, list(zip(support, query)), lr=policies.inner_lr
    )
    theta, step = rl.flatten(params), 1e-5
    for i in range(0, len(theta), 7):
        sides = []
        for sign in (1, -1):
            moved = theta.clone()
            moved[i] += sign * step
            loss, _ = policies.surrogate_loss_and_kl(rl.unflatten(moved, params), old)
            sides.append(loss)
        difference = (sides[0] - sides[1]) / (2 * step)
        assert rl.flatten(gradient)[i].item() == pytest.approx(difference, rel=1e-5, abs=1e-8)


def test_the_fisher_product_is_the_second_derivative_of_the_divergence(adapted):
    policies, params, _, _ = adapted
    old = [x.detach() for x in policies.gaussians(params)]
    theta = rl.flatten(params)

    def divergence(vector):
        mean, log_std = policies.gaussians(rl.unflatten(vector, params))
        old_mean, old_log_std = old
        var, old_var = torch.exp(2 * log_std), torch.exp(2 * old_log_std)
        kl = log_std - old_log_std + (old_var + (mean - old_mean) ** 2) / (2 * var) - 0.5
        return kl.sum(-1).mean()

    hessian = torch.autograd.functional.hessian(divergence, theta)
    product = policies.fisher_vector_product(params, damping=0.01)
    v = torch.randn(len(theta), generator=torch.Generator().manual_seed(1), dtype=theta.dtype)
    torch.testing.assert_close(product(v), hessian @ v + 0.01 * v)


def test_a_step_improves_the_loss_and_keeps_to_the_divergence(adapted):
    policies, params, support, query = adapted
    settings = replace(POINT, inner_lr=policies.inner_lr, max_kl=0.02)
    old = policies.gaussians(params)
    old_loss, _ = policies.surrogate_loss_and_kl(params, old)
    figures = rl.trpo_step(policies.policy, support, query, settings)
    new = {name: p.detach() for name, p in policies.policy.named_parameters()}
    loss, kl = policies.surrogate_loss_and_kl(new, old)
    assert loss < old_loss - 0.01 and 0.005 < kl <= 0.02
    assert figures["kl"] == pytest.approx(kl)
    assert figures["loss_before"] == pytest.approx(old_loss)
    assert figures["loss_after"] == pytest.approx(loss)


def test_a_step_into_nothing_is_no_error_but_is_not_taken(adapted):
    """A deviation that becomes 0, or a mean that is NaN: the line search shortens such a step."""
    policies, params, _, _ = adapted
    old = policies.gaussians(params)
    for name, value in (("log_std", -1e4), ("mean.4.bias", float("nan"))):
        candidate = {**params, name: torch.full_like(params[name], value)}
        loss, kl = policies.surrogate_loss_and_kl(candidate, old)
        assert not (loss < 0 and kl <= 0.02)  # what the line search asks for


def test_where_no_step_is_good_enough_nothing_is_changed(adapted, monkeypatch):
    policies, params, support, query = adapted
    settings = replace(POINT, inner_lr=policies.inner_lr, max_kl=0.02)
    worse = lambda *_: (np.inf, 0.0)  # noqa: E731
    monkeypatch.setattr(AdaptedPolicies, "surrogate_loss_and_kl", worse)
    figures = rl.trpo_step(policies.policy, support, query, settings)
    assert (figures["kl"], figures["backtracks"]) == (0.0, POINT.backtracks)
    for name, p in policies.policy.named_parameters():
        assert torch.equal(p, params[name])


def test_all_layers_begin_at_glorots_scale():
    torch.manual_seed(0)
    policy = GaussianPolicy(state_dim=39, action_dim=4, hidden=128)
    for layer in (policy.mean[0], policy.mean[2], policy.mean[4]):
        largest = (6 / (layer.in_features + layer.out_features)) ** 0.5  # of a uniform law
        assert 0.99 * largest < layer.weight.abs().max() <= largest
        assert (layer.bias == 0).all()


def test_the_mean_action_in_numpy_is_that_of_the_policy():
    torch.manual_seed(0)
    policy = GaussianPolicy(5, 3, hidden=7)
    weights = rl.to_arrays(dict(policy.named_parameters()))
    state = np.random.default_rng(0).normal(size=5).astype(np.float32)
    mean, _ = policy(torch.from_numpy(state))
    np.testing.assert_allclose(rl.mean_action(weights, state), mean.detach(), atol=1e-6)
    again = rl.to_arrays(dict(rl.policy_of(weights).named_parameters()))
    assert all(np.array_equal(again[name], weights[name]) for name in weights)


# ---- Advantages ----------------------------------------------------------------------------------


def test_discounted_sums():
    sums = rl.discounted_sums(np.array([[1.0, 2.0, 4.0]]), 0.5)
    np.testing.assert_allclose(sums, [[1 + 0.5 * 2 + 0.25 * 4, 2 + 0.5 * 4, 4]])


def test_what_the_state_and_the_time_foretell_is_no_advantage():
    rng = np.random.default_rng(0)
    states, actions = rng.normal(size=(10, 20, 3)), rng.normal(size=(10, 20, 2))
    surprise = rng.normal(size=(10, 20))
    # The return of a step is its reward, as nothing later counts.
    rewards = 5 + 2 * states[..., 0] - np.arange(20) / 10 + 0.1 * surprise
    rollouts = Rollouts(states, actions, rewards, successes=np.zeros((10, 20), bool))
    batch = rl.to_batch(rollouts, replace(POINT, discount=0.0))
    assert np.corrcoef(batch["advantages"], surprise.reshape(-1))[0, 1] > 0.95
    assert abs(batch["advantages"].mean()) < 1e-5
    assert batch["advantages"].std() == pytest.approx(1, abs=0.01)


def test_advantages_are_those_of_generalized_advantage_estimation():
    rng = np.random.default_rng(0)
    shape, discount, gae_lambda = (4, 9), 0.9, 0.7
    rollouts = Rollouts(
        states=rng.normal(size=(*shape, 3)),
        actions=rng.normal(size=(*shape, 2)),
        rewards=rng.normal(size=shape),
        successes=np.zeros(shape, bool),
    )
    settings = replace(POINT, discount=discount, gae_lambda=gae_lambda)
    batch = rl.to_batch(rollouts, settings)

    values = rl.baseline_values(rollouts, rl.discounted_sums(rollouts.rewards, discount))
    next_values = np.pad(values[:, 1:], ((0, 0), (0, 1)))
    deltas = rollouts.rewards + discount * next_values - values
    advantages = np.array(
        [
            [sum((discount * gae_lambda) ** k * d for k, d in enumerate(of[t:])) for t in range(9)]
            for of in deltas
        ]
    ).ravel()
    expected = (advantages - advantages.mean()) / advantages.std()
    np.testing.assert_allclose(batch["advantages"], expected, atol=1e-5)


# ---- It learns -----------------------------------------------------------------------------------


def returns(policy, goals=10, seed=1):
    """The mean returns to new goals before and after an inner step."""
    simulator = PointSimulator()
    weights = rl.to_arrays(dict(policy.named_parameters()))
    samples = [
        rl.goal_job(
            rl.Goal("move", seed=rl.evaluation_seed(seed, i), noise_seed=(seed, i)),
            simulator,
            weights,
            POINT,
        )
        for i in range(goals)
    ]
    return [np.mean([sample.mean_return for sample in when]) for when in zip(*samples)]


def test_it_learns_to_find_a_goal_that_only_rewards_tell():
    torch.manual_seed(0)
    policy = GaussianPolicy(2, 2, POINT.hidden)
    untrained_before, untrained_after = returns(policy)
    for iteration in range(30):
        rl.iterate(InProcessPool(), PointSimulator(), ["move"], policy, iteration, POINT, bar=None)
    before, after = returns(policy)
    assert after > before + 3  # of 10 steps, whose rewards are the distances, negative
    assert after > untrained_after + 3
    assert untrained_after < untrained_before + 2


def test_each_iteration_has_goals_of_its_own_and_none_is_measured_on(monkeypatch):
    policy, trained_on, measured_on = GaussianPolicy(2, 2, 8), [], []

    class Watched(InProcessPool):
        def run(self, job, jobs, bar=None):
            trained_on.extend(arguments["goal"] for arguments in jobs)
            return super().run(job, jobs, bar)

    def run_jobs(job, jobs, **_):
        measured_on.extend(arguments["goal"] for arguments in jobs)
        return InProcessPool().run(job, jobs)

    monkeypatch.setattr(rl, "run_jobs", run_jobs)
    monkeypatch.setattr(rl, "trpo_step", lambda *_, **__: {})
    simulator = PointSimulator()
    for iteration in range(3):
        rl.iterate(Watched(), simulator, ["a", "b", "c"], policy, iteration, POINT, bar=None)
    rl.measure(simulator, ["a"], policy, POINT, workers=None)
    assert len({goal.seed for goal in trained_on}) == 3 * POINT.goals
    assert len({goal.noise_seed for goal in trained_on}) == 3 * POINT.goals
    assert sorted(Counter(goal.task for goal in trained_on[: POINT.goals]).values()) == [1, 2, 2]
    assert not {goal.seed for goal in trained_on} & {goal.seed for goal in measured_on}


# ---- Command line --------------------------------------------------------------------------------


@pytest.fixture
def point_suite(monkeypatch, tmp_path, no_pictures):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(SIMULATORS, "point", PointSimulator)
    monkeypatch.setattr(rl, "run_jobs", lambda job, jobs, **_: InProcessPool().run(job, jobs))
    monkeypatch.setattr(rl, "WorkerPool", InProcessPool)
    return "--suite point --goals 2 --rollouts 2 --hidden 8 --episodes 2 --steps".split()


def test_a_run_that_was_resumed_ends_with_the_same_weights(point_suite, monkeypatch):
    """Also where one of the two rolls out in another process."""
    rl.main([*point_suite, "160", "--out", "parts"])
    rl.main([*point_suite, "240", "--out", "parts", "--resume", "--overwrite"])
    monkeypatch.setattr(rl, "WorkerPool", lambda workers: common.WorkerPool(1))
    rl.main([*point_suite, "240", "--out", "whole"])  # three iterations of 80 steps
    whole, parts = (torch.load(f"{name}/last.pt", weights_only=True) for name in ("whole", "parts"))
    assert whole["iteration"] == parts["iteration"] == 3
    for name, weight in whole["weights"].items():
        assert torch.equal(weight, parts["weights"][name])
    last_line = rl.read_json_lines(Path("parts/metrics.jsonl"))[-1]
    assert last_line["steps"] == 240 and len(last_line["std"]) == 2
    assert last_line["success_of_tasks"] == {"move": last_line["success_after"]}
    report = json.loads(Path("parts/success.json").read_text())
    assert report["provenance"]["steps"] == 240
    assert set(report["successes"]) == {"before", "after one inner step"}


AGAIN = "--resume --overwrite --out run".split()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--resume", "--out", "nothing"], "there is no run to resume"),
        (["--out", "run"], "already holds results: add --resume --overwrite to go on"),
        (["--out", "run", "--overwrite"], "add --resume, or another --out"),
        ([*AGAIN, "--hidden", "9"], "trained with other settings (hidden"),
        (["--resume", "--out", "damaged"], "is damaged"),
        (["--resume", "--out", "foreign"], "is of no run of rl.py"),
        (["--out", "results"], "already holds results: add --resume --overwrite to go on"),
        (["--suite", "poin"], "did you mean 'point'"),
        ([*AGAIN, "--steps", "80"], "160 are taken already"),
        (["--max-kl", "-1"], "--max-kl is -1.0: use at least 0"),
    ],
)
def test_mistakes_are_one_line(point_suite, capsys, arguments, message):
    rl.main([*point_suite, "160", "--out", "run"])
    Path("damaged").mkdir()
    Path("damaged/last.pt").write_bytes(b"no checkpoint")
    Path("foreign").mkdir()
    torch.save({"model": {}}, "foreign/last.pt")
    Path("results").mkdir()
    Path("results/success.json").touch()
    with pytest.raises(SystemExit, match="2"):
        common.command_line(lambda: rl.main([*point_suite, "160", *arguments]))
    assert message in capsys.readouterr().err.splitlines()[-1]
    assert Path("run/success.json").exists()  # a mistake costs no results


def test_meta_worlds_state_hides_the_goal_alone():
    from metaworld_env import MetaWorldPointCloudEnv

    env = MetaWorldPointCloudEnv("push")
    env.begin(0)
    state = env.state_without_goal()
    assert state.shape == (39,) and state.dtype == np.float32
    np.testing.assert_array_equal(state[:36], np.float32(env.expert_observation[:36]))
    assert not state[36:].any() and env.expert_observation[36:].any()


def test_a_simulator_without_such_states_is_refused():
    class SimulatorWithoutStates(PointSimulator):
        def make(self, task, num_points):
            return object()

    with pytest.raises(common.UserError, match="use one of Meta-World's suites, such as ml10"):
        rl.environment(SimulatorWithoutStates(), "move")
