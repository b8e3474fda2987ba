"""Tests of evaluate.py: which checkpoint, rollouts, swapped inputs, animations, bad input.

Most roll out in toy_simulator.py, which takes milliseconds, and without other processes.
"""

import json
import os
import runpy
import sys
from dataclasses import replace
from functools import partial
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
import torch
from conftest import fails, same_bits
from toy_simulator import COLORS, ToyEnvironment, ToySimulator

import clip
import common
import data
import evaluate
import model
import report
import simulator
import tests.drift
import tests.unseen

TASKS = ["touch-red", "touch-green"]  # base tasks of the toy; touch-blue is its novel one
INFO = {
    "suite": "toy",
    "preset": "tiny",
    "arguments": {"lr": 1e-3, "after_success": None},
    "text_weights": "words",
    "step": 6,
}


def features(instructions, weights, identity):
    """In place of CLIP: one-hot vectors, by the color in the instruction."""
    colors = [next(color for color in COLORS if color in text) for text in instructions]
    rows = [list(COLORS).index(color) for color in colors]
    return 10 * torch.eye(512)[rows], identity or "words"


def run_here(job, jobs, *, total, description, unit, workers, pool):
    """In place of `common.run_jobs`: in this process."""
    return [job(**arguments) for arguments in jobs]


@pytest.fixture(autouse=True)
def toy(monkeypatch, own_folder, no_pictures):
    """The toy is one of the simulators, and nothing is rolled out in other processes."""
    monkeypatch.setitem(simulator.SIMULATORS, "toy", ToySimulator)
    monkeypatch.setattr(evaluate, "text_features", features)
    monkeypatch.setattr(evaluate, "run_jobs", run_here)


@pytest.fixture(scope="session")
def recordings(tmp_path_factory):
    """Three expert demonstrations of each of the toy's tasks: task -> file."""
    folder = tmp_path_factory.mktemp("toy")
    toy = ToySimulator()
    paths = {task: folder / f"{task}.npz" for task in toy.instructions}
    for task, path in paths.items():
        simulator.collect_task(toy, task, path, episodes=3, seed=0)
    return paths


def fit(config, recordings, steps=20):
    """A policy that has learned a little of the toy."""
    torch.manual_seed(0)
    policy, generator = model.build_policy(config), torch.Generator().manual_seed(0)
    samplers = {
        task: data.WindowSampler(data.load_demonstrations(recordings[task]), config)
        for task in TASKS
    }
    policy.normalizer.fit(samplers.values())
    text, _ = features(TASKS, None, None)
    optimizer = torch.optim.AdamW(policy.parameters(), lr=3e-3)
    for step in range(steps):
        task = step % 2
        batch = samplers[TASKS[task]].batch(16, generator)
        noise = policy.draw_noise_and_timesteps(16, generator)
        policy.loss(text=text[[task]], **batch, **noise).backward()
        optimizer.step()
        optimizer.zero_grad()
    return policy.eval()


TINY = replace(model.PRESETS["tiny"], state_dim=3, action_dim=3)


@pytest.fixture(scope="session")
def trained(recordings):
    return fit(TINY, recordings)


@pytest.fixture(scope="session")
def untrained(recordings):
    return fit(TINY, recordings, steps=1)


@pytest.fixture
def run(trained, untrained):
    """The folder of a run in the toy, with two checkpoints; it is in the present folder."""
    folder = Path("runs/toy-tiny-seed0")
    folder.mkdir(parents=True)
    model.save(folder / "ema-00003.pt", untrained, **{**INFO, "step": 3})
    model.save(folder / "ema-00006.pt", trained, **INFO)
    return folder


def command(run, recordings, options=""):
    folder = recordings["touch-red"].parent
    common = f"--checkpoint {run} --data {folder} --demonstrations 2 --device cpu"
    return [*common.split(), *options.split()]


def report_of(folder):
    return json.loads((Path(folder) / "success.json").read_text())


# ---- Which checkpoint ----------------------------------------------------------------------------


def test_the_default_is_the_newest_finished_run_of_the_suite_that_is_not_tiny(capsys):
    def leave(name, preset="small", suite="ml10", steps=5, last=5):
        arguments = {"preset": preset, "suite": suite, "steps": steps}
        Path(f"runs/{name}").mkdir(parents=True)
        Path(f"runs/{name}/config.json").write_text(json.dumps({"arguments": arguments}))
        Path(f"runs/{name}/ema-{last:05d}.pt").touch()

    leave("a-tiny", preset="tiny")
    leave("b-unfinished", last=4)
    leave("c-own", suite="own")
    Path("runs/damaged").mkdir()
    Path("runs/damaged/config.json").write_text('{"argum')
    assert evaluate.default_checkpoint("ml10") == evaluate.SHIPPED_CHECKPOINT
    assert "comes with the code" in capsys.readouterr().out
    for name, when in (("z-older", 10), ("d-newer", 20)):  # not the last one by its name
        leave(name)
        os.utime(f"runs/{name}/ema-00005.pt", (when, when))
    assert evaluate.default_checkpoint("ml10") == Path("runs/d-newer/ema-00005.pt")
    assert evaluate.default_checkpoint("own") == Path("runs/c-own/ema-00005.pt")
    with pytest.raises(evaluate.UserError, match="no finished run on ml45"):
        evaluate.default_checkpoint("ml45")
    leave("f-tiny", preset="tiny", suite="ml45")
    with pytest.raises(evaluate.UserError, match=r"f-tiny is a run of `tiny`.* add --checkpoint"):
        evaluate.default_checkpoint("ml45")


def test_a_folder_stands_for_its_last_checkpoint():
    for step in (3, 99_000, 100_000):
        Path(f"ema-{step:05d}.pt").touch()
    assert [path.stem for path in evaluate.checkpoints_of(".")] == [
        "ema-00003",
        "ema-99000",
        "ema-100000",
    ]
    Path("adapted").mkdir()
    Path("adapted/adapted.pt").touch()
    assert evaluate.checkpoints_of("adapted") == [Path("adapted/adapted.pt")]
    Path("interrupted").mkdir()
    Path("interrupted/last.pt").touch()
    with pytest.raises(evaluate.UserError, match=r"add --resume .* or name interrupted/last.pt"):
        evaluate.checkpoints_of("interrupted")


def test_a_policy_that_does_not_say_how_it_was_trained_is_refused(run, recordings, capsys):
    model.save("plain.pt", model.build_policy(TINY), suite="toy", preset="tiny")
    message = fails(evaluate, command("plain.pt", recordings), capsys)
    assert "plain.pt lacks arguments, text_weights, step: use a file of train.py" in message


# ---- Rollouts ------------------------------------------------------------------------------------


def test_the_policy_that_ships_opens_windows(recorded, monkeypatch):
    """Guards it against everything that it depends on: text weights, camera, sampling, layers."""
    task, meta_world = "window-open", simulator.simulator_of("ml10")
    text, _ = clip.text_features([meta_world.instructions[task]], "random")
    outcomes = evaluate.evaluate_checkpoint(
        evaluate.SHIPPED_CHECKPOINT,
        meta_world,
        recordings={task: recorded / f"{task}.npz"},
        text={task: text[0]},
        episodes=10,
        seed=0,
        stop_at_success=True,  # quicker
    )
    assert len(outcomes.any_step[task]) == 10 and sum(outcomes.any_step[task]) >= 8
    assert outcomes.at_end is None


