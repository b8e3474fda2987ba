"""Tests of train.py: Algorithm 1's batches and steps, whole runs at preset `tiny`, bad input."""

import copy
import functools
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import BASE, fails, fingerprint, metrics, same_bits, weights, whole_state
from test_finetune import COLORS, own_recording, save_recording
from torch.func import functional_call

import common
import data
import evaluate
import finetune
import model
import report
import simulator
import train
from tests import oracle

ROOT = Path(train.__file__).resolve().parent
SHORT = (
    "--preset tiny --steps 4 --checkpoint-every 2 --clip-weights random --device cpu --threads 1"
).split()
pytestmark = pytest.mark.usefixtures("small_suite", "own_folder", "no_curves", "no_pictures")


@pytest.fixture
def no_curves(monkeypatch):
    """No curves are drawn: they take half a second each."""
    monkeypatch.setattr(report, "plot_curves", lambda folder: (folder / "curves.png").touch())


def save_pair(folder):
    """Writes recordings of random numbers of two tasks unlike each other."""
    for task, scale in (("pour", 1.0), ("stir", 2.0)):
        recording = own_recording(180, ends=[90, 180], task=task)
        recording["state"] *= scale
        recording["action"] = np.roll(recording["action"], int(7 * scale), axis=0)
        recording["meta"] = json.dumps({"positions_in_state": 3, "success_frames": [40, 40]})
        save_recording(folder, recording)
    return folder


@pytest.fixture(scope="session")
def pair(tmp_path_factory):
    """The folder of `save_pair`, to be left as it is."""
    return save_pair(tmp_path_factory.mktemp("pair"))


@pytest.fixture(scope="session")
def finished(pair, tmp_path_factory):
    """The folder of a run on `pair` that nothing interrupted, to be left as it is."""
    folder = tmp_path_factory.mktemp("finished") / "run"
    train.main([*SHORT, "--data", str(pair), "--out", str(folder)])
    return folder


class Bowl:
    """Stands in for a simulator whose recordings are those of `save_pair`. It is not rolled out."""

    name, instructions, episode_steps = "bowl", {"pour": "Pour.", "stir": "Stir."}, 90

    def tasks(self, suite):
        return ["pour", "stir"], ["fold"]


@pytest.fixture
def bowl(monkeypatch, pair):
    """The suite `bowl`, already collected; returns the flags of a run that it is evaluated in."""
    monkeypatch.setitem(simulator.SIMULATORS, "bowl", Bowl)
    monkeypatch.setattr(train, "collect", lambda *_, **__: None)
    return [*SHORT, "--suite", "bowl", "--data", str(pair), "--episodes", "2"]


# ---- Settings, learning rate, batches ------------------------------------------------------------


def test_every_setting_is_a_flag_and_is_kept(finished):
    args = train.parse([])
    assert all(hasattr(args, name) for name in asdict(train.Settings()))
    kept = weights(finished / "ema-00004.pt")[1]["arguments"]
    assert train.Settings(**kept).steps == 4 and kept.keys() == asdict(train.Settings()).keys()


def test_help_says_each_presets_value(capsys):
    with pytest.raises(SystemExit):
        train.parse(["--help"])
    printed = " ".join(capsys.readouterr().out.split())
    assert "outer steps (paper 54000, small 8000, tiny 30)" in printed
    assert "of weights, batches and noise (0)" in printed
    assert "(paper 512, small 128, tiny 64)" in printed


def test_the_learning_rate_warms_up_and_falls_to_zero_along_a_cosine():
    settings = train.Settings(steps=1500, lr=1e-3, warmup=500)
    rate = functools.partial(train.learning_rate, settings=settings, peak=settings.lr)
    assert rate(0) == pytest.approx(1e-3 / 500)
    assert rate(499) == rate(500) == pytest.approx(1e-3)
    assert rate(1000) == pytest.approx(5e-4)
    assert 0 < rate(1499) < 1e-8 and rate(1500) == pytest.approx(0, abs=1e-12)
    assert train.learning_rate(0, replace(settings, warmup=0), peak=1e-3) == 1e-3
    assert np.all(np.diff([rate(step) for step in range(500, 1500)]) < 0)


def one_task(**options):
    """A policy and the windows of one task's recording."""
    policy = model.build_policy(model.PRESETS["tiny"])
    demonstrations = data.Demonstrations(**own_recording(180, ends=[90, 180]) | {"meta": {}})
    return policy, data.WindowSampler(demonstrations, policy.config, **options)


def test_training_begins_with_the_papers_adamw_over_every_parameter():
    _, sampler = one_task()
    state = train.start_training(
        model.PRESETS["tiny"], train.Settings(lr=0.25), {"stir": sampler}, "cpu"
    )
    (group,) = state.optimizer.param_groups
    assert isinstance(state.optimizer, torch.optim.AdamW) and group["lr"] == 0.25
    assert group["betas"] == (0.95, 0.999) and group["weight_decay"] == 1e-6
    assert set(map(id, group["params"])) == set(map(id, state.policy.parameters()))


def test_a_batch_follows_from_its_seed_alone():
    policy, sampler = one_task()

    def batch(*seed):
        return train.task_batch(policy, sampler, torch.zeros(512), 12, seed, train.Settings())

    first = batch(0, 1, 2)
    assert same_bits(first, batch(0, 1, 2))
    for other in (batch(0, 2, 2), batch(0, 1, 3), batch(1, 1, 2)):
        assert not torch.equal(first["noise"], other["noise"])
        assert not torch.equal(first["action"], other["action"])


def test_support_and_query_of_a_batch_are_of_different_episodes():
    recording = own_recording(180, ends=[60, 120, 180]) | {"meta": {}}
    recording["state"][:] = np.repeat([0.0, 1.0, 2.0], 60)[:, None]  # tells the episode
    policy = model.build_policy(model.PRESETS["tiny"])
    sampler = data.WindowSampler(data.Demonstrations(**recording), policy.config)
    settings = train.Settings(support=4, query=8)
    for k in range(20):
        batch = train.task_batch(policy, sampler, torch.zeros(512), 12, (0, k), settings)
        support, query = (set(x["state"].unique().tolist()) for x in model.split(batch, 4))
        assert not support & query


def test_a_share_of_the_batches_sees_no_instruction_and_of_inner_steps_nothing():
    policy, sampler = one_task()

    def batches(inner=False, **shares):
        settings, text = train.Settings(**shares), torch.ones(512)
        return [
            train.task_batch(policy, sampler, text, 4, (0, k), settings, inner) for k in range(40)
        ]

    plain, dropped = batches(), batches(instruction_dropout=0.5)
    silent = [bool((batch["text"] == 0).all()) for batch in dropped]
    assert 10 <= sum(silent) <= 30
    for one, other in zip(plain, dropped):
        assert same_bits(one | {"text": 0}, other | {"text": 0})

    assert all(map(same_bits, plain, batches(task_dropout=0.5)))  # but for inner steps
    inner = batches(inner=True, task_dropout=0.5)
    hidden = [bool((batch["demo_points"] == 0).all()) for batch in inner]
    assert 10 <= sum(hidden) <= 30 and not any((b["demo_points"] == 0).all() for b in plain)
    for one, other, hides in zip(plain, inner, hidden):
        for name in one:
            zero = hides and name in model.TASK_INPUTS
            assert torch.equal(other[name], torch.zeros_like(one[name]) if zero else one[name])


