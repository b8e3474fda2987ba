"""RESULTS.json, and what README and RESULTS.md show of it: tables and charts.

    python -m tests.results runs/ml10-dami-seed0   # takes a run of tests.runs into RESULTS.json
    python -m tests.results                        # writes the tables, draws the charts
    python -m tests.results --compare ml10-dami ml10-neither    # episodes won and lost, sign test
    python -m tests.results --ship CHECKPOINT      # makes it assets/ml10-small.pt, float16

RESULTS.json holds for each run how it was trained and, for each report that measured it, every
episode (1: success, 0: not) with the command, hardware, seed and date.
"""

import json
import re
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

from data import write_atomically
from evaluate import SHIPPED_CHECKPOINT, TRAINED
from model import PRESETS
from report import (
    Successes,
    draw_success,
    format_success,
    mean_interval,
    mean_success,
    pooled_success,
    wilson_interval,
)
from common import format_table
from simulator import simulator_of
from tests.runs import AGAIN, REPORTS

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "RESULTS.json"
PAPER = json.loads((ROOT / "assets" / "paper_results.json").read_text())
TASKS = {
    suite: dict(zip(("base", "novel"), simulator_of(suite).tasks(suite)))
    for suite in ("ml10", "ml45")
}
DIFFICULTY = {  # as DP3 groups Meta-World's tasks, after Seo et al. (2022); the others are easy
    "medium": "basketball bin-picking box-close coffee-pull coffee-push hammer peg-insert-side "
    "push-wall soccer sweep sweep-into",
    "hard": "assembly hand-insert pick-out-of-hole pick-place push push-back",
    "very hard": "disassemble pick-place-wall shelf-place stick-pull stick-push",
}
VARIANTS = {  # a run's name without its seed -> what it is
    "ml10-dami": "DAMI",
    "ml10-first-order": "DAMI, first order",
    "ml10-first-order-3e-2": "DAMI, first order, with an inner rate of 3e-2",
    "ml10-dami-cpu": "DAMI, trained on the CPU",
    "ml10-no-inner-loop": "without the inner loop",
    "ml10-no-inner-loop-cpu": "without the inner loop, trained on the CPU",
    "ml10-mlp": "without the inner loop, an MLP for VMT",
    "ml10-no-demonstration": "without a demonstration",
    "ml10-neither": "without both: multi-task training",
    "ml10-30-demonstrations": "multi-task training, thirty demonstrations",
    "ml10-scratch": "from random weights",
    "ml10-scratch-eight": "eight actions of ten steps: from random weights",
    "ml10-dami-eight": "eight actions of ten steps: DAMI",
    "ml10-inner-3e-2": "eight actions of ten steps: DAMI with an inner rate of 3e-2",
    "ml10-no-inner-loop-eight": "eight actions of ten steps: without the inner loop",
    "ml10-neither-eight": "eight actions of ten steps: multi-task training",
    "ml45-no-inner-loop": "ML45, without the inner loop",
    "before": "until 2026-11-23: the instruction always told, inner rate 1e-4, DDIM, eight of ten",
    "before-no-inner-loop": "until 2026-11-23, without the inner loop",
}
SWAPPED = {  # a run -> its panel in the swap chart
    "before-seed0": "until 2026-11-23",
    "ml10-dami-seed0": "DAMI, seed 0",
    "ml10-no-inner-loop-cpu-seed0": "what ships",
}
POLICIES = {  # of baselines.py -> what the paper calls it
    "dp3": "DP3",
    "flow": "FlowPolicy",
    "mamba": "Mamba",
    "freq": "FreqPolicy",
}
ABLATION = {  # a row of the paper's ablation -> our variant, and what it is
    "baseline": ("baseline", "an MLP for VMT, no TCFM: the paper's Baseline"),
    "+vmt": ("vmt", "VMT, no TCFM"),
    "+tcfm-down": ("no-inner-loop-cpu", "VMT, TCFM in the first down-sampling level"),
    "+tcfm-mid": ("mid", "VMT, TCFM in the middle"),
    "+tcfm-up": ("up", "VMT, TCFM in the last up-sampling level"),
}
LIMITS = {  # what multi-task training may lack -> what it is given
    "neither": "`small` as it is: 10 demonstrations, 128 points, 84 x 84 rays, 10 000 steps",
    "twice-as-long": "20 000 steps",
    "30-demonstrations": "30 demonstrations",
    "100-demonstrations": "100 demonstrations",
    "points-64": "64 points",
    "points-256": "256 points",
    "pixels": "168 x 168 rays",
    "positions": "the true positions of object and goal, in the state",
    "unmoved": "scenes as they are (`--no-augment`)",
}
TUNING = {  # a short multi-task training -> what it is
    "4000-steps": "`small` as it is, but 4000 steps of 16 windows a task",
    "lr-5e-4": "half the learning rate (5e-4)",
    "lr-2e-3": "twice the learning rate (2e-3)",
    "batch-8": "8000 steps of 8 windows",
    "batch-32": "2000 steps of 32 windows",
    "not-augmented": "scenes as they are (`--no-augment`)",
    "augmented-twice": "scenes turned and stretched twice as much",
    "not-averaged": "the last weights, not their moving average",
}
SHOWN = {  # a suite -> the columns of its tables: a variant, and what it is called there
    "ml10": {
        "ml10-dami": "DAMI",
        "ml10-no-inner-loop": "no inner loop",
        "ml10-no-demonstration": "no demonstration",
        "ml10-neither": "multi-task",
    },
    "ml45": {
        "ml45-dami": "DAMI",
        "ml45-no-inner-loop": "no inner loop",
        "ml45-no-demonstration": "no demonstration",
        "ml45-neither": "multi-task",
        "ml45-dp3": "DP3",
    },
}
REPORT = {"base": ("base", 0), "novel": ("novel", "after")}  # what measures the tasks of a split


