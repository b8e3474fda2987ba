"""Tests of train.py: Algorithm 1's batches and steps, whole runs at preset `tiny`, bad input."""

import contextlib
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
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from conftest import (
    BASE,
    FEW,
    SMALL_ML10,
    fails,
    fingerprint,
    metrics,
    same_bits,
    weights,
    whole_state,
)
from test_finetune import own_recording
from torch.func import functional_call

import data
import evaluate
import finetune
import model
import report
import scripts
import train
from tests import oracle

ROOT = Path(train.__file__).resolve().parent
pytestmark = pytest.mark.usefixtures("small_suite", "own_folder")


# ---- Settings, learning rate, batches ------------------------------------------------------------


def test_every_setting_is_a_flag_and_is_kept(run):
    args = train.parse([])
    assert all(hasattr(args, name) for name in asdict(train.Settings()))
    assert weights(run / "ema-00006.pt")[1]["arguments"].keys() == asdict(train.Settings()).keys()


def test_help_says_each_presets_value(capsys):
    with pytest.raises(SystemExit):
        train.parse(["--help"])
    printed = " ".join(capsys.readouterr().out.split())
    assert "outer steps (paper 54000, small 10000, tiny 30)" in printed
    assert "of weights, batches and noise (0)" in printed
    assert "points of a cloud (paper 512, small 128, tiny 64)" in printed


def test_the_learning_rate_warms_up_and_falls_to_zero_along_a_cosine():
    settings = train.Settings(steps=1500, lr=1e-3, warmup=500)
    rate = functools.partial(train.learning_rate, settings=settings)
    assert rate(0) == pytest.approx(1e-3 / 500)
    assert rate(499) == rate(500) == pytest.approx(1e-3)
    assert rate(1000) == pytest.approx(5e-4)
    assert 0 < rate(1499) < 1e-8 and rate(1500) == pytest.approx(0, abs=1e-12)
    assert train.learning_rate(0, replace(settings, warmup=0)) == 1e-3
    assert np.all(np.diff([rate(step) for step in range(500, 1500)]) < 0)


def test_training_begins_with_the_papers_adamw_over_every_parameter():
    config, recording = model.PRESETS["tiny"], own_recording() | {"meta": {}}
    samplers = {"stir": data.WindowSampler(data.Demonstrations(**recording), config)}
    settings = train.Settings(lr=0.25)
    policy, _, optimizer = train.initialize(config, settings, samplers, torch.device("cpu"))
    (group,) = optimizer.param_groups
    assert isinstance(optimizer, torch.optim.AdamW) and group["lr"] == 0.25
    assert group["betas"] == (0.95, 0.999) and group["weight_decay"] == 1e-6
    assert set(map(id, group["params"])) == set(map(id, policy.parameters()))


def test_the_oracle_keeps_the_last_weights_and_moves_scenes_twice_as_much(monkeypatch):
    middle, drawn, kept = torch.zeros(1, 3), [], []
    policy = torch.nn.Linear(1, 1)
    for attribute, module in {"TURN": data, "STRETCH": data, "ema_model": train}.items():
        monkeypatch.setattr(module, attribute, getattr(module, attribute))  # undone at the end
    for _ in range(2):
        a, _ = data.draw_affine_maps(1000, middle, torch.Generator().manual_seed(0))
        drawn.append((a - torch.eye(3)).flatten(1).norm(dim=1).mean())
        average = train.ema_model(policy)
        for weight in (1.0, 2.0, 3.0):
            torch.nn.init.constant_(policy.weight, weight)
            average.update_parameters(policy)
        kept.append(average.module.weight.item())
        oracle.augmented_twice()
        oracle.not_averaged()
    assert drawn[1] / drawn[0] == pytest.approx(2, abs=0.1)
    assert 1 < kept[0] < 3 and kept[1] == 3


def test_support_and_query_are_disjoint_and_share_the_demonstration(recorded):
    policy = model.DAMIPolicy(model.PRESETS["tiny"])
    demonstrations = data.load_demonstrations(recorded / "reach.npz")
    sampler = data.WindowSampler(demonstrations, policy.config)
    batch = train.task_batch(policy, sampler, torch.zeros(512), 12, (0, 1, 2), train.Settings())
    support, query = train.split(batch, 4)
    for name in batch:
        if name in train.PER_WINDOW:
            assert torch.equal(torch.cat([support[name], query[name]]), batch[name])
            assert len(support[name]) == 4
        else:
            assert support[name] is query[name] and len(batch[name]) == 1
    again = train.task_batch(policy, sampler, torch.zeros(512), 12, (0, 1, 2), train.Settings())
    other = train.task_batch(policy, sampler, torch.zeros(512), 12, (0, 2, 2), train.Settings())
    assert same_bits(batch, again) and not torch.equal(batch["noise"], other["noise"])
    assert not torch.equal(batch["action"], other["action"])