def test_both_shares_are_drawn_apart():
    policy, sampler = one_task()
    settings = train.Settings(instruction_dropout=0.5, task_dropout=0.5)
    batches = [
        train.task_batch(policy, sampler, torch.ones(512), 4, (0, k), settings, inner=True)
        for k in range(200)
    ]
    kinds = [(bool(b["text"].any()), bool(b["demo_points"].any())) for b in batches]
    assert kinds.count((False, False)) == pytest.approx(100, abs=25)
    assert kinds.count((False, True)) == pytest.approx(50, abs=20)
    assert kinds.count((True, True)) == pytest.approx(50, abs=20)


def test_the_tasks_of_a_step_and_of_a_training_follow_from_the_seed():
    settings = train.Settings(seed=3, tasks_per_step=4)
    steps = [train.tasks_of_step(step, 10, settings) for step in range(200)]
    assert all(len(set(places)) == 4 and places == sorted(places) for places in steps)
    assert steps == [train.tasks_of_step(step, 10, settings) for step in range(200)]
    counts = np.bincount(np.concatenate(steps), minlength=10)
    assert counts.min() > 50 and steps[0] != steps[1]  # each is drawn, about 80 times
    assert train.tasks_of_step(0, 10, replace(settings, seed=4)) != steps[0]
    for every in (None, 10, 11):
        assert train.tasks_of_step(7, 10, replace(settings, tasks_per_step=every)) == [*range(10)]

    names = [f"task-{i}" for i in range(10)]
    drawn = [simulator.draw_base_tasks(names, 4, seed) for seed in range(5)]
    assert all(len(set(of)) == 4 and of == sorted(of) for of in drawn)
    assert len({tuple(of) for of in drawn}) == 5
    assert simulator.draw_base_tasks(names, None, seed=0) == names
    with pytest.raises(common.UserError, match="--base-tasks is 11: there are 10"):
        simulator.draw_base_tasks(names, 11, seed=0)


def test_the_world_in_which_weights_are_frozen_trains_rates_alone(monkeypatch):
    """Before, training ends as if it were all; a world of tests.oracle."""
    schedule = train.learning_rate
    monkeypatch.setattr(train, "learning_rate", schedule)  # undone at the end
    oracle.frozen()
    settings = train.Settings(steps=40, pretrain_fraction=0.5, lr=1e-3, rate_lr=1e-2, warmup=4)
    weights = [train.learning_rate(step, settings, peak=1e-3) for step in range(40)]
    alone = replace(settings, steps=20)
    assert weights[:20] == [schedule(step, alone, peak=1e-3) for step in range(20)]
    assert weights[20:] == [0.0] * 20
    assert train.learning_rate(30, settings, peak=1e-2) == 1e-2
    with pytest.raises(AssertionError, match="--lr and --rate-lr must differ"):
        train.learning_rate(0, replace(settings, lr=1e-2), peak=1e-2)


def test_the_world_without_an_average_keeps_the_last_weights(monkeypatch):
    monkeypatch.setattr(train, "ema_model", train.ema_model)
    oracle.not_averaged()
    policy = model.build_policy(model.PRESETS["tiny"])
    average = train.ema_model(policy)
    for _ in range(3):
        for p in policy.parameters():
            p.data += 1
        average.update_parameters(policy)
    assert same_bits(dict(average.module.state_dict()), dict(policy.state_dict()))


def test_products_in_bfloat16_leave_nearly_the_same_gradient():
    torch.manual_seed(0)
    policy, sampler = one_task()
    policy.normalizer.fit([sampler])
    text = torch.randn(512)
    batches = [
        train.task_batch(policy, sampler, text, 12, (0, 0, k), train.Settings()) for k in range(4)
    ]
    whole, half = (
        torch.cat([g.flatten() for g in train.multi_task_gradient(policy, batches, b)[0].values()])
        for b in (False, True)
    )
    assert half.dtype == torch.float32 and not torch.equal(whole, half)
    assert torch.cosine_similarity(whole, half, dim=0) > 0.99


# ---- Algorithm 1, whole steps --------------------------------------------------------------------


def two_tasks():
    """The windows and instruction features of two tasks unlike each other.

    The robot moves twice as far in the second task, and its clouds lie 2 m aside.
    """
    samplers = {}
    for i, task in enumerate(("stir", "pour")):
        recording = own_recording(180, ends=[90, 180], task=task) | {"meta": {}}
        recording["points"] += np.float16(2 * i)
        recording["action"] *= 1 + i
        demonstrations = data.Demonstrations(**recording)
        samplers[task] = data.WindowSampler(demonstrations, model.PRESETS["tiny"])
    generator = torch.Generator().manual_seed(0)
    text = {task: torch.randn(512, generator=generator).double() for task in samplers}
    return samplers, text


def adam_direction(moments, name, gradient, step):
    """Where Adam goes at a learning rate of 1, with betas 0.95 and 0.999; updates its moments."""
    m, v = moments[name]
    moments[name] = m, v = 0.95 * m + 0.05 * gradient, 0.999 * v + 0.001 * gradient**2
    unbiased_m, unbiased_v = m / (1 - 0.95 ** (step + 1)), v / (1 - 0.999 ** (step + 1))
    return unbiased_m / (unbiased_v.sqrt() + 1e-8)


def plain_meta_training(policy, samplers, text, settings):
    """Algorithm 1 with SGD's inner step, AdamW and the moving average written out.

    Yields after each outer step (weights, averaged weights, logarithms of the inner rates, query
    loss, query loss before the inner step, gradient norm). Draws are as train.py says: they follow
    from (seed, step, task) alone.
    """
    theta = {name: p.detach().clone() for name, p in policy.named_parameters()}
    average = {name: torch.zeros_like(p) for name, p in theta.items()}
    log_rates = {
        name: torch.tensor(math.log(settings.inner_lr), dtype=torch.float64) for name in theta
    }
    moments = {name: (0.0, 0.0) for name in theta}
    rate_moments = {name: (0.0, 0.0) for name in theta}
    n = settings.support + settings.query
    for step in range(settings.steps):
        theta = {name: p.requires_grad_() for name, p in theta.items()}
        log_rates = {name: x.requires_grad_() for name, x in log_rates.items()}
        after, before = [], []
        for i in train.tasks_of_step(step, len(samplers), settings):
            task, sampler = list(samplers.items())[i]
            seed = np.random.SeedSequence((settings.seed, step, i)).generate_state(2, np.uint64)[0]
            generator = torch.Generator().manual_seed(int(seed))
            batch = sampler.batch(n, generator) | policy.draw_noise_and_timesteps(n, generator)
            task_inputs = {name: batch.pop(name) for name in list(batch) if "demo_" in name}
            task_inputs["text"] = text[task][None]
            support = {name: x[: settings.support] for name, x in batch.items()} | task_inputs
            query = {name: x[settings.support :] for name, x in batch.items()} | task_inputs
            loss = functional_call(policy, theta, (), support)
            gradient = torch.autograd.grad(loss, list(theta.values()), create_graph=True)
            adapted = {
                name: p - log_rates[name].exp() * g for (name, p), g in zip(theta.items(), gradient)
            }
            after.append(functional_call(policy, adapted, (), query))
            before.append(functional_call(policy, theta, (), query))
        loss = torch.stack(after).mean()
        gradients = torch.autograd.grad(loss, [*theta.values(), *log_rates.values()])
        rate_gradients = dict(zip(log_rates, gradients[len(theta) :]))
        gradients = dict(zip(theta, gradients))

        warm = (step + 1) / settings.warmup
        done = (step - settings.warmup) / (settings.steps - settings.warmup)
        scale = warm if warm <= 1 else (1 + math.cos(math.pi * done)) / 2
        decay = 0 if step == 0 else 1 - (1 + step) ** -0.75
        theta = {name: p.detach() for name, p in theta.items()}
        log_rates = {name: x.detach() for name, x in log_rates.items()}
        for name, g in gradients.items():  # AdamW, weight decay 1e-6
            direction = adam_direction(moments, name, g, step)
            shrunk = theta[name] * (1 - scale * settings.lr * 1e-6)
            theta[name] = shrunk - scale * settings.lr * direction
            average[name] = decay * average[name] + (1 - decay) * theta[name]
        if settings.learn_inner_lr:
            for name, g in rate_gradients.items():  # no weight decay
                direction = adam_direction(rate_moments, name, g, step)
                log_rates[name] = log_rates[name] - scale * settings.rate_lr * direction
        norm = torch.cat([g.flatten() for g in gradients.values()]).norm()
        yield theta, average, log_rates, loss.item(), torch.stack(before).mean().item(), norm.item()


