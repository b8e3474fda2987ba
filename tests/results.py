"""RESULTS.json, and what README and RESULTS.md show of it: tables, a learning curve, a chart.

    python -m tests.results runs/seeds         # takes a report of evaluate.py into RESULTS.json
    python -m tests.results                    # writes the tables, draws the pictures
    python -m tests.results --ship CHECKPOINT  # makes it assets/ml10-small.pt, weights as float16

RESULTS.json keeps for each report every episode (1: success, 0: not), the command that measured it,
hardware, seed and date; and for each training run that a report names its settings, command and
time.
"""

import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from data import write_atomically
from evaluate import (
    SHIPPED_CHECKPOINT,
    TRAINED,
    Successes,
    format_success,
    mean_interval,
    mean_success,
    paper_success,
)
from scripts import load_checkpoint, save_checkpoint
from simulator import suite_tasks

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "RESULTS.json"
BASE, NOVEL = suite_tasks("ml10")
SEEDS = ["seeds", "seed2"]  # the reports that hold the three seeds
CHECKPOINTS = ["top5-0", "top5-1", "top5-2"]  # those of every checkpoint of each seed
BASE_COLUMNS = {"small, 3 seeds": SEEDS, "the one in `assets/`": ["shipped"]}
NOVEL_COLUMNS = {
    "small, 3 seeds": SEEDS,
    "with 1000 steps": ["long-0", "long-1", "long-2"],
    "the one in `assets/`": ["shipped"],
}
ABLATIONS = [  # what is different in it, reports
    ("DAMI", SEEDS),
    (
        "no MAML at all (`--maml off`)",
        ["eval-multi-task", "eval-multi-task-seed1", "eval-multi-task-seed2"],
    ),
    ("DAMI", ["eval-short-dami"]),
    ("an inner rate 30 times as large (`--inner-lr 3e-3`)", ["eval-short-inner"]),
    ("first order instead of second (`--maml first`)", ["eval-short-first-order"]),
    ("an MLP instead of VMT (`--demo-encoder mlp`)", ["eval-short-mlp"]),
    ("TCFM in the middle of the U-Net (`--tcfm mid`)", ["eval-short-mid"]),
    ("TCFM in the last up-sampling level (`--tcfm up`)", ["eval-short-up"]),
    ("DP3 + MAML (`--demo-encoder none --tcfm none`)", ["eval-short-dp3-maml"]),
    ("multi-task DP3 (the same with `--maml off`)", ["eval-short-dp3"]),
]


def take(results: dict, folder: Path) -> None:
    """Adds the report in a folder of evaluate.py, and the training runs beside it, to `results`."""
    report = json.loads((folder / "success.json").read_text())
    for kind in ("successes", "checkpoints"):
        for label, successes in report.get(kind, {}).items():
            report[kind][label] = {
                task: "".join(str(int(s)) for s in episodes) for task, episodes in successes.items()
            }
    results["evaluations"][folder.name] = report
    for run in {label.split("/")[0] for label in report["successes"]} - {"assets"}:
        path = folder.parent / run
        lines = [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]
        minutes = [line["seconds"] for line in lines if "loss" in line][-1] / 60
        results["trainings"][run] = {
            "minutes": round(minutes, 1),
            **json.loads((path / "config.json").read_text()),
        }


def successes(
    results: dict, reports: Sequence[str], kind: str = "successes"
) -> dict[str, Successes]:
    """Label -> task -> episodes of reports: of the last checkpoints, or of all (kind
    `checkpoints`).
    """
    return {
        label: {task: [c == "1" for c in episodes] for task, episodes in tasks.items()}
        for report in reports
        for label, tasks in results["evaluations"][report][kind].items()
    }


def curves(results: dict, reports: Sequence[str], tasks: list[str]) -> dict[str, dict[int, float]]:
    """Run -> step -> mean success over tasks, for each of its checkpoints."""
    found: dict[str, dict[int, float]] = {}
    for label, measured in successes(results, reports, "checkpoints").items():
        run, checkpoint = label.split("/")
        found.setdefault(run, {})[int(checkpoint.removeprefix("ema-"))] = mean_success(
            only(measured, tasks)
        )
    return found


