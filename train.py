"""Meta-training (Algorithm 1): second-order MAML over all tasks of a suite.

    python train.py --suite ml10                        # collects demonstrations, trains, evaluates
    python train.py --suite ml10 --preset tiny          # the same in a minute, to see it work
    python train.py --suite ml10 --resume               # goes on where an interrupted run stopped
    python train.py --suite ml10 --policy dp3 --maml off    # multi-task DP3; see baselines.py
    python train.py --data recordings                   # own tasks: every recording in a folder
    torchrun --nproc-per-node 4 train.py --suite ml10   # tasks shared among 4 processes

`meta_train` is Algorithm 1, `task_batch` draws what it reads; `run` does what happens around it.

The random numbers of a batch follow from the seed, the outer step and the number of the task. So a
run that is killed and resumed ends with the same bits as one that is not, on a CPU with the same
number of threads; and processes that share the tasks draw what a single one would.
"""

import argparse
import copy
import hashlib
import json
import math
import os
import shlex
import time
from collections.abc import Iterator, Sequence
from contextlib import nullcontext, suppress
from dataclasses import asdict, dataclass, replace
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor
from torch.optim.swa_utils import AveragedModel

import baselines
import common
import evaluate
import model
import report
from clip import TextWeightsError
from common import (
    CUDAGraphed,
    StopRequest,
    UserError,
    WorkerPool,
    append_json,
    choose,
    read_json_lines,
    setting,
)
from data import (
    Demonstrations,
    RecordingError,
    WindowSampler,
    hold_out,
    load_demonstrations,
    suspicions,
    write_text,
)
from maml import InnerRate, meta_gradient
from model import TASK_INPUTS, CheckpointError, DAMIPolicy, PolicyConfig, ema_model, split
from report import Outcomes
from simulator import (
    SIMULATORS,
    Simulator,
    collect,
    draw_base_tasks,
    made_by_simulator,
    simulator_of,
)

# ---- Settings ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Settings:
    """What a training is made of. Each field made by `setting` is a flag.

    Every checkpoint keeps all of them (`arguments`). The defaults are the paper's (3000
    epochs of 18 outer steps), except for the warm-up, which is DP3's.
    """

    suite: str = "ml10"  # or "own", for own recordings
    preset: str = "paper"
    seed: int = setting(0, "of weights, batches and noise", least=0, most=2**32 - 1)
    maml: str = setting("second", "order of the meta-gradient", choices=("second", "first", "off"))
    steps: int = setting(54_000, "outer steps", least=1)
    support: int = setting(20, "windows a task for the inner step", least=1)
    query: int = setting(88, "windows a task for the outer loss", least=1)
    inner_lr: float = setting(1e-4, "learning rate of the inner step", least=0)
    learn_inner_lr: bool = setting(
        False, "learn a rate of the inner step for each tensor of weights, starting from --inner-lr"
    )
    rate_lr: float = setting(
        1e-2, "peak learning rate of AdamW for the logarithms of learned inner rates", least=0
    )
    lr: float = setting(1e-4, "peak learning rate of AdamW", least=0)
    warmup: int = setting(500, "steps of linear warm-up", least=0)
    pretrain_fraction: float = setting(
        0.0, "fraction of the outer steps, at the beginning, without an inner step", least=0, most=1
    )
    vectorize: int = setting(1, "tasks that run at once; memory grows with them", least=1)
    bfloat16: bool = setting(False, "compute steps without an inner step in bfloat16")
    after_success: int | None = setting(
        None, "windows that begin more than this many frames after success are late", least=0
    )
    late_fraction: float = setting(
        0.0, "fraction of late windows in a batch; 0 leaves them out", least=0, most=1
    )
    augment: bool = setting(False, "shift, turn and stretch each scene at random")
    one_map: bool = setting(
        False, "augment all scenes of a batch alike, its demonstration included"
    )
    instruction_dropout: float = setting(
        0.0, "fraction of the batches without instruction", least=0, most=1
    )
    task_dropout: float = setting(
        0.0, "fraction of the inner steps without instruction and demonstration", least=0, most=1
    )
    base_tasks: int | None = setting(
        None, "base tasks to train on, drawn by the seed (default: all)", least=1
    )
    tasks_per_step: int | None = setting(
        None, "tasks of each outer step, drawn at random (default: all)", least=1
    )
    demonstrations: int | None = setting(10, "demonstrations a task (own: all)", least=1)
    held_out: int = setting(
        0, "the last demonstrations of each task, kept for measuring only", least=0
    )
    checkpoint_every: int = setting(3_600, "steps between EMA checkpoints", least=1)
    evaluate_every: int = setting(3_600, "steps between evaluations", least=1)
    episodes: int = setting(20, "evaluation episodes a task; 0: never evaluate", least=0)
    evaluate_on: str = setting("base", "tasks to evaluate on", choices=("base", "novel"))

    def __post_init__(self) -> None:
        common.check_settings(self)
        if self.learn_inner_lr and self.inner_lr == 0:
            raise UserError("--inner-lr is 0: --learn-inner-lr starts from a rate above 0")

    @property
    def pretrain_steps(self) -> int:
        """The number of steps, at the beginning, that have no inner step."""
        return self.steps if self.maml == "off" else round(self.pretrain_fraction * self.steps)


# ---- Algorithm 1 ---------------------------------------------------------------------------------


def task_batch(
    policy: DAMIPolicy,
    sampler: WindowSampler,
    text: Tensor,
    n: int,
    seed: tuple[int, ...],
    settings: Settings,
    inner: bool = False,
) -> dict[str, Tensor]:
    """Draws n windows, a complete reference demonstration, noise and timesteps (lines 5, 6 and 9).

    The first `settings.support` windows are the support set. With three or more episodes, support
    and query windows come from different ones; the paper draws both from the same.

    Where the instruction names the task, a policy need read nothing else. In a fraction of the
    batches (`instruction_dropout`) zeros therefore take its place, and only the demonstration tells
    the task. Where an inner step follows (`inner`), both are zeros in a fraction of the batches
    (`task_dropout`): then only the support windows tell the task.

    Returns the keyword arguments of `policy.loss`, on the device of `text`. They follow from `seed`
    alone.
    """
    seed_of_batch, seed_of_dropout = np.random.SeedSequence(seed).generate_state(2, np.uint64)
    generator = torch.Generator().manual_seed(int(seed_of_batch))
    batch = policy.draw_batch(sampler, text, n, generator, support=settings.support)

    generator = torch.Generator().manual_seed(int(seed_of_dropout))
    drop_instruction, drop_task = torch.rand(2, generator=generator)
    if inner and drop_task < settings.task_dropout:
        dropped = TASK_INPUTS
    elif drop_instruction < settings.instruction_dropout:
        dropped = ("text",)
    else:
        dropped = ()
    for name in dropped:
        batch[name] = torch.zeros_like(batch[name])
    return batch