@pytest.mark.parametrize(("learned", "tasks_per_step"), [(False, None), (True, None), (False, 1)])
def test_training_is_a_plain_loop_with_the_inner_step_adamw_and_the_average_written_out(
    monkeypatch, learned, tasks_per_step
):
    monkeypatch.setattr(train, "LOSS_BEFORE_EVERY", 2)
    samplers, text = two_tasks()
    settings = train.Settings(
        seed=3,
        steps=4,
        support=2,
        query=3,
        inner_lr=0.05,
        learn_inner_lr=learned,
        rate_lr=0.5,
        lr=1e-2,
        warmup=2,
        vectorize=2,
        tasks_per_step=tasks_per_step,
    )
    state = train.start_training(model.PRESETS["tiny"], settings, samplers, "cpu")
    policy = state.policy.double()  # in place: the optimizer's parameters, too
    average = state.average.module.double()
    for log_rate in state.log_rates.values():
        log_rate.data = torch.tensor(math.log(settings.inner_lr), dtype=torch.float64)
    for part in ("points", "state", "action"):  # scaled to both tasks
        whole = torch.cat([getattr(sampler, part).flatten(0, -2) for sampler in samplers.values()])
        scaled = policy.normalizer.normalize(part, whole)
        for end in (scaled.amin(0), scaled.amax(0).neg()):
            assert torch.allclose(end, torch.full_like(end, -1))
    plain = plain_meta_training(copy.deepcopy(policy), samplers, text, settings)
    training = train.meta_train(state, samplers, text, settings)
    mean_rate = settings.inner_lr
    for k, expected, figures in zip(range(4), plain, training):
        theta, averaged, log_rates, loss, before, norm = expected
        assert state.step == k + 1 and figures["loss"] == pytest.approx(loss, rel=1e-9)
        assert ("loss_before" in figures) == (k % 2 == 0)  # it is not measured at every step
        if k % 2 == 0:
            assert figures["loss_before"] == pytest.approx(before, rel=1e-9)
        assert figures["gradient_norm"] == pytest.approx(norm, rel=1e-9)
        for name, parameter in policy.named_parameters():
            assert torch.allclose(parameter, theta[name], atol=1e-9), (k, name)
        for name, parameter in average.named_parameters():
            assert torch.allclose(parameter, averaged[name], atol=1e-9), (k, name)
        if learned:  # the mean of the rates that this step used, which start as one
            assert figures["inner_lr"] == pytest.approx(mean_rate, rel=1e-9)
            mean_rate = float(np.exp(np.mean([x.item() for x in log_rates.values()])))
        assert ("inner_lr" in figures) == learned
        assert state.log_rates.keys() == (log_rates.keys() if learned else set())
        for name, log_rate in state.log_rates.items():
            assert torch.allclose(log_rate, log_rates[name], atol=1e-9), (k, name)
    assert k == 3 and list(training) == []


def first_step(folder, options=""):
    """Trains one step on own recordings; the line of metrics.jsonl and the EMA checkpoint."""
    out = Path("runs") / (options or "plain")
    train.main([*SHORT, "--steps", "1", "--data", str(folder), "--out", str(out), *options.split()])
    return metrics(out)[0], weights(out / "ema-00001.pt")[0]


FLAGS = (
    *("--augment", "--after-success 3", "--seed 1", "--inner-lr 0.5", "--lr 1", "--support 5"),
    *("--query 9", "--instruction-dropout 1", "--task-dropout 1", "--maml first", "--maml off"),
    *("--maml off --bfloat16", "--augment --one-map", "--after-success 3 --late-fraction 0.5"),
    *("--warmup 1", "--tasks-per-step 1", "--demonstrations 1", "--base-tasks 1"),
)
# What the first step does not show
LATER = {
    *("steps", "checkpoint_every", "evaluate_every", "episodes", "evaluate_on", "held_out"),
    *("pretrain_fraction", "vectorize", "learn_inner_lr", "rate_lr", "suite", "preset"),
}


def test_every_flag_changes_the_training(pair):
    """The first step's numbers are others with it; twice without it, they are the same."""
    lines = {options: first_step(pair, options)[0] for options in ("", "--seed 0", *FLAGS)}
    figures = {
        options: (line["loss"], line["gradient_norm"], line["lr"])
        for options, line in lines.items()
    }
    assert figures[""] == figures["--seed 0"]
    assert len(set(figures.values())) == len(figures) - 1
    rounded, exact = lines["--maml off --bfloat16"]["loss"], lines["--maml off"]["loss"]
    assert rounded == pytest.approx(exact, rel=0.05)
    named = {flag[2:].replace("-", "_") for flag in " ".join(FLAGS).split() if flag[:2] == "--"}
    assert named | LATER == set(asdict(train.Settings()))


def test_the_seed_draws_the_weights_and_all_tasks_scale_the_normalizer(pair):
    _, initial = first_step(pair, "--lr 0")
    _, again = first_step(pair, "--lr 0 --seed 0 --support 5")
    _, others = first_step(pair, "--lr 0 --seed 1")
    assert same_bits(dict(initial), dict(again))
    drawn = [name for name in initial if "normalizer" not in name and initial[name].std() > 0]
    assert len(drawn) > 20 and not any(torch.equal(initial[n], others[n]) for n in drawn)
    recordings = [data.load_demonstrations(file) for file in pair.glob("*.npz")]
    for part in ("points", "state", "action"):
        arrays = [getattr(recording, part) for recording in recordings]
        whole = np.concatenate([array.reshape(-1, array.shape[-1]) for array in arrays])
        half = (whole.max(0) - whole.min(0)) / 2
        assert np.allclose(initial[f"normalizer.{part}_scale"], half, rtol=1e-3)


