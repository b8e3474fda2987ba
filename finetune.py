"""Few-shot adaptation to a novel task (Algorithm 2): ten demonstrations, 200 gradient steps.

    python finetune.py --task shelf-place            # from the newest run, or the policy that ships
    python finetune.py --task novel                  # all novel tasks of the suite
    python finetune.py --data demos.npz --steps 500  # own demonstrations, in data.py's format

The EMA policy of meta-training is trained on with AdamW, each step on windows of the task's
demonstrations and one of them as reference; its three parts have learning rates of their own, and
there is neither warm-up nor decay. What is kept is an EMA again. On a Meta-World task the policy is
rolled out before and after: the difference is what adaptation bought.
"""

import argparse
import copy
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import evaluate
import scripts
from data import WindowSampler, load_demonstrations
from model import DAMIPolicy, ema_model
from report import write_report
from scripts import Flags, command_line, load_checkpoint, progress_bar, save_checkpoint, setting
from simulator import check_task, collect, is_simulated, suite_tasks

LEARNING_RATES = {"vision": 1e-5, "diffusion": 3e-5, "other": 1e-4}  # AdamW's, by part
PAPER_LEARNING_RATE = 1e-4  # of the meta-training that they belong to
BATCH = {"paper": 108, "small": 64, "tiny": 16}  # windows a step


@dataclass(frozen=True)
class Settings(Flags):
    """What an adaptation is made of; each field is a flag. None: as the preset has it."""

    steps: int = setting(200, "gradient steps (default: 200)", least=1)
    batch: int | None = setting(None, f"windows a step{scripts.of_presets(BATCH)}", least=1)
    lr_vision: float | None = setting(None, "learning rate of the observation encoder", least=0)
    lr_diffusion: float | None = setting(None, "learning rate of the U-Net", least=0)
    lr_other: float | None = setting(None, "learning rate of VMT and U2T", least=0)
    instruction: bool = setting(True, "--no-instruction: adapt and roll out without it")
    normalizer: str = setting("fit", "to the task, or `keep` the suite's", choices=("fit", "keep"))
    demonstrations: int | None = setting(None, "how many (default: 10; of a file all)", least=1)
    held_out: int = setting(0, "of them, the last so many only judge (default: 0)", least=0)
    episodes: int = setting(20, "rollouts before and after (default: 20)", least=0)
    seed: int = setting(0, "of batches, noise and goals (default: 0)", least=0, most=999)


# ---- Algorithm 2 ---------------------------------------------------------------------------------


def adapt_policy(
    policy: DAMIPolicy,
    sampler: WindowSampler,
    text: Tensor,
    steps: int,
    batch: int,
    learning_rates: dict[str, float],
    seed: int = 0,
) -> Iterator[tuple[int, float, DAMIPolicy]]:
    """Adapts a copy of a policy to the demonstrations of one task (Algorithm 2, lines 2 to 17).

    Args:
        policy: the meta-trained (EMA) policy; it is left as it is.
        sampler: of the task's demonstrations.
        text: instruction feature, (text_dim,).
        steps, batch: gradient steps, and windows in each.
        learning_rates: of the parameter groups `vision`, `diffusion` and `other`.
        seed: of batches, demonstrations and noise.

    Yields (steps done, loss, the moving average of the adapted policy) after each step. Raises
    ValueError if the loss is not finite.
    """
    adapted = copy.deepcopy(policy).train()  # line 2
    average = ema_model(adapted)
    average.module.eval()
    parts = adapted.parameter_groups().items()
    groups = [{"params": part, "lr": learning_rates[name]} for name, part in parts if part]
    optimizer = torch.optim.AdamW(groups, betas=(0.95, 0.999), weight_decay=1e-6, fused=True)
    generator = torch.Generator().manual_seed(seed)

    def loss_and_gradient(drawn: dict[str, Tensor]) -> tuple[Tensor, tuple[Tensor, ...]]:
        loss = adapted.loss(text=text[None], **drawn)  # lines 8 to 14
        return loss.detach(), torch.autograd.grad(loss, list(adapted.parameters()))

    lengths = {episode.stop - episode.start for episode in sampler.episodes}
    if text.is_cuda and len(lengths) == 1:  # always equal shapes
        loss_and_gradient = scripts.Captured(loss_and_gradient)

    for step in range(1, steps + 1):  # line 6
        drawn = sampler.batch(batch, generator)  # line 7
        drawn |= adapted.draw_noise_and_timesteps(batch, generator)  # line 10
        drawn = {name: x.to(text.device) for name, x in drawn.items()}
        loss, gradient = loss_and_gradient(drawn)
        if not torch.isfinite(loss):
            raise ValueError(f"{sampler.task}: loss not finite at step {step}, lower the --lr-...")

        for parameter, g in zip(adapted.parameters(), gradient):
            parameter.grad = g
        torch.nn.utils.clip_grad_norm_(adapted.parameters(), 1.0)
        optimizer.step()  # line 15
        average.update_parameters(adapted)  # line 16
        yield step, loss.item(), average.module


