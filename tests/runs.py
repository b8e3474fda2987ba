"""The runs behind RESULTS.md, as a queue: train, measure, report; survives a kill.

    python -m tests.runs --list              # what there is, and what is done
    python -m tests.runs --only dami neither # two at a time, one thread each
    python -m tests.runs                     # all of it

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
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from common import choose, command_line
from tests.oracle import WORLDS

VARIANTS = {
    "dami": "",
    "no-inner-loop": "--maml off",
    "no-demonstration": "--demo-encoder none",
    "neither": "--demo-encoder none --maml off",
    "twice-as-long": "--demo-encoder none --maml off --steps 20000",
    "first-order": "--maml first",
    "first-order-3e-2": "--maml first --inner-lr 3e-2",
    "inner-3e-2": "--inner-lr 3e-2",
    "no-dropout": "--instruction-dropout 0",
    "more-dropout": "--instruction-dropout 0.5",
    "no-support-only": "--support-only 0",
    "mlp": "--demo-encoder mlp --maml off",
    "mid": "--tcfm mid --maml off",
    "up": "--tcfm up --maml off",
    "baseline": "--demo-encoder mlp --tcfm none --maml off",
    "vmt": "--tcfm none --maml off",
    "scratch": "--maml off --warmup 10000 --steps 1",  # at a rate of 1e-7: a policy of chance
}
VARIANTS |= {policy: f"--policy {policy} --maml off" for policy in ("dp3", "flow", "mamba", "freq")}
VARIANTS |= {f"{policy}-maml": f"--policy {policy}" for policy in ("dp3", "flow", "mamba", "freq")}
LIMITS = {  # what more or less of something would buy; measured on base tasks alone
    "30-demonstrations": "--demonstrations 30 --data data30",
    "100-demonstrations": "--demonstrations 100 --data data100",
    "points-64": "--num-points 64",
    "points-256": "--num-points 256",
    "unmoved": "--no-augment",
    "positions": "--data data-positions",
    "pixels": "--data data-pixels",
}
SHORT = f"{VARIANTS['neither']} --steps 4000"
TUNING = {  # two fifths of the steps, or as many windows; measured as LIMITS are
    "4000-steps": "",
    "lr-5e-4": "--lr 5e-4",
    "lr-2e-3": "--lr 2e-3",
    "batch-8": "--support 2 --query 6 --steps 8000",
    "batch-32": "--support 8 --query 24 --steps 2000",
    "not-augmented": "--no-augment",
    "augmented-twice": "",
    "not-averaged": "",
}
VARIANTS |= {name: f"{VARIANTS['neither']} {flags}" for name, flags in LIMITS.items()}
VARIANTS |= {name: f"{SHORT} {flags}" for name, flags in TUNING.items()}

SEED = 1  # of the evaluation's goals: that of no training, and of no choice that was made
EPISODES = 50
READS = ("dami", "no-inner-loop")  # a demonstration: may go without the instruction
LONGER = ("neither", "twice-as-long")
DECIDE = (*READS, "no-demonstration", "neither")
SHOWN = (*READS, "neither", "scratch")
REPORTED = [name for name in VARIANTS if name not in LIMITS | TUNING]
REPORTS = {  # name -> command, of which variants, (): of REPORTED; {run} is the run's folder
    "base": ("evaluate.py --checkpoint {run}", ()),
    "novel": ("finetune.py --task novel --checkpoint {run}", ()),
    "told": ("evaluate.py --checkpoint {run} --swap demonstration instruction", READS),
    "swap": ("evaluate.py --checkpoint {run} --without instruction --swap demonstration", READS),
    "one-shot": ("evaluate.py --checkpoint {run} --split novel --without instruction", READS),
    "top": ("evaluate.py --checkpoint {run} --top 5 --episodes 20", ("neither",)),
    "alone": ("finetune.py --task novel --checkpoint {run} --no-instruction", READS),
}
AGAIN = "-goals2"  # the same report on 50 other goals
REPORTS |= {name + AGAIN: (f"{REPORTS[name][0]} --seed 2", DECIDE) for name in ("base", "novel")}
REPORTS["limits"] = (f"{REPORTS['base'][0]} --seed 10", (*LONGER, *LIMITS, *TUNING))
# Along the adaptation, and with fewer demonstrations: 20 episodes.
CURVE = {"curve": "--curve 1 5 20 50", "long": "--steps 1000 --curve 500"}
CURVE |= {f"{n}-shot": f"--demonstrations {n}" for n in (1, 3, 5)}
for name, flags in CURVE.items():
    REPORTS[name] = (f"finetune.py --task novel --checkpoint {{run}} --episodes 20 {flags}", SHOWN)


@dataclass(frozen=True)
class Job:
    """A command whose result is a file."""

    command: str
    done: Path
    log: Path

    def run(self) -> int:
        """Runs it in a process; returns the exit code."""
        self.log.parent.mkdir(parents=True, exist_ok=True)
        with self.log.open("a") as log:
            print(f"$ python {self.command}", file=log, flush=True)
            words = [sys.executable, *self.command.split()]
            return subprocess.run(words, stdout=log, stderr=log).returncode


def jobs(variant: str, seed: int, suite: str, steps: int, episodes: int) -> list[Job]:
    """Training first, then what measures it."""
    run, flags = Path(f"runs/{suite}-{variant}-seed{seed}"), VARIANTS[variant]
    world, data = "", ""
    if variant in WORLDS:
        world = f"-m tests.oracle {variant} "
        data = "".join(re.findall(r" --data \S+", flags))

    resume = " --resume" if (run / "last.pt").exists() else ""
    steps = int(re.findall(r"--steps (\d+)", f"--steps {steps} {flags}")[-1])
    trained = f"{world}train.py --suite {suite} --preset small --seed {seed} --episodes 0"
    trained += f" --out {run} --threads 1 --steps {steps} --clip-weights random {flags}{resume}"
    listed = [Job(trained, run / f"ema-{steps:05d}.pt", run.with_suffix(".log"))]
    for name, (command, variants) in REPORTS.items():
        if variant in (variants or REPORTED):
            out = Path(f"{run}-{name}")
            script, words = command.format(run=run).split(" ", 1)
            measured = f"{world}{script} --episodes {episodes} --seed {SEED} {words}{data}"
            measured += f" --workers 1 --threads 1 --out {out} --overwrite"
            listed.append(Job(measured, out / "success.json", run.with_suffix(".log")))
    return listed


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Trains and measures what RESULTS.md shows.")
    parser.add_argument("--only", nargs="+", default=list(VARIANTS), help="these variants")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="of training")
    parser.add_argument("--suite", default="ml10", help="ml10 or ml45")
    parser.add_argument("--steps", type=int, default=10_000, help="of each training")
    parser.add_argument("--episodes", type=int, default=EPISODES, help="a task")
    parser.add_argument("--at-once", type=int, default=2, help="runs at a time")
    parser.add_argument("--list", action="store_true", help="only say what is done")
    args = parser.parse_args(argv)
    chains = [
        jobs(choose(variant, VARIANTS, "variant"), seed, args.suite, args.steps, args.episodes)
        for seed in args.seeds
        for variant in args.only
    ]
    stopped = threading.Event()

    def work(chain: list[Job]) -> None:
        for job in chain:
            if job.done.exists() or stopped.is_set():
                continue
            code = job.run()
            print(f"{'done' if code == 0 else f'exit code {code}'}: {job.command}", flush=True)
            if code != 0:
                return  # what comes after needs it

    if args.list:
        for job in (job for chain in chains for job in chain):
            print(f"{'done' if job.done.exists() else '    '}  python {job.command}")
        return
    with ThreadPoolExecutor(args.at_once) as pool:
        try:
            list(pool.map(work, chains))
        finally:
            stopped.set()


if __name__ == "__main__":
    command_line(main)