def multi_task_loss(policy: DAMIPolicy, batches: list[dict[str, Tensor]]) -> Tensor:
    """The mean loss () of all windows of all tasks, whose batches have equally many windows."""
    if len({batch["demo_points"].shape for batch in batches}) == 1:  # demonstrations can be stacked
        batches = [{name: torch.cat([b[name] for b in batches]) for name in batches[0]}]
    return torch.stack([policy.loss(**batch) for batch in batches]).mean()


def multi_task_gradient(
    policy: DAMIPolicy, batches: list[dict[str, Tensor]], bfloat16: bool = False
) -> tuple[dict[str, Tensor], Tensor]:
    """The gradient of ordinary multi-task training: all windows of all tasks, no inner step.

    `batches` are those of `task_batch`, one for each task. With `bfloat16`, matrix products and
    convolutions are computed in it, and the gradient stays float32. Returns parameter name ->
    gradient, and the loss ().
    """
    with torch.autocast(batches[0]["action"].device.type, torch.bfloat16, enabled=bfloat16):
        loss = multi_task_loss(policy, batches)
    parameters = dict(policy.named_parameters())
    gradients = torch.autograd.grad(loss, list(parameters.values()))
    return dict(zip(parameters, gradients)), loss.detach()


def rate_in_training(log_rates: dict[str, Tensor], settings: Settings) -> InnerRate:
    """alpha, as maml.py takes it: the learned rate of each tensor, or the one of --inner-lr."""
    if not log_rates:
        return settings.inner_lr
    return {name: log_rate.exp() for name, log_rate in log_rates.items()}


def maml_gradient(
    policy: DAMIPolicy,
    batches: list[dict[str, Tensor]],
    log_rates: dict[str, Tensor],
    settings: Settings,
    vectorize: int,
) -> tuple[dict[str, Tensor], dict[str, Tensor], Tensor]:
    """The gradient of the query loss through each task's inner step (lines 7 to 19).

    `DAMIPolicy.loss` is lines 7 to 13 and 15 to 17, `maml.adapt` is line 14, and the way back is
    `maml.meta_gradient` (line 18). `batches` has one of `task_batch` for each task; `vectorize`
    tasks run at once. `log_rates` are those of the `TrainingState`. Returns parameter name ->
    gradient, the same for `log_rates`, and the mean query loss after the inner step, ().
    """
    inner_lr = rate_in_training(log_rates, settings)
    gradients, rate_gradients, losses = meta_gradient(
        partial(model.loss_of, policy),
        dict(policy.named_parameters()),
        [split(batch, settings.support) for batch in batches],
        lr=inner_lr,
        first_order=settings.maml == "first",
        vectorize=vectorize,
    )
    # d L / d log(alpha) = alpha * d L / d alpha
    log_rate_gradients = {name: inner_lr[name] * g for name, g in rate_gradients.items()}
    return gradients, log_rate_gradients, losses.mean()


def tasks_of_step(step: int, tasks: int, settings: Settings) -> list[int]:
    """The numbers of an outer step's tasks: all, or as many as the settings say."""
    if settings.tasks_per_step is None or settings.tasks_per_step >= tasks:
        return list(range(tasks))
    rng = np.random.default_rng((settings.seed, step))
    return sorted(rng.choice(tasks, settings.tasks_per_step, replace=False).tolist())


def learning_rate(step: int, settings: Settings, peak: float) -> float:
    """Rises linearly to the peak, then falls along half a cosine, to 0 one step after the last."""
    if step < settings.warmup:
        return peak * (step + 1) / settings.warmup
    done, steps = step - settings.warmup, max(1, settings.steps - settings.warmup)
    return peak * 0.5 * (1 + math.cos(math.pi * done / steps))


@dataclass
class TrainingState:
    """Everything that training changes: what last.pt keeps, so that a run can go on from it."""

    policy: DAMIPolicy
    average: AveragedModel  # of the policy; its `.module` is what is kept and rolled out
    optimizer: torch.optim.Optimizer
    # Parameter name -> the logarithm () of its inner learning rate, which keeps the rate positive;
    # empty where the rate is fixed. These are not averaged.
    log_rates: dict[str, Tensor]
    step: int = 0  # outer steps that are done
    seconds: float = 0.0  # that they took

    def progress(self) -> dict[str, Any]:
        """What every checkpoint says of the training so far; rates only where they are learned."""
        return {
            "step": self.step,
            "seconds": self.seconds,
            "inner_rates": {name: rate.exp().item() for name, rate in self.log_rates.items()},
        }


def start_training(
    config: PolicyConfig,
    settings: Settings,
    samplers: dict[str, WindowSampler],
    device: str | torch.device = "cpu",
) -> TrainingState:
    """Line 1: fresh weights, their average, and AdamW.

    The normalizer, which Algorithm 1 leaves out, is fitted to the data of all tasks.
    """
    torch.manual_seed(settings.seed)
    policy = model.build_policy(config).to(device)
    policy.normalizer.fit(samplers.values())
    optimizer = torch.optim.AdamW(
        policy.parameters(), lr=settings.lr, betas=(0.95, 0.999), weight_decay=1e-6, fused=True
    )
    log_rates = {}
    if settings.learn_inner_lr:
        start = math.log(settings.inner_lr)
        log_rates = {name: p.new_tensor(start) for name, p in policy.named_parameters()}
        optimizer.add_param_group({"params": list(log_rates.values()), "weight_decay": 0.0})
    return TrainingState(policy, ema_model(policy), optimizer, log_rates)


LOSS_BEFORE_EVERY = 10  # steps; it serves the log alone


