"""assets/RESULTS.json, and what README and RESULTS.md show of it: tables and charts.

    python -m tests.results runs/ml10-dami-seed0   # takes a run of tests.runs into RESULTS.json
    python -m tests.results                        # writes the tables, draws the charts
    python -m tests.results --compare ml10-dami ml10-neither    # episodes won and lost, sign test
    python -m tests.results --ship RUN             # makes it assets/SUITE-small.pt, float16
    python -m tests.results --ship RUN goals-reach-inner    # the same with another name

RESULTS.json holds for each run how it was trained and, for each report that measured it, every
episode (1: success, 0: not) with the command, hardware, seed and date.
"""

import argparse
import json
import re
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

import model
from common import UserError, command_line, count, format_table, read_json_lines
from data import write_text
from evaluate import SHIPPED_CHECKPOINT, TRAINED, checkpoints_of, load_trained
from model import CheckpointError
from report import (
    PAPER_NAMES,
    PAPER_RESULTS,
    Successes,
    format_success,
    mean_interval,
    mean_success,
    paper_columns,
    plot_success,
    pooled_success,
    save_png,
    wilson_interval,
)
from simulator import simulator_of
from tests.runs import AGAIN, HIDDEN_REPORTS, REPORTS, UNNAMED_REPORTS
from unnamed_tasks import ANGLES, DIRECTIONS, SCENES, turned_task

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "assets" / "RESULTS.json"
PAGES = ("README.md", "RESULTS.md")
PAPER = json.loads(PAPER_RESULTS.read_text())


def tasks_of(suite: str) -> dict[str, list[str]]:
    """The base and the novel tasks of a suite."""
    base, novel = simulator_of(suite).tasks(suite)
    return {"base": base, "novel": novel}