def take(results: dict, run: Path) -> None:
    """Adds a run's training and the reports beside its folder to `results`."""
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    minutes = [line["seconds"] for line in lines if "loss" in line][-1] / 60
    config = json.loads((run / "config.json").read_text())
    results[run.name] = {"training": {"minutes": round(minutes, 1), **config}}
    inner = [(line["loss_before"], line["loss"]) for line in lines if "loss_before" in line][-500:]
    if inner:  # the query losses of the last 500 outer steps
        before, after = np.mean(inner, axis=0).round(5).tolist()
        results[run.name]["training"]["inner_step"] = {"before": before, "after": after}
    for name in REPORTS:
        path = Path(f"{run}-{name}") / "success.json"
        if path.exists():
            report = json.loads(path.read_text())
            for part in [name for name in ("successes", "checkpoints") if name in report]:
                report[part] = {
                    column: {task: "".join(str(int(s)) for s in e) for task, e in tasks.items()}
                    for column, tasks in report[part].items()
                }
            results[run.name][name] = report


def runs_of(results: dict, variant: str) -> list[dict]:
    """The runs of a variant, one a seed."""
    return [run for name, run in sorted(results.items()) if name.rsplit("-seed")[0] == variant]


def measured(run: dict, report: str, column: int | str = 0) -> Successes | None:
    """The episodes in a column (its name, or its place) of a run's report, if there is one."""
    columns = run.get(report, {}).get("successes", {})
    if isinstance(column, int):
        column = list(columns)[column] if columns else ""
    if column not in columns:
        return None
    return {task: [c == "1" for c in episodes] for task, episodes in columns[column].items()}


def on_all_goals(run: dict, report: str, column: int | str = 0) -> Successes | None:
    """The same with the episodes of the report on other goals behind them, if there is one."""
    first, again = (measured(run, name, column) for name in (report, report + AGAIN))
    return {task: first[task] + again[task] for task in first} if first and again else first


def mean(results: dict, variant: str, report: str, column: int | str = 0) -> str:
    """The mean over tasks: Student's interval over several seeds, Wilson's over one's episodes."""
    found = [on_all_goals(run, report, column) for run in runs_of(results, variant)]
    found = [successes for successes in found if successes]
    if not found:
        return ""
    if len(found) > 1:
        return mean_interval([mean_success(successes) for successes in found])
    return f"{pooled_success(found[0])} (one run)"


