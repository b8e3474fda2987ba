"""The runs behind RESULTS.md, as a queue: train, measure, report; survives a kill.

    python -m tests.runs --list              # what there is, and what is done
    python -m tests.runs --only dami neither # two at a time, one thread each
    python -m tests.runs                     # all of it
    python -m tests.runs --suite goals-reach --seeds 0 1 2 3 4   # where goals are hidden
    python -m tests.runs --suite pairs --seeds 0                 # where nothing names the task

A variant is a set of flags of train.py, a run is a variant and a seed. A run is trained, then
measured: base tasks as they are, novel tasks along their adaptation, and what swapping the
demonstration does. A job whose result exists is skipped, a training that was interrupted goes on.
`python -m tests.results` takes what is finished into RESULTS.json.
"""

import argparse
import re
import subprocess
import sys
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path

import train
from common import choose, command_line
from tests.oracle import WORLDS
from train import preset_settings
from unnamed_tasks import ANGLES, DIRECTIONS, SCENES, turned_task

NEITHER = "--demo-encoder none --maml off"  # multi-task training
METHOD = {  # a variant of the method -> its flags of train.py
    "dami": "",
    "no-inner-loop": "--maml off",
    "no-demonstration": "--demo-encoder none",
    "neither": NEITHER,
    "twice-as-long": f"{NEITHER} --steps 20000",  # twice the 10,000 of the older recipe
    "first-order": "--maml first",
    "first-order-3e-2": "--maml first --inner-lr 3e-2",
    "inner-3e-2": "--inner-lr 3e-2",
    "no-dropout": "--instruction-dropout 0",
    "more-dropout": "--instruction-dropout 0.5",
    "no-task-dropout": "--task-dropout 0",
    "mlp": "--demo-encoder mlp --maml off",
    "mid": "--tcfm mid --maml off",
    "up": "--tcfm up --maml off",
    "baseline": "--demo-encoder mlp --tcfm none --maml off",
    "vmt": "--tcfm none --maml off",
    "scratch": "--maml off --warmup 10000 --steps 1",  # at a rate of 1e-7: a policy of chance
    "dp3": "--policy dp3 --maml off",
    "flow": "--policy flow --maml off",
    "mamba": "--policy mamba --maml off",
    "freq": "--policy freq --maml off",
    "dp3-maml": "--policy dp3",
    "flow-maml": "--policy flow",
    "mamba-maml": "--policy mamba",
    "freq-maml": "--policy freq",
}
LIMITS = {  # what more or less of something would buy; measured on base tasks alone
    "30-demonstrations": f"{NEITHER} --demonstrations 30 --data data30",
    "100-demonstrations": f"{NEITHER} --demonstrations 100 --data data100",
    "points-64": f"{NEITHER} --num-points 64",
    "points-256": f"{NEITHER} --num-points 256",
    "unmoved": f"{NEITHER} --no-augment",
    "positions": f"{NEITHER} --data data-positions",
    "pixels": f"{NEITHER} --data data-pixels",
}
SHORT = f"{NEITHER} --steps 4000"
TUNING = {  # two fifths of the older recipe's steps, or as many windows; measured as LIMITS are
    "4000-steps": SHORT,
    "lr-5e-4": f"{SHORT} --lr 5e-4",
    "lr-2e-3": f"{SHORT} --lr 2e-3",
    "batch-8": f"{SHORT} --support 2 --query 6 --steps 8000",
    "batch-32": f"{SHORT} --support 8 --query 24 --steps 2000",
    "not-augmented": f"{SHORT} --no-augment",
    "augmented-twice": SHORT,  # in a world of tests.oracle, as are "not-averaged", "positions" ...
    "not-averaged": SHORT,
}
VARIANTS = {**METHOD, **LIMITS, **TUNING}

SEED = 1  # of the evaluation's goals; since 2026-11-27 no choice was made on them
EPISODES = 20  # of a task
AGAIN = "-goals2"  # the same report on as many other goals