TASKS = {"ml10": tasks_of("ml10"), "ml45": tasks_of("ml45")}
DIFFICULTY = {  # as DP3 groups Meta-World's tasks, after Seo et al. (2022); the others are easy
    "medium": "basketball bin-picking box-close coffee-pull coffee-push hammer peg-insert-side "
    "push-wall soccer sweep sweep-into",
    "hard": "assembly hand-insert pick-out-of-hole pick-place push push-back",
    "very hard": "disassemble pick-place-wall shelf-place stick-pull stick-push",
}
# Runs whose names begin with "old-" had the camera and the recipe of 2026-11-27.
OLD_VARIANTS = {  # of ML10: a run's name without its seed -> what it is
    "old-ml10-dami": "DAMI",
    "old-ml10-first-order": "DAMI, first order",
    "old-ml10-no-inner-loop": "without the inner loop",
    "old-ml10-no-inner-loop-cpu": "without the inner loop, trained on the CPU alone",
    "old-ml10-no-demonstration": "without a demonstration",
    "old-ml10-neither": "without both: multi-task training",
}
SWAPPED = {  # a run -> its panel in the swap chart
    "ml10-small-seed0": "DAMI",
    "ml10-no-inner-loop-seed0": "DAMI without the inner loop",
}
POLICIES = {  # of baselines.py -> what the paper calls it
    policy: name for policy, name in PAPER_NAMES.items() if policy not in ("dami", "rl")
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
# A group (a suite, or "old-" and a suite) -> the columns of its tables: a variant, and its title.
SHOWN = {
    "ml10": {
        "ml10-dami": "DAMI",
        "ml10-no-inner-loop": "no inner loop",
        "ml10-no-demonstration": "no demonstration",
        "ml10-neither": "multi-task",
    },
    "old-ml45": {
        "old-ml45-dami": "DAMI",
        "old-ml45-no-inner-loop": "no inner loop",
        "old-ml45-no-demonstration": "no demonstration",
        "old-ml45-neither": "multi-task",
        "old-ml45-dp3": "DP3",
    },
}


@dataclass(frozen=True)
class Column:
    """A column of a report (a name of `tests.runs.REPORTS`).

    `column` is its place, its title, or what its title ends with behind a comma: "zeros" finds
    "goals-reach-demonstration-seed0/ema-01500, zeros".
    """

    report: str
    column: int | str = 0
    at_end: bool = False  # success at the end, not at any step
    other_task: bool = False  # success, at any step, at the other task of a pair


BASE, BEFORE, AFTER = Column("base"), Column("novel", "before"), Column("novel", "after")
MEASURED_BY = {"base": BASE, "novel": AFTER}  # the tasks of a split

# The names of all reports, each once and in their order.
REPORT_NAMES = tuple(dict.fromkeys(chain(REPORTS, HIDDEN_REPORTS, *UNNAMED_REPORTS.values())))

Results = dict[str, dict[str, Any]]  # a run's name -> "training", and its reports by their names


# ---- From runs to RESULTS.json -------------------------------------------------------------------


def take(results: Results, run: Path) -> None:
    """Adds a run's training and the reports beside its folder to `results`.

    Reports that `results` has already, of the same training, stay where no folder has newer ones. A
    folder of `tests.controls`, which trains nothing, and one of rl.py are their own reports.

    Raises UserError for any other folder.
    """
    if (run / "success.json").exists():
        report = read_report(run)
        script = shlex.split(report["provenance"]["command"])[1:3]  # or "-m" and a module
        if script == ["-m", "tests.controls"]:
            results[run.name] = {"novel": report}
            return
        if script[0] == "rl.py":
            results[run.name] = {"rl": report}
            return
    steps = []
    if (run / "config.json").exists():
        steps = [line for line in read_json_lines(run / "metrics.jsonl") if "loss" in line]
    if not steps:
        raise UserError(f"{run} is no run of train.py, tests.controls or rl.py")
    training = {
        "minutes": round(steps[-1]["seconds"] / 60, 1),
        **json.loads((run / "config.json").read_text()),
    }
    late = [line for line in steps if line["step"] > steps[-1]["step"] - 500]
    inner_steps = [line for line in late if "loss_before" in line]
    if inner_steps:  # the mean query losses of the last 500 outer steps
        training["inner_step"] = {
            "before": round(float(np.mean([line["loss_before"] for line in inner_steps])), 5),
            "after": round(float(np.mean([line["loss"] for line in inner_steps])), 5),
        }
    earlier = results.get(run.name, {})
    kept = earlier if earlier.get("training") == training else {}
    results[run.name] = {**kept, "training": training}
    for name in REPORT_NAMES:
        folder = Path(f"{run}-{name}")
        if (folder / "success.json").exists():
            results[run.name][name] = read_report(folder)


def read_report(folder: Path) -> dict[str, Any]:
    """A report as RESULTS.json keeps it, with the episodes as digits."""
    report = json.loads((folder / "success.json").read_text())
    with_episodes = (
        "successes",
        "successes at the end",
        "successes at the other task",
        "checkpoints",
    )
    for part in with_episodes:
        if part in report:
            report[part] = {
                title: {task: as_digits(episodes) for task, episodes in column.items()}
                for title, column in report[part].items()
            }
    return report


def as_digits(episodes: Sequence[bool]) -> str:
    """`[True, False]` -> "10"."""
    return "".join(str(int(success)) for success in episodes)


# ---- What RESULTS.json holds ---------------------------------------------------------------------


def runs_of(results: Results, variant: str) -> list[dict]:
    """The runs of a variant, one a seed."""
    name_of_run = re.compile(rf"{re.escape(variant)}(-seed\d+)?")
    return [run for name, run in sorted(results.items()) if name_of_run.fullmatch(name)]


def measured(run: dict, column: Column) -> Successes | None:
    """The episodes in a column of a run's report, if there is one."""
    part = "successes at the end" if column.at_end else "successes"
    if column.other_task:
        part = "successes at the other task"
    columns = run.get(column.report, {}).get(part, {})
    title = column.column
    if isinstance(title, int):
        if not columns:
            return None
        title = list(columns)[title]
    for name, tasks in columns.items():
        if name == title or name.endswith(f", {title}"):
            return {task: [c == "1" for c in episodes] for task, episodes in tasks.items()}
    return None


def on_all_goals(run: dict, column: Column) -> Successes | None:
    """The same with the episodes of the report on other goals behind them, if there is one."""
    first = measured(run, column)
    again = measured(run, replace(column, report=column.report + AGAIN))
    if first is None or again is None:
        return first
    return {task: first[task] + again[task] for task in first}


def of_each_run(results: Results, variant: str, column: Column) -> list[float]:
    """The success of each of a variant's runs that has the column, in percent."""
    of_runs = [on_all_goals(run, column) for run in runs_of(results, variant)]
    return [mean_success(successes) for successes in of_runs if successes]


def mean(results: Results, variant: str, column: Column) -> str:
    """The mean over a variant's trainings, with each training's own in brackets.

    If there is only one training: its success with Wilson's interval.
    """
    rates = of_each_run(results, variant, column)
    if not rates:
        return ""
    if len(rates) == 1:
        return f"{pooled(results, variant, column)} (one run)"
    each = ", ".join(f"{rate:.1f}".removesuffix(".0") for rate in rates)
    return f"{np.mean(rates):.1f} ({each})"


def together(
    results: Results, variant: str, column: Column, tasks: Sequence[str] | None = None
) -> list[bool]:
    """The episodes of some tasks, or of all, and of all of a variant's seeds together."""
    episodes = []
    for run in runs_of(results, variant):
        successes = on_all_goals(run, column) or {}
        for task in tasks or successes:
            episodes += successes.get(task, [])
    return episodes


def pooled(
    results: Results, variant: str, column: Column, tasks: Sequence[str] | None = None
) -> str:
    """The share of successes in some tasks, or in all, of all of a variant's seeds together."""
    episodes = together(results, variant, column, tasks)
    return format_success(sum(episodes), len(episodes)) if episodes else ""


# ---- Tables --------------------------------------------------------------------------------------


def paper_mean(suite: str, split: str, policy: str, tasks: Sequence[str] | None = None) -> str:
    """The mean of what the paper has of a policy on some tasks of a split, or on all."""
    rates = PAPER[suite][split]
    return f"{np.mean([rates[task][policy] for task in tasks or TASKS[suite][split]]):.1f}"


def paper_cells(suite: str, split: str, tasks: Sequence[str] | None = None) -> list[str]:
    """That of DP3 and of DAMI."""
    return [paper_mean(suite, split, policy, tasks) for policy in ("DP3", "DAMI")]


def variants_of(results: Results, group: str) -> dict[str, str]:
    """A group of SHOWN, as far as there are runs."""
    return {variant: title for variant, title in SHOWN[group].items() if runs_of(results, variant)}


def head(results: Results, group: str, title: str) -> list[str]:
    """The first row of a table of a group."""
    return [title, *variants_of(results, group).values(), "paper, DP3", "paper, DAMI"]


def suite_of(group: str) -> str:
    """The suite of a group of SHOWN."""
    return group.removeprefix("old-")


def means_table(results: Results, group: str) -> str:
    """The means of each variant of a group, and the paper's, at any step and at the end."""
    suite = suite_of(group)
    rows = [head(results, group, suite.upper())]
    for title, column, paper in (
        ("base tasks", BASE, paper_cells(suite, "base")),
        ("novel tasks, no gradient step", BEFORE, ["", ""]),
        ("novel tasks, 200 steps", AFTER, paper_cells(suite, "novel")),
    ):
        rows.append(
            [
                title,
                *(mean(results, variant, column) for variant in variants_of(results, group)),
                *paper,
            ]
        )
        at_end = replace(column, at_end=True)
        cells = [mean(results, variant, at_end) for variant in variants_of(results, group)]
        if any(cells):
            rows.append([f"{title}, at the end", *cells, "", ""])
    return format_table(rows)


def by_task_table(results: Results, split: str, group: str) -> str:
    """A row a task: each variant's seeds together, and the paper's."""
    suite, column = suite_of(group), MEASURED_BY[split]
    rows = [head(results, group, "task")]
    for task in TASKS[suite][split]:
        cells = [
            pooled(results, variant, column, [task]) for variant in variants_of(results, group)
        ]
        rows.append([task, *cells, *paper_cells(suite, split, [task])])
    means = [mean(results, variant, column) for variant in variants_of(results, group)]
    rows.append(["**mean**", *means, *paper_cells(suite, split)])
    return format_table(rows)


def difficulty_table(results: Results, group: str) -> str:
    """A row for the base tasks, and one for the novel tasks, of each difficulty."""
    suite = suite_of(group)
    difficulty_of = {task: name for name, tasks in DIFFICULTY.items() for task in tasks.split()}
    rows = [head(results, group, "tasks")]
    for split, column in MEASURED_BY.items():
        for difficulty in ("easy", *DIFFICULTY):
            tasks = [t for t in TASKS[suite][split] if difficulty_of.get(t, "easy") == difficulty]
            if tasks:
                cells = [
                    pooled(results, variant, column, tasks)
                    for variant in variants_of(results, group)
                ]
                title = f"{split}, {difficulty} ({len(tasks)})"
                rows.append([title, *cells, *paper_cells(suite, split, tasks)])
    return format_table(rows)


def old_variants_table(results: Results) -> str:
    """A row a variant of ML10, by the older recipe."""
    rows = [["ML10", "base", "novel, no gradient step", "novel, 200 steps"]]
    for variant, title in OLD_VARIANTS.items():
        cells = [mean(results, variant, column) for column in (BASE, BEFORE, AFTER)]
        rows.append([title, *cells])
    return format_table(rows)


def policies_table(results: Results) -> str:
    """The paper's policies, without and with meta-training, beside what the paper has of them."""
    rows = [
        [
            "ML10",
            "base",
            "base + MAML",
            "novel",
            "novel + MAML",
            "paper, base, without / with",
            "paper, novel, without / with",
        ]
    ]
    of_dami = [f"- / {paper_mean('ml10', split, 'DAMI')}" for split in ("base", "novel")]
    ours = with_and_without(results, "old-ml10-no-inner-loop", "old-ml10-dami")
    rows.append(["DAMI", *ours, *of_dami])
    for policy, name in POLICIES.items():
        ours = with_and_without(results, f"old-ml10-{policy}", f"old-ml10-{policy}-maml")
        paper = []
        for split, table in (("base", "base_maml_avg"), ("novel", "novel_maml")):
            with_maml = np.mean(PAPER["ml10"][table][name])
            paper.append(f"{paper_mean('ml10', split, name)} / {with_maml:.1f}")
        rows.append([name, *ours, *paper])
    return format_table(rows)


def with_and_without(results: Results, plain: str, meta_trained: str) -> list[str]:
    """The means of a variant without and one with meta-training, on base and on novel tasks."""
    return [
        mean(results, variant, column)
        for column in (BASE, AFTER)
        for variant in (plain, meta_trained)
    ]


def length_table(results: Results) -> str:
    """A row a checkpoint of the run whose checkpoints were all measured."""
    rows = [["outer steps", "minutes", "base tasks"]]
    run = results["old-ml10-neither-seed0"]
    training = run["training"]
    for label, tasks in run["top"]["checkpoints"].items():
        step = int(re.search(r"\d+$", label)[0])
        minutes = training["minutes"] * step / training["arguments"]["steps"]
        episodes = "".join(tasks.values())
        success = format_success(episodes.count("1"), len(episodes))
        rows.append([str(step), f"{minutes:.0f}", success])
    return format_table(rows)


def pairs(one: Successes, other: Successes) -> list[tuple[bool, bool]]:
    """What two policies made of each episode."""
    return [pair for task in one for pair in zip(one[task], other[task])]


def won_and_lost(one: Successes, other: Successes) -> tuple[int, int]:
    """How many episodes a policy wins against another on the same goals, and how many it loses."""
    outcomes = pairs(one, other)
    return outcomes.count((True, False)), outcomes.count((False, True))


COMPARED_WITH = "ml10-neither"  # of ML10, multi-task training


def against_multi_task_table(results: Results) -> str:
    """A row a training of ML10: won and lost against multi-task training of the same seed."""
    rows = [["against multi-task training", "base tasks: won, lost", "novel tasks: won, lost"]]
    for variant, title in variants_of(results, "ml10").items():
        for seed in range(3):
            ours = results.get(f"{variant}-seed{seed}")
            theirs = results.get(f"{COMPARED_WITH}-seed{seed}")
            if variant == COMPARED_WITH or ours is None or theirs is None:
                continue
            cells = []
            for column in MEASURED_BY.values():
                won, lost = won_and_lost(measured(ours, column), measured(theirs, column))
                cells.append(f"{won}, {lost}")
            rows.append([f"{title}, seed {seed}", *cells])
    return format_table(rows)


def limits_table(results: Results, titles: dict[str, str], first: str) -> str:
    """A row a variant of `titles`, seed 0 of each, beside the first of them.

    They are measured on goals that no other result has. `first` is the title of the first column.
    """
    successes = {
        variant: measured(results.get(f"old-ml10-{variant}-seed0", {}), Column("limits"))
        for variant in titles
    }
    plain = successes[next(iter(titles))]
    rows = [[first, "base tasks", "won, lost against the first"]]
    for variant, of_variant in successes.items():
        if of_variant is None:
            continue
        won, lost = won_and_lost(of_variant, plain)
        against = "" if of_variant is plain else f"{won}, {lost}"
        rows.append([titles[variant], pooled_success(of_variant), against])
    return format_table(rows)


SWAP_COLUMNS = {  # what a policy is shown -> where that was measured
    "instruction, own demonstration": Column("told", 0),
    "instruction, another's demonstration": Column("told", 1),
    "another's instruction, own demonstration": Column("told", 2),
    "own demonstration alone": Column("swap", 0),
    "another's demonstration alone": Column("swap", 1),
}


def swaps(results: Results) -> dict[str, dict[str, Successes]]:
    """Policy -> what it is shown -> its episodes on the base tasks."""
    return {
        title: {label: measured(results[name], column) for label, column in SWAP_COLUMNS.items()}
        for name, title in SWAPPED.items()
    }


def swap_table(results: Results) -> str:
    """A row for each thing that a policy can be shown, a column a policy."""
    policies = swaps(results)
    rows = [["what the policy sees", *policies]]
    for label in SWAP_COLUMNS:
        cells = [pooled_success(columns[label]) for columns in policies.values()]
        rows.append([label, *cells])
    return format_table(rows)


SHOWN_ANOTHER = "demonstration of another task"  # as reports of `evaluate.py --swap` call it

# What is measured on goals that no observation tells: a title, the variant, and its report.
HIDDEN_ROWS = (
    ("with the goal's own demonstration", "demonstration", Column("novel", 0)),
    ("the same, from 20 starts", "demonstration", Column("starts")),
    (
        "with the goal's own, trained for twice as many steps",
        "demonstration-twice-as-long",
        Column("novel", 0),
    ),
    ("these, from 20 starts", "demonstration-twice-as-long", Column("starts")),
    ("with another goal's", "demonstration", Column("novel", SHOWN_ANOTHER)),
    (
        "with another goal's, trained for twice as many steps",
        "demonstration-twice-as-long",
        Column("novel", SHOWN_ANOTHER),
    ),
    ("with zeros in its place", "demonstration", Column("novel", "zeros")),
    (
        "with zeros in its place, trained for twice as many steps",
        "demonstration-twice-as-long",
        Column("novel", "zeros"),
    ),
    ("with its last frame alone", "demonstration", Column("parts", "last-frame")),
    ("without its actions", "demonstration", Column("parts", "no-actions")),
    ("with its frames in another order", "demonstration", Column("parts", "shuffled")),
    (
        "with the goal's own, trained at twice the learning rate",
        "demonstration-twice-the-rate",
        Column("novel", 0),
    ),
    ("second order: before any step", "inner", Column("0-steps")),
    ("second order: 1 inner step", "inner", Column("1-steps")),
    ("second order: 1 inner step on another goal", "inner", Column("1-steps-swap", SHOWN_ANOTHER)),
    ("second order: 1 inner step, from one demonstration", "inner", Column("1-steps-of-1")),
    ("second order: 1 inner step, from two", "inner", Column("1-steps-of-2")),
    ("second order: 5 inner steps", "inner", Column("5-steps")),
    ("second order: 20 inner steps", "inner", Column("20-steps")),
    ("second order: 1 step of AdamW", "inner", Column("adamw", "1 steps")),
    ("second order: 5 steps of AdamW", "inner", Column("adamw", "5 steps")),
    ("second order: 20 steps of AdamW", "inner", Column("adamw", "20 steps")),
    ("second order: 200 steps of AdamW", "inner", Column("adamw", "after")),
    ("first order: before any step", "inner-first-order", Column("0-steps")),
    ("first order: 1 inner step", "inner-first-order", Column("1-steps")),
    ("first order: 5 inner steps", "inner-first-order", Column("5-steps")),
    ("first order: 20 inner steps", "inner-first-order", Column("20-steps")),
    ("multi-task: before any step", "neither", Column("0-steps")),
    ("multi-task: 1 step at its best rate", "neither", Column("1-steps-best-rate")),
    ("multi-task: 5 steps at their best rate", "neither", Column("5-steps-best-rate")),
    ("multi-task: 20 steps at their best rate", "neither", Column("20-steps-best-rate")),
    ("multi-task: 1 step of AdamW", "neither", Column("adamw", "1 steps")),
    ("multi-task: 5 steps of AdamW", "neither", Column("adamw", "5 steps")),
    ("multi-task: 20 steps of AdamW", "neither", Column("adamw", "20 steps")),
    ("multi-task: 200 steps of AdamW", "neither", Column("adamw", "after")),
    ("multi-task, then learned rates: before any step", "frozen", Column("0-steps")),
    ("multi-task, then learned rates: 1 step", "frozen", Column("1-steps")),
    ("multi-task, then learned rates: 5 steps", "frozen", Column("5-steps")),
    ("multi-task, then learned rates: 20 steps", "frozen", Column("20-steps")),
    ("multi-task, longer: before any step", "neither-as-long", Column("0-steps")),
    ("multi-task, longer: 1 step", "neither-as-long", Column("1-steps-best-rate")),
    ("multi-task, longer: 5 steps", "neither-as-long", Column("5-steps-best-rate")),
    ("multi-task, longer: 20 steps", "neither-as-long", Column("20-steps-best-rate")),
    ("demonstration and inner loop: before a step", "both", Column("novel", 0)),
    ("demonstration and inner loop: 1 inner step", "both", Column("1-steps")),
    ("no demonstration, but the goal is seen", "marker", Column("0-steps")),
    ("no network: the demonstration's actions again", "controls", Column("novel", "replay")),
    ("no network: to the hand's last position", "controls", Column("novel", "servo")),
    ("the expert, who knows the goal", "controls", Column("novel", "expert")),
)


def hidden_goals_table(results: Results, skill: str) -> str:
    """A row for everything that was measured on the novel goals of a skill."""
    rows = [[f"{skill}, goals never seen", "at any step", "at the end"]]
    for title, variant, column in HIDDEN_ROWS:
        name = f"goals-{skill}-{variant}"
        cells = [mean(results, name, replace(column, at_end=at_end)) for at_end in (False, True)]
        if any(cells):
            rows.append([title, *cells])
    return format_table(rows)


HIDDEN_SUMMARY = {  # the most important of these rows -> their titles in README
    "with the goal's own demonstration": "a demonstration of the goal",
    "the same, from 20 starts": "the same, from 20 starts in place of five",
    "with the goal's own, trained for twice as many steps": (
        "a demonstration of the goal, twice as many steps of training"
    ),
    "these, from 20 starts": "trained so, from 20 starts in place of five",
    "with another goal's": "a demonstration of another goal",
    "with zeros in its place": "zeros in its place",
    "second order: before any step": "no demonstration, second-order MAML: before any step",
    "second order: 1 inner step": "the same, after one inner step",
    "first order: 1 inner step": "first-order MAML, after one inner step",
    "multi-task: 1 step at its best rate": "multi-task training, one step at its best rate",
    "no network: to the hand's last position": "a script: the hand to where a demonstration ended",
    "the expert, who knows the goal": "the expert, who knows the goal",
}


def hidden_summary_table(results: Results) -> str:
    """The success at the end on novel goals: a row for what a policy has, a column a skill."""
    skills = ("reach", "push", "pick-place")
    rows = [["success at the end, percent", *skills]]
    for title, variant, column in HIDDEN_ROWS:
        if title in HIDDEN_SUMMARY:
            at_end = replace(column, at_end=True)
            cells = [mean(results, f"goals-{skill}-{variant}", at_end) for skill in skills]
            rows.append([HIDDEN_SUMMARY[title], *cells])
    return format_table(rows)


NUMBERS_OF_GOALS = {  # goals of a training -> its variant, and where it was measured
    5: ("demonstration-5-goals", Column("0-steps")),
    20: ("demonstration-20-goals", Column("0-steps")),
    40: ("demonstration-40-goals", Column("0-steps")),
    80: ("demonstration-80-goals", Column("0-steps")),
    160: ("demonstration", Column("novel")),
    320: ("demonstration-320-goals", Column("0-steps")),
}


def numbers_of_goals_table(results: Results, skill: str) -> str:
    """The success on novel goals with their demonstration, by the number of goals in training."""
    rows = [[f"{skill}, goals in training", "at any step", "at the end"]]
    for number, (variant, column) in NUMBERS_OF_GOALS.items():
        name = f"goals-{skill}-{variant}"
        cells = [mean(results, name, replace(column, at_end=at_end)) for at_end in (False, True)]
        if any(cells):
            rows.append([str(number), *cells])
    return format_table(rows)


# What is measured where no observation names the task: a title, the variant, its report, and the
# column of that. Where the report is None, it is the one in which tasks are also shown the
# demonstrations of others. It is called after its scene in pairs, and "angles" where actions are
# turned.
UNNAMED_ROWS = (
    ("its own demonstration", "demonstration", None, 0),
    ("its own demonstration without the actions", "demonstration", None, "no-actions"),
    ("another task's demonstration", "demonstration", None, SHOWN_ANOTHER),
    ("zeros in place of a demonstration", "demonstration", None, "zeros"),
    ("no demonstration, second-order MAML: before any step", "inner", "0-steps", 0),
    ("the same, after one inner step", "inner", "1-steps", 0),
    ("the same, after five inner steps", "inner", "5-steps", 0),
    ("multi-task training", "neither", "multi-task", 0),
    ("the same, after one step at its best rate", "neither", "1-steps-best-rate", 0),
    ("the same, after five steps at their best rate", "neither", "5-steps-best-rate", 0),
)


def pairs_table(results: Results) -> str:
    """A row for what a policy has; success at its task and at the other one, by scene."""
    head_cells = [f"{scene}, {which}" for scene in SCENES for which in ("its task", "the other")]
    rows = [["success at any step, percent", *head_cells]]
    for title, variant, report, shown in UNNAMED_ROWS:
        cells = []
        for scene in SCENES:
            tasks = [f"{scene}-{direction}-hidden" for direction in DIRECTIONS]
            for other_task in (False, True):
                column = Column(report or scene, shown, other_task=other_task)
                cells.append(pooled(results, f"pairs-{variant}", column, tasks))
        if any(cells):
            rows.append([title, *cells])
    return format_table(rows)


def turned_actions_table(results: Results, skill: str) -> str:
    """A row for what a policy has: success on all new angles, and at the end on each of them."""
    angles = ANGLES["novel"]
    angle_cells = [f"{angle:g}" for angle in angles]
    rows = [[f"{skill}, percent", "at any step", "at the end", *angle_cells]]
    for title, variant, report, shown in UNNAMED_ROWS:
        name = f"convention-{skill}-{variant}"
        column = Column(report or "angles", shown)
        at_end = replace(column, at_end=True)
        cells = [pooled(results, name, column), pooled(results, name, at_end)]
        for angle in angles:
            episodes = together(results, name, at_end, [turned_task(skill, angle)])
            cells.append(f"{100 * np.mean(episodes):.0f}" if episodes else "")
        if any(cells):
            rows.append([title, *cells])
    return format_table(rows)


def rl_table(results: Results) -> str:
    """What reinforcement learning reaches on ML10: success before and after its inner step."""
    rows = [["ML10", "base tasks", "base, at the end", "novel tasks", "novel, at the end"]]
    for title, label in (
        ("MAML-TRPO, before the inner step", "before"),
        ("MAML-TRPO, after it", "after one inner step"),
    ):
        cells = []
        for split in ("base", "novel"):
            for at_end in (False, True):
                column = Column("rl", label, at_end=at_end)
                cells.append(pooled(results, "rl-ml10", column, TASKS["ml10"][split]))
        rows.append([title, *cells])
    base, novel = (paper_mean("ml10", split, PAPER_NAMES["rl"]) for split in ("base", "novel"))
    rows.append(['paper, "Meta-World"', base, "", novel, ""])
    return format_table(rows)


TABLES: dict[str, Callable[[Results], str]] = {
    "goals": hidden_summary_table,
    "goals reach": lambda results: hidden_goals_table(results, "reach"),
    "goals push": lambda results: hidden_goals_table(results, "push"),
    "goals pick-place": lambda results: hidden_goals_table(results, "pick-place"),
    "goals reach numbers": lambda results: numbers_of_goals_table(results, "reach"),
    "pairs": pairs_table,
    "turned actions": lambda results: turned_actions_table(results, "reach"),
    "means": lambda results: means_table(results, "ml10"),
    "rl": rl_table,
    "base": lambda results: by_task_table(results, "base", "ml10"),
    "novel": lambda results: by_task_table(results, "novel", "ml10"),
    "against multi-task": against_multi_task_table,
    "swap": swap_table,
    "old variants": old_variants_table,
    "old policies": policies_table,
    "old ml45 means": lambda results: means_table(results, "old-ml45"),
    "old ml45 difficulty": lambda results: difficulty_table(results, "old-ml45"),
    "old length": length_table,
    "old limits": lambda results: limits_table(results, LIMITS, "given"),
    "old tuning": lambda results: limits_table(results, TUNING, "trained"),
}


def fill(text: str, results: Results) -> str:
    """README or RESULTS.md with each table between its two comments as RESULTS.json has it."""

    def filled(match: re.Match) -> str:
        opening, name, end = match.groups()
        return f"{opening}{TABLES[name](results)}\n{end}"

    return re.sub(r"(<!-- results: (.+?) -->\n).*?(<!-- end -->)", filled, text, flags=re.S)


# ---- Charts --------------------------------------------------------------------------------------


def plot_swap(results: Results, path: Path) -> None:
    """Writes a chart with a bar for each thing that a policy can be shown, a panel a policy."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    policies = swaps(results)
    labels = list(SWAP_COLUMNS)
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    panels = figure.subplots(1, len(policies), sharey=True)
    own_color, other_color = "C0", "C3"
    for axes, (title, columns) in zip(panels, policies.items()):
        for place, label in enumerate(labels):
            episodes = [success for of_task in columns[label].values() for success in of_task]
            rate, bounds = np.mean(episodes), wilson_interval(sum(episodes), len(episodes))
            error = 100 * np.abs(np.array(bounds)[:, None] - rate)  # (2, 1)
            color = other_color if "another" in label else own_color
            axes.barh(place, 100 * rate, xerr=error, color=color, capsize=2)
        axes.set_yticks(range(len(labels)), labels, fontsize=8)
        axes.set(xlabel="success, %", xlim=(0, 100), ylim=(len(labels) - 0.4, -0.6))
        axes.set_title(title, fontsize=8)
        axes.spines[["top", "right"]].set_visible(False)
    legend = [
        Patch(color=own_color, label="all inputs are of the task that is measured"),
        Patch(
            color=other_color, label="one is of another task: a long bar says that it is ignored"
        ),
    ]
    figure.legend(handles=legend, ncols=2, loc="outside lower center", frameon=False, fontsize=8)
    figure.suptitle("ML10's base tasks: one training a panel, 200 episodes a bar", fontsize=10)
    save_png(figure, path, dpi=120)


ARMS = {  # of those without a demonstration encoder -> its line in the figure
    "inner": "second-order MAML",
    "inner-first-order": "first-order MAML",
    "frozen": "multi-task, then learned rates",
    "neither": "multi-task, inner steps at the best of five rates",
}


def columns_of_steps(arm: str) -> dict[str, dict[int, Column]]:
    """The panels of the figure: a title -> after so many steps -> where that was measured.

    Multi-task training has, for each number of inner steps, the rate that is best for it.
    """
    best_rate = "-best-rate" if arm == "neither" else ""
    inner_steps = {n: Column(f"{n}-steps{best_rate}") for n in (1, 5, 20)}
    adamw = {n: Column("adamw", f"{n} steps") for n in (1, 5, 20)}
    return {
        "inner steps (gradient descent), all on the same eight windows": {
            0: Column("0-steps"),
            **inner_steps,
        },
        "steps of AdamW, each on 64 windows": {
            0: Column("adamw", "before"),
            **adamw,
            200: Column("adamw", "after"),
        },
    }


def plot_steps(results: Results, skill: str, path: Path) -> None:
    """Writes a chart of success at the end on novel goals along gradient steps, a line an arm.

    Lines are means of trainings, each of which is a dot. A dashed line is the mean of the policies
    that read a demonstration, without any step.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.8), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for place, (arm, label) in enumerate(ARMS.items()):
        variant, color = f"goals-{skill}-{arm}", f"C{place}"
        for axes, columns in zip(panels, columns_of_steps(arm).values()):
            x = np.arange(len(columns)) + 0.05 * (place - 1.5)  # so that no arm hides another
            means = []
            for i, column in enumerate(columns.values()):
                rates = of_each_run(results, variant, replace(column, at_end=True))
                axes.plot([x[i]] * len(rates), rates, "o", color=color, alpha=0.5)
                means.append(np.mean(rates) if rates else np.nan)
            if not np.isnan(means).all():
                axes.plot(x, means, color=color, label=label)
    shown = of_each_run(results, f"goals-{skill}-demonstration", Column("novel", 0, at_end=True))
    for axes, (title, columns) in zip(panels, columns_of_steps("inner").items()):
        if shown:
            label = "with a demonstration as input, no step"
            axes.axhline(np.mean(shown), color="gray", linestyle="--", label=label)
        axes.set_xticks(range(len(columns)), [str(n) for n in columns])
        axes.set(xlabel=title, xlim=(-0.4, len(columns) - 0.6), ylim=(-3, 103))
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel(f"success at the end, {skill}, %")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, ncols=3, loc="outside lower center", frameon=False, fontsize=8)
    title = f"{skill}, goals never seen: each dot is one training, lines are their means"
    figure.suptitle(title, fontsize=10)
    save_png(figure, path, dpi=120)


