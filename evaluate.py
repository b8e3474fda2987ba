"""Success rates: rollouts in Meta-World, confidence intervals, tables, charts and animations.

    python evaluate.py                                        # base tasks of the newest run's last checkpoint
    python evaluate.py --split all                            # and the novel tasks, each after adaptation
    python evaluate.py --checkpoint runs/a runs/b --top 5     # all checkpoints of several runs (seeds): last, and best 5
    python evaluate.py --task reach --gif reach.gif           # watch one rollout

An episode succeeds if any of its 200 steps reports success, so a rollout ends there. Base tasks are evaluated by direct
inference, novel tasks after adaptation (Algorithm 2), each rollout with one reference demonstration, drawn from the
task's own and held. Goals come from seeds that no demonstration uses.

Letters: E episodes rolled out side by side, To = 2 observation steps, Ta = 8 executed actions, N points, A action dim.
"""

import argparse
import json
import math
import multiprocessing
import os
import platform
import shlex
import signal
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from data import (
    Demonstrations,
    InputError,
    MetaWorldPointCloudEnv,
    WindowSampler,
    check_task,
    collect,
    command_line,
    evaluation_seed,
    load_demonstrations,
    suite_tasks,
)
from model import DAMIPolicy, load_checkpoint, load_clip_text_encoder
from model import InputError as ModelInputError

EPISODES_A_JOB = 10  # rolled out side by side in one process; part of the protocol, since it shapes the noise drawn
PAPER_RESULTS = Path(__file__).parent / "assets" / "paper_results.json"
SHIPPED_CHECKPOINT = Path(__file__).parent / "assets" / "ml10-small.pt"

Successes = dict[str, list[bool]]  # task -> one entry an episode


# ---- Figures ---------------------------------------------------------------------------------------------------------