@dataclass(frozen=True)
class Report:
    """A measurement of a run."""

    command: str  # {run} is the run's folder. A --seed or --episodes in it wins over the plan's
    variants: Sequence[str]  # that it measures


EVERY = tuple(METHOD)
READS = ("dami", "no-inner-loop")  # a demonstration, and so can be measured without the instruction
DECIDE = (*READS, "no-demonstration", "neither")
SHOWN = (*READS, "neither", "scratch")
LONGER = ("neither", "twice-as-long")
WITHOUT = "evaluate.py --checkpoint {run} --without instruction"
REPORTS = {
    "base": Report("evaluate.py --checkpoint {run}", EVERY),
    "novel": Report("finetune.py --task novel --checkpoint {run}", EVERY),
    "told": Report("evaluate.py --checkpoint {run} --swap demonstration instruction", READS),
    "swap": Report(f"{WITHOUT} --swap demonstration", READS),
    "one-shot": Report(f"{WITHOUT} --split novel", READS),
    "top": Report("evaluate.py --checkpoint {run} --top 5", ("neither",)),
    "alone": Report("finetune.py --task novel --checkpoint {run} --no-instruction", READS),
    f"base{AGAIN}": Report("evaluate.py --checkpoint {run} --seed 2", DECIDE),
    f"novel{AGAIN}": Report("finetune.py --task novel --checkpoint {run} --seed 2", DECIDE),
    "limits": Report("evaluate.py --checkpoint {run} --seed 10", (*LONGER, *LIMITS, *TUNING)),
}
CURVE = {  # along the adaptation, and with fewer demonstrations; flags of finetune.py
    "curve": "--curve 1 5 20 50",
    "long": "--steps 1000 --curve 500",
    "1-shot": "--demonstrations 1",
    "3-shot": "--demonstrations 3",
    "5-shot": "--demonstrations 5",
}
for name, flags in CURVE.items():
    REPORTS[name] = Report(f"finetune.py --task novel --checkpoint {{run}} {flags}", SHOWN)

# Where goals are hidden. Some variants read a demonstration; those that read none have the same
# batches, and some of them take inner steps. "neither-as-long", which was not measured so far, is
# multi-task training for about as many minutes as "inner" takes on reach.
NO_DEMONSTRATION = "--demo-encoder none --tasks-per-step 12 --support 8 --query 4 --lr 1e-3"
LEARNED_RATES = f"{NO_DEMONSTRATION} --vectorize 12 --learn-inner-lr --inner-lr 3e-2"
INNER = f"{LEARNED_RATES} --pretrain-fraction 0.2"
HIDDEN_METHOD = {
    "demonstration": "--maml off",
    "demonstration-twice-the-rate": "--maml off --lr 1e-3",
    "demonstration-twice-as-long": "--maml off --steps 6000",  # of push and pick-place
    "neither": f"{NO_DEMONSTRATION} --maml off",
    "neither-as-long": f"{NO_DEMONSTRATION} --maml off --steps 6500",
    "inner": INNER,
    "inner-first-order": f"{INNER} --maml first",
    "both": "",
    # In worlds of tests.oracle. "frozen": after the 1,500 steps of "neither" only rates of the
    # inner step are learned. "marker": the cloud shows the goal.
    "frozen": f"{LEARNED_RATES} --pretrain-fraction 0.75 --steps 2000",
    "marker": "--maml off --demo-encoder none --data data-marker",
    # Fewer or more goals than the 160 of "demonstration", and as many windows a step, 80
    "demonstration-5-goals": "--maml off --base-tasks 5 --tasks-per-step 5 --support 8 --query 8",
    "demonstration-20-goals": (
        "--maml off --base-tasks 20 --tasks-per-step 20 --support 2 --query 2"
    ),
    "demonstration-40-goals": "--maml off --base-tasks 40",
    "demonstration-80-goals": "--maml off --base-tasks 80",
    "demonstration-320-goals": "--maml off --base-tasks 320",
}
NUMBERS_OF_GOALS = tuple(f"demonstration-{n}-goals" for n in (5, 20, 40, 80, 320))
ADAPTED = ("inner", "inner-first-order", "frozen")
MULTI_TASK = ("neither", "neither-as-long")
LONGEST = "demonstration-twice-as-long"
READERS = ("demonstration", "demonstration-twice-the-rate")
# Multi-task training has no rate of an inner step. For each number of steps it gets the one that
# was best on the goals of validation, of 0.01, 0.03, 0.1, 0.3 and 1:
# python evaluate.py --suite goals-reach-validation --split novel --checkpoint
# runs/goals-reach-neither-seed0 --episodes 3 --seed 2 --inner-steps 1 --inner-lr 0.03
MULTI_TASK_RATES = {1: 0.03, 5: 0.01, 20: 0.3}
INNER_STEPS = (1, 5, 20)  # that are measured