def only(results: Successes, tasks: list[str]) -> Successes:
    return {task: results[task] for task in tasks}


def pooled(results: Successes, tasks: list[str]) -> str:
    """The episodes of several tasks together, with Wilson's interval."""
    episodes = [success for task in tasks for success in results[task]]
    return format_success(sum(episodes), len(episodes))


def mean_of_runs(runs: list[Successes], tasks: list[str]) -> str:
    """Student's interval over several runs; Wilson's over the episodes of one."""
    if len(runs) == 1:
        return pooled(runs[0], tasks)
    return mean_interval([mean_success(only(run, tasks)) for run in runs])


def seeds_table(
    results: dict, tasks: list[str], columns: dict[str, list[str]], checkpoints: Sequence[str] = ()
) -> str:
    """A row a task: the seeds' episodes together, a column for some reports; then the means over
    seeds.

    With the reports of every checkpoint also the paper's number: the mean of the five best
    checkpoints of each run.
    """
    lines = [
        f"| task | {' | '.join(columns)} | paper, DP3 | paper, DAMI |",
        "|---" * (len(columns) + 3) + "|",
    ]
    runs = {title: list(successes(results, reports).values()) for title, reports in columns.items()}
    paper = json.loads((ROOT / "assets" / "paper_results.json").read_text())["ml10"]
    dp3 = {task: (paper["base"] | paper["novel"])[task]["DP3"] for task in tasks}
    for task in tasks:
        cells = [
            pooled({task: [s for run in seeds for s in run[task]]}, [task])
            for seeds in runs.values()
        ]
        lines.append(
            f"| {task} | {' | '.join(cells)} | {dp3[task]:.1f} | {paper_success('ml10', task):.1f} "
            "|"
        )
    means = [mean_of_runs(seeds, tasks) for seeds in runs.values()]
    ours = np.mean([paper_success("ml10", task) for task in tasks])
    of_paper = f"{np.mean(list(dp3.values())):.1f} | {ours:.1f} |"
    lines.append(f"| **mean** | {' | '.join(means)} | {of_paper}")
    if checkpoints:
        best = [
            float(np.mean(sorted(curve.values())[-5:]))
            for curve in curves(results, checkpoints, tasks).values()
        ]
        lines.append(
            f"| mean, best 5 checkpoints | {mean_interval(best)}{' |' * len(columns)} {of_paper}"
        )
    return "\n".join(lines)


def ablation_table(results: dict) -> str:
    """A row a variant: what is different in it, and its means over the base and over the novel
    tasks.
    """
    lines = ["| outer steps | variant | base | novel |", "|---|---|---|---|"]
    for title, reports in ABLATIONS:
        measured = successes(results, reports)
        (steps,) = {
            results["trainings"][label.split("/")[0]]["arguments"]["steps"] for label in measured
        }
        cells = [mean_of_runs(list(measured.values()), tasks) for tasks in (BASE, NOVEL)]
        lines.append(f"| {steps} | {title} | {' | '.join(cells)} |")
    return "\n".join(lines)


def means_table(results: dict) -> str:
    """The two means, ours and the paper's."""
    paper = json.loads((ROOT / "assets" / "paper_results.json").read_text())["ml10"]
    rows = {
        "base tasks": (BASE, SEEDS, "base"),
        "novel tasks": (NOVEL, SEEDS, "novel"),
        "novel tasks, 1000 steps": (NOVEL, NOVEL_COLUMNS["with 1000 steps"], "novel"),
    }
    lines = ["| ML10 | `small` | paper, DP3 | paper, DAMI |", "|---|---|---|---|"]
    for title, (tasks, reports, split) in rows.items():
        ours = mean_of_runs(list(successes(results, reports).values()), tasks)
        theirs = [np.mean([paper[split][task][row] for task in tasks]) for row in ("DP3", "DAMI")]
        lines.append(f"| {title} | {ours} | {theirs[0]:.1f} | {theirs[1]:.1f} |")
    return "\n".join(lines)