def papers(suite: str, split: str, tasks: list[str]) -> list[str]:
    """The paper's success of DP3 and of DAMI, the mean over some tasks."""
    theirs = PAPER[suite][split]
    return [f"{np.mean([theirs[t][name] for t in tasks]):.1f}" for name in ("DP3", "DAMI")]


def head(suite: str, title: str) -> list[str]:
    """The first row of a table of a suite's variants."""
    return [title, *SHOWN[suite].values(), "paper, DP3", "paper, DAMI"]


def means_table(results: dict, suite: str = "ml10") -> str:
    """The means of DAMI, without its inner loop, of multi-task training, and the paper's."""
    tasks = TASKS[suite]
    rows = [
        ["base tasks", REPORT["base"], papers(suite, "base", tasks["base"])],
        ["novel tasks, no gradient step", ("novel", "before"), ["", ""]],
        ["novel tasks, 200 steps", REPORT["novel"], papers(suite, "novel", tasks["novel"])],
    ]
    shown = SHOWN[suite]
    rows = [[t, *(mean(results, v, *report) for v in shown), *theirs] for t, report, theirs in rows]
    return format_table([head(suite, suite.upper()), *rows])


def by_task_table(split: str, suite: str = "ml10") -> Callable[[dict], str]:
    """A row a task: each variant's seeds together, and the paper's."""

    def make(results: dict) -> str:
        rows, tasks, shown = [], TASKS[suite][split], SHOWN[suite]
        for task in tasks:
            cells = [pooled(results, variant, REPORT[split], [task]) for variant in shown]
            rows.append([task, *cells, *papers(suite, split, [task])])
        means = [mean(results, variant, *REPORT[split]) for variant in shown]
        rows.append(["**mean**", *means, *papers(suite, split, tasks)])
        return format_table([head(suite, "task"), *rows])

    return make


def together(
    results: dict, variant: str, report: tuple[str, int | str], tasks: list[str] | None = None
) -> list[bool]:
    """The episodes of some tasks, or all, and of all of a variant's seeds together."""
    found = [on_all_goals(run, *report) or {} for run in runs_of(results, variant)]
    return [
        s for successes in found for task in tasks or successes for s in successes.get(task, [])
    ]


def pooled(results: dict, variant: str, report: tuple[str, int | str], tasks: list[str]) -> str:
    """The share of successes in some tasks, of all of a variant's seeds together."""
    episodes = together(results, variant, report, tasks)
    return format_success(sum(episodes), len(episodes)) if episodes else ""


def difficulty_table(results: dict, suite: str = "ml10") -> str:
    """A row for the base tasks, and one for the novel tasks, of each difficulty."""
    rows, of = [], {task: name for name, tasks in DIFFICULTY.items() for task in tasks.split()}
    for split, report in REPORT.items():
        for difficulty in ("easy", *DIFFICULTY):
            tasks = [t for t in TASKS[suite][split] if of.get(t, "easy") == difficulty]
            if tasks:
                cells = [pooled(results, variant, report, tasks) for variant in SHOWN[suite]]
                title = f"{split}, {difficulty} ({len(tasks)})"
                rows.append([title, *cells, *papers(suite, split, tasks)])
    return format_table([head(suite, "tasks"), *rows])


def variants_table(results: dict) -> str:
    """What decides: a row a variant."""
    rows = []
    for variant, title in VARIANTS.items():
        columns = REPORT["base"], ("novel", "before"), REPORT["novel"]
        cells = [mean(results, variant, *column) for column in columns]
        if any(cells) and not variant.startswith("ml45"):  # it has a table of its own
            rows.append([title, *cells])
    return format_table([["ML10", "base", "novel, no gradient step", "novel, 200 steps"], *rows])


