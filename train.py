"""Meta-training (Algorithm 1): second-order MAML over all tasks of a suite.

    python train.py --suite ml10                                  # collects what is missing, trains, evaluates
    python train.py --suite ml10 --preset tiny                    # the same in a few minutes, to see it work
    python train.py --suite ml10 --resume                         # goes on where an interrupted run stopped
    python train.py --suite ml10 --maml off --demo-encoder none --tcfm none      # multi-task DP3
    python train.py --data recordings                             # own tasks: every recording in that folder
    torchrun --nproc-per-node 4 train.py --suite ml10             # tasks shared among 4 processes

One batch, from disk to the loss: `task_batch` here draws windows and a reference demonstration from a
`data.WindowSampler`, `maml.meta_gradient` takes the inner step and calls `model.DAMIPolicy.loss` twice.

Whatever is random in outer step k follows from (seed, k, task) alone. A run that was killed and resumed therefore ends
with the same bits as one that was not, and tasks may be shared among processes without changing what they draw.
"""

import argparse
import json
import math
import os
import signal
import sys
import time
from dataclasses import asdict, replace
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor
from torch.func import functional_call
from tqdm import tqdm

from data import (
    Demonstrations,
    InputError,
    WindowSampler,
    choose,
    collect,
    command_line,
    load_demonstrations,
    own_recordings,
    suite_tasks,
)
from evaluate import (
    command,
    evaluate,
    hardware,
    mean_success,
    pick_device,
    text_features,
    window_sampler,
    write_atomically,
    write_report,
)
from maml import meta_gradient
from model import PRESETS, DAMIPolicy, PolicyConfig, ema_model, load_checkpoint, save_checkpoint
from model import InputError as ModelInputError

# What a preset means for training; the architecture of the same name is in model.PRESETS.
SETTINGS = {
    "paper": {  # the hyperparameter table: 3000 epochs of 18 outer steps
        "steps": 54_000,
        "support": 20,  # windows a task for the inner step
        "query": 88,  # windows a task for the outer loss
        "after_success": None,  # windows may begin anywhere in an episode
        "augment": False,  # scenes stay where they are
        "inner_lr": 1e-4,
        "multi_task_share": 0.0,  # of the steps, the first ones, without the inner step; MAML after them
        "vectorize": 1,  # tasks at once; 258 M adapted parameters a task are many
        "lr": 1e-4,
        "warmup": 500,
        "checkpoint_every": 3_600,  # outer steps: the paper's 200 epochs
        "evaluate_every": 3_600,
        "episodes": 20,
        "demonstrations": 10,
    },
    "small": {
        "steps": 10_000,
        "support": 4,
        "query": 12,
        "after_success": 20,  # or at most so many frames after its first success: three in five frames are later
        "augment": True,  # each window's scene, and the demonstration's, is put elsewhere at random
        "inner_lr": 1e-4,
        "multi_task_share": 0.8,  # a quarter of the time a step, nearly the same gradient while the policy is rough
        "vectorize": 10,
        "lr": 1e-3,
        "warmup": 100,
        "checkpoint_every": 1_000,
        "evaluate_every": 10_000,
        "episodes": 20,
        "demonstrations": 10,
    },
    "tiny": {
        "steps": 30,
        "support": 4,
        "query": 8,
        "after_success": 20,
        "augment": False,
        "inner_lr": 1e-3,
        "multi_task_share": 0.0,
        "vectorize": 10,
        "lr": 3e-3,
        "warmup": 5,
        "checkpoint_every": 15,
        "evaluate_every": 30,
        "episodes": 2,
        "demonstrations": 2,
    },
}
OWN_FRAMES = 500  # the paper's positions on the real robot
SAVE_SECONDS = 60  # between two savings of last.pt: what a killed run loses at most
WINDOW = ("points", "state", "action", "noise", "timesteps")  # the parts of a batch that have an entry a window


def learning_rate(step: int, steps: int, peak: float, warmup: int) -> float:
    """Linear warm-up over `warmup` steps, then half a cosine down to zero at `steps`."""
    if step < warmup:
        return peak * (step + 1) / warmup
    return peak * 0.5 * (1 + math.cos(math.pi * (step - warmup) / max(1, steps - warmup)))


