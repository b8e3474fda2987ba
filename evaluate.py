"""Success rates: rollouts in a simulator, in parallel processes, and animations of them.

    python evaluate.py                                       # base tasks, the newest run
    python evaluate.py --checkpoint runs/a runs/b --top 5    # all checkpoints of two runs
    python evaluate.py --task reach --gif reach.gif          # watch one rollout (.mp4 too)
    python evaluate.py --without instruction --swap demonstration    # is the demonstration read?

An episode is played to its end, and its success is reported twice: at any step, as the paper and
DP3 count it, and at the end, as Meta-World's own evaluation does. Each rollout reads one reference
demonstration, drawn from those of its task. Episodes come from seeds that no demonstration uses,
unless --known-goals is given. With --inner-steps a policy is adapted to each task as in training;
Algorithm 2 of the paper is in finetune.py.

One action, from the network to the simulated arm: `rollout` keeps the last To observations of each
episode, `DAMIPolicy.sample_actions` draws a chunk of actions from them, and the environment's
`advance` takes these one by one. What an environment and a simulator are is stated in simulator.py.

Letters: E episodes rolled out side by side, To observation steps, Ta executed actions, N points,
P point_dim, A action dim, S state dim.
"""

import argparse
import copy
import json
import math
import zlib
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import baselines  # noqa: F401  (adds its policies to those that can be loaded)
import common
import maml
import model
from clip import TextWeightsError, text_features
from common import UserError, WorkerPool, progress_bar, report_progress, run_jobs
from data import Demonstrations, RecordingError, WindowSampler, load_demonstrations, positions
from model import CheckpointError, DAMIPolicy
from report import (
    Frame,
    Outcomes,
    Parts,
    Successes,
    animate,
    mean_interval,
    mean_success,
    movie_writer,
    paper_columns,
    write_report,
)
from simulator import (
    Environment,
    OutOfSightError,
    Simulator,
    check_task,
    collect,
    draw_base_tasks,
    environments_of,
    evaluation_seed,
    simulator_of,
)

EVALUATION_SEED = 0  # of the goals; the same for every seed of training
EPISODES_A_JOB = 10  # rolled out side by side in one process; another number draws other noise

# ---- What may be read in place of a demonstration ------------------------------------------------
#
# Each takes a demonstration, as `WindowSampler.demonstration` gives it, and returns one of the same
# shapes. The success that a policy loses by one of them shows how much it reads what was left out.


def zeros(demonstration: dict[str, Tensor]) -> dict[str, Tensor]:
    """Zeros in place of everything."""
    return {name: torch.zeros_like(x) for name, x in demonstration.items()}


def last_frame(demonstration: dict[str, Tensor]) -> dict[str, Tensor]:
    """The last frame in place of every frame: how it ends, but not the way there."""
    return {name: x[:, -1:].expand_as(x) for name, x in demonstration.items()}


def without_actions(demonstration: dict[str, Tensor]) -> dict[str, Tensor]:
    """What was seen, but not what was done: zeros in the place of the actions."""
    return {**demonstration, "demo_action": torch.zeros_like(demonstration["demo_action"])}


def shuffled_frames(demonstration: dict[str, Tensor]) -> dict[str, Tensor]:
    """All frames in another order, which is the same for all demonstrations of one length."""
    T = demonstration["demo_action"].shape[1]
    order = torch.randperm(T, generator=torch.Generator().manual_seed(0))
    return {name: x[:, order.to(x.device)] for name, x in demonstration.items()}


DEMONSTRATION_CONTROLS = {
    "zeros": zeros,
    "last-frame": last_frame,
    "no-actions": without_actions,
    "shuffled": shuffled_frames,
}


def controlled(demonstration: dict[str, Tensor], control: str | None) -> dict[str, Tensor]:
    """What a policy reads in place of a demonstration.

    `control` is a key of DEMONSTRATION_CONTROLS; None leaves the demonstration as it is.
    """
    return demonstration if control is None else DEMONSTRATION_CONTROLS[control](demonstration)


def of_next_task(inputs: dict[str, Any]) -> dict[str, Any]:
    """Gives every task what belongs to the next one, and the last what belongs to the first."""
    values = list(inputs.values())
    return dict(zip(inputs, [*values[1:], values[0]]))


# ---- Checkpoints, and what they say --------------------------------------------------------------

SHIPPED_CHECKPOINT = Path(__file__).parent / "assets" / "ml10-small.pt"
# What train.py saves in a checkpoint beside the weights
TRAINED = ("suite", "preset", "arguments", "text_weights", "step")
# Settings of train.py that may differ when a run is resumed, and between runs that are averaged.
# Only `vectorize` changes weights, in their last bits.
FREE_TO_CHANGE = ("vectorize", "checkpoint_every", "evaluate_every", "episodes")


def ema_checkpoint(folder: Path, step: int) -> Path:
    """The file in a run's folder that holds the moving average after a step."""
    return folder / f"ema-{step:05d}.pt"


def checkpoints_of(path: str | Path) -> list[Path]:
    """The checkpoints of a run's folder in the order of steps, or its adapted.pt; a file as it is.

    Raises UserError for a folder without checkpoints.
    """
    path = Path(path)
    if not path.is_dir():
        return [path]
    # By the length first, since steps may have more than five digits
    by_step = sorted(path.glob("ema-*.pt"), key=lambda file: (len(file.name), file.name))
    if by_step:
        return by_step
    if (path / "adapted.pt").exists():
        return [path / "adapted.pt"]
    if (path / "last.pt").is_file():
        raise UserError(
            f"{path} is a run that was interrupted before its first checkpoint: add --resume to "
            f"its training, or name {path / 'last.pt'}"
        )
    adapted = ", ".join(str(file.parent) for file in sorted(path.glob("*/adapted.pt")))
    suggestion = adapted or "a folder of train.py or finetune.py, or a .pt file"
    raise UserError(f"{path} holds no checkpoint: name {suggestion}")