def hidden_reports() -> dict[str, Report]:
    """The same as REPORTS, where goals are hidden."""
    novel = "evaluate.py --split novel --checkpoint {run}"
    reports = {
        "novel": Report(
            f"{novel} --swap demonstration --controls zeros", (*READERS, LONGEST, "both")
        ),
        # All goals share their starts, and five are few where some of them are hard.
        "starts": Report(f"{novel} --episodes 20", (*READERS, LONGEST)),
        "parts": Report(f"{novel} --controls last-frame no-actions shuffled", READERS),
        "0-steps": Report(novel, (*ADAPTED, *MULTI_TASK, *NUMBERS_OF_GOALS, "marker")),
        "1-steps-swap": Report(f"{novel} --inner-steps 1 --swap demonstration", ("inner",)),
        "1-steps-of-1": Report(f"{novel} --inner-steps 1 --demonstrations 1", ("inner",)),
        "1-steps-of-2": Report(f"{novel} --inner-steps 1 --demonstrations 2", ("inner",)),
    }
    for steps in INNER_STEPS:
        adapted = f"{novel} --inner-steps {steps}"
        at_best_rate = f"{adapted} --inner-lr {MULTI_TASK_RATES[steps]}"
        reports[f"{steps}-steps"] = Report(adapted, (*ADAPTED, "both"))
        reports[f"{steps}-steps-best-rate"] = Report(at_best_rate, MULTI_TASK)
    # As finetune.py adapts where nothing is said. On the goals of validation 200 such steps, after
    # multi-task training, ended 21 of 30 episodes at the goal; steps at three times the rates 20,
    # and with the normalizer of training 22 (--episodes 3 --seed 2, training seed 0).
    by_adamw = "finetune.py --task novel --checkpoint {run} --curve 1 5 20"
    arms = (*READERS, "both", "inner", "inner-first-order", *MULTI_TASK)
    reports["adamw"] = Report(by_adamw, arms)  # the last, since it takes longest
    return reports


HIDDEN_REPORTS = hidden_reports()

# Where no observation names the task (unnamed_tasks.py), these are the arms. Pairs are measured on
# the tasks that they were trained on, in new episodes; turned actions on new angles.
UNNAMED_METHOD = {
    "demonstration": "--maml off --lr 5e-4 --support 2 --query 6 --steps 3000",
    "neither": f"{NO_DEMONSTRATION} --maml off --steps 1500",
    "inner": f"{INNER} --steps 1500",
}


# As MULTI_TASK_RATES, of the same five, on the angles of convention-reach-validation
TURNED_MULTI_TASK_RATES = {1: 0.01, 5: 0.03}


def angles_apart(skill: str) -> list[str]:
    """The tasks of the eight new angles, in a circle in which the next is 135 degrees further."""
    angles = ANGLES["novel"]
    return [turned_task(skill, angles[3 * i % len(angles)]) for i in range(len(angles))]