def task_batch(
    policy: DAMIPolicy, sampler: WindowSampler, text: Tensor, n: int, seed: tuple[int, ...]
) -> dict[str, Tensor]:
    """Draws n windows, a complete reference demonstration, noise and timesteps (Algorithm 1, lines 5, 6 and 9).

    Returns the keyword arguments of `policy.loss`. They follow from `seed` alone.
    """
    generator = torch.Generator().manual_seed(int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0]))
    return {"text": text[None], **sampler.batch(n, generator), **policy.draw_noise(n, generator)}


def split(batch: dict[str, Tensor], n_support: int) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Splits the windows of a batch by index into support and query; both keep demonstration and instruction."""
    support = {name: x[:n_support] if name in WINDOW else x for name, x in batch.items()}
    query = {name: x[n_support:] if name in WINDOW else x for name, x in batch.items()}
    return support, query


def mean_loss_gradient(policy: DAMIPolicy, batches: list[dict[str, Tensor]]) -> tuple[dict[str, Tensor], Tensor]:
    """The gradient of ordinary multi-task training: all windows of all tasks in one batch, no inner step."""
    if len({batch["demo_points"].shape for batch in batches}) == 1:
        loss = policy.loss(**{name: torch.cat([batch[name] for batch in batches]) for name in batches[0]})
    else:  # demonstrations of different lengths
        loss = torch.stack([policy.loss(**batch) for batch in batches]).mean()
    gradients = torch.autograd.grad(loss, list(policy.parameters()))
    return dict(zip(dict(policy.named_parameters()), gradients)), loss.detach()[None]


class StopRequest:
    """Turns the first Ctrl-C into a request to stop after the step at hand; the second one interrupts at once."""

    def __enter__(self) -> "StopRequest":
        self.requested = False
        self.previous = signal.signal(signal.SIGINT, self.handle)
        return self

    def __exit__(self, *_: Any) -> None:
        signal.signal(signal.SIGINT, self.previous)

    def handle(self, *_: Any) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True


def fit_config(config: PolicyConfig, demonstrations: list[Demonstrations]) -> PolicyConfig:
    """The configuration with the dimensions of own recordings, and positions for their longest, or for 500 frames."""
    longest = max((d.episode(i).stop - d.episode(i).start for d in demonstrations for i in range(len(d))), default=1)
    return replace(
        config,
        state_dim=demonstrations[0].state.shape[1],
        action_dim=demonstrations[0].action.shape[1],
        num_points=min(config.num_points, *(d.points.shape[1] for d in demonstrations)),
        demo_positions=math.ceil(max(longest, OWN_FRAMES) / config.demo_stride),
    )


def not_finite(step: int, tasks: list[str], folder: Path) -> InputError:
    """What to say when the loss or its gradient overflows; `tasks` are those to blame, if that is known."""
    kept = f"; {folder}/last.pt keeps an earlier state" if (folder / "last.pt").exists() else ""
    return InputError(
        f"the loss or its gradient is not finite at step {step} (tasks: {', '.join(tasks) or 'all'}){kept}: "
        "train again with a smaller --lr or --inner-lr, in another --out"
    )


def log(folder: Path, **values: Any) -> None:
    """Appends a line to metrics.jsonl."""
    with (folder / "metrics.jsonl").open("a") as file:
        file.write(json.dumps(values) + "\n")


def rewind_metrics(folder: Path, step: int) -> None:
    """Drops the lines that a killed run wrote after its last save."""
    path = folder / "metrics.jsonl"
    lines = path.read_text().splitlines() if path.exists() else []
    kept = [line for line in lines if line.endswith("}") and json.loads(line)["step"] <= step]
    write_atomically(path, lambda temporary: temporary.write_text("".join(f"{line}\n" for line in kept)))


def draw_curves(folder: Path) -> None:
    """Draws curves.png from metrics.jsonl: the query loss, its running mean, and success where it was measured."""
    from matplotlib.figure import Figure

    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    steps = np.array([line["step"] for line in lines if "loss" in line])
    losses = np.array([line["loss"] for line in lines if "loss" in line])
    evaluated = [(line["step"], line["success"]) for line in lines if "success" in line]
    figure = Figure(figsize=(7, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.plot(steps, losses, color="C0", alpha=0.3, linewidth=0.8, label="query loss")
    width = max(1, len(losses) // 50)
    mean = np.convolve(losses, np.ones(width) / width, mode="valid")
    axes.plot(steps[width - 1 :], mean, color="C0", label=f"mean of {width} steps")
    axes.set(xlabel="outer step", ylabel="loss (actions in [-1, 1])", yscale="log")
    axes.spines["top"].set_visible(False)
    handles, labels = axes.get_legend_handles_labels()
    if evaluated:
        right = axes.twinx()
        (line,) = right.plot(*zip(*evaluated), "o-", color="C1")
        right.set(ylabel="mean success on base tasks, %", ylim=(0, 100))
        right.spines["top"].set_visible(False)
        handles, labels = [*handles, line], [*labels, "success (right)"]
    axes.legend(handles, labels, frameon=False)
    write_atomically(folder / "curves.png", lambda temporary: figure.savefig(temporary, dpi=120, format="png"))


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Meta-train a DAMI policy on a Meta-World suite (Algorithm 1).")
    run = parser.add_argument_group("run")
    run.add_argument(
        "--suite", help="ml10 or ml45 (default: ml10, or the recordings in --data if they are not Meta-World's)"
    )
    run.add_argument("--preset", help="paper, small or tiny (default: paper on CUDA, small on a CPU)")
    run.add_argument("--data", default="data", help="folder of the demonstrations (default: data)")
    run.add_argument("--out", help="folder of the run (default: runs/SUITE-PRESET-seedSEED)")
    run.add_argument("--resume", action="store_true", help="go on from the run's last.pt")
    run.add_argument("--seed", type=int, default=0, help="of weights, batches and noise (default: 0)")
    run.add_argument("--device", help="cpu, cuda, cuda:1 ... (default: cuda if there is one)")
    run.add_argument("--workers", type=int, help="processes for collecting and evaluating (default: one a core)")
    run.add_argument("--clip-weights", help="CLIP's ViT-B-32.pt, or `random` (default: the cache, or a download)")
    method = parser.add_argument_group("method (default: the preset's)")
    method.add_argument("--maml", choices=("second", "first", "off"), default="second", help="order (default: second)")
    method.add_argument("--demo-encoder", choices=("vmt", "mlp", "none"), help="encoder of the demonstration")
    method.add_argument("--tcfm", choices=("down", "mid", "up", "none"), help="the U-Net level that reads it")
    method.add_argument(
        "--augment", action=argparse.BooleanOptionalAction, help="shift, turn and stretch each scene at random"
    )
    for name, kind, text in [
        ("steps", int, "outer steps"),
        ("support", int, "windows a task for the inner step"),
        ("query", int, "windows a task for the outer loss"),
        ("after-success", int, "frames after an episode's first success in which a window may still begin"),
        ("inner-lr", float, "learning rate of the inner step"),
        ("vectorize", int, "tasks that run at once; memory is for so many"),
        ("multi-task-share", float, "share of the steps that MAML begins with as multi-task training: no inner step"),
        ("lr", float, "peak learning rate of AdamW"),
        ("warmup", int, "steps of linear warm-up"),
        ("checkpoint-every", int, "steps between EMA checkpoints"),
        ("evaluate-every", int, "steps between evaluations"),
        ("episodes", int, "evaluation episodes a task; 0: never evaluate"),
        ("demonstrations", int, "demonstrations a task (of own recordings by default all)"),
        ("num-points", int, "points of each cloud that the policy reads"),
    ]:
        method.add_argument(f"--{name}", type=kind, help=text)
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    args = parse(argv)
    world, rank = int(os.environ.get("WORLD_SIZE", 1)), int(os.environ.get("RANK", 0))
    device = pick_device(args.device)
    if world > 1:
        if device.type == "cuda" and device.index is None:
            device = torch.device("cuda", int(os.environ["LOCAL_RANK"]))
        # The leader alone evaluates, and the others wait for it: hence the long time-out.
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo", timeout=timedelta(hours=6))
    leader = rank == 0
    preset = choose(args.preset or ("paper" if device.type == "cuda" else "small"), SETTINGS, "preset")
    settings = {
        name: value if (given := getattr(args, name)) is None else given for name, value in SETTINGS[preset].items()
    }
    for name in ("steps", "support", "query", "vectorize", "checkpoint_every", "evaluate_every", "demonstrations"):
        if settings[name] < 1:
            raise InputError(f"--{name.replace('_', '-')} is {settings[name]}: use at least 1")
    if (settings["after_success"] or 0) < 0:
        raise InputError(f"--after-success is {settings['after_success']}: use at least 0")
    if args.num_points is not None and args.num_points < 1:
        raise InputError(f"--num-points is {args.num_points}: use at least 1")
    if args.seed < 0:
        raise InputError(f"--seed is {args.seed}: use 0 or more")
    changes = {"demo_encoder": args.demo_encoder, "tcfm": args.tcfm, "num_points": args.num_points}
    config = replace(PRESETS[preset], **{name: value for name, value in changes.items() if value is not None})
    own = {} if args.suite else own_recordings(args.data)
    suite = args.suite or ("own" if own else "ml10")
    tasks = list(own) or suite_tasks(suite)[0]
    folder = Path(args.out or f"runs/{suite}-{preset}-seed{args.seed}")
    if leader:
        print(f"preset {preset} on {device} ({hardware(device)}), {len(tasks)} tasks, run folder {folder}", flush=True)

    # Demonstrations, collected by one process; the others wait for it
    if leader:
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / "last.pt").exists() and not args.resume:
            raise InputError(f"{folder} already holds a run: add --resume to go on with it, or choose another --out")
        if not own:
            collect(tasks, args.data, settings["demonstrations"], workers=args.workers)
    if world > 1:
        dist.barrier()
    paths = own or {task: Path(args.data) / f"{task}.npz" for task in tasks}
    if own:  # no simulator to be rolled out in
        settings |= {"demonstrations": args.demonstrations, "episodes": 0}
    demonstrations = [load_demonstrations(paths[task]).first(settings["demonstrations"]) for task in tasks]
    if own:
        config = fit_config(config, demonstrations)

    # The policy, or the state in which it was left
    arguments = {"suite": suite, "preset": preset, "seed": args.seed, "maml": args.maml, **settings}
    torch.manual_seed(args.seed)
    policy = DAMIPolicy(config).to(device)
    ema = ema_model(policy)
    optimizer = torch.optim.AdamW(
        policy.parameters(), lr=settings["lr"], betas=(0.95, 0.999), weight_decay=1e-6, fused=True
    )
    start, seconds, identity = 0, 0.0, None
    if args.resume and (folder / "last.pt").exists():
        averaged, state = load_checkpoint(folder / "last.pt", device)
        if averaged.config != config or state["arguments"] != arguments:
            old = state["arguments"] | asdict(averaged.config)
            new = arguments | asdict(config)
            differing = ", ".join(
                f"{name} {old.get(name)} -> {new[name]}" for name in new if old.get(name) != new[name]
            )
            raise InputError(f"{folder} was started with other settings ({differing}): give the old ones to resume it")
        policy.load_state_dict(state["training"]["policy"])
        ema.module.load_state_dict(averaged.state_dict())
        ema.n_averaged.copy_(state["training"]["n_averaged"])
        optimizer.load_state_dict(state["training"]["optimizer"])
        start, seconds, identity = state["step"], state["seconds"], state["text_weights"]
    else:
        every = {
            name: np.concatenate([getattr(d, name) for d in demonstrations]) for name in ("points", "state", "action")
        }
        every["points"] = every["points"][:, : config.num_points]
        for module in (policy, ema.module):
            module.normalizer.fit(**{name: torch.from_numpy(x) for name, x in every.items()})
    features, identity = text_features([d.instruction for d in demonstrations], args.clip_weights, identity)
    text = dict(zip(tasks, features.to(device)))  # each (text_dim,)
    drawn = settings["after_success"], settings["augment"]
    samplers = {task: window_sampler(policy, d, *drawn) for task, d in zip(tasks, demonstrations)}
    info = {"suite": suite, "preset": preset, "text_weights": identity, "arguments": arguments}
    if leader and start == 0:
        (folder / "metrics.jsonl").unlink(missing_ok=True)
        written = {
            "arguments": arguments,
            "config": asdict(config),
            "text_weights": identity,
            "hardware": hardware(device),
            "command": command("train.py", argv),
        }
        write_atomically(folder / "config.json", lambda temporary: temporary.write_text(json.dumps(written, indent=1)))
    elif leader:
        rewind_metrics(folder, start)

    def save_last(step: int) -> None:
        training = {"policy": policy.state_dict(), "n_averaged": ema.n_averaged, "optimizer": optimizer.state_dict()}
        save_checkpoint(folder / "last.pt", ema.module, **info, step=step, seconds=seconds, training=training)

    measure = partial(
        evaluate,
        demonstrations=paths,
        text=text,
        episodes=settings["episodes"],
        workers=args.workers,
        device=device,
        n_demonstrations=settings["demonstrations"],
    )

    def loss_fn(params: dict[str, Tensor], batch: dict[str, Tensor]) -> Tensor:
        return functional_call(policy, params, (), batch)

    share = 1.0 if args.maml == "off" else settings["multi_task_share"]
    multi_task_steps = round(share * settings["steps"])
    params = dict(policy.named_parameters())
    mine = list(enumerate(tasks))[rank::world]  # this process's share of the tasks
    n = settings["support"] + settings["query"]
    lengths = {len(range(e.start, e.stop, config.demo_stride)) for s in samplers.values() for e in s.episodes}
    vectorize = settings["vectorize"] if len(lengths) == 1 else 1  # tasks at once need demonstrations of one length
    saved = time.monotonic()
    bar = {"desc": "training", "unit": "step", "dynamic_ncols": True, "disable": not leader}
    with StopRequest() as stop, tqdm(total=settings["steps"], initial=start, **bar) as progress:
        for step in range(start, settings["steps"]):
            began = time.monotonic()

            # One outer step (Algorithm 1, lines 3-21)
            batches = (task_batch(policy, samplers[t], text[t], n, (args.seed, step, index)) for index, t in mine)
            if step < multi_task_steps:
                gradients, losses = mean_loss_gradient(policy, list(batches))
            else:
                pairs = (split(batch, settings["support"]) for batch in batches)
                gradients, losses = meta_gradient(
                    loss_fn,
                    params,
                    pairs,
                    settings["inner_lr"],
                    first_order=args.maml == "first",
                    vectorize=vectorize,
                )
            loss = losses.mean()
            if world > 1:  # the mean over all tasks is the mean of the processes' means, weighted by their shares
                for x in (loss, *gradients.values()):
                    dist.all_reduce(x.mul_(len(mine) / len(tasks)))
            norm = torch.nn.utils.get_total_norm(gradients.values())
            if not torch.isfinite(loss + norm):
                bad = [t for (_, t), value in zip(mine, losses) if len(losses) == len(mine) and not value.isfinite()]
                raise not_finite(step + 1, bad, folder)
            for name, parameter in params.items():
                parameter.grad = gradients[name]
            lr = learning_rate(step, settings["steps"], settings["lr"], settings["warmup"])
            optimizer.param_groups[0]["lr"] = lr
            optimizer.step()
            ema.update_parameters(policy)
            seconds += time.monotonic() - began

            # What it leaves behind
            done = step + 1
            if leader:
                progress.update()
                progress.set_postfix(loss=f"{loss:.4f}")
                log(folder, step=done, loss=loss.item(), gradient_norm=norm.item(), lr=lr, seconds=round(seconds, 2))
                final = done == settings["steps"]
                milestone = final or done % settings["checkpoint_every"] == 0
                if milestone:
                    checkpoint = folder / f"ema-{done:05d}.pt"
                    save_checkpoint(checkpoint, ema.module, **info, step=done, seconds=seconds)
                    if settings["episodes"] and (final or done % settings["evaluate_every"] == 0):
                        successes = measure(checkpoint)
                        log(folder, step=done, success=mean_success(successes), successes=successes)
                    draw_curves(folder)
                if milestone or stop.requested or time.monotonic() - saved > SAVE_SECONDS:
                    save_last(done)  # after the evaluation: a run killed in it comes back to it
                    saved = time.monotonic()
            if stop.requested and done < settings["steps"]:
                if leader:
                    progress.close()
                    print(f"saved after step {done}: add --resume to go on from there", file=sys.stderr)
                raise KeyboardInterrupt
    if world > 1:
        dist.destroy_process_group()

    if leader and start == settings["steps"]:
        print(f"{folder} was finished before: nothing left to do")
    elif leader:
        if settings["episodes"]:
            facts = {
                "title": f"{suite} base tasks, preset {preset}, step {settings['steps']}",
                "episodes a task": settings["episodes"],
                "training": f"{seconds / 60:.1f} min on {hardware(device)}",
                "seed": args.seed,
                "text weights": identity,
                "date": time.strftime("%Y-%m-%d"),
                "command": command("train.py", argv),
            }
            print(f"\n{write_report(folder, {'last checkpoint': successes}, facts, suite)}")
        print(f"\n{folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}")


if __name__ == "__main__":
    command_line(main, ModelInputError)