def default_checkpoint(suite: str) -> Path:
    """The last checkpoint of the newest finished run on `suite`; without any, one that ships.

    Runs of `tiny` do not count: they show that everything works, and succeed nearly nowhere.
    Raises UserError where there is neither.
    """
    finished, tiny = [], []
    for config in Path("runs").glob("*/config.json"):
        with suppress(OSError, ValueError, KeyError, TypeError):  # of a damaged file
            arguments = json.loads(config.read_text())["arguments"]
            last = ema_checkpoint(config.parent, arguments["steps"])
            if arguments["suite"] == suite and last.is_file():
                runs_of_preset = tiny if arguments["preset"] == "tiny" else finished
                runs_of_preset.append(last)
    if finished:
        return max(finished, key=lambda path: path.stat().st_mtime)
    shipped = SHIPPED_CHECKPOINT.with_name(f"{suite}-small.pt")
    if shipped.is_file():
        print(
            f"no finished run on {suite} in runs/: using the policy that comes with the code",
            flush=True,
        )
        return shipped
    if tiny:
        run = max(tiny, key=lambda path: path.stat().st_mtime).parent
        raise UserError(
            f"{run} is a run of `tiny`, which only shows that everything works, and is never "
            f"taken unasked: train with --preset small, or add --checkpoint {run}"
        )
    raise UserError(f"no finished run on {suite} in runs/: train one, or name a --checkpoint")


def load_trained(
    path: str | Path, device: str | torch.device = "cpu", **config_overrides: Any
) -> tuple[DAMIPolicy, dict[str, Any]]:
    """`model.load` of a file of train.py or finetune.py; CheckpointError for any other policy."""
    return model.load(path, device, needs=TRAINED, **config_overrides)


def reads_instruction(info: dict[str, Any]) -> bool:
    """Whether a checkpoint's policy is given its instruction. It is, unless adapted without."""
    return info.get("adaptation", {}).get("instruction", True)


def instruction_features(
    instructions: dict[str, str],
    weights: str | None,
    identity: str | None,
    device: str | torch.device,
    use_instruction: bool = True,
) -> tuple[dict[str, Tensor], str]:
    """Encodes instructions with CLIP's text tower.

    Args:
        instructions: task -> sentence.
        weights: those of --clip-weights, see `clip.text_features`.
        identity: of the weights that must be used, as a checkpoint names them; None: any.
        device: of the features.
        use_instruction: False gives zeros in place of every feature.

    Returns:
        Task -> feature (text_dim,), and the identity of the weights.
    """
    features, identity = text_features(list(instructions.values()), weights, identity)
    if not use_instruction:
        features = torch.zeros_like(features)
    return dict(zip(instructions, features.to(device))), identity


# ---- The inner step, as adaptation ---------------------------------------------------------------


def rate_of_checkpoint(
    info: dict[str, Any], device: str | torch.device, override: float | None = None
) -> maml.InnerRate:
    """The learning rate of an inner step: `override`, or that of the checkpoint's training.

    Training used one rate for all weights, or learned one for each tensor.
    """
    if override is not None:
        return override
    learned = info.get("inner_rates")
    if not learned:
        return info["arguments"]["inner_lr"]
    return {name: torch.tensor(rate, device=device) for name, rate in learned.items()}


def inner_seed(seed: int, task: str) -> int:
    """The seed of the windows and the noise of inner steps: each task has draws of its own."""
    return zlib.crc32(f"{seed} {task}".encode())


def take_inner_steps(
    policy: DAMIPolicy,
    sampler: WindowSampler,
    text: Tensor,
    *,
    steps: int,
    batch: int,
    lr: maml.InnerRate,
    seed: int = 0,
    demonstration_control: str | None = None,
) -> Iterator[tuple[int, float, DAMIPolicy]]:
    """Adapts a copy of a policy by steps of gradient descent, all on one batch (Eq. 2).

    Args:
        policy: it is left as it is.
        sampler: of the task's demonstrations.
        text: instruction feature, (text_dim,).
        steps: gradient steps.
        batch: windows in the batch.
        lr: the learning rate, or parameter name -> tensor, see `maml.adapt`.
        seed: of the batch: its demonstration, its windows and their noise.
        demonstration_control: of the batch's demonstration, see `controlled`.

    Yields:
        (steps done, loss of the batch after them, the adapted policy) after each step. The policy
        is always the same object.

    Raises:
        UserError: the loss is not finite.
    """
    adapted = copy.deepcopy(policy)
    generator = torch.Generator().manual_seed(seed)
    support = adapted.draw_batch(sampler, text, batch, generator)
    demonstration = {name: x for name, x in support.items() if name.startswith("demo_")}
    support.update(controlled(demonstration, demonstration_control))

    loss_fn = partial(model.loss_of, policy)
    params = {name: p.detach() for name, p in policy.named_parameters()}
    for step in range(1, steps + 1):
        params = maml.adapt(loss_fn, params, support, lr)
        with torch.no_grad():
            loss = loss_fn(params, support)
        if not torch.isfinite(loss):
            raise UserError(
                f"{sampler.task}: the loss is not finite after inner step {step}: use a smaller "
                "--inner-lr"
            )
        adapted.load_state_dict(params, strict=False)  # `params` lacks the normalizer
        yield step, loss.item(), adapted


# ---- Rollouts ------------------------------------------------------------------------------------


@torch.no_grad()
def rollout(
    policy: DAMIPolicy,
    environments: Sequence[Environment],
    seeds: Sequence[int],
    sampler: WindowSampler,
    text: Tensor,
    generator: torch.Generator,
    demonstration_control: str | None = None,
    reference: int | None = None,
    stop_at_success: bool = False,
    on_steps: Callable[[int], None] | None = None,
) -> list[list[bool]]:
    """Rolls out E episodes of one task side by side, and says which of their steps were a success.

    The demonstrations are encoded once. Of every Ta frames the policy reads the last To. Only those
    are observed, since observing takes most of a simulator's time.

    Args:
        policy: in evaluation mode.
        environments, seeds: E environments, and the seeds of their episodes.
        sampler: of the task's demonstrations, from which one is drawn for each rollout.
        text: instruction feature, (text_dim,).
        generator: draws demonstrations and noise; on the CPU.
        demonstration_control: see `controlled`.
        reference: the demonstration that all rollouts hold; None: each draws its own.
        stop_at_success: an episode ends at its first success, and not when it is over.
        on_steps: called with the number of steps that the episodes took since its last call.

    Returns:
        For each of E episodes, whether each step that was taken reported success.
    """
    To = policy.config.n_obs_steps
    device = text.device

    # Each rollout reads one reference demonstration. All are drawn before any noise is, and they
    # are encoded one at a time, since they may differ in length.
    if reference is None:
        references = [sampler.sample_episode(generator) for _ in environments]
    else:
        references = [reference for _ in environments]
    contexts = []
    for episode in references:
        demonstration = controlled(sampler.demonstration(episode), demonstration_control)
        contexts.append(policy.encode_demo(text[None], **demonstration))

    # The last To observations of each episode, the oldest first. At its start all are the same.
    histories = []
    for environment, seed in zip(environments, seeds):
        environment.begin(seed)
        try:
            first = environment.observe()
        except OutOfSightError as error:
            raise UserError(
                f"{sampler.task}: nothing is seen at the start of the episode of seed {seed}: "
                f"look at the simulator's camera ({error})"
            ) from error
        histories.append(deque([first] * To, maxlen=To))

    successes: list[list[bool]] = [[] for _ in environments]
    running = list(range(len(environments)))
    while running:
        points = np.stack([[o["point_cloud"] for o in histories[e]] for e in running])
        state = np.stack([[o["agent_pos"] for o in histories[e]] for e in running])
        chunks = sample_chunks(
            policy,
            points=torch.from_numpy(points).to(device),  # (E, To, N, P)
            state=torch.from_numpy(state).to(device),  # (E, To, S)
            contexts=[contexts[e] for e in running],
            generator=generator,
        )  # (E, Ta, A)

        steps_taken = 0
        still_running = []
        for e, chunk in zip(running, chunks):
            step_successes, ended = take_actions(
                environments[e], chunk, histories[e], stop_at_success
            )
            successes[e] += step_successes
            steps_taken += len(step_successes)
            if not ended:
                still_running.append(e)
        running = still_running
        if on_steps is not None:
            on_steps(steps_taken)
    return successes