def meta_train(
    state: TrainingState,
    samplers: dict[str, WindowSampler],
    text: dict[str, Tensor],
    settings: Settings,
    *,
    rank: int = 0,
    world: int = 1,
) -> Iterator[dict[str, float]]:
    """Algorithm 1: trains the policy of `state`, from its step on.

    Args:
        state: it is changed in place.
        samplers, text: task -> its windows, and its instruction feature (text_dim,).
        rank, world: this process's number, and how many processes share the tasks.

    Yields:
        Figures of each outer step: loss, gradient_norm and lr. Where there is an inner step, loss
        is the query loss after it, and every tenth step (0, 10, 20 ...) has the query loss before
        it as well, loss_before. Where rates of the inner step are learned, inner_lr is their
        geometric mean.

    Raises:
        UserError: the loss or its gradient is not finite. The step changed nothing then.
    """
    policy = state.policy
    all_tasks = list(samplers)

    # If all episodes have the same length, batches of several tasks can be stacked. Their shapes
    # then never change, so that, on a GPU, either kind of step can be one CUDA graph.
    lengths = {e.stop - e.start for sampler in samplers.values() for e in sampler.episodes}
    vectorize = settings.vectorize if len(lengths) == 1 else 1
    without_inner_step = partial(multi_task_gradient, policy, bfloat16=settings.bfloat16)
    through_inner_step = partial(
        maml_gradient, policy, log_rates=state.log_rates, settings=settings, vectorize=vectorize
    )
    if policy.device.type == "cuda" and len(lengths) == 1 and world == 1:
        without_inner_step = CUDAGraphed(without_inner_step)
        through_inner_step = CUDAGraphed(through_inner_step)

    for step in range(state.step, settings.steps):  # lines 2, 22
        inner = step >= settings.pretrain_steps
        task_numbers = tasks_of_step(step, len(all_tasks), settings)  # line 3
        my_task_numbers = task_numbers[rank::world]
        batches = []  # all are drawn first, then `vectorize` tasks at a time are adapted
        for i in my_task_numbers:  # lines 4 to 6, 9
            task = all_tasks[i]
            batch = task_batch(
                policy,
                samplers[task],
                text[task],
                n=settings.support + settings.query,
                seed=(settings.seed, step, i),
                settings=settings,
                inner=inner,
            )
            batches.append(batch)

        # The gradient of the mean loss over my tasks
        if inner:
            gradients, log_rate_gradients, loss = through_inner_step(batches)  # lines 7 to 19
        else:
            gradients, loss = without_inner_step(batches)
            log_rate_gradients = {}
        figures = {"loss": loss}
        if inner and step % LOSS_BEFORE_EVERY == 0:
            queries = [split(batch, settings.support)[1] for batch in batches]
            with torch.no_grad():
                figures["loss_before"] = multi_task_loss(policy, queries)

        # Each process has the mean over its own tasks. Weighted by how many those are, they add up
        # to the mean over all.
        if world > 1:
            for x in (*figures.values(), *gradients.values(), *log_rate_gradients.values()):
                dist.all_reduce(x.mul_(len(my_task_numbers) / len(task_numbers)))

        if state.log_rates:
            figures["inner_lr"] = torch.stack(list(state.log_rates.values())).mean().exp()
        figures["gradient_norm"] = torch.nn.utils.get_total_norm(gradients.values())
        if not torch.isfinite(figures["loss"] + figures["gradient_norm"]):
            raise UserError(
                f"the loss or its gradient is not finite at step {step + 1}: train again with a "
                "smaller --lr or --inner-lr, in another --out (what was saved before is whole)"
            )

        # One step of AdamW, and one of the moving average, which is what is kept and rolled out
        for name, parameter in policy.named_parameters():
            parameter.grad = gradients[name]
        for name, log_rate in state.log_rates.items():
            log_rate.grad = log_rate_gradients.get(name)  # None without inner step: AdamW skips it
        lr = learning_rate(step, settings, peak=settings.lr)
        state.optimizer.param_groups[0]["lr"] = lr
        if settings.learn_inner_lr:
            rate_lr = learning_rate(step, settings, peak=settings.rate_lr)
            state.optimizer.param_groups[1]["lr"] = rate_lr
        state.optimizer.step()  # line 20
        state.average.update_parameters(policy)  # line 21
        state.step = step + 1
        yield {**{name: x.item() for name, x in figures.items()}, "lr": lr}


# ---- Checkpoints, and last.pt, which a run goes on from ------------------------------------------

# last.pt is written every SAVE_SECONDS, so a killed run loses little more. A file that is slow to
# write is written less often, so that writing takes at most about SAVE_SHARE of the time.
SAVE_SECONDS = 20
SAVE_SHARE = 0.04

# Beside `evaluate.FREE_TO_CHANGE` these may differ while no inner step has been taken.
OF_INNER_STEP = ("maml", "inner_lr", "learn_inner_lr", "rate_lr", "task_dropout")


# These follow from recordings.
OF_RECORDINGS = ("point_dim", "state_dim", "action_dim", "demo_positions")


def is_due(step: int, every: int, settings: Settings) -> bool:
    """Whether something that is done every `every` steps and after the last is done after this."""
    return step == settings.steps or step % every == 0


def is_milestone(step: int, settings: Settings) -> bool:
    """Whether the moving average is kept after this step."""
    every = (settings.checkpoint_every, settings.evaluate_every)
    return any(is_due(step, n, settings) for n in every)


def save_average(folder: Path, state: TrainingState, info: dict[str, Any]) -> None:
    """Writes the moving average, and `info`, to the checkpoint of this step."""
    path = evaluate.ema_checkpoint(folder, state.step)
    model.save(path, state.average.module, **state.progress(), **info)


class Saver:
    """Writes a run's last.pt, often enough to lose little, rarely enough to cost little."""

    def __init__(self, path: Path, info: dict[str, Any]) -> None:
        self.path = path
        self.info = info
        self.last_saved = time.monotonic()  # or when the run began
        self.took = 0.0  # seconds

    def is_due(self) -> bool:
        waited = time.monotonic() - self.last_saved
        return waited > max(SAVE_SECONDS, self.took / SAVE_SHARE)

    def save(self, state: TrainingState) -> None:
        began = time.monotonic()
        training = {
            "policy": state.policy.state_dict(),
            "optimizer": state.optimizer.state_dict(),
            "n_averaged": state.average.n_averaged,
            "log_rates": state.log_rates,
        }
        average = state.average.module
        model.save(self.path, average, training=training, **state.progress(), **self.info)
        self.last_saved = time.monotonic()
        self.took = self.last_saved - began


def restore(path: Path, state: TrainingState, settings: Settings, digest: str) -> dict[str, Any]:
    """Brings a fresh state to where last.pt left it; returns what else that file says.

    `digest` is the `fingerprint` of what is trained on. Raises UserError for a run that was
    started with other settings, or on other recordings.
    """
    policy, config = state.policy, state.policy.config
    averaged, info = model.load(
        path, policy.device, needs=(*evaluate.TRAINED, "training", "recordings", "provenance")
    )

    try:
        settings_then = Settings(**info["arguments"])  # newer fields take their defaults
    except TypeError as error:
        raise UserError(f"{path} is of another version of the code: {error}") from error
    may_differ = set(evaluate.FREE_TO_CHANGE)
    if info["recordings"] != digest:  # as is said below
        may_differ.update(OF_RECORDINGS)
    if info["step"] <= min(settings.pretrain_steps, settings_then.pretrain_steps):
        may_differ.update(OF_INNER_STEP)
    differences = []
    for now, then in ((settings, settings_then), (config, averaged.config)):
        for name, value in asdict(now).items():
            if getattr(then, name) != value and name not in may_differ:
                differences.append(f"{name} {getattr(then, name)} -> {value}")
    if differences:
        raise UserError(
            f"{path.parent} was started with other settings ({', '.join(differences)}): "
            "give the old ones to resume it"
        )
    if info["recordings"] != digest:
        raise UserError(f"{path.parent} was started on other recordings: bring those back")

    policy.load_state_dict(info["training"]["policy"])
    state.average.module.load_state_dict(averaged.state_dict())
    state.average.n_averaged.copy_(info["training"]["n_averaged"])
    # The group of the inner rates keeps its new settings: they may have been turned on, or changed,
    # before the first inner step.
    optimizer_state = info["training"]["optimizer"]
    optimizer_state["param_groups"][1:] = state.optimizer.state_dict()["param_groups"][1:]
    state.optimizer.load_state_dict(optimizer_state)
    if info["step"] > settings.pretrain_steps:
        for name, log_rate in state.log_rates.items():
            log_rate.copy_(info["training"]["log_rates"][name])
    state.step, state.seconds = info["step"], info["seconds"]
    return info


