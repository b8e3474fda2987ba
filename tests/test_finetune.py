"""Tests of finetune.py: one task, all novel tasks, own recordings, bad input."""

import copy
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import fails, fingerprint, metrics, same_bits, weights

import common
import data
import evaluate
import finetune
import model
import report

pytestmark = pytest.mark.usefixtures("small_suite", "own_folder", "no_pictures")


def adapting(run, recorded, options="", task="door-close"):
    """The command line that adapts the short run's policy."""
    flags = f"--task {task} --demonstrations 2 --steps 2 --episodes 0 --device cpu {options}"
    return [*flags.split(), "--data", str(recorded), "--checkpoint", str(run / "ema-00006.pt")]


COLORS = 3  # numbers of a point beside its position


def own_recording(frames=200, action_dim=4, ends=None, state_dim=9, task="stir", features=0):
    """The fields of a user's recording of random numbers, not checked."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(frames, 64, 3))
    return {
        "task": task,
        "instruction": "Stir the soup.",
        "points": np.pad(points, ((0, 0), (0, 0), (0, features))).astype(np.float16),
        "state": rng.normal(size=(frames, state_dim)).astype(np.float32),
        "action": rng.uniform(-1, 1, size=(frames, action_dim)).astype(np.float32),
        "episode_ends": np.array([frames] if ends is None else ends, dtype=np.int64),
        "meta": "{}",
    }


def save_recording(folder, recording):
    """Writes the fields of `own_recording`, as somebody else's recorder would."""
    Path(folder).mkdir(exist_ok=True)
    np.savez(Path(folder) / f"{recording['task']}.npz", **recording)


def evaluated(monkeypatch, successes):
    """Puts `successes(checkpoint)` in the place of rollouts; returns the list of calls to come."""
    calls = []

    def evaluate_checkpoint(*, checkpoint, recordings, **options):
        calls.append(options)
        of_tasks = {task: successes(checkpoint) for task in recordings}
        return report.Outcomes(any_step=of_tasks, at_end=of_tasks)

    monkeypatch.setattr(evaluate, "evaluate_checkpoint", evaluate_checkpoint)
    return calls


# ---- Adaptation ----------------------------------------------------------------------------------


def test_finetuning_needs_only_a_task_and_reports_before_and_after(recorded, capsys):
    argv = "--task door-close --demonstrations 2 --steps 4 --batch 4 --episodes 1 --device cpu"
    argv = [*argv.split(), "--data", str(recorded)]
    finetune.main(argv)
    folder = Path("runs/finetune/door-close-seed0")
    names = "adapted.pt config.json metrics.jsonl success.json success.md success.png"
    assert sorted(p.name for p in folder.iterdir() if p.name != ".lock") == names.split()
    columns = json.loads((folder / "success.json").read_text())["successes"]
    assert list(columns) == ["before", "after"]
    assert all(len(column["door-close"]) == 1 for column in columns.values())
    printed = capsys.readouterr().out
    assert "using the policy that comes with the code" in printed and "adapted to" in printed
    columns = ("before", "after", "before, at the end", "after, at the end", "paper, DAMI")
    assert re.search(r" +\| ".join(columns), printed)
    assert re.search(r"\| steps +\| 4 +\| 200 +\|", printed)  # the settings
    assert [line["step"] for line in metrics(folder)] == [1, 2, 3, 4]

    policy, info = weights(folder / "adapted.pt")
    assert info["adapted_to"] == "door-close" and info["preset"] == "small"
    old = weights(evaluate.SHIPPED_CHECKPOINT)[0]
    assert any(not torch.equal(policy[name], old[name]) for name in old)
    assert not torch.equal(policy["normalizer.state_scale"], old["normalizer.state_scale"])
    assert evaluate.SHIPPED_CHECKPOINT.stat().st_size < 16 * 2**20

    before = fingerprint(folder)
    message = fails(finetune, argv, capsys)
    assert "already holds success.json: add --overwrite" in message
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

    diffusion = {"condition_encoder", "denoiser"}
    assert moved(a) == {"observation_encoder", "demo_encoder", "u2t", "normalizer", *diffusion}
    assert moved(frozen) == diffusion


