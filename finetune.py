"""Few-shot adaptation to a novel task (Algorithm 2): ten demonstrations, 200 gradient steps.

    python finetune.py --task shelf-place            # from the newest run, or the policy that ships
    python finetune.py --task novel                  # all novel tasks of the suite
    python finetune.py --data demos.npz --steps 500  # own demonstrations, in data.py's format
    python finetune.py --task shelf-place --inner-steps 5    # as meta-training adapts, see below

Training goes on from the averaged weights of meta-training, with AdamW. Each step reads windows of
the task's demonstrations, and one demonstration as reference. The three parts of the policy have
learning rates of their own, which stay constant. The moving average is kept, as in meta-training. A
task of a simulator is rolled out before and after: the difference is what adaptation bought.

With `--inner-steps`, the adaptation is the one that meta-training differentiates (Eq. 2): so many
steps of plain gradient descent on one batch of windows, with the inner learning rates of training,
fixed or learned. The normalizer stays that of training, and nothing is averaged.
"""

import argparse
import copy
import json
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import common
import evaluate
import model
import report
from clip import TextWeightsError
from common import CUDAGraphed, UserError, WorkerPool, append_json, setting
from data import (
    Demonstrations,
    RecordingError,
    WindowSampler,
    hold_out,
    load_demonstrations,
    suspicions,
    write_text,
)
from model import CheckpointError, DAMIPolicy, PolicyConfig, ema_model
from report import Outcomes
from simulator import (
    SIMULATORS,
    Simulator,
    check_recipe,
    check_task,
    collect,
    made_by_simulator,
    simulator_of,
)

LEARNING_RATES = {"vision": 1e-5, "diffusion": 3e-5, "other": 1e-4}  # AdamW's, by part
PAPER_LEARNING_RATE = 1e-4  # of the meta-training that they belong to
BATCH = {"paper": 108, "small": 64, "tiny": 16}  # windows a step, by preset


@dataclass(frozen=True)
class Settings:
    """What an adaptation is made of; each field is a flag.

    A default of None stands for one that depends on the policy or the task, see `resolve` and
    `main`.
    """

    steps: int = setting(200, "gradient steps (default: 200)", least=1)
    batch: int | None = setting(None, f"windows a step{common.describe_presets(BATCH)}", least=1)
    lr_vision: float | None = setting(None, "learning rate of the observation encoder", least=0)
    lr_diffusion: float | None = setting(None, "learning rate of the denoiser", least=0)
    lr_other: float | None = setting(None, "learning rate of VMT and U2T", least=0)
    inner_steps: int | None = setting(
        None, "in place of AdamW: steps of meta-training's inner loop, on one batch", least=1
    )
    inner_lr: float | None = setting(
        None, "learning rate of the inner steps (default: training's, learned or fixed)", least=0
    )
    instruction: bool = setting(True, "read the instruction (default: yes)")
    normalizer: str = setting(
        "fit",
        "fit it to the task's data (the default), or keep that of training",
        choices=("fit", "keep"),
    )
    demonstrations: int | None = setting(
        None, "how many (default: 10 or 5, as the suite says; of a file all)", least=1
    )
    held_out: int = setting(
        0, "how many of them, the last ones, are kept for measuring alone (default: 0)", least=0
    )
    episodes: int = setting(20, "rollouts a task, before and after (default: 20)", least=0)
    seed: int = setting(0, "of batches, noise and goals (default: 0)", least=0, most=999)

    def __post_init__(self) -> None:
        common.check_settings(self)


# ---- Algorithm 2 ---------------------------------------------------------------------------------