def policies_table(results: dict) -> str:
    """The paper's policies, without and with meta-training, beside what the paper has of them."""
    rows = [["ML10", *(f"{split}{how}" for split in REPORT for how in ("", " + MAML"))]]
    rows[0] += [f"paper, {split}, without / with" for split in REPORT]
    ours = {f"ml10-{key}": (f"ml10-{key}-maml", name) for key, name in POLICIES.items()}
    for plain, (meta, name) in ({"ml10-no-inner-loop": ("ml10-dami", "DAMI")} | ours).items():
        row = [mean(results, v, *column) for column in REPORT.values() for v in (plain, meta)]
        for split, tasks in TASKS["ml10"].items():
            theirs = f"{np.mean([PAPER['ml10'][split][t][name] for t in tasks]):.1f}"
            if name == "DAMI":
                row.append(f"- / {theirs}")
            else:
                maml = PAPER["ml10"]["base_maml_avg" if split == "base" else "novel_maml"][name]
                row.append(f"{theirs} / {np.mean(maml):.1f}")
        rows.append([name, *row])
    return format_table(rows)


def ablation_table(results: dict) -> str:
    """The rows of the paper's ablation, each with its mean there."""
    rows = [["ML10, without the inner loop", *REPORT, "paper, novel"]]
    for row, (variant, title) in ABLATION.items():
        cells = [mean(results, f"ml10-{variant}", *report) for report in REPORT.values()]
        rows.append([title, *cells, f"{np.mean(PAPER['ml10']['novel_ablation'][row]):.1f}"])
    return format_table(rows)


def length_table(results: dict) -> str:
    """A row a checkpoint of the run whose checkpoints were all measured."""
    rows = [["outer steps", "minutes", "base tasks"]]
    for run in results.values():
        for label, tasks in run.get("top", {}).get("checkpoints", {}).items():
            step, whole = int(label[-5:]), run["training"]["arguments"]["steps"]
            minutes, episodes = run["training"]["minutes"] * step / whole, "".join(tasks.values())
            success = format_success(episodes.count("1"), len(episodes))
            rows.append([str(step), f"{minutes:.0f}", success])
    return format_table(rows)


def pairs(one: Successes, other: Successes) -> list[tuple[bool, bool]]:
    """What two policies made of each episode."""
    return [pair for task in one for pair in zip(one[task], other[task])]


def limits_table(titles: dict[str, str], first: str) -> Callable[[dict], str]:
    """A row a variant of `titles`, seed 0 of each, beside the first: on goals of no result."""

    def make(results: dict) -> str:
        rows = [[first, "base tasks", "won, lost against the first"]]
        found = {v: measured(results.get(f"ml10-{v}-seed0", {}), "limits") for v in titles}
        plain = found[next(iter(titles))]
        for variant, successes in found.items():
            if successes:
                outcomes = pairs(successes, plain)
                counts = f"{outcomes.count((True, False))}, {outcomes.count((False, True))}"
                against = counts if successes is not plain else ""
                rows.append([titles[variant], pooled_success(successes), against])
        return format_table(rows)

    return make


def swaps(results: dict) -> dict[str, list[tuple[str, Successes]]]:
    """Policy -> what it is shown, and its episodes on the base tasks."""
    found = {}
    for name, title in SWAPPED.items():
        run = results.get(name, {})
        shown = [
            ("instruction, own demonstration", measured(run, "told", 0)),
            ("instruction, another's demonstration", measured(run, "told", 1)),
            ("another's instruction, own demonstration", measured(run, "told", 2)),
            ("own demonstration alone", measured(run, "swap", 0)),
            ("another's demonstration alone", measured(run, "swap", 1)),
        ]
        found[title] = [(label, successes) for label, successes in shown if successes]
    return found


def reading_table(results: dict) -> str:
    """A row a run that is told nothing: success with its own demonstration, with another task's."""
    rows = [["run", "own demonstration alone", "another's demonstration alone"]]
    for variant, title in VARIANTS.items():
        for run in runs_of(results, variant):
            if "swap" in run:
                cells = [pooled_success(measured(run, "swap", column)) for column in (0, 1)]
                rows.append([f"{title}, seed {run['training']['arguments']['seed']}", *cells])
    return format_table(rows)