def test_any_simulator_is_recorded_and_rolled_out_in_by_its_protocol(monkeypatch, recordings):
    recorded = data.load_demonstrations(recordings["touch-red"])
    assert recorded.instruction == "Touch the red ball." and len(recorded) == 3
    sampler, text = data.WindowSampler(recorded, TINY), torch.zeros(512)
    policy, toys = (
        model.build_policy(TINY),
        [ToySimulator().make("touch-red", 64) for _ in range(2)],
    )

    def roll_out(stop_at_success):
        return evaluate.rollout(
            policy,
            toys,
            [5, 6],
            sampler,
            text,
            torch.Generator().manual_seed(0),
            stop_at_success=stop_at_success,
        )

    for of_steps in roll_out(stop_at_success=False):
        assert len(of_steps) == 12 and all(type(success) is bool for success in of_steps)

    def ask_the_experts(points, state, context, generator):
        actions = np.stack([env.expert_action() for env in toys])
        return torch.from_numpy(actions)[:, None].expand(-1, 8, -1)

    monkeypatch.setattr(policy, "sample_actions", ask_the_experts)
    stopped = roll_out(stop_at_success=True)
    assert all(of_steps.index(True) == len(of_steps) - 1 < 11 for of_steps in stopped)
    assert [env.steps for env in toys] == [len(of_steps) for of_steps in stopped]
    whole = roll_out(stop_at_success=False)
    assert all(any(of_steps) and len(of_steps) == 12 for of_steps in whole)
    monkeypatch.setattr(policy, "sample_actions", lambda *inputs: -ask_the_experts(*inputs))
    assert roll_out(stop_at_success=True) == [[False] * 12] * 2


def test_clouds_with_colors_are_rolled_out_on(recordings):
    colored, config = ToySimulator(colored=True), replace(TINY, point_dim=6)
    simulator.collect_task(colored, "touch-red", "red.npz", episodes=2, seed=0)
    sampler = data.WindowSampler(data.load_demonstrations("red.npz"), config)
    policy, environment = model.build_policy(config), colored.make("touch-red", 64)
    successes = evaluate.rollout(
        policy, [environment], [0], sampler, torch.zeros(512), torch.Generator()
    )
    assert len(successes) == 1 and environment.steps > 0


def test_in_worker_processes_the_episodes_are_the_same(run, recordings, monkeypatch, capsys):
    checkpoint, text = run / "ema-00003.pt", dict(zip(recordings, 10 * torch.eye(512)))
    monkeypatch.setattr(evaluate, "EPISODES_A_JOB", 3)

    def measure(checkpoint=checkpoint, recordings=recordings, text=text, **options):
        return evaluate.evaluate_checkpoint(
            checkpoint, ToySimulator(), recordings, text, episodes=5, seed=3, **options
        )

    here = measure()
    assert {len(successes) for successes in here.any_step.values()} == {5}
    assert {len(successes) for successes in here.at_end.values()} == {5}
    assert 2 < sum(sum(successes) for successes in here.any_step.values()) < 13  # could differ
    measurements = (  # one after the other in the same processes: nothing is mistaken for another
        {},
        {"inner_steps": 1, "inner_lr": 0.1, "support": 4},
        {"checkpoint": run / "ema-00006.pt"},
        {"recordings": evaluate.of_next_task(recordings)},
        {"text": evaluate.of_next_task(text)},
        {"n_demonstrations": 1},
        {"demonstration_control": "zeros"},
        {"config_overrides": {"inference_steps": 1}},
        {},
    )
    expected = [here, *(measure(**options) for options in measurements[1:])]
    monkeypatch.setattr(evaluate, "run_jobs", common.run_jobs)
    with common.WorkerPool(2) as pool:
        assert [measure(**options, pool=pool) for options in measurements] == expected
    assert len({str(outcomes) for outcomes in expected}) > 3
    assert "evaluating: 100%" in capsys.readouterr().err


def test_inner_steps_of_each_task_and_seed_have_draws_of_their_own(run, recordings, monkeypatch):
    seeds = []

    def steps(policy, *_, seed, **__):
        seeds.append(seed)
        return [(1, 0.0, policy)]

    monkeypatch.setattr(evaluate, "take_inner_steps", steps)
    for seed in (0, 1, 0):
        evaluate.evaluate_checkpoint(
            checkpoint=run / "ema-00006.pt",
            simulator=ToySimulator(),
            recordings={task: recordings[task] for task in TASKS},
            text={task: torch.zeros(512) for task in TASKS},
            episodes=1,
            seed=seed,
            inner_steps=1,
            inner_lr=0.1,
            support=4,
        )
        evaluate.cached_policy_of_task.cache_clear()
    assert len(set(seeds)) == 4 and seeds[:2] == seeds[4:]


def test_adaptation_has_late_windows_as_training_had_them(trained):
    recording = replace(numbered([40, 40]), meta={"success_frames": [10, 10]})
    recording = replace(recording, state=recording.state[:, :3], action=recording.action[:, :3])
    info = {"arguments": {"after_success": 5, "late_fraction": 0.25}}
    sampler = evaluate.adaptation_sampler(recording, trained, info)
    assert sampler.late.any() and sampler.late_fraction == 0.25 and not sampler.augment


def policy_of_task(checkpoint, recording):
    """What a worker process is asked for, of two demonstrations and without inner steps."""
    return evaluate.PolicyOfTask(
        checkpoint=checkpoint,
        device="cpu",
        config_overrides=(),
        recording=recording,
        n_demonstrations=2,
        text=np.zeros(512, np.float32).tobytes(),
        demonstration_control=None,
        inner_steps=0,
        inner_lr=0.1,
        support=4,
        inner_seed=0,
    )


def test_what_a_process_keeps_is_not_mistaken_for_something_else(run, recordings):
    wanted = policy_of_task(run / "ema-00006.pt", recordings["touch-red"])

    def weights_for(**changes):
        policy, _, _ = evaluate.cached_policy_of_task(replace(wanted, **changes))
        return dict(policy.named_parameters())

    _, sampler, text = evaluate.cached_policy_of_task(wanted)
    _, fewer, _ = evaluate.cached_policy_of_task(replace(wanted, n_demonstrations=1))
    assert (len(sampler.episodes), len(fewer.episodes)) == (2, 1)
    ones = np.ones(512, np.float32).tobytes()
    _, _, other_text = evaluate.cached_policy_of_task(replace(wanted, text=ones))
    assert not text.any() and other_text.all()

    kept = [
        weights_for(),
        weights_for(inner_steps=1),
        weights_for(inner_steps=2),
        weights_for(inner_steps=1, inner_lr=0.01),
        weights_for(inner_steps=1, support=8),
        weights_for(inner_steps=1, inner_seed=1),
        weights_for(inner_steps=1, demonstration_control="zeros"),
        weights_for(checkpoint=run / "ema-00003.pt"),
    ]
    for one, other in combinations(kept, 2):
        assert not same_bits(one, other)
    assert same_bits(kept[1], weights_for(inner_steps=1))


