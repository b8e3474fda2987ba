"""Tests of finetune.py: one task, all novel tasks, own recordings, bad input."""

import copy
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import fails, fingerprint, metrics, same_bits, weights

import data
import evaluate
import finetune
import model
import scripts

pytestmark = pytest.mark.usefixtures("small_suite", "own_folder")


def adapting(run, recorded, options="", task="door-close"):
    """The command line that adapts the short run's policy."""
    common = f"--task {task} --demonstrations 2 --steps 2 --episodes 0 --device cpu {options}"
    return [*common.split(), "--data", str(recorded), "--checkpoint", str(run / "ema-00006.pt")]


def own_recording(frames=200, action_dim=4, ends=None, state_dim=9, task="stir"):
    """A user's recording of random numbers, not checked."""
    rng = np.random.default_rng(0)
    return {
        "task": task,
        "instruction": "Stir the soup.",
        "points": rng.normal(size=(frames, 64, 3)).astype(np.float16),
        "state": rng.normal(size=(frames, state_dim)).astype(np.float32),
        "action": rng.uniform(-1, 1, size=(frames, action_dim)).astype(np.float32),
        "episode_ends": np.array([frames] if ends is None else ends, dtype=np.int64),
        "meta": "{}",
    }


# ---- Adaptation ----------------------------------------------------------------------------------


def test_finetuning_needs_only_a_task_and_reports_before_and_after(
    recorded, monkeypatch, tmp_path, capsys
):
    argv = "--task door-close --demonstrations 2 --steps 4 --batch 4 --episodes 1 --device cpu"
    finetune.main([*argv.split(), "--data", str(recorded)])
    folder = Path("runs/finetune/door-close-seed0")
    names = "adapted.pt config.json metrics.jsonl success.json success.md success.png"
    assert sorted(path.name for path in folder.iterdir()) == names.split()
    columns = json.loads((folder / "success.json").read_text())["successes"]
    assert list(columns) == ["before", "after"]
    assert all(len(column["door-close"]) == 1 for column in columns.values())
    printed = capsys.readouterr().out
    assert "using the policy that comes with the code" in printed and "adapted to" in printed
    assert re.search(r"\| before +\| after +\| paper +\|", printed)
    assert re.search(r"\| steps +\| 4 +\| 200 +\|", printed)  # the settings
    assert [line["step"] for line in metrics(folder)] == [1, 2, 3, 4]

    policy, info = weights(folder / "adapted.pt")
    assert info["adapted_to"] == "door-close" and info["preset"] == "small"
    old = weights(evaluate.SHIPPED_CHECKPOINT)[0]
    assert any(not torch.equal(policy[name], old[name]) for name in old)
    assert not torch.equal(policy["normalizer.state_scale"], old["normalizer.state_scale"])
    assert evaluate.SHIPPED_CHECKPOINT.stat().st_size < 16 * 2**20

    before, argv = fingerprint(folder), [*argv.split(), "--data", str(recorded)]
    message = fails(finetune, argv, capsys)
    assert "already holds adapted.pt: add --overwrite" in message
    assert fingerprint(folder) == before
    for wrong in (["--held-out", "2"], ["--checkpoint", str(folder / "adapted.pt")]):
        fails(finetune, [*argv, "--overwrite", *wrong], capsys)
        assert fingerprint(folder) == before
    finetune.main([*argv, "--overwrite", "--episodes", "0", "--steps", "1"])
    assert not list(folder.glob("success.*"))  # they were of the old policy


def test_adaptation_is_repeatable_and_moves_only_what_has_a_learning_rate(run, recorded):
    frozen = "--lr-vision 0 --lr-other 0 --normalizer keep"
    for name, options in {"a": "", "b": "", "frozen": frozen}.items():
        finetune.main([*adapting(run, recorded, options), "--out", name])
    a, b, frozen = (weights(f"{name}/adapted.pt")[0] for name in ("a", "b", "frozen"))
    old = weights(run / "ema-00006.pt")[0]
    assert same_bits(dict(a), dict(b))

    def moved(new):
        return {name.split(".")[0] for name in old if not torch.equal(old[name], new[name])}

    assert moved(a) == {"observation_encoder", "demo_encoder", "u2t", "unet", "normalizer"}
    assert moved(frozen) == {"unet"}


