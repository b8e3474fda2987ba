"""What needs no network where goals are hidden, and so says what a success of a policy is worth.

    python -m tests.controls --suite goals-reach --out runs/goals-reach-controls

`replay` takes the demonstration's actions one by one. `servo` moves the hand to where it was at the
demonstration's end, with the fingers as they were there. `expert` is Meta-World's script, which is
told the goal. Demonstrations are as many as in `evaluate.py --split novel`, and starts are the
same; the demonstration of each episode is drawn anew.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from common import command_line, locked, provenance, report_progress, run_jobs
from data import RecordingError, load_demonstrations
from evaluate import claim_results
from report import Outcomes, write_report
from simulator import Simulator, collect, environments_of, evaluation_seed, simulator_of
from tests.runs import SEED

CONTROLS = ("replay", "servo", "expert")
STIFFNESS = 5.0  # of the servo: an action of 1 for 20 centimetres, as Meta-World's script for reach


def control_job(
    simulator: Simulator, task: str, recording: Path, seeds: Sequence[int]
) -> dict[str, list[list[bool]]]:
    """Control -> for each episode whether each of its steps was a success."""
    demonstrations = load_demonstrations(recording)
    (env,) = environments_of(simulator, task, 1, simulator.recipe["num_points"])
    successes: dict[str, list[list[bool]]] = {control: [] for control in CONTROLS}
    for seed in seeds:
        index = np.random.default_rng(seed).integers(len(demonstrations))
        frames = demonstrations.episode(index)
        actions = demonstrations.action[frames]  # (T, 4)
        target = demonstrations.state[frames.stop - 1, :3]  # of the hand
        for control, of_episodes in successes.items():
            env.begin(seed)
            steps = []
            for step in range(simulator.episode_steps):
                if control == "replay":
                    action = actions[min(step, len(actions) - 1)]
                elif control == "servo":
                    displacement = STIFFNESS * (target - env.hand())
                    action = np.append(np.clip(displacement, -1, 1), actions[-1, 3])
                else:
                    action = env.expert_action()
                _, _, info = env.advance(action)
                steps.append(info["success"])
            of_episodes.append(steps)
            report_progress(task, 1)
    return successes


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Measures what needs no network.")
    parser.add_argument("--suite", default="goals-reach", help="of hidden goals (goals-reach)")
    parser.add_argument("--data", default="data", help="folder of the demonstrations (data)")
    parser.add_argument("--episodes", type=int, default=5, help="episodes a task (5)")
    parser.add_argument("--seed", type=int, default=SEED, help=f"of the starts ({SEED})")
    parser.add_argument("--workers", type=int, help="processes (one a core)")
    parser.add_argument("--out", help="folder of the report (runs/SUITE-controls)")
    parser.add_argument("--overwrite", action="store_true", help="replace the report in it")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    args = parse(argv)

    simulator = simulator_of(args.suite)
    _, tasks = simulator.tasks(args.suite)
    out = Path(args.out or f"runs/{args.suite}-controls")
    with locked(out):
        claim_results(out, args.overwrite)  # the new report takes the place of the old one
        recordings = collect(
            simulator, tasks, args.data, episodes=simulator.demonstrations, workers=args.workers
        )
        seeds = [evaluation_seed(args.seed, i) for i in range(args.episodes)]
        jobs: list[dict[str, Any]] = [
            {"simulator": simulator, "task": task, "recording": recording, "seeds": seeds}
            for task, recording in recordings.items()
        ]
        results = run_jobs(
            control_job,
            jobs,
            workers=args.workers,
            total=len(jobs) * len(seeds) * len(CONTROLS),
            description="controls",
        )
        outcomes = {
            control: Outcomes(
                any_step={
                    task: [any(steps) for steps in successes[control]]
                    for task, successes in zip(tasks, results)
                },
                at_end={
                    task: [steps[-1] for steps in successes[control]]
                    for task, successes in zip(tasks, results)
                },
            )
            for control in CONTROLS
        }
        arguments = sys.argv[1:] if argv is None else argv
        report = {
            "title": "no network",
            "episodes a task": args.episodes,
            "seed": args.seed,
            **provenance("-m", ["tests.controls", *arguments], "cpu"),
        }
        print(write_report(out, outcomes, report, pooled=True))


if __name__ == "__main__":
    command_line(main, errors=(RecordingError,))