def sample_chunks(
    policy: DAMIPolicy,
    points: Tensor,
    state: Tensor,
    contexts: Sequence[tuple[Tensor, ...] | None],
    generator: torch.Generator,
) -> np.ndarray:
    """Draws action chunks (E, Ta, A) for observations (E, To, N, P), (E, To, S) and E contexts."""
    if contexts[0] is None:  # this architecture reads no task
        chunks = policy.sample_actions(points, state, None, generator)
    elif len({context[0].shape for context in contexts}) == 1:
        stacked = tuple(torch.cat(tensors) for tensors in zip(*contexts))
        chunks = policy.sample_actions(points, state, stacked, generator)
    else:  # demonstrations of different lengths cannot be stacked
        chunks_of_one = [
            policy.sample_actions(points[[e]], state[[e]], context, generator)
            for e, context in enumerate(contexts)
        ]
        chunks = torch.cat(chunks_of_one)
    return chunks.cpu().numpy()


def take_actions(
    environment: Environment,
    chunk: np.ndarray,
    history: deque[dict[str, np.ndarray]],
    stop_at_success: bool,
) -> tuple[list[bool], bool]:
    """Takes the actions of a chunk (Ta, A); `history` gets what is seen after each of the last To.

    Returns whether each step reported success, and whether the episode ended. An episode in which
    nothing is left to observe ends there, and its last step counts as no success.
    """
    successes = []
    for i, action in enumerate(chunk):
        _, truncated, info = environment.advance(action)
        successes.append(bool(info["success"]))
        if truncated or (stop_at_success and info["success"]):
            return successes, True
        if i >= len(chunk) - history.maxlen:
            try:
                history.append(environment.observe())
            except OutOfSightError:
                successes[-1] = False
                return successes, True
    return successes, False


# ---- Evaluation in worker processes --------------------------------------------------------------


@lru_cache(maxsize=1)
def cached_policy(
    checkpoint: str | Path, device: str, config_overrides: tuple[tuple[str, Any], ...]
) -> tuple[DAMIPolicy, dict[str, Any]]:
    """`load_trained`, whose result a process keeps until it is asked for another policy."""
    return load_trained(checkpoint, device, **dict(config_overrides))


@dataclass(frozen=True)
class PolicyOfTask:
    """Which policy is rolled out on a task, and how it is adapted to it before that.

    It is hashable, so that `lru_cache` keeps the policy from one job of a task to the next.
    """

    checkpoint: str | Path
    device: str
    config_overrides: tuple[tuple[str, Any], ...]  # names and values, see `inference_overrides`
    recording: Path  # of the task's demonstrations
    n_demonstrations: int | None  # the first so many of them; None: all
    text: bytes  # the float32 numbers of the instruction feature
    demonstration_control: str | None  # this and the next three: see `evaluate_checkpoint`
    inner_steps: int
    inner_lr: float | None
    support: int | None
    inner_seed: int  # of the windows and the noise of inner steps


def adaptation_sampler(
    demonstrations: Demonstrations,
    policy: DAMIPolicy,
    info: dict[str, Any],
    device: str | torch.device = "cpu",
) -> WindowSampler:
    """The windows that adapt a checkpoint's policy to a task.

    Late windows are as frequent as in its training, but scenes are not augmented.
    """
    training = info["arguments"]
    return WindowSampler(
        demonstrations,
        policy.config,
        device=device,
        after_success=training.get("after_success"),
        late_fraction=training.get("late_fraction", 0.0),
    )


@lru_cache(maxsize=1)
def cached_policy_of_task(wanted: PolicyOfTask) -> tuple[DAMIPolicy, WindowSampler, Tensor]:
    """A policy for a task, kept until this process is asked for any other `PolicyOfTask`.

    Returns:
        The policy, adapted to the task where there are inner steps; the windows of the task's
        demonstrations; and the instruction feature, (text_dim,).
    """
    policy, info = cached_policy(wanted.checkpoint, wanted.device, wanted.config_overrides)
    demonstrations = load_demonstrations(wanted.recording).take(wanted.n_demonstrations)
    sampler = adaptation_sampler(demonstrations, policy, info, wanted.device)
    text = torch.from_numpy(np.frombuffer(wanted.text, np.float32).copy()).to(wanted.device)
    if wanted.inner_steps > 0:
        of_each_step = take_inner_steps(
            policy,
            sampler,
            text,
            steps=wanted.inner_steps,
            batch=wanted.support or info["arguments"]["support"],
            lr=rate_of_checkpoint(info, wanted.device, wanted.inner_lr),
            seed=wanted.inner_seed,
            demonstration_control=wanted.demonstration_control,
        )
        for _, _, adapted in of_each_step:
            policy = adapted  # in the end, that after the last step
    return policy, sampler, text


