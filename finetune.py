"""Few-shot adaptation to a novel task (Algorithm 2): ten demonstrations, 200 gradient steps.

    python finetune.py --task shelf-place            # from the newest run, or the policy that ships
    python finetune.py --task novel                  # all novel tasks of the suite
    python finetune.py --data demos.npz --steps 500  # own demonstrations, in data.py's format

The EMA policy of meta-training is copied and trained with AdamW on windows of the task's
demonstrations, each step with a reference demonstration drawn from them; the three parts of the
policy have learning rates of their own. An EMA of the adapted policy is what is kept. There is no
warm-up and no decay. On a Meta-World task the policy is then rolled out, before and after: the
difference is what adaptation bought.
"""

import argparse
import copy
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import evaluate
import scripts
from clip import text_features
from data import WindowSampler, load_demonstrations
from model import DAMIPolicy, ema_model
from scripts import Flags, command_line, load_checkpoint, progress_bar, save_checkpoint, setting
from simulator import INSTRUCTIONS, check_task, collect, suite_tasks

LEARNING_RATES = {"vision": 1e-5, "diffusion": 3e-5, "other": 1e-4}  # AdamW's, by part
PAPER_LEARNING_RATE = 1e-4  # of the meta-training that they belong to
BATCH = {"paper": 108, "small": 64, "tiny": 16}  # windows a step


@dataclass(frozen=True)
class Settings(Flags):
    """What an adaptation is made of; each field is a flag. None: as the preset has it."""

    steps: int = setting(200, "gradient steps (default: 200)", least=1)
    batch: int | None = setting(None, "windows a step (default: the preset's)", least=1)
    lr_vision: float | None = setting(None, "learning rate of the observation encoder", least=0)
    lr_diffusion: float | None = setting(None, "learning rate of the U-Net", least=0)
    lr_other: float | None = setting(None, "learning rate of VMT and U2T", least=0)
    instruction: bool = setting(True, "--no-instruction: adapt and roll out without it")
    normalizer: str = setting("fit", "to the task, or `keep` the suite's", choices=("fit", "keep"))
    demonstrations: int | None = setting(None, "how many (default: 10; of a file all)", least=1)
    episodes: int = setting(20, "rollouts before and after (default: 20)", least=0)
    seed: int = setting(0, "of batches, noise and goals (default: 0)", least=0, most=999)


# ---- Algorithm 2 ---------------------------------------------------------------------------------


def adapt_policy(
    policy: DAMIPolicy,
    sampler: WindowSampler,
    text: Tensor,
    steps: int = 200,
    batch: int = 108,
    learning_rates: dict[str, float] = LEARNING_RATES,
    seed: int = 0,
    on_step: Callable[[int, float], None] | None = None,
) -> DAMIPolicy:
    """Adapts a copy of a policy to the demonstrations of one task (Algorithm 2, lines 2 to 17).

    Args:
        policy: the meta-trained (EMA) policy; it is left as it is.
        sampler: of the task's demonstrations, on the policy's device.
        text: instruction feature, (text_dim,).
        steps, batch: gradient steps, and windows in each.
        learning_rates: of the parameter groups `vision`, `diffusion` and `other`.
        seed: of batches, demonstrations and noise.
        on_step: called with (steps done, loss) after each.

    Returns:
        The moving average of the adapted policy, in evaluation mode.

    Raises:
        ValueError: the loss is not finite.
    """
    adapted = copy.deepcopy(policy).train()  # line 2
    average = ema_model(adapted)
    parts = adapted.parameter_groups()
    groups = [
        {"params": parts[name], "lr": lr} for name, lr in learning_rates.items() if parts[name]
    ]
    optimizer = torch.optim.AdamW(groups, betas=(0.95, 0.999), weight_decay=1e-6, fused=True)
    generator = torch.Generator().manual_seed(seed)

    for step in range(1, steps + 1):  # line 6
        windows = sampler.batch(batch, generator)  # line 7
        noise = adapted.draw_noise_and_timesteps(batch, generator)  # line 10
        loss = adapted.loss(text=text[None], **windows, **noise)  # lines 8 to 14
        if not torch.isfinite(loss):
            task = sampler.task
            raise ValueError(f"the loss is not finite at step {step} on {task}: lower the --lr-...")

        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(adapted.parameters(), 1.0)
        optimizer.step()  # line 15
        average.update_parameters(adapted)  # line 16
        if on_step is not None:
            on_step(step, loss.item())
    return average.module.eval()


# ---- From files to files -------------------------------------------------------------------------


