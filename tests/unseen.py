"""How far drawn actions are from an expert's on goals that no training saw: a row a checkpoint.

    python simulator.py --suite ml10 --seed 7 --data data-unseen
    python -m tests.unseen runs/ml10-neither-seed0    # all checkpoints of a folder, or files

The error is `evaluate.action_error`, the mean over the base tasks of ML10.
"""

import argparse
from functools import cache
from itertools import chain
from pathlib import Path

import numpy as np
import torch

import scripts
from data import load_demonstrations
from evaluate import TRAINED, action_error
from scripts import checkpoints_of, command_line, load_checkpoint
from simulator import suite_tasks


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Action errors on goals that no training saw.")
    parser.add_argument("checkpoints", nargs="+", help=".pt files, or folders of train.py")
    parser.add_argument("--data", default="data", help="folder of the reference demonstrations")
    parser.add_argument("--unseen", default="data-unseen", help="folder of those to judge by")
    parser.add_argument("--threads", type=int, help="of PyTorch")
    args = parser.parse_args(argv)
    scripts.pick_device("cpu", args.threads)
    tasks = suite_tasks("ml10")[0]
    seen, unseen = (
        {task: load_demonstrations(Path(folder) / f"{task}.npz") for task in tasks}
        for folder in (args.data, args.unseen)
    )

    @cache
    def features(identity: str) -> dict[str, torch.Tensor]:
        return scripts.instruction_features(seen, None, identity, "cpu")[0]

    rows = [["checkpoint", "action error", "of the mean action"]]
    for path in chain(*map(checkpoints_of, args.checkpoints)):
        policy, info = load_checkpoint(path, needs=TRAINED)
        shown, held = (scripts.windows(part, policy.config) for part in (seen, unseen))
        text = features(info["text_weights"])
        errors = [action_error(policy, shown[task], held[task], text[task]) for task in tasks]
        rows.append([str(path), *(f"{mean:.4f}" for mean in np.mean(errors, axis=0))])
    print(scripts.format_table(rows))


if __name__ == "__main__":
    command_line(main)