def test_ten_episodes_are_rolled_out_side_by_side(run, recordings, monkeypatch):
    """Part of the protocol of every published number: the noise drawn depends on it."""
    calls = []

    def count(policy, *, environments, seeds, generator, **_):
        calls.append((len(environments), list(seeds), generator.initial_seed()))
        return [[True]] * len(seeds)

    monkeypatch.setattr(evaluate, "rollout", count)
    text = dict.fromkeys(TASKS, torch.zeros(512))
    evaluate.evaluate_checkpoint(
        run / "ema-00006.pt",
        ToySimulator(),
        {"touch-red": recordings["touch-red"]},
        text,
        episodes=23,
        seed=7,
    )
    first = simulator.evaluation_seed(7, 0)
    assert calls == [
        (10, [*range(first, first + 10)], first),
        (10, [*range(first + 10, first + 20)], first + 10),
        (3, [*range(first + 20, first + 23)], first + 20),
    ]


def test_each_task_has_its_own_environments_and_its_first_demonstrations(
    run, recordings, monkeypatch
):
    made, read = [], []

    class Watched(ToySimulator):
        def make(self, task, num_points):
            made.append((task, num_points))
            return super().make(task, num_points)

    def keep(policy, *, sampler, seeds, **_):
        read.append((sampler.task, len(sampler.episodes)))
        return [[True]] * len(seeds)

    monkeypatch.setattr(evaluate, "rollout", keep)
    evaluate.evaluate_checkpoint(
        run / "ema-00006.pt",
        Watched(),
        {task: recordings[task] for task in TASKS},
        dict.fromkeys(TASKS, torch.zeros(512)),
        episodes=12,
        n_demonstrations=2,
    )
    assert read == [("touch-red", 2)] * 2 + [("touch-green", 2)] * 2
    assert made == [("touch-red", 64)] * 10 + [("touch-green", 64)] * 10  # kept between jobs


def test_of_pairs_it_is_told_how_often_the_other_task_was_done(run, recordings, monkeypatch):
    class Pairs(ToySimulator):
        def make(self, task, num_points):
            environment = super().make(task, num_points)
            environment.other_successes = [False, task == "touch-red", False]
            return environment

    monkeypatch.setattr(evaluate, "rollout", lambda policy, *, seeds, **_: [[True]] * len(seeds))
    outcomes = evaluate.evaluate_checkpoint(
        run / "ema-00006.pt",
        Pairs(),
        {task: recordings[task] for task in TASKS},
        dict.fromkeys(TASKS, torch.zeros(512)),
        episodes=2,
    )
    assert outcomes.other_task == {"touch-red": [True] * 2, "touch-green": [False] * 2}
    report.write_report(Path("pairs"), {"a": outcomes}, {}, pooled=True)
    assert report.read_outcomes(Path("pairs")) == {"a": outcomes}
    assert "the other task" in Path("pairs/success.md").read_text()


def test_a_rollout_ends_without_success_where_nothing_is_seen(run, recordings):
    class Hidden(ToySimulator):
        def make(self, task, num_points):
            environment = super().make(task, num_points)
            observe, advance = environment.observe, environment.advance

            def observe_at_first():
                if environment.steps > 4:
                    raise simulator.OutOfSightError("gone")
                return observe()

            def always_successful(action):
                reward, truncated, _ = advance(action)
                return reward, truncated, {"success": True}

            environment.observe, environment.advance = observe_at_first, always_successful
            return environment

    outcomes = evaluate.evaluate_checkpoint(
        run / "ema-00006.pt",
        Hidden(),
        {"touch-red": recordings["touch-red"]},
        {"touch-red": torch.zeros(512)},
        episodes=2,
    )
    assert outcomes == report.Outcomes({"touch-red": [True] * 2}, {"touch-red": [False] * 2})


def test_a_job_sees_the_same_frames_whatever_its_worker_did_before(run, recordings, monkeypatch):
    frames = []

    class Watched(ToySimulator):
        def make(self, task, num_points):
            environment = super().make(task, num_points)
            observe = environment.observe

            def watched():
                frames.append(observe()["point_cloud"])
                return observe()

            environment.observe = watched
            return environment

    def job(task, episode):
        frames.clear()
        evaluate.rollout_job(
            policy_of_task(run / "ema-00003.pt", recordings[task]),
            simulator=Watched(),
            task=task,
            seeds=[simulator.evaluation_seed(0, episode)],
            reference_seed=None,
            stop_at_success=True,
        )
        return np.stack(frames)

    alone = job("touch-red", 1)
    for task, episode in [("touch-red", 0), ("touch-green", 0), ("touch-red", 1)]:
        later = job(task, episode)
    assert len(alone) > 1 and np.array_equal(alone, later)


def test_known_goals_are_those_of_the_demonstrations(run, recordings, monkeypatch):
    seeds = []

    def keep_seeds(policy, **options):
        seeds.extend(options["seeds"])
        return [[True]] * len(options["seeds"])

    monkeypatch.setattr(evaluate, "rollout", keep_seeds)
    text = {"touch-red": torch.zeros(512)}
    known = data.load_demonstrations(recordings["touch-red"]).meta["episode_seeds"]
    for options, expected in (
        ({"episodes": 20}, known),
        ({"episodes": 20, "n_demonstrations": 2}, known[:2]),
        ({"episodes": 1}, known[:1]),
    ):
        seeds.clear()
        evaluate.evaluate_checkpoint(
            run / "ema-00006.pt",
            ToySimulator(),
            {"touch-red": recordings["touch-red"]},
            text,
            known_goals=True,
            **options,
        )
        assert seeds == expected


class Corridor:
    """A robot that goes one step ahead whatever it is told, and is there after `length` steps."""

    def __init__(self, length, successful=True):
        self.length, self.successful = length, successful

    def begin(self, seed):
        self.steps, self.observed = 0, []

    def advance(self, action):
        self.steps += 1
        there = self.steps >= self.length
        return 0.0, there, {"success": there and self.successful}

    def observe(self):
        self.observed.append(self.steps)
        state = np.full(9, self.steps, np.float32)
        state[0] = self.length  # tells the rollout
        return {"point_cloud": np.full((64, 3), self.steps, np.float32), "agent_pos": state}


def numbered(lengths, **meta):
    """A recording whose actions tell the episode and the frame: 10 e + 0.01 t."""
    counts = [np.full(n, 10 * e) + 0.01 * np.arange(n) for e, n in enumerate(lengths)]
    action = np.repeat(np.concatenate(counts)[:, None], 4, axis=1).astype(np.float32)
    points = np.random.default_rng(0).normal(size=(len(action), 64, 3)).astype(np.float16)
    state = np.zeros((len(action), 9), np.float32)
    return data.Demonstrations(
        task="stir",
        instruction="Stir.",
        points=points,
        state=state,
        action=action,
        episode_ends=np.cumsum(lengths),
        meta=meta,
    )