def fingerprint(samplers: dict[str, WindowSampler]) -> str:
    """A digest of everything that is trained on."""
    sha = hashlib.sha256()
    for sampler in samplers.values():
        sha.update(f"{sampler.task} {sampler.instruction}".encode())
        if sampler.augment:
            sha.update(f"{sampler.one_map}".encode())
            sha.update(f"{sampler.positions_in_state} {sampler.center.tolist()}".encode())
            if sampler.rotation_near is not None:
                sha.update(f"{sampler.rotation_near.tolist()}".encode())
        for part in (sampler.points, sampler.state, sampler.action, sampler.windows):
            sha.update(part.cpu().numpy().tobytes())
        if sampler.late.any():
            sha.update(sampler.late.cpu().numpy().tobytes())
    return sha.hexdigest()


# ---- What is measured while a run goes on --------------------------------------------------------


@dataclass(frozen=True)
class Evaluation:
    """Rollouts of a run's checkpoints, at the steps where they are due."""

    folder: Path
    settings: Settings
    simulator: Simulator | None  # None: own recordings, which are rolled out nowhere
    recordings: dict[str, Path]
    n_demonstrations: int | None  # of each recording, one of which is the reference; None: all
    text: dict[str, Tensor]
    workers: int | None
    device: torch.device

    def roll_out(
        self,
        checkpoint: Path,
        *,
        recordings: dict[str, Path] | None = None,
        demonstration_control: str | None = None,
        inner_steps: int = 0,
        pool: WorkerPool | None = None,
    ) -> Outcomes:
        """Rolls a checkpoint out, with the demonstrations of `recordings` or of the tasks' own.

        The other arguments are those of `evaluate.evaluate_checkpoint`.
        """
        return evaluate.evaluate_checkpoint(
            checkpoint=checkpoint,
            simulator=self.simulator,
            recordings=recordings or self.recordings,
            text={task: self.text[task] for task in self.recordings},
            episodes=self.settings.episodes,
            seed=evaluate.EVALUATION_SEED,
            workers=self.workers,
            device=self.device,
            n_demonstrations=self.n_demonstrations,
            demonstration_control=demonstration_control,
            inner_steps=inner_steps,
            pool=pool,
        )

    def run(self, step: int, stop: StopRequest) -> Outcomes | None:
        """Rolls out the checkpoint of a step and logs the outcomes, or reads them from the log.

        Returns None if no evaluation is due. Ctrl-C stops it at once, since the run is saved.
        """
        settings = self.settings
        due = is_due(step, settings.evaluate_every, settings)
        if self.simulator is None or settings.episodes == 0 or not due:
            return None
        for line in read_json_lines(self.folder / "metrics.jsonl"):
            if line["step"] == step and "successes_at_end" in line:
                logged = Outcomes(
                    line["successes"], line["successes_at_end"], line.get("successes_at_other_task")
                )
                if all(len(x) == settings.episodes for x in logged.any_step.values()):
                    return logged  # otherwise --episodes was another then
        try:
            with stop.suspended():
                outcomes = self.roll_out(evaluate.ema_checkpoint(self.folder, step))
        except KeyboardInterrupt:
            raise KeyboardInterrupt("all is saved, add --resume to go on") from None
        append_json(
            self.folder / "metrics.jsonl",
            step=step,
            success=report.mean_success(outcomes.any_step),
            success_at_end=report.mean_success(outcomes.at_end),
            successes=outcomes.any_step,
            successes_at_end=outcomes.at_end,
            successes_at_other_task=outcomes.other_task,
        )
        return outcomes

    def contributions(
        self, own: Outcomes, reads_demonstration: bool, stop: StopRequest
    ) -> dict[str, Outcomes]:
        """What demonstration and inner step contribute to success on the tasks that are measured.

        Title -> outcomes of the last checkpoint, which is shown
        - each task's own demonstration (`own`, which is measured already),
        - that of another task,
        - and zeros in place of a demonstration.
        If training had inner steps, all three again after one, on windows of the task whose
        demonstration is read. It also animates the first two tasks, from one seed.
        """
        settings = self.settings
        checkpoint = evaluate.ema_checkpoint(self.folder, settings.steps)
        own_title = "own demonstration" if reads_demonstration else "no demonstration"
        # Title -> whose demonstrations are read, and the control of `evaluate.controlled`
        inputs: dict[str, tuple[dict[str, Path], str | None]] = {own_title: (self.recordings, None)}
        if reads_demonstration and len(self.recordings) > 1:
            inputs["another task's"] = (evaluate.of_next_task(self.recordings), None)
        if reads_demonstration:
            inputs["none"] = (self.recordings, "zeros")
        has_inner_step = settings.pretrain_steps < settings.steps
        columns = {own_title: own}
        try:
            with stop.suspended(), WorkerPool(self.workers) as pool:
                for inner_steps in (0, 1) if has_inner_step else (0,):
                    for title, (recordings, control) in inputs.items():
                        label = f"{title}, after an inner step" if inner_steps else title
                        if label not in columns:
                            columns[label] = self.roll_out(
                                checkpoint,
                                recordings=recordings,
                                demonstration_control=control,
                                inner_steps=inner_steps,
                                pool=pool,
                            )
            with stop.suspended():
                self.animate(checkpoint)
        except KeyboardInterrupt:
            raise KeyboardInterrupt("all is saved, add --resume to go on") from None
        return columns

    def animate(self, checkpoint: Path) -> None:
        """Writes goals.gif: the first two tasks, from one seed."""
        policy, _ = evaluate.load_trained(checkpoint, self.device)
        samplers = [
            WindowSampler(
                load_demonstrations(path).take(self.n_demonstrations),
                policy.config,
                device=self.device,
            )
            for path in list(self.recordings.values())[:2]
        ]
        evaluate.write_animation(
            policy, self.simulator, samplers, self.text, seed=0, path=self.folder / "goals.gif"
        )