def adapt_policy(
    policy: DAMIPolicy,
    sampler: WindowSampler,
    text: Tensor,
    *,
    steps: int,
    batch: int,
    learning_rates: dict[str, float],
    seed: int = 0,
) -> Iterator[tuple[int, float, DAMIPolicy]]:
    """Adapts a copy of a policy to the demonstrations of one task (Algorithm 2, lines 2, 5 to 17).

    Args:
        policy: the meta-trained (EMA) policy; it is left as it is.
        sampler: of the task's demonstrations.
        text: instruction feature, (text_dim,).
        steps, batch: gradient steps, and windows in each.
        learning_rates: of the parameter groups `vision`, `diffusion` and `other`.
        seed: of batches, demonstrations and noise.

    Yields:
        After each step: (steps done, the loss of the step's batch before that step, the moving
        average of the adapted policy). The average is always the same object.

    Raises:
        UserError: the loss is not finite.
    """
    adapted = copy.deepcopy(policy).train()  # line 2
    average = ema_model(adapted)
    optimizer = torch.optim.AdamW(
        [
            {"params": parameters, "lr": learning_rates[part]}
            for part, parameters in adapted.parameter_groups().items()
            if parameters
        ],
        betas=(0.95, 0.999),
        weight_decay=1e-6,
        fused=True,
    )
    generator = torch.Generator().manual_seed(seed)

    gradient_of = partial(loss_and_gradients, adapted)
    lengths = {episode.stop - episode.start for episode in sampler.episodes}
    if text.is_cuda and len(lengths) == 1:  # the shapes are the same in every step
        gradient_of = CUDAGraphed(gradient_of)

    for step in range(1, steps + 1):  # line 6
        drawn = adapted.draw_batch(sampler, text, batch, generator)  # lines 7 and 10
        loss, gradients = gradient_of(drawn)  # lines 8 to 14
        if not torch.isfinite(loss):
            raise UserError(
                f"{sampler.task}: the loss is not finite at step {step}: use smaller learning "
                "rates, --lr-vision, --lr-diffusion and --lr-other"
            )

        for parameter, gradient in zip(adapted.parameters(), gradients):
            parameter.grad = gradient
        torch.nn.utils.clip_grad_norm_(adapted.parameters(), 1.0)
        optimizer.step()  # line 15
        average.update_parameters(adapted)  # line 16
        yield step, loss.item(), average.module