# ---- From files to files -------------------------------------------------------------------------


def adapt_checkpoint(
    checkpoint: Path,
    data: Path,
    text: Tensor,
    folder: Path,
    settings: Settings,
    curve: Sequence[int] = (),
    **changed: Any,
) -> dict[str, Any]:
    """Adapts the policy of a checkpoint to the task of a recording, on the device of `text`.

    Writes adapted.pt (a checkpoint like any other; after the steps in `curve` adapted-STEP.pt),
    metrics.jsonl and config.json to `folder`; returns what config.json says, `seconds` among it.
    What is in `changed` takes the place of the same in the policy's configuration. Raises
    ValueError where the two files do not fit each other.
    """
    policy, info = load_checkpoint(checkpoint, text.device, evaluate.TRAINED, **changed)
    demonstrations = load_demonstrations(data).take(settings.demonstrations)
    trained, task = info["arguments"], demonstrations.task
    how = policy.config, "cpu", trained.get("after_success")
    parts = evaluate.hold_out({task: demonstrations}, settings.held_out)
    shown, unseen = (scripts.windows(part, *how) for part in parts)
    sampler, judged_by = shown[task], (shown, unseen, {task: text})
    scripts.rewind_metrics(folder, 0)
    evaluate.judge(folder, 0, policy, *judged_by)
    if settings.normalizer == "fit":
        policy.normalizer.fit([sampler])  # line 3

    # The paper's rates belong to a meta-training at 1e-4; for another they keep their proportion.
    scale = trained["lr"] / PAPER_LEARNING_RATE
    given = {part: getattr(settings, f"lr_{part}") for part in LEARNING_RATES}
    rates = {p: lr * scale if given[p] is None else given[p] for p, lr in LEARNING_RATES.items()}
    batch = settings.batch or BATCH[info["preset"]]
    used = asdict(settings) | {"batch": batch, "learning_rates": rates}
    resolved = used | {f"lr_{part}": rate for part, rate in rates.items()}
    scripts.print_settings(resolved, asdict(Settings()))
    about = {name: info[name] for name in evaluate.TRAINED} | {"adaptation": used}
    about |= {"adapted_to": task, "instruction": demonstrations.instruction}

    seconds, began = 0.0, time.monotonic()
    bar = {"desc": f"adapting to {task}", "unit": "step"}
    training = adapt_policy(policy, sampler, text, settings.steps, batch, rates, settings.seed)
    with progress_bar(total=settings.steps, **bar) as progress:
        for step, loss, adapted in training:
            seconds += time.monotonic() - began
            progress.set_postfix(loss=f"{loss:.4f}")
            progress.update()
            scripts.log(folder, step=step, loss=loss)
            if step in curve:
                save_checkpoint(folder / f"adapted-{step:05d}.pt", adapted, **about)
            began = time.monotonic()

    save_checkpoint(folder / "adapted.pt", adapted, **about)
    table = evaluate.judge(folder, settings.steps, adapted, *judged_by)
    print(table, end="\n" if table else "", flush=True)
    written = {"checkpoint": str(checkpoint), "data": str(data), **used, "seconds": seconds}
    scripts.write_text(folder / "config.json", json.dumps(written, indent=1))
    return written