def looks_table(results: dict) -> str:
    """A row a run that was also rolled out with eight actions of ten steps for four of five."""
    columns = REPORT.values()
    rows = [["run", *(f"{split}, {n}" for split in REPORT for n in ("8 of 10", "4 of 5"))]]
    for name, run in sorted(results.items()):
        before = results.get(name.replace("-seed", "-eight-seed"))
        if before and "base" in before and before["training"] == run["training"]:
            cells = [pooled_success(measured(r, *c)) for c in columns for r in (before, run)]
            rows.append([f"{VARIANTS[name.rsplit('-seed')[0]]}, seed {name[-1]}", *cells])
    return format_table(rows)


def swap_table(results: dict) -> str:
    rows = {}
    policies = swaps(results)
    for title, shown in policies.items():
        for label, successes in shown:
            rows.setdefault(label, {})[title] = pooled_success(successes)
    cells = [[label, *(by.get(title, "") for title in policies)] for label, by in rows.items()]
    return format_table([["what the policy sees", *policies], *cells])


TABLES = {
    "means": means_table,
    "base": by_task_table("base"),
    "novel": by_task_table("novel"),
    "difficulty": difficulty_table,
    "variants": variants_table,
    "policies": policies_table,
    "ablation": ablation_table,
    "length": length_table,
    "limits": limits_table(LIMITS, "given"),
    "tuning": limits_table(TUNING, "trained"),
    "ml45 means": lambda results: means_table(results, "ml45"),
    "ml45 difficulty": lambda results: difficulty_table(results, "ml45"),
    "ml45 novel": by_task_table("novel", "ml45"),
    "looks": looks_table,
    "swap": swap_table,
    "reading": reading_table,
}


def fill(text: str, results: dict) -> str:
    """README or RESULTS.md with each table between its two comments as RESULTS.json has it."""
    for name, make in TABLES.items():
        pattern = rf"(<!-- results: {name} -->\n).*?(<!-- end -->)"
        if found := re.search(pattern, text, flags=re.S):
            text = text.replace(found[0], f"{found[1]}{make(results)}\n{found[2]}")
    return text


def draw_swap(results: dict, path: Path) -> None:
    """A bar for each thing that a policy can be shown: is the demonstration read?"""
    from matplotlib.figure import Figure

    policies = {title: dict(shown) for title, shown in swaps(results).items() if shown}
    labels = list(max(policies.values(), key=len))
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(policies), sharey=True))
    for axes, (title, shown) in zip(panels, policies.items()):
        for label, successes in shown.items():
            episodes = [s for task in successes.values() for s in task]
            rate, bounds = np.mean(episodes), wilson_interval(sum(episodes), len(episodes))
            error = 100 * np.abs(np.array(bounds)[:, None] - rate)
            color = "C3" if "another" in label else "C0"
            axes.barh(labels.index(label), 100 * rate, xerr=error, color=color, capsize=2)
        for label in set(labels) - set(shown):
            axes.text(3, labels.index(label), "not measured", va="center", fontsize=8)
        axes.set_yticks(range(len(labels)), labels, fontsize=8)
        axes.set(xlabel="success, %", xlim=(0, 100), ylim=(len(labels) - 0.4, -0.6))
        axes.set_title(title, fontsize=10)
        axes.spines[["top", "right"]].set_visible(False)
    write_atomically(path, lambda temporary: figure.savefig(temporary, dpi=120, format="png"))