def test_two_steps_of_adaptation_are_two_of_plain_adamw_on_gradients_clipped_to_norm_one():
    torch.manual_seed(0)
    policy = model.DAMIPolicy(model.PRESETS["tiny"]).double()  # weight decay is small
    recording = own_recording(400, ends=[200, 400]) | {"meta": {}}
    recording["action"] *= np.linspace(1, 20, 400)[:, None]  # not normalized: large gradients
    sampler = data.WindowSampler(data.Demonstrations(**recording), policy.config)
    text, rates = torch.randn(512).double(), {"vision": 1e-3, "diffusion": 3e-3, "other": 1e-2}
    adapting = finetune.adapt_policy(
        policy, sampler, text, steps=2, batch=4, learning_rates=rates, seed=7
    )

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


@pytest.mark.parametrize("learned, control", [(False, None), (True, None), (False, "zeros")])
def test_inner_steps_are_steps_of_plain_gradient_descent_on_one_batch(learned, control):
    torch.manual_seed(0)
    policy = model.DAMIPolicy(model.PRESETS["tiny"]).double()
    recording = own_recording(400, ends=[200, 400]) | {"meta": {}}
    sampler = data.WindowSampler(data.Demonstrations(**recording), policy.config)
    policy.normalizer.fit([sampler])
    text, start = torch.randn(512).double(), copy.deepcopy(policy.state_dict())
    names = [name for name, _ in policy.named_parameters()]
    rates = torch.linspace(0.01, 0.05, len(names)).double() if learned else [0.02] * len(names)
    adapting = evaluate.take_inner_steps(
        policy,
        sampler,
        text,
        steps=3,
        batch=4,
        lr=dict(zip(names, rates)) if learned else 0.02,
        seed=7,
        demonstration_control=control,
    )

    plain, generator = copy.deepcopy(policy), torch.Generator().manual_seed(7)
    batch = sampler.batch(4, generator) | plain.draw_noise_and_timesteps(4, generator)
    if control == "zeros":
        for name in ("demo_points", "demo_state", "demo_action"):
            batch[name] = torch.zeros_like(batch[name])
    for k, (step, loss, adapted) in enumerate(adapting):
        gradients = torch.autograd.grad(
            plain.loss(text=text[None], **batch), list(plain.parameters())
        )
        with torch.no_grad():
            for parameter, gradient, rate in zip(plain.parameters(), gradients, rates):
                parameter -= rate * gradient
            assert loss == pytest.approx(plain.loss(text=text[None], **batch).item())
        assert step == k + 1
        for name, x in adapted.state_dict().items():  # the normalizer's numbers, too
            assert torch.allclose(x, plain.state_dict()[name], atol=1e-10, rtol=0), name
    assert step == 3 and same_bits(dict(policy.state_dict()), dict(start))


def adapting_by_inner_steps(run, recorded, options="", task="door-close"):
    """`adapting` with two inner steps in place of two of AdamW."""
    argv = adapting(run, recorded, f"--inner-steps 2 {options}", task)
    position = argv.index("--steps")
    return argv[:position] + argv[position + 2 :]


def test_inner_steps_are_as_those_of_the_training_and_keep_its_normalizer(run, recorded):
    argv = adapting_by_inner_steps(run, recorded)
    finetune.main([*argv, "--out", "inner"])
    written = json.loads(Path("inner/config.json").read_text())
    expected = {"steps": 2, "batch": 4, "inner_lr": 1e-3, "normalizer": "keep", "lr_other": None}
    assert {name: written[name] for name in expected} == expected  # the preset tiny's
    assert [line["step"] for line in metrics(Path("inner"))] == [1, 2]
    finetune.main([*argv, "--inner-lr", "1e-3", "--batch", "4", "--out", "same"])
    finetune.main([*argv, "--inner-lr", "0", "--out", "unmoved"])
    finetune.main([*argv, "--inner-lr", "1", "--out", "far"])  # no step is lost in rounding
    old, new, same, unmoved, far = (
        dict(weights(path)[0])
        for path in (
            run / "ema-00006.pt",
            *(f"{n}/adapted.pt" for n in ("inner", "same", "unmoved", "far")),
        )
    )
    assert same_bits(new, same) and same_bits(old, unmoved) and not same_bits(old, new)
    unchanged = {name for name in old if torch.equal(old[name], far[name])}
    assert unchanged == {name for name in old if name.startswith("normalizer")}