# ---- Command line --------------------------------------------------------------------------------


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Adapts a policy to one task (Algorithm 2).")
    add = parser.add_argument_group("run").add_argument
    add("--task", nargs="+", help="tasks of Meta-World, or `novel`: the novel ones of the suite")
    add("--suite", help="of the run to start from, and of `novel` (default: the run's, or ml10)")
    add("--data", default="data", help="folder of the demonstrations, or one file (default: data)")
    add("--checkpoint", help="file or run folder to start from (default: the newest run's last)")
    add("--curve", nargs="+", type=int, default=[], help="roll out after these steps, too")
    add("--out", help="folder of the adapted policy (default: runs/finetune/TASK-seedSEED)")
    add("--overwrite", action="store_true", help="replace what is in that folder")
    scripts.add_inference_flags(add)
    scripts.add_common_flags(add)
    rates = f"Learning rates at a meta-training rate of {PAPER_LEARNING_RATE:g}: {LEARNING_RATES}."
    Settings.add_flags(parser.add_argument_group("settings", rates))
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    args = parse(argv)
    settings = Settings().given(args)
    device = scripts.pick_device(args.device, args.threads)

    # Which tasks, and from which policy
    file = Path(args.data) if args.data.endswith(".npz") else None
    if args.task is None and file is None:
        raise ValueError("name a task of Meta-World with --task, or a recording with --data")
    simulated = True
    if file is not None:
        recorded = load_demonstrations(file)
        tasks, simulated = [recorded.task], is_simulated(recorded, file)
        if args.task not in (None, tasks):
            raise ValueError(f"{file} is a recording of {tasks[0]}, not of {args.task[0]}")
    elif args.task != ["novel"]:
        tasks = [check_task(task) for task in args.task]
    suite_tasks(args.suite or "ml10")  # refuses a wrong one now
    if not all(0 < step < settings.steps for step in args.curve):
        raise ValueError(f"--curve: use steps from 1 to {settings.steps - 1}, those before --steps")
    suite = args.suite or "ml10" if simulated else "own"
    checkpoint = scripts.checkpoints_of(args.checkpoint or evaluate.default_checkpoint(suite))[-1]
    changed = scripts.inference(args)
    _, info = load_checkpoint(checkpoint, needs=evaluate.TRAINED, **changed)
    if args.task == ["novel"]:
        tasks = suite_tasks(args.suite or info["suite"])[1]
    where = f"{device} ({scripts.hardware(device)})"
    print(f"{checkpoint}: preset {info['preset']}, step {info['step']}, on {where}", flush=True)

    several = args.task is not None and (len(args.task) > 1 or args.task == ["novel"])
    name = "-".join(args.task or tasks)
    folder = Path(args.out or f"runs/finetune/{name}-seed{settings.seed}")
    folders = {task: folder / task if several else folder for task in tasks}
    if file is None:
        settings = replace(settings, demonstrations=settings.demonstrations or 10)

    with scripts.locked(folder):
        claimed = {folder, *folders.values()}
        old = [file for path in claimed for file in scripts.claim_folder(path, args.overwrite)]
        if checkpoint.resolve() in [path.resolve() for path in old]:
            raise ValueError(f"{checkpoint} itself would be overwritten: choose another --out")
        n, how = settings.demonstrations, (args.clip_weights, info["text_weights"], device)
        paths = {tasks[0]: file} if file else collect(tasks, args.data, n, workers=args.workers)
        recorded = {task: load_demonstrations(paths[task]).take(n) for task in tasks}
        shown, _ = evaluate.hold_out(recorded, settings.held_out)  # refuses too many now
        text, identity = scripts.instruction_features(recorded, *how, told=settings.instruction)
        for file in old:
            file.unlink()

        # Each task before, in between if asked for, and after
        between = sorted(set(args.curve))
        columns = {"before": checkpoint.resolve()}
        columns |= {f"{step} steps": f"adapted-{step:05d}.pt" for step in between}
        columns["after"] = "adapted.pt"
        results, seconds = {column: {} for column in columns}, 0.0
        for task, out in folders.items():
            arguments = checkpoint, paths[task], text[task], out, settings, between
            took = adapt_checkpoint(*arguments, **changed)["seconds"]
            seconds += took
            print(f"adapted to {task} in {took:.1f} s; wrote {out / 'adapted.pt'}", flush=True)
            if simulated and settings.episodes:
                protocol = (settings.episodes, settings.seed, args.workers, device)
                for column, policy in columns.items():
                    of_task = {task: paths[task]}, text, *protocol, len(shown[task])
                    results[column] |= evaluate.evaluate(out / policy, *of_task, **changed)
        if not results["after"]:
            return  # own recordings have no simulator to be rolled out in

        facts = {"title": f"{name}: before and after {settings.steps} steps"}
        facts |= {"checkpoint": str(checkpoint), "seconds a task": round(seconds / len(tasks), 1)}
        kept = ("steps", "demonstrations", "episodes", "seed", "instruction")
        facts |= {"text weights": identity} | {key: getattr(settings, key) for key in kept}
        facts |= scripts.report_facts("finetune.py", argv, device) | changed
        print(f"\n{write_report(folder, results, facts, info['suite'])}")


if __name__ == "__main__":
    command_line(main)
