"""What is made of results: success rates with their intervals, tables, charts, reports.

85.0 [64.0, 94.8]     17 of 20 episodes, in percent, and Wilson's 95 % interval
82.2 ± 1.9 (3 runs)   the mean of runs of several seeds, and Student's 95 % interval
"""

import json
import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from data import write_atomically
from scripts import format_table, write_text
from simulator import SUITES, suite_tasks

PAPER_RESULTS = Path(__file__).parent / "assets" / "paper_results.json"

Successes = dict[str, list[bool]]  # task -> one entry an episode


# ---- Numbers -------------------------------------------------------------------------------------


def wilson_interval(successes: int, episodes: int) -> tuple[float, float]:
    """Returns Wilson's 95 % interval of a success rate, as two fractions."""
    from scipy.stats import binomtest  # comes with metaworld; takes a second to import

    interval = binomtest(successes, episodes).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


def format_success(successes: int, episodes: int) -> str:
    """`17 of 20` -> `85.0 [64.0, 94.8]`: percent, with the 95 % Wilson interval."""
    low, high = wilson_interval(successes, episodes)
    return f"{100 * successes / episodes:.1f} [{100 * low:.1f}, {100 * high:.1f}]"


def pooled_success(results: Successes) -> str:
    """The episodes of all tasks together, as `format_success` writes them."""
    episodes = [success for task in results.values() for success in task]
    return format_success(sum(episodes), len(episodes))


def mean_success(results: Successes) -> float:
    """The mean over tasks of the success rate, in percent."""
    return 100 * float(np.mean([np.mean(episodes) for episodes in results.values()]))


def mean_interval(values: Sequence[float]) -> str:
    """Mean over runs with Student's 95 % interval, in the unit of the values."""
    if len(values) == 1:
        return f"{values[0]:.1f} (one run)"
    from scipy.stats import t

    margin = t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / math.sqrt(len(values))
    return f"{np.mean(values):.1f} ± {margin:.1f} ({len(values)} runs)"


# ---- Tables and charts ---------------------------------------------------------------------------


def paper_success(suite: str | None, task: str) -> float | None:
    """The paper's success rate of DAMI on a task in percent, if it reports one."""
    tables = json.loads(PAPER_RESULTS.read_text())
    for split in ("base", "novel"):
        if task in tables.get(suite or "", {}).get(split, {}):
            return tables[suite][split][task]["DAMI"]
    return None


def parts_of(tasks: Sequence[str], suite: str | None) -> dict[str, list[str]]:
    """What to call the mean, and of which tasks; base and novel ones of a suite are told apart."""
    split = zip(("base", "novel"), suite_tasks(suite) if suite in SUITES else ((), ()))
    parts = {f"mean of {part}": [t for t in tasks if t in known] for part, known in split}
    whole = all(parts.values()) and sum(map(len, parts.values())) == len(tasks)
    return parts if whole else {"mean": list(tasks)}


def success_table(columns: dict[str, Successes], suite: str | None = None) -> str:
    """A Markdown table: a row a task, a column for each set of results, the paper's; the means."""

    def row(name: str, tasks: Sequence[str]) -> list[str]:
        cells = [pooled_success({t: results[t] for t in tasks}) for results in columns.values()]
        known = [paper_success(suite, task) for task in tasks]
        return [name, *cells, "" if None in known else f"{np.mean(known):.1f}"]

    tasks = list(next(iter(columns.values())))
    rows = [["task", *columns, "paper"], *(row(task, [task]) for task in tasks)]
    if len(tasks) > 1:
        rows += [row(f"**{name}**", part) for name, part in parts_of(tasks, suite).items()]
    return format_table(rows)