def test_inner_steps_are_taken_with_the_rates_that_were_learned(run, recorded):
    info = torch.load(run / "ema-00006.pt", weights_only=True)
    policy, _ = model.load(run / "ema-00006.pt")
    rates = {name: 0.0 for name, _ in policy.named_parameters()} | {"denoiser.head.1.bias": 0.25}
    torch.save(info | {"inner_rates": rates}, "learned.pt")
    argv = [*adapting_by_inner_steps(run, recorded), "--checkpoint", "learned.pt"]
    finetune.main([*argv, "--out", "learned"])
    finetune.main([*argv, "--inner-lr", "0.25", "--out", "one-rate"])
    old = weights("learned.pt")[0]

    def moved(new):
        return {name for name in old if not torch.equal(old[name], new[name])}

    adapted, kept = weights("learned/adapted.pt")
    assert moved(adapted) == {"denoiser.head.1.bias"} and kept["inner_rates"] == rates
    assert moved(weights("one-rate/adapted.pt")[0]) == rates.keys()


def test_inner_steps_on_several_tasks_are_rolled_out_and_resumed(
    run, recorded, monkeypatch, capsys
):
    calls = evaluated(monkeypatch, lambda checkpoint: [checkpoint.stem == "adapted"])
    argv = adapting_by_inner_steps(run, recorded, "--episodes 1 --out both", "door-close reach")
    finetune.main(argv)
    successes = json.loads(Path("both/success.json").read_text())["successes"]
    assert successes["after"] == {"door-close": [True], "reach": [True]}
    assert successes["before"] == {"door-close": [False], "reach": [False]}
    assert len(calls) == 4
    message = fails(finetune, [*argv, "--resume", "--inner-lr", "0.5"], capsys)
    assert "was made with another inner_lr" in message
    finetune.main([*argv, "--resume"])
    assert len(calls) == 4


def test_inner_steps_that_diverge_stop_and_write_no_policy(run, recorded, capsys):
    argv = adapting_by_inner_steps(run, recorded, "--inner-lr 1e30")
    message = fails(finetune, argv, capsys)
    assert "door-close: the loss is not finite after inner step 1" in message
    assert not list(Path().rglob("adapted.pt"))


def test_the_papers_learning_rates_belong_to_its_meta_training_and_are_scaled_to_this_one(
    run, recorded
):
    finetune.main([*adapting(run, recorded, "--lr-other 0.25"), "--out", "adapted"])
    info = weights("adapted/adapted.pt")[1]
    assert info["arguments"]["lr"] == 3e-3  # the paper's is 1e-4
    written = json.loads(Path("adapted/config.json").read_text())
    for used in (written, info["adaptation"]):
        rates = [used[f"lr_{part}"] for part in ("vision", "diffusion", "other")]
        assert rates == pytest.approx([3e-4, 9e-4, 0.25])
        assert used["batch"] == 16 and used["demonstrations"] == 2


def test_without_its_instruction_a_task_is_adapted_to_and_rolled_out_on_zeros(
    run, recorded, monkeypatch
):
    adapt_policy, read = finetune.adapt_policy, []

    def watched(policy, sampler, text, **options):
        read.append(text)
        return adapt_policy(policy, sampler, text, **options)

    monkeypatch.setattr(finetune, "adapt_policy", watched)
    calls = evaluated(monkeypatch, lambda checkpoint: [True])
    finetune.main([*adapting(run, recorded), "--out", "told"])
    finetune.main([*adapting(run, recorded, "--no-instruction --episodes 1"), "--out", "untold"])
    options = "--demonstrations 2 --episodes 1 --checkpoint untold --out measured".split()
    evaluate.main(["--data", str(recorded), *options])
    with_instruction, without = read
    assert with_instruction.any() and not without.any()
    assert len(calls) == 3  # before, after, and by evaluate.py
    assert not any(call["text"]["door-close"].any() for call in calls)


def test_all_novel_tasks_are_adapted_to_as_each_alone(run, recorded, monkeypatch):
    evaluated(monkeypatch, lambda checkpoint: [True, checkpoint.stem != "ema-00006"])
    options = "--episodes 2 --curve 1"
    finetune.main([*adapting(run, recorded, options, task="novel"), "--out", "all"])
    finetune.main([*adapting(run, recorded), "--out", "alone"])
    adapted, info = weights("all/door-close/adapted.pt")
    assert same_bits(dict(adapted), dict(weights("alone/adapted.pt")[0]))
    assert info["adapted_to"] == "door-close"
    between = weights("all/door-close/adapted-00001.pt")[0]
    assert any(not torch.equal(between[name], adapted[name]) for name in adapted)
    columns = json.loads(Path("all/success.json").read_text())["successes"]
    expected = {"before": [True, False], "1 steps": [True, True], "after": [True, True]}
    assert columns == {name: {"door-close": episodes} for name, episodes in expected.items()}