def test_a_share_of_the_batches_sees_no_instruction_and_of_inner_steps_nothing(recorded):
    policy = model.DAMIPolicy(model.PRESETS["tiny"])
    demonstrations = data.load_demonstrations(recorded / "reach.npz")
    sampler = data.WindowSampler(demonstrations, policy.config)

    def batches(inner=False, **shares):
        how, settings = (torch.ones(512), 4), train.Settings(**shares)
        return [train.task_batch(policy, sampler, *how, (0, k), settings, inner) for k in range(40)]

    plain, dropped = batches(), batches(instruction_dropout=0.5)
    silent = [bool((batch["text"] == 0).all()) for batch in dropped]
    assert 10 <= sum(silent) <= 30
    for one, other in zip(plain, dropped):
        assert same_bits(one | {"text": 0}, other | {"text": 0})

    assert all(map(same_bits, plain, batches(support_only=0.5)))  # but for inner steps
    inner = batches(inner=True, support_only=0.5)
    hidden = [bool((batch["demo_points"] == 0).all()) for batch in inner]
    assert 10 <= sum(hidden) <= 30 and not any((b["demo_points"] == 0).all() for b in plain)
    for one, other, hides in zip(plain, inner, hidden):
        for name in one:
            zero = hides and name not in train.PER_WINDOW
            assert torch.equal(other[name], torch.zeros_like(one[name]) if zero else one[name])


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


def plain_meta_training(policy, samplers, text, settings):
    """Algorithm 1 with SGD's inner step, AdamW and the moving average written out.

    Yields after each outer step (weights, averaged weights, query loss, query loss before the inner
    step, gradient norm). Draws are as train.py says: they follow from (seed, step, task) alone.
    """
    theta = {name: p.detach().clone() for name, p in policy.named_parameters()}
    m, v, average = ({name: torch.zeros_like(p) for name, p in theta.items()} for _ in range(3))
    n = settings.support + settings.query
    for step in range(settings.steps):
        theta = {name: p.requires_grad_() for name, p in theta.items()}
        after, before = [], []
        for i, (task, sampler) in enumerate(samplers.items()):
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
                name: p - settings.inner_lr * g for (name, p), g in zip(theta.items(), gradient)
            }
            after.append(functional_call(policy, adapted, (), query))
            before.append(functional_call(policy, theta, (), query))
        loss = torch.stack(after).mean()
        gradients = dict(zip(theta, torch.autograd.grad(loss, list(theta.values()))))

        warm = (step + 1) / settings.warmup
        done = (step - settings.warmup) / (settings.steps - settings.warmup)
        rate = settings.lr * (warm if warm <= 1 else (1 + math.cos(math.pi * done)) / 2)
        decay = 0 if step == 0 else 1 - (1 + step) ** -0.75
        theta = {name: p.detach() for name, p in theta.items()}
        for name, g in gradients.items():  # AdamW, betas 0.95 and 0.999, weight decay 1e-6
            m[name] = 0.95 * m[name] + 0.05 * g
            v[name] = 0.999 * v[name] + 0.001 * g**2
            unbiased_m = m[name] / (1 - 0.95 ** (step + 1))
            unbiased_v = v[name] / (1 - 0.999 ** (step + 1))
            shrunk = theta[name] * (1 - rate * 1e-6)
            theta[name] = shrunk - rate * unbiased_m / (unbiased_v.sqrt() + 1e-8)
            average[name] = decay * average[name] + (1 - decay) * theta[name]
        norm = torch.cat([g.flatten() for g in gradients.values()]).norm()
        yield theta, average, loss.item(), torch.stack(before).mean().item(), norm.item()


def test_training_is_a_plain_loop_with_the_inner_step_adamw_and_the_average_written_out():
    samplers, text = two_tasks()
    settings = train.Settings(
        seed=3, steps=4, support=2, query=3, inner_lr=0.05, lr=1e-2, warmup=2, vectorize=2
    )
    device = torch.device("cpu")
    policy, average, optimizer = train.initialize(model.PRESETS["tiny"], settings, samplers, device)
    policy.double(), average.module.double()  # in place: the optimizer's parameters, too
    for part in ("points", "state", "action"):  # scaled to both tasks
        whole = torch.cat([getattr(sampler, part).flatten(0, -2) for sampler in samplers.values()])
        scaled = policy.normalizer.normalize(part, whole)
        for end in (scaled.amin(0), scaled.amax(0).neg()):
            assert torch.allclose(end, torch.full_like(end, -1))
    plain = plain_meta_training(copy.deepcopy(policy), samplers, text, settings)
    training = train.meta_train(policy, average, optimizer, samplers, text, settings)
    for k, (theta, averaged, loss, before, norm), (step, figures) in zip(range(4), plain, training):
        assert step == k + 1 and figures["loss"] == pytest.approx(loss, rel=1e-9)
        assert figures["loss_before"] == pytest.approx(before, rel=1e-9)
        assert figures["gradient_norm"] == pytest.approx(norm, rel=1e-9)
        for name, parameter in policy.named_parameters():
            assert torch.allclose(parameter, theta[name], atol=1e-9), (step, name)
        for name, parameter in average.module.named_parameters():
            assert torch.allclose(parameter, averaged[name], atol=1e-9), (step, name)
    assert k == 3 and list(training) == []