# ---- Whole runs ----------------------------------------------------------------------------------


def test_training_leaves_everything_that_it_promises(run):
    names = "config.json curves.png ema-00003.pt ema-00006.pt last.pt metrics.jsonl"
    names += " success.json success.md success.png"
    assert sorted(p.name for p in run.iterdir() if p.name != ".lock") == names.split()
    config = json.loads((run / "config.json").read_text())
    assert config["arguments"]["steps"] == 6 and config["text weights"] == "random-seed-0"
    assert model.PolicyConfig(**config["config"]) == model.PRESETS["tiny"]

    lines = [line for line in metrics(run) if "loss" in line]
    assert [line["step"] for line in lines] == [1, 2, 3, 4, 5, 6]
    assert all(np.isfinite(line["loss"]) and line["gradient_norm"] > 0 for line in lines)
    (evaluated,) = (line for line in metrics(run) if "success" in line)
    written = json.loads((run / "success.json").read_text())
    successes = written["successes"]["last checkpoint"]
    assert list(successes) == BASE and all(len(episodes) == 2 for episodes in successes.values())
    assert evaluated["successes"] == successes
    assert evaluated["success"] == report.mean_success(successes)
    at_end = written["successes at the end"]["last checkpoint"]
    assert evaluated["successes_at_end"] == at_end
    assert evaluated["success_at_end"] == report.mean_success(at_end)
    assert written["provenance"]["seed"] == evaluate.EVALUATION_SEED == 0
    table = (run / "success.md").read_text()
    assert all(f"| {task} " in table for task in BASE)
    assert "paper, DAMI" in table and "random-seed-0" in table
    for name in ("curves.png", "success.png"):
        assert (run / name).read_bytes().startswith(b"\x89PNG")

    policy, ema = whole_state(run)["training"]["policy"], weights(run / "ema-00006.pt")[0]
    assert all(torch.equal(ema[name], policy[name]) for name in ema if "normalizer" in name)
    assert ema["normalizer.action_scale"].ne(1).any()  # fitted
    assert any(not torch.equal(ema[name], policy[name]) for name in ema)