def evaluate_checkpoint(
    checkpoint: str | Path,
    simulator: Simulator,
    recordings: dict[str, Path],
    text: dict[str, Tensor],
    *,
    episodes: int = 20,
    seed: int = EVALUATION_SEED,
    workers: int | None = None,
    device: str | torch.device = "cpu",
    n_demonstrations: int | None = None,
    demonstration_control: str | None = None,
    inner_steps: int = 0,
    inner_lr: float | None = None,
    support: int | None = None,
    known_goals: bool = False,
    stop_at_success: bool = False,
    config_overrides: dict[str, Any] | None = None,
    description: str = "evaluating",
    pool: WorkerPool | None = None,
) -> Outcomes:
    """Rolls a checkpoint out on tasks of a simulator, in parallel processes.

    Args:
        checkpoint: a file of train.py or finetune.py.
        simulator: it is pickled for the worker processes.
        recordings: task -> file with its demonstrations.
        text: task -> instruction feature, (text_dim,).
        episodes: rollouts of each task; episode i has the goal of `evaluation_seed(seed, i)`.
        seed: chooses goals, noise, reference demonstrations, and the windows and noise of inner
            steps. With `known_goals` it chooses only the latter two and, in a simulator with
            `one_demonstration`, the reference demonstration.
        workers: processes; None: one a core.
        device: where the policy runs.
        n_demonstrations: use only the first so many of each recording; None: all.
        demonstration_control: of demonstrations in inner steps and rollouts, see `controlled`.
        inner_steps: the policy is adapted to each task by so many steps before, see
            `take_inner_steps`.
        inner_lr: the learning rate of these steps; None: the one or those of its training.
        support: windows for these steps; None: as many as in its training.
        known_goals: roll out on the demonstrations' goals, at most `episodes` of them, each once.
        stop_at_success: an episode ends at its first success; it is quicker.
        config_overrides: of the policy's configuration, see `inference_overrides`.
        description: the progress bar's.
        pool: processes to use, kept from one call to the next; None: `workers` of its own. They
            keep what they read, so that checkpoints and recordings must not change meanwhile.

    Returns:
        The successes, in the order of the episodes. They do not depend on `workers`.
    """
    episodes_a_job = 1 if getattr(simulator, "one_environment", False) else EPISODES_A_JOB
    reference_seed = seed if getattr(simulator, "one_demonstration", False) else None
    jobs = []
    for task, recording in recordings.items():
        if known_goals:
            seeds = episode_seeds_of(recording)[:n_demonstrations][:episodes]
        else:
            seeds = [evaluation_seed(seed, episode) for episode in range(episodes)]
        wanted = PolicyOfTask(
            checkpoint=checkpoint,
            device=str(device),
            config_overrides=tuple((config_overrides or {}).items()),
            recording=recording,
            n_demonstrations=n_demonstrations,
            text=text[task].cpu().float().numpy().tobytes(),
            demonstration_control=demonstration_control,
            inner_steps=inner_steps,
            inner_lr=inner_lr,
            support=support,
            inner_seed=inner_seed(seed, task),
        )
        for start in range(0, len(seeds), episodes_a_job):
            jobs.append(
                {
                    "wanted": wanted,
                    "simulator": simulator,
                    "task": task,
                    "seeds": seeds[start : start + episodes_a_job],
                    "stop_at_success": stop_at_success,
                    "reference_seed": reference_seed,
                }
            )
    job_episodes = run_jobs(
        rollout_job,
        jobs,
        workers=workers,
        total=sum(len(job["seeds"]) for job in jobs) * simulator.episode_steps,
        description=description,
        unit="step",
        pool=pool,
    )

    any_step: Successes = {task: [] for task in recordings}
    at_end: Successes = {task: [] for task in recordings}
    other_task: Successes = {}
    for job, (episodes_of_job, of_other_task) in zip(jobs, job_episodes):
        task = job["task"]
        for steps in episodes_of_job:
            any_step[task].append(any(steps))
            at_end[task].append(steps[-1])
        for steps in of_other_task:
            other_task.setdefault(task, []).append(any(steps))
    if stop_at_success:  # what came after the first success was not played
        return Outcomes(any_step, at_end=None)
    return Outcomes(any_step, at_end, other_task or None)


def episode_seeds_of(recording: Path) -> list[int]:
    """The seeds of a recording's episodes. Raises UserError if it does not say them."""
    seeds = load_demonstrations(recording).meta.get("episode_seeds")
    if seeds is None:
        raise UserError(f"--known-goals: {recording} does not say the seeds of its episodes")
    return seeds


def rollout_job(
    wanted: PolicyOfTask,
    simulator: Simulator,
    task: str,
    seeds: list[int],
    stop_at_success: bool,
    reference_seed: int | None,
) -> tuple[list[list[bool]], list[list[bool]]]:
    """`rollout` of the episodes of these seeds, of one task, in a worker process.

    A `reference_seed` draws one demonstration, which all rollouts of the task hold.

    Returns two lists with an entry for each episode: whether each of its steps was a success, and
    whether each of them did the other task of a pair. The second list is empty where tasks are no
    pairs, see unnamed_tasks.py.
    """
    policy, sampler, text = cached_policy_of_task(wanted)
    environments = environments_of(simulator, task, len(seeds), policy.config.num_points)
    reference = None
    if reference_seed is not None:
        reference = sampler.sample_episode(torch.Generator().manual_seed(reference_seed))
    successes = rollout(
        policy,
        environments=environments,
        seeds=seeds,
        sampler=sampler,
        text=text,
        generator=torch.Generator().manual_seed(seeds[0]),
        demonstration_control=wanted.demonstration_control,
        reference=reference,
        stop_at_success=stop_at_success,
        on_steps=partial(report_progress, task),
    )
    skipped = len(seeds) * simulator.episode_steps - sum(map(len, successes))
    report_progress(task, skipped)  # the steps of episodes that ended early
    others = [env.other_successes for env in environments if hasattr(env, "other_successes")]
    return successes, others


# ---- Without a simulator: held-out episodes ------------------------------------------------------


@dataclass(frozen=True)
class ActionError:
    """How far actions are from an expert's: mean absolute errors, of each number of an action."""

    of_policy: np.ndarray  # (A,) of the actions that the policy draws, in the action's unit
    of_mean_action: np.ndarray  # (A,) of always doing the mean action of the training data


