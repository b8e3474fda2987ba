"""Success rates: rollouts in Meta-World, in parallel processes, and animations of them.

    python evaluate.py                                       # base tasks, the newest run
    python evaluate.py --checkpoint runs/a runs/b --top 5    # all checkpoints of two runs
    python evaluate.py --task reach --gif reach.gif          # watch one rollout (.mp4 too)
    python evaluate.py --without instruction --swap demonstration    # is the demonstration read?

An episode succeeds if any of its 200 steps reports success, so a rollout ends there. Each rollout
holds one reference demonstration, drawn from the task's own. Goals come from seeds that no
demonstration uses. Nothing is adapted here: novel tasks are finetune.py's.

One action, from the network to the simulated arm: `rollout` keeps two frames of each episode,
`DAMIPolicy.sample_actions` draws a chunk of actions, `MetaWorldPointCloudEnv.advance` takes them.

Letters: E episodes rolled out side by side, To observation steps, Ta executed actions,
N points, A action dim, S state dim.
"""

import argparse
import json
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

import data
import scripts
from data import Demonstrations, WindowSampler, load_demonstrations, write_atomically
from model import DAMIPolicy
from report import Successes, mean_interval, mean_success, parts_of, write_report
from scripts import (
    at_least,
    checkpoints_of,
    command_line,
    format_table,
    load_checkpoint,
    run_jobs,
    worker,
    write_text,
)
from simulator import MetaWorldPointCloudEnv, check_task, collect, evaluation_seed, suite_tasks

EVALUATION_SEED = 0  # of the goals; the same for every seed of training
EPISODES_A_JOB = 10  # side by side in one process; part of the protocol: it shapes the noise drawn
SHIPPED_CHECKPOINT = Path(__file__).parent / "assets" / "ml10-small.pt"
TRAINED = ("suite", "preset", "arguments", "text_weights", "step")  # what train.py's files say

# ---- What to measure, and on what ----------------------------------------------------------------


def default_checkpoint(suite: str, runs: str | Path = "runs") -> Path:
    """The last checkpoint of the newest finished run on `suite`; without any, the one that ships.

    Runs of `tiny` do not count: they show that everything works, and succeed nearly nowhere.
    """
    finished = []
    for config in Path(runs).glob("*/config.json"):
        with suppress(OSError, ValueError, KeyError, TypeError):  # of a damaged file
            arguments = json.loads(config.read_text())["arguments"]
            last = config.parent / f"ema-{arguments['steps']:05d}.pt"
            if arguments["suite"] == suite and arguments["preset"] != "tiny" and last.is_file():
                finished.append(last)
    if finished:
        return max(finished, key=lambda path: path.stat().st_mtime)
    if suite != "ml10" or not SHIPPED_CHECKPOINT.is_file():
        raise ValueError(
            f"no finished run on {suite} in {runs}/: train one, or name a --checkpoint"
        )
    print(f"no finished run in {runs}/: using the policy that comes with the code", flush=True)
    return SHIPPED_CHECKPOINT


# ---- Rollouts ------------------------------------------------------------------------------------


class Environment(Protocol):
    """What `rollout` asks of a simulator: Meta-World's, or your own with these three methods.

    An observation holds "point_cloud" (N, 3) and "agent_pos" (S,), both float32, as the policy was
    trained on them. simulator.RayCastCamera makes clouds of any MuJoCo model.
    """

    def reset(self, *, seed: int) -> tuple[dict[str, np.ndarray], dict]:
        """Begins the episode of a seed; returns (observation, info)."""

    def advance(self, action: np.ndarray) -> tuple[float, bool, dict]:
        """Takes one step with an action (A,); returns (reward, truncated, {"success": bool}).

        After a success, or `truncated`, it is not called again.
        """

    def observe(self) -> dict[str, np.ndarray]:
        """The observation of the present moment."""