def test_two_steps_of_adaptation_are_two_of_plain_adamw_on_gradients_clipped_to_norm_one():
    torch.manual_seed(0)
    policy = model.DAMIPolicy(model.PRESETS["tiny"]).double()  # weight decay is small
    recording = own_recording(400, ends=[200, 400]) | {"meta": {}}
    recording["action"] *= np.linspace(1, 20, 400)[:, None]  # not normalized: large gradients
    sampler = data.WindowSampler(data.Demonstrations(**recording), policy.config)
    text, rates = torch.randn(512).double(), {"vision": 1e-3, "diffusion": 3e-3, "other": 1e-2}
    adapting = finetune.adapt_policy(policy, sampler, text, 2, 4, rates, seed=7)

    plain, generator = copy.deepcopy(policy), torch.Generator().manual_seed(7)
    parts = plain.parameter_groups()
    groups = [{"params": parts[name], "lr": rate} for name, rate in rates.items()]
    optimizer = torch.optim.AdamW(groups, betas=(0.95, 0.999), weight_decay=1e-6)
    average, norms = model.ema_model(plain), []
    for _, found, adapted in adapting:
        batch = sampler.batch(4, generator) | plain.draw_noise_and_timesteps(4, generator)
        optimizer.zero_grad()
        loss = plain.loss(text=text[None], **batch)
        loss.backward()
        norms.append(torch.nn.utils.clip_grad_norm_(plain.parameters(), 1.0).item())
        optimizer.step()
        average.update_parameters(plain)
        assert found == pytest.approx(loss.item())
        moved = zip(adapted.parameters(), average.module.parameters())
        assert all(torch.allclose(*pair, atol=1e-10, rtol=0) for pair in moved)
    assert min(norms) > 1 and max(norms) > 1.05 * min(norms)  # AdamW does not feel a common factor


def test_the_papers_learning_rates_belong_to_its_meta_training_and_are_scaled_to_this_one(
    run, recorded
):
    finetune.main([*adapting(run, recorded, "--lr-other 0.25"), "--out", "adapted"])
    info = weights("adapted/adapted.pt")[1]
    assert info["arguments"]["lr"] == 3e-3  # the paper's is 1e-4
    rates = json.loads(Path("adapted/config.json").read_text())["learning_rates"]
    assert rates == pytest.approx({"vision": 3e-4, "diffusion": 9e-4, "other": 0.25})
    assert info["adaptation"]["learning_rates"] == rates


def test_without_its_instruction_a_task_is_adapted_to_and_rolled_out_on_zeros(
    run, recorded, monkeypatch
):
    adapt_policy, read = finetune.adapt_policy, []

    def watched(policy, sampler, text, *others):
        read.append(text)
        return adapt_policy(policy, sampler, text, *others)

    def measured(checkpoint, paths, text, *_, **__):
        read.append(text["door-close"])
        return {"door-close": [True]}

    monkeypatch.setattr(finetune, "adapt_policy", watched)
    monkeypatch.setattr(evaluate, "evaluate", measured)
    finetune.main([*adapting(run, recorded), "--out", "told"])
    finetune.main([*adapting(run, recorded, "--no-instruction --episodes 1"), "--out", "untold"])
    options = "--demonstrations 2 --episodes 1 --checkpoint untold --out measured".split()
    evaluate.main(["--data", str(recorded), *options])
    told, *untold = read  # the others: adapted with, before, after, and by evaluate.py
    assert told.any() and len(untold) == 4 and not any(text.any() for text in untold)


def test_all_novel_tasks_are_adapted_to_as_each_alone(run, recorded, monkeypatch):
    def measured(policy, paths, *_):
        return {task: [True, policy.stem != "ema-00006"] for task in paths}

    monkeypatch.setattr(evaluate, "evaluate", measured)
    options = "--episodes 2 --curve 1"
    finetune.main([*adapting(run, recorded, options, task="novel"), "--out", "all"])
    finetune.main([*adapting(run, recorded), "--out", "alone"])
    adapted, info = weights("all/door-close/adapted.pt")
    assert same_bits(dict(adapted), dict(weights("alone/adapted.pt")[0]))
    assert info["adapted_to"] == "door-close"
    between = weights("all/door-close/adapted-00001.pt")[0]  # 9 is more than there are
    assert any(not torch.equal(between[name], adapted[name]) for name in adapted)
    columns = json.loads(Path("all/success.json").read_text())["successes"]
    expected = {"before": [True, False], "1 steps": [True, True], "after": [True, True]}
    assert columns == {name: {"door-close": episodes} for name, episodes in expected.items()}


def test_rollouts_read_the_demonstrations_that_were_adapted_to(run, recorded, monkeypatch):
    seen = []

    def evaluate_nothing(*args):
        seen.append(args[-1])
        return {"reach": [True]}

    monkeypatch.setattr(evaluate, "evaluate", evaluate_nothing)
    file = recorded / "reach.npz"
    argv = [*adapting(run, file, "--episodes 1", task="reach"), "--demonstrations"]
    finetune.main([*argv, "1"])
    assert seen == [1, 1]  # before and after
    finetune.main([*argv, "2", "--held-out", "1", "--overwrite"])
    assert seen[2:] == [1, 1]


def test_own_recordings_are_adapted_to_without_a_simulator(run, capsys):
    np.savez("own.npz", **own_recording(frames=150))
    checkpoint = ["--checkpoint", str(run / "ema-00006.pt")]
    finetune.main(["--data", "own.npz", *checkpoint, "--demonstrations", "1", "--steps", "2"])
    folder = Path("runs/finetune/stir-seed0")
    names = ["adapted.pt", "config.json", "metrics.jsonl"]
    assert sorted(path.name for path in folder.iterdir()) == names
    assert "adapted to stir" in capsys.readouterr().out


