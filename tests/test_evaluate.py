"""Tests of evaluate.py: figures, which checkpoint, rollouts, the policy that ships, bad input."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import BASE, fails

import clip
import evaluate
import finetune
import model
import scripts
import simulator
import train

pytestmark = pytest.mark.usefixtures("small_suite", "own_folder")


# ---- Figures -------------------------------------------------------------------------------------


def test_success_is_written_in_percent_with_its_interval():
    assert evaluate.format_success(17, 20) == "85.0 [64.0, 94.8]"
    assert evaluate.format_success(0, 20) == "0.0 [0.0, 16.1]"
    assert evaluate.mean_success({"a": [True, False], "b": [True, True, True]}) == 75.0


def test_the_mean_over_runs_has_students_interval():
    assert evaluate.mean_interval([50.0]) == "50.0 (one run)"
    # 4.303 * 10 / sqrt(3)
    assert evaluate.mean_interval([40.0, 50.0, 60.0]) == "50.0 ± 24.8 (3 runs)"


def test_a_table_has_a_row_a_task_the_mean_and_the_papers_figures():
    successes = {"reach": [True, False], "drawer-close": [True, True]}
    table = evaluate.success_table({"ours": successes}, "ml10")
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()]
    assert rows[0] == ["task", "ours", "paper"]
    assert [row[0] for row in rows[2:]] == ["reach", "drawer-close", "**mean**"]
    assert rows[4][1] == evaluate.format_success(3, 4)
    paper = [evaluate.paper_success("ml10", task) for task in ("reach", "drawer-close")]
    assert [row[2] for row in rows[2:]] == [f"{value:.1f}" for value in (*paper, sum(paper) / 2)]


# ---- Which checkpoint ----------------------------------------------------------------------------


def test_the_default_is_the_newest_finished_run_of_the_suite_that_is_not_tiny(capsys):
    policy = model.DAMIPolicy(model.PRESETS["tiny"])

    def leave(name, preset="small", suite="ml10", steps=5, last=5):
        arguments = {"preset": preset, "suite": suite, "steps": steps}
        Path(f"runs/{name}").mkdir(parents=True)
        Path(f"runs/{name}/config.json").write_text(json.dumps({"arguments": arguments}))
        scripts.save_checkpoint(f"runs/{name}/ema-{last:05d}.pt", policy)

    leave("a-tiny", preset="tiny")
    leave("b-unfinished", last=4)
    leave("c-own", suite="own")
    assert evaluate.default_checkpoint("ml10") == evaluate.SHIPPED_CHECKPOINT
    assert "comes with the code" in capsys.readouterr().out
    leave("d-older")
    leave("e-newer")
    assert evaluate.default_checkpoint("ml10") == Path("runs/e-newer/ema-00005.pt")
    assert evaluate.default_checkpoint("own") == Path("runs/c-own/ema-00005.pt")
    with pytest.raises(ValueError, match="no finished run on ml45"):
        evaluate.default_checkpoint("ml45")


def test_without_any_policy_the_user_is_told_how_to_make_one(monkeypatch, capsys):
    monkeypatch.setattr(evaluate, "SHIPPED_CHECKPOINT", Path("none.pt"))
    for script, argv in ((evaluate, []), (finetune, ["--task", "shelf-place"])):
        assert "no finished run on ml10 in runs/: train one" in fails(script, argv, capsys)


# ---- Rollouts ------------------------------------------------------------------------------------


def test_the_policy_that_ships_opens_windows(recorded):
    """Guards it against everything that it depends on: text weights, camera, sampling, layers."""
    task = "window-open"
    features, _ = clip.text_features([simulator.INSTRUCTIONS[task]], "random")
    paths, text = {task: recorded / f"{task}.npz"}, {task: features[0]}
    successes = evaluate.evaluate(evaluate.SHIPPED_CHECKPOINT, paths, text, 10, 0)[task]
    assert len(successes) == 10 and sum(successes) >= 8


def evaluating(run, recorded, options=""):
    common = f"--demonstrations 2 --device cpu {options}"
    return ["--checkpoint", str(run), "--data", str(recorded), *common.split()]


def test_evaluating_again_with_other_workers_gives_the_same_episodes(
    run, recorded, monkeypatch, capsys
):
    monkeypatch.setattr(evaluate, "EPISODES_A_JOB", 1)  # as in the run
    options = "--episodes 2 --workers 1 --out report"
    evaluate.main(evaluating(run, recorded, options))
    report = json.loads(Path("report/success.json").read_text())
    trained = json.loads((run / "success.json").read_text())
    label = "ml10-tiny-seed0/ema-00006"
    assert report["successes"] == {label: trained["successes"]["last checkpoint"]}
    monkeypatch.setattr(evaluate, "collect", None)  # said before anything is collected
    message = fails(evaluate, evaluating(run, recorded, options), capsys)
    assert "already holds success.json: add --overwrite" in message


def test_the_best_checkpoints_of_a_run_are_averaged(run, recorded, monkeypatch, capsys):
    def measured(checkpoint, paths, *_):
        return {task: [checkpoint.stem == "ema-00003", True] for task in paths}

    monkeypatch.setattr(evaluate, "evaluate", measured)
    evaluate.main(evaluating(run, recorded, "--episodes 2 --top 2 --out report"))
    facts = json.loads(Path("report/success.json").read_text())["facts"]
    assert facts["mean, last checkpoint"] == "50.0 (one run)"
    assert facts["mean, best 2 checkpoints"] == "75.0 (one run)"
    assert "best 2 checkpoints" in capsys.readouterr().out


def test_a_job_sees_the_same_frames_whatever_its_worker_did_before(run, recorded, monkeypatch):
    text = torch.randn(512, generator=torch.Generator().manual_seed(0)).numpy()
    rollout, frames = evaluate.rollout, []

    def watched(*args):
        watch = lambda _, observation: frames.append(observation["point_cloud"])  # noqa: E731
        return rollout(*args[:6], watch)

    class Quiet:
        def put(self, item):
            pass

    monkeypatch.setattr(evaluate, "rollout", watched)
    monkeypatch.setattr(simulator, "EPISODE_STEPS", 40)
    monkeypatch.setattr(evaluate, "loaded", {})
    monkeypatch.setattr(evaluate.worker, "finished", Quiet(), raising=False)

    def job(task, episode):
        frames.clear()
        seeds = [simulator.evaluation_seed(0, episode)]
        evaluate.rollout_job(task, str(recorded / f"{task}.npz"), 2, text, seeds)
        return np.stack(frames)

    evaluate.load_policy(str(run / "ema-00006.pt"), "cpu")
    alone = job("reach", 1)
    for task, episode in [("reach", 0), ("drawer-close", 0), ("reach", 1)]:
        later = job(task, episode)
    assert len(alone) == 5 and np.array_equal(alone, later)


def test_inputs_are_swapped_with_those_of_the_next_task_or_left_out(
    run, recorded, monkeypatch, capsys
):
    calls = []

    def measured(checkpoint, paths, text, episodes, seed, workers, device, n, blank, sampler):
        calls.append(({t: path.stem for t, path in paths.items()}, text, blank))
        return {task: [len(calls) == 1] * episodes for task in paths}

    monkeypatch.setattr(evaluate, "evaluate", measured)
    swap = "--swap demonstration instruction --episodes 2 --out swapped"
    evaluate.main(evaluating(run, recorded, swap))
    following = dict(zip(BASE, BASE[1:] + BASE[:1]))
    own, demonstration, instruction = calls
    assert own[0] == instruction[0] == {task: task for task in BASE}
    assert demonstration[0] == following and demonstration[1] is own[1]
    assert all(torch.equal(instruction[1][t], own[1][following[t]]) for t in BASE)
    columns = json.loads(Path("swapped/success.json").read_text())["successes"]
    assert [name.split(", ")[-1] for name in columns][1:] == [
        "demonstration of another task",
        "instruction of another task",
    ]
    calls.clear()
    without = "--without demonstration instruction --episodes 2 --out without"
    evaluate.main(evaluating(run, recorded, without))
    assert calls[0][2] and all(not text.any() for text in calls[0][1].values())
    report = json.loads(Path("without/success.json").read_text())
    assert report["facts"]["without"] == "demonstration and instruction"
    assert "--swap needs" in fails(
        evaluate, evaluating(run, recorded, f"--task reach {swap}"), capsys
    )


def test_a_rollout_can_be_watched(run, recorded, monkeypatch, capsys):
    monkeypatch.setattr(simulator, "EPISODE_STEPS", 24)
    evaluate.main(evaluating(run, recorded, "--task reach --gif reach.gif"))
    assert Path("reach.gif").read_bytes().startswith(b"GIF8")
    assert Path("reach.gif").stat().st_size > 10_000
    assert "wrote reach.gif" in capsys.readouterr().out


# ---- Bad input -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options, message",
    [
        ("--checkpoint none.pt", "none.pt"),
        ("--episodes 0", "--episodes is 0: use at least 1"),
        ("--gif reach.gif", "name its task"),
        ("--task reach --gif reach.mp4", "reach.gif"),
        ("--seed -1", "seed"),
        ("--task raech", "did you mean 'reach'?"),
        ("--suite ml-45", "did you mean 'ml45'?"),
        ("--top 5", "holds 2 checkpoints, fewer than --top"),
    ],
)
def test_a_wrong_argument_ends_in_one_line_that_says_what_to_do(run, options, message, capsys):
    assert message in fails(evaluate, ["--checkpoint", run, *options.split()], capsys)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is CUDA here")
@pytest.mark.parametrize("script", [train, finetune, evaluate])
def test_cuda_where_there_is_none_points_to_the_cpu(script, capsys):
    assert "--device cuda cannot be used here" in fails(script, ["--device", "cuda"], capsys)


def test_a_policy_that_was_adapted_is_measured_on_its_task_alone(run, recorded, capsys):
    info = torch.load(run / "ema-00006.pt", weights_only=True)
    torch.save(info | {"adapted_to": "door-close"}, "adapted.pt")
    argv = ["--data", recorded, "--demonstrations", "2", "--checkpoint"]
    message = fails(evaluate, [*argv, "adapted.pt", "--task", "reach"], capsys)
    assert "was adapted to door-close, not to reach" in message
    message = fails(evaluate, [*argv, run, "adapted.pt"], capsys)
    assert "adapted.pt was adapted to door-close: measure it alone" in message


def test_a_policy_of_own_recordings_cannot_be_rolled_out(run, recorded, capsys):
    info = torch.load(run / "ema-00006.pt", weights_only=True)
    torch.save(info | {"suite": "own"}, "own.pt")
    message = fails(evaluate, ["--checkpoint", "own.pt", "--data", recorded], capsys)
    assert "no simulator" in message


def test_a_command_ends_quietly_or_in_one_line(capsys):
    with pytest.raises(SystemExit) as end:
        scripts.command_line(lambda: (_ for _ in ()).throw(KeyboardInterrupt()))
    assert end.value.code == 130