def log_heldout_errors(
    folder: Path,
    state: TrainingState,
    train_samplers: dict[str, WindowSampler],
    heldout_samplers: dict[str, WindowSampler],
    text: dict[str, Tensor],
    settings: Settings,
) -> None:
    """Logs the average policy's action errors on held-out episodes, and writes held-out.md.

    One of its tables has the errors of each task, at the first and at the last step at which they
    were measured. The other one has the errors of each number of an action, as means over tasks;
    after the last step of training also with other demonstrations, and after inner steps
    (`heldout_controls`).
    """
    policy = state.average.module
    measured = evaluate.evaluate_heldout(policy, train_samplers, heldout_samplers, text)
    errors = {task: float(error.of_policy.mean()) for task, error in measured.items()}
    append_json(
        folder / "metrics.jsonl",
        step=state.step,
        action_error=float(np.mean(list(errors.values()))),
        action_errors=errors,
    )
    lines = [line for line in read_json_lines(folder / "metrics.jsonl") if "action_errors" in line]
    columns = {f"step {line['step']}": line["action_errors"] for line in (lines[0], lines[-1])}
    columns["the mean action"] = {
        task: float(error.of_mean_action.mean()) for task, error in measured.items()
    }
    rows = {
        "the mean action": np.mean([error.of_mean_action for error in measured.values()], axis=0),
        f"step {state.step}": mean_of_tasks(measured),
    }
    if state.step == settings.steps:
        controls = heldout_controls(
            policy,
            train_samplers,
            heldout_samplers,
            text,
            settings,
            inner_lr=rate_in_training(state.log_rates, settings),
        )
        rows.update(controls)
    names = next(iter(train_samplers.values())).action_names
    tables = [report.heldout_table(columns), report.action_error_table(rows, names)]
    write_text(folder / "held-out.md", "\n\n".join([*tables, f"{report.HELDOUT_NOTE}\n"]))


def mean_of_tasks(measured: dict[str, evaluate.ActionError]) -> np.ndarray:
    """The policy's errors (A,), as a mean over tasks."""
    return np.mean([error.of_policy for error in measured.values()], axis=0)


def heldout_controls(
    policy: DAMIPolicy,
    train_samplers: dict[str, WindowSampler],
    heldout_samplers: dict[str, WindowSampler],
    text: dict[str, Tensor],
    settings: Settings,
    inner_lr: InnerRate,
) -> dict[str, np.ndarray]:
    """Title -> held-out errors (A,), means over tasks: with other demonstrations or after steps.

    They stand in for the rollouts of `Evaluation.contributions` where nothing can be rolled out.
    """
    measure = partial(evaluate.evaluate_heldout, policy, train_samplers, heldout_samplers, text)
    rows = {}
    if policy.config.reads_demonstration and len(train_samplers) > 1:
        rows["another task's demonstration"] = mean_of_tasks(measure(swap_demonstrations=True))
    if policy.config.reads_demonstration:
        rows["zeros for a demonstration"] = mean_of_tasks(measure(demonstration_control="zeros"))
    if settings.pretrain_steps == settings.steps:  # there was no inner step in training
        return rows

    measured = {1: {}, 5: {}}  # inner steps -> task -> its action error
    for task, heldout_sampler in heldout_samplers.items():
        sampler = copy.copy(train_samplers[task])
        sampler.augment = False  # finetune.py --inner-steps, too, leaves scenes as they are
        of_each_step = evaluate.take_inner_steps(
            policy,
            sampler,
            text[task],
            steps=5,
            batch=settings.support,
            lr=inner_lr,
            seed=evaluate.inner_seed(settings.seed, task),
        )
        try:
            for step, _, adapted in of_each_step:
                if step in measured:
                    measured[step][task] = evaluate.action_error(
                        adapted, sampler, heldout_sampler, text[task]
                    )
        except UserError as error:  # of five steps, where training took one
            print(f"inner steps on held-out episodes were not measured: {error}", flush=True)
    for step, of_tasks in measured.items():
        if len(of_tasks) == len(heldout_samplers):
            rows[f"after {common.count(step, 'inner step')}"] = mean_of_tasks(of_tasks)
    return rows


def report_training(
    folder: Path,
    settings: Settings,
    simulator: Simulator | None,
    policy: str,
    seconds: float,
    provenance: dict[str, Any],
    columns: dict[str, Outcomes],
) -> None:
    """Writes and prints the results of a finished run, and prints what can be done with it."""
    if columns:
        report.plot_curves(folder)
        table = report.write_report(
            folder,
            columns,
            {
                "title": f"{settings.suite}, {settings.evaluate_on} tasks, "
                f"{settings.preset}, {policy}",
                "seed": evaluate.EVALUATION_SEED,
                "episodes a task": settings.episodes,
                "training": f"{seconds / 60:.1f} min",
                "training seed": settings.seed,
                **provenance,
            },
            paper=report.paper_columns(settings.suite, [policy]),
            pooled=settings.evaluate_on == "novel",
        )
        print(f"\n{table}")
    if (folder / "held-out.md").exists():
        print(f"\n{(folder / 'held-out.md').read_text(encoding='utf-8').rstrip()}")

    files = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    print(f"\n{folder} is finished: {', '.join(files)}")
    if simulator is None:
        new = "--data NEW.npz"
    elif simulator.tasks(settings.suite)[1]:
        new = f"--task novel --suite {settings.suite}"
    else:
        return  # there are no novel tasks to adapt to
    print(f"next: python finetune.py {new} --checkpoint {shlex.quote(str(folder))}")


# ---- Presets, and what suites change -------------------------------------------------------------

# What a preset changes; the architecture of the same name is in baselines.PRESETS.
# fmt: off
SETTINGS = {
    "paper": Settings(),
    "small": Settings(
        preset="small", steps=8_000, support=4, query=12, lr=1e-3, warmup=100,
        pretrain_fraction=0.9,  # a step without an inner step takes a third of the time
        after_success=20,  # three fifths of the experts' frames are later ...
        late_fraction=0.15,  # ... and show how to stay; many of them cost success elsewhere
        instruction_dropout=0.2,  # otherwise the policy ignores the demonstration
        task_dropout=0.25, inner_lr=3e-3,  # without task inputs the inner step must find the task
        vectorize=10, augment=True, checkpoint_every=1_000, evaluate_every=8_000,
    ),
    "tiny": Settings(
        preset="tiny", steps=30, support=4, query=8, inner_lr=1e-3, lr=3e-3, warmup=5, vectorize=10,
        after_success=20, demonstrations=2, checkpoint_every=15, evaluate_every=30, episodes=2,
    ),
}
# fmt: on