def killed_run(pair, out, step):
    """Trains in a process killed (SIGKILL) just after logging `step`, between two savings."""
    program = f"""
import os, signal
import train
append_json = train.append_json
def append_and_die(path, **values):
    append_json(path, **values)
    if values["step"] == {step}:
        os.kill(os.getpid(), signal.SIGKILL)
train.append_json = append_and_die
train.main({[*SHORT, "--data", str(pair), "--out", str(out)]!r})
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True)
    assert done.returncode == -signal.SIGKILL, done.stderr.decode()


def test_a_run_killed_between_savings_resumes_to_the_same_bits(pair, finished, tmp_path):
    out = tmp_path / "killed"
    killed_run(pair, out, step=3)
    assert len(metrics(out)) == 3 and weights(out / "last.pt")[1]["step"] == 2
    with (out / "metrics.jsonl").open("a") as file:
        file.write('{"step": 4, "lo')  # as if killed while writing
    train.main([*SHORT, "--data", str(pair), "--out", str(out), "--resume"])
    assert same_bits(whole_state(out), whole_state(finished))
    for whole, resumed in zip(metrics(finished), metrics(out), strict=True):
        assert {**whole, "seconds": 0} == {**resumed, "seconds": 0}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_ctrl_c_saves_says_how_to_resume_and_ends_with_130(
    pair, finished, tmp_path, monkeypatch, capsys, number
):
    append_json, out = train.append_json, tmp_path / "interrupted"

    def append_and_interrupt(path, **values):
        append_json(path, **values)
        if values["step"] == 1:
            signal.raise_signal(number)

    argv = [*SHORT, "--data", str(pair), "--out", str(out)]
    with monkeypatch.context() as patch, pytest.raises(SystemExit) as end:
        patch.setattr(train, "append_json", append_and_interrupt)
        common.command_line(lambda: train.main(argv))
    error = capsys.readouterr().err
    assert end.value.code == 130 and "saved after step 1" in error and "--resume" in error
    assert weights(out / "last.pt")[1]["step"] == 1
    train.main([*argv, "--resume"])
    assert same_bits(whole_state(out), whole_state(finished))


def test_success_at_the_other_task_of_a_pair_is_kept_when_a_finished_run_is_resumed(
    bowl, tmp_path, monkeypatch
):
    def of_pairs(recordings, episodes, **_):
        won, lost = ({task: [x] * episodes for task in recordings} for x in (True, False))
        return report.Outcomes(won, won, other_task=lost)

    argv = [*bowl, "--out", str(tmp_path / "run")]
    monkeypatch.setattr(evaluate, "evaluate_checkpoint", of_pairs)
    train.main(argv)
    written = json.loads((tmp_path / "run/success.json").read_text())
    monkeypatch.setattr(evaluate, "evaluate_checkpoint", None)  # what is logged is not done again
    train.main([*argv, "--resume"])
    again = json.loads((tmp_path / "run/success.json").read_text())
    for part in ("successes", "successes at the end", "successes at the other task"):
        assert again[part] == written[part] != {}
    assert again["successes at the other task"] != again["successes"]


def test_a_run_stopped_while_it_is_evaluated_is_evaluated_when_resumed(
    bowl, tmp_path, monkeypatch, capsys
):
    def stopped(**_):
        signal.raise_signal(signal.SIGINT)

    out, argv = tmp_path / "run", [*bowl, "--evaluate-every", "4", "--out", str(tmp_path / "run")]
    with monkeypatch.context() as patch, pytest.raises(SystemExit) as end:
        patch.setattr(evaluate, "evaluate_checkpoint", stopped)
        common.command_line(lambda: train.main(argv))
    assert end.value.code == 130 and "add --resume to go on" in capsys.readouterr().err
    assert weights(out / "last.pt")[1]["step"] == 4 and not (out / "success.json").exists()

    successes, asked = {"pour": [True, False], "stir": [True, True]}, []

    def evaluated(**options):
        asked.append(options)
        return report.Outcomes(any_step=successes, at_end=successes)

    monkeypatch.setattr(evaluate, "evaluate_checkpoint", evaluated)
    train.main([*argv, "--resume"])
    [options] = asked
    assert options["checkpoint"] == out / "ema-00004.pt" and isinstance(options["simulator"], Bowl)
    assert list(options["recordings"]) == list(options["text"]) == ["pour", "stir"]
    assert options["episodes"] == 2 and options["n_demonstrations"] == 2 and options["seed"] == 0
    written = json.loads((out / "success.json").read_text())
    assert written["successes"]["last checkpoint"] == successes
    assert "--resume" not in written["provenance"]["command"]  # the command that began the run
    train.main([*argv, "--resume"])  # a finished run: nothing is done twice
    assert len(asked) == 1


def test_a_run_is_evaluated_and_resumed_where_it_was_asked_for(bowl, monkeypatch, capsys):
    evaluated = []

    def evaluate_and_stop(checkpoint, episodes, **_):
        evaluated.append(checkpoint.stem)
        if evaluated == ["ema-00002"]:
            signal.raise_signal(signal.SIGINT)
        outcomes = {"pour": [True] * episodes, "stir": [True] * episodes}
        return report.Outcomes(any_step=outcomes, at_end=outcomes)

    monkeypatch.setattr(evaluate, "evaluate_checkpoint", evaluate_and_stop)
    argv = [*bowl, *"--evaluate-every 2 --checkpoint-every 3 --held-out 1 --out run".split()]
    with pytest.raises(SystemExit) as end:
        common.command_line(lambda: train.main(argv))
    assert end.value.code == 130 and "add --resume to go on" in capsys.readouterr().err
    train.main([*argv, "--resume"])
    assert evaluated == [f"ema-{step:05d}" for step in (2, 2, 4)]
    train.main([*argv, "--resume"])  # is read from the log
    assert len(evaluated) == 3
    train.main([*argv, "--resume", "--episodes", "7"])  # of another number: not
    assert evaluated[3:] == ["ema-00004"]


def test_saving_takes_a_few_per_cent_of_the_time(tmp_path, monkeypatch):
    """A save of ten seconds is due again after minutes, one of an instant after seconds."""
    now = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    state = train.start_training(
        model.PRESETS["tiny"], train.Settings(), {"stir": one_task()[1]}, "cpu"
    )

    for length, waits in ((10.0, 250.0), (0.001, 20.0)):

        def save(*_, length=length, **__):
            nonlocal now
            now += length

        monkeypatch.setattr(model, "save", save)
        saver = train.Saver(tmp_path / "last.pt", info={})
        saver.save(state)
        now += waits - 1
        assert not saver.is_due()
        now += 2
        assert saver.is_due()


def test_a_run_saves_its_state_as_often_as_is_due(pair, monkeypatch):
    """Beside the two checkpoints, which are saved in any case."""
    saved, save = [], train.Saver.save

    def counted(saver, state):
        saved.append(state.step)
        save(saver, state)

    monkeypatch.setattr(train.Saver, "save", counted)
    argv = [*SHORT, "--data", str(pair)]
    train.main([*argv, "--out", "seldom"])
    assert saved == [2, 4]
    saved.clear()
    monkeypatch.setattr(train.Saver, "is_due", lambda saver: True)
    train.main([*argv, "--out", "often"])
    assert saved == [1, 2, 3, 4]


WAYS = {
    "second": "",
    "loop": "--vectorize 1",
    "first": "--maml first",
    "off": "--maml off",
    "mlp": "--demo-encoder mlp",
    "baseline": "--demo-encoder mlp --tcfm none",
    "+VMT": "--tcfm none",
    "dp3": "--maml off --demo-encoder none --tcfm none",
}


def test_every_way_of_training_has_a_gradient_of_its_own(pair, tmp_path):
    def first_lines(name, options):
        argv = [*SHORT, *options.split(), "--steps", "2", "--inner-lr", "0.1"]
        train.main([*argv, "--data", str(pair), "--out", str(tmp_path / name)])
        return metrics(tmp_path / name)

    first_step = {name: first_lines(name, options)[0] for name, options in WAYS.items()}
    norm = {name: line["gradient_norm"] for name, line in first_step.items()}
    assert norm["loop"] == pytest.approx(norm["second"], rel=1e-4)
    assert first_step["first"]["loss"] == pytest.approx(first_step["second"]["loss"], rel=1e-5)
    assert len({f"{value:.3g}" for name, value in norm.items() if name != "loop"}) == len(WAYS) - 1
    names = weights(tmp_path / "dp3" / "last.pt")[0]
    assert not any(name.startswith(("u2t", "demo_encoder")) for name in names)

    # The first of the two steps without the inner one
    half = first_lines("half", "--pretrain-fraction 0.5")
    assert half[0] == pytest.approx(first_step["off"] | {"seconds": half[0]["seconds"]})
    never = first_lines("never", "--pretrain-fraction 0.5 --maml off")
    assert half[1]["gradient_norm"] != pytest.approx(never[1]["gradient_norm"], rel=1e-3)


def dropout_settings(options):
    args = train.parse(["--preset", "small", *options.split()])
    config = train.choose_architecture(args, "small")
    settings = common.with_flags(train.default_settings("small", "ml10", config), args)
    return settings.instruction_dropout, settings.task_dropout


def test_a_policy_that_reads_no_demonstration_keeps_its_instruction():
    """Nothing else would tell it the task; but whoever asks for the dropout gets it."""
    assert dropout_settings("") == dropout_settings("--demo-encoder mlp") == (0.2, 0.25)
    assert dropout_settings("--demo-encoder none") == dropout_settings("--policy dp3") == (0, 0)
    assert dropout_settings("--demo-encoder none --instruction-dropout 0.1") == (0.1, 0)


def test_two_processes_under_torchrun_train_as_one_does(pair, tmp_path):
    folder = shutil.copytree(pair, tmp_path / "three")  # tasks: unequal shares
    save_recording(folder, own_recording(180, ends=[90, 180], task="wipe"))
    argv = [*SHORT, "--steps", "3", "--learn-inner-lr", "--data", str(folder)]
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    launcher += ["--nproc-per-node", "2", str(ROOT / "train.py")]
    two = subprocess.run(
        [*launcher, *argv, "--out", str(tmp_path / "two")], capture_output=True, text=True
    )
    assert two.returncode == 0, two.stderr
    assert json.loads((tmp_path / "two/config.json").read_text())["processes of torchrun"] == 2
    train.main([*argv, "--out", str(tmp_path / "one")])
    for one, both in zip(metrics(tmp_path / "one"), metrics(tmp_path / "two"), strict=True):
        assert both["loss"] == pytest.approx(one["loss"], rel=1e-4)
        assert both["gradient_norm"] == pytest.approx(one["gradient_norm"], rel=1e-3)
        assert ("loss_before" in both) == ("loss_before" in one) == (one["step"] == 1)
        if "loss_before" in one:
            assert both["loss_before"] == pytest.approx(one["loss_before"], rel=1e-4)

    def all_weights(policy):
        return torch.cat([policy[n].flatten() for n in one if "normalizer" not in n])

    trainings = [whole_state(tmp_path / name)["training"] for name in ("one", "two")]
    rates, rates_of_two = (torch.stack([*t["log_rates"].values()]) for t in trainings)
    assert (rates - rates_of_two).norm() < 1e-2 * (rates - math.log(1e-3)).norm()
    one, two = (training["policy"] for training in trainings)
    torch.manual_seed(0)
    start = model.build_policy(model.load(tmp_path / "one" / "last.pt")[0].config)
    moved = all_weights(one) - all_weights(start.state_dict())
    assert (all_weights(one) - all_weights(two)).norm() < 1e-3 * moved.norm()
    assert moved.norm() > 0.1


def child_of_rank(launcher, rank):
    """The process of torchrun that has this rank; None before it has started."""
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            parent = int(stat.read_text().rpartition(")")[2].split()[1])
            environment = (stat.parent / "environ").read_bytes().split(b"\0")
            if parent == launcher and f"RANK={rank}".encode() in environment:
                return int(stat.parent.name)
    return None


def test_a_signal_to_one_of_torchruns_processes_stops_and_saves_all(pair, tmp_path):
    argv = [*SHORT, "--steps", "100000", "--data", str(pair), "--out", str(tmp_path / "run")]
    words = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    with subprocess.Popen([*words, str(ROOT / "train.py"), *argv], stderr=subprocess.PIPE) as two:
        log, deadline = tmp_path / "run" / "metrics.jsonl", time.monotonic() + 120
        while not log.exists() or len(metrics(log.parent)) < 3:
            assert two.poll() is None and time.monotonic() < deadline
            time.sleep(0.1)
        os.kill(child_of_rank(two.pid, 1), signal.SIGINT)
        errors = two.stderr.read().decode()
    done = metrics(log.parent)[-1]["step"]
    assert f"interrupted: saved after step {done}, add --resume to go on" in errors
    assert whole_state(log.parent)["step"] == done


# ---- Learned rates of the inner step -------------------------------------------------------------


def stop_after(step, monkeypatch, argv):
    """Trains until Ctrl-C comes after a step."""
    append_json = train.append_json

    def append_and_interrupt(path, **values):
        append_json(path, **values)
        if values["step"] == step:
            signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(train, "append_json", append_and_interrupt)
        train.main(argv)


def test_learned_rates_are_resumed_to_the_same_bits_and_stand_in_every_checkpoint(
    pair, finished, tmp_path, monkeypatch
):
    argv = [*SHORT, "--data", str(pair), "--learn-inner-lr"]
    train.main([*argv, "--out", "whole"])
    stop_after(3, monkeypatch, [*argv, "--out", "resumed"])
    train.main([*argv, "--out", "resumed", "--resume"])
    assert same_bits(whole_state(Path("resumed")), whole_state(Path("whole")))
    state = whole_state(Path("whole"))
    kept = {
        path.name: weights(path)[1]["inner_rates"] for path in sorted(Path("whole").glob("*.pt"))
    }
    names = {name for name, _ in model.load("whole/last.pt")[0].named_parameters()}
    assert all(rates.keys() == names for rates in kept.values())
    assert kept["last.pt"] == kept["ema-00004.pt"] != kept["ema-00002.pt"]
    for name, rate in kept["last.pt"].items():
        assert rate == state["training"]["log_rates"][name].exp().item() != pytest.approx(1e-3)
    assert weights(finished / "ema-00004.pt")[1]["inner_rates"] == {}  # a fixed rate


def test_rates_may_be_learned_after_a_training_that_had_no_inner_step_so_far(
    pair, monkeypatch, capsys
):
    argv = [*SHORT, "--data", str(pair), "--pretrain-fraction", "0.5"]
    learned = ["--learn-inner-lr", "--inner-lr", "0.02", "--rate-lr", "0.3"]
    train.main([*argv, *learned, "--out", "whole"])
    stop_after(2, monkeypatch, [*argv, "--out", "resumed"])
    train.main([*argv, *learned, "--out", "resumed", "--resume"])
    assert same_bits(whole_state(Path("resumed")), whole_state(Path("whole")))
    before, after = (
        weights(f"whole/ema-0000{step}.pt")[1]["inner_rates"].values() for step in (2, 4)
    )
    assert list(before) == pytest.approx([0.02] * len(before))
    assert not any(rate == pytest.approx(0.02) for rate in after)
    message = fails(train, [*argv, "--out", "resumed", "--resume"], capsys)
    assert "inner_lr 0.02 -> 0.001, learn_inner_lr True -> False, rate_lr 0.3 -> 0.01" in message


def test_inner_steps_on_held_out_episodes_are_taken_with_the_learned_rates(pair, monkeypatch):
    take_inner_steps, used, taken = evaluate.take_inner_steps, [], []

    def watched(*arguments, lr, **options):
        used.append(lr)
        for after_step in take_inner_steps(*arguments, lr=lr, **options):
            taken.append(after_step[0])
            yield after_step

    monkeypatch.setattr(evaluate, "take_inner_steps", watched)
    options = "--steps 2 --held-out 1 --learn-inner-lr --rate-lr 1 --out run".split()
    train.main([*SHORT, "--data", str(pair), *options])
    rates = weights("run/ema-00002.pt")[1]["inner_rates"]
    assert len(used) == 2 and taken == 2 * [1, 2, 3, 4, 5]  # of each of two tasks
    table = Path("run/held-out.md").read_text()
    after_one, after_five = (
        next(line for line in table.splitlines() if title in line).split("|")[2:]
        for title in ("after 1 inner step ", "after 5 inner steps ")
    )
    assert after_one != after_five
    for lr in used:
        assert {name: rate.item() for name, rate in lr.items()} == rates


def test_inner_steps_that_go_too_far_do_not_cost_the_training(pair, capsys):
    """Of five steps on held-out episodes, where the training took one."""
    options = "--steps 2 --held-out 1 --inner-lr 1e3 --out run".split()
    train.main([*SHORT, "--data", str(pair), *options])
    assert Path("run/last.pt").exists()
    assert "the loss is not finite after inner step" in capsys.readouterr().out
    table = Path("run/held-out.md").read_text()
    assert "after 5 inner steps" not in table and "the mean action" in table


# ---- Resuming ------------------------------------------------------------------------------------


@pytest.fixture
def resumable(pair, finished, tmp_path):
    """The flags that resume a copy of the finished run."""
    shutil.copytree(finished, tmp_path / "run")
    return [*SHORT, "--data", str(pair), "--out", str(tmp_path / "run"), "--resume"]


def edit_last(folder, **arguments):
    """Changes what last.pt says it was trained with."""
    last = torch.load(folder / "last.pt", weights_only=True)
    last["arguments"].update(arguments)
    torch.save(last, folder / "last.pt")


def test_what_changes_no_number_may_differ_when_a_run_is_resumed(resumable, tmp_path):
    """Out of memory the advice is a smaller --vectorize: resuming must accept it."""
    others = "--vectorize 1 --checkpoint-every 2 --evaluate-every 4 --episodes 0".split()
    train.main([*resumable, *others])
    written = json.loads((tmp_path / "run" / "config.json").read_text())
    assert written["arguments"]["vectorize"] == 1


def test_a_run_that_was_begun_before_a_setting_existed_is_resumed(resumable, tmp_path, capsys):
    last = torch.load(tmp_path / "run" / "last.pt", weights_only=True)
    del last["arguments"]["held_out"]
    torch.save(last, tmp_path / "run" / "last.pt")
    train.main(resumable)
    assert "held_out 0 -> 1" in fails(train, [*resumable, "--held-out", "1"], capsys)


def test_a_run_of_another_version_is_refused_in_one_line(resumable, tmp_path, capsys):
    edit_last(tmp_path / "run", a_setting_that_is_gone=1)
    assert "last.pt is of another version of the code" in fails(train, resumable, capsys)


def test_what_concerns_the_inner_step_may_differ_before_the_first_one(resumable, tmp_path, capsys):
    other = "--inner-lr 0.5 --task-dropout 0.5".split()
    message = fails(train, [*resumable, *other], capsys)
    assert "inner_lr 0.001 -> 0.5, task_dropout 0.0 -> 0.5" in message
    edit_last(tmp_path / "run", pretrain_fraction=1.0)
    config = tmp_path / "run" / "config.json"
    begun = json.loads(config.read_text())
    config.write_text("{")  # edited by hand
    train.main([*resumable, *other, "--pretrain-fraction", "1"])
    written = json.loads(config.read_text())
    assert written["arguments"]["inner_lr"] == 0.5 and written["command"] == begun["command"]


def test_an_existing_run_is_neither_overwritten_nor_resumed_with_other_settings(
    pair, finished, capsys
):
    before = fingerprint(finished)
    argv = [*SHORT, "--data", pair, "--out", finished]
    assert "already holds a run: add --resume" in fails(train, argv, capsys)
    message = fails(train, [*argv, "--resume", "--lr", "0.5"], capsys)
    assert "lr 0.003 -> 0.5" in message and "steps" not in message
    message = fails(train, [*argv, "--resume", "--demo-encoder", "mlp"], capsys)
    assert "demo_encoder vmt -> mlp" in message
    assert fingerprint(finished) == before


def test_a_new_run_overwrites_nothing_that_it_did_not_write(pair, capsys):
    argv = [*SHORT, "--data", str(pair), "--out", "notes"]
    Path("notes").mkdir()
    for name, text in (("config.json", "[1]"), ("metrics.jsonl", "{}\n"), ("success.json", "{}")):
        Path("notes", name).write_text(text)
        assert f"notes already holds {name} of something else" in fails(train, argv, capsys)
        assert Path("notes", name).read_text() == text
        Path("notes", name).unlink()
    train.main([*argv, "--steps", "2"])
    for file in Path("notes").glob("*.pt"):  # as if it had been killed before it saved
        file.unlink()
    train.main([*argv, "--steps", "2"])


def test_what_own_recordings_cannot_be_measured_by_is_refused(pair, capsys):
    for flag in ("--episodes 5", "--evaluate-on novel"):
        message = fails(train, [*SHORT, "--data", str(pair), *flag.split()], capsys)
        assert f"{flag.split()[0]}: own recordings have no simulator" in message


def test_processes_with_different_text_weights_do_not_train_together(monkeypatch):
    def gather(identities, identity):
        identities[:] = [identity, other]

    monkeypatch.setattr(train.dist, "all_gather_object", gather)
    other = "random-seed-0"
    train.check_same_weights("random-seed-0", world=2)
    other = "openai"
    with pytest.raises(train.UserError, match=r"weights \(random-seed-0, openai\)"):
        train.check_same_weights("random-seed-0", world=2)


def test_a_run_is_not_resumed_on_other_recordings(tmp_path, capsys):
    folder = save_pair(tmp_path / "own")
    argv = [*SHORT, "--steps", "2", "--augment", "--data", str(folder), "--out", "run"]
    train.main(argv)
    recording = data.load_demonstrations(folder / "pour.npz")
    elsewhere = {**recording.meta, "workspace": [[0, 0, 0], [1, 1, 1]]}
    for change in ({"action": -recording.action}, {"instruction": "Another."}, {"meta": elsewhere}):
        data.save_demonstrations(folder / "pour.npz", replace(recording, **change))
        message = fails(train, [*argv, "--resume"], capsys)
        assert "was started on other recordings" in message
    longer = own_recording(720, ends=[700, 720], task="pour")  # beyond the learned positions
    save_recording(folder, longer)
    assert "was started on other recordings" in fails(train, [*argv, "--resume"], capsys)


def test_what_cannot_be_resumed_is_said(pair, finished, tmp_path, capsys):
    argv = [*SHORT, "--data", pair]
    message = fails(train, [*argv, "--out", tmp_path / "mistyped", "--resume"], capsys)
    assert "no run to resume" in message
    out = tmp_path / "run"
    out.mkdir()
    shutil.copy(finished / "ema-00002.pt", out / "last.pt")
    message = fails(train, [*argv, "--out", out, "--resume"], capsys)
    assert "last.pt lacks training, recordings" in message
    (out / "last.pt").rename(out / "ema-00002.pt")
    assert "already holds a run" in fails(train, [*argv, "--out", out], capsys)
    with common.locked(tmp_path / "busy"):
        message = fails(train, [*argv, "--out", tmp_path / "busy"], capsys)
    assert "another process runs in" in message


# ---- Own recordings ------------------------------------------------------------------------------


def test_own_recordings_of_any_length_and_dimension_are_trained_on_and_adapted_to(capsys):
    for task, ends in (("stir", [60, 90]), ("pour", [200, 350])):
        recording = own_recording(ends[-1], action_dim=7, ends=ends, state_dim=7, task=task)
        save_recording("own", recording)
    argv = [*SHORT, "--steps", "2", "--data", "own"]
    for name, options in {"maml": [], "off": ["--maml", "off"]}.items():
        train.main([*argv, "--out", f"runs/{name}", *options])
        policy, info = model.load(f"runs/{name}/ema-00002.pt")
        config = policy.config
        assert (config.state_dim, config.action_dim, config.demo_positions) == (7, 7, 25)
        assert info["suite"] == "own" and info["arguments"]["demonstrations"] is None
        assert not Path(f"runs/{name}/success.json").exists()
    checkpoint = ["--checkpoint", "runs/maml/ema-00002.pt"]
    finetune.main(["--data", "own/pour.npz", *checkpoint, "--steps", "2"])
    assert weights("runs/finetune/pour-seed0/adapted.pt")[1]["adapted_to"] == "pour"
    assert "base tasks" not in capsys.readouterr().out


def test_the_loss_of_tasks_whose_demonstrations_differ_in_length_is_the_mean_of_theirs():
    policy = model.build_policy(model.PRESETS["tiny"])
    recording = data.Demonstrations(**own_recording(150, ends=[60, 150]) | {"meta": {}})
    sampler = data.WindowSampler(recording, policy.config)
    text = torch.zeros(512)
    batches = [
        train.task_batch(policy, sampler, text, 4, (0, k), train.Settings()) for k in range(6)
    ]
    assert len({batch["demo_points"].shape for batch in batches}) == 2
    mean = torch.stack([policy.loss(**batch) for batch in batches]).mean()
    torch.testing.assert_close(train.multi_task_loss(policy, batches), mean)


def test_what_looks_wrong_in_recordings_is_said_before_training(capsys, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    recording = own_recording(90)
    recording["state"][50, 3] = 1e6
    save_recording("own", recording)
    monkeypatch.setattr(train, "fit_to_recordings", stop)
    with pytest.raises(KeyboardInterrupt):
        train.main([*SHORT, "--steps", "1", "--data", "own"])
    assert "own/stir.npz: state 3 is 1e+06 in frame 50 (episode 0)" in capsys.readouterr().out


def test_points_with_colours_and_names_of_a_simulators_tasks_are_trained_on():
    """Six columns make a policy of six. What is own is told by the recording, not by its name."""
    save_recording("own", own_recording(90, task="hammer", features=COLORS))
    train.main([*SHORT, "--steps", "1", "--data", "own", "--out", "run"])
    policy, info = model.load("run/ema-00001.pt")
    assert policy.config.point_dim == 6 and info["suite"] == "own"
    finetune.main("--data own/hammer.npz --checkpoint run --steps 1".split())


NO_SIMULATOR = """
import sys
for name in ("metaworld", "mujoco", "gymnasium", "scipy"):
    sys.modules[name] = None  # as where it is not installed: importing it fails
