"""Meta-training (Algorithm 1): second-order MAML over all tasks of a suite.

    python train.py --suite ml10                        # collects demonstrations, trains, evaluates
    python train.py --suite ml10 --preset tiny          # the same in a minute, to see it work
    python train.py --suite ml10 --resume               # goes on where an interrupted run stopped
    python train.py --suite ml10 --policy dp3 --maml off    # multi-task DP3; see baselines.py
    python train.py --data recordings                   # own tasks: every recording in a folder
    torchrun --nproc-per-node 4 train.py --suite ml10   # tasks shared among 4 processes

Whatever is random in outer step k follows from (seed, k, task) alone. On a CPU, with as many
threads, a run that was killed and resumed therefore ends with the same bits as one that was not,
and tasks may be shared among processes without changing what they draw.
"""

import argparse
import math
import time
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor
from torch.func import functional_call
from torch.optim.swa_utils import AveragedModel

import baselines
import evaluate
import report
import scripts
from data import WindowSampler, load_demonstrations
from maml import meta_gradient
from model import PRESETS, TASK_INPUTS, DAMIPolicy, PolicyConfig, ema_model, split
from scripts import Flags, choose, command_line, progress_bar, save_checkpoint, setting
from simulator import SUITES, collect, own_recordings, suite_tasks

# ---- Settings ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Settings(Flags):
    """What a run is made of. Each field is a flag, and is kept in every checkpoint (`arguments`).

    The defaults are the paper's (3000 epochs of 18 outer steps), but for the warm-up, DP3's.
    """

    suite: str = setting("ml10", "ml10 or ml45 (default: ml10, or own recordings in --data)")
    preset: str = setting("paper", "paper, small or tiny (default: paper on CUDA, else small)")
    seed: int = setting(0, "of weights, batches and noise", least=0, most=2**32 - 1)
    maml: str = setting("second", "order of the meta-gradient", choices=("second", "first", "off"))
    steps: int = setting(54_000, "outer steps", least=1)
    support: int = setting(20, "windows a task for the inner step", least=1)
    query: int = setting(88, "windows a task for the outer loss", least=1)
    inner_lr: float = setting(1e-4, "learning rate of the inner step", least=0)
    lr: float = setting(1e-4, "peak learning rate of AdamW", least=0)
    warmup: int = setting(500, "steps of linear warm-up", least=0)
    multi_task_share: float = setting(0.0, "first steps without an inner step", least=0, most=1)
    vectorize: int = setting(1, "tasks that run at once; memory is for so many", least=1)
    bfloat16: bool = setting(False, "products of steps without an inner step in bfloat16")
    after_success: int | None = setting(None, "windows begin at most so much later", least=0)
    augment: bool = setting(False, "shift, turn and stretch each scene at random")
    instruction_dropout: float = setting(0.0, "share of batches without it", least=0, most=1)
    support_only: float = setting(0.0, "share of inner steps told nothing else", least=0, most=1)
    demonstrations: int | None = setting(10, "demonstrations a task (own: all)", least=1)
    held_out: int = setting(0, "of them, the last so many only judge", least=0)
    checkpoint_every: int = setting(3_600, "steps between EMA checkpoints", least=1)
    evaluate_every: int = setting(3_600, "steps between evaluations", least=1)
    episodes: int = setting(20, "evaluation episodes a task; 0: never evaluate", least=0)


