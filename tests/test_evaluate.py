"""Tests of evaluate.py: figures, which checkpoint, rollouts, the policy that ships, bad input."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from conftest import BASE, fails

import clip
import data
import evaluate
import finetune
import model
import report
import scripts
import simulator
import tests.unseen
import train

pytestmark = pytest.mark.usefixtures("small_suite", "own_folder")


# ---- Figures -------------------------------------------------------------------------------------


def test_success_is_written_in_percent_with_its_interval():
    assert report.format_success(17, 20) == "85.0 [64.0, 94.8]"
    assert report.format_success(0, 20) == "0.0 [0.0, 16.1]"
    assert report.mean_success({"a": [True, False], "b": [True, True, True]}) == 75.0


def test_the_mean_over_runs_has_students_interval():
    assert report.mean_interval([50.0]) == "50.0 (one run)"
    # 4.303 * 10 / sqrt(3)
    assert report.mean_interval([40.0, 50.0, 60.0]) == "50.0 ± 24.8 (3 runs)"


def test_a_table_has_a_row_a_task_the_mean_and_the_papers_figures():
    successes = {"reach": [True, False], "drawer-close": [True, True]}
    table = report.success_table({"ours": successes}, "ml10")
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()]
    assert rows[0] == ["task", "ours", "paper"]
    assert [row[0] for row in rows[2:]] == ["reach", "drawer-close", "**mean**"]
    assert rows[4][1] == report.format_success(3, 4)
    paper = [report.paper_success("ml10", task) for task in ("reach", "drawer-close")]
    assert [row[2] for row in rows[2:]] == [f"{value:.1f}" for value in (*paper, sum(paper) / 2)]


def test_base_and_novel_tasks_have_means_of_their_own_and_columns_are_aligned():
    successes = {"reach": [True], "window-open": [True], "door-close": [False]}
    table = report.success_table({"ours": successes}, "ml10").splitlines()
    assert len({len(line) for line in table}) == 1
    means = {line.split("|")[1].strip(): line.split("|")[2].split()[0] for line in table[5:]}
    assert means == {"**mean of base**": "100.0", "**mean of novel**": "0.0"}
    assert "**mean** " in report.success_table({"ours": successes})  # of no suite


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
    written = json.loads(Path("report/success.json").read_text())
    trained = json.loads((run / "success.json").read_text())
    label = "ml10-tiny-seed0/ema-00006"
    assert written["successes"] == {label: trained["successes"]["last checkpoint"]}
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
        env = args[1][0]
        return rollout(*args[:6], lambda: frames.append(env.observe()["point_cloud"]))

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

    evaluate.load_policy(str(run / "ema-00006.pt"), "cpu", {})
    alone = job("reach", 1)
    for task, episode in [("reach", 0), ("drawer-close", 0), ("reach", 1)]:
        later = job(task, episode)
    assert len(alone) == 5 and np.array_equal(alone, later)


def test_known_goals_are_those_of_the_demonstrations(run, recorded, monkeypatch, capsys):
    jobs = []
    monkeypatch.setattr(evaluate, "run_jobs", lambda job, given, *_: jobs.extend(given) or [])
    paths, text = {"reach": recorded / "reach.npz"}, {"reach": torch.zeros(512)}
    evaluate.evaluate(run / "ema-00006.pt", paths, text, episodes=20, known_goals=True)
    known = data.load_demonstrations(paths["reach"]).meta["episode_seeds"]
    assert [seed for *_, seeds, _ in jobs for seed in seeds] == known and len(known) < 20
    assert "leave out --swap" in fails(
        evaluate, evaluating(run, recorded, "--known-goals --swap instruction"), capsys
    )


def test_inputs_are_swapped_with_those_of_the_next_task_or_left_out(
    run, recorded, monkeypatch, capsys
):
    calls = []

    def measured(checkpoint, paths, text, episodes, seed, workers, device, n, blank, _, **changed):
        calls.append(({t: path.stem for t, path in paths.items()}, text, blank, changed))
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
    without = "--without demonstration instruction --episodes 2 --out without --n-action-steps 4"
    evaluate.main(evaluating(run, recorded, without))
    assert calls[0][2:] == (True, {"n_action_steps": 4}) and all(
        not text.any() for text in calls[0][1].values()
    )
    written = json.loads(Path("without/success.json").read_text())
    assert written["facts"]["without"] == "demonstration and instruction"
    assert written["facts"]["n_action_steps"] == 4 and "sampler" not in written["facts"]
    assert "--swap needs" in fails(
        evaluate, evaluating(run, recorded, f"--task reach {swap}"), capsys
    )


def test_a_rollout_can_be_watched(run, recorded, monkeypatch, capsys):
    monkeypatch.setattr(simulator, "EPISODE_STEPS", 24)
    evaluate.main(evaluating(run, recorded, "--task reach --gif reach.gif"))
    assert Path("reach.gif").read_bytes().startswith(b"GIF8")
    assert Path("reach.gif").stat().st_size > 10_000
    printed = capsys.readouterr()
    assert "wrote reach.gif" in printed.out
    assert "rolling out: 24step" in printed.err and "drawing: 100%" in printed.err


def test_an_adapted_policy_is_watched_from_its_folder(run, recorded, monkeypatch, capsys):
    seen = []
    monkeypatch.setattr(
        evaluate, "write_gif", lambda policy, sampler, *_: seen.append(sampler.task)
    )
    info = torch.load(run / "ema-00006.pt", weights_only=True)
    Path("all/door-close").mkdir(parents=True)
    torch.save(info | {"adapted_to": "door-close"}, "all/door-close/adapted.pt")
    argv = ["--data", str(recorded), *"--demonstrations 2 --gif door.gif --checkpoint".split()]
    evaluate.main([*argv, "all/door-close"])
    assert seen == ["door-close"] and "is novel" not in capsys.readouterr().out
    assert "holds no checkpoint: name all/door-close" in fails(evaluate, [*argv, "all"], capsys)
    evaluate.main([*argv, str(run), "--task", "door-close"])
    assert "door-close is novel to this policy: `python finetune.py" in capsys.readouterr().out


def test_a_movie_is_written_by_what_is_there(monkeypatch):
    assert evaluate.movie_writer("x.gif").fps == evaluate.FPS
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ValueError, match="install ffmpeg or `pip install imageio-ffmpeg`"):
        evaluate.movie_writer("x.mp4")
    package = SimpleNamespace(get_ffmpeg_exe=lambda: sys.executable)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", package)
    assert evaluate.movie_writer("x.mp4").bin_path() == sys.executable
    with pytest.raises(ValueError, match="there is no such folder"):
        evaluate.movie_writer("none/x.gif")


def test_a_folder_stands_for_its_last_checkpoint(run):
    info = scripts.load_checkpoint(run)[1]
    assert info["step"] == 6 and len(scripts.checkpoints_of(run)) == 2
    for step in (99_000, 100_000):
        Path(f"ema-{step:05d}.pt").touch()
    assert scripts.checkpoints_of(".")[-1].name == "ema-100000.pt"


TABLE = """
<mujoco>
  <worldbody>
    <camera name="corner" pos="0 -1 1" xyaxes="1 0 0 0 1 1" fovy="50"/>
    <geom name="table" type="box" pos="0 0 -0.02" size="1 1 0.01"/>
    <body name="hand">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="y" type="slide" axis="0 1 0"/>
      <geom type="sphere" size="0.08" pos="0 0 0.1" mass="1"/>
    </body>
    <site name="goal" type="sphere" size="0.05" pos="0 0 0.1" rgba="1 0 0 1"/>
  </worldbody>