def rollout(
    policy: DAMIPolicy,
    envs: Sequence[Environment],
    seeds: Sequence[int],
    sampler: WindowSampler,
    text: Tensor,
    generator: torch.Generator,
    on_chunk: Callable[[], None] | None = None,
    blank: bool = False,
) -> list[bool]:
    """Rolls out E episodes of one task side by side, and says which of them succeeded.

    The demonstrations are encoded once. The policy reads To frames in every Ta: in the others no
    ray is cast.

    Args:
        policy: in evaluation mode.
        envs, seeds: E simulators, see `Environment`, and the seeds of their goals.
        sampler: of the task's demonstrations, from which one a rollout is drawn.
        text: instruction feature, (text_dim,).
        generator: draws demonstrations and noise; on the CPU.
        on_chunk: called before each round of chunks.
        blank: the policy sees zeros in place of its demonstration.

    Returns:
        E booleans.
    """
    To, device = policy.config.n_obs_steps, text.device

    # One reference demonstration a rollout, held. All are drawn before any noise is; they are
    # encoded one at a time, since they may differ in length.
    demos = [sampler.demonstration(sampler.draw_episode(generator)) for _ in envs]
    if blank:
        demos = [{name: torch.zeros_like(x) for name, x in demo.items()} for demo in demos]
    with torch.no_grad():
        contexts = [policy.encode_demo(text[None], **demo) for demo in demos]

    frames = [[env.reset(seed=seed)[0]] * To for env, seed in zip(envs, seeds)]  # the first, twice
    success, running = [False] * len(envs), list(range(len(envs)))
    while running:
        points = np.stack([[f["point_cloud"] for f in frames[e]] for e in running])  # (E, To, N, 3)
        state = np.stack([[f["agent_pos"] for f in frames[e]] for e in running])  # (E, To, S)
        if on_chunk is not None:
            on_chunk()

        chunks = sample_chunks(
            policy,
            torch.from_numpy(points).to(device),
            torch.from_numpy(state).to(device),
            [contexts[e] for e in running],
            generator,
        )  # (E, Ta, A)

        for e, chunk in zip(list(running), chunks):
            for step, action in enumerate(chunk, start=1):
                _, truncated, info = envs[e].advance(action)
                success[e] = success[e] or info["success"]
                if success[e] or truncated:  # a later step cannot undo a success
                    running.remove(e)
                    break
                if step > len(chunk) - To:
                    frames[e] = [*frames[e], envs[e].observe()][-To:]
    return success


def sample_chunks(
    policy: DAMIPolicy,
    points: Tensor,
    state: Tensor,
    contexts: Sequence,
    generator: torch.Generator,
) -> np.ndarray:
    """Action chunks (E, Ta, A) for observations (E, To, N, 3), (E, To, S) and one context each."""
    if contexts[0] is None:  # this architecture reads no task
        return policy.sample_actions(points, state, None, generator).cpu().numpy()
    if len({context[0].shape for context in contexts}) > 1:  # demonstrations of different lengths
        each = [
            policy.sample_actions(p[None], s[None], context, generator)
            for p, s, context in zip(points, state, contexts)
        ]
        return torch.cat(each).cpu().numpy()
    context = tuple(torch.cat(parts) for parts in zip(*contexts))
    return policy.sample_actions(points, state, context, generator).cpu().numpy()


# ---- Without a simulator: held-out episodes ------------------------------------------------------


def hold_out(
    recorded: dict[str, Demonstrations], n: int
) -> tuple[dict[str, Demonstrations], dict[str, Demonstrations]]:
    """Parts each recording, by task, into all but its last n episodes, and those; n = 0: no others.

    Raises ValueError where nothing would be left to train on.
    """
    kept, held = {}, {}
    for task, whole in recorded.items():
        kept[task], heldout = data.hold_out(whole, n)
        if heldout is not None:
            held[task] = heldout
    return kept, held