def draw_adaptation(results: dict, path: Path) -> None:
    """Success on novel tasks against gradient steps, and against the number of demonstrations."""
    from matplotlib.figure import Figure

    shots = [(n, f"{n}-shot", "after") for n in (1, 3, 5)] + [(10, "curve", "after")]
    steps = [(0, "curve", "before"), *((n, "curve", f"{n} steps") for n in (1, 5, 20, 50))]
    steps += [(200, "curve", "after"), (500, "long", "500 steps"), (1000, "long", "after")]
    panels = {"gradient steps, ten demonstrations": steps}
    panels["demonstrations, 200 gradient steps"] = shots
    figure = Figure(figsize=(10, 3.8), layout="constrained")
    for axes, (label, points) in zip(figure.subplots(1, 2, sharey=True), panels.items()):
        for variant, title in VARIANTS.items():
            curve = [(x, together(results, variant, report)) for x, *report in points]
            if not (curve := [(x, episodes) for x, episodes in curve if episodes]):
                continue
            bounds = [wilson_interval(sum(e), len(e)) for _, e in curve]
            rates = np.array([np.mean(e) for _, e in curve])
            error = 100 * np.abs(np.array(bounds).T - rates)  # (2, points)
            line = {"marker": "o", "markersize": 4, "capsize": 2, "linewidth": 1.5}
            line["label"] = SHOWN["ml10"].get(variant, title)
            axes.errorbar([x for x, _ in curve], 100 * rates, error, **line)
        axes.set_xscale("symlog", linthresh=1)
        axes.set_xticks([x for x, *_ in points], [x for x, *_ in points], fontsize=7)
        axes.minorticks_off()
        axes.set(xlabel=label, ylim=(0, 100))
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("success on novel tasks, %")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, frameon=False, ncols=2, loc="outside upper center", fontsize=8)
    write_atomically(path, lambda temporary: figure.savefig(temporary, dpi=120, format="png"))


def draw_by_task(results: dict, path: Path) -> None:
    """Success by task, of all seeds together, beside the paper's."""
    columns: dict[str, Successes] = {}
    for variant, label in SHOWN["ml10"].items():
        columns[label] = {task: [] for tasks in TASKS["ml10"].values() for task in tasks}
        for run in runs_of(results, variant):
            for report in REPORT.values():
                for task, successes in on_all_goals(run, *report).items():
                    columns[label][task] += successes
    title = "base tasks directly, novel tasks (the last five) after 200 steps"
    draw_success(columns, path, title, "ml10")


def compare(results: dict, one: str, other: str) -> str:
    """Episodes on the same goals that one variant wins and loses against another, seed by seed.

    A row a report that both have, of its column "after" or else its first; p: two-sided sign test.
    """
    rows = [["report", "won", "lost", "episodes", "p"]]
    names = [name for name in results if name.startswith(f"{one}-seed")]
    both = [(results[name], results.get(name.replace(one, other, 1), {})) for name in names]
    for name in (name for name in REPORTS if not name.endswith(AGAIN)):
        outcomes = []
        for pair in both:
            columns = [on_all_goals(r, name, "after") or on_all_goals(r, name) for r in pair]
            if all(columns):
                outcomes += pairs(*columns)
        if outcomes:
            won, lost = outcomes.count((True, False)), outcomes.count((False, True))
            p = binomtest(won, won + lost).pvalue if won + lost else 1.0
            rows.append([name, str(won), str(lost), str(len(outcomes)), f"{p:.4f}"])
    return format_table(rows)


def ship(checkpoint: str) -> None:
    """Writes assets/ml10-small.pt: a checkpoint in float16 that is rolled out as `small` is."""
    small = asdict(PRESETS["small"])
    changed = {name: small[name] for name in ("n_action_steps", "inference_steps")}
    policy, info = load_checkpoint(checkpoint, **changed)
    kept = {name: info[name] for name in TRAINED}
    save_checkpoint(SHIPPED_CHECKPOINT, policy, half=True, **kept)


def main(words: list[str]) -> None:
    if words[:1] == ["--ship"]:
        return ship(words[1])
    results = json.loads(RESULTS.read_text())
    if words[:1] == ["--compare"]:
        return print(compare(results, *words[1:]))
    for folder in words:
        take(results, Path(folder))
    if words:
        text = json.dumps(results, indent=1) + "\n"
        write_atomically(RESULTS, lambda path: path.write_text(text))
        return
    for name in ("README.md", "RESULTS.md"):
        filled = fill((ROOT / name).read_text(), results)
        write_atomically(ROOT / name, lambda path, filled=filled: path.write_text(filled))
    draw_swap(results, ROOT / "assets" / "swap.png")
    draw_by_task(results, ROOT / "assets" / "success.png")
    if any("curve" in run for run in results.values()):
        draw_adaptation(results, ROOT / "assets" / "adaptation.png")


if __name__ == "__main__":
    main(sys.argv[1:])