</mujoco>
"""


class Table:
    """A hand on a table, in MuJoCo but not in Meta-World: the three methods of `Environment`."""

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(TABLE)
        self.data = mujoco.MjData(self.model)
        box = ((-0.5, -0.5, 0.0), (0.5, 0.5, 0.3))
        self.camera = simulator.RayCastCamera(self.model, 40, box, "corner")

    def reset(self, *, seed):
        mujoco.mj_resetData(self.model, self.data)
        self.steps, self.goal = 0, np.random.default_rng(seed).uniform(0.2, 0.3, 2)
        self.model.site("goal").pos[:2] = self.goal
        return self.observe(), {}

    def advance(self, action):
        self.data.qpos += 0.02 * np.clip(action, -1, 1)
        self.steps += 1
        near = bool(np.abs(self.data.qpos - self.goal).max() < 0.03)
        return 0.0, self.steps >= 40, {"success": near}

    def observe(self):
        mujoco.mj_forward(self.model, self.data)
        cloud = data.farthest_point_sample(self.camera.points(self.data), 64)
        return {"point_cloud": cloud, "agent_pos": self.data.qpos.astype(np.float32)}


def test_your_own_simulator_is_rolled_out_in(monkeypatch):
    env: evaluate.Environment = Table()
    frames, ends = [], [20, 40]
    for seed in (0, 1):
        observation, _ = env.reset(seed=seed)
        for _ in range(20):
            action = (50 * (env.goal - observation["agent_pos"])).clip(-1, 1)
            frames.append((observation["point_cloud"], observation["agent_pos"], action))
            env.advance(action)
            observation = env.observe()
    points, state, action = (np.stack(x).astype(np.float32) for x in zip(*frames))
    recorded = data.Demonstrations("go", "Go there.", points, state, action, np.array(ends), {})
    assert recorded.problem() is None
    goals = points[points[..., 0] > 0.12]  # not the hand where it begins, but the marker
    assert len(goals) and np.abs(goals[:, 2] - 0.1).max() < 0.15

    policy = model.DAMIPolicy(replace(model.PRESETS["tiny"], state_dim=2, action_dim=2))
    sampler, text = data.WindowSampler(recorded, policy.config), torch.zeros(512)
    envs, seen = [Table(), Table()], []

    def rollout():
        generator = torch.Generator().manual_seed(0)
        how = sampler, text, generator, lambda: seen.append(envs[0].steps)
        return evaluate.rollout(policy, envs, [5, 6], *how)

    assert all(type(success) is bool for success in rollout())
    assert all(env.steps <= 40 for env in envs) and seen == list(range(0, envs[0].steps, 8))

    def toward(points, state, context, generator):
        goals = torch.tensor(np.array([env.goal for env in envs])).float()
        return (50 * (goals - state[:, -1])).clip(-1, 1)[:, None].expand(-1, 8, -1)

    monkeypatch.setattr(policy, "sample_actions", toward)
    assert rollout() == [True, True] and all(env.steps < 40 for env in envs)
    monkeypatch.setattr(policy, "sample_actions", lambda *a: -toward(*a))
    assert rollout() == [False, False] and all(env.steps == 40 for env in envs)

    policy = model.DAMIPolicy(replace(policy.config, n_action_steps=1))  # one of two frames is old
    seen.clear()
    rollout()
    assert seen == list(range(envs[0].steps))


def watched_rollout(monkeypatch, env, **how):
    """40 steps away from the goal; the demonstrations and the frames that the policy is given."""
    policy, demonstrations, frames = model.DAMIPolicy(model.PRESETS["tiny"]), [], []

    def away(points, state, context, generator):
        frames.append({"point_cloud": points[0].numpy(), "agent_pos": state[0].numpy()})
        return -torch.ones(1, 8, 2)

    monkeypatch.setattr(policy, "encode_demo", lambda text, **demo: demonstrations.append(demo))
    monkeypatch.setattr(policy, "sample_actions", away)
    sampler = data.WindowSampler(numbered([40]), policy.config)
    given = sampler, torch.zeros(512), torch.Generator()
    assert evaluate.rollout(policy, [env], [5], *given, **how) == [False]
    return demonstrations, frames


def test_a_rollout_shows_the_policy_the_older_frame_first_and_the_newest_last(monkeypatch):
    env, observed = Table(), {}
    observe = env.observe
    monkeypatch.setattr(env, "observe", lambda: observed.setdefault(env.steps, observe()))
    _, frames = watched_rollout(monkeypatch, env)
    for newest, found in zip(range(0, 40, 8), frames, strict=True):
        older = max(newest - 1, 0)
        for part, x in found.items():
            np.testing.assert_array_equal(x, [observed[step][part] for step in (older, newest)])


def test_a_demonstration_that_is_left_out_of_a_rollout_is_all_zeros(monkeypatch):
    (shown,), _ = watched_rollout(monkeypatch, Table())
    (left_out,), _ = watched_rollout(monkeypatch, Table(), blank=True)
    assert shown["demo_points"].any() and shown["demo_action"].any()
    for part, x in shown.items():
        assert torch.equal(left_out[part], torch.zeros_like(x))


class Corridor:
    """A robot that goes one step ahead whatever it is told, and is there after `length` steps."""

    def __init__(self, length):
        self.length = length

    def reset(self, *, seed):
        self.steps = 0
        return self.observe(), {}

    def advance(self, action):
        self.steps += 1
        return 0.0, False, {"success": self.steps >= self.length}

    def observe(self):
        state = np.full(9, self.steps, np.float32)
        state[0] = self.length  # tells the rollout
        return {"point_cloud": np.ones((64, 3), np.float32), "agent_pos": state}


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
    assert successes == [True] * 5

    again = torch.Generator().manual_seed(3)  # all are drawn before any noise
    drawn = [sampler.draw_episode(again) for _ in long]
    assert len(set(drawn)) >= 3  # the seed is such that they differ
    assert read == {n: [episode] * -(-n // 8) for n, episode in zip(long, drawn)}


# ---- Bad input -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options, message",
    [
        ("--checkpoint none.pt", "none.pt"),
        ("--episodes 0", "--episodes is 0: use at least 1"),
        ("--gif reach.gif", "name its task"),
        ("--task reach --gif reach.avi", "name it .gif or .mp4"),
        ("--task reach --gif reach.gif --known-goals", "leave out --known-goals"),
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
    torch.save(info | {"adaptation": {"instruction": False}}, "untold.pt")
    message = fails(evaluate, [*argv, run, "untold.pt"], capsys)
    assert "untold.pt: with --no-instruction or without" in message


def test_a_policy_of_own_recordings_cannot_be_rolled_out(run, recorded, capsys):
    info = torch.load(run / "ema-00006.pt", weights_only=True)
    torch.save(info | {"suite": "own"}, "own.pt")
    message = fails(evaluate, ["--checkpoint", "own.pt", "--data", recorded], capsys)
    assert "no simulator" in message


# ---- Held-out episodes ---------------------------------------------------------------------------


def numbered(lengths, frames=None):
    """A recording whose actions tell the episode and the frame: 10 e + 0.01 t."""
    counts = [np.full(n, 10 * e) + 0.01 * np.arange(n) for e, n in enumerate(lengths)]
    action = np.repeat(np.concatenate(counts)[:, None], 4, axis=1).astype(np.float32)
    points = np.random.default_rng(0).normal(size=(len(action), 64, 3)).astype(np.float16)
    state = np.zeros((len(action), 9), np.float32)
    meta = {} if frames is None else {"success_frames": frames}
    ends = np.cumsum(lengths)
    return data.Demonstrations("stir", "Stir.", points, state, action, ends, meta)


def test_the_last_episodes_are_held_out():
    recorded = numbered([30, 20, 40, 25], frames=[1, 2, 3, 4]).take(3)
    kept, held = evaluate.hold_out({"stir": recorded}, 2)
    assert kept["stir"].episode_ends.tolist() == [30] and len(kept["stir"].action) == 30
    assert held["stir"].episode_ends.tolist() == [20, 60] and held["stir"].problem() is None
    assert held["stir"].meta["success_frames"] == [2, 3]
    np.testing.assert_array_equal(held["stir"].action, recorded.action[30:90])
    assert evaluate.hold_out({"stir": recorded}, 0)[1] == {}
    with pytest.raises(ValueError, match="stir has 3 episodes: use a --held-out below that"):
        evaluate.hold_out({"stir": recorded}, 3)


def test_the_action_error_is_the_mean_absolute_error_over_executed_chunks(monkeypatch):
    policy = model.DAMIPolicy(model.PRESETS["tiny"])
    kept, held = evaluate.hold_out({"stir": numbered([30, 40, 12])}, 2)
    shown, unseen = (data.WindowSampler(part["stir"], policy.config) for part in (kept, held))
    shown_to, drawn = [], []

    def draw(points, state, context, generator):
        shown_to.append(context)
        drawn.append(torch.full((len(points), 8, 4), 10.5))
        return drawn[-1]

    monkeypatch.setattr(policy, "sample_actions", draw)
    monkeypatch.setattr(policy, "encode_demo", lambda text, demo_action, **_: demo_action)
    error, plain = evaluate.action_error(policy, shown, unseen, torch.zeros(512))
    # Episode 1: chunks at 0, 8, 16, 24, 32; episode 2 has 12 frames: at 0, and half a one at 8.
    first, second = 10 + 0.01 * np.arange(40), 20 + 0.01 * np.arange(12)
    assert [len(chunks) for chunks in drawn] == [5, 2]
    actions = np.concatenate([first, second])
    assert error == pytest.approx(np.abs(actions - 10.5).mean(), rel=1e-4)
    assert plain == pytest.approx(np.abs(actions - 0.01 * 14.5).mean(), rel=1e-4)
    assert all((demo < 10).all() for demo in shown_to)  # an episode that was trained on


def test_a_policy_that_fits_its_demonstrations_has_a_small_action_error():
    """A policy that has learned one episode draws it; an untrained one does not."""
    config = replace(model.PRESETS["tiny"], demo_encoder="none", tcfm="none", inference_steps=2)
    torch.manual_seed(0)
    policy, recorded = model.DAMIPolicy(config), numbered([40, 40])
    recorded.state[:] = np.linspace(-1, 1, 40).repeat(1)[np.arange(80) % 40][:, None]
    recorded.points[40:], recorded.action[40:] = recorded.points[:40], recorded.action[:40]
    kept, held = evaluate.hold_out({"stir": recorded}, 1)
    shown, unseen = (data.WindowSampler(part["stir"], config) for part in (kept, held))
    policy.normalizer.fit(shown.points, shown.state, shown.action)
    before, plain = evaluate.action_error(policy, shown, unseen, torch.zeros(512))
    adapting = finetune.adapt_policy(
        policy, shown, torch.zeros(512), 80, 16, dict.fromkeys(finetune.LEARNING_RATES, 5e-3)
    )
    *_, (_, _, adapted) = adapting
    after, _ = evaluate.action_error(adapted, shown, unseen, torch.zeros(512))
    assert after < 0.3 * plain < before


def test_checkpoints_are_judged_on_episodes_that_no_training_saw(run, recorded, own_folder, capsys):
    held = {task: data.load_demonstrations(recorded / f"{task}.npz") for task in BASE}
    shown = {task: demonstrations.take(1) for task, demonstrations in held.items()}
    for task, demonstrations in shown.items():
        data.save_demonstrations(own_folder / f"{task}.npz", demonstrations)
    folders = ["--data", str(own_folder), "--unseen", str(recorded)]
    tests.unseen.main([str(run), str(run / "ema-00006.pt"), *folders])
    rows = [line.split("|")[1:-1] for line in capsys.readouterr().out.splitlines()[2:]]
    files = [run / "ema-00003.pt", *2 * [run / "ema-00006.pt"]]
    assert [Path(row[0].strip()) for row in rows] == files
    policy, info = scripts.load_checkpoint(files[-1])
    text, _ = scripts.instruction_features(shown, None, info["text_weights"], "cpu")
    shown, held = (scripts.windows(part, policy.config) for part in (shown, held))
    errors = [evaluate.action_error(policy, shown[t], held[t], text[t]) for t in BASE]
    expected = [f"{mean:.4f}" for mean in np.mean(errors, axis=0)]
    assert [cell.strip() for cell in rows[-1][1:]] == expected and rows[1] == rows[2] != rows[0]