@torch.no_grad()
def action_error(
    policy: DAMIPolicy, shown: WindowSampler, unseen: WindowSampler, text: Tensor, seed: int = 0
) -> tuple[float, float]:
    """How far drawn actions are from an expert's: mean absolute error, in the action's unit.

    Whole episodes are gone through as in a rollout, from one executed chunk of Ta actions to the
    next, but the policy sees the expert's frames: so errors do not add up. The mean is over the
    frames of all episodes and the A numbers of an action.

    Args:
        policy: in any mode.
        shown: the episodes trained on; one of them is the reference demonstration.
        unseen: the episodes to judge by.
        text: instruction feature, (text_dim,).
        seed: of references and noise.

    Returns:
        The error, and that of always doing the mean action of `shown`, to compare it with.
    """
    generator, errors, plain = torch.Generator().manual_seed(seed), [], []
    To, Ta = policy.config.n_obs_steps, policy.config.n_action_steps
    for episode in unseen.episodes:
        demo = shown.demonstration(shown.draw_episode(generator))
        context = policy.encode_demo(text[None], **{k: x.to(text.device) for k, x in demo.items()})
        newest = torch.arange(episode.start, episode.stop, Ta)[:, None]  # (n, 1) frames
        seen = (newest + torch.arange(1 - To, 1)).clamp(episode.start)  # (n, To)
        done = newest + torch.arange(Ta)  # (n, Ta), the last of them perhaps beyond the episode
        inside = done < episode.stop
        points, state = unseen.points[seen].float(), unseen.state[seen]
        both = points.to(text.device), state.to(text.device)
        drawn = policy.sample_actions(*both, context, generator)  # (n, Ta, A)
        acted = unseen.action[done[inside]]  # (frames, A)
        errors.append((drawn.to(acted.device)[inside] - acted).abs().flatten())
        plain.append((shown.action.mean(dim=0).to(acted.device) - acted).abs().flatten())
    return torch.cat(errors).mean().item(), torch.cat(plain).mean().item()


def judge(
    folder: Path,
    step: int,
    policy: DAMIPolicy,
    shown: dict[str, WindowSampler],
    unseen: dict[str, WindowSampler],
    text: dict[str, Tensor],
) -> str:
    """Logs the action errors on held-out episodes, of which there may be none.

    Returns a table, also in held-out.md: a row a task, the errors at the first and last step that
    was judged so far, and those of always doing the mean action.
    """
    if not unseen:
        return ""
    found = {task: action_error(policy, shown[task], unseen[task], text[task]) for task in unseen}
    errors = {task: error for task, (error, _) in found.items()}
    mean = float(np.mean(list(errors.values())))
    scripts.log(folder, step=step, action_error=mean, action_errors=errors)

    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    columns = {line["step"]: line["action_errors"] for line in lines if "action_errors" in line}
    columns = {f"step {k}": columns[k] for k in sorted({min(columns), step})}
    columns["the mean action"] = {task: error for task, (_, error) in found.items()}
    rows = [[task, *(f"{errors[task]:.4f}" for errors in columns.values())] for task in found]
    if len(rows) > 1:
        means = [f"{np.mean(list(errors.values())):.4f}" for errors in columns.values()]
        rows.append(["**mean**", *means])
    table = format_table([["held-out action error", *columns], *rows])
    write_text(folder / "held-out.md", f"{table}\n\nMean absolute error, in the action's unit.\n")
    return table


# ---- Evaluation in worker processes --------------------------------------------------------------

loaded: dict[str, Any] = {}  # what a worker process keeps between jobs: policy and environments


def load_policy(checkpoint: str, device: str, changed: dict[str, Any]) -> None:
    """Sets up a worker process."""
    loaded.update(policy=load_checkpoint(checkpoint, device, **changed)[0], task=None)


