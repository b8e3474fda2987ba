"""Tests of train.py, finetune.py and evaluate.py on real Meta-World: whole runs at preset `tiny`, and bad input."""

import functools
import hashlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import BASE, NOVEL
from scipy.stats import binomtest

import data
import evaluate
import finetune
import model
import robot
import train

ROOT = Path(train.__file__).resolve().parent
SMALL_ML10 = {"train": [f"{task}-v3" for task in BASE], "test": [f"{task}-v3" for task in NOVEL]}
FEW = ["--preset", "tiny", "--steps", "6", "--checkpoint-every", "3", "--demonstrations", "2", "--episodes", "0"]
FEW += ["--clip-weights", "random", "--device", "cpu"]


@pytest.fixture(scope="module", autouse=True)
def small_suite():
    """ML10 with three of its ten base tasks, and the text tower built once instead of for every call."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(data.SUITES, "ml10", SMALL_ML10)
        patch.setattr(evaluate, "load_clip_text_encoder", functools.cache(model.load_clip_text_encoder))
        yield


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    handler, threads = signal.getsignal(signal.SIGINT), torch.get_num_threads()
    monkeypatch.chdir(tmp_path)
    yield
    signal.signal(signal.SIGINT, handler)
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def run(recorded, tmp_path_factory):
    """The folder in which `train.py` ran, with its default run folder inside."""
    folder = tmp_path_factory.mktemp("trained")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(evaluate, "EPISODES_A_JOB", 1)  # jobs enough for both workers
        few = [*FEW, "--episodes", "2"]
        train.main(["--suite", "ml10", "--data", str(recorded), "--workers", "2", "--evaluate-every", "6", *few])
    return folder / "runs" / "ml10-tiny-seed0"


def fails(script, argv, capsys):
    """Runs a script that must end with exit code 2 and exactly one line on stderr; returns the line."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as end:
        data.command_line(lambda: script.main([str(arg) for arg in argv]), model.InputError)
    error = capsys.readouterr().err
    assert end.value.code == 2 and error.startswith("error: ") and error.count("\n") == 1, error
    return error


def weights(path):
    policy, info = model.load_checkpoint(path)
    return policy.state_dict(), info


def same_bits(a, b):
    """Whether two nested checkpoints are equal, bit for bit."""
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same_bits(a[key], b[key]) for key in a)
    if isinstance(a, list):
        return len(a) == len(b) and all(map(same_bits, a, b))
    return a == b


def whole_state(folder):
    """Policy, EMA, optimizer and step of a run's last.pt; not the seconds."""
    policy, info = weights(folder / "last.pt")
    return {"ema": dict(policy), "training": info["training"], "step": info["step"]}


def fingerprint(folder):
    return {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.rglob("*")) if path.is_file()}


def metrics(folder):
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


# --- Figures ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("successes, episodes", [(0, 20), (1, 20), (17, 20), (20, 20), (1, 1), (30, 60)])
def test_the_wilson_interval_is_scipys(successes, episodes):
    expected = binomtest(successes, episodes).proportion_ci(0.95, method="wilson")
    assert evaluate.wilson_interval(successes, episodes) == pytest.approx((expected.low, expected.high), abs=1e-6)


def test_success_is_written_in_percent_with_its_interval():
    assert evaluate.format_success(17, 20) == "85.0 [64.0, 94.8]"
    assert evaluate.format_success(0, 20) == "0.0 [0.0, 16.1]"
    assert evaluate.mean_success({"a": [True, False], "b": [True, True, True]}) == 75.0
    with pytest.raises(ValueError):
        evaluate.wilson_interval(0, 0)


def test_the_mean_over_runs_has_students_interval():
    assert evaluate.mean_interval([50.0]) == "50.0 (one run)"
    assert evaluate.mean_interval([40.0, 50.0, 60.0]) == "50.0 ± 24.8 (3 runs)"  # 4.303 * 10 / sqrt(3)


def test_a_table_has_a_row_a_task_the_mean_and_the_papers_figures():
    table = evaluate.success_table({"ours": {"reach": [True, False], "drawer-close": [True, True]}}, "ml10")
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()]
    assert rows[0] == ["task", "ours", "paper"]
    assert [row[0] for row in rows[2:]] == ["reach", "drawer-close", "**mean**"]
    assert rows[4][1] == evaluate.format_success(3, 4)
    paper = [evaluate.paper_success("ml10", task) for task in ("reach", "drawer-close")]
    assert [row[2] for row in rows[2:]] == [f"{value:.1f}" for value in (*paper, sum(paper) / 2)]