def wilson_interval(successes: int, episodes: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a success rate, as two fractions. Raises ValueError without episodes."""
    if episodes < 1:
        raise ValueError("an interval needs at least one episode")
    z, p = 1.959964, successes / episodes
    center = p + z**2 / (2 * episodes)
    margin = z * math.sqrt(p * (1 - p) / episodes + z**2 / (4 * episodes**2))
    scale = 1 + z**2 / episodes
    return max(0.0, (center - margin) / scale), min(1.0, (center + margin) / scale)


def format_success(successes: int, episodes: int) -> str:
    """`17 of 20` -> `85.0 [64.0, 94.8]`: percent, with the 95 % Wilson interval."""
    low, high = wilson_interval(successes, episodes)
    return f"{100 * successes / episodes:.1f} [{100 * low:.1f}, {100 * high:.1f}]"


def mean_success(successes: Successes) -> float:
    """The mean over tasks of the success rate, in percent."""
    return 100 * float(np.mean([np.mean(episodes) for episodes in successes.values()]))


# ---- Preparation -----------------------------------------------------------------------------------------------------


def pick_device(name: str | None) -> torch.device:
    """`cuda` where there is one unless a name is given. Raises InputError for a device that is not there."""
    name = name or ("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).split("\n")[0]
        raise InputError(f"--device {name} cannot be used here ({reason}): use --device cpu") from error
    return device


def newest_checkpoint(runs: str | Path = "runs") -> Path:
    """The last EMA checkpoint of the run that was written to last; without any, the one of the repository, said so.

    Raises InputError if that is missing, too.
    """
    checkpoints = sorted(Path(runs).glob("*/ema-*.pt"), key=lambda path: (path.stat().st_mtime, path.name))
    if checkpoints:
        return checkpoints[-1]
    if not SHIPPED_CHECKPOINT.is_file():
        raise InputError(f"no checkpoint in {runs}/: run `python train.py --suite ml10` first, or name a --checkpoint")
    print(f"no checkpoint in {runs}/: using the one that comes with the code, {SHIPPED_CHECKPOINT.name}", flush=True)
    return SHIPPED_CHECKPOINT


def load_trained(path: str | Path, device: str | torch.device = "cpu") -> tuple[DAMIPolicy, dict[str, Any]]:
    """`model.load_checkpoint`, for a file that says how it was trained. Raises InputError for one that does not."""
    policy, info = load_checkpoint(path, device)
    needed = ("suite", "preset", "arguments", "text_weights", "step")
    if missing := [name for name in needed if name not in info]:
        raise InputError(f"{path} does not say its {', '.join(missing)}: use a checkpoint of train.py or finetune.py")
    return policy, info


def text_features(instructions: Sequence[str], weights: str | None, identity: str | None = None) -> tuple[Tensor, str]:
    """Encodes instructions with CLIP's frozen text tower, once.

    Args:
        instructions: plain sentences.
        weights: the value of --clip-weights: a file, `random`, or None for what is there.
        identity: the text weights that a checkpoint was made with. No others are accepted, and if they were random
            ones, the same are drawn again without looking for CLIP's.

    Returns:
        (features (len(instructions), 512) float32 on the CPU, identity of the weights).

    Raises:
        InputError: the weights that can be had are not those of the checkpoint.
    """
    if weights is None and identity is not None and identity.startswith("random"):
        weights = "random"
    encoder = load_clip_text_encoder(weights)
    if identity is not None and encoder.identity != identity:
        raise InputError(
            f"the checkpoint was made with the text weights {identity!r}, here are {encoder.identity!r}: "
            "give the same ones with --clip-weights"
        )
    return encoder.encode(list(instructions)), encoder.identity


def window_sampler(
    policy: DAMIPolicy, demonstrations: Demonstrations, after_success: int | None = None, augment: bool = False
) -> WindowSampler:
    """The sampler of one task's demonstrations with this policy's horizon, points and stride, on its device.

    `after_success` and `augment` are for training, as in `WindowSampler`.

    Raises InputError where policy and demonstrations disagree.
    """
    config, device = policy.config, next(policy.parameters()).device
    found = (demonstrations.state.shape[1], demonstrations.action.shape[1])
    if found != (config.state_dim, config.action_dim):
        raise InputError(
            f"{demonstrations.task}: state and action have {found[0]} and {found[1]} dimensions, the policy "
            f"{config.state_dim} and {config.action_dim}: use a checkpoint trained on such data"
        )
    sampler = WindowSampler(
        demonstrations,
        config.horizon,
        config.n_obs_steps,
        config.n_action_steps,
        config.num_points,
        config.demo_stride,
        device,
        after_success,
        augment,
    )
    longest = max(math.ceil((e.stop - e.start) / config.demo_stride) for e in sampler.episodes)
    if config.demo_encoder != "none" and longest > config.demo_positions:
        raise InputError(
            f"{demonstrations.task}: a demonstration has {longest} frames (every {config.demo_stride}th of it), the "
            f"policy {config.demo_positions} positions: cut it, or train with more positions or a larger stride"
        )
    return sampler


# ---- Rollouts --------------------------------------------------------------------------------------------------------


def rollout(
    policy: DAMIPolicy,
    envs: Sequence[MetaWorldPointCloudEnv],
    seeds: Sequence[int],
    sampler: WindowSampler,
    text: Tensor,
    generator: torch.Generator,
    on_chunk: Callable[[int, dict], None] | None = None,
) -> list[bool]:
    """Rolls out E episodes of one task side by side, and says which of them succeeded.

    The demonstrations are encoded once. The policy reads To frames in every Ta: in the others no ray is cast.

    Args:
        policy: in evaluation mode.
        envs, seeds: E environments and the seeds of their goals.
        sampler: of the task's demonstrations, from which one a rollout is drawn.
        text: instruction feature, (text_dim,).
        generator: draws demonstrations and noise; on the CPU.
        on_chunk: called with (index of the environment, observation) before each chunk, for pictures.

    Returns:
        E booleans.
    """
    To, device = policy.config.n_obs_steps, text.device
    drawn = [sampler.demonstration(generator) for _ in envs]  # held for the whole rollout
    contexts = []
    for demo in drawn:  # one at a time: they may differ in length
        with torch.no_grad():
            contexts.append(
                policy.encode_demo(text[None], *(demo[name][None] for name in ("points", "state", "action")))
            )
    frames = [[env.reset(seed=seed)[0]] * To for env, seed in zip(envs, seeds)]  # the first frame, repeated
    success, running = [False] * len(envs), list(range(len(envs)))
    while running:
        points = torch.from_numpy(np.stack([[f["point_cloud"] for f in frames[e]] for e in running]))  # (E, To, N, 3)
        state = torch.from_numpy(np.stack([[f["agent_pos"] for f in frames[e]] for e in running]))  # (E, To, S)
        if on_chunk is not None:
            for e in running:
                on_chunk(e, frames[e][-1])
        chunks = sample_chunks(policy, points.to(device), state.to(device), [contexts[e] for e in running], generator)
        for e, chunk in zip(list(running), chunks):
            frames[e] = []
            for step, action in enumerate(chunk, start=1):
                _, truncated, info = envs[e].advance(action)
                success[e] = success[e] or info["success"]
                if success[e] or truncated:
                    running.remove(e)
                    break
                if step > len(chunk) - To:
                    frames[e].append(envs[e].observe())
    return success


def sample_chunks(
    policy: DAMIPolicy, points: Tensor, state: Tensor, contexts: Sequence, generator: torch.Generator
) -> np.ndarray:
    """Action chunks (E, Ta, A) float32 for observations (E, To, N, 3), (E, To, S) and one context each."""
    if contexts[0] is None:  # this architecture reads no task
        return policy.sample_actions(points, state, None, generator).cpu().numpy()
    if len({context[0].shape for context in contexts}) > 1:  # demonstrations of different lengths
        each = [policy.sample_actions(p[None], s[None], c, generator) for p, s, c in zip(points, state, contexts)]
        return torch.cat(each).cpu().numpy()
    context = tuple(torch.cat(parts) for parts in zip(*contexts))
    return policy.sample_actions(points, state, context, generator).cpu().numpy()


# ---- Evaluation in worker processes ----------------------------------------------------------------------------------

worker: dict[str, Any] = {}  # what a worker process keeps between jobs: policy and environments


def start_worker(checkpoint: str, device: str) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the starting process's business
    torch.set_num_threads(1)  # one process a core
    worker.update(policy=load_checkpoint(checkpoint, device)[0], task=None)


def run_job(
    task: str, data: str, n_demonstrations: int | None, text: np.ndarray, seed: int, first: int, episodes: int
) -> list[bool]:
    """Episodes first ... first + episodes - 1 of one task."""
    policy = worker["policy"]
    if worker["task"] != task:
        demonstrations = load_demonstrations(data).first(n_demonstrations)
        worker.update(task=task, sampler=window_sampler(policy, demonstrations), envs=[])
    while len(worker["envs"]) < episodes:
        worker["envs"].append(MetaWorldPointCloudEnv(task, policy.config.num_points))
    seeds = [evaluation_seed(seed, first + i) for i in range(episodes)]
    generator = torch.Generator().manual_seed(seeds[0])
    text = torch.from_numpy(text).to(worker["sampler"].state.device)
    return rollout(policy, worker["envs"][:episodes], seeds, worker["sampler"], text, generator)


def evaluate(
    checkpoint: str | Path,
    demonstrations: dict[str, Path],
    text: dict[str, Tensor],
    episodes: int = 20,
    seed: int = 0,
    workers: int | None = None,
    device: str | torch.device = "cpu",
    n_demonstrations: int | None = None,
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

    Returns:
        task -> E booleans, in the order of the episodes. They do not depend on the number of workers.
    """
    if episodes < 1:
        raise InputError(f"--episodes is {episodes}: evaluate at least 1")
    jobs = [
        (
            task,
            str(path),
            n_demonstrations,
            text[task].cpu().numpy(),
            seed,
            first,
            min(EPISODES_A_JOB, episodes - first),
        )
        for task, path in demonstrations.items()
        for first in range(0, episodes, EPISODES_A_JOB)
    ]
    if workers is not None and workers < 1:
        raise InputError(f"--workers is {workers}: use at least 1")
    workers = min(workers or os.cpu_count() or 1, len(jobs))
    results: dict[str, dict[int, list[bool]]] = {task: {} for task in demonstrations}
    with (
        ProcessPoolExecutor(
            workers, multiprocessing.get_context("spawn"), start_worker, (str(checkpoint), str(device))
        ) as pool,
        tqdm(total=len(demonstrations) * episodes, desc="evaluating", unit="episode", dynamic_ncols=True) as progress,
    ):
        try:
            pending = {pool.submit(run_job, *job): job for job in jobs}
            for future in as_completed(pending):
                task, first = pending[future][0], pending[future][5]
                results[task][first] = future.result()
                progress.update(len(results[task][first]))
        except BrokenProcessPool:
            raise InputError("an evaluating process was killed, perhaps for memory: try fewer --workers") from None
        except BaseException:
            pool.shutdown(cancel_futures=True)  # what is running ends first: at most a few seconds
            raise
    return {task: [s for first in sorted(parts) for s in parts[first]] for task, parts in results.items()}


# ---- Reports ---------------------------------------------------------------------------------------------------------


def paper_success(suite: str | None, task: str) -> float | None:
    """The paper's success rate of DAMI on a task in percent, if it reports one."""
    tables = json.loads(PAPER_RESULTS.read_text())
    for split in ("base", "novel"):
        if task in tables.get(suite or "", {}).get(split, {}):
            return tables[suite][split][task]["DAMI"]
    return None


def success_table(columns: dict[str, Successes], suite: str | None = None) -> str:
    """A Markdown table: a row a task, a column for each set of results, and the paper's beside them; then the mean."""
    tasks = list(next(iter(columns.values())))
    paper = {task: paper_success(suite, task) for task in tasks}
    lines = [f"| task | {' | '.join(columns)} | paper |", "|---" * (len(columns) + 2) + "|"]
    for task in tasks:
        cells = [format_success(sum(results[task]), len(results[task])) for results in columns.values()]
        lines.append(f"| {task} | {' | '.join(cells)} | {'' if paper[task] is None else f'{paper[task]:.1f}'} |")
    if len(tasks) > 1:
        cells = []
        for results in columns.values():
            flat = [success for episodes in results.values() for success in episodes]
            cells.append(format_success(sum(flat), len(flat)))
        known = [value for value in paper.values() if value is not None]
        mean = f"{np.mean(known):.1f}" if len(known) == len(tasks) else ""
        lines.append(f"| **mean** | {' | '.join(cells)} | {mean} |")
    return "\n".join(lines)


def draw_success(columns: dict[str, Successes], path: Path, title: str, suite: str | None = None) -> None:
    """A bar chart of success rates with their Wilson intervals, a group a task, the paper's beside them."""
    from matplotlib.figure import Figure

    tasks = list(next(iter(columns.values())))
    groups = len(columns) + 1
    figure = Figure(figsize=(max(4.5, 2 + 0.9 * len(tasks)), 3.6), layout="constrained")
    axes = figure.subplots()
    x, width = np.arange(len(tasks)), 0.8 / groups
    for i, (label, results) in enumerate(columns.items()):
        rates = np.array([np.mean(results[task]) for task in tasks])
        bounds = np.array([wilson_interval(sum(results[task]), len(results[task])) for task in tasks]).T
        errors = 100 * np.abs(bounds - rates)
        axes.bar(x + i * width, 100 * rates, width, yerr=errors, capsize=2, label=label, error_kw={"linewidth": 0.8})
    paper = [paper_success(suite, task) for task in tasks]
    if any(value is not None for value in paper):
        axes.bar(
            x + len(columns) * width, [value or 0 for value in paper], width, color="0.8", label="paper (GPU, 258 M)"
        )
    axes.set_xticks(x + width * (groups - 1) / 2, tasks, rotation=30, ha="right")
    axes.set(ylabel="success, %", ylim=(0, 105), title=title)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(frameon=False, ncols=groups, loc="outside upper center", fontsize=8)
    write_atomically(path, lambda temporary: figure.savefig(temporary, dpi=120, format="png"))


def write_atomically(path: str | Path, write: Callable[[Path], Any]) -> None:
    """Calls `write` with a temporary name beside `path`, then renames: the file is complete or the old one."""
    path = Path(path)
    temporary = path.with_name(f".{os.getpid()}.{path.name}")  # with its suffix: some writers go by it
    try:
        write(temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def command(script: str, argv: Sequence[str] | None) -> str:
    """The command line that a script was started with, for its report."""
    return shlex.join(["python", script, *(sys.argv[1:] if argv is None else argv)])


def write_report(
    folder: Path,
    columns: dict[str, Successes],
    facts: dict[str, Any],
    suite: str | None = None,
    checkpoints: dict[str, Successes] | None = None,
) -> str:
    """Writes success.json (every episode, and how it was measured), success.md and success.png; returns the table.

    `checkpoints`: what else was measured and is only kept in success.json.
    """
    table = success_table(columns, suite)
    note = ", ".join(f"{name} {value}" for name, value in facts.items())
    text = f"{table}\n\nPercent of episodes, 95 % Wilson interval. {note}.\n"
    folder.mkdir(parents=True, exist_ok=True)
    report = {"facts": facts, "successes": columns} | ({"checkpoints": checkpoints} if checkpoints else {})
    write_atomically(folder / "success.json", lambda temporary: temporary.write_text(json.dumps(report, indent=1)))
    write_atomically(folder / "success.md", lambda temporary: temporary.write_text(text))
    draw_success(columns, folder / "success.png", facts.get("title", "Success in Meta-World"), suite)
    return table


def hardware(device: str | torch.device = "cpu") -> str:
    """The processor that results were measured on."""
    if torch.device(device).type == "cuda":
        return torch.cuda.get_device_name(device)
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        name = platform.processor() or platform.machine()
    return f"{name}, {os.cpu_count()} cores"


# ---- Pictures --------------------------------------------------------------------------------------------------------


def write_gif(policy: DAMIPolicy, sampler: WindowSampler, text: Tensor, seed: int, path: str | Path) -> bool:
    """Rolls out one episode and writes it as an animation: the ray-cast picture beside the cloud the policy sees.

    Returns whether the episode succeeded.
    """
    from matplotlib.animation import FuncAnimation, PillowWriter
    from matplotlib.figure import Figure

    env = MetaWorldPointCloudEnv(sampler.task, policy.config.num_points, render_mode="rgb_array")
    frames = []

    def on_chunk(_: int, observation: dict) -> None:
        frames.append((env.render(), observation["point_cloud"]))

    generator = torch.Generator().manual_seed(evaluation_seed(seed, 0))
    (success,) = rollout(policy, [env], [evaluation_seed(seed, 0)], sampler, text, generator, on_chunk)
    on_chunk(0, env.observe())  # how it ended
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
        right.scatter(*cloud.T, c=cloud[:, 2], cmap="viridis", vmin=low[2], vmax=high[2], s=4)
        right.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        right.set(xticklabels=[], yticklabels=[], zticklabels=[])
        right.set_box_aspect(high - low)
        right.view_init(elev=25, azim=-30)
        step = min(index * policy.config.n_action_steps, env.steps)
        right.set_title(f"{policy.config.num_points} points, step {step}", fontsize=9)

    animation = FuncAnimation(figure, draw, frames=[*range(len(frames)), len(frames) - 1, len(frames) - 1])
    write_atomically(path, lambda temporary: animation.save(temporary, writer=PillowWriter(fps=8), dpi=70))
    return success


# ---- Command line ----------------------------------------------------------------------------------------------------


def checkpoints_of(path: str | Path, top: int) -> list[Path]:
    """A file as it is; of a run's folder its last EMA checkpoint, or all of them if the best `top` are wanted."""
    path = Path(path)
    if not path.is_dir():
        return [path]
    found = sorted(path.glob("ema-*.pt"))
    if not found:
        raise InputError(f"{path} holds no ema-*.pt: name a run folder of train.py, or a checkpoint file")
    if top > len(found):
        raise InputError(
            f"{path} holds {len(found)} checkpoints, --top asks for the best {top}: train.py keeps one every --checkpoint-every steps"
        )
    return found if top else found[-1:]


def mean_interval(values: Sequence[float]) -> str:
    """Mean over runs with its 95 % interval by Student's t, in the unit of the values; of one run just the value."""
    if len(values) == 1:
        return f"{values[0]:.1f} (one run)"
    from scipy.stats import t  # comes with metaworld

    margin = t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / math.sqrt(len(values))
    return f"{np.mean(values):.1f} ± {margin:.1f} ({len(values)} runs)"


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Measure success in Meta-World.")
    parser.add_argument("--checkpoint", nargs="+", help="files or run folders (default: the newest run's last)")
    parser.add_argument(
        "--split", choices=("base", "novel", "all"), default="base", help="novel tasks: after adaptation"
    )
    parser.add_argument("--suite", help="ml10 or ml45 (default: the checkpoint's)")
    parser.add_argument("--task", help="only this task")
    parser.add_argument("--data", default="data", help="folder of the demonstrations (default: data)")
    parser.add_argument("--demonstrations", type=int, default=10, help="demonstrations a task (default: 10)")
    parser.add_argument("--episodes", type=int, default=20, help="episodes a task (default: 20)")
    parser.add_argument("--steps", type=int, default=200, help="adaptation steps on novel tasks (default: 200)")
    parser.add_argument("--top", type=int, default=0, help="all checkpoints of each run; also the mean of the best TOP")
    parser.add_argument("--seed", type=int, default=0, help="of goals, noise and adaptation (default: 0)")
    parser.add_argument("--out", default="runs/evaluation", help="folder of the report (default: runs/evaluation)")
    parser.add_argument("--device", help="cpu, cuda, cuda:1 ... (default: cuda if there is one)")
    parser.add_argument("--workers", type=int, help="processes (default: one a core)")
    parser.add_argument("--clip-weights", help="CLIP's ViT-B-32.pt, or `random` (default: as in the checkpoint)")
    parser.add_argument("--gif", metavar="FILE", help="write one rollout of --task as an animation instead")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    from finetune import adapt_checkpoint  # finetune.py imports this module; only the novel tasks need it

    args = parse(argv)
    for name in ("demonstrations", "episodes", "steps"):
        if getattr(args, name) < 1:
            raise InputError(f"--{name} is {getattr(args, name)}: use at least 1")
    evaluation_seed(args.seed, 0)  # refuses a seed out of range now rather than after the adaptation
    if args.gif and not (args.task and args.gif.endswith(".gif")):
        raise InputError("--gif draws one rollout to a .gif file: name its --task, as in --task reach --gif reach.gif")
    device = pick_device(args.device)
    groups = [checkpoints_of(path, args.top) for path in args.checkpoint or [newest_checkpoint()]]
    labels = {path: f"{path.resolve().parent.name}/{path.stem}" for group in groups for path in group}
    if len(set(labels.values())) < sum(map(len, groups)):
        raise InputError("two of the checkpoints have the same folder and file name: rename the folder of one run")
    policy, info = load_trained(groups[0][-1], device)
    suite = args.suite or info["suite"]
    base, novel = suite_tasks(suite)
    chosen = {"base": base, "novel": novel, "all": base + novel}[args.split]
    if args.task:
        chosen = [check_task(args.task)]
    out = Path(args.out)
    out.mkdir(parents=True, exist_ok=True)
    paths = collect(chosen, args.data, args.demonstrations, workers=args.workers)
    demonstrations = {task: load_demonstrations(path).first(args.demonstrations) for task, path in paths.items()}
    instructions = [demonstrations[task].instruction for task in chosen]
    features, identity = text_features(instructions, args.clip_weights, info["text_weights"])
    text = dict(zip(chosen, features.to(device)))

    if args.gif:
        sampler = window_sampler(policy, demonstrations[args.task])
        success = write_gif(policy, sampler, text[args.task], args.seed, args.gif)
        print(f"{args.task}: {'success' if success else 'failure'}; wrote {args.gif}")
        return

    def measure(checkpoint: Path) -> Successes:
        _, info = load_trained(checkpoint)
        if info["text_weights"] != identity:
            raise InputError(f"{checkpoint} was made with the text weights {info['text_weights']!r}, not {identity!r}")
        settings = (args.episodes, args.seed, args.workers, device, args.demonstrations)
        direct = [task for task in chosen if task not in novel or "adapted_to" in info]
        successes = evaluate(checkpoint, {task: paths[task] for task in direct}, text, *settings) if direct else {}
        for task in chosen:
            if task not in direct:  # a novel task: adapt first
                adapted = out / f"{labels[checkpoint].replace('/', '-')}-{task}.pt"
                adapt_checkpoint(checkpoint, demonstrations[task], text[task], adapted, args.steps, seed=args.seed)
                successes |= evaluate(adapted, {task: paths[task]}, text, *settings)
        return successes

    results = {checkpoint: measure(checkpoint) for checkpoints in groups for checkpoint in checkpoints}
    columns = {labels[group[-1]]: results[group[-1]] for group in groups}
    facts = {
        "title": f"{suite}, {args.split} tasks" if not args.task else args.task,
        "episodes a task": args.episodes,
        "seed": args.seed,
        "adaptation steps": args.steps,
        "hardware": hardware(device),
        "text weights": identity,
        "date": time.strftime("%Y-%m-%d"),
        "command": command("evaluate.py", argv),
    }
    for name, split in {"base": base, "novel": novel}.items():
        inside = [task for task in chosen if task in split]
        if inside and len(chosen) > 1:
            means = [[mean_success({t: results[c][t] for t in inside}) for c in group] for group in groups]
            facts[f"{name} mean, last checkpoint"] = mean_interval([group[-1] for group in means])
            if args.top:
                best = [float(np.mean(sorted(group)[-args.top :])) for group in means]
                facts[f"{name} mean, best {args.top} checkpoints"] = mean_interval(best)
    every = {labels[checkpoint]: successes for checkpoint, successes in results.items()} if args.top else None
    print(f"\n{write_report(out, columns, facts, suite, every)}\n")
    for name, value in facts.items():
        print(f"{name}: {value}")


if __name__ == "__main__":
    command_line(main, ModelInputError)