def rollout_job(
    task: str,
    data: str,
    n_demonstrations: int | None,
    text: np.ndarray,
    seeds: list[int],
    blank: bool = False,
) -> list[bool]:
    """Rolls out the episodes of these seeds, of one task, in a worker process."""
    policy = loaded["policy"]
    device = policy.normalizer.action_scale.device
    if loaded["task"] != task:
        demonstrations = load_demonstrations(data).take(n_demonstrations)
        sampler = WindowSampler(demonstrations, policy.config, device=device)
        loaded.update(task=task, sampler=sampler, envs=[])
    while len(loaded["envs"]) < len(seeds):
        loaded["envs"].append(MetaWorldPointCloudEnv(task, policy.config.num_points))

    def on_chunk() -> None:
        if worker.stop.is_set():  # Ctrl-C in the starting process
            raise InterruptedError("evaluation was interrupted")

    envs, generator = loaded["envs"][: len(seeds)], torch.Generator().manual_seed(seeds[0])
    text = torch.from_numpy(text).to(device)
    success = rollout(policy, envs, seeds, loaded["sampler"], text, generator, on_chunk, blank)
    worker.finished.put((task, len(seeds)))
    return success


def evaluate(
    checkpoint: str | Path,
    demonstrations: dict[str, Path],
    text: dict[str, Tensor],
    episodes: int = 20,
    seed: int = 0,
    workers: int | None = None,
    device: str | torch.device = "cpu",
    n_demonstrations: int | None = None,
    blank: bool = False,
    known_goals: bool = False,
    **changed: Any,
) -> Successes:
    """Rolls a checkpoint out on Meta-World tasks in parallel processes.

    Args:
        checkpoint: a file of train.py or finetune.py.
        demonstrations: task -> file with its demonstrations.
        text: task -> instruction feature, (text_dim,).
        episodes: rollouts a task; episode i has the goal of `evaluation_seed(seed, i)`.
        seed: chooses goals, noise and reference demonstrations.
        workers: processes, by default one a core.
        device: where the policy runs.
        n_demonstrations: use only the first so many of each file; None: all.
        blank: the policy sees zeros in place of its demonstration.
        known_goals: those of the demonstrations instead, at most `episodes` of them.
        changed: of the policy's configuration, for the rollouts, see `scripts.inference`.

    Returns:
        task -> E booleans, in the order of the episodes. They do not depend on `workers`.
    """
    at_least(1, episodes=episodes)
    jobs, total = [], 0
    for task, path in demonstrations.items():
        seeds = [evaluation_seed(seed, i) for i in range(episodes)]
        if known_goals:
            seeds = load_demonstrations(path).meta["episode_seeds"][:n_demonstrations][:episodes]
        how = task, str(path), n_demonstrations, text[task].cpu().numpy()
        starts = range(0, len(seeds), EPISODES_A_JOB)
        jobs += [(*how, seeds[start : start + EPISODES_A_JOB], blank) for start in starts]
        total += len(seeds)
    setup = (load_policy, str(checkpoint), str(device), changed)
    found = run_jobs(rollout_job, jobs, workers, total, "evaluating", setup)

    results: Successes = {task: [] for task in demonstrations}
    for (task, *_), successes in zip(jobs, found):
        results[task] += successes
    return results


def evaluate_step(
    folder: Path,
    step: int,
    settings: Any,
    stop: scripts.StopRequest,
    paths: dict[str, Path],
    text: dict[str, Tensor],
    *others: Any,
) -> Successes | None:
    """`evaluate` of a run's checkpoint where that is due, logged, unless it was done before.

    `settings` are those of train.py, `others` come after `seed`. Ctrl-C stops it at once.
    """
    due = step == settings.steps or (step and step % settings.evaluate_every == 0)
    if not settings.episodes or not due:
        return None
    for line in (folder / "metrics.jsonl").read_text().splitlines():
        values = json.loads(line)
        if values["step"] == step and "successes" in values:
            return values["successes"]
    protocol = settings.episodes, EVALUATION_SEED, *others
    with stop.at_once():  # everything is saved
        successes = evaluate(folder / f"ema-{step:05d}.pt", paths, text, *protocol)
    scripts.log(folder, step=step, success=mean_success(successes), successes=successes)
    return successes


# ---- Animations ----------------------------------------------------------------------------------

FPS = 30