# ---- Bad input -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options, message",
    [
        ("", "name a task of Meta-World with --task"),
        ("--task shelf-plce", "unknown task 'shelf-plce': did you mean 'shelf-place'?"),
        ("--task shelf-place --steps 0", "--steps is 0: use at least 1"),
        ("--task shelf-place --lr-other -1", "--lr-other is -1.0: use at least 0"),
        ("--task shelf-place --checkpoint none.pt", "none.pt"),
        ("--task novel --suite ml1", "unknown suite 'ml1'"),
        ("--task shelf-place --curve 5 500", "--curve: use steps from 1 to 199"),
    ],
)
def test_a_wrong_argument_ends_in_one_line_that_says_what_to_do(options, message, capsys):
    assert message in fails(finetune, options.split(), capsys)


@pytest.mark.parametrize(
    "changes, options, message",
    [
        ({"frames": 220}, "", "has 11 frames (every 20th), the policy 10 positions"),
        ({"action_dim": 7}, "", "has 7 numbers an action, the policy 4: use"),
        ({"frames": 0, "ends": []}, "", "holds no episodes"),
        ({}, "--demonstrations 3", "3 demonstrations of stir asked for, there are 1"),
    ],
)
def test_demonstrations_that_do_not_fit_are_refused(run, capsys, changes, options, message):
    np.savez("own.npz", **own_recording(**changes))
    argv = ["--data", "own.npz", "--checkpoint", run / "ema-00006.pt", "--steps", "1"]
    assert message in fails(finetune, [*argv, *options.split()], capsys)
    assert not list(Path().rglob("adapted.pt"))


def test_a_recording_of_another_task_is_refused(run, recorded, capsys):
    argv = adapting(run, recorded / "reach.npz", task="drawer-close")
    message = fails(finetune, argv, capsys)
    assert "is a recording of reach, not of drawer-close" in message


@pytest.mark.parametrize("task", ["../../evil", "a/b", "", "x" * 10_000])
def test_a_name_that_is_no_name_writes_nowhere(run, task, capsys):
    np.savez("own.npz", **own_recording(task=task))
    assert "is no name" in fails(finetune, ["--data", "own.npz"], capsys)
    assert not Path("runs").exists()


def test_an_adaptation_that_diverges_stops_and_writes_nothing(run, recorded, capsys):
    argv = adapting(run, recorded, "--lr-diffusion 1e30")
    message = fails(finetune, [*argv, "--steps", "20"], capsys)
    assert "loss not finite at step" in message and "door-close" in message
    assert not list(Path().rglob("adapted.pt"))


def test_neither_a_training_run_nor_a_folder_in_use_is_written_into(run, recorded, capsys):
    before = fingerprint(run)
    message = fails(finetune, [*adapting(run, recorded, "--overwrite"), "--out", run], capsys)
    assert "holds a training run" in message and fingerprint(run) == before
    with scripts.locked(Path("busy")):
        message = fails(finetune, [*adapting(run, recorded), "--out", "busy"], capsys)
    assert "another process runs in busy" in message
    Path("busy/.999999999.adapted.pt").write_text("left by a killed process")
    finetune.main([*adapting(run, recorded), "--out", "busy"])
    assert not list(Path("busy").glob(".*"))


def test_novel_tasks_are_those_of_the_suite_of_the_run(run, recorded, monkeypatch, capsys):
    info = torch.load(run / "ema-00006.pt", weights_only=True)
    torch.save(info | {"suite": "ml45"}, "ml45.pt")

    def named(tasks, *_, **__):
        raise ValueError(f"asked for {' '.join(tasks)}")

    monkeypatch.setattr(finetune, "collect", named)
    argv = ["--task", "novel", "--checkpoint", "ml45.pt"]
    assert "box-close hand-insert" in fails(finetune, argv, capsys)
    assert "asked for door-close" in fails(finetune, [*argv, "--suite", "ml10"], capsys)


def test_a_folder_that_cannot_be_made_ends_in_one_line(run, recorded, capsys):
    Path("taken").write_text("a file")
    assert "taken" in fails(finetune, [*adapting(run, recorded), "--out", "taken"], capsys)
    assert Path("taken").read_text() == "a file"


def test_a_checkpoint_that_does_not_fit_is_refused(run, recorded, capsys):
    info = torch.load(run / "ema-00006.pt", weights_only=True)
    torch.save(info | {"config": info["config"] | {"unet_widths": [32, 64]}}, "shape.pt")
    Path("cut.pt").write_bytes((run / "ema-00006.pt").read_bytes()[:1000])
    torch.save(info | {"text_weights": "openai-ViT-B-32-40d36571"}, "clip.pt")
    policy = model.DAMIPolicy(model.PRESETS["tiny"])
    scripts.save_checkpoint("bare.pt", policy)
    messages = {
        "shape.pt": "weights and configuration do not fit",
        "cut.pt": "damaged",
        "clip.pt": "'openai-ViT-B-32-40d36571'",
        "bare.pt": "suite",
    }
    for name, message in messages.items():
        argv = [*adapting(run, recorded, "--clip-weights random"), "--checkpoint", name]
        assert message in fails(finetune, argv, capsys)