@torch.no_grad()
def action_error(
    policy: DAMIPolicy,
    train_sampler: WindowSampler,
    heldout_sampler: WindowSampler,
    text: Tensor,
    *,
    demonstrations: WindowSampler | None = None,
    demonstration_control: str | None = None,
) -> ActionError:
    """How far drawn actions are from an expert's on held-out episodes.

    Whole episodes are gone through as in a rollout, from one executed chunk of Ta actions to the
    next, but the policy sees the expert's frames, so that errors do not add up. The mean is over
    the frames of all held-out episodes.

    Args:
        policy: in any mode.
        train_sampler: of the episodes trained on.
        heldout_sampler: of the episodes to judge by.
        text: instruction feature, (text_dim,).
        demonstrations: one of its episodes is the reference demonstration; None: `train_sampler`.
        demonstration_control: see `controlled`.
    """
    demonstrations = demonstrations or train_sampler
    generator = torch.Generator().manual_seed(0)  # of reference demonstrations and noise
    device = text.device
    To, Ta = policy.config.n_obs_steps, policy.config.n_action_steps
    mean_action = train_sampler.action.mean(dim=0)  # (A,)
    errors, errors_of_mean = [], []
    for episode in heldout_sampler.episodes:
        demonstration = demonstrations.demonstration(demonstrations.sample_episode(generator))
        demonstration = {name: x.to(device) for name, x in demonstration.items()}
        demonstration = controlled(demonstration, demonstration_control)
        context = policy.encode_demo(text[None], **demonstration)

        newest = torch.arange(episode.start, episode.stop, Ta)[:, None]  # (n, 1) frames
        observed = (newest + torch.arange(1 - To, 1)).clamp(episode.start)  # (n, To)
        points = heldout_sampler.points[observed].float().to(device)  # (n, To, N, P)
        state = heldout_sampler.state[observed].to(device)  # (n, To, S)
        drawn = policy.sample_actions(points, state, context, generator)  # (n, Ta, A)

        executed = newest + torch.arange(Ta)  # (n, Ta) frames; the last may be behind the episode
        inside = executed < episode.stop
        expert = heldout_sampler.action[executed[inside]]  # (frames, A)
        errors.append((drawn.to(expert.device)[inside] - expert).abs())
        errors_of_mean.append((mean_action.to(expert.device) - expert).abs())
    return ActionError(
        of_policy=torch.cat(errors).mean(dim=0).cpu().numpy(),
        of_mean_action=torch.cat(errors_of_mean).mean(dim=0).cpu().numpy(),
    )


def evaluate_heldout(
    policy: DAMIPolicy,
    train_samplers: dict[str, WindowSampler],
    heldout_samplers: dict[str, WindowSampler],
    text: dict[str, Tensor],
    *,
    demonstration_control: str | None = None,
    swap_demonstrations: bool = False,
) -> dict[str, ActionError]:
    """`action_error` of each task that has held-out episodes.

    With `swap_demonstrations` each task is given a demonstration of the next one.
    """
    demonstrations = of_next_task(train_samplers) if swap_demonstrations else train_samplers
    return {
        task: action_error(
            policy,
            train_samplers[task],
            heldout_sampler,
            text[task],
            demonstrations=demonstrations[task],
            demonstration_control=demonstration_control,
        )
        for task, heldout_sampler in heldout_samplers.items()
    }


# ---- Animations ----------------------------------------------------------------------------------

MAX_FILMS = 3  # in one animation, below each other


class FilmedEnvironment:
    """An environment that keeps a frame before every second step, for `rollout`."""

    def __init__(self, environment: Environment, on_step: Callable[[], Any]):
        self.environment = environment
        self.on_step = on_step
        self.steps = 0
        self.success = False
        self.frames: list[Frame] = []

    def begin(self, seed: int) -> None:
        self.environment.begin(seed)

    def observe(self) -> dict[str, np.ndarray]:
        return self.environment.observe()

    def advance(self, action: np.ndarray) -> tuple[float, bool, dict]:
        if self.steps % 2 == 0:
            self.film()
        self.steps += 1
        self.on_step()
        reward, truncated, info = self.environment.advance(action)
        self.success = info["success"]
        return reward, truncated, info

    def film(self) -> None:
        """Keeps the present moment, with the cloud of the moment before if nothing is seen."""
        try:
            cloud = positions(self.observe()["point_cloud"])
        except OutOfSightError:
            cloud = self.frames[-1].cloud
        self.frames.append(Frame(self.steps, self.success, self.environment.render(), cloud))


def write_animation(
    policy: DAMIPolicy,
    simulator: Simulator,
    samplers: Sequence[WindowSampler],
    text: dict[str, Tensor],
    *,
    seed: int,
    path: str | Path,
) -> list[list[bool]]:
    """Rolls out one whole episode of each sampler's task, and animates them below each other.

    Each row has the picture, and what the policy sees beside it. All episodes have the same seed:
    where tasks are hidden goals they begin alike, and only their demonstrations differ.

    Args:
        policy: in evaluation mode.
        simulator: has the samplers' tasks.
        samplers: of the tasks' demonstrations, one of which is the reference of each rollout.
        text: task -> instruction feature, (text_dim,).
        seed: of start, goal, reference demonstration and noise: `evaluation_seed(seed, 0)`.
        path: of the animation, .gif or .mp4; see `movie_writer`.

    Returns:
        For each sampler, whether each step reported success.
    """
    writer = movie_writer(path)
    episode_seed = evaluation_seed(seed, 0)
    films, successes = {}, []
    with progress_bar(desc="rolling out", unit="step") as progress:
        for sampler in samplers:
            environment = FilmedEnvironment(
                simulator.make(sampler.task, policy.config.num_points), on_step=progress.update
            )
            successes += rollout(
                policy,
                environments=[environment],
                seeds=[episode_seed],
                sampler=sampler,
                text=text[sampler.task],
                generator=torch.Generator().manual_seed(episode_seed),
            )
            environment.success = successes[-1][-1]  # False if it ended because nothing was seen
            environment.film()  # how it ended
            films[sampler.task] = environment.frames
    animate(films, writer, path)
    return successes


# ---- Folders of results --------------------------------------------------------------------------

# What evaluate.py and finetune.py leave in their folder.
RESULTS = [
    "success.json",
    "success.md",
    "success.png",
    "held-out.md",
    "adapted.pt",
    "adapted-[0-9]*.pt",
    "config.json",
    "metrics.jsonl",
]