def write_gif(
    policy: DAMIPolicy, sampler: WindowSampler, text: Tensor, seed: int, path: str | Path
) -> bool:
    """Rolls out one episode and animates every second step: the picture, and what the policy sees.

    Returns whether the episode succeeded.
    """
    from matplotlib.animation import FuncAnimation
    from matplotlib.figure import Figure

    writer = movie_writer(path)
    env = MetaWorldPointCloudEnv(sampler.task, policy.config.num_points, render_mode="rgb_array")
    frames, advance = [], env.advance

    def film(action: np.ndarray) -> tuple:
        if env.steps % 2 == 0:
            frames.append((env.render(), env.cloud()))
        progress.update()
        return advance(action)

    env.advance = film
    goal = evaluation_seed(seed, 0)
    generator = torch.Generator().manual_seed(goal)
    with scripts.progress_bar(desc="rolling out", unit="step") as progress:
        (success,) = rollout(policy, [env], [goal], sampler, text, generator)
    frames.append((env.render(), env.cloud()))  # how it ended

    clouds = np.concatenate([cloud for _, cloud in frames])
    low, high = clouds.min(0), clouds.max(0)
    figure = Figure(figsize=(6, 3), layout="constrained")
    left = figure.add_subplot(1, 2, 1)
    right = figure.add_subplot(1, 2, 2, projection="3d")

    def draw(index: int) -> None:
        picture, cloud = frames[index]
        left.clear()
        right.clear()
        left.imshow(picture)
        left.set_axis_off()
        left.set_title(f"{sampler.task}: {'success' if success else 'failure'}", fontsize=9)
        right.scatter(*cloud.T, c=cloud[:, 2], cmap="viridis", vmin=low[2], vmax=high[2], s=9)
        right.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        right.set(xticklabels=[], yticklabels=[], zticklabels=[])
        right.set_box_aspect(high - low)
        right.view_init(elev=25, azim=-30)
        step = min(2 * index, env.steps)
        right.set_title(f"{policy.config.num_points} points, step {step}", fontsize=9)

    shown = [*range(len(frames)), *[len(frames) - 1] * 10]  # the end stays a while
    animation = FuncAnimation(figure, draw, frames=shown)
    with scripts.progress_bar(desc="drawing", unit="frame", total=len(shown)) as progress:
        how = {"writer": writer, "dpi": 70, "progress_callback": lambda *_: progress.update()}
        write_atomically(path, lambda name: animation.save(name, **how))
    return success


def movie_writer(path: str | Path) -> Any:
    """What writes a .gif, or an .mp4 where there is ffmpeg, or the package imageio-ffmpeg with it.

    Raises ValueError for any other file, one of no folder, or where there is neither.
    """
    import matplotlib
    from matplotlib.animation import FFMpegWriter, PillowWriter

    path, problem = Path(path), "name it .gif or .mp4"
    if not path.resolve().parent.is_dir():
        problem = "there is no such folder"
    elif path.suffix == ".gif":
        return PillowWriter(fps=FPS)
    elif path.suffix == ".mp4":
        with suppress(ImportError):
            ffmpeg = import_module("imageio_ffmpeg").get_ffmpeg_exe()
            matplotlib.rcParams["animation.ffmpeg_path"] = ffmpeg
        if FFMpegWriter.isAvailable():
            return FFMpegWriter(fps=FPS)
        problem = "install ffmpeg or `pip install imageio-ffmpeg`, or name it .gif"
    raise ValueError(f"cannot write {path}: {problem}")