def test_the_learning_rate_warms_up_and_falls_to_zero_along_a_cosine():
    rate = functools.partial(train.learning_rate, steps=1500, peak=1e-3, warmup=500)
    assert rate(0) == pytest.approx(1e-3 / 500)
    assert rate(499) == rate(500) == pytest.approx(1e-3)
    assert rate(1000) == pytest.approx(5e-4)
    assert 0 < rate(1499) < 1e-8 and rate(1500) == pytest.approx(0, abs=1e-12)
    assert train.learning_rate(0, 10, 1.0, 0) == 1.0  # no warm-up
    assert np.all(np.diff([rate(step) for step in range(500, 1500)]) < 0)


def test_support_and_query_are_disjoint_and_share_the_demonstration(recorded):
    policy = model.DAMIPolicy(model.PRESETS["tiny"])
    sampler = evaluate.window_sampler(policy, data.load_demonstrations(recorded / "reach.npz"))
    batch = train.task_batch(policy, sampler, torch.zeros(512), 12, (0, 1, 2))
    support, query = train.split(batch, 4)
    for name in batch:
        if name in train.WINDOW:
            assert torch.equal(torch.cat([support[name], query[name]]), batch[name]) and len(support[name]) == 4
        else:
            assert support[name] is query[name] and len(batch[name]) == 1
    again = train.task_batch(policy, sampler, torch.zeros(512), 12, (0, 1, 2))
    other = train.task_batch(policy, sampler, torch.zeros(512), 12, (0, 2, 2))
    assert same_bits(batch, again) and not torch.equal(batch["noise"], other["noise"])
    assert not torch.equal(batch["action"], other["action"])


# --- Whole runs ------------------------------------------------------------------------------------------------------


def test_training_leaves_everything_that_it_promises(run):
    names = "config.json curves.png ema-00003.pt ema-00006.pt last.pt metrics.jsonl success.json success.md success.png"
    assert sorted(path.name for path in run.iterdir()) == names.split()
    config = json.loads((run / "config.json").read_text())
    assert config["arguments"]["steps"] == 6 and config["text_weights"] == "random-seed-0"
    assert model.PolicyConfig(**config["config"]) == model.PRESETS["tiny"]
    lines = [line for line in metrics(run) if "loss" in line]
    assert [line["step"] for line in lines] == [1, 2, 3, 4, 5, 6]
    assert all(np.isfinite(line["loss"]) and line["gradient_norm"] > 0 for line in lines)
    (evaluated,) = (line for line in metrics(run) if "success" in line)
    report = json.loads((run / "success.json").read_text())
    successes = report["successes"]["last checkpoint"]
    assert list(successes) == BASE and all(len(episodes) == 2 for episodes in successes.values())
    assert evaluated["successes"] == successes and evaluated["success"] == evaluate.mean_success(successes)
    table = (run / "success.md").read_text()
    assert all(f"| {task} |" in table for task in BASE) and "paper" in table and "random-seed-0" in table
    for name in ("curves.png", "success.png"):
        assert (run / name).read_bytes().startswith(b"\x89PNG")
    policy, ema = whole_state(run)["training"]["policy"], weights(run / "ema-00006.pt")[0]
    assert all(torch.equal(ema[name], policy[name]) for name in ema if "normalizer" in name)
    assert ema["normalizer.action_scale"].ne(1).any()  # fitted
    assert not torch.equal(ema["unet.head.1.weight"], policy["unet.head.1.weight"])