# What a preset changes; the architecture of the same name is in model.PRESETS.
# fmt: off
SETTINGS = {
    "paper": Settings(),
    "small": Settings(
        preset="small", steps=10_000, support=4, query=12, lr=1e-3, warmup=100,
        multi_task_share=0.8,  # a quarter of the time a step, and nearly the same gradient
        after_success=20,  # three in five of the experts' frames are later
        instruction_dropout=0.2,  # or the demonstration is never read
        support_only=0.25, inner_lr=3e-3,  # told nothing, a step has all to teach: RESULTS.md
        vectorize=10, augment=True, checkpoint_every=1_000, evaluate_every=10_000,
    ),
    "tiny": Settings(
        preset="tiny", steps=30, support=4, query=8, inner_lr=1e-3, lr=3e-3, warmup=5, vectorize=10,
        after_success=20, demonstrations=2, checkpoint_every=15, evaluate_every=30, episodes=2,
    ),
}
# fmt: on
SAVE_SECONDS = 20  # between two savings of last.pt: what a killed run loses at most
# Old name, until the tests of this file ask model.TASK_INPUTS:
PER_WINDOW = ("points", "state", "action", "noise", "timesteps")
PER_WINDOW += ("times", "drop_path", "cutoffs", "mask")


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

    Where the instruction names the task, nothing else need be read. In a share of the batches it
    is therefore left out (zeros), and only the demonstration tells the task. Where an `inner` step
    follows, a share sees neither: there the support windows alone tell it.

    Returns the keyword arguments of `policy.loss`. They follow from `seed` alone.
    """
    for_batch, for_shares = np.random.SeedSequence(seed).generate_state(2, np.uint64)
    generator = torch.Generator().manual_seed(int(for_batch))
    drop, _, hide = torch.rand(3, generator=torch.Generator().manual_seed(int(for_shares)))
    hide = inner and hide < settings.support_only  # `_` is free: RESULTS.md's runs drew three
    windows = sampler.batch(n, generator)
    if hide:
        shown = [name for name in windows if name in TASK_INPUTS]
        windows |= {name: torch.zeros_like(windows[name]) for name in shown}
    if hide or drop < settings.instruction_dropout:
        text = torch.zeros_like(text)
    drawn = {"text": text[None], **windows, **policy.draw_noise_and_timesteps(n, generator)}
    return {name: x.to(text.device) for name, x in drawn.items()}


def multi_task_gradient(
    policy: DAMIPolicy, batches: list[dict[str, Tensor]], bfloat16: bool = False
) -> tuple[dict[str, Tensor], Tensor]:
    """The gradient of ordinary multi-task training: all windows of all tasks, no inner step.

    `batches` are of `task_batch`, one a task. With `bfloat16` matrix products and convolutions are
    computed in it, and the gradient stays float32. Returns parameter name -> gradient, loss (1,).
    """
    if len({batch["demo_points"].shape for batch in batches}) == 1:  # else: of different lengths
        batches = [{name: torch.cat([b[name] for b in batches]) for name in batches[0]}]
    with torch.autocast(batches[0]["action"].device.type, torch.bfloat16, enabled=bfloat16):
        loss = torch.stack([policy.loss(**batch) for batch in batches]).mean()
    parameters = dict(policy.named_parameters())
    gradients = torch.autograd.grad(loss, list(parameters.values()))
    return dict(zip(parameters, gradients)), loss.detach()[None]


def learning_rate(step: int, settings: Settings) -> float:
    """Linear warm-up, then half a cosine, to zero one step after the last."""
    peak, steps, warmup = settings.lr, settings.steps, settings.warmup
    if step < warmup:
        return peak * (step + 1) / warmup
    return peak * 0.5 * (1 + math.cos(math.pi * (step - warmup) / max(1, steps - warmup)))


def initialize(
    config: PolicyConfig,
    settings: Settings,
    samplers: dict[str, WindowSampler],
    device: torch.device,
) -> tuple[DAMIPolicy, AveragedModel, torch.optim.Optimizer]:
    """A fresh policy, normalized to all windows (line 1), its moving average, and AdamW."""
    torch.manual_seed(settings.seed)
    policy = baselines.build_policy(config).to(device)
    policy.normalizer.fit(samplers.values())
    optimizer = torch.optim.AdamW(
        policy.parameters(), lr=settings.lr, betas=(0.95, 0.999), weight_decay=1e-6, fused=True
    )
    return policy, ema_model(policy), optimizer


def meta_train(
    policy: DAMIPolicy,
    ema: AveragedModel,
    optimizer: torch.optim.Optimizer,
    samplers: dict[str, WindowSampler],
    text: dict[str, Tensor],
    settings: Settings,
    start: int = 0,
    rank: int = 0,
    world: int = 1,
) -> Iterator[tuple[int, dict[str, float]]]:
    """Algorithm 1: trains `policy` and its average `ema`, from outer step `start` on.

    Args:
        samplers, text: task -> its windows, and its instruction feature (text_dim,).
        rank, world: this process's number, and how many share the tasks.

    Yields:
        (steps done, figures) after each outer step: loss and gradient_norm. Where there is an inner
        step, loss is the query's after it, and loss_before is the query's before it.

    Raises:
        ValueError: the loss or its gradient is not finite; this step changed nothing.
    """
    params = dict(policy.named_parameters())
    my_tasks = list(enumerate(samplers))[rank::world]
    seed, n = settings.seed, settings.support + settings.query
    multi_task_share = 1.0 if settings.maml == "off" else settings.multi_task_share
    multi_task_steps = round(multi_task_share * settings.steps)

    # Several tasks at once, if their demonstrations can be stacked.
    lengths = {e.stop - e.start for sampler in samplers.values() for e in sampler.episodes}
    at_once = settings.vectorize if len(lengths) == 1 else 1
    how = {"lr": settings.inner_lr, "first_order": settings.maml == "first", "vectorize": at_once}

    def loss_fn(params: dict[str, Tensor], batch: dict[str, Tensor]) -> Tensor:
        return functional_call(policy, params, (), batch)

    def without_inner_step(batches: list[dict[str, Tensor]]) -> tuple:
        return *multi_task_gradient(policy, batches, settings.bfloat16), {}

    def through_inner_step(batches: list[dict[str, Tensor]]) -> tuple:  # lines 4 to 19
        pairs = [split(batch, settings.support) for batch in batches]
        gradients, losses, before = meta_gradient(loss_fn, params, pairs, **how)
        return gradients, losses, {"loss_before": before.mean()}

    if next(policy.parameters()).is_cuda and world == len(lengths) == 1:  # always equal shapes
        without_inner_step = scripts.Captured(without_inner_step)
        through_inner_step = scripts.Captured(through_inner_step)

    for step in range(start, settings.steps):  # lines 2, 22
        inner = step >= multi_task_steps
        batches = [  # lines 3 to 6, 9
            task_batch(policy, samplers[t], text[t], n, (seed, step, i), settings, inner)
            for i, t in my_tasks
        ]

        # The gradient of the mean loss over my tasks
        gradients, losses, figures = (through_inner_step if inner else without_inner_step)(batches)
        loss = losses.mean()

        # The mean over all tasks: the processes' means, weighted by their shares
        if world > 1:
            for x in (loss, *figures.values(), *gradients.values()):
                dist.all_reduce(x.mul_(len(my_tasks) / len(samplers)))
        norm = torch.nn.utils.get_total_norm(gradients.values())
        if not torch.isfinite(loss + norm):
            raise ValueError(
                f"the loss or its gradient is not finite at step {step + 1}: train again with a "
                "smaller --lr or --inner-lr, in another --out (what was saved before is whole)"
            )

        # One step of AdamW, and of the moving average, which is what is kept and rolled out
        for name, parameter in params.items():
            parameter.grad = gradients[name]
        optimizer.param_groups[0]["lr"] = learning_rate(step, settings)
        optimizer.step()  # line 20
        ema.update_parameters(policy)  # line 21
        figures = figures | {"loss": loss, "gradient_norm": norm}
        yield step + 1, {name: x.item() for name, x in figures.items()}


# ---- Command line --------------------------------------------------------------------------------


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Meta-trains a policy on a suite (Algorithm 1).")
    add = parser.add_argument_group("run").add_argument
    add("--data", help="folder of the demonstrations (default: data)")
    add("--out", help="folder of the run (default: runs/SUITE-PRESET-seedSEED)")
    add("--resume", action="store_true", help="go on from the run's last.pt")
    scripts.add_common_flags(add)
    scripts.add_architecture_flags(parser)
    Settings.add_flags(parser.add_argument_group("settings (default: the preset's)"), SETTINGS)
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    args = parse(argv)
    device = scripts.pick_device(args.device, args.threads)
    own = own_recordings(args.data) if args.data and not args.suite else {}  # task -> file
    default = "paper" if device.type == "cuda" else "small"
    preset = choose(args.preset or default, PRESETS, "preset")
    suite = "own" if own else choose(args.suite or "ml10", SUITES, "suite")
    settings, policy = SETTINGS[preset], args.policy or "dami"
    if policy != "dami" or args.demo_encoder == "none":  # the instruction alone tells the task
        settings = replace(settings, instruction_dropout=0.0, support_only=0.0)
    settings = settings.given(args, suite=suite)
    name = preset if policy == "dami" else f"{policy}-{preset}"
    if own:  # all demonstrations unless told otherwise, and no simulator to be rolled out in
        settings = replace(settings, demonstrations=args.demonstrations, episodes=0)
    tasks = list(own) or suite_tasks(suite)[0]
    paths = own or {task: Path(args.data or "data") / f"{task}.npz" for task in tasks}
    folder = Path(args.out or f"runs/{suite}-{name}-seed{settings.seed}")

    device, rank, world = scripts.join_processes(device, len(tasks))
    with scripts.locked(folder) if rank == 0 else nullcontext():
        if rank == 0:
            where = f"{device} ({scripts.hardware(device)})"
            print(f"preset {name} on {where}, {len(tasks)} tasks, in {folder}", flush=True)
            scripts.check_run(folder, args.resume)
            if not own:
                collect(tasks, args.data or "data", settings.demonstrations, workers=args.workers)
        if world > 1:
            dist.barrier()
        facts = scripts.report_facts("train.py", argv, device)
        run(args, settings, paths, folder, facts, device, rank, world)
        if world > 1:
            dist.destroy_process_group()


def run(
    args: argparse.Namespace,
    settings: Settings,
    paths: dict[str, Path],
    folder: Path,
    facts: dict[str, Any],
    device: torch.device,
    rank: int,
    world: int,
) -> None:
    """Trains on recordings (task -> file), from the start or from where `folder` was left.

    The leader, of rank 0, logs, saves, evaluates and reports.
    """
    leader = rank == 0

    # Demonstrations and their windows, the policy, and the state in which the run was left
    n, rest = settings.demonstrations, settings.after_success
    recorded = {task: load_demonstrations(path).take(n) for task, path in paths.items()}
    config = scripts.choose_config(args, settings.preset, recorded, settings.suite == "own")

    recorded, held = evaluate.hold_out(recorded, settings.held_out)
    how = (config, "cpu", rest, settings.augment)  # drawn there, whatever computes
    shown = n and n - settings.held_out  # demonstrations for rollouts
    samplers, unseen = (scripts.windows(part, *how) for part in (recorded, held))
    policy, ema, optimizer = initialize(config, settings, samplers, device)
    data = scripts.digest(samplers)
    left = {"step": 0, "seconds": 0.0, "text_weights": None}
    if args.resume:
        left = scripts.restore(folder / "last.pt", policy, ema, optimizer, settings, data)
    start, seconds = left["step"], left["seconds"]
    how = args.clip_weights, left["text_weights"], device
    text, identity = scripts.instruction_features(recorded, *how)

    # What is written beside the weights, and beside the results
    about = {"suite": settings.suite, "preset": settings.preset, "text_weights": identity}
    about["arguments"] = asdict(settings)
    facts = {"text weights": identity, **facts}
    if leader:
        scripts.begin_run(folder, start, settings, SETTINGS[settings.preset], config, facts)

    bar = {"desc": "training", "unit": "step", "total": settings.steps, "initial": start}
    with scripts.StopRequest() as stop, progress_bar(**bar, disable=not leader) as progress:
        how = settings, stop, paths, text, args.workers, device, shown
        if leader:
            evaluate.evaluate_step(folder, start, *how)  # the run may have been stopped meanwhile
        began = saved = time.monotonic()
        training = meta_train(policy, ema, optimizer, samplers, text, settings, start, rank, world)
        for step, figures in training:
            seconds += time.monotonic() - began
            if leader:
                progress.update()
                progress.set_postfix(loss=f"{figures['loss']:.4f}")
                figures["lr"] = optimizer.param_groups[0]["lr"]
                scripts.log(folder, step=step, **figures, seconds=round(seconds, 2))

                every = settings.checkpoint_every, settings.evaluate_every
                milestone = step == settings.steps or any(step % n == 0 for n in every)
                if milestone:  # before last.pt: a run that goes on from there lacks none of it
                    checkpoint = folder / f"ema-{step:05d}.pt"
                    save_checkpoint(checkpoint, ema.module, **about, step=step, seconds=seconds)
                    evaluate.judge(folder, step, ema.module, samplers, unseen, text)
                    report.draw_curves(folder)
                if milestone or stop.requested or time.monotonic() - saved > SAVE_SECONDS:
                    now = {"step": step, "seconds": seconds, "data": data}
                    scripts.save_run(folder, policy, ema, optimizer, **about, **now)
                    saved = time.monotonic()

            if stop.requested and step < settings.steps:
                raise KeyboardInterrupt(f"saved after step {step}, add --resume to go on")
            if leader:
                evaluate.evaluate_step(folder, step, *how)
            began = time.monotonic()

    if leader:
        successes = evaluate.evaluate_step(folder, settings.steps, *how)
        facts |= {"seed": evaluate.EVALUATION_SEED}
        report.report_training(folder, settings, config.policy, seconds, facts, successes)


if __name__ == "__main__":
    command_line(main)