TABLES = {
    "means": means_table,
    "base": lambda results: seeds_table(results, BASE, BASE_COLUMNS, CHECKPOINTS),
    "novel": lambda results: seeds_table(results, NOVEL, NOVEL_COLUMNS),
    "ablations": ablation_table,
}


def fill(text: str, results: dict) -> str:
    """README or RESULTS.md with each table between its two comments as RESULTS.json has it."""
    for name, table in TABLES.items():
        pattern = rf"(<!-- results: {name} -->\n).*?(<!-- end -->)"
        if found := re.search(pattern, text, flags=re.S):
            text = text.replace(found[0], f"{found[1]}{table(results)}\n{found[2]}")
    return text


def draw(results: dict) -> None:
    """assets/learning-curve.png and assets/success.png."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
    for run, curve in curves(results, CHECKPOINTS, BASE).items():
        arguments = results["trainings"][run]["arguments"]
        axes.plot(
            *zip(*sorted(curve.items())),
            "o-",
            markersize=3,
            linewidth=1,
            label=f"seed {arguments['seed']}",
        )
    axes.axvline(
        arguments["steps"] * arguments["multi_task_share"],
        color="0.7",
        linestyle=":",
        label="MAML begins",
    )
    axes.set(xlabel="outer step", ylabel="mean success on base tasks, %", ylim=(0, 100))
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8)
    write_atomically(
        ROOT / "assets" / "learning-curve.png",
        lambda path: figure.savefig(path, dpi=110, format="png"),
    )
    plt.close(figure)

    figure, axes = plt.subplots(figsize=(9, 3.4), layout="constrained")
    tasks = BASE + NOVEL
    runs = list(successes(results, SEEDS).values())
    rates = np.array(
        [[100 * np.mean(run[task]) for task in tasks] for run in runs]
    )  # (seeds, tasks)
    x = np.arange(len(tasks)) + 0.5 * (np.arange(len(tasks)) >= len(BASE))
    axes.bar(x - 0.2, rates.mean(0), 0.4, color="C0", label=f"small, mean of {len(runs)} seeds")
    axes.plot(
        np.tile(x - 0.2, len(runs)), rates.ravel(), ".", color="k", markersize=4, label="each seed"
    )
    axes.bar(
        x + 0.2,
        [paper_success("ml10", task) for task in tasks],
        0.4,
        color="0.75",
        label="paper (on a GPU)",
    )
    axes.set_xticks(x, tasks, rotation=35, ha="right")
    axes.set(ylabel="success, %", ylim=(0, 105))
    axes.set_title("base tasks directly, novel tasks (right) after 200 steps", fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(frameon=False, ncols=3, loc="outside upper center", fontsize=8)
    write_atomically(
        ROOT / "assets" / "success.png", lambda path: figure.savefig(path, dpi=110, format="png")
    )
    plt.close(figure)


def ship(checkpoint: str) -> None:
    """Writes assets/ml10-small.pt: a checkpoint of train.py, its weights as float16."""
    policy, info = load_checkpoint(checkpoint)
    kept = {name: info[name] for name in TRAINED}
    save_checkpoint(SHIPPED_CHECKPOINT, policy, half=True, **kept)


def main(folders: list[str]) -> None:
    if folders[:1] == ["--ship"]:
        return ship(folders[1])
    empty = {"trainings": {}, "evaluations": {}}
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else empty
    for folder in folders:
        take(results, Path(folder))
    if folders:
        text = json.dumps(results, indent=1) + "\n"
        write_atomically(RESULTS, lambda path: path.write_text(text))
        return
    for name in ("README.md", "RESULTS.md"):
        filled = fill((ROOT / name).read_text(), results)
        write_atomically(ROOT / name, lambda path, filled=filled: path.write_text(filled))
    draw(results)


if __name__ == "__main__":
    main(sys.argv[1:])