def test_several_tasks_stand_side_by_side_in_one_report(run, recorded, monkeypatch):
    evaluated(monkeypatch, lambda checkpoint: [checkpoint.stem == "adapted"])
    argv = adapting(run, recorded, "--episodes 1", task="door-close reach")
    finetune.main([*argv, "--out", "both"])
    assert {path.parent.name for path in Path("both").rglob("adapted.pt")} == {
        "door-close",
        "reach",
    }
    report = json.loads(Path("both/success.json").read_text())
    assert report["successes"]["before"] == {"door-close": [False], "reach": [False]}
    assert report["successes"]["after"] == {"door-close": [True], "reach": [True]}
    assert report["provenance"]["title"] == "door-close-reach: before and after 2 steps"


def test_an_interrupted_run_of_several_tasks_goes_on_with_those_that_are_left(
    run, recorded, monkeypatch, capsys
):
    evaluated(monkeypatch, lambda checkpoint: [checkpoint.stem == "adapted"])
    argv = [*adapting(run, recorded, "--episodes 1", task="door-close reach"), "--out", "both"]
    adapt_to_task = finetune.Adaptation.run

    def interrupted(adaptation, text):
        if adaptation.recording.stem == "reach":
            raise KeyboardInterrupt
        return adapt_to_task(adaptation, text)

    with monkeypatch.context() as patch:
        patch.setattr(finetune.Adaptation, "run", interrupted)
        with pytest.raises(KeyboardInterrupt, match="add --resume to go on"):
            finetune.main(argv)
    finished = fingerprint(Path("both/door-close"))
    assert "add --overwrite" in fails(finetune, argv, capsys)
    message = fails(finetune, [*argv, "--resume", "--batch", "3"], capsys)
    assert "both/door-close was made with another batch: give the same" in message
    for flags, name in (("--curve 1", "curve"), ("--n-action-steps 4", "config_overrides")):
        message = fails(finetune, [*argv, "--resume", *flags.split()], capsys)
        assert f"was made with another {name}" in message
    alone = [*adapting(run, recorded), "--out", "both/door-close", "--resume"]
    assert "--resume goes on with several tasks" in fails(finetune, alone, capsys)
    assert fingerprint(Path("both/door-close")) == finished
    finetune.main([*argv, "--resume"])
    assert fingerprint(Path("both/door-close")) == finished
    successes = json.loads(Path("both/success.json").read_text())["successes"]
    assert successes["after"] == {"door-close": [True], "reach": [True]}


def test_rollouts_read_the_demonstrations_that_were_adapted_to(run, recorded, monkeypatch):
    calls = evaluated(monkeypatch, lambda checkpoint: [True])
    argv = adapting(run, recorded / "reach.npz", "--episodes 1", task="reach")
    finetune.main([*argv, "--demonstrations", "1"])
    finetune.main([*argv, "--demonstrations", "2", "--held-out", "1", "--overwrite"])
    assert [call["n_demonstrations"] for call in calls] == [1, 1, 1, 1]  # before, after; twice


def test_own_recordings_are_adapted_to_without_a_simulator(run, capsys):
    recording = own_recording(frames=150)
    recording["state"][5, 0] = 1e6
    save_recording(".", recording)
    checkpoint = ["--checkpoint", str(run / "ema-00006.pt")]
    finetune.main(["--data", "stir.npz", *checkpoint, "--demonstrations", "1", "--steps", "2"])
    folder = Path("runs/finetune/stir-seed0")
    names = ["adapted.pt", "config.json", "metrics.jsonl"]
    assert sorted(path.name for path in folder.iterdir() if path.name != ".lock") == names
    printed = capsys.readouterr().out
    assert "adapted to stir" in printed and "stir.npz: state 0 is 1e+06 in frame 5" in printed


def test_held_out_episodes_tell_what_adaptation_bought(run, capsys):
    save_recording(".", own_recording(180, ends=[90, 180]))
    options = ["--checkpoint", str(run), *"--held-out 1 --steps 2 --out adapted".split()]
    finetune.main(["--data", "stir.npz", *options])
    before, after = (line for line in metrics(Path("adapted")) if "action_error" in line)
    assert (before["step"], after["step"]) == (0, 2)
    assert before["action_errors"] == {"stir": before["action_error"]}
    printed, table = capsys.readouterr().out, Path("adapted/held-out.md").read_text()
    head = r"\| held-out action error +\| action\[0\] .* \| action\[3\] +\| mean"
    assert re.search(head, printed) and re.search(head, table)
    for title, line in (("step 0", before), ("step 2", after)):
        assert re.search(rf"\| {title} .*\| {line['action_error']:.4f} +\|", table)

    # The first episode alone was adapted to
    options = ["--checkpoint", str(run), *"--demonstrations 1 --steps 2 --out first".split()]
    finetune.main(["--data", "stir.npz", *options])
    with_held_out, first = (dict(weights(f"{name}/adapted.pt")[0]) for name in ("adapted", "first"))
    assert same_bits(with_held_out, first)