# ---- Command line --------------------------------------------------------------------------------


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Measures success in Meta-World.")
    add = parser.add_argument
    add("--checkpoint", nargs="+", help="files or run folders (default: the newest run's last)")
    add("--suite", help="ml10 or ml45 (default: the checkpoint's, or ml10)")
    add("--split", choices=("base", "novel", "all"), default="base", help="which of its tasks")
    add("--task", nargs="+", help="only these tasks, of any suite")
    add("--data", default="data", help="folder of the demonstrations (default: data)")
    add("--demonstrations", type=int, default=10, help="demonstrations a task (default: 10)")
    add("--episodes", type=int, default=20, help="episodes a task (default: 20)")
    add(
        "--top", type=int, default=0, help="all checkpoints of a run; also the mean of the best TOP"
    )
    parts = {"nargs": "+", "choices": ("demonstration", "instruction"), "default": []}
    add("--swap", **parts, help="measure also with these of another task")
    scripts.add_inference_flags(add)
    add("--without", **parts, help="leave these out: zeros in their place")
    add("--seed", type=int, default=0, help="of goals, noise and demonstrations (default: 0)")
    add("--known-goals", action="store_true", help="those of the demonstrations, not new ones")
    add("--out", default="runs/evaluation", help="folder of the report (default: runs/evaluation)")
    add("--overwrite", action="store_true", help="replace the report in that folder")
    scripts.add_common_flags(add)
    add("--gif", metavar="FILE", help="animate one rollout instead, .gif or .mp4")
    return parser.parse_args(argv)


def choose_tasks(args: argparse.Namespace, suite: str, info: dict[str, Any]) -> list[str]:
    """The tasks to measure: --task, the one a policy was adapted to, or those of the split."""
    adapted = info.get("adapted_to")
    if args.task and adapted and args.task != [adapted]:
        raise ValueError(f"this policy was adapted to {adapted}, not to {' '.join(args.task)}")
    if args.task or adapted:
        return [check_task(task) for task in args.task or [adapted]]
    if suite == "own":
        raise ValueError("a policy of own recordings has no simulator to be measured in")
    base, novel = suite_tasks(suite)
    return {"base": base, "novel": novel, "all": base + novel}[args.split]


def of_next_task(each: dict[str, Any]) -> dict[str, Any]:
    """Every task gets what belongs to the next one, the last what belongs to the first."""
    values = list(each.values())
    return dict(zip(each, values[1:] + values[:1]))