# What a suite of hidden goals changes, in every preset. The instruction tells nothing, and need
# not be left out for the demonstration to be read. One map moves all scenes of a task, which makes
# new goals; a map of each scene's own would hide the goal. What was learned is measured on novel
# goals, without adapting to them.
HIDDEN_GOALS = {
    "base_tasks": 160,
    "demonstrations": 3,  # one to read, one for the support windows, one for the query windows
    "tasks_per_step": 16,
    "augment": True,
    "one_map": True,
    "instruction_dropout": 0.0,
    "task_dropout": 0.0,
    "after_success": None,  # episodes are short, and end soon after their success
    "late_fraction": 0.0,
    "evaluate_on": "novel",
    "episodes": 2,
}
# What it changes besides in `small`: many goals a step, and few windows of each. At the learning
# rate of other suites, 1e-3, one of two trainings got stuck at a loss at which the goal is read
# only in part. Where the hand has to find the puck first, more steps are needed.
HIDDEN_GOALS_SMALL = {
    "lr": 5e-4,
    "tasks_per_step": 40,
    "support": 1,
    "query": 1,
    "pretrain_fraction": 0.97,
    "checkpoint_every": 500,
    "evaluate_every": 3_000,
}
HIDDEN_GOALS_STEPS = {"reach": 1_500, "push": 3_000, "pick-place": 3_000}  # of `small`

# What pairs change. The instruction does not tell the task, so leaving it out teaches nothing.
PAIRS = {"instruction_dropout": 0.0, "after_success": None, "late_fraction": 0.0}

# What turned actions change. Augmentation also stretches scenes, and so would change the angle.
CONVENTION = {
    "demonstrations": 8,
    "augment": False,
    "instruction_dropout": 0.0,
    "after_success": None,  # episodes are short, and end soon after their success
    "late_fraction": 0.0,
    "evaluate_on": "novel",
    "episodes": 5,
}
SUITE_SETTINGS = {
    "goals-reach": HIDDEN_GOALS,
    "goals-push": HIDDEN_GOALS,
    "goals-pick-place": HIDDEN_GOALS,
    "pairs": PAIRS,
    "convention-reach": CONVENTION,
    "convention-push": CONVENTION,
}


def preset_settings(preset: str, suite: str) -> Settings:
    """A preset's settings on a suite; goals-reach-validation has those of goals-reach."""
    name = suite.removesuffix("-validation")
    changes = dict(SUITE_SETTINGS.get(name, {}))
    if preset == "small" and name.startswith("goals-"):
        steps = HIDDEN_GOALS_STEPS[name.removeprefix("goals-")]
        changes.update(HIDDEN_GOALS_SMALL, steps=steps)
    return replace(SETTINGS[preset], suite=suite, **changes)


# ---- From the command line to a run --------------------------------------------------------------

# A policy for own recordings can read demonstrations of up to 500 frames, the paper's number on a
# real robot, or as long as the longest of the recordings.
OWN_FRAMES = 500
ARCHITECTURE = {  # the fields of PolicyConfig that are flags, and their help
    "policy": "DAMI, or one that the paper compares it with, see baselines.py",
    "demo_encoder": "what encodes the demonstration; none: it is not read",
    "denoiser": "the network that denoises actions, a key of model.denoisers",
    "tcfm": "where U2T's output modulates the U-Net; none: nowhere, see model.PolicyConfig",
    "sampler": "DDIM as published, or as DP3 runs it",
    "num_points": "points of a cloud",
}


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Meta-trains a policy on a suite (Algorithm 1).")
    group = parser.add_argument_group("run")
    group.add_argument(
        "--suite", help=f"{', '.join(SIMULATORS)} (default: ml10, or own recordings in --data)"
    )
    group.add_argument(
        "--preset", help="paper, small or tiny (default: paper on CUDA, small on a CPU)"
    )
    group.add_argument("--data", help="folder of the demonstrations (default: data)")
    group.add_argument(
        "--out",
        help="folder of the run (default: runs/SUITE-PRESET-seedSEED, with --policy "
        "runs/SUITE-POLICY-PRESET-seedSEED; for own recordings SUITE is own-DATA)",
    )
    group.add_argument("--resume", action="store_true", help="go on from the run's last.pt")
    common.add_common_flags(group)

    group = parser.add_argument_group("architecture (default: the preset's)")
    choices = {**model.choices(), "policy": tuple(baselines.PRESETS)}
    for name, text in ARCHITECTURE.items():
        values = {preset: getattr(config, name) for preset, config in model.PRESETS.items()}
        group.add_argument(
            common.flag_name(name),
            type=str if name in choices else int,
            choices=choices.get(name),
            help=text + common.describe_presets(values),
        )
    group = parser.add_argument_group(
        "settings", "Default: the preset's. goals-*, pairs and convention-* change some of them."
    )
    common.add_settings(group, Settings, SETTINGS)
    return parser.parse_args(argv)


def own_recordings(folder: Path) -> dict[str, Path]:
    """Task -> file of the recordings in a folder, none of which was made by a simulator."""
    if folder.is_file():
        raise UserError(f"{folder} is a file: name its folder, all recordings in it are trained on")
    if not folder.is_dir():
        raise UserError(f"there is no folder {folder}: with --suite ml10, experts fill it")
    paths = {path.stem: path for path in sorted(folder.glob("*.npz"))}
    if not paths:
        raise UserError(f"{folder} holds no recordings (.npz): with --suite ml10, experts fill it")
    for path in paths.values():
        if made_by_simulator(load_demonstrations(path)):
            raise UserError(
                f"{path} was recorded in a simulator: name its suite, for example --suite ml10, or "
                "move it to train on the other recordings"
            )
    return paths


def choose_architecture(args: argparse.Namespace, preset: str) -> PolicyConfig:
    """The preset's architecture, with the flags that were given."""
    flags = {name: getattr(args, name) for name in ARCHITECTURE}
    config = baselines.PRESETS[args.policy or "dami"][preset]
    try:
        config = replace(config, **{name: x for name, x in flags.items() if x is not None})
        with torch.device("meta"):  # which takes no memory
            model.build_policy(config)  # refuses what does not fit
    except model.ConfigError as error:
        raise UserError(str(error)) from error
    return config


def default_settings(preset: str, suite: str, config: PolicyConfig) -> Settings:
    """A preset's settings on a suite for an architecture."""
    settings = preset_settings(preset, suite)
    if suite == "own":  # all demonstrations, and no simulator to be rolled out in
        settings = replace(settings, demonstrations=None, episodes=0)
    if config.demo_encoder == "none":  # then the instruction alone tells the task
        settings = replace(settings, instruction_dropout=0.0, task_dropout=0.0)
    return settings