@pytest.mark.parametrize("lengths", [[40] * 6, [40, 36, 40, 44, 40, 44]])
def test_each_rollout_holds_a_demonstration_of_its_own_from_beginning_to_end(monkeypatch, lengths):
    policy, read = model.DAMIPolicy(model.PRESETS["tiny"]), {}

    def encode(text, demo_points, demo_state, demo_action):
        episode = (demo_action[:, :1, 0] / 10).round()  # (1, 1), see `numbered`
        return demo_action, episode

    def sample(points, state, context, generator):
        assert len(context[1]) == len(state)
        for length, episode in zip(state[:, -1, 0], context[1][:, 0]):
            read.setdefault(int(length), []).append(int(episode))
        torch.randn(len(state), generator=generator)
        return torch.zeros(len(state), 8, 4)

    monkeypatch.setattr(policy, "encode_demo", encode)
    monkeypatch.setattr(policy, "sample_actions", sample)
    sampler = data.WindowSampler(numbered(lengths), policy.config)
    long = [30, 5, 24, 17, 39]  # steps of each rollout: some end before others
    envs, generator = [Corridor(n) for n in long], torch.Generator().manual_seed(3)
    successes = evaluate.rollout(policy, envs, range(5), sampler, torch.zeros(512), generator)
    assert successes == [[False] * (n - 1) + [True] for n in long]

    again = torch.Generator().manual_seed(3)  # all are drawn before any noise
    drawn = [sampler.sample_episode(again) for _ in long]
    assert len(set(drawn)) >= 3  # the seed is such that they differ
    assert read == {n: [episode] * -(-n // 8) for n, episode in zip(long, drawn)}


def walk(monkeypatch, corridor, config=model.PRESETS["tiny"], **options):
    """Rolls out in a corridor; returns (successes, demonstrations read, states read)."""
    policy, demonstrations, states = model.DAMIPolicy(config), [], []

    def sample(points, state, context, generator):
        assert torch.equal(points[0, :, 0, 0], state[0, :, 1])  # of the same moments
        states.append(state[0, :, 1].tolist())
        return torch.zeros(1, config.n_action_steps, 4)

    monkeypatch.setattr(policy, "encode_demo", lambda text, **demo: demonstrations.append(demo))
    monkeypatch.setattr(policy, "sample_actions", sample)
    sampler = data.WindowSampler(numbered([40]), config)
    successes = evaluate.rollout(
        policy, [corridor], [5], sampler, torch.zeros(512), torch.Generator(), **options
    )
    return successes, demonstrations, states


class Walked(Corridor):
    """Remembers the first number of each action that it was told."""

    def begin(self, seed):
        super().begin(seed)
        self.told = []

    def advance(self, action):
        self.told.append(round(float(action[0])))
        return super().advance(action)


def test_each_rollout_takes_the_actions_of_its_own_chunks_in_their_order(monkeypatch):
    policy = model.DAMIPolicy(model.PRESETS["tiny"])

    def sample(points, state, context, generator):
        """Actions that tell the corridor and the step: 100 * length + step, numbered on."""
        length, step = state[:, -1, 0, None, None], state[:, -1, 1, None, None]
        return (100 * length + step + torch.arange(8)[:, None]).expand(-1, 8, 4)

    monkeypatch.setattr(policy, "encode_demo", lambda text, **demo: None)
    monkeypatch.setattr(policy, "sample_actions", sample)
    sampler = data.WindowSampler(numbered([40]), policy.config)
    corridors = [Walked(n) for n in (20, 5, 13)]  # the second ends first
    evaluate.rollout(policy, corridors, range(3), sampler, torch.zeros(512), torch.Generator())
    for corridor in corridors:
        assert corridor.told == [100 * corridor.length + t for t in range(corridor.length)]


def test_a_rollout_says_of_each_step_whether_it_was_a_success(monkeypatch):
    for successful in (True, False):
        corridor = Corridor(20, successful)
        [of_steps], _, _ = walk(monkeypatch, corridor)
        assert of_steps == [False] * 19 + [successful] and corridor.steps == 20


class Passing(Corridor):
    """A success at the tenth step, and never again."""

    def advance(self, action):
        reward, truncated, _ = super().advance(action)
        return reward, truncated, {"success": self.steps == 10}


def test_an_episode_is_played_to_its_end_unless_it_stops_at_its_first_success(monkeypatch):
    [of_steps], _, _ = walk(monkeypatch, Passing(20))
    assert of_steps == [step == 10 for step in range(1, 21)]
    [of_steps], _, _ = walk(monkeypatch, Passing(20), stop_at_success=True)
    assert of_steps == [step == 10 for step in range(1, 11)]


def test_success_at_any_step_and_at_the_end_are_counted_apart(run, recordings, monkeypatch):
    of_steps = [[False, True, False], [False, True, True], [False, False, False]]
    monkeypatch.setattr(evaluate, "rollout", lambda policy, **_: of_steps)
    arguments = {
        "checkpoint": run / "ema-00006.pt",
        "simulator": ToySimulator(),
        "recordings": {"touch-red": recordings["touch-red"]},
        "text": {"touch-red": torch.zeros(512)},
        "episodes": 3,
    }
    outcomes = evaluate.evaluate_checkpoint(**arguments)
    assert outcomes.any_step == {"touch-red": [True, True, False]}
    assert outcomes.at_end == {"touch-red": [False, True, False]}
    stopped = evaluate.evaluate_checkpoint(**arguments, stop_at_success=True)
    assert stopped.any_step == outcomes.any_step and stopped.at_end is None


def test_the_policy_reads_the_older_frame_first_and_the_newest_last(monkeypatch):
    corridor = Corridor(40)
    _, _, states = walk(monkeypatch, corridor)
    assert states == [[0, 0], [7, 8], [15, 16], [23, 24], [31, 32]]
    assert corridor.observed == [0, 7, 8, 15, 16, 23, 24, 31, 32, 39]  # no more than is read
    one_action = replace(model.PRESETS["tiny"], n_action_steps=1)  # one of two frames is old
    _, _, states = walk(monkeypatch, Corridor(4), one_action)
    assert states == [[0, 0], [0, 1], [1, 2], [2, 3]]


def test_a_demonstration_that_is_left_out_of_a_rollout_is_all_zeros(monkeypatch):
    _, [shown], _ = walk(monkeypatch, Corridor(9))
    _, [left_out], _ = walk(monkeypatch, Corridor(9), demonstration_control="zeros")
    assert shown["demo_points"].any() and shown["demo_action"].any()
    for part, x in shown.items():
        assert torch.equal(left_out[part], torch.zeros_like(x))


# ---- From the command line to the report ---------------------------------------------------------


def test_base_tasks_are_measured_and_the_report_says_how(run, recordings, capsys):
    evaluate.main(command(run, recordings, "--episodes 5 --seed 3 --out report"))
    written = report_of("report")
    [label] = written["successes"]
    assert label == "toy-tiny-seed0/ema-00006" and "checkpoints" not in written
    text, _ = features(["touch-red", "touch-green"], None, None)
    outcomes = evaluate.evaluate_checkpoint(
        run / "ema-00006.pt",
        ToySimulator(),
        {task: recordings[task] for task in TASKS},
        dict(zip(TASKS, text)),
        episodes=5,
        seed=3,
        n_demonstrations=2,
    )
    assert written["successes"][label] == outcomes.any_step
    assert written["successes at the end"][label] == outcomes.at_end
    provenance = written["provenance"]
    assert provenance["title"] == "toy, base tasks" and provenance["episodes a task"] == 5
    assert provenance["seed"] == 3 and provenance["text weights"] == "words"
    assert provenance["goals"] == "new" and provenance["left out"] == "nothing"
    assert provenance["command"].startswith("python evaluate.py --checkpoint runs/toy-tiny")
    assert {"hardware", "date", "mean, last checkpoint"} <= set(provenance)
    assert "sampler" not in provenance
    printed = capsys.readouterr().out
    assert "| touch-red " in printed and "| **mean** " in printed and "paper" not in printed
    assert "mean, last checkpoint: " in printed


def test_base_tasks_are_those_that_the_policy_was_trained_on(run, recordings, capsys):
    content = torch.load(run / "ema-00006.pt", weights_only=True)
    content["arguments"].update(base_tasks=1, seed=0)
    torch.save(content, run / "ema-00006.pt")
    evaluate.main(command(run, recordings, "--episodes 1 --out report"))
    [trained] = simulator.draw_base_tasks(TASKS, 1, seed=0)
    [measured] = report_of("report")["successes"].values()
    assert list(measured) == [trained]

    # Beside one that was trained on the other task
    other = next(s for s in range(9) if simulator.draw_base_tasks(TASKS, 1, seed=s) != [trained])
    content["arguments"]["seed"] = other
    Path("other").mkdir()
    torch.save(content, "other/ema-00006.pt")
    both = [*command(run, recordings, "--episodes 1 --out both"), "--checkpoint", str(run), "other"]
    assert "are for different tasks: measure each alone" in fails(evaluate, both, capsys)


def test_the_best_checkpoints_of_a_run_are_averaged(run, recordings, monkeypatch, capsys):
    def measured(checkpoint, recordings, **_):
        of_tasks = {task: [checkpoint.stem == "ema-00003", True] for task in recordings}
        return report.Outcomes(any_step=of_tasks, at_end=of_tasks)

    monkeypatch.setattr(evaluate, "evaluate_checkpoint", measured)
    swap = "--swap instruction"  # is no checkpoint
    evaluate.main(command(run, recordings, f"--episodes 2 --top 1 {swap} --out report"))
    written = report_of("report")
    assert written["provenance"]["mean, last checkpoint"] == "50.0 (one run)"
    assert written["provenance"]["mean, best 1 checkpoints"] == "100.0 (one run)"
    last = "toy-tiny-seed0/ema-00006"
    assert list(written["successes"]) == [last, f"{last}, instruction of another task"]
    assert list(written["checkpoints"]) == ["toy-tiny-seed0/ema-00003", last]
    assert "best 1 checkpoints" in capsys.readouterr().out


def test_runs_are_averaged_if_only_their_seeds_differ():
    def run_of(seed, lr=1e-3, steps=None, vectorize=1, **config):
        info = {"arguments": {"seed": seed, "lr": lr, "vectorize": vectorize}}
        info["adaptation"] = {"steps": steps}
        config = replace(TINY, **config)
        return [evaluate.Checkpoint(Path(f"{seed}.pt"), f"run-{seed}/ema", config, info)]

    outcomes = {f"run-{s}/ema": report.Outcomes({"reach": [s > 0]}, None) for s in (0, 1)}
    means = partial(evaluate.mean_successes, outcomes, parts={"mean": ["reach"]}, top=0)
    assert list(means(runs=[run_of(0), run_of(1, vectorize=10)])) == ["mean, last checkpoint"]
    apart = {
        "run-0/ema: mean, last checkpoint": "0.0 (one run)",
        "run-1/ema: mean, last checkpoint": "100.0 (one run)",
    }
    for other in ({"lr": 5e-4}, {"steps": 200}, {"tcfm": "mid"}, {"num_points": 32}):
        assert means(runs=[run_of(0), run_of(1, **other)]) == apart


def test_inputs_are_swapped_with_those_of_the_next_task_or_left_out(run, recordings, monkeypatch):
    calls = []

    def measured(checkpoint, recordings, text, **options):
        read = {task: path.stem for task, path in recordings.items()}
        calls.append((read, text, options))
        of_tasks = {task: [len(calls) == 1] * options["episodes"] for task in recordings}
        return report.Outcomes(any_step=of_tasks, at_end=of_tasks)

    monkeypatch.setattr(evaluate, "evaluate_checkpoint", measured)
    swap = "--swap demonstration instruction --episodes 2"
    evaluate.main(command(run, recordings, f"{swap} --split all --out swapped"))
    following = {"touch-red": "touch-green", "touch-green": "touch-blue", "touch-blue": "touch-red"}
    own, demonstration, instruction = calls
    assert own[0] == instruction[0] == {task: task for task in ToySimulator().instructions}
    assert demonstration[0] == following and demonstration[1] is own[1]
    assert all(torch.equal(instruction[1][t], own[1][following[t]]) for t in following)
    written = report_of("swapped")
    assert [name.split(", ")[-1] for name in written["successes"]][1:] == [
        "demonstration of another task",
        "instruction of another task",
    ]
    assert {"mean of base, last checkpoint", "mean of novel, last checkpoint"} <= set(
        written["provenance"]
    )

    calls.clear()
    without = "--without demonstration instruction --episodes 2 --out without --n-action-steps 4"
    evaluate.main(command(run, recordings, without))
    [(_, text, options)] = calls
    assert options["demonstration_control"] == "zeros"
    assert options["config_overrides"] == {"n_action_steps": 4}
    assert not any(feature.any() for feature in text.values())
    provenance = report_of("without")["provenance"]
    assert provenance["left out"] == "demonstration and instruction"
    assert provenance["n_action_steps"] == 4 and "sampler" not in provenance


def test_what_the_command_line_says_reaches_the_rollouts(run, recordings, trained, monkeypatch):
    calls = []

    def measured(checkpoint, recordings, text, **options):
        calls.append((checkpoint, list(recordings), text, options))
        return report.Outcomes(any_step={task: [True] for task in recordings}, at_end=None)

    monkeypatch.setattr(evaluate, "evaluate_checkpoint", measured)
    flags = "--task touch-green --known-goals --seed 3 --episodes 4 --workers 2 --sampler ddim "
    flags += "--stop-at-success"
    evaluate.main(command(run, recordings, flags))
    [(checkpoint, tasks, text, options)] = calls
    assert checkpoint == run / "ema-00006.pt" and tasks == ["touch-green"]
    assert torch.equal(text["touch-green"], features(tasks, None, None)[0][0])
    assert isinstance(options.pop("simulator"), ToySimulator)
    assert options.pop("pool").workers == 2
    assert options == {
        "episodes": 4,
        "seed": 3,
        "device": torch.device("cpu"),
        "n_demonstrations": 2,
        "demonstration_control": None,
        "inner_steps": 0,
        "inner_lr": None,
        "support": None,
        "known_goals": True,
        "stop_at_success": True,
        "config_overrides": {"sampler": "ddim"},
    }
    provenance = report_of("runs/evaluation")["provenance"]
    assert provenance["goals"] == "of the demonstrations, each once"
    assert provenance["sampler"] == "ddim" and provenance["title"] == "touch-green"


def test_a_policy_that_was_adapted_without_its_instruction_is_not_given_one(
    trained, recordings, monkeypatch
):
    texts = []

    def measured(checkpoint, recordings, text, **_):
        texts.extend(text.values())
        return report.Outcomes(any_step={task: [True] for task in recordings}, at_end=None)

    monkeypatch.setattr(evaluate, "evaluate_checkpoint", measured)
    info = {**INFO, "adapted_to": "touch-blue", "adaptation": {"instruction": False}}
    model.save("adapted.pt", trained, **info)
    evaluate.main(command("adapted.pt", recordings))
    assert len(texts) == 1 and not texts[0].any()


def test_a_run_of_another_policy_stands_beside_that_policys_published_numbers(
    run, recordings, monkeypatch, capsys
):
    """The toy plays ML10: its tasks are renamed to two of that suite."""

    class Renamed(ToySimulator):
        instructions: ClassVar[dict] = {"reach": "To the red ball.", "push": "To the green ball."}

        def tasks(self, suite):
            return ["reach", "push"], []

    monkeypatch.setitem(simulator.SIMULATORS, "ml10", Renamed)
    monkeypatch.setattr(
        evaluate,
        "evaluate_checkpoint",
        lambda recordings, **_: report.Outcomes({task: [True] for task in recordings}, None),
    )
    renamed = dict(zip(("reach", "push"), recordings.values()))
    monkeypatch.setattr(evaluate, "collect", lambda *_, **__: renamed)
    Path("runs/dp3").mkdir()
    dp3 = model.build_policy(replace(TINY, policy="dp3", demo_encoder="none", tcfm="none"))
    model.save("runs/dp3/ema-00006.pt", dp3, **{**INFO, "suite": "ml10"})
    evaluate.main(["--checkpoint", "runs/dp3"])
    table = capsys.readouterr().out
    assert "| paper, DP3 |" in table and "DAMI" not in table and "54.7" in table
    evaluate.main(["--checkpoint", "runs/dp3", str(run), "--suite", "ml10", "--overwrite"])
    assert "| paper, DP3 | paper, DAMI |" in capsys.readouterr().out


def test_results_are_overwritten_only_when_asked_and_nothing_else_is(run, recordings, capsys):
    argv = command(run, recordings, "--episodes 1 --out report")
    evaluate.main(argv)
    mine = [Path("report/notes.md"), Path("report/adapted-notes.pt"), Path("report/.2024-11.txt")]
    for path in (*mine, Path("report/held-out.md")):
        path.write_text("x")
    before = Path("report/success.json").read_bytes()
    assert "already holds success.json: add --overwrite" in fails(evaluate, argv, capsys)
    assert Path("report/success.json").read_bytes() == before
    evaluate.main([*argv, "--overwrite", "--seed", "1"])
    assert report_of("report")["provenance"]["seed"] == 1
    assert all(path.exists() for path in mine)
    assert not Path("report/held-out.md").exists()  # a result, too


def test_old_results_stay_where_the_new_ones_are_refused(run, recordings, monkeypatch, capsys):
    argv = command(run, recordings, "--episodes 1 --out report")
    evaluate.main(argv)

    def refuse(*_, **__):
        raise evaluate.UserError("no disk")

    monkeypatch.setattr(evaluate, "collect", refuse)
    assert "no disk" in fails(evaluate, [*argv, "--overwrite"], capsys)
    assert Path("report/success.json").exists()


def test_a_control_keeps_of_a_demonstration_what_its_name_says():
    generator = torch.Generator().manual_seed(0)
    whole = {
        "demo_points": torch.rand(1, 6, 4, 3, generator=generator),
        "demo_state": torch.rand(1, 6, 5, generator=generator),
        "demo_action": torch.rand(1, 6, 2, generator=generator),
    }
    changed = {name: make(whole) for name, make in evaluate.DEMONSTRATION_CONTROLS.items()}
    for demonstration in changed.values():
        assert {n: x.shape for n, x in demonstration.items()} == {
            n: x.shape for n, x in whole.items()
        }
    assert not any(x.any() for x in changed["zeros"].values())
    for name, x in changed["last-frame"].items():
        assert all(torch.equal(x[:, t], whole[name][:, -1]) for t in range(6))
    for name, x in changed["no-actions"].items():
        assert not x.any() if name == "demo_action" else torch.equal(x, whole[name])
    order = [  # one for all three
        [int((whole[name][0] == frame).flatten(1).all(1).nonzero()) for frame in x[0]]
        for name, x in changed["shuffled"].items()
    ]
    assert order[0] == order[1] == order[2] != list(range(6)) and sorted(order[0]) == [*range(6)]


# ---- Animations ----------------------------------------------------------------------------------


def test_a_rollout_can_be_watched(run, recordings, capsys):
    evaluate.main(command(run, recordings, "--task touch-red touch-green --gif x.gif"))
    assert Path("x.gif").read_bytes().startswith(b"GIF8")
    assert Path("x.gif").stat().st_size > 10_000
    printed = capsys.readouterr()
    assert "wrote x.gif" in printed.out
    assert "rolling out: " in printed.err and "drawing: 100%" in printed.err
    assert not Path("runs/evaluation").exists()


def test_every_second_step_and_the_last_moment_are_filmed(trained, recordings, monkeypatch):
    films = []
    monkeypatch.setattr(evaluate, "animate", lambda of_tasks, *_: films.append(of_tasks))
    sampler = data.WindowSampler(data.load_demonstrations(recordings["touch-red"]), TINY)
    made = []

    class Kept(ToySimulator):
        def make(self, task, num_points):
            made.append(super().make(task, num_points))
            return made[-1]

    text, _ = features(["touch-red"], None, None)
    [successes] = evaluate.write_animation(
        trained, Kept(), [sampler], {"touch-red": text[0]}, seed=2, path=Path("x.gif")
    )
    [film], [environment] = films, made
    [(task, frames)] = film.items()
    assert task == "touch-red" and environment.steps == len(successes) == 12
    assert [frame.step for frame in frames] == [*range(0, environment.steps, 2), environment.steps]
    outcome_before = [False, *successes]  # nothing is told before it happens
    assert [frame.success for frame in frames] == [outcome_before[f.step] for f in frames]
    np.testing.assert_array_equal(frames[-1].cloud, environment.observe()["point_cloud"])
    np.testing.assert_array_equal(frames[-1].picture, environment.render())
    assert not np.array_equal(frames[0].picture, frames[-1].picture)
    [again] = evaluate.rollout(  # filming changes nothing
        trained,
        [ToySimulator().make("touch-red", 64)],
        [simulator.evaluation_seed(2, 0)],
        sampler,
        text[0],
        torch.Generator().manual_seed(simulator.evaluation_seed(2, 0)),
    )
    assert again == successes


class Vanishing(ToyEnvironment):
    """Succeeds at every step, until nothing is seen any more."""

    def begin(self, seed):
        super().begin(seed)
        self.observed = 0

    def observe(self):
        self.observed += 1
        if self.steps >= 8 or self.hidden:
            raise simulator.OutOfSightError("gone")
        cloud = super().observe()["point_cloud"]
        cloud[:, 2] = 0.5  # all at one height, as in a plane
        return {"point_cloud": cloud, "agent_pos": np.float32(self.hand)}

    def advance(self, action):
        reward, truncated, _ = super().advance(action)
        return reward, truncated, {"success": True}


@pytest.mark.parametrize("hidden", [False, True])
def test_an_episode_in_which_nothing_is_seen_any_more_is_filmed_as_the_failure_that_it_is(
    trained, recordings, hidden, monkeypatch, capsys
):
    class Simulator(ToySimulator):
        def make(self, task, num_points):
            environment = Vanishing(None, num_points, self.episode_steps)
            environment.hidden = hidden  # from the start
            return environment

    films = []
    animate = evaluate.animate
    monkeypatch.setattr(evaluate, "animate", lambda *x: (films.append(x[0]), animate(*x)))
    sampler = data.WindowSampler(data.load_demonstrations(recordings["touch-red"]), TINY)
    text, _ = features(["touch-red"], None, None)
    animated = partial(
        evaluate.write_animation,
        policy=trained,
        simulator=Simulator(),
        samplers=[sampler],
        text={"touch-red": text[0]},
        seed=2,
        path=Path("x.gif"),
    )
    if hidden:
        message = "touch-red: nothing is seen at the start of the episode of seed"
        with pytest.raises(evaluate.UserError, match=message):
            animated()
        return
    [successes] = animated()
    [film] = films
    assert successes == [True] * 7 + [False]
    assert [frame.success for frame in film["touch-red"]][-2:] == [True, False]
    assert Path("x.gif").read_bytes().startswith(b"GIF8")  # also of a plane


def test_an_adapted_policy_is_watched_from_its_folder(
    run, trained, recordings, monkeypatch, capsys
):
    seen = []
    monkeypatch.setattr(
        evaluate,
        "write_animation",
        lambda p, s, samplers, *_, **__: (seen.append(samplers[0].task), [[False]])[1],
    )
    Path("all/touch-blue").mkdir(parents=True)
    model.save("all/touch-blue/adapted.pt", trained, **{**INFO, "adapted_to": "touch-blue"})
    evaluate.main(command("all/touch-blue", recordings, "--gif x.gif"))
    assert seen == ["touch-blue"] and "is novel" not in capsys.readouterr().out
    message = fails(evaluate, command("all", recordings, "--gif x.gif"), capsys)
    assert "holds no checkpoint: name all/touch-blue" in message
    message = fails(evaluate, command(run, recordings, "--out all/touch-blue --overwrite"), capsys)
    assert "holds an adapted policy" in message and Path("all/touch-blue/adapted.pt").exists()
    Path("all/touch-blue/adapted.pt").rename("all/touch-blue/adapted-00005.pt")  # stopped there
    fails(evaluate, command(run, recordings, "--out all/touch-blue --overwrite"), capsys)
    assert Path("all/touch-blue/adapted-00005.pt").exists()
    evaluate.main(command(run, recordings, "--gif x.gif --task touch-blue"))
    advice = f"`python finetune.py --task touch-blue --suite toy --checkpoint {run}/ema-00006.pt`"
    assert f"touch-blue is novel to this policy: {advice}" in capsys.readouterr().out


def test_a_movie_is_written_by_what_is_there(monkeypatch):
    assert evaluate.movie_writer("x.gif").fps == report.FPS
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(evaluate.UserError, match="install ffmpeg or `pip install imageio-ffmpeg`"):
        evaluate.movie_writer("x.mp4")
    package = SimpleNamespace(get_ffmpeg_exe=lambda: sys.executable)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", package)
    assert evaluate.movie_writer("x.mp4").bin_path() == sys.executable


# ---- Refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options, message",
    [
        ("--checkpoint none.pt", "no checkpoint at none.pt"),
        ("--episodes 0", "--episodes is 0: use at least 1"),
        ("--episodes 100001", "use fewer --episodes"),
        ("--demonstrations 0", "--demonstrations is 0: use at least 1"),
        ("--workers 0", "--workers is 0: use at least 1"),
        ("--seed -1", "seed -1 is out of range"),
        ("--seed 1000", "seed 1000 is out of range"),
        ("--task touch-rd", "did you mean 'touch-red'?"),
        ("--suite ml-45", "did you mean 'ml45'?"),
        ("--suite goals-raech", "did you mean 'goals-reach'?"),
        ("--n-action-steps 99", "cannot be used like this: n_action_steps is 99"),
        ("--support 3", "--support is for --inner-steps: give both"),
        ("--inner-lr 0.1", "--inner-lr is for --inner-steps: give both"),
        ("--inner-steps 1 --inner-lr nan", "--inner-lr is nan: use a number from 0"),
        ("--top -1", "--top is -1: use at least 0"),
        ("--top 5", "holds 2 checkpoints, fewer than --top"),
        ("--swap instruction --known-goals", "shows another's: leave out one of the two"),
        ("--inner-steps 1 --n-action-steps 4", "windows that --inner-steps learn from: leave out"),
        ("--swap instruction --task touch-red", "name two --task"),
        ("--swap instruction --task touch-red touch-red", "name two --task"),
        ("--controls last-frame --without demonstration", "leave out --without demonstration"),
        ("--gif x.gif --split all", "at most 2 rollouts"),
        ("--gif x.gif --task touch-red --known-goals", "leave out --known-goals"),
        ("--gif x.gif --task touch-red --without demonstration", "--without demonstration"),
        ("--gif x.gif --task touch-red touch-blue --swap demonstration", "leave out --swap"),
        ("--gif x.gif --task touch-red --controls zeros", "leave out --controls"),
        ("--gif x.gif --task touch-red --top 2", "leave out --top"),
        ("--gif x.gif --task touch-red --stop-at-success", "leave out --stop-at-success"),
        ("--swap demonstration --without demonstration", "leave out one of the two"),
        ("--gif x.avi --task touch-red", "name it .gif or .mp4"),
        ("--gif none/x.gif --task touch-red", "there is no such folder"),
        ("--out runs/toy-tiny-seed0", "holds a training run: choose another --out"),
        ("--checkpoint runs/toy-tiny-seed0 runs/toy-tiny-seed0", "rename one's folder"),
        ("--device cuda:99", "cannot be used here"),
    ],
)
def test_a_mistake_ends_in_one_line_that_says_what_to_do(
    run, recordings, options, message, monkeypatch, capsys
):
    monkeypatch.setattr(evaluate, "run_jobs", common.run_jobs)
    monkeypatch.setattr(evaluate, "MAX_FILMS", 2)  # the suite has three tasks
    assert message in fails(evaluate, command(run, recordings, options), capsys)


@pytest.mark.parametrize(
    "info, others, options, message",
    [
        (
            {"adapted_to": "touch-blue"},
            [],
            "--task touch-red",
            "was adapted to touch-blue, not to touch-red",
        ),
        ({"adapted_to": "touch-blue"}, ["run"], "", "are for different tasks: measure"),
        (
            {"adaptation": {"instruction": False}},
            ["run"],
            "",
            "measure policies with and without --no-instruction apart",
        ),
        ({"text_weights": "others"}, ["run"], "", "made with text weights 'others'"),
        ({"suite": "own"}, [], "", "no simulator to be measured in"),
        ({"suite": "none"}, [], "", "unknown suite 'none'"),
    ],
)
def test_a_checkpoint_that_cannot_be_measured_so_is_refused(
    run, trained, recordings, info, others, options, message, capsys
):
    model.save("other.pt", trained, **{**INFO, **info})
    argv = command(run if others else "other.pt", recordings, options)
    if others:
        argv.insert(2, "other.pt")
    assert message in fails(evaluate, argv, capsys)
    if others:  # in the other order, too
        argv[1:3] = argv[2:0:-1]
        in_other_order = message.replace("'others'", "'words'")
        assert in_other_order in fails(evaluate, argv, capsys)


def test_without_any_policy_the_user_is_told_how_to_make_one(monkeypatch, capsys):
    monkeypatch.setattr(evaluate, "SHIPPED_CHECKPOINT", Path("none.pt"))
    assert "no finished run on ml10 in runs/: train one" in fails(evaluate, [], capsys)


@pytest.mark.parametrize(
    "options, message",
    [
        ("--checkpoint damaged.pt", "damaged.pt is damaged or no PyTorch checkpoint"),
        ("--data damaged", "touch-red.npz"),
        ("--clip-weights none.pt", "none.pt: there is no such file"),
    ],
)
def test_the_script_says_of_damaged_files_what_they_are(
    run, recordings, options, message, monkeypatch, capsys
):
    Path("damaged.pt").write_bytes(b"x")
    Path("damaged").mkdir()
    Path("damaged/touch-red.npz").write_bytes(b"x")
    monkeypatch.setattr(sys, "argv", ["evaluate.py", *command(run, recordings, options)])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(evaluate.__file__, run_name="__main__")
    error = capsys.readouterr().err
    assert end.value.code == 2 and error.startswith("error: ") and message in error


# ---- Held-out episodes ---------------------------------------------------------------------------


def test_the_action_error_is_the_mean_absolute_error_over_executed_chunks(monkeypatch):
    policy = model.DAMIPolicy(model.PRESETS["tiny"])
    kept, heldout = data.hold_out(numbered([30, 40, 12]), 2)
    shown_to, drawn = [], []

    def draw(points, state, context, generator):
        shown_to.append(context)
        drawn.append(torch.full((len(points), 8, 4), 10.5))
        return drawn[-1]

    monkeypatch.setattr(policy, "sample_actions", draw)
    monkeypatch.setattr(policy, "encode_demo", lambda text, demo_action, **_: demo_action)
    heldout.action[:, 3] += 1  # the numbers of an action have errors of their own
    error = evaluate.action_error(
        policy,
        data.WindowSampler(kept, policy.config),
        data.WindowSampler(heldout, policy.config),
        torch.zeros(512),
    )
    # Episode 1: chunks at 0, 8, 16, 24, 32; episode 2 has 12 frames: at 0, and half a one at 8.
    first, second = 10 + 0.01 * np.arange(40), 20 + 0.01 * np.arange(12)
    assert [len(chunks) for chunks in drawn] == [5, 2]
    actions = np.concatenate([first, second])[:, None] + [0, 0, 0, 1]
    assert error.of_policy == pytest.approx(np.abs(actions - 10.5).mean(0), rel=1e-4)
    assert error.of_mean_action == pytest.approx(np.abs(actions - 0.01 * 14.5).mean(0), rel=1e-4)
    assert all((demo < 10).all() for demo in shown_to)  # an episode that was trained on


def test_every_task_with_held_out_episodes_is_judged_by_its_own(trained, recordings):
    train_samplers, heldout_samplers = {}, {}
    for task in TASKS:
        kept, heldout = data.hold_out(data.load_demonstrations(recordings[task]), 1)
        train_samplers[task] = data.WindowSampler(kept, TINY)
        heldout_samplers[task] = data.WindowSampler(heldout, TINY)
    text = dict(zip(TASKS, features(TASKS, None, None)[0]))

    def errors(**options):
        measured = evaluate.evaluate_heldout(
            trained, train_samplers, heldout_samplers, text, **options
        )
        return {task: error.of_policy.tolist() for task, error in measured.items()}

    own = errors()
    for task in TASKS:
        alone = evaluate.action_error(
            trained, train_samplers[task], heldout_samplers[task], text[task]
        )
        assert own[task] == alone.of_policy.tolist()
    assert own["touch-red"] != own["touch-green"]
    swapped, without = errors(swap_demonstrations=True), errors(demonstration_control="zeros")
    assert own["touch-red"] != swapped["touch-red"] != without["touch-red"] != own["touch-red"]
    del heldout_samplers["touch-red"]
    assert errors() == {"touch-green": own["touch-green"]}


def test_a_policy_that_draws_the_experts_actions_has_no_action_error(recordings, monkeypatch):
    recorded = data.load_demonstrations(recordings["touch-red"])
    sampler, policy = data.WindowSampler(recorded, TINY), model.build_policy(TINY)

    def recall(points, state, context, generator):
        """The actions that follow where this state, the hand's position, was recorded."""
        chunks = []
        for cloud, hand in zip(points[:, -1], state[:, -1]):
            here = (sampler.points.float() == cloud).all((1, 2)) & (sampler.state == hand).all(1)
            frame = int(here.nonzero()[0])
            chunks.append(sampler.action[(torch.arange(8) + frame).clamp(max=len(here) - 1)])
        return torch.stack(chunks)

    monkeypatch.setattr(policy, "sample_actions", recall)
    error = evaluate.action_error(policy, sampler, sampler, torch.zeros(512))
    assert error.of_policy.max() < 1e-6 < error.of_mean_action.mean()

    monkeypatch.setattr(tests.drift, "PARTS", ((0, 4), (8, 12)))
    expert, drawn = zip(*tests.drift.forward_actions(policy, sampler, torch.zeros(512)))
    assert drawn == pytest.approx(expert, abs=1e-6)
    assert expert[0] > 0.5 and expert[1] < 0.1  # on its way, and where it stands


def test_checkpoints_are_judged_on_episodes_that_no_training_saw(
    run, trained, recordings, monkeypatch, capsys
):
    monkeypatch.setattr(tests.unseen, "SUITE", "toy")
    folder = recordings["touch-red"].parent
    Path("seen").mkdir()
    for task in TASKS:
        recorded = data.load_demonstrations(folder / f"{task}.npz")
        data.save_demonstrations(f"seen/{task}.npz", recorded.take(1))
    argv = [str(run), str(run / "ema-00006.pt"), "--data", "seen", "--unseen", str(folder)]
    tests.unseen.main(argv)
    rows = [line.split("|")[1:-1] for line in capsys.readouterr().out.splitlines()[2:]]
    files = [run / "ema-00003.pt", *2 * [run / "ema-00006.pt"]]
    assert [Path(row[0].strip()) for row in rows] == files
    text, errors = features(TASKS, None, None)[0], []
    for task, feature in zip(TASKS, text):
        shown = data.WindowSampler(data.load_demonstrations(f"seen/{task}.npz"), TINY)
        held = data.WindowSampler(data.load_demonstrations(folder / f"{task}.npz"), TINY)
        error = evaluate.action_error(trained, shown, held, feature)
        errors.append((error.of_policy.mean(), error.of_mean_action.mean()))
    expected = [f"{mean:.4f}" for mean in np.mean(errors, axis=0)]
    assert [cell.strip() for cell in rows[-1][1:]] == expected and rows[1] == rows[2] != rows[0]