def main(argv: list[str] | None = None) -> None:
    args = parse(argv)
    at_least(1, demonstrations=args.demonstrations, episodes=args.episodes)
    at_least(0, top=args.top)
    evaluation_seed(args.seed, 0)  # refuses a seed out of range now rather than after collecting
    if args.gif:
        movie_writer(args.gif)  # refuses a wrong name now
    device = scripts.pick_device(args.device, args.threads)

    # Which checkpoints: of each run the last, or all of them for the mean of the best
    runs = [
        checkpoints_of(path)
        for path in args.checkpoint or [default_checkpoint(args.suite or "ml10")]
    ]
    for found in runs:
        if args.top > len(found):
            raise ValueError(f"{found[-1].parent} holds {len(found)} checkpoints, fewer than --top")
    runs = [found if args.top else found[-1:] for found in runs]
    labels = {path: f"{path.resolve().parent.name}/{path.stem}" for run in runs for path in run}
    if len(set(labels.values())) < sum(map(len, runs)):
        raise ValueError("two checkpoints have the same folder and file name: rename one's folder")
    changed = scripts.inference(args)
    policy, info = load_checkpoint(runs[0][-1], device, needs=TRAINED, **changed)

    # Tasks, their demonstrations and instructions
    suite = args.suite or info["suite"]
    tasks = choose_tasks(args, suite, info)
    if args.gif and len(tasks) > 1:
        raise ValueError("--gif draws one rollout: name its task, --task reach --gif reach.gif")
    if args.gif and (args.known_goals or "demonstration" in args.without):
        raise ValueError("--gif: leave out --known-goals, and --without demonstration")
    if args.gif and "adapted_to" not in info and tasks[0] in suite_tasks(suite)[1]:
        adapt = f"python finetune.py --task {tasks[0]}"
        print(f"{tasks[0]} is novel to this policy: `{adapt}`, then --checkpoint with its folder")
    if args.swap and (len(tasks) < 2 or args.top):
        raise ValueError("--swap needs the tasks of a split, and the last checkpoint alone")
    if args.swap and args.known_goals:
        raise ValueError("--known-goals are those of a task's own demonstrations: leave out --swap")
    for checkpoint in labels:
        _, each = load_checkpoint(checkpoint, needs=TRAINED)
        if each["text_weights"] != info["text_weights"]:
            raise ValueError(f"{checkpoint} was made with text weights {each['text_weights']!r}")
        if each.get("adapted_to", tasks[0]) != tasks[0] or ("adapted_to" in each and tasks[1:]):
            raise ValueError(f"{checkpoint} was adapted to {each['adapted_to']}: measure it alone")
        if scripts.is_told(each) != scripts.is_told(info):
            raise ValueError(f"{checkpoint}: with --no-instruction or without, not both at once")
    out = Path(args.out)
    with nullcontext() if args.gif else scripts.locked(out):
        old = [] if args.gif else scripts.claim_folder(out, args.overwrite)
        paths = collect(tasks, args.data, args.demonstrations, workers=args.workers)
        n, how = args.demonstrations, (args.clip_weights, info["text_weights"], device)
        recorded = {task: load_demonstrations(path).take(n) for task, path in paths.items()}
        told = scripts.is_told(info) and "instruction" not in args.without
        text, identity = scripts.instruction_features(recorded, *how, told=told)
        for file in old:
            file.unlink()

        if args.gif:
            sampler = WindowSampler(recorded[tasks[0]], policy.config, device=device)
            success = write_gif(policy, sampler, text[tasks[0]], args.seed, args.gif)
            print(f"{tasks[0]}: {'success' if success else 'failure'}; wrote {args.gif}")
            return

        chosen = args.task or "adapted_to" in info
        facts = {"title": " ".join(tasks) if chosen else f"{suite}, {args.split} tasks"}
        facts |= {"episodes a task": args.episodes, "seed": args.seed, "text weights": identity}
        facts |= scripts.report_facts("evaluate.py", argv, device) | changed
        if args.known_goals:
            facts["goals"] = "of the demonstrations, each once"
        if args.without:
            facts["without"] = " and ".join(args.without)
        measure(args, suite, runs, labels, paths, text, device, facts)


def measure(
    args: argparse.Namespace,
    suite: str,
    runs: list[list[Path]],
    labels: dict[Path, str],
    paths: dict[str, Path],
    text: dict[str, Tensor],
    device: torch.device,
    facts: dict[str, Any],
) -> None:
    """Rolls out the checkpoints of all runs (path -> label), and reports."""
    blank = "demonstration" in args.without
    protocol = args.episodes, args.seed, args.workers, device, args.demonstrations, blank
    protocol += (args.known_goals,)
    changed = scripts.inference(args)
    results, swapped = {}, {}
    for checkpoint in labels:
        results[checkpoint] = evaluate(checkpoint, paths, text, *protocol, **changed)
        for part in args.swap:
            inputs = {"demonstration": paths, "instruction": text}
            inputs[part] = of_next_task(inputs[part])
            label = f"{labels[checkpoint]}, {part} of another task"
            swapped[label] = evaluate(checkpoint, *inputs.values(), *protocol, **changed)

    for name, part in parts_of(list(paths), suite).items():
        of_part = {path: {task: found[task] for task in part} for path, found in results.items()}
        means = [[mean_success(of_part[path]) for path in run] for run in runs]
        facts[f"{name}, last checkpoint"] = mean_interval([run[-1] for run in means])
        if args.top:
            best = [float(np.mean(sorted(run)[-args.top :])) for run in means]
            facts[f"{name}, best {args.top} checkpoints"] = mean_interval(best)
    columns = {labels[run[-1]]: results[run[-1]] for run in runs} | swapped
    all_checkpoints = {labels[path]: found for path, found in results.items()} if args.top else None
    print(f"\n{write_report(Path(args.out), columns, facts, suite, all_checkpoints)}\n")
    for name, value in facts.items():
        print(f"{name}: {value}")


if __name__ == "__main__":
    command_line(main)