def unnamed_reports(suite: str) -> dict[str, Report]:
    """The same as REPORTS, for "pairs" and for "convention-SKILL".

    `--swap demonstration` shows each task that is named the demonstration of the next one, and the
    last that of the first. So the tasks are named in groups: the two of a scene, or all angles.
    """
    if suite == "pairs":
        evaluation = "evaluate.py --checkpoint {run}"
        groups = {
            scene: [f"{scene}-{direction}-hidden" for direction in DIRECTIONS] for scene in SCENES
        }
    else:
        evaluation = "evaluate.py --split novel --checkpoint {run}"
        groups = {"angles": angles_apart(suite.removeprefix("convention-"))}
    reports = {}
    for group, tasks in groups.items():
        named = f"evaluate.py --task {' '.join(tasks)} --checkpoint {{run}}"
        swapped = f"{named} --swap demonstration --controls zeros no-actions"
        reports[group] = Report(swapped, ("demonstration",))
    for steps in (0, 1, 5):
        reports[f"{steps}-steps"] = Report(f"{evaluation} --inner-steps {steps}", ("inner",))
    reports["multi-task"] = Report(evaluation, ("neither",))
    if suite == "convention-reach":
        for steps, rate in TURNED_MULTI_TASK_RATES.items():
            adapted = f"{evaluation} --inner-steps {steps} --inner-lr {rate}"
            reports[f"{steps}-steps-best-rate"] = Report(adapted, ("neither",))
    return reports


HIDDEN_SUITES = ("goals-reach", "goals-push", "goals-pick-place")
UNNAMED_SUITES = ("pairs", "convention-reach", "convention-push")
UNNAMED_REPORTS = {suite: unnamed_reports(suite) for suite in UNNAMED_SUITES}


@dataclass(frozen=True)
class Plan:
    """What is trained on a suite, and how it is measured."""

    variants: dict[str, str]  # name -> flags of train.py
    reports: dict[str, Report]
    episodes: int  # of a task


def plan_of(suite: str) -> Plan:
    """The plan of a suite: that of hidden goals, of tasks without a name, or of ML10 and ML45."""
    choose(suite, ("ml10", "ml45", *HIDDEN_SUITES, *UNNAMED_SUITES), "suite")
    if suite in HIDDEN_SUITES:
        variants = dict(HIDDEN_METHOD)
        if suite == "goals-reach":
            del variants[LONGEST]  # there it would be four times as long
        return Plan(variants, HIDDEN_REPORTS, episodes=5)
    if suite in UNNAMED_SUITES:
        return Plan(UNNAMED_METHOD, UNNAMED_REPORTS[suite], episodes=20)
    return Plan(VARIANTS, REPORTS, episodes=EPISODES)


running: set[subprocess.Popen] = set()  # the processes of this queue


@dataclass(frozen=True)
class Job:
    """A command whose result is a file."""

    command: str
    result: Path
    log: Path
    measures: Path | None = None  # the checkpoint, if the job is a report

    def is_done(self) -> bool:
        """Whether its result exists, and is not of an earlier training."""
        if not self.result.exists():
            return False
        if self.measures is None:  # a training
            return True
        if not self.measures.exists():  # a report of a training that is gone
            return False
        return self.measures.stat().st_mtime <= self.result.stat().st_mtime

    def run(self) -> int:
        """Runs it in a process; returns the exit code."""
        self.log.parent.mkdir(parents=True, exist_ok=True)
        with self.log.open("a") as log:
            print(f"$ python {self.command}", file=log, flush=True)
            words = [sys.executable, *self.command.split()]
            # In a session of its own: Ctrl-C reaches it once, by `terminate`.
            process = subprocess.Popen(words, stdout=log, stderr=log, start_new_session=True)
            running.add(process)
            code = process.wait()
            running.discard(process)
            return code


def steps_of(suite: str, flags: str) -> int:
    """How many outer steps a training with these flags takes."""
    return train.parse(flags.split()).steps or preset_settings("small", suite).steps