# ---- Bad input -----------------------------------------------------------------------------------

REFUSED = {
    "": "name a task of a simulator with --task",
    "--task shelf-plce": "unknown task 'shelf-plce': did you mean 'shelf-place'?",
    "--task novel --suite ml1": "unknown suite 'ml1'",
    "--task shelf-place --steps 0": "--steps is 0: use at least 1",
    "--task shelf-place --lr-other -1": "--lr-other is -1.0: use at least 0",
    "--task shelf-place --seed 1000": "--seed is 1000: use at most 999",
    "--task shelf-place --checkpoint none.pt": "none.pt",
    "--task shelf-place --curve 5 500": "--curve: use steps from 1 to 199",
    "--task shelf-place --inner-steps 0": "--inner-steps is 0: use at least 1",
    "--task shelf-place --inner-lr 1": "--inner-lr is the learning rate of --inner-steps",
    "--task shelf-place --inner-steps 1 --steps 9 --curve 300": "2: leave out --steps, --curve",
    "--task shelf-place --inner-steps 1 --lr-vision 0": "2: leave out --lr-vision",
    "--task shelf-place --inner-steps 1 --normalizer fit": "2: leave out --normalizer",
    "--data missing.npz": "missing.npz is missing",
    "--data own.npz --task stir": "no finished run on own",
    "--data own.npz --task shelf-place": "no finished run on own",
    "--data own.npz --checkpoint {run} --task reach": "is a recording of stir, not of reach",
    "--data own.npz --checkpoint {run} --demonstrations 3": "3 demonstrations of stir asked for",
    "--data own.npz --checkpoint {run} --held-out 2": "stir: 2 of 2 episodes cannot be held out",
    "--data own.npz --suite ml10": "stir has 64 points a cloud, the policy 128",
    "--task shelf-place --workers 0": "--workers is 0: use at least 1",
    "--data long.npz --checkpoint {run}": "has 11 frames (one in 20), the policy 10 positions",
    "--data wide.npz --checkpoint {run}": "has 7 numbers an action, the policy 4: use",
    "--data none.npz --checkpoint {run}": "holds no episodes",
    "--data nowhere.npz --checkpoint {run}": "is no name",
    "--data {recorded}/reach.npz --task drawer-close": "is a recording of reach, not of drawer-",
    "--data otherwise.npz": "otherwise.npz was recorded with another camera",
    "--data elsewhere.npz": "elsewhere.npz was made in meta-world-hidden: name the --suite of its",
    "--data wide.npz --checkpoint {run} --out old --overwrite": "the policy 4: use",
    "--data own.npz --checkpoint {run} --out taken": "taken cannot be written to",
    "--data own.npz --checkpoint {run} --out {run} --overwrite": "holds a training run",
}


@pytest.fixture
def files(recorded):
    """Recordings in the test's folder, most of which do not fit the short run's policy."""
    recordings = {
        "own": own_recording(180, ends=[90, 180]),
        "long": own_recording(220),
        "wide": own_recording(action_dim=7),
        "none": own_recording(0, ends=[]),
        "nowhere": own_recording(task="../../evil"),
    }
    for name, recording in recordings.items():
        np.savez(f"{name}.npz", **recording)
    reach = data.load_demonstrations(recorded / "reach.npz")
    reach.meta["camera"] = "another"
    data.save_demonstrations("otherwise.npz", reach)
    reach.meta["simulator"] = "meta-world-hidden"
    data.save_demonstrations("elsewhere.npz", reach)
    Path("taken").write_text("a file")
    Path("old").mkdir()
    Path("old/.lock").touch()
    Path("old/success.json").write_text("{}")  # results that a mistake must not cost


@pytest.mark.parametrize("options", REFUSED)
def test_a_mistake_ends_in_one_line_that_says_what_to_do(options, files, run, recorded, capsys):
    argv = options.format(run=run, recorded=recorded).split()
    before, of_run = fingerprint(Path()), fingerprint(run)
    assert REFUSED[options] in fails(finetune, [*argv, "--device", "cpu"], capsys)
    assert not [path for path in Path("runs").rglob("*") if path.is_file() and path.name != ".lock"]
    shutil.rmtree("runs", ignore_errors=True)
    assert fingerprint(Path()) == before and fingerprint(run) == of_run