def claim_results(folder: Path, overwrite: bool) -> list[Path]:
    """Makes a folder for results, and returns the old results in it, which are to be removed.

    The caller removes them when all checks have passed, so that a mistake costs nobody their
    results. Raises UserError if there are any and `overwrite` is False, or if the folder
    holds a training run, which is never overwritten.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.glob("ema-*.pt")) or (folder / "last.pt").exists():
        raise UserError(f"{folder} holds a training run: choose another --out")
    old = [path for name in RESULTS for path in folder.glob(name)]
    if old and not overwrite:
        raise UserError(f"{folder} already holds {old[0].name}: add --overwrite, or another --out")
    return old


# ---- Command line --------------------------------------------------------------------------------


def add_inference_flags(parser: Any) -> None:
    """Adds the flags that change a policy's configuration for rollouts."""
    parser.add_argument(
        "--sampler", choices=("ddim", "dp3"), help="DDIM as published, or as DP3 runs it"
    )
    parser.add_argument(
        "--n-action-steps", type=int, help="actions that are executed of each chunk"
    )
    parser.add_argument("--inference-steps", type=int, help="diffusion steps for each chunk")


def inference_overrides(args: argparse.Namespace) -> dict[str, Any]:
    """Those flags of `add_inference_flags` that were given, by the names of `PolicyConfig`."""
    flags = {
        "sampler": args.sampler,
        "n_action_steps": args.n_action_steps,
        "inference_steps": args.inference_steps,
    }
    return {name: value for name, value in flags.items() if value is not None}


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Measures success in a simulator.")
    add = parser.add_argument
    add(
        "--checkpoint",
        nargs="+",
        help="files or run folders (default: the newest finished run on the suite but for those of "
        "`tiny`, or the policy that ships)",
    )
    add("--suite", help="such as ml10, ml45 (default: the checkpoint's, or ml10)")
    add("--split", choices=("base", "novel", "all"), default="base", help="of the suite's tasks")
    add("--task", nargs="+", help="only these tasks, of the suite's simulator")
    add("--data", default="data", help="folder of the demonstrations (default: data)")
    add(
        "--demonstrations",
        type=int,
        help="demonstrations a task (default: 10 or 5, as the suite says)",
    )
    add("--episodes", type=int, default=20, help="episodes a task (default: 20)")
    add(
        "--top",
        type=int,
        default=0,
        help="all checkpoints of each run, and the mean of its TOP best",
    )
    inputs = ("demonstration", "instruction")
    add(
        "--swap",
        nargs="+",
        choices=inputs,
        default=[],
        help="measure the last checkpoint also with another task's demonstration or instruction",
    )
    add("--without", nargs="+", choices=inputs, default=[], help="zeros in place of these inputs")
    add(
        "--controls",
        nargs="+",
        choices=tuple(DEMONSTRATION_CONTROLS),
        default=[],
        help="measure the last checkpoint also with only a part of the demonstration",
    )
    add("--seed", type=int, default=0, help="of goals, noise and demonstrations (default: 0)")
    add(
        "--known-goals",
        action="store_true",
        help="roll out on the goals of the demonstrations; noise then does not depend on --seed",
    )
    add(
        "--stop-at-success",
        action="store_true",
        help="end an episode at its first success: quicker, and nothing after it is measured",
    )
    add("--out", default="runs/evaluation", help="folder of the report (default: runs/evaluation)")
    add("--overwrite", action="store_true", help="replace the report in that folder")
    add("--gif", metavar="FILE", help="animate one rollout a task instead, .gif or .mp4")
    add(
        "--inner-steps",
        type=int,
        default=0,
        help="inner steps, as in training, that adapt the policy to each task first (default: 0)",
    )
    add("--inner-lr", type=float, help="learning rate of these steps (default: as in training)")
    add("--support", type=int, help="windows for these steps (default: as many as in training)")
    add_inference_flags(parser)
    common.add_common_flags(parser)
    return parser.parse_args(argv)