def fit_to_recordings(
    config: PolicyConfig, recordings: Sequence[Demonstrations], longest: int, fewer_points: bool
) -> PolicyConfig:
    """The architecture with the dimensions of the recordings.

    Args:
        config: the architecture otherwise.
        recordings: one of each task.
        longest: there are learned positions for at least so many frames, before the stride.
        fewer_points: where `config` asks for more points than a recording has, take the smallest
            number of points of all recordings.
    """
    first, num_points = recordings[0], config.num_points
    if fewer_points:
        num_points = min(num_points, min(d.points.shape[1] for d in recordings))
    for demonstrations in recordings:
        ends = [0, *demonstrations.episode_ends.tolist()]
        longest = max(longest, max(np.diff(ends).tolist()))
    return replace(
        config,
        point_dim=first.points.shape[2],
        state_dim=first.state.shape[1],
        action_dim=first.action.shape[1],
        num_points=num_points,
        demo_positions=math.ceil(longest / config.demo_stride),
    )


def join_processes(device: torch.device, tasks_per_step: int) -> tuple[torch.device, int, int]:
    """Joins the processes of torchrun, which share the tasks; returns (device, rank, how many).

    Rank 0 collects, logs, saves and evaluates, while the others wait for it.
    """
    world = int(os.environ.get("WORLD_SIZE", 1))
    if world == 1:
        return device, 0, 1
    if world > tasks_per_step:
        raise UserError(
            f"{world} processes for {tasks_per_step} tasks a step: use at most one process a task"
        )
    if "RANK" not in os.environ:
        raise UserError("WORLD_SIZE is set and RANK is not: start with torchrun, or unset it")
    if device.type == "cuda" and device.index is None:
        device = torch.device("cuda", int(os.environ["LOCAL_RANK"]))
        torch.cuda.set_device(device)
    backend = "nccl" if device.type == "cuda" else "gloo"
    dist.init_process_group(backend, timeout=timedelta(hours=6))  # an evaluation is long
    return device, int(os.environ["RANK"]), world


def check_same_weights(identity: str, world: int) -> None:
    """Raises UserError if the processes of torchrun have different CLIP weights."""
    identities: list[Any] = [None] * world
    dist.all_gather_object(identities, identity)
    if len(set(identities)) > 1:
        raise UserError(
            f"processes have different text weights ({', '.join(identities)}): name one file for "
            "all by --clip-weights"
        )


def check_folder(folder: Path, resume: bool) -> None:
    """Raises UserError if a run cannot be resumed, or if a new one would overwrite something."""
    if resume:
        if not (folder / "last.pt").exists():
            raise UserError(f"there is no run to resume in {folder}: look at --out")
        return
    if any(folder.glob("*.pt")):
        raise UserError(f"{folder} already holds a run: add --resume, or another --out")
    # A run that was killed before it saved leaves config.json and metrics.jsonl, and may begin anew
    arguments = {}
    with suppress(OSError, ValueError, KeyError, TypeError):  # no file, or not one of train.py
        arguments = json.loads((folder / "config.json").read_text())["arguments"]
    files = {"success.json"} if arguments else {"success.json", "config.json", "metrics.jsonl"}
    for name in sorted(files):
        if (folder / name).exists():
            raise UserError(f"{folder} already holds {name} of something else: use another --out")


def any_process(flag: bool, device: torch.device) -> bool:
    """Whether the flag is set in any of torchrun's processes, which all ask at the same step."""
    of_all = torch.tensor(float(flag), device=device)
    dist.all_reduce(of_all, op=dist.ReduceOp.MAX)
    return of_all.item() > 0


def begin_files(
    folder: Path, step: int, settings: Settings, config: PolicyConfig, provenance: dict[str, Any]
) -> None:
    """Writes config.json, and drops what was logged later than `step`.

    It also prints the settings of a new run, or where an old one goes on.
    """
    if step == 0:
        default_config = baselines.PRESETS[config.policy][settings.preset]
        default = default_settings(settings.preset, settings.suite, config)
        common.print_settings(
            used={**asdict(settings), **asdict(config)},
            default={**asdict(default), **asdict(default_config)},
        )
    else:
        print(f"going on after step {step} of {settings.steps}", flush=True)
    content = {**provenance, "arguments": asdict(settings), "config": asdict(config)}
    write_text(folder / "config.json", json.dumps(content, indent=1))

    path = folder / "metrics.jsonl"
    kept = [line for line in read_json_lines(path) if line["step"] <= step] if step else []
    write_text(path, "".join(f"{json.dumps(line)}\n" for line in kept))


def make_samplers(
    recordings: dict[str, Demonstrations], config: PolicyConfig, settings: Settings
) -> tuple[dict[str, WindowSampler], dict[str, WindowSampler]]:
    """Task -> the windows to train on, and those of the held-out episodes, if there are any."""
    train_samplers, heldout_samplers = {}, {}
    for task, recording in recordings.items():
        kept, heldout = hold_out(recording, settings.held_out)
        train_samplers[task] = WindowSampler(
            kept,
            config,
            after_success=settings.after_success,
            late_fraction=settings.late_fraction,
            augment=settings.augment,
            one_map=settings.one_map,
        )
        if heldout is not None:
            heldout_samplers[task] = WindowSampler(heldout, config)
    return train_samplers, heldout_samplers