@pytest.fixture
def own_pair(monkeypatch):
    """A folder with two tasks' recordings of random numbers, whose positions are known."""
    monkeypatch.setattr(report, "draw_curves", lambda folder: None)  # a second each
    Path("own").mkdir()
    for task, reach in (("stir", 2.0), ("pour", 1.0)):
        recording = own_recording(180, ends=[90, 180], task=task)
        recording["state"] *= reach
        recording["meta"] = json.dumps({"positions_in_state": 3, "success_frames": [40, 40]})
        np.savez(f"own/{task}.npz", **recording)
    return Path("own")


def first_step(folder, options=""):
    """Trains one step on own recordings; the line of metrics.jsonl and the EMA checkpoint."""
    argv = "--preset tiny --steps 1 --clip-weights random --device cpu --data".split()
    out = Path("runs") / (options or "plain")
    train.main([*argv, str(folder), "--out", str(out), *options.split()])
    return metrics(out)[0], weights(out / "ema-00001.pt")[0]


FLAGS = "--augment|--after-success 3|--seed 1|--inner-lr 0.5|--lr 1|--support 5|--query 9"
FLAGS += "|--instruction-dropout 1|--support-only 1|--maml off|--maml off --bfloat16"


def test_every_flag_changes_the_training(own_pair):
    """The first step's numbers are others with it; twice without it, they are the same."""
    runs = {
        options: first_step(own_pair, options) for options in ["", "--seed 0", *FLAGS.split("|")]
    }
    figures = {
        name: (line["loss"], line["gradient_norm"], line["lr"]) for name, (line, _) in runs.items()
    }
    assert figures[""] == figures["--seed 0"]
    assert len(set(figures.values())) == len(runs) - 1
    exact, rounded = (figures[name][0] for name in ("--maml off", "--maml off --bfloat16"))
    assert rounded == pytest.approx(exact, rel=0.05)


def test_the_seed_draws_the_weights_and_all_tasks_scale_the_normalizer(own_pair):
    _, initial = first_step(own_pair, "--lr 0")
    _, again = first_step(own_pair, "--lr 0 --seed 0 --support 5")
    _, others = first_step(own_pair, "--lr 0 --seed 1")
    assert same_bits(dict(initial), dict(again))
    drawn = [name for name in initial if "normalizer" not in name and initial[name].std() > 0]
    assert len(drawn) > 20 and not any(torch.equal(initial[n], others[n]) for n in drawn)
    pair = [data.load_demonstrations(file) for file in own_pair.glob("*.npz")]
    for part in ("points", "state", "action"):
        whole = np.concatenate(
            [getattr(d, part).reshape(-1, getattr(d, part).shape[-1]) for d in pair]
        )
        half = (whole.max(0) - whole.min(0)) / 2
        assert np.allclose(initial[f"normalizer.{part}_scale"], half, rtol=1e-3)


# ---- Whole runs ----------------------------------------------------------------------------------


def test_products_in_bfloat16_leave_nearly_the_same_gradient(recorded):
    torch.manual_seed(0)
    policy = model.DAMIPolicy(model.PRESETS["tiny"])
    demonstrations = data.load_demonstrations(recorded / "reach.npz")
    sampler, text = data.WindowSampler(demonstrations, policy.config), torch.randn(512)
    policy.normalizer.fit(sampler.points, sampler.state, sampler.action)
    batches = [
        train.task_batch(policy, sampler, text, 12, (0, 0, k), train.Settings()) for k in range(4)
    ]
    whole, half = (
        torch.cat([g.flatten() for g in train.multi_task_gradient(policy, batches, b)[0].values()])
        for b in (False, True)
    )
    assert half.dtype == torch.float32 and not torch.equal(whole, half)
    assert torch.cosine_similarity(whole, half, dim=0) > 0.99


class Replayed:
    """What stands in for a CUDA graph where there is no GPU: it runs the function again."""

    captured: scripts.Captured

    def replay(self):
        again = self.captured.function(*self.captured.inputs)
        torch._foreach_copy_(list(self.captured.outputs), list(again))