def adapt_checkpoint(
    checkpoint: Path, data: Path, text: Tensor, folder: Path, settings: Settings
) -> dict[str, Any]:
    """Adapts the policy of a checkpoint to the task of a recording, on the device of `text`.

    Writes adapted.pt (a checkpoint like any other), metrics.jsonl and config.json to `folder`, and
    returns what config.json says: the settings used, with the preset's in place of None, and
    `seconds` spent on the steps. Raises ValueError where the two files do not fit each other.
    """
    policy, info = load_checkpoint(checkpoint, text.device, needs=evaluate.TRAINED)
    demonstrations = load_demonstrations(data).take(settings.demonstrations)
    trained, device = info["arguments"], text.device
    sampler = WindowSampler(demonstrations, policy.config, device, trained.get("after_success"))
    if settings.normalizer == "fit":
        policy.normalizer.fit(sampler.points, sampler.state, sampler.action)  # line 3

    # The paper's rates belong to a meta-training at 1e-4; for another they keep their proportion.
    scale = trained["lr"] / PAPER_LEARNING_RATE
    given = {part: getattr(settings, f"lr_{part}") for part in LEARNING_RATES}
    rates = {p: lr * scale if given[p] is None else given[p] for p, lr in LEARNING_RATES.items()}
    batch = settings.batch or BATCH[info["preset"]]

    losses = []
    bar = {"desc": f"adapting to {demonstrations.task}", "unit": "step"}
    with progress_bar(total=settings.steps, **bar) as progress:

        def on_step(step: int, loss: float) -> None:
            losses.append(loss)
            progress.set_postfix(loss=f"{loss:.4f}")
            progress.update()

        began = time.monotonic()
        steps, seed = settings.steps, settings.seed
        adapted = adapt_policy(policy, sampler, text, steps, batch, rates, seed, on_step)
        seconds = time.monotonic() - began

    used = asdict(settings) | {"batch": batch, "learning_rates": rates}
    kept = {name: info[name] for name in evaluate.TRAINED}
    about = {"adapted_to": demonstrations.task, "instruction": demonstrations.instruction}
    save_checkpoint(folder / "adapted.pt", adapted, **kept, **about, adaptation=used)
    scripts.rewind_metrics(folder, 0)
    for step, loss in enumerate(losses, start=1):
        scripts.log(folder, step=step, loss=loss)
    written = {"checkpoint": str(checkpoint), "data": str(data), **used, "seconds": seconds}
    scripts.write_text(folder / "config.json", json.dumps(written, indent=1))
    return written


# ---- Command line --------------------------------------------------------------------------------


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Adapts a policy to one task (Algorithm 2).")
    add = parser.add_argument_group("run").add_argument
    add("--task", help="a Meta-World task, or `novel`: all novel tasks of the suite")
    add("--suite", default="ml10", help="of the run to start from, and of `novel` (default: ml10)")
    add("--data", default="data", help="folder of the demonstrations, or one file (default: data)")
    add("--checkpoint", help="file or run folder to start from (default: the newest run's last)")
    add("--out", help="folder of the adapted policy (default: runs/finetune/TASK-seedSEED)")
    add("--overwrite", action="store_true", help="replace what is in that folder")
    add("--device", help="cpu, cuda, cuda:1 ... (default: cuda if there is one)")
    add("--workers", type=int, help="processes for collecting and evaluating (default: one a core)")
    add("--clip-weights", help="CLIP's ViT-B-32.pt, or `random` (default: as in the checkpoint)")
    Settings.add_flags(parser.add_argument_group("settings"))
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    args = parse(argv)
    settings = Settings().given(args)
    device = scripts.pick_device(args.device)

    # Which tasks, from which policy: a recording of one's own, one task, or all novel tasks
    file = Path(args.data) if args.data.endswith(".npz") else None
    if args.task is None and file is None:
        raise ValueError("name a task of Meta-World with --task, or a recording with --data")
    if file is not None:
        tasks = [load_demonstrations(file).task]
        if args.task not in (None, *tasks):
            raise ValueError(f"{file} is a recording of {tasks[0]}, not of {args.task}")
    else:
        tasks = suite_tasks(args.suite)[1] if args.task == "novel" else [check_task(args.task)]
    simulated = all(task in INSTRUCTIONS for task in tasks)
    start = args.checkpoint or evaluate.default_checkpoint(args.suite if simulated else "own")
    checkpoint = evaluate.checkpoints_of(start)[-1]
    _, info = load_checkpoint(checkpoint, needs=evaluate.TRAINED)
    where = f"{device} ({scripts.hardware(device)})"
    print(f"{checkpoint}: preset {info['preset']}, step {info['step']}, on {where}", flush=True)

    # Folders, demonstrations and instructions
    folder = Path(args.out or f"runs/finetune/{args.task or tasks[0]}-seed{settings.seed}")
    folders = {task: folder / task if args.task == "novel" else folder for task in tasks}
    for path in folders.values():
        scripts.claim_folder(path, "adapted.pt", args.overwrite)
    if file is None:
        settings = replace(settings, demonstrations=settings.demonstrations or 10)
        paths = collect(tasks, args.data, settings.demonstrations, workers=args.workers)
    else:
        paths = {tasks[0]: file}
    instructions = [load_demonstrations(paths[task]).instruction for task in tasks]
    features, identity = text_features(instructions, args.clip_weights, info["text_weights"])
    text = dict(zip(tasks, features.to(device) * settings.instruction))  # each (text_dim,)

    columns, seconds = {"before": {}, "after": {}}, 0.0
    for task in tasks:
        adapted = folders[task] / "adapted.pt"
        used = adapt_checkpoint(checkpoint, paths[task], text[task], folders[task], settings)
        seconds += used["seconds"]
        print(f"adapted to {task} in {used['seconds']:.1f} s; wrote {adapted}", flush=True)
        if simulated and settings.episodes:
            protocol = (settings.episodes, settings.seed, args.workers, device)
            for column, policy in {"before": checkpoint, "after": adapted}.items():
                columns[column] |= evaluate.evaluate(
                    policy, {task: paths[task]}, text, *protocol, settings.demonstrations
                )
    if not columns["after"]:
        return  # own recordings have no simulator to be rolled out in

    facts = {"title": f"{args.task}: before and after {settings.steps} steps"}
    facts |= {"checkpoint": str(checkpoint), "seconds a task": round(seconds / len(tasks), 1)}
    facts |= {name: getattr(settings, name) for name in ("steps", "demonstrations", "episodes")}
    facts |= {"seed": settings.seed, "text weights": identity}
    facts |= scripts.report_facts("finetune.py", argv, device)
    print(f"\n{evaluate.write_report(folder, columns, facts, info['suite'])}")


if __name__ == "__main__":
    command_line(main)