import train, finetune
train.main({train!r})
finetune.main({finetune!r})
"""


def test_own_recordings_need_no_simulator(pair, tmp_path):
    program = NO_SIMULATOR.format(
        train=[*SHORT, "--steps", "1", "--data", str(pair), "--out", str(tmp_path / "run")],
        finetune=["--data", str(pair / "stir.npz"), "--checkpoint", str(tmp_path / "run")]
        + ["--out", str(tmp_path / "adapted"), *"--steps 1 --device cpu".split()],
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "adapted" / "adapted.pt").exists()


def test_held_out_episodes_are_only_for_measuring(pair, capsys, monkeypatch):
    argv = [*SHORT, *"--steps 2 --checkpoint-every 1 --data".split(), str(pair)]
    append_json = train.append_json

    def stopped(path, **values):
        append_json(path, **values)
        if values["step"] == 1 and "loss" in values:
            signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(train, "append_json", stopped)
        train.main([*argv, "--out", "runs/held", "--held-out", "1"])
    train.main([*argv, "--out", "runs/held", "--held-out", "1", "--resume"])
    printed = capsys.readouterr().out
    assert "held-out action error" in printed
    assert len(re.findall(r"\| held_out +\| 1 +\| 0 +\|", printed)) == 1  # not when it goes on
    assert "going on after step 1 of 2" in printed
    assert "next: python finetune.py --data NEW.npz --checkpoint runs/held" in printed
    train.main([*argv, "--out", "runs/first", "--demonstrations", "1"])
    held, first = (whole_state(Path(f"runs/{name}")) for name in ("held", "first"))
    assert same_bits(held, first)

    folder = Path("runs/held")
    lines = [line for line in metrics(folder) if "action_error" in line]
    assert [line["step"] for line in lines] == [1, 2]
    for line in lines:
        assert line["action_errors"].keys() == {"stir", "pour"}
        assert line["action_error"] == pytest.approx(np.mean([*line["action_errors"].values()]))
    table = (folder / "held-out.md").read_text()
    assert re.search(r"\| held-out action error +\| step 1 +\| step 2 +\| the mean action", table)
    for line in lines:
        assert f"{line['action_errors']['stir']:.4f}" in table
    assert re.search(r"\| held-out action error +\| action\[0\] .* \| action\[3\] +\| mean", table)
    rows = re.findall(r"^\| ([a-z][^|]*?) +\|", table.split("action[3]")[1], re.M)
    assert rows == [
        "the mean action",
        "step 2",
        "another task's demonstration",
        "zeros for a demonstration",
        "after 1 inner step",
        "after 5 inner steps",
    ]
    errors = re.findall(r"^\| [a-z][^|]*\|(.*)\|$", table.split("action[3]")[1], re.M)
    assert len(errors) == len(set(errors)) == 6  # each row is of a measurement of its own
    message = fails(train, [*argv, "--out", "runs/none", "--held-out", "2"], capsys)
    assert "2 of 2 episodes cannot be held out" in message


# ---- Bad input -----------------------------------------------------------------------------------

REFUSED = {
    "--suite ml11": "unknown suite 'ml11': did you mean 'ml10'?",
    "--preset tny": "unknown preset 'tny': did you mean 'tiny'?",
    "--steps 0": "--steps is 0: use at least 1",
    "--demonstrations 0": "--demonstrations is 0: use at least 1",
    "--demonstrations 3": "3 demonstrations of pour asked for, there are 2",
    "--threads 0": "--threads is 0: use at least 1",
    "--workers 0": "--workers is 0: use at least 1",
    "--base-tasks 3": "--base-tasks is 3: there are 2, use at most that",
    "--denoiser frequency-transformer": "is the denoiser of freq, not dami",
    "--num-points 0": "num_points is 0: use whole numbers from 1 to",
    "--num-points 65": "pour has 64 points a cloud, the policy 65",
    "--policy flow --tcfm down": "policy flow needs tcfm 'none', not 'down'",
    "--after-success -1": "--after-success is -1: use at least 0",
    "--learn-inner-lr --inner-lr 0": "--inner-lr is 0: --learn-inner-lr starts from a rate above",
    "--seed -1": "--seed is -1: use at least 0",
    f"--seed {2**65}": f"--seed is {2**65}: use at most 4294967295",
    "--lr -1": "--lr is -1.0: use at least 0",
    "--lr nan": "--lr is nan",
    "--lr inf": "--lr is inf",
    "--pretrain-fraction 7": "--pretrain-fraction is 7.0: use at most 1",
    "--warmup -3": "--warmup is -3: use at least 0",
    "--device meta": "--device meta cannot be used here",
    "--data misspelt": "there is no folder misspelt: with --suite ml10, experts fill it",
    "--data empty": "empty holds no recordings (.npz)",
    "--data a-file.npz": "a-file.npz is a file: name its folder",
    "--data simulated": "reach.npz was recorded in a simulator: name its suite, for example",
    "--data mixed": "reach.npz was recorded in a simulator: name its suite, for example",
    "--out a-file.npz/run": "a-file.npz/run cannot be written to",
}


@pytest.mark.parametrize("options", REFUSED)
def test_a_mistake_ends_in_one_line_that_says_what_to_do(options, pair, capsys):
    Path("empty").mkdir()
    Path("a-file.npz").touch()
    shutil.copytree(pair, "mixed")
    for folder in ("simulated", "mixed"):
        save_recording(folder, own_recording(task="reach") | {"meta": '{"simulator": "bowl"}'})
    before = fingerprint(Path())
    argv = [*SHORT, "--data", pair, "--out", "run", *options.split()]
    assert REFUSED[options] in fails(train, argv, capsys)
    assert {path.name for path in Path("run").rglob("*")} <= {".lock"}  # nothing was written
    shutil.rmtree("run", ignore_errors=True)
    assert fingerprint(Path()) == before and not Path("misspelt").exists()


def test_torchruns_variables_alone_end_in_one_line(pair, monkeypatch, capsys):
    argv = [*SHORT, "--data", pair]
    monkeypatch.setenv("WORLD_SIZE", "2")  # as left behind in a shell
    for name in ("RANK", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    assert "RANK is not" in fails(train, argv, capsys)
    monkeypatch.setenv("WORLD_SIZE", "3")
    monkeypatch.setenv("RANK", "0")
    assert "3 processes for 2 tasks a step: use at most one process a task" in fails(
        train, argv, capsys
    )


def test_a_loss_that_is_not_finite_stops_training_and_keeps_the_last_good_state(
    pair, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(train.Saver, "is_due", lambda saver: True)
    argv = [*SHORT, "--data", pair, "--out", tmp_path / "run", "--lr", "1e30", "--warmup", "1"]
    message = fails(train, argv, capsys)
    assert "smaller --lr" in message
    step = int(re.search(r"not finite at step (\d+)", message)[1])
    state, info = weights(tmp_path / "run" / "last.pt")
    assert info["step"] == step - 1 >= 1 and all(torch.isfinite(x).all() for x in state.values())


def test_a_mistake_in_the_code_keeps_its_traceback(pair, monkeypatch):
    """Only a user's mistakes end in one line; a student's broken loss shows where it broke."""

    def broken(*_, **__):
        [_] = 1, 2

    monkeypatch.setattr(model.DAMIPolicy, "encode_demo", broken)
    with pytest.raises(ValueError, match="too many values to unpack"):
        common.command_line(lambda: train.main([*SHORT, "--data", str(pair), "--out", "run"]))