def draw_success(
    columns: dict[str, Successes], path: Path, title: str, suite: str | None = None
) -> None:
    """A bar chart of success with Wilson intervals, a group a task, the paper's beside them."""
    from matplotlib.figure import Figure

    tasks = list(next(iter(columns.values())))
    groups = len(columns) + 1
    figure = Figure(figsize=(max(4.5, 2 + 0.9 * len(tasks)), 3.6), layout="constrained")
    axes = figure.subplots()
    x, width = np.arange(len(tasks)), 0.8 / groups

    for i, (label, results) in enumerate(columns.items()):
        rates = np.array([np.mean(results[task]) for task in tasks])
        bounds = [wilson_interval(sum(results[task]), len(results[task])) for task in tasks]
        errors = 100 * np.abs(np.array(bounds).T - rates)  # (2, tasks)
        style = {"capsize": 2, "error_kw": {"linewidth": 0.8}}
        axes.bar(x + i * width, 100 * rates, width, yerr=errors, label=label, **style)

    paper = [paper_success(suite, task) for task in tasks]
    if any(value is not None for value in paper):
        heights = [value or 0 for value in paper]
        axes.bar(x + len(columns) * width, heights, width, color="0.8", label="paper (on a GPU)")

    axes.set_xticks(x + width * (groups - 1) / 2, tasks, rotation=30, ha="right")
    axes.set(ylabel="success, %", ylim=(0, 105), title=title)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(frameon=False, ncols=groups, loc="outside upper center", fontsize=8)
    write_atomically(path, lambda temporary: figure.savefig(temporary, dpi=120, format="png"))


def draw_curves(folder: Path) -> None:
    """Draws curves.png of a run: the loss, its running mean, and success where measured."""
    from matplotlib.figure import Figure

    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    steps = np.array([line["step"] for line in lines if "loss" in line])
    losses = np.array([line["loss"] for line in lines if "loss" in line])
    of = {"success": "mean success on base tasks, %", "action_error": "held-out action error"}
    measured = {name: [(line["step"], line[name]) for line in lines if name in line] for name in of}
    name = "success" if measured["success"] else "action_error"

    figure = Figure(figsize=(7, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.plot(steps, losses, color="C0", alpha=0.3, linewidth=0.8, label="training loss")
    width = max(1, len(losses) // 50)
    mean = np.convolve(losses, np.ones(width) / width, mode="valid")
    axes.plot(steps[width - 1 :], mean, color="C0", label=f"mean of {width} steps")
    axes.set(xlabel="outer step", ylabel="loss (actions in [-1, 1])", yscale="log")
    axes.spines["top"].set_visible(False)
    handles, labels = axes.get_legend_handles_labels()
    if measured[name]:
        right = axes.twinx()
        (line,) = right.plot(*zip(*measured[name]), "o-", color="C1")
        right.set(ylabel=of[name], ylim=(0, 100 if name == "success" else None))
        right.spines["top"].set_visible(False)
        handles, labels = [*handles, line], [*labels, f"{name.replace('_', ' ')} (right)"]
    axes.legend(handles, labels, frameon=False)

    path = folder / "curves.png"
    write_atomically(path, lambda temporary: figure.savefig(temporary, dpi=120, format="png"))


# ---- Reports -------------------------------------------------------------------------------------


def write_report(
    folder: Path,
    columns: dict[str, Successes],
    facts: dict[str, Any],
    suite: str | None = None,
    checkpoints: dict[str, Successes] | None = None,
) -> str:
    """Writes success.json (every episode, how it was measured), .md, .png; returns the table.

    `checkpoints`: what else was measured and is only kept in success.json.
    """
    table = success_table(columns, suite)
    note = ", ".join(f"{name} {value}" for name, value in facts.items())
    report = {"facts": facts, "successes": columns}
    if checkpoints:
        report["checkpoints"] = checkpoints
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "success.json", json.dumps(report, indent=1))
    text = f"{table}\n\nPercent of episodes, 95 % Wilson interval. {note}.\n"
    write_text(folder / "success.md", text)
    draw_success(columns, folder / "success.png", facts.get("title", "Success"), suite)
    return table


def report_training(
    folder: Path,
    arguments: Any,
    policy: str,
    seconds: float,
    facts: dict[str, Any],
    successes: Successes | None,
) -> None:
    """What stands at the end of a training: curves, success or held-out errors, what is next."""
    draw_curves(folder)
    if successes:
        facts = facts | {"title": f"{arguments.suite}, base tasks, {arguments.preset}, {policy}"}
        facts |= {"episodes a task": arguments.episodes}
        facts |= {"training": f"{seconds / 60:.1f} min", "training seed": arguments.seed}
        columns = {"last checkpoint": successes}
        print(f"\n{write_report(folder, columns, facts, arguments.suite)}")
    if (judged := folder / "held-out.md").exists():
        print(f"\n{judged.read_text().rstrip()}")
    files = ", ".join(sorted(path.name for path in folder.iterdir()))
    suite = arguments.suite
    new = "--data NEW.npz" if suite == "own" else f"--task novel --suite {suite}"
    print(f"\n{folder} is finished: {files}")
    print(f"next: python finetune.py {new} --checkpoint {shlex.quote(str(folder))}")