def loss_and_gradients(
    policy: DAMIPolicy, batch: dict[str, Tensor]
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """The loss () of a batch, and its gradient for each parameter."""
    loss = policy.loss(**batch)
    return loss.detach(), torch.autograd.grad(loss, list(policy.parameters()))


# ---- From files to files -------------------------------------------------------------------------


def resolve(settings: Settings, info: dict[str, Any]) -> Settings:
    """Fills in what the settings leave open: the windows a step, and the learning rates.

    Both depend on the training that a checkpoint tells of beside its weights (`info`). The paper's
    learning rates are for a meta-training at 1e-4, and are scaled by the rate of this one. Inner
    steps are as in training; where it learned their rates, `inner_lr` stays None.
    """
    if settings.inner_steps is not None:
        inner_lr = settings.inner_lr
        if inner_lr is None and not info.get("inner_rates"):
            inner_lr = info["arguments"]["inner_lr"]
        return replace(
            settings,
            steps=settings.inner_steps,
            batch=settings.batch or info["arguments"]["support"],
            inner_lr=inner_lr,
            normalizer="keep",
        )
    scale = info["arguments"]["lr"] / PAPER_LEARNING_RATE
    rates = {}
    for part, rate in LEARNING_RATES.items():
        of_flag = getattr(settings, f"lr_{part}")
        rates[f"lr_{part}"] = rate * scale if of_flag is None else of_flag
    return replace(settings, batch=settings.batch or BATCH[info["preset"]], **rates)


def log_heldout_error(
    folder: Path,
    step: int,
    policy: DAMIPolicy,
    train_sampler: WindowSampler,
    heldout_sampler: WindowSampler,
    text: Tensor,
) -> evaluate.ActionError:
    """Logs the action error on held-out episodes, and returns it."""
    error = evaluate.action_error(policy, train_sampler, heldout_sampler, text)
    mean = float(error.of_policy.mean())
    append_json(
        folder / "metrics.jsonl",
        step=step,
        action_error=mean,
        action_errors={train_sampler.task: mean},
    )
    return error


@dataclass(frozen=True)
class Adaptation:
    """The adaptation of a checkpoint's policy to one task: from which files to which, and how."""

    checkpoint: Path  # a file of train.py or finetune.py
    recording: Path  # a file with the task's demonstrations
    folder: Path  # what is written goes there
    settings: Settings
    curve: Sequence[int]  # steps after which a checkpoint is also written and rolled out
    config_overrides: dict[str, Any]  # of the policy's configuration, see `inference_overrides`

    def describe(self) -> dict[str, Any]:
        """All that decides the results, for config.json."""
        return {
            "checkpoint": str(self.checkpoint),
            "data": str(self.recording),
            "curve": list(self.curve),
            "config_overrides": self.config_overrides,
            **asdict(self.settings),
        }

    def checkpoint_after(self, step: int) -> Path:
        """The checkpoint of an intermediate step."""
        return self.folder / f"adapted-{step:05d}.pt"

    def run(self, text: Tensor) -> float:
        """Adapts the policy, on the device of the instruction feature `text` (text_dim,).

        Writes adapted.pt, a checkpoint like any other, metrics.jsonl and config.json to the folder,
        which exists, and held-out.md if there are held-out episodes.

        Returns the seconds that the gradient steps took.

        Raises:
            RecordingError, CheckpointError: one of the two files is damaged, or they do not fit.
            UserError: the loss is not finite.
        """
        settings, folder = self.settings, self.folder
        policy, info = evaluate.load_trained(self.checkpoint, text.device, **self.config_overrides)
        demonstrations = load_demonstrations(self.recording).take(settings.demonstrations)
        kept, heldout = hold_out(demonstrations, settings.held_out)
        sampler = evaluate.adaptation_sampler(kept, policy, info)
        write_text(folder / "metrics.jsonl", "")  # lines are appended
        if heldout is not None:
            heldout_sampler = WindowSampler(heldout, policy.config)
            before = log_heldout_error(folder, 0, policy, sampler, heldout_sampler, text)
        if settings.normalizer == "fit":
            policy.normalizer.fit([sampler])  # line 3

        checkpoint_info = {
            **{name: info[name] for name in evaluate.TRAINED},
            "inner_rates": info.get("inner_rates", {}),
            "adaptation": asdict(settings),
            "adapted_to": demonstrations.task,
            "instruction": demonstrations.instruction,
        }
        if settings.inner_steps is None:
            training = adapt_policy(
                policy,
                sampler,
                text,
                steps=settings.steps,
                batch=settings.batch,
                learning_rates={part: getattr(settings, f"lr_{part}") for part in LEARNING_RATES},
                seed=settings.seed,
            )
        else:
            training = evaluate.take_inner_steps(
                policy,
                sampler,
                text,
                steps=settings.inner_steps,
                batch=settings.batch,
                lr=evaluate.rate_of_checkpoint(info, text.device, settings.inner_lr),
                seed=evaluate.inner_seed(settings.seed, demonstrations.task),
            )
        seconds = 0.0
        began = time.monotonic()
        with common.progress_bar(
            desc=f"adapting to {demonstrations.task}", unit="step", total=settings.steps
        ) as bar:
            for step, loss, adapted in training:
                seconds += time.monotonic() - began
                bar.set_postfix(loss=f"{loss:.4f}")
                bar.update()
                append_json(folder / "metrics.jsonl", step=step, loss=loss)
                if step in self.curve:
                    model.save(self.checkpoint_after(step), adapted, **checkpoint_info)
                began = time.monotonic()
        model.save(folder / "adapted.pt", adapted, **checkpoint_info)

        if heldout is not None:
            after = log_heldout_error(
                folder, settings.steps, adapted, sampler, heldout_sampler, text
            )
            table = report.action_error_table(
                {
                    "the mean action": before.of_mean_action,
                    "step 0": before.of_policy,
                    f"step {settings.steps}": after.of_policy,
                },
                sampler.action_names,
            )
            print(table, flush=True)
            write_text(folder / "held-out.md", f"{table}\n\n{report.HELDOUT_NOTE}\n")
        description = {**self.describe(), "seconds": seconds}
        write_text(folder / "config.json", json.dumps(description, indent=1))
        return seconds

    def roll_out(
        self, task: str, text: Tensor, simulator: Simulator, pool: WorkerPool
    ) -> dict[str, Outcomes]:
        """Rolls out the policy before and after `run`, and in between: column -> outcomes."""
        columns = {"before": self.checkpoint}
        for step in sorted(set(self.curve)):
            columns[f"{step} steps"] = self.checkpoint_after(step)
        columns["after"] = self.folder / "adapted.pt"
        taken = len(load_demonstrations(self.recording).take(self.settings.demonstrations))
        return {
            column: evaluate.evaluate_checkpoint(
                checkpoint=policy,
                simulator=simulator,
                recordings={task: self.recording},
                text={task: text},
                episodes=self.settings.episodes,
                seed=self.settings.seed,
                device=text.device,
                n_demonstrations=taken - self.settings.held_out,
                config_overrides=self.config_overrides,
                description=f"evaluating {column}",
                pool=pool,
            )
            for column, policy in columns.items()
        }


def read_instructions(
    paths: dict[str, Path], settings: Settings, config: PolicyConfig
) -> dict[str, str]:
    """Task -> instruction, of recordings (task -> file).

    Raises RecordingError for a recording of fewer demonstrations than the settings ask for, or one
    that does not fit a policy of this configuration.
    """
    instructions = {}
    for task, path in paths.items():
        demonstrations = load_demonstrations(path).take(settings.demonstrations)
        hold_out(demonstrations, settings.held_out)  # only to check that there are enough
        WindowSampler(demonstrations, config)  # only to check that they fit
        instructions[task] = demonstrations.instruction
    return instructions


# ---- Command line --------------------------------------------------------------------------------


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Adapts a policy to one task (Algorithm 2).")
    group = parser.add_argument_group("run")
    add = group.add_argument
    add("--task", nargs="+", help="tasks of the suite's simulator, or `novel`: all its novel ones")
    add("--suite", help="of the run to start from, and of the tasks (default: the run's, or ml10)")
    add("--data", default="data", help="folder of the demonstrations, or one file (default: data)")
    add("--checkpoint", help="file or run folder to start from (default: the newest run's last)")
    add("--curve", nargs="+", type=int, default=[], help="roll out after these steps, too")
    add("--out", help="folder of the adapted policy (default: runs/finetune/TASK-seedSEED)")
    add("--overwrite", action="store_true", help="replace what is in that folder")
    add("--resume", action="store_true", help="go on there, with the tasks not measured yet")
    evaluate.add_inference_flags(group)
    common.add_common_flags(group)
    rates = ", ".join(f"{part} {rate:g}" for part, rate in LEARNING_RATES.items())
    group = parser.add_argument_group(
        "settings", f"Learning rates at a meta-training rate of {PAPER_LEARNING_RATE:g}: {rates}."
    )
    common.add_settings(group, Settings)
    return parser.parse_args(argv)


def check_flags(args: argparse.Namespace, settings: Settings) -> None:
    """Raises UserError for what can be refused before any file is read."""
    if args.task is None and not args.data.endswith(".npz"):
        raise UserError("name a task of a simulator with --task, or a recording with --data")
    if args.suite is not None:
        common.choose(args.suite, SIMULATORS, "suite")
    if settings.inner_steps is None and settings.inner_lr is not None:
        raise UserError("--inner-lr is the learning rate of --inner-steps: give both")
    if settings.inner_steps is not None:
        if args.n_action_steps is not None:
            raise UserError(
                "--n-action-steps also changes the windows that --inner-steps learn from: "
                "leave out one"
            )
        of_algorithm_2 = ("steps", "curve", "lr_vision", "lr_diffusion", "lr_other")
        given = [name for name in of_algorithm_2 if getattr(args, name) not in (None, [])]
        if args.normalizer == "fit":
            given.append("normalizer")
        if given:
            flags = ", ".join(common.flag_name(name) for name in given)
            raise UserError(f"--inner-steps takes the place of Algorithm 2: leave out {flags}")
    if not all(0 < step < settings.steps for step in args.curve):
        raise UserError(f"--curve: use steps from 1 to {settings.steps - 1}, those before --steps")


def choose_checkpoint(args: argparse.Namespace, simulated: bool) -> Path:
    """The policy to start from: --checkpoint, or that of the newest run on the suite."""
    if args.checkpoint is not None:
        return evaluate.checkpoints_of(args.checkpoint)[-1]
    return evaluate.default_checkpoint(args.suite or ("ml10" if simulated else "own"))


def choose_tasks(names: Sequence[str], simulator: Simulator, suite: str) -> list[str]:
    """The tasks of a simulator that --task names."""
    if list(names) == ["novel"]:
        _, novel = simulator.tasks(suite)
        if not novel:
            raise UserError(f"--task novel: {suite} has no novel tasks")
        return novel
    return [check_task(simulator, name) for name in dict.fromkeys(names)]  # each once


def check_recording(
    recording: Demonstrations, file: Path, names: Sequence[str] | None, simulator: Simulator | None
) -> None:
    """Raises UserError for a recording of another task than --task says (`names`).

    Of a simulator's recording it also checks that it was made by the simulator's present recipe.
    """
    if names is not None and list(names) != [recording.task]:
        raise UserError(f"{file} is a recording of {recording.task}, not of {' '.join(names)}")
    if simulator is not None:
        made_in = recording.meta["simulator"]
        if made_in != simulator.name:
            raise UserError(f"{file} was made in {made_in}: name the --suite of its task")
        check_recipe(recording, file, simulator.recipe)
        check_task(simulator, recording.task)


def claim_folders(folders: Iterable[Path], checkpoint: Path, overwrite: bool) -> list[Path]:
    """Makes the folders, and returns the old results in them, see `evaluate.claim_results`.

    Raises UserError if `checkpoint` is one of them.
    """
    old_files = []
    for folder in folders:
        old_files += evaluate.claim_results(folder, overwrite)
    if checkpoint.resolve() in [file.resolve() for file in old_files]:
        raise UserError(f"{checkpoint} itself would be overwritten: choose another --out")
    return old_files


def read_measured(
    adaptations: dict[str, Adaptation],
) -> dict[str, tuple[dict[str, Outcomes], float]]:
    """What an interrupted run has measured: task -> (column -> outcomes, seconds of adapting).

    Raises UserError for a task that was adapted to or rolled out in another way than `adaptations`
    (task -> how) say.
    """
    measured = {}
    for task, adaptation in adaptations.items():
        folder = adaptation.folder
        if not (folder / "config.json").is_file():  # it is written when the adaptation is finished
            if (folder / "success.json").is_file():  # which is written after it
                raise UserError(f"{folder} holds other results: choose another --out")
            continue
        try:
            config = json.loads((folder / "config.json").read_text())
            seconds = config["seconds"]
        except (ValueError, TypeError, KeyError):  # not of finetune.py
            raise UserError(f"{folder} holds other results: choose another --out") from None
        expected = adaptation.describe()
        different = [name for name, value in expected.items() if config.get(name) != value]
        if different:
            raise UserError(
                f"{folder} was made with another {', '.join(different)}: give the same as then, or "
                "--overwrite it without --resume"
            )
        if (folder / "success.json").is_file():
            measured[task] = (report.read_outcomes(folder), seconds)
        elif adaptation.settings.episodes == 0 and (folder / "adapted.pt").is_file():
            measured[task] = ({}, seconds)
    return measured


def adapt_tasks(
    adaptations: dict[str, Adaptation],
    text: dict[str, Tensor],
    *,
    simulator: Simulator | None,
    workers: int | None,
    provenance: dict[str, Any],
    measured: dict[str, tuple[dict[str, Outcomes], float]],
) -> tuple[dict[str, Outcomes], float]:
    """Adapts a policy to each task separately; rolls it out before, in between and after.

    What is measured of a task is written into its folder at once.

    Args:
        adaptations, text: task -> how, and its instruction feature (text_dim,).
        simulator: to roll out in; None: there is none.
        workers: processes for the rollouts; None: one a core.
        provenance: what stands beside the results.
        measured: tasks that need no adaptation any more, see `read_measured`.

    Returns:
        Column ("before", "50 steps" ..., "after") -> how the episodes went, no columns without
        rollouts; and the seconds that adapting took, for all tasks together.
    """
    results: dict[str, Outcomes] = {}  # column -> those of all tasks
    total_seconds = 0.0
    with WorkerPool(workers) as pool:
        for task, adaptation in adaptations.items():
            folder = adaptation.folder
            if task in measured:
                of_task, seconds = measured[task]
                print(f"{task} was measured before: {folder}", flush=True)
            else:
                seconds = adaptation.run(text[task])
                written = folder / "adapted.pt"
                print(f"adapted to {task} in {seconds:.1f} s; wrote {written}", flush=True)
                of_task = {}
                if simulator is not None and adaptation.settings.episodes > 0:
                    of_task = adaptation.roll_out(task, text[task], simulator, pool)
                    report.write_report(folder, of_task, {**provenance, "title": task})
            total_seconds += seconds
            for column, outcomes in of_task.items():
                earlier = results.get(column, Outcomes({}, {}))
                results[column] = earlier.joined(outcomes)
    return results, total_seconds


def main(argv: Sequence[str] | None = None) -> None:
    args = parse(argv)
    settings = common.with_flags(Settings(), args)
    check_flags(args, settings)
    common.check_workers(args.workers)
    device = common.pick_device(args.device, args.threads)

    # A recording in a file, one's own or a simulator's; or tasks of a simulator to collect
    file = Path(args.data) if args.data.endswith(".npz") else None
    recording = None if file is None else load_demonstrations(file)
    if recording is not None:
        for suspicion in suspicions(recording):
            print(f"{file}: {suspicion}", flush=True)
    simulated = recording is None or made_by_simulator(recording)

    # The policy to start from
    checkpoint = choose_checkpoint(args, simulated)
    config_overrides = evaluate.inference_overrides(args)
    policy, info = evaluate.load_trained(checkpoint, **config_overrides)
    settings = resolve(settings, info)
    where = f"{device} ({common.hardware(device)})"
    print(f"{checkpoint}: preset {info['preset']}, step {info['step']}, on {where}", flush=True)

    # The tasks, and the simulator to roll them out in
    suite = args.suite or info["suite"]
    if simulated and suite == "own":
        raise UserError(f"{checkpoint} was trained on own recordings: name the task's --suite")
    simulator = simulator_of(suite) if simulated else None
    if recording is None:
        tasks = choose_tasks(args.task, simulator, suite)
        paths = {task: Path(args.data) / f"{task}.npz" for task in tasks}
        if settings.demonstrations is None:  # of a file all are used
            settings = replace(settings, demonstrations=simulator.demonstrations)
    else:
        check_recording(recording, file, args.task, simulator)
        tasks = [recording.task]
        paths = {recording.task: file}

    # One task writes into `out` itself; of several, each writes into a folder of its own in it
    name = "novel" if args.task == ["novel"] else "-".join(tasks)
    out = Path(args.out or f"runs/finetune/{name}-seed{settings.seed}")
    several = len(tasks) > 1 or args.task == ["novel"]
    if args.resume and not several:
        raise UserError("--resume goes on with several tasks: adapt to this one with --overwrite")
    folders = {task: out / task if several else out for task in tasks}

    with common.locked(out):
        if args.resume and (out / "adapted.pt").exists():
            raise UserError(f"{out} holds the policy of one task: choose another --out")
        if args.resume and (out / "config.json").exists():
            raise UserError(f"{out} holds other results: choose another --out")
        finished = all((folder / "config.json").exists() for folder in folders.values())
        if args.resume and (out / "success.json").exists() and not finished:
            raise UserError(f"{out} holds other results: choose another --out")
        adaptations = {
            task: Adaptation(
                checkpoint=checkpoint,
                recording=paths[task],
                folder=folders[task],
                settings=settings,
                curve=args.curve,
                config_overrides=config_overrides,
            )
            for task in tasks
        }
        measured = read_measured(adaptations) if args.resume else {}
        unfinished = [folder for task, folder in folders.items() if task not in measured]
        old_files = claim_folders({out, *unfinished}, checkpoint, args.overwrite or args.resume)
        if recording is None:
            n = settings.demonstrations
            collect(simulator, tasks, args.data, episodes=n, workers=args.workers)
        instructions = read_instructions(paths, settings, policy.config)
        text, text_weights = evaluate.instruction_features(
            instructions,
            weights=args.clip_weights,
            identity=info["text_weights"],
            device=device,
            use_instruction=settings.instruction,
        )
        for old_file in old_files:  # nothing more can be refused
            old_file.unlink()

        usual = {name: x for name, x in asdict(Settings()).items() if x is not None}
        common.print_settings(used=asdict(settings), default=usual)
        provenance = {
            "title": f"{name}: before and after {settings.steps} steps",
            "checkpoint": str(checkpoint),
            "text weights": text_weights,
            "steps": settings.steps,
            "demonstrations": settings.demonstrations,
            "episodes": settings.episodes,
            "seed": settings.seed,
            "instruction": settings.instruction,
            **common.provenance("finetune.py", argv, device),
            **config_overrides,
        }
        try:
            results, seconds = adapt_tasks(
                adaptations,
                text,
                simulator=simulator,
                workers=args.workers,
                provenance=provenance,
                measured=measured,
            )
        except KeyboardInterrupt:
            advice = "add --resume to go on with the tasks that are left" if several else ""
            raise KeyboardInterrupt(advice) from None
        if not results:
            return
        table = report.write_report(
            out,
            results,
            {**provenance, "seconds a task": round(seconds / len(tasks), 1)},
            parts=evaluate.group_tasks(tasks, simulator, suite),
            paper=report.paper_columns(suite, [policy.config.policy]),
        )
        print(f"\n{table}")


if __name__ == "__main__":
    common.command_line(main, errors=(RecordingError, CheckpointError, TextWeightsError))