def test_an_adaptation_that_diverges_stops_and_writes_no_policy(run, recorded, capsys):
    argv = adapting(run, recorded, "--lr-diffusion 1e30")
    message = fails(finetune, [*argv, "--steps", "20"], capsys)
    assert "door-close: the loss is not finite at step" in message
    assert not list(Path().rglob("adapted.pt"))


def test_resuming_several_tasks_removes_no_policy_of_one(run, recorded, capsys):
    argv = adapting(run, recorded, "--episodes 0 --out one")
    finetune.main(argv)
    before = fingerprint(Path("one"))
    several = adapting(run, recorded, "--episodes 0 --out one --resume", "door-close reach")
    assert "one holds the policy of one task: choose another --out" in fails(
        finetune, several, capsys
    )
    assert fingerprint(Path("one")) == before

    # Nor a report of evaluate.py
    Path("measured").mkdir()
    Path("measured/success.json").write_text("{}")
    several = adapting(run, recorded, "--episodes 0 --out measured --resume", "door-close reach")
    assert "measured holds other results" in fails(finetune, several, capsys)
    assert Path("measured/success.json").exists()

    # Nor a file of that name that is the user's own
    for folder in (Path("project"), Path("project/door-close")):
        folder.mkdir()
        (folder / "config.json").write_text('{"mine": 1}')
        several = adapting(run, recorded, "--episodes 0 --out project --resume", "door-close reach")
        assert f"{folder} holds other results" in fails(finetune, several, capsys)
        (folder / "config.json").unlink()
    Path("project/door-close/success.json").write_text("{}")  # as evaluate.py leaves it
    assert "project/door-close holds other results" in fails(finetune, several, capsys)
    assert Path("project/door-close/success.json").exists()

    # Nor a policy that was adapted otherwise and not rolled out
    argv = adapting(run, recorded, "--episodes 0 --out both", "door-close reach")
    finetune.main(argv)
    before = fingerprint(Path("both"))
    message = fails(finetune, [*argv, "--resume", "--batch", "3"], capsys)
    assert "both/door-close was made with another batch" in message
    finetune.main([*argv, "--resume"])  # nothing is left to do
    assert fingerprint(Path("both")) == before


def test_a_folder_in_use_is_not_written_into(run, recorded, capsys):
    with common.locked(Path("busy")):
        message = fails(finetune, [*adapting(run, recorded), "--out", "busy"], capsys)
    assert "another process runs in busy" in message


def test_novel_tasks_are_those_of_the_suite_of_the_run(run, monkeypatch, capsys):
    info = torch.load(run / "ema-00006.pt", weights_only=True)
    torch.save(info | {"suite": "ml45"}, "ml45.pt")
    torch.save(info | {"suite": "own"}, "own.pt")

    def named(simulated_in, tasks, *_, **__):
        raise common.UserError(f"asked for {' '.join(tasks)}")

    monkeypatch.setattr(finetune, "collect", named)
    argv = ["--task", "novel", "--checkpoint"]
    assert "box-close hand-insert" in fails(finetune, [*argv, "ml45.pt"], capsys)
    assert "asked for door-close" in fails(finetune, [*argv, "ml45.pt", "--suite", "ml10"], capsys)
    assert "own.pt was trained on own recordings" in fails(finetune, [*argv, "own.pt"], capsys)


def test_a_checkpoint_that_does_not_fit_is_refused(run, recorded, capsys):
    info = torch.load(run / "ema-00006.pt", weights_only=True)
    torch.save(info | {"config": info["config"] | {"unet_widths": [32, 64]}}, "shape.pt")
    Path("cut.pt").write_bytes((run / "ema-00006.pt").read_bytes()[:1000])
    torch.save(info | {"text_weights": "openai-ViT-B-32-40d36571"}, "clip.pt")
    model.save("bare.pt", model.DAMIPolicy(model.PRESETS["tiny"]))
    messages = {
        "shape.pt": "weights and configuration do not fit",
        "cut.pt": "damaged",
        "clip.pt": "'openai-ViT-B-32-40d36571'",
        "bare.pt": "suite",
    }
    for name, message in messages.items():
        argv = [*adapting(run, recorded, "--clip-weights random"), "--checkpoint", name]
        assert message in fails(finetune, argv, capsys)