def plot_by_task(results: Results, path: Path) -> None:
    """Writes a chart of success by task, of all seeds together, beside the paper's."""
    columns: dict[str, Successes] = {}
    for variant, label in variants_of(results, "ml10").items():
        columns[f"{label}, {count(len(runs_of(results, variant)), 'training')}"] = {
            task: together(results, variant, column, [task])
            for split, column in MEASURED_BY.items()
            for task in TASKS["ml10"][split]
        }
    parts = {
        "base tasks, as trained": TASKS["ml10"]["base"],
        "novel tasks, after 200 gradient steps": TASKS["ml10"]["novel"],
    }
    title = "Success at any step on ML10"
    plot_success(columns, path, title, paper_columns("ml10", ["dami"]), parts)


# ---- Comparing, and shipping ---------------------------------------------------------------------


def compare(results: Results, one: str, other: str) -> str:
    """Episodes on the same goals that one variant wins and loses against another.

    Of each report that both have, its column "after" or else its first is compared: a row a seed of
    training, and where there are several the mean difference, with Student's interval of 95 % over
    these. p is of a two-sided sign test over episodes. It speaks of two trainings, and says nothing
    of how far others would lie apart.

    Raises UserError for a variant of which there is no run.
    """

    def episodes_of(run: dict, report: str) -> Successes | None:
        after = on_all_goals(run, Column(report, "after"))
        return after or on_all_goals(run, Column(report))

    for variant in (one, other):
        if not runs_of(results, variant):
            raise UserError(f"{RESULTS.name} has no run of {variant}")
    rows = [["report", "seed", "won", "lost", "episodes", "difference, points", "p"]]
    names = [name for name in results if re.fullmatch(rf"{re.escape(one)}-seed\d+", name)]
    for report in REPORT_NAMES:
        if report.endswith(AGAIN):  # these episodes are counted with those of the report itself
            continue
        differences = []
        for name in names:
            ours = episodes_of(results[name], report)
            theirs = episodes_of(results.get(name.replace(one, other, 1), {}), report)
            if not ours or not theirs:
                continue
            won, lost = won_and_lost(ours, theirs)
            number = len(pairs(ours, theirs))
            difference = 100 * (won - lost) / number
            p = binomtest(won, won + lost).pvalue if won + lost else 1.0
            seed = name.rpartition("-seed")[2]
            cells = [seed, won, lost, number, f"{difference:+.1f}", f"{p:.4f}"]
            rows.append([report, *map(str, cells)])
            differences.append(difference)
        if len(differences) > 1:
            rows.append([report, "mean", "", "", "", mean_interval(differences), ""])
    return format_table(rows)