def check_flags(args: argparse.Namespace) -> None:
    """Raises UserError for what can be refused before any file is read."""
    for name, value, least in (
        ("demonstrations", args.demonstrations, 1),
        ("episodes", args.episodes, 1),
        ("top", args.top, 0),
        ("inner-steps", args.inner_steps, 0),
        ("support", args.support, 1),
    ):
        if value is not None and value < least:
            raise UserError(f"--{name} is {value}: use at least {least}")
    if args.suite not in (None, "own"):
        simulator_of(args.suite)  # raises UserError for an unknown suite
    evaluation_seed(args.seed, args.episodes - 1)  # raises UserError where it is out of range
    for name, value in (("inner-lr", args.inner_lr), ("support", args.support)):
        if value is not None and args.inner_steps == 0:
            raise UserError(f"--{name} is for --inner-steps: give both")
    if args.inner_lr is not None and not 0 <= args.inner_lr < math.inf:
        raise UserError(f"--inner-lr is {args.inner_lr}: use a number from 0")
    if args.gif:
        movie_writer(args.gif)  # raises UserError for what cannot be written
        not_shown = {
            "--known-goals": args.known_goals,
            "--inner-steps": args.inner_steps,
            "--swap": args.swap,
            "--controls": args.controls,
            "--top": args.top,
            "--stop-at-success": args.stop_at_success,
            "--without demonstration": "demonstration" in args.without,
        }
        for flag, given in not_shown.items():
            if given:
                raise UserError(f"--gif: leave out {flag}")
        if len(args.checkpoint or []) > 1:
            raise UserError("--gif shows rollouts of one policy: name one --checkpoint")
    for name in args.swap:
        if name in args.without:
            raise UserError(f"--swap {name} and --without {name}: leave out one of the two")
    if args.controls and "demonstration" in args.without:
        raise UserError("--controls change the demonstration: leave out --without demonstration")
    if args.swap and args.known_goals:
        raise UserError(
            "--known-goals are those of a task's own demonstrations, and --swap shows another's: "
            "leave out one of the two"
        )
    if args.inner_steps and args.n_action_steps is not None:
        raise UserError(
            "--n-action-steps also changes the windows that --inner-steps learn from: leave out one"
        )


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint to measure."""

    path: Path
    label: str  # its column in tables and charts: the run's folder and the file's name
    config: model.PolicyConfig
    info: dict[str, Any]  # what the file says beside the weights, see TRAINED


def choose_checkpoints(
    paths: Sequence[str | Path], top: int, config_overrides: dict[str, Any]
) -> list[list[Checkpoint]]:
    """The checkpoints to measure of each run, in the order of their steps.

    They are all of a run's, or the last one alone where `top` is 0.
    Raises UserError for a run of fewer than `top` checkpoints, and for two of one label.
    """
    runs = []
    for path in paths:
        files = checkpoints_of(path)
        if top > len(files):
            raise UserError(f"{path} holds {len(files)} checkpoints, fewer than --top")
        run = []
        for file in files if top else files[-1:]:
            policy, info = load_trained(file, **config_overrides)
            label = f"{file.resolve().parent.name}/{file.stem}"
            run.append(Checkpoint(file, label, policy.config, info))
        runs.append(run)

    labels = [checkpoint.label for checkpoint in chain(*runs)]
    if len(set(labels)) < len(labels):
        raise UserError("two checkpoints have the same folder and file name: rename one's folder")
    return runs


def choose_tasks(
    args: argparse.Namespace, simulator: Simulator, suite: str, info: dict[str, Any]
) -> list[str]:
    """The tasks to measure: --task, the one a policy was adapted to, or those of the split.

    `info` is the checkpoint's. Base tasks of its own suite are those that it was trained on.
    """
    tasks = list(dict.fromkeys(args.task or []))  # each once
    adapted_to = info.get("adapted_to")
    if adapted_to is not None:
        if tasks and tasks != [adapted_to]:
            raise UserError(f"this policy was adapted to {adapted_to}, not to {' '.join(tasks)}")
        tasks = [adapted_to]
    if tasks:
        for task in tasks:
            check_task(simulator, task)
        return tasks
    base, novel = simulator.tasks(suite)
    if args.split == "novel" and not novel:
        raise UserError(f"--split novel: {suite} has no novel tasks")
    training = info["arguments"]
    if suite == info["suite"] and training.get("base_tasks") is not None:
        base = draw_base_tasks(base, training["base_tasks"], training["seed"])
    return {"base": base, "novel": novel, "all": [*base, *novel]}[args.split]


def check_together(checkpoints: Sequence[Checkpoint]) -> None:
    """Raises UserError for checkpoints that cannot be given the same instruction features."""
    first = checkpoints[0].info
    for checkpoint in checkpoints:
        info = checkpoint.info
        path = checkpoint.path
        if info["text_weights"] != first["text_weights"]:
            raise UserError(f"{path} was made with text weights {info['text_weights']!r}")
        if reads_instruction(info) != reads_instruction(first):
            raise UserError(f"{path}: measure policies with and without --no-instruction apart")


def group_tasks(tasks: Sequence[str], simulator: Simulator, suite: str) -> Parts:
    """The means to report: of base and of novel tasks where there are both, else of all tasks."""
    base, novel = simulator.tasks(suite)
    parts = {
        "mean of base": [task for task in tasks if task in base],
        "mean of novel": [task for task in tasks if task in novel],
    }
    others = [task for task in tasks if task not in base and task not in novel]
    if others or not all(parts.values()):
        return {"mean": list(tasks)}
    return parts


@dataclass(frozen=True)
class Measurement:
    """A column of the report: what is rolled out, and what it is told of each task."""

    label: str
    checkpoint: Path
    recordings: dict[str, Path]
    text: dict[str, Tensor]
    demonstration_control: str | None = None  # see DEMONSTRATION_CONTROLS


def choose_measurements(
    runs: list[list[Checkpoint]],
    recordings: dict[str, Path],
    text: dict[str, Tensor],
    args: argparse.Namespace,
) -> list[Measurement]:
    """Every checkpoint with its tasks' own inputs; of each run the last one also with others.

    The others are those of --controls and --swap.
    """
    measurements, with_other_inputs = [], []
    for run in runs:
        for checkpoint in run:
            measurement = Measurement(
                label=checkpoint.label,
                checkpoint=checkpoint.path,
                recordings=recordings,
                text=text,
                demonstration_control="zeros" if "demonstration" in args.without else None,
            )
            measurements.append(measurement)
        last = measurements[-1]  # of this run
        for control in args.controls:
            with_other_inputs.append(
                replace(last, label=f"{last.label}, {control}", demonstration_control=control)
            )
        for name in args.swap:
            label = f"{last.label}, {name} of another task"
            if name == "demonstration":
                other = replace(last, label=label, recordings=of_next_task(recordings))
            else:
                other = replace(last, label=label, text=of_next_task(text))
            with_other_inputs.append(other)
    return [*measurements, *with_other_inputs]


def recipe_of(checkpoint: Checkpoint) -> tuple:
    """What makes a policy, but for its seed: architecture, training and adaptation."""
    training = {}
    for name, value in checkpoint.info["arguments"].items():
        if name not in ("seed", *FREE_TO_CHANGE):
            training[name] = value
    return checkpoint.config, training, checkpoint.info.get("adaptation")


def mean_successes(
    outcomes: dict[str, Outcomes], runs: list[list[Checkpoint]], parts: Parts, top: int
) -> dict[str, str]:
    """Means over runs, with their intervals: of the last checkpoint, and of the `top` best ones.

    They are of success at any step. Runs are averaged if only their seeds differ.
    """
    recipes = [recipe_of(run[-1]) for run in runs]
    if any(recipe != recipes[0] for recipe in recipes):
        means = {}
        for run in runs:
            for name, mean in mean_successes(outcomes, [run], parts, top).items():
                means[f"{run[-1].label}: {name}"] = mean
        return means

    means = {}
    for name, tasks in parts.items():
        last, best = [], []  # of each run, in percent
        for run in runs:
            rates = []  # of each of its checkpoints
            for checkpoint in run:
                any_step = outcomes[checkpoint.label].any_step
                rates.append(mean_success({task: any_step[task] for task in tasks}))
            last.append(rates[-1])
            best.append(float(np.mean(sorted(rates)[-top:])))
        means[f"{name}, last checkpoint"] = mean_interval(last)
        if top:
            means[f"{name}, best {top} checkpoints"] = mean_interval(best)
    return means


def load_inputs(
    args: argparse.Namespace,
    simulator: Simulator,
    tasks: Sequence[str],
    info: dict[str, Any],
    device: torch.device,
) -> tuple[dict[str, Path], dict[str, Tensor], str]:
    """Collects what is missing of the tasks' demonstrations, and encodes their instructions.

    Returns task -> file of its demonstrations, task -> instruction feature (text_dim,), and the
    identity of CLIP's weights. `info` is that of a checkpoint.
    """
    recordings = collect(
        simulator, tasks, args.data, episodes=args.demonstrations, workers=args.workers
    )
    text, identity = instruction_features(
        {task: load_demonstrations(path).instruction for task, path in recordings.items()},
        weights=args.clip_weights,
        identity=info["text_weights"],
        device=device,
        use_instruction=reads_instruction(info) and "instruction" not in args.without,
    )
    return recordings, text, identity


def watch(
    args: argparse.Namespace,
    checkpoint: Checkpoint,
    simulator: Simulator,
    suite: str,
    tasks: Sequence[str],
    device: torch.device,
) -> None:
    """--gif: animates one rollout of each task."""
    if len(tasks) > MAX_FILMS:
        raise UserError(
            f"--gif draws at most {MAX_FILMS} rollouts: name their tasks, --task reach --gif x.gif"
        )
    _, novel = simulator.tasks(suite)
    needs_adaptation = checkpoint.info["arguments"].get("evaluate_on") != "novel"
    for task in tasks:
        if "adapted_to" not in checkpoint.info and task in novel and needs_adaptation:
            adapt = (
                f"python finetune.py --task {task} --suite {suite} --checkpoint {checkpoint.path}"
            )
            print(f"{task} is novel to this policy: `{adapt}`, then --checkpoint with its folder")
    policy, info = load_trained(checkpoint.path, device, **inference_overrides(args))
    recordings, text, _ = load_inputs(args, simulator, tasks, info, device)
    samplers = []
    for task in tasks:
        demonstrations = load_demonstrations(recordings[task]).take(args.demonstrations)
        samplers.append(WindowSampler(demonstrations, policy.config, device=device))
    successes = write_animation(policy, simulator, samplers, text, seed=args.seed, path=args.gif)
    for task, steps in zip(tasks, successes):
        if steps[-1]:
            outcome = "success at the end"
        elif any(steps):
            outcome = "success, but not at the end"
        else:
            outcome = "failure"
        print(f"{task}: {outcome}")
    print(f"wrote {args.gif}")


def measure(
    args: argparse.Namespace,
    argv: list[str] | None,
    runs: list[list[Checkpoint]],
    simulator: Simulator,
    suite: str,
    tasks: list[str],
    device: torch.device,
) -> None:
    """Rolls out the checkpoints of all runs, and writes and prints the report."""
    out = Path(args.out)
    info = runs[0][-1].info
    if (out / "adapted.pt").exists() or any(out.glob("adapted-[0-9]*.pt")):
        raise UserError(f"{out} holds an adapted policy: choose another --out")
    old_results = claim_results(out, args.overwrite)
    recordings, text, identity = load_inputs(args, simulator, tasks, info, device)
    if args.known_goals:
        for recording in recordings.values():
            episode_seeds_of(recording)  # raises UserError while old results are still there

    outcomes = {}
    with WorkerPool(args.workers) as pool:
        for file in old_results:
            file.unlink()
        for measurement in choose_measurements(runs, recordings, text, args):
            outcomes[measurement.label] = evaluate_checkpoint(
                checkpoint=measurement.checkpoint,
                simulator=simulator,
                recordings=measurement.recordings,
                text=measurement.text,
                episodes=args.episodes,
                seed=args.seed,
                device=device,
                n_demonstrations=args.demonstrations,
                demonstration_control=measurement.demonstration_control,
                inner_steps=args.inner_steps,
                inner_lr=args.inner_lr,
                support=args.support,
                known_goals=args.known_goals,
                stop_at_success=args.stop_at_success,
                config_overrides=inference_overrides(args),
                pool=pool,
            )

    parts = group_tasks(tasks, simulator, suite)
    inner_settings = {}
    if args.inner_steps > 0:
        inner_settings["inner rate"] = "as in training" if args.inner_lr is None else args.inner_lr
        inner_settings["support"] = args.support or "as in training"
    by_name = args.task or "adapted_to" in info
    provenance = {
        "title": " ".join(tasks) if by_name else f"{suite}, {args.split} tasks",
        "episodes a task": len(next(iter(outcomes.values())).any_step[tasks[0]]),
        "seed": args.seed,
        "goals": "of the demonstrations, each once" if args.known_goals else "new",
        "left out": " and ".join(args.without) or "nothing",
        "inner steps": args.inner_steps,
        **inner_settings,
        "text weights": identity,
        **common.provenance("evaluate.py", argv, device),
        **inference_overrides(args),
        **mean_successes(outcomes, runs, parts, args.top),
    }
    earlier = {checkpoint.label for run in runs for checkpoint in run[:-1]}
    shown = {label: outcome for label, outcome in outcomes.items() if label not in earlier}
    table = write_report(
        out,
        shown,
        provenance,
        parts=parts,
        paper=paper_columns(suite, dict.fromkeys(run[-1].config.policy for run in runs)),
        checkpoints={c.label: outcomes[c.label] for c in chain(*runs)} if args.top else None,
        pooled=info["arguments"].get("evaluate_on") == "novel" and len(shown) > 1,
    )
    print(f"\n{table}\n")
    for name, value in provenance.items():
        print(f"{name}: {value}")


def main(argv: list[str] | None = None) -> None:
    args = parse(argv)
    check_flags(args)
    device = common.pick_device(args.device, args.threads)

    # Which checkpoints, in which simulator, on which tasks
    paths = args.checkpoint or [default_checkpoint(args.suite or "ml10")]
    runs = choose_checkpoints(paths, args.top, inference_overrides(args))
    info = runs[0][-1].info
    suite = args.suite or info["suite"]
    if suite == "own":
        raise UserError("a policy of own recordings has no simulator to be measured in")
    simulator = simulator_of(suite)
    if args.demonstrations is None:
        args.demonstrations = simulator.demonstrations
    tasks = choose_tasks(args, simulator, suite, info)
    check_together(list(chain(*runs)))
    for checkpoint in chain(*runs):
        if choose_tasks(args, simulator, suite, checkpoint.info) != tasks:
            raise UserError(
                f"{checkpoint.path} and {runs[0][-1].path} are for different tasks: measure each "
                "alone, or, unless one was adapted to a task, name --task"
            )
    if args.swap and len(tasks) < 2:
        raise UserError(
            "--swap gives a task the input of another one that is measured, and this is one alone: "
            "name two --task, or measure a split"
        )

    if args.gif:
        watch(
            args,
            checkpoint=runs[0][-1],
            simulator=simulator,
            suite=suite,
            tasks=tasks,
            device=device,
        )
        return
    with common.locked(Path(args.out)):
        measure(args, argv, runs=runs, simulator=simulator, suite=suite, tasks=tasks, device=device)


if __name__ == "__main__":
    common.command_line(main, errors=(RecordingError, CheckpointError, TextWeightsError))
