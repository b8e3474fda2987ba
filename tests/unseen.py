"""How far drawn actions are from an expert's on goals that no training saw: a row a checkpoint.

    python simulator.py --suite ml10 --seed 7 --data data-unseen
    python -m tests.unseen runs/ml10-neither-seed0    # all checkpoints of a folder, or files

The error is `evaluate.action_error`, the mean over the base tasks of ML10.
"""

import argparse
from itertools import chain
from pathlib import Path

import numpy as np

import common
import evaluate
from clip import TextWeightsError
from data import RecordingError, WindowSampler, load_demonstrations
from model import CheckpointError
from simulator import simulator_of

SUITE = "ml10"


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Action errors on goals that no training saw.")
    parser.add_argument("checkpoints", nargs="+", help=".pt files, or folders of train.py")
    parser.add_argument("--data", default="data", help="folder of the reference demonstrations")
    parser.add_argument("--unseen", default="data-unseen", help="folder of those to judge by")
    parser.add_argument("--threads", type=int, help="of PyTorch")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    args = parse(argv)
    common.pick_device("cpu", args.threads)
    tasks, _ = simulator_of(SUITE).tasks(SUITE)
    seen = {task: load_demonstrations(Path(args.data) / f"{task}.npz") for task in tasks}
    unseen = {task: load_demonstrations(Path(args.unseen) / f"{task}.npz") for task in tasks}
    instructions = {task: recorded.instruction for task, recorded in seen.items()}

    texts = {}  # identity of text weights -> task -> feature
    rows = [["checkpoint", "action error", "of the mean action"]]
    for path in chain.from_iterable(evaluate.checkpoints_of(path) for path in args.checkpoints):
        policy, info = evaluate.load_trained(path)
        identity = info["text_weights"]
        if identity not in texts:
            texts[identity], _ = evaluate.instruction_features(instructions, None, identity, "cpu")
        errors = evaluate.evaluate_heldout(
            policy,
            {task: WindowSampler(seen[task], policy.config) for task in tasks},
            {task: WindowSampler(unseen[task], policy.config) for task in tasks},
            texts[identity],
        )
        of_policy = np.mean([error.of_policy for error in errors.values()])
        of_mean_action = np.mean([error.of_mean_action for error in errors.values()])
        rows.append([str(path), f"{of_policy:.4f}", f"{of_mean_action:.4f}"])
    print(common.format_table(rows))


if __name__ == "__main__":
    common.command_line(main, errors=(RecordingError, CheckpointError, TextWeightsError))