def killed_run(recorded, out, step):
    """Trains in a process that is killed (SIGKILL) just after logging `step`, between two savings."""
    program = f"""
import os, signal
import data, train
data.SUITES["ml10"] = {SMALL_ML10!r}
log = train.log
def log_and_die(folder, **values):
    log(folder, **values)
    if values["step"] == {step}:
        os.kill(os.getpid(), signal.SIGKILL)
train.log = log_and_die
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


def test_ctrl_c_saves_says_how_to_resume_and_ends_with_130(run, recorded, tmp_path, monkeypatch, capsys):
    log, out = train.log, tmp_path / "interrupted"

    def log_and_interrupt(folder, **values):
        log(folder, **values)
        if values["step"] == 2:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(train, "log", log_and_interrupt)
    argv = ["--data", str(recorded), "--out", str(out), *FEW]
    with pytest.raises(SystemExit) as end:
        data.command_line(lambda: train.main(argv))
    error = capsys.readouterr().err
    assert end.value.code == 130 and "saved after step 2" in error and "--resume" in error
    assert weights(out / "last.pt")[1]["step"] == 2
    monkeypatch.setattr(train, "log", log)
    train.main([*argv, "--resume"])
    assert same_bits(whole_state(out), whole_state(run))


def test_every_way_of_training_learns_something_of_its_own(run, recorded, tmp_path):
    ways = {
        "first": ["--maml", "first"],
        "off": ["--maml", "off"],
        "loop": ["--vectorize", "1"],
        "mlp": ["--demo-encoder", "mlp"],
        "dp3": ["--maml", "off", "--demo-encoder", "none", "--tcfm", "none"],
    }
    for name, options in ways.items():
        argv = [*FEW, *options, "--steps", "2", "--inner-lr", "0.1"]
        train.main(["--data", str(recorded), "--out", str(tmp_path / name), *argv])
    argv = [*FEW, "--steps", "2", "--inner-lr", "0.1"]
    train.main(["--data", str(recorded), "--out", str(tmp_path / "second"), *argv])
    first_step = {name: metrics(tmp_path / name)[0] for name in [*ways, "second"]}
    assert first_step["first"]["loss"] == pytest.approx(first_step["second"]["loss"], rel=1e-5)
    assert first_step["loop"]["gradient_norm"] == pytest.approx(first_step["second"]["gradient_norm"], rel=1e-4)
    norms = {f"{line['gradient_norm']:.3g}" for name, line in first_step.items() if name != "loop"}
    assert len(norms) == 5
    argv += ["--multi-task-share", "0.5"]  # the first of the two steps without the inner one
    train.main(["--data", str(recorded), "--out", str(tmp_path / "annealed"), *argv])
    annealed = metrics(tmp_path / "annealed")
    assert annealed[0] == pytest.approx(first_step["off"] | {"seconds": annealed[0]["seconds"]})
    train.main(["--data", str(recorded), "--out", str(tmp_path / "never"), *argv, "--maml", "off"])
    assert annealed[1]["gradient_norm"] != pytest.approx(metrics(tmp_path / "never")[1]["gradient_norm"], rel=1e-3)
    names = weights(tmp_path / "dp3" / "last.pt")[0]
    assert not any(name.startswith(("u2t", "demo_encoder")) for name in names)


def test_two_processes_under_torchrun_train_as_one_does(recorded, tmp_path):
    script = tmp_path / "small_train.py"
    script.write_text(
        "import sys\nimport data, train\n"
        f'data.SUITES["ml10"] = {SMALL_ML10!r}\n'  # three tasks: unequal shares
        "train.main(sys.argv[1:])\n"
    )
    argv = ["--data", str(recorded), *FEW, "--steps", "3", "--checkpoint-every", "3"]
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    two = subprocess.run(
        [*launcher, str(script), "--out", str(tmp_path / "two"), *argv], env=environment, capture_output=True
    )
    assert two.returncode == 0, two.stderr.decode()
    train.main(["--out", str(tmp_path / "one"), *argv])
    for one, both in zip(metrics(tmp_path / "one"), metrics(tmp_path / "two")):
        assert both["loss"] == pytest.approx(one["loss"], rel=1e-4)
        assert both["gradient_norm"] == pytest.approx(one["gradient_norm"], rel=1e-3)
    one, two = (whole_state(tmp_path / name)["training"]["policy"] for name in ("one", "two"))
    torch.manual_seed(0)
    start = model.DAMIPolicy(model.PRESETS["tiny"]).state_dict()
    moved = torch.cat([(one[name] - start[name]).flatten() for name in one if "normalizer" not in name])
    apart = torch.cat([(one[name] - two[name]).flatten() for name in one if "normalizer" not in name])
    assert apart.norm() < 1e-3 * moved.norm() and moved.norm() > 0.1


def test_without_a_run_the_policy_that_comes_with_the_code_is_used(recorded, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    argv = ["--task", "door-close", "--data", str(recorded), "--demonstrations", "2", "--episodes", "0"]
    finetune.main([*argv, "--steps", "1", "--batch", "4", "--device", "cpu"])
    assert "no checkpoint in runs/: using the one that comes with the code, ml10-small.pt" in capsys.readouterr().out
    info = weights("runs/finetune/door-close-seed0/adapted.pt")[1]
    assert info["preset"] == "small" and info["arguments"]["maml"] == "second"
    assert evaluate.SHIPPED_CHECKPOINT.stat().st_size < 16 * 2**20


def test_without_any_policy_the_user_is_told_how_to_make_one(monkeypatch, capsys):
    monkeypatch.setattr(evaluate, "SHIPPED_CHECKPOINT", Path("none.pt"))
    for script, argv in ((evaluate, []), (finetune, ["--task", "shelf-place"])):
        assert "no checkpoint in runs/: run `python train.py --suite ml10` first" in fails(script, argv, capsys)


def test_finetuning_needs_only_a_task_and_reports_before_and_after(run, recorded, monkeypatch, capsys):
    monkeypatch.chdir(run.parent.parent)
    before = fingerprint(run)
    argv = ["--task", "door-close", "--data", str(recorded), "--demonstrations", "2", "--steps", "4", "--episodes", "1"]
    finetune.main([*argv, "--device", "cpu"])
    folder = Path("runs/finetune/door-close-seed0")
    names = "adapted.pt config.json metrics.jsonl success.json success.md success.png"
    assert sorted(path.name for path in folder.iterdir()) == names.split()
    columns = json.loads((folder / "success.json").read_text())["successes"]
    assert list(columns) == ["before", "after"] and all(len(c["door-close"]) == 1 for c in columns.values())
    printed = capsys.readouterr().out
    assert "ema-00006.pt" in printed and "adapted in" in printed and "| before | after | paper |" in printed
    assert [line["step"] for line in metrics(folder)] == [1, 2, 3, 4]
    policy, info = weights(folder / "adapted.pt")
    assert info["adapted_to"] == "door-close" and info["text_weights"] == "random-seed-0"
    old = weights(run / "ema-00006.pt")[0]
    assert any(not torch.equal(policy[name], old[name]) for name in old)
    assert not torch.equal(policy["normalizer.state_scale"], old["normalizer.state_scale"])  # fit, the default
    assert fingerprint(run) == before


def test_adaptation_is_repeatable_and_moves_only_what_has_a_learning_rate(run, recorded, tmp_path):
    argv = ["--task", "door-close", "--data", str(recorded), "--demonstrations", "2", "--steps", "2", "--episodes", "0"]
    argv += ["--device", "cpu", "--checkpoint", str(run / "ema-00006.pt")]
    frozen = [*argv, "--lr-vision", "0", "--lr-other", "0", "--normalizer", "keep"]
    for name, options in {"a": argv, "b": argv, "frozen": frozen}.items():
        finetune.main([*options, "--out", str(tmp_path / name)])
    a, b, frozen = (weights(tmp_path / name / "adapted.pt")[0] for name in ("a", "b", "frozen"))
    old = weights(run / "ema-00006.pt")[0]
    assert same_bits(dict(a), dict(b))
    moved = {name.split(".")[0] for name in old if not torch.equal(old[name], a[name])}
    assert moved == {"observation_encoder", "demo_encoder", "u2t", "unet", "normalizer"}
    assert {name.split(".")[0] for name in old if not torch.equal(old[name], frozen[name])} == {"unet"}


def test_evaluating_again_with_other_workers_gives_the_same_episodes(run, recorded, monkeypatch, capsys):
    monkeypatch.setattr(evaluate, "EPISODES_A_JOB", 1)  # as in the run
    argv = ["--checkpoint", str(run), "--data", str(recorded), "--demonstrations", "2", "--episodes", "2"]
    evaluate.main([*argv, "--workers", "1", "--top", "2", "--out", "report", "--device", "cpu"])
    report = json.loads(Path("report/success.json").read_text())
    trained = json.loads((run / "success.json").read_text())
    assert report["successes"] == {"ml10-tiny-seed0/ema-00006": trained["successes"]["last checkpoint"]}
    assert {"base mean, last checkpoint", "base mean, best 2 checkpoints"} <= set(report["facts"])
    assert "best 2 checkpoints" in capsys.readouterr().out


def test_a_job_sees_the_same_frames_whatever_its_worker_did_before(run, recorded, monkeypatch):
    text = torch.randn(512, generator=torch.Generator().manual_seed(0)).numpy()
    rollout, frames = evaluate.rollout, []
    watch = lambda _, observation: frames.append(observation["point_cloud"])  # noqa: E731
    monkeypatch.setattr(evaluate, "rollout", lambda *args: rollout(*args, watch))
    monkeypatch.setattr(evaluate, "EPISODES_A_JOB", 1)
    monkeypatch.setattr(data, "EPISODE_STEPS", 40)
    monkeypatch.setattr(evaluate, "worker", {})

    def job(task, first):
        frames.clear()
        evaluate.run_job(task, str(recorded / f"{task}.npz"), 2, text, 0, first, 1)
        return np.stack(frames)

    evaluate.start_worker(str(run / "ema-00006.pt"), "cpu")
    alone = job("reach", 1)
    for task, first in [("reach", 0), ("drawer-close", 0), ("reach", 1)]:
        later = job(task, first)
    assert len(alone) == 5 and np.array_equal(alone, later)


def test_novel_tasks_are_adapted_to_before_they_are_evaluated_as_finetune_does(run, recorded):
    argv = ["--checkpoint", str(run / "ema-00006.pt"), "--split", "novel", "--data", str(recorded), "--episodes", "1"]
    evaluate.main([*argv, "--demonstrations", "2", "--steps", "2", "--workers", "1", "--out", "report"])
    adapted = Path("report/ml10-tiny-seed0-ema-00006-door-close.pt")
    assert model.load_checkpoint(adapted)[1]["adapted_to"] == "door-close"
    report = json.loads(Path("report/success.json").read_text())
    assert list(report["successes"]["ml10-tiny-seed0/ema-00006"]) == ["door-close"]
    argv = ["--task", "door-close", "--data", str(recorded), "--demonstrations", "2", "--steps", "2", "--episodes", "0"]
    finetune.main([*argv, "--checkpoint", str(run / "ema-00006.pt"), "--out", "finetuned"])
    assert same_bits(dict(weights(adapted)[0]), dict(weights("finetuned/adapted.pt")[0]))


def test_a_rollout_can_be_watched(run, recorded, monkeypatch, capsys):
    monkeypatch.setattr(data, "EPISODE_STEPS", 24)
    argv = ["--checkpoint", str(run), "--data", str(recorded), "--demonstrations", "2", "--out", "report"]
    evaluate.main([*argv, "--task", "reach", "--gif", "reach.gif", "--device", "cpu"])
    assert Path("reach.gif").read_bytes().startswith(b"GIF8") and Path("reach.gif").stat().st_size > 10_000
    assert "wrote reach.gif" in capsys.readouterr().out


# --- Bad input -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "script, argv, message",
    [
        (train, ["--suite", "ml11", "--preset", "tiny"], "unknown suite 'ml11': did you mean 'ml10'?"),
        (train, ["--preset", "tny"], "unknown preset 'tny': did you mean 'tiny'?"),
        (train, ["--preset", "tiny", "--steps", "0"], "--steps is 0: use at least 1"),
        (train, ["--preset", "tiny", "--demonstrations", "0"], "--demonstrations is 0: use at least 1"),
        (train, ["--preset", "tiny", "--tcfm", "none"], "set both to 'none'"),
        (finetune, ["--task", "shelf-plce"], "unknown task 'shelf-plce': did you mean 'shelf-place'?"),
        (finetune, ["--task", "shelf-place", "--steps", "0"], "--steps is 0: use at least 1"),
        (finetune, [], "name a Meta-World task with --task"),
        (train, ["--preset", "tiny", "--after-success", "-1"], "--after-success is -1: use at least 0"),
        (train, ["--preset", "tiny", "--num-points", "0"], "--num-points is 0: use at least 1"),
        (evaluate, ["--checkpoint", "none.pt"], "no checkpoint at none.pt"),
        (evaluate, ["--episodes", "0"], "--episodes is 0: use at least 1"),
        (evaluate, ["--gif", "reach.gif"], "name its --task"),
        (evaluate, ["--task", "reach", "--gif", "reach.mp4"], "to a .gif file"),
        (train, ["--preset", "tiny", "--seed", "-1"], "--seed is -1: use 0 or more"),
    ],
)
def test_a_wrong_argument_ends_in_one_line_that_says_what_to_do(script, argv, message, capsys):
    assert message in fails(script, argv, capsys)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is CUDA here")
@pytest.mark.parametrize("script", [train, finetune, evaluate])
def test_cuda_where_there_is_none_points_to_the_cpu(script, capsys):
    assert "--device cuda cannot be used here" in fails(script, ["--device", "cuda"], capsys)


def test_names_that_the_checkpoint_makes_known_are_checked_too(run, capsys):
    argv = ["--checkpoint", run]
    assert "did you mean 'reach'?" in fails(evaluate, [*argv, "--task", "raech"], capsys)
    assert "did you mean 'ml45'?" in fails(evaluate, [*argv, "--suite", "ml-45"], capsys)
    assert "holds 2 checkpoints, --top asks for the best 5" in fails(evaluate, [*argv, "--top", "5"], capsys)


def test_an_existing_run_is_neither_overwritten_nor_resumed_with_other_settings(run, recorded, capsys):
    before = fingerprint(run)
    argv = ["--data", recorded, "--out", run, *FEW, "--episodes", "2", "--evaluate-every", "6"]
    assert "already holds a run: add --resume" in fails(train, argv, capsys)
    message = fails(train, [*argv, "--resume", "--lr", "0.5"], capsys)
    assert "lr 0.003 -> 0.5" in message and "steps" not in message
    assert "demo_encoder vmt -> mlp" in fails(train, [*argv, "--resume", "--demo-encoder", "mlp"], capsys)
    assert fingerprint(run) == before


def test_an_output_folder_that_cannot_be_made_ends_in_one_line(run, recorded, capsys):
    Path("taken").write_text("a file")
    common = ["--data", recorded, "--out", "taken"]
    assert "taken" in fails(train, [*common, *FEW], capsys)
    adapt = ["--task", "door-close", "--checkpoint", run / "ema-00006.pt", "--demonstrations", "2", "--steps", "1"]
    assert "taken" in fails(finetune, [*common, *adapt], capsys)
    assert "taken" in fails(evaluate, [*common, "--checkpoint", run, "--demonstrations", "2"], capsys)
    assert Path("taken").read_text() == "a file"


def test_a_checkpoint_that_does_not_fit_is_refused_by_every_script(run, recorded, capsys):
    info = torch.load(run / "ema-00006.pt", weights_only=True)
    torch.save(info | {"config": info["config"] | {"unet_widths": [32, 64]}}, "shape.pt")
    Path("cut.pt").write_bytes((run / "ema-00006.pt").read_bytes()[:1000])
    torch.save(info | {"text_weights": "openai-ViT-B-32-40d36571"}, "clip.pt")
    data_of = ["--data", recorded, "--task", "reach", "--demonstrations", "2", "--clip-weights", "random"]
    for script in (finetune, evaluate):
        for name, message in {
            "shape.pt": "weights and configuration do not fit",
            "cut.pt": "damaged",
            "clip.pt": "made with the text weights 'openai-ViT-B-32-40d36571', here are 'random-seed-0'",
        }.items():
            assert message in fails(script, [*data_of, "--checkpoint", name], capsys)


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


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"frames": 220}, "a demonstration has 11 frames (every 20th of it), the policy 10 positions"),
        ({"action_dim": 7}, "state and action have 9 and 7 dimensions, the policy 9 and 4"),
        ({"frames": 0, "ends": []}, "holds no episodes"),
    ],
)
def test_demonstrations_that_do_not_fit_the_policy_are_refused(run, capsys, changes, message):
    np.savez("own.npz", **own_recording(**changes))
    argv = ["--data", "own.npz", "--checkpoint", run / "ema-00006.pt", "--demonstrations", "1", "--steps", "1"]
    assert message in fails(finetune, argv, capsys)
    assert not list(Path().rglob("adapted.pt"))


def test_own_recordings_are_adapted_to_without_a_simulator(run, capsys):
    np.savez("own.npz", **own_recording(frames=150))
    finetune.main(
        ["--data", "own.npz", "--checkpoint", str(run / "ema-00006.pt"), "--demonstrations", "1", "--steps", "2"]
    )
    folder = Path("runs/finetune/stir-seed0")
    assert sorted(path.name for path in folder.iterdir()) == ["adapted.pt", "config.json", "metrics.jsonl"]
    assert "adapted in" in capsys.readouterr().out


def test_own_recordings_of_any_length_and_dimension_are_trained_on_and_adapted_to(capsys):
    Path("own").mkdir()
    for task, ends in (("stir", [60, 90]), ("pour", [200, 350])):
        recorded = own_recording(ends[-1], action_dim=7, ends=ends, state_dim=7, task=task)
        np.savez(f"own/{task}.npz", **recorded)
    argv = ["--preset", "tiny", "--steps", "2", "--checkpoint-every", "2", "--data", "own", "--clip-weights", "random"]
    for name, options in {"maml": [], "off": ["--maml", "off"]}.items():
        train.main([*argv, "--out", f"runs/{name}", *options])
        policy, info = model.load_checkpoint(f"runs/{name}/ema-00002.pt")
        config = policy.config
        assert (config.state_dim, config.action_dim, config.demo_positions) == (7, 7, 25) and info["suite"] == "own"
        assert not Path(f"runs/{name}/success.json").exists()
    finetune.main(["--data", "own/pour.npz", "--checkpoint", "runs/maml/ema-00002.pt", "--steps", "2"])
    assert weights("runs/finetune/pour-seed0/adapted.pt")[1]["adapted_to"] == "pour"
    assert "own, base tasks" not in capsys.readouterr().out
    assert "unknown suite 'own'" in fails(evaluate, ["--checkpoint", "runs/maml/ema-00002.pt"], capsys)


def test_more_demonstrations_than_there_are_is_said(run, capsys):
    np.savez("own.npz", **own_recording())
    argv = ["--data", "own.npz", "--checkpoint", run / "ema-00006.pt", "--demonstrations", "3"]
    assert "3 demonstrations of stir were asked for, but there are 1" in fails(finetune, argv, capsys)


def test_a_loss_that_is_not_finite_stops_training_and_keeps_the_last_good_state(
    recorded, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(train, "SAVE_SECONDS", -1)  # saves after every step
    argv = ["--data", str(recorded), "--out", str(tmp_path / "run"), *FEW, "--lr", "1e30", "--warmup", "1"]
    with pytest.raises(SystemExit) as end:
        data.command_line(lambda: train.main(argv))
    message = capsys.readouterr().err.splitlines()[-1]  # after the progress bar
    assert end.value.code == 2 and message.startswith("error: the loss") and "smaller --lr" in message
    assert any(task in message for task in [*BASE, "tasks: all"])
    step = int(re.search(r"not finite at step (\d+)", message)[1])
    state, info = weights(tmp_path / "run" / "last.pt")
    assert info["step"] == step - 1 >= 1 and all(torch.isfinite(x).all() for x in state.values())
    assert [path.name for path in (tmp_path / "run").iterdir() if path.name.startswith(".")] == []


def test_an_adaptation_that_diverges_stops_and_writes_nothing(run, recorded, capsys):
    argv = ["--task", "door-close", "--data", recorded, "--checkpoint", run / "ema-00006.pt", "--demonstrations", "2"]
    with pytest.raises(data.InputError, match=r"not finite at step \d+ on door-close"):
        finetune.main([str(arg) for arg in [*argv, "--steps", "20", "--lr-diffusion", "1e30", "--episodes", "0"]])
    assert not list(Path().rglob("adapted.pt"))


# --- README ----------------------------------------------------------------------------------------------------------


def readme_commands():
    """The command lines of README.md's bash blocks that call one of the scripts: (script, arguments)."""
    text = (ROOT / "README.md").read_text()
    blocks = re.findall(r"```(?:bash|sh)\n(.*?)```", text, flags=re.DOTALL)
    lines = [line.strip() for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    commands = []
    for line in lines:
        for part in line.split("&&"):
            words = shlex.split(part, comments=True)
            names = [
                i
                for i, word in enumerate(words)
                if Path(word).name in ("train.py", "finetune.py", "evaluate.py", "data.py", "robot.py")
            ]
            if names and words[0] in ("python", "torchrun"):
                commands.append((Path(words[names[0]]).stem, words[names[0] + 1 :]))
    return commands


def test_the_readmes_commands_are_understood():
    commands = readme_commands()
    scripts = {"train": train, "finetune": finetune, "evaluate": evaluate, "data": data, "robot": robot}
    assert {name for name, _ in commands} == set(scripts)
    for name, arguments in commands:
        scripts[name].parse(arguments)