def run(
    args: argparse.Namespace,
    settings: Settings,
    config: PolicyConfig,
    simulator: Simulator | None,
    paths: dict[str, Path],
    evaluated_paths: dict[str, Path],
    folder: Path,
    provenance: dict[str, Any],
    device: torch.device,
    rank: int,
    world: int,
) -> None:
    """Trains on recordings, from the start or from where a run was left; rank 0 writes its files.

    Args:
        args: the command line.
        settings: what to train with.
        config: the architecture, whose dimensions will be those of the recordings.
        simulator: where to evaluate; None: nowhere.
        paths: task -> its recording, of the tasks to train on.
        evaluated_paths: the same of the tasks to evaluate on.
        folder: of the run.
        provenance: what stands beside every result.
        device, rank, world: of this process, see `join_processes`.
    """
    # The demonstrations and their windows. Windows are drawn on the CPU, whatever the device is
    recordings = {
        task: load_demonstrations(path).take(settings.demonstrations)
        for task, path in paths.items()
    }
    if rank == 0:
        for task, recording in recordings.items():
            for suspicion in suspicions(recording):
                print(f"{paths[task]}: {suspicion}", flush=True)
    config = fit_to_recordings(
        config,
        list(recordings.values()),
        longest=OWN_FRAMES if simulator is None else simulator.episode_steps,
        fewer_points=args.num_points is None,
    )
    train_samplers, heldout_samplers = make_samplers(recordings, config, settings)
    digest = fingerprint(train_samplers)

    # The policy, fresh or as it was left
    state = start_training(config, settings, train_samplers, device)
    text_weights = None  # any
    if args.resume:
        saved = restore(folder / "last.pt", state, settings, digest)
        text_weights, provenance = saved["text_weights"], saved["provenance"]
    instructions = {task: recording.instruction for task, recording in recordings.items()}
    for task, path in evaluated_paths.items():
        instructions.setdefault(task, load_demonstrations(path).instruction)
    if rank > 0:
        dist.barrier()  # rank 0 downloads CLIP's weights, if they are not there
    text, text_weights = evaluate.instruction_features(
        instructions, weights=args.clip_weights, identity=text_weights, device=device
    )
    if world > 1:
        if rank == 0:
            dist.barrier()
        check_same_weights(text_weights, world)
    provenance = {"text weights": text_weights, **provenance}

    n_demonstrations = None
    if simulator is not None and settings.evaluate_on == "novel":
        n_demonstrations = simulator.demonstrations
    elif settings.demonstrations is not None:
        n_demonstrations = settings.demonstrations - settings.held_out

    # What every checkpoint says, what last.pt says besides, and where results are measured
    checkpoint_info = {
        "suite": settings.suite,
        "preset": settings.preset,
        "arguments": asdict(settings),
        "text_weights": text_weights,
        "provenance": provenance,
    }
    saver = Saver(folder / "last.pt", info={**checkpoint_info, "recordings": digest})
    evaluation = Evaluation(
        folder=folder,
        settings=settings,
        simulator=simulator,
        recordings=evaluated_paths,
        n_demonstrations=n_demonstrations,
        text=text,
        workers=args.workers,
        device=device,
    )
    if rank == 0:
        begin_files(folder, state.step, settings, config, provenance)

    bar = common.progress_bar(
        desc="training", unit="step", total=settings.steps, initial=state.step, disable=rank != 0
    )
    outcomes = None
    with StopRequest() as stop, bar:
        if rank == 0 and state.step > 0:
            checkpoint = evaluate.ema_checkpoint(folder, state.step)
            if is_milestone(state.step, settings) and not checkpoint.exists():
                # Missing where --checkpoint-every or --evaluate-every changed on --resume
                save_average(folder, state, checkpoint_info)
            outcomes = evaluation.run(state.step, stop)  # the run may have been stopped during it
        began = time.monotonic()
        for figures in meta_train(state, train_samplers, text, settings, rank=rank, world=world):
            state.seconds += time.monotonic() - began
            milestone = is_milestone(state.step, settings)
            if rank == 0:
                bar.update()
                bar.set_postfix(loss=f"{figures['loss']:.4f}")
                append_json(
                    folder / "metrics.jsonl",
                    step=state.step,
                    **figures,
                    seconds=round(state.seconds, 2),
                )
                if milestone:  # before last.pt: a run that goes on from there lacks none of it
                    save_average(folder, state, checkpoint_info)
                    if heldout_samplers:
                        log_heldout_errors(
                            folder, state, train_samplers, heldout_samplers, text, settings
                        )
                    report.plot_curves(folder)
            stopping = stop.requested  # read once: a signal from now on is served a step later
            if world > 1:
                stopping = any_process(stopping, device)
            if rank == 0 and (milestone or stopping or saver.is_due()):
                saver.save(state)
            if stopping:
                if world > 1:
                    dist.barrier()  # or torchrun would end rank 0, which may still be saving
                raise KeyboardInterrupt(f"saved after step {state.step}, add --resume to go on")
            if rank == 0:
                outcomes = evaluation.run(state.step, stop)
            began = time.monotonic()

        columns = {}
        if outcomes is not None and settings.evaluate_on == "novel":
            columns = evaluation.contributions(
                outcomes, state.policy.config.reads_demonstration, stop
            )
        elif outcomes is not None:
            columns = {"last checkpoint": outcomes}
    if rank == 0:
        report_training(
            folder, settings, simulator, config.policy, state.seconds, provenance, columns
        )


def main(argv: Sequence[str] | None = None) -> None:
    args = parse(argv)
    device = common.pick_device(args.device, args.threads)
    default = "paper" if device.type == "cuda" else "small"
    preset = choose(args.preset or default, SETTINGS, "preset")
    own = args.data is not None and args.suite is None
    for flag in ("episodes", "evaluate_on"):
        if own and getattr(args, flag):
            raise UserError(
                f"{common.flag_name(flag)}: own recordings have no simulator to be rolled out in; "
                "--held-out keeps episodes to measure by"
            )
    suite = "own" if own else args.suite or "ml10"
    config = choose_architecture(args, preset)

    # Own recordings, or the base tasks of a suite
    simulator = None if own else simulator_of(suite)
    settings = common.with_flags(default_settings(preset, suite, config), args)
    common.check_workers(args.workers)
    novel_paths = {}  # of tasks that are not trained on, if they are evaluated on
    if own:
        recorded = own_recordings(Path(args.data))
        trained = draw_base_tasks(list(recorded), settings.base_tasks, settings.seed)
        paths = {task: recorded[task] for task in trained}
    else:
        base_tasks, novel_tasks = simulator.tasks(suite)
        data = Path(args.data or "data")
        trained = draw_base_tasks(base_tasks, settings.base_tasks, settings.seed)
        paths = {task: data / f"{task}.npz" for task in trained}
        if settings.evaluate_on == "novel" and not novel_tasks:
            raise UserError(f"--evaluate-on novel: {suite} has no novel tasks")
        if settings.evaluate_on == "novel" and settings.episodes > 0:
            novel_paths = {task: data / f"{task}.npz" for task in novel_tasks}
    name = preset if config.policy == "dami" else f"{config.policy}-{preset}"
    trained_on = suite if simulator else f"own-{Path(args.data).resolve().name}"
    folder = Path(args.out or f"runs/{trained_on}-{name}-seed{settings.seed}")

    tasks_per_step = len(tasks_of_step(0, len(paths), settings))
    device, rank, world = join_processes(device, tasks_per_step)
    with common.locked(folder) if rank == 0 else nullcontext():
        if rank == 0:
            where = f"{device} ({common.hardware(device)})"
            tasks = common.count(len(paths), "task")
            print(f"preset {name} on {where}, {tasks}, in {folder}", flush=True)
            check_folder(folder, args.resume)
            if simulator is not None:
                n = settings.demonstrations
                collect(simulator, list(paths), data, episodes=n, workers=args.workers)
                if novel_paths:
                    n = simulator.demonstrations
                    collect(simulator, list(novel_paths), data, episodes=n, workers=args.workers)
        provenance = common.provenance("train.py", argv, device)
        if world > 1:
            provenance["processes of torchrun"] = world
            dist.barrier()
        run(
            args=args,
            settings=settings,
            config=config,
            simulator=simulator,
            paths=paths,
            evaluated_paths=novel_paths or paths,
            folder=folder,
            provenance=provenance,
            device=device,
            rank=rank,
            world=world,
        )
        if world > 1:
            dist.destroy_process_group()


if __name__ == "__main__":
    common.command_line(main, errors=(RecordingError, CheckpointError, TextWeightsError))
