"""Few-shot adaptation to a novel task (Algorithm 2): ten demonstrations, 200 gradient steps.

    python finetune.py --task shelf-place                        # from the newest run's last checkpoint
    python finetune.py --data demos.npz --steps 500              # own demonstrations, in the format of data.py

The EMA policy of meta-training is copied and trained with AdamW on windows of the task's demonstrations, each step with
a reference demonstration drawn from them; the three parts of the policy have learning rates of their own. An EMA of the
adapted policy is what is kept. On a Meta-World task it is then rolled out, and so is the policy before adaptation: the
difference is what adaptation bought.
"""

import argparse
import copy
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from data import (
    INSTRUCTIONS,
    Demonstrations,
    InputError,
    WindowSampler,
    check_task,
    collect,
    command_line,
    evaluation_seed,
    load_demonstrations,
)
from evaluate import (
    command,
    evaluate,
    hardware,
    load_trained,
    newest_checkpoint,
    pick_device,
    text_features,
    window_sampler,
    write_atomically,
    write_report,
)
from model import DAMIPolicy, ema_model, save_checkpoint
from model import InputError as ModelInputError

# AdamW's learning rates for the parts of the policy. The paper's belong to a meta-training at 1e-4; those of the other
# presets keep their proportion to the learning rate the policy was meta-trained with.
LEARNING_RATES = {"vision": 1e-5, "diffusion": 3e-5, "other": 1e-4}
PAPER_LEARNING_RATE = 1e-4
BATCH = {"paper": 108, "small": 64, "tiny": 16}  # windows a step


def adapt_policy(
    policy: DAMIPolicy,
    sampler: WindowSampler,
    text: Tensor,
    steps: int = 200,
    batch: int = 108,
    learning_rates: dict[str, float] = LEARNING_RATES,
    clip: float = 1.0,
    weight_decay: float = 1e-6,
    seed: int = 0,
    on_step: Callable[[int, float], None] | None = None,
) -> DAMIPolicy:
    """Adapts a copy of a policy to the demonstrations of one task (Algorithm 2, lines 2-16).

    Args:
        policy: the meta-trained (EMA) policy; it is left as it is.
        sampler: of the task's demonstrations, on the policy's device (`evaluate.window_sampler`).
        text: instruction feature, (text_dim,).
        steps: gradient steps.
        batch: windows a step.
        learning_rates: of the parameter groups `vision`, `diffusion` and `other`.
        clip: largest norm of the gradient.
        weight_decay: of AdamW.
        seed: of batches, demonstrations and noise.
        on_step: called with (steps done, loss) after each.

    Returns:
        The moving average of the adapted policy, in evaluation mode.

    Raises:
        InputError: the loss is not finite.
    """
    adapted = copy.deepcopy(policy).train()
    average = ema_model(adapted)
    groups = adapted.parameter_groups()
    optimizer = torch.optim.AdamW(
        [{"params": groups[name], "lr": lr} for name, lr in learning_rates.items() if groups[name]],
        betas=(0.95, 0.999),
        weight_decay=weight_decay,
        fused=True,
    )
    generator = torch.Generator().manual_seed(seed)
    for step in range(steps):
        loss = adapted.loss(text=text[None], **sampler.batch(batch, generator), **adapted.draw_noise(batch, generator))
        if not torch.isfinite(loss):
            raise InputError(f"the loss is not finite at step {step + 1} on {sampler.task}: use smaller learning rates")
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(adapted.parameters(), clip)
        optimizer.step()
        average.update_parameters(adapted)
        if on_step is not None:
            on_step(step + 1, loss.item())
    return average.module.eval()