def jobs_of_run(
    variant: str, seed: int, *, suite: str, flags: str, episodes: int, only: Sequence[str] | None
) -> list[Job]:
    """The jobs of a run in their order: its training, then the reports that measure it.

    `flags` are those of the training, beside the variant's. `only` names the reports to make; None:
    all of the plan.
    """
    plan = plan_of(suite)
    flags = f"{plan.variants[variant]} {flags}"
    run = Path(f"runs/{suite}-{variant}-seed{seed}")
    log = run.with_suffix(".log")

    # In another world reports, too, read the recordings that were made in it.
    world, data = "", ""
    if variant in WORLDS:
        world = f"-m tests.oracle {variant} "
        data = "".join(re.findall(r" --data \S+", flags))

    resume = " --resume" if (run / "last.pt").exists() else ""
    steps = steps_of(suite, flags)
    training = (
        f"{world}train.py --suite {suite} --preset small --seed {seed} --episodes 0 "
        f"--out {run} --threads 1 --clip-weights random {flags}{resume}"
    )
    checkpoint = run / f"ema-{steps:05d}.pt"
    jobs = [Job(training, result=checkpoint, log=log)]
    for name, report in plan.reports.items():
        if variant not in report.variants or (only and name not in only):
            continue
        out = Path(f"{run}-{name}")
        script, report_flags = report.command.format(run=run).split(" ", 1)
        command = (
            f"{world}{script} --episodes {episodes} --seed {SEED} {report_flags}{data} "
            f"--workers 1 --threads 1 --out {out} --overwrite"
        )
        jobs.append(Job(command, result=out / "success.json", log=log, measures=checkpoint))
    return jobs


def run_in_order(jobs: Sequence[Job], stopped: threading.Event) -> int:
    """Runs the jobs of a run one after the other, until `stopped` is set; returns how many failed.

    Those that are done are skipped. If the training fails, there is nothing to measure.
    """
    failed = 0
    for job in jobs:
        if job.is_done() or stopped.is_set():
            continue
        code = job.run()
        outcome = "done" if code == 0 else f"exit code {code}"
        print(f"{outcome}: {job.command}", flush=True)
        if code != 0:
            failed += 1
            if job.measures is None:
                break
    return failed


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Trains and measures what RESULTS.md shows.")
    parser.add_argument("--only", nargs="+", help="these variants (all)")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="of training")
    parser.add_argument("--suite", default="ml10", help="such as ml10 or goals-reach (ml10)")
    parser.add_argument("--flags", default="", help="more flags of each training")
    parser.add_argument("--episodes", type=int, help="a task (20; where goals are hidden 5)")
    parser.add_argument("--reports", nargs="+", help="these reports, such as base novel (all)")
    parser.add_argument("--at-once", type=int, default=2, help="runs at a time")
    parser.add_argument("--list", action="store_true", help="only say what is done")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    args = parse(argv)

    plan = plan_of(args.suite)
    variants = args.only or list(plan.variants)
    for variant in variants:
        choose(variant, plan.variants, "variant")
    for report in args.reports or ():
        choose(report, plan.reports, "report")

    episodes = args.episodes or plan.episodes
    runs = [
        jobs_of_run(
            variant, seed, suite=args.suite, flags=args.flags, episodes=episodes, only=args.reports
        )
        for seed in args.seeds
        for variant in variants
    ]
    if args.list:
        for job in chain.from_iterable(runs):
            print(f"{'done' if job.is_done() else '    '}  python {job.command}")
        return
    stopped = threading.Event()
    with ThreadPoolExecutor(args.at_once) as pool:
        try:
            failed = sum(pool.map(partial(run_in_order, stopped=stopped), runs))
        except BaseException:  # Ctrl-C and `kill`, too
            stopped.set()
            for process in list(running):
                process.terminate()  # a training saves, and ends
            raise
    if failed:
        sys.exit(1)


if __name__ == "__main__":
    command_line(main)