def test_a_captured_function_is_the_function_until_the_next_call(monkeypatch):
    device = "cuda" if torch.cuda.is_available() else "cpu"
    weight, calls = torch.full((3,), 2.0, device=device, requires_grad=True), []

    def function(batch, more):
        calls.append(batch)
        loss = ((weight * batch["x"]) ** 2).sum() + more[0].sum()
        return loss.detach(), torch.autograd.grad(loss, weight)[0]

    captured = scripts.Captured(function)
    if device == "cpu":
        graph, nothing = Replayed(), lambda *_: contextlib.nullcontext()
        graph.captured = captured
        streams = SimpleNamespace(wait_stream=lambda stream: None)
        monkeypatch.setattr(torch.cuda, "CUDAGraph", lambda: graph)
        for name in ("Stream", "current_stream"):
            monkeypatch.setattr(torch.cuda, name, lambda: streams)
        for name in ("stream", "graph"):
            monkeypatch.setattr(torch.cuda, name, nothing)

    generator = torch.Generator().manual_seed(0)
    for _ in range(3):
        x, y = torch.randn(2, 3, generator=generator).to(device)
        given, found = ({"x": x.clone()}, [y.clone()]), captured({"x": x}, [y])
        assert all(batch["x"] is not x for batch in calls)  # it works on copies
        assert all(torch.allclose(a, b) for a, b in zip(found, function(*given)))
        with torch.no_grad():
            weight += 1  # in place, as an optimizer does
        assert torch.equal(x, given[0]["x"])  # the caller's own stays as it was


def test_training_leaves_everything_that_it_promises(run):
    names = "config.json curves.png ema-00003.pt ema-00006.pt last.pt metrics.jsonl"
    names += " success.json success.md success.png"
    assert sorted(path.name for path in run.iterdir()) == names.split()
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
    assert written["facts"]["seed"] == evaluate.EVALUATION_SEED == 0
    table = (run / "success.md").read_text()
    assert all(f"| {task} " in table for task in BASE)
    assert "paper" in table and "random-seed-0" in table
    for name in ("curves.png", "success.png"):
        assert (run / name).read_bytes().startswith(b"\x89PNG")

    policy, ema = whole_state(run)["training"]["policy"], weights(run / "ema-00006.pt")[0]
    assert all(torch.equal(ema[name], policy[name]) for name in ema if "normalizer" in name)
    assert ema["normalizer.action_scale"].ne(1).any()  # fitted
    assert not torch.equal(ema["unet.head.1.weight"], policy["unet.head.1.weight"])