def ship(run: str, name: str | None = None) -> None:
    """Writes a run's last checkpoint to assets/NAME.pt, in float16, to be rolled out as `small` is.

    Without a name it is SUITE-small, which scripts take where there is no run of the suite.
    """
    small = model.PRESETS["small"]
    checkpoint = checkpoints_of(run)[-1]
    policy, info = load_trained(
        checkpoint, n_action_steps=small.n_action_steps, inference_steps=small.inference_steps
    )
    kept = {name: info[name] for name in (*TRAINED, "inner_rates") if name in info}
    path = SHIPPED_CHECKPOINT.with_name(f"{name or info['suite'] + '-small'}.pt")
    model.save(path, policy, half=True, **kept)


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("runs", nargs="*", help="folders of tests.runs to take into RESULTS.json")
    add("--compare", nargs=2, metavar="VARIANT", help="episodes that the first wins and loses")
    add("--ship", nargs="+", metavar="RUN", help="a run, and a name: assets/NAME.pt is made of it")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    args = parse(argv)
    if args.ship:
        if len(args.ship) > 2:
            raise UserError("--ship takes a run and a name")
        ship(*args.ship)
        return
    results = json.loads(RESULTS.read_text())
    if args.compare:
        one, other = args.compare
        print(compare(results, one, other))
        return
    if args.runs:
        for folder in args.runs:
            take(results, Path(folder))
        write_text(RESULTS, json.dumps(results, indent=1) + "\n")
        return

    pages = {ROOT / name: fill((ROOT / name).read_text(), results) for name in PAGES}
    for path, text in pages.items():
        write_text(path, text)
    plot_swap(results, ROOT / "assets" / "swap.png")
    plot_by_task(results, ROOT / "assets" / "success.png")
    plot_steps(results, "reach", ROOT / "assets" / "inner-steps.png")


if __name__ == "__main__":
    command_line(main, errors=(CheckpointError,))