def adapt_checkpoint(
    checkpoint: str | Path,
    demonstrations: Demonstrations,
    text: Tensor,
    out: str | Path,
    steps: int = 200,
    batch: int | None = None,
    learning_rates: dict[str, float] | None = None,
    normalizer: str = "fit",
    seed: int = 0,
) -> dict[str, Any]:
    """Adapts the policy of a checkpoint to a task and writes the adapted one to `out`, a checkpoint like any other.

    Args:
        checkpoint: a file of train.py.
        demonstrations: of the task.
        text: instruction feature, (text_dim,), on the device to adapt on.
        steps, seed: as in `adapt_policy`.
        batch: windows a step; None: the preset's.
        learning_rates: changes to the default ones, by parameter group.
        normalizer: `fit` the value ranges to the demonstrations (Algorithm 2, line 3), or `keep` those of the suite.

    Returns:
        The settings used, `seconds` spent on the steps, and `losses`, one a step.

    Raises:
        InputError: checkpoint and demonstrations do not fit each other, or the loss is not finite.
    """
    policy, info = load_trained(checkpoint, text.device)
    sampler = window_sampler(policy, demonstrations, info["arguments"].get("after_success"))
    if normalizer == "fit":
        policy.normalizer.fit(sampler.points, sampler.state, sampler.action)
    scale = info["arguments"]["lr"] / PAPER_LEARNING_RATE
    settings = {
        "steps": steps,
        "batch": batch or BATCH[info["preset"]],
        "learning_rates": {name: lr * scale for name, lr in LEARNING_RATES.items()} | (learning_rates or {}),
        "seed": seed,
    }
    losses = []
    with tqdm(total=steps, desc=f"adapting to {demonstrations.task}", unit="step", dynamic_ncols=True) as progress:

        def on_step(step: int, loss: float) -> None:
            losses.append(loss)
            progress.set_postfix(loss=f"{loss:.4f}")
            progress.update()

        began = time.monotonic()
        adapted = adapt_policy(policy, sampler, text, **settings, on_step=on_step)
        seconds = time.monotonic() - began
    settings["normalizer"] = normalizer
    kept = {name: info[name] for name in ("suite", "preset", "text_weights", "arguments", "step")}
    about = {"adapted_to": demonstrations.task, "instruction": demonstrations.instruction, "adaptation": settings}
    save_checkpoint(out, adapted, **kept, **about)
    return {**settings, "seconds": seconds, "losses": losses}


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Adapt a meta-trained policy to one task (Algorithm 2).")
    parser.add_argument("--task", help="a Meta-World task; its demonstrations are collected if missing")
    parser.add_argument("--data", default="data", help="folder of the demonstrations, or one file (default: data)")
    parser.add_argument("--checkpoint", help="policy to start from (default: the newest run's last)")
    parser.add_argument(
        "--out", help="folder for the adapted policy and its report (default: runs/finetune/TASK-seedSEED)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of batches, noise and evaluation (default: 0)")
    parser.add_argument("--device", help="cpu, cuda, cuda:1 ... (default: cuda if there is one)")
    parser.add_argument(
        "--episodes", type=int, default=20, help="evaluation episodes; 0: do not evaluate (default: 20)"
    )
    parser.add_argument("--workers", type=int, help="processes for collecting and evaluating (default: one a core)")
    parser.add_argument("--clip-weights", help="CLIP's ViT-B-32.pt, or `random` (default: as in the checkpoint)")
    parser.add_argument("--demonstrations", type=int, help="the first so many (default: 10, or all of a file's)")
    parser.add_argument("--steps", type=int, default=200, help="gradient steps (default: 200)")
    parser.add_argument("--batch", type=int, help="windows a step (default: paper 108, small 64, tiny 16)")
    parser.add_argument(
        "--normalizer",
        choices=("fit", "keep"),
        default="fit",
        help="value ranges: the task's (default), or the suite's",
    )
    for part in LEARNING_RATES:
        parser.add_argument(f"--lr-{part}", type=float, help=f"learning rate of the {part} parameters")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    args = parse(argv)
    for name in ("steps", "batch", "demonstrations"):
        if (value := getattr(args, name)) is not None and value < 1:
            raise InputError(f"--{name} is {value}: use at least 1")
    evaluation_seed(args.seed, 0)  # refuses a seed out of range now rather than after the adaptation
    device = pick_device(args.device)
    data = Path(args.data)
    if args.task is None and data.suffix != ".npz":
        raise InputError("name a Meta-World task with --task, or a file of demonstrations with --data")
    if args.task is not None:
        check_task(args.task)
    checkpoint = Path(args.checkpoint) if args.checkpoint else newest_checkpoint()
    _, info = load_trained(checkpoint)
    print(f"{checkpoint}: preset {info['preset']}, step {info['step']}, on {device} ({hardware(device)})", flush=True)

    n_demonstrations = args.demonstrations
    if data.suffix != ".npz":
        n_demonstrations = n_demonstrations or 10
        data = collect([args.task], data, n_demonstrations, workers=args.workers)[args.task]
    demonstrations = load_demonstrations(data).first(n_demonstrations)
    task = args.task or demonstrations.task
    features, identity = text_features([demonstrations.instruction], args.clip_weights, info["text_weights"])
    text = features[0].to(device)
    folder = Path(args.out or f"runs/finetune/{task}-seed{args.seed}")
    folder.mkdir(parents=True, exist_ok=True)

    given = {name: lr for name in LEARNING_RATES if (lr := getattr(args, f"lr_{name}")) is not None}
    adapted = folder / "adapted.pt"
    result = adapt_checkpoint(
        checkpoint, demonstrations, text, adapted, args.steps, args.batch, given, args.normalizer, args.seed
    )
    losses, seconds = result.pop("losses"), result["seconds"]
    lines = "".join(json.dumps({"step": step, "loss": loss}) + "\n" for step, loss in enumerate(losses, start=1))
    write_atomically(folder / "metrics.jsonl", lambda temporary: temporary.write_text(lines))
    written = {"checkpoint": str(checkpoint), "data": str(data), **result, "text_weights": identity}
    write_atomically(folder / "config.json", lambda temporary: temporary.write_text(json.dumps(written, indent=1)))
    print(f"adapted in {seconds:.1f} s: loss {losses[0]:.4f} -> {losses[-1]:.4f}; wrote {adapted}", flush=True)

    if args.episodes == 0 or task not in INSTRUCTIONS:  # own recordings have no simulator to be rolled out in
        return
    columns = {
        name: evaluate(
            path, {task: data}, {task: text}, args.episodes, args.seed, args.workers, device, args.demonstrations
        )
        for name, path in {"before": checkpoint, "after": adapted}.items()
    }
    facts = {
        "title": f"{task}: before and after {args.steps} steps",
        "checkpoint": str(checkpoint),
        "adaptation": f"{args.steps} steps in {seconds:.1f} s on {hardware(device)}",
        "seed": args.seed,
        "text weights": identity,
        "date": time.strftime("%Y-%m-%d"),
        "command": command("finetune.py", argv),
    }
    print(f"\n{write_report(folder, columns, facts, info['suite'])}")


if __name__ == "__main__":
    command_line(main, ModelInputError)