def killed_run(recorded, out, step):
    """Trains in a process killed (SIGKILL) just after logging `step`, between two savings."""
    program = f"""
import os, signal
import scripts, simulator, train
simulator.SUITES["ml10"] = {SMALL_ML10!r}
log = scripts.log
def log_and_die(folder, **values):
    log(folder, **values)
    if values["step"] == {step}:
        os.kill(os.getpid(), signal.SIGKILL)
scripts.log = log_and_die
train.main({["--data", str(recorded), "--out", str(out), *FEW]!r})
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True)
    assert done.returncode == -signal.SIGKILL, done.stderr.decode()


def test_a_run_killed_between_savings_resumes_to_the_same_bits(run, recorded, tmp_path):
    out = tmp_path / "killed"
    killed_run(recorded, out, step=5)
    assert len(metrics(out)) == 5 and weights(out / "last.pt")[1]["step"] == 3
    with (out / "metrics.jsonl").open("a") as file:
        file.write('{"step": 6, "lo')  # as if killed while writing
    train.main(["--data", str(recorded), "--out", str(out), "--resume", *FEW])
    assert [line["step"] for line in metrics(out)] == [1, 2, 3, 4, 5, 6]
    assert same_bits(whole_state(out), whole_state(run))
    for whole, resumed in zip([line for line in metrics(run) if "loss" in line], metrics(out)):
        assert {**whole, "seconds": 0} == {**resumed, "seconds": 0}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_ctrl_c_saves_says_how_to_resume_and_ends_with_130(
    run, recorded, tmp_path, monkeypatch, capsys, number
):
    log, out = scripts.log, tmp_path / "interrupted"

    def log_and_interrupt(folder, **values):
        log(folder, **values)
        if values["step"] == 2:
            signal.raise_signal(number)

    monkeypatch.setattr(scripts, "log", log_and_interrupt)
    argv = ["--data", str(recorded), "--out", str(out), *FEW]
    with pytest.raises(SystemExit) as end:
        scripts.command_line(lambda: train.main(argv))
    error = capsys.readouterr().err
    assert end.value.code == 130 and "saved after step 2" in error and "--resume" in error
    assert weights(out / "last.pt")[1]["step"] == 2
    monkeypatch.setattr(scripts, "log", log)
    train.main([*argv, "--resume"])
    assert same_bits(whole_state(out), whole_state(run))


def test_a_run_stopped_while_it_is_measured_is_measured_when_resumed(
    run, recorded, tmp_path, monkeypatch, capsys
):
    def stopped(*_):
        signal.raise_signal(signal.SIGINT)

    argv = [*FEW, *"--episodes 2 --evaluate-every 6".split(), "--data", str(recorded)]
    argv += ["--out", str(tmp_path / "run")]
    with monkeypatch.context() as patch:
        patch.setattr(evaluate, "evaluate", stopped)
        with pytest.raises(SystemExit) as end:
            scripts.command_line(lambda: train.main(argv))
    assert end.value.code == 130 and weights(tmp_path / "run" / "last.pt")[1]["step"] == 6
    assert not (tmp_path / "run" / "success.json").exists()
    dead = subprocess.Popen(["true"])
    dead.wait()
    (tmp_path / "run" / f".{dead.pid}.last.pt").write_text("left by a killed process")

    measured = {task: [True, False] for task in BASE}
    monkeypatch.setattr(evaluate, "evaluate", lambda *_: measured)
    train.main([*argv, "--resume"])
    written = json.loads((tmp_path / "run" / "success.json").read_text())
    assert written["successes"]["last checkpoint"] == measured
    assert (tmp_path / "run" / "curves.png").exists()
    assert not list((tmp_path / "run").glob(".*"))
    assert same_bits(whole_state(tmp_path / "run"), whole_state(run) | {"step": 6})


def test_a_run_is_measured_and_resumed_where_it_was_asked_for(recorded, monkeypatch, capsys):
    measured = []

    def evaluated(checkpoint, *_):
        measured.append(checkpoint.stem)
        if measured == ["ema-00002"]:
            signal.raise_signal(signal.SIGINT)
        return {task: [True] for task in BASE}

    monkeypatch.setattr(evaluate, "evaluate", evaluated)
    argv = [*FEW, *"--episodes 1 --evaluate-every 2 --checkpoint-every 3 --out run".split()]
    argv += ["--data", str(recorded)]
    with pytest.raises(SystemExit) as end:
        scripts.command_line(lambda: train.main(argv))
    assert end.value.code == 130 and "add --resume to go on" in capsys.readouterr().err
    train.main([*argv, "--resume"])
    assert measured == [f"ema-{step:05d}" for step in (2, 2, 4, 6)]


def test_what_another_user_is_writing_is_left_alone(tmp_path, monkeypatch):
    def refused(*_):
        raise PermissionError

    (tmp_path / ".1.last.pt").touch()
    monkeypatch.setattr(os, "kill", refused)
    with scripts.locked(tmp_path):
        assert (tmp_path / ".1.last.pt").exists()


def test_a_broken_pipe_does_not_end_the_work(monkeypatch):
    class Broken:
        def write(self, *text):
            raise BrokenPipeError

        flush = write

    monkeypatch.setattr(sys, "stderr", Broken())
    with scripts.progress_bar(total=2) as progress:
        progress.update()
        progress.set_postfix(loss="0")
    with pytest.raises(SystemExit) as end:
        scripts.command_line(lambda: (_ for _ in ()).throw(ValueError("x")))
    assert end.value.code == 2


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


def test_every_way_of_training_learns_something_of_its_own(recorded, tmp_path):
    def first_lines(name, options):
        argv = [*FEW, *options.split(), "--steps", "2", "--inner-lr", "0.1"]
        train.main(["--data", str(recorded), "--out", str(tmp_path / name), *argv])
        return metrics(tmp_path / name)

    first_step = {name: first_lines(name, options)[0] for name, options in WAYS.items()}
    norm = {name: line["gradient_norm"] for name, line in first_step.items()}
    assert norm["loop"] == pytest.approx(norm["second"], rel=1e-4)
    assert first_step["first"]["loss"] == pytest.approx(first_step["second"]["loss"], rel=1e-5)
    assert len({f"{value:.3g}" for name, value in norm.items() if name != "loop"}) == len(WAYS) - 1
    names = weights(tmp_path / "dp3" / "last.pt")[0]
    assert not any(name.startswith(("u2t", "demo_encoder")) for name in names)

    # The first of the two steps without the inner one
    half = first_lines("half", "--multi-task-share 0.5")
    assert half[0] == pytest.approx(first_step["off"] | {"seconds": half[0]["seconds"]})
    never = first_lines("never", "--multi-task-share 0.5 --maml off")
    assert half[1]["gradient_norm"] != pytest.approx(never[1]["gradient_norm"], rel=1e-3)


def test_two_processes_under_torchrun_train_as_one_does(recorded, tmp_path):
    script = tmp_path / "small_train.py"
    script.write_text(
        "import sys\nimport scripts, simulator, train\n"
        f'simulator.SUITES["ml10"] = {SMALL_ML10!r}\n'  # three tasks: unequal shares
        "scripts.command_line(lambda: train.main(sys.argv[1:]))\n"
    )

    def torchrun(processes, argv):
        launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
        launcher += ["--nproc-per-node", str(processes), str(script)]
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        return subprocess.run([*launcher, *argv], env=environment, capture_output=True, text=True)

    argv = ["--data", str(recorded), *FEW, "--steps", "3", "--checkpoint-every", "3"]
    two = torchrun(2, ["--out", str(tmp_path / "two"), *argv])
    assert two.returncode == 0, two.stderr
    train.main(["--out", str(tmp_path / "one"), *argv])
    for one, both in zip(metrics(tmp_path / "one"), metrics(tmp_path / "two")):
        assert both["loss"] == pytest.approx(one["loss"], rel=1e-4)
        assert both["gradient_norm"] == pytest.approx(one["gradient_norm"], rel=1e-3)
        assert both["loss_before"] == pytest.approx(one["loss_before"], rel=1e-4)

    def all_weights(policy):
        return torch.cat([policy[n].flatten() for n in one if "normalizer" not in n])

    one, two = (whole_state(tmp_path / name)["training"]["policy"] for name in ("one", "two"))
    torch.manual_seed(0)
    start = model.DAMIPolicy(model.PRESETS["tiny"]).state_dict()
    moved = all_weights(one) - all_weights(start)
    assert (all_weights(one) - all_weights(two)).norm() < 1e-3 * moved.norm()
    assert moved.norm() > 0.1


def test_torchruns_variables_alone_end_in_one_line(monkeypatch, capsys, recorded):
    monkeypatch.setenv("WORLD_SIZE", "2")  # as left behind in a shell
    for name in ("RANK", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    assert "RANK" in fails(train, [*FEW, "--data", recorded], capsys)


def test_numbers_go_to_tensorboard_where_it_is_installed(tmp_path, monkeypatch):
    written = []

    class Writer:
        def __init__(self, folder, **_):
            self.folder = folder

        def add_scalar(self, *values):
            written.append((self.folder, *values))

        def close(self):
            pass

    package = SimpleNamespace(SummaryWriter=Writer)
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", package)
    scripts.log(tmp_path, step=3, loss=0.5, lr=1, successes={"reach": [True]})
    assert written == [(tmp_path, "loss", 0.5, 3), (tmp_path, "lr", 1, 3)]
    assert metrics(tmp_path)[0]["successes"] == {"reach": [True]}
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    scripts.log(tmp_path / "..", step=4, loss=0.5)
    assert len(written) == 2


def test_windows_is_told_in_one_line_what_to_use():
    program = "import sys; sys.modules.update(fcntl=None, termios=None, tty=None); import robot"
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert "needs Linux or macOS; on Windows, run it under WSL" in done.stderr


def test_lines_of_metrics_that_were_cut_are_dropped(tmp_path):
    for step in (1, 2, 3):
        scripts.log(tmp_path, step=step, loss=0.5)
    path = tmp_path / "metrics.jsonl"
    path.write_text(path.read_text().replace('{"step": 2, "loss": 0.5}', '{"step": 2, "lo'))
    scripts.rewind_metrics(tmp_path, 3)
    assert [line["step"] for line in metrics(tmp_path)] == [1, 3]


def test_more_processes_than_tasks_are_refused_before_anything_waits(monkeypatch, capsys):
    monkeypatch.setenv("WORLD_SIZE", "4")
    monkeypatch.setenv("RANK", "0")
    assert "4 processes for 3 tasks: use at most one a task" in fails(train, FEW, capsys)


# ---- Own recordings ------------------------------------------------------------------------------


def test_own_recordings_of_any_length_and_dimension_are_trained_on_and_adapted_to(capsys):
    Path("own").mkdir()
    for task, ends in (("stir", [60, 90]), ("pour", [200, 350])):
        recorded = own_recording(ends[-1], action_dim=7, ends=ends, state_dim=7, task=task)
        np.savez(f"own/{task}.npz", **recorded)
    argv = "--preset tiny --steps 2 --checkpoint-every 2 --data own --clip-weights random".split()
    for name, options in {"maml": [], "off": ["--maml", "off"]}.items():
        train.main([*argv, "--out", f"runs/{name}", *options])
        policy, info = scripts.load_checkpoint(f"runs/{name}/ema-00002.pt")
        config = policy.config
        assert (config.state_dim, config.action_dim, config.demo_positions) == (7, 7, 25)
        assert info["suite"] == "own" and info["arguments"]["demonstrations"] is None
        assert not Path(f"runs/{name}/success.json").exists()
    checkpoint = ["--checkpoint", "runs/maml/ema-00002.pt"]
    finetune.main(["--data", "own/pour.npz", *checkpoint, "--steps", "2"])
    assert weights("runs/finetune/pour-seed0/adapted.pt")[1]["adapted_to"] == "pour"
    assert "base tasks" not in capsys.readouterr().out


def test_held_out_episodes_only_judge(capsys, monkeypatch):
    Path("own").mkdir()
    for task in ("stir", "pour"):
        np.savez(f"own/{task}.npz", **own_recording(90, ends=[60, 90], task=task))
    argv = "--preset tiny --steps 2 --checkpoint-every 1 --data own --clip-weights random".split()
    argv += ["--device", "cpu"]  # two runs on CUDA differ in their last bits
    log = scripts.log

    def stopped(folder, **values):
        log(folder, **values)
        if values["step"] == 1 and "loss" in values:
            signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(scripts, "log", stopped)
        train.main([*argv, "--out", "runs/judged", "--held-out", "1"])
    train.main([*argv, "--out", "runs/judged", "--held-out", "1", "--resume"])
    printed = capsys.readouterr().out
    assert "held-out action error" in printed and re.search(r"\| held_out +\| 1 +\| 0 +\|", printed)
    assert "next: python finetune.py --data NEW.npz --checkpoint runs/judged" in printed
    train.main([*argv, "--out", "runs/first", "--demonstrations", "1"])
    judged, first = (whole_state(Path(f"runs/{name}")) for name in ("judged", "first"))
    assert same_bits(judged, first)

    folder = Path("runs/judged")
    lines = [line for line in metrics(folder) if "action_error" in line]
    assert [line["step"] for line in lines] == [1, 2]
    for line in lines:
        assert line["action_errors"].keys() == {"stir", "pour"}
        assert line["action_error"] == pytest.approx(np.mean([*line["action_errors"].values()]))
    table = (folder / "held-out.md").read_text()
    assert re.search(r"\| held-out action error +\| step 1 +\| step 2 +\| the mean action", table)
    assert f"{lines[1]['action_errors']['stir']:.4f}" in table
    message = fails(train, [*argv, "--out", "runs/none", "--held-out", "2"], capsys)
    assert "has 2 episodes: use a --held-out below that" in message

    options = "--checkpoint runs/judged --held-out 1 --steps 2".split()
    finetune.main(["--data", "own/stir.npz", *options])
    lines = metrics(Path("runs/finetune/stir-seed0"))
    assert [line["step"] for line in lines if "action_error" in line] == [0, 2]
    assert "| step 0" in capsys.readouterr().out


def test_a_run_of_an_older_version_which_lacks_a_setting_is_resumed(run, recorded, tmp_path):
    shutil.copytree(run, tmp_path / "run")
    last = torch.load(run / "last.pt", weights_only=True)
    del last["arguments"]["held_out"]
    torch.save(last, tmp_path / "run" / "last.pt")
    options = "--episodes 2 --evaluate-every 6".split()
    argv = [*FEW, *options, "--data", str(recorded), "--out", str(tmp_path / "run")]
    train.main([*argv, "--resume"])
    with pytest.raises(ValueError, match="held_out 0 -> 1"):
        train.main([*argv, "--resume", "--held-out", "1"])


def test_threads_are_as_many_as_were_asked_for(own_folder):
    asked = torch.get_num_threads() + 1
    scripts.pick_device("cpu", asked)
    assert torch.get_num_threads() == asked
    scripts.pick_device("cpu")
    assert torch.get_num_threads() == asked  # left as they are


def test_what_concerns_the_inner_step_may_differ_before_the_first_one(run, recorded, tmp_path):
    shutil.copytree(run, tmp_path / "run")
    argv = [*FEW, "--data", str(recorded), "--out", str(tmp_path / "run"), "--resume"]
    argv += "--episodes 2 --evaluate-every 6".split()
    other = "--inner-lr 0.5 --support-only 0.5".split()
    with pytest.raises(ValueError, match=r"inner_lr .* -> 0.5, support_only 0.0 -> 0.5"):
        train.main([*argv, *other])
    last = torch.load(run / "last.pt", weights_only=True)
    last["arguments"]["multi_task_share"] = 1.0
    torch.save(last, tmp_path / "run" / "last.pt")
    train.main([*argv, *other, "--multi-task-share", "1"])
    config, begun = tmp_path / "run" / "config.json", json.loads((run / "config.json").read_text())
    said = json.loads(config.read_text())
    assert said["arguments"]["inner_lr"] == 0.5 and said["command"] == begun["command"]
    config.write_text("{")  # edited by hand
    train.main([*argv, *other, "--multi-task-share", "1"])
    assert json.loads(config.read_text()).keys() == begun.keys()


# ---- Bad input -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options, message",
    [
        ("--suite ml11", "unknown suite 'ml11': did you mean 'ml10'?"),
        ("--preset tny", "unknown preset 'tny': did you mean 'tiny'?"),
        ("--steps 0", "--steps is 0: use at least 1"),
        ("--demonstrations 0", "--demonstrations is 0: use at least 1"),
        ("--threads 0", "--threads is 0: use at least 1"),
        ("--num-points 0", "num_points is 0: use at least 1"),
        ("--after-success -1", "--after-success is -1: use at least 0"),
        ("--seed -1", "--seed is -1: use at least 0"),
        ("--lr -1", "--lr is -1.0: use at least 0"),
        ("--lr nan", "--lr is nan"),
        ("--multi-task-share 7", "--multi-task-share is 7.0: use at most 1"),
        ("--warmup -3", "--warmup is -3: use at least 0"),
        ("--lr inf", "--lr is inf: use at most 1.79"),
        (f"--seed {2**65}", f"--seed is {2**65}: use at most 4294967295"),
        ("--device meta", "--device meta cannot be used here"),
    ],
)
def test_a_wrong_argument_ends_in_one_line_that_says_what_to_do(options, message, recorded, capsys):
    assert message in fails(train, [*FEW, "--data", recorded, *options.split()], capsys)
    assert not list(Path().rglob("last.pt"))


def test_an_existing_run_is_neither_overwritten_nor_resumed_with_other_settings(
    run, recorded, capsys
):
    before = fingerprint(run)
    argv = ["--data", recorded, "--out", run, *FEW, "--episodes", "2", "--evaluate-every", "6"]
    assert "already holds a run: add --resume" in fails(train, argv, capsys)
    message = fails(train, [*argv, "--resume", "--lr", "0.5"], capsys)
    assert "lr 0.003 -> 0.5" in message and "steps" not in message
    message = fails(train, [*argv, "--resume", "--demo-encoder", "mlp"], capsys)
    assert "demo_encoder vmt -> mlp" in message
    assert fingerprint(run) == before


def test_a_folder_without_recordings_is_not_filled_with_others(tmp_path, capsys):
    folder, file = tmp_path / "mine", tmp_path / "stir.npz"
    folder.mkdir()
    file.touch()
    tiny = ["--preset", "tiny", "--data"]
    assert "mine holds no recordings (.npz)" in fails(train, [*tiny, folder], capsys)
    assert "stir.npz is a file: name its folder" in fails(train, [*tiny, file], capsys)
    message = fails(train, ["--suite", "ml10", "--out", file / "run"], capsys)
    assert "stir.npz/run: not a directory, name another file or folder" in message
    assert not list(folder.iterdir())


def test_what_cannot_be_resumed_is_said(run, recorded, tmp_path, capsys):
    argv = ["--data", recorded, *FEW]
    message = fails(train, [*argv, "--out", tmp_path / "mistyped", "--resume"], capsys)
    assert "no run to resume" in message
    out = tmp_path / "run"
    out.mkdir()
    (out / "ema-00003.pt").write_bytes(b"all that is left")
    assert "already holds a run" in fails(train, [*argv, "--out", out], capsys)
    with scripts.locked(tmp_path / "busy"):
        message = fails(train, [*argv, "--out", tmp_path / "busy"], capsys)
    assert "another process runs in" in message
    assert "no folder" in fails(train, ["--preset", "tiny", "--data", "misspelt"], capsys)
    assert not Path("misspelt").exists()
    Path("mixed").mkdir()
    for name in ("reach", "stir"):
        shutil.copy(recorded / "reach.npz", f"mixed/{name}.npz")
    message = fails(train, ["--preset", "tiny", "--data", "mixed"], capsys)
    assert "mixes your recordings with reach" in message
    Path("alone").mkdir()
    np.savez("alone/hammer.npz", **own_recording(task="hammer", state_dim=7))
    for script, data_ in ((train, "alone"), (finetune, "alone/hammer.npz")):
        message = fails(script, ["--data", data_], capsys)
        assert (
            "alone/hammer.npz is not Meta-World's hammer as recorded here (another camera"
            in message
        )
    assert [path.name for path in Path("alone").iterdir()] == ["hammer.npz"]


def test_a_run_is_not_resumed_on_other_recordings(recorded, tmp_path, capsys):
    Path("own").mkdir()
    for task in BASE:
        demonstrations = data.load_demonstrations(recorded / f"{task}.npz")
        data.save_demonstrations(f"own/{task}-mine.npz", demonstrations)
    argv = ["--data", "own", *[word for word in FEW if word not in ("--suite", "ml10")]]
    argv += ["--augment"]
    train.main([*argv, "--steps", "2", "--out", "run"])
    elsewhere = demonstrations.meta | {"workspace": [[0, 0, 0], [1, 1, 1]]}
    wrong = {"action": -demonstrations.action}, {"instruction": "Another."}, {"meta": elsewhere}
    for change in wrong:
        data.save_demonstrations(f"own/{task}-mine.npz", replace(demonstrations, **change))
        message = fails(train, [*argv, "--steps", "2", "--out", "run", "--resume"], capsys)
        assert "was started on other recordings" in message


def test_a_loss_that_is_not_finite_stops_training_and_keeps_the_last_good_state(
    recorded, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(train, "SAVE_SECONDS", -1)  # saves after every step
    argv = ["--data", recorded, "--out", tmp_path / "run", *FEW, "--lr", "1e30", "--warmup", "1"]
    message = fails(train, argv, capsys)
    assert "smaller --lr" in message
    step = int(re.search(r"not finite at step (\d+)", message)[1])
    state, info = weights(tmp_path / "run" / "last.pt")
    assert info["step"] == step - 1 >= 1 and all(torch.isfinite(x).all() for x in state.values())
    assert [path.name for path in (tmp_path / "run").iterdir() if path.name.startswith(".")] == []
