"""What README and RESULTS.md claim is what RESULTS.json holds."""

import importlib
import json
import os
import re
import threading
from dataclasses import asdict, fields, replace

import numpy as np
import pytest

from common import UserError
from hidden_goals import SKILLS, names_of
from model import PRESETS, PolicyConfig
from report import mean_interval, wilson_interval
from tests import oracle
from tests.oracle import WORLDS
from tests.results import (
    HIDDEN_ROWS,
    HIDDEN_SUMMARY,
    NUMBERS_OF_GOALS,
    POLICIES,
    RESULTS,
    ROOT,
    TABLES,
    TASKS,
    UNNAMED_ROWS,
    Column,
    compare,
    fill,
    measured,
    runs_of,
    take,
)
from tests.runs import (
    HIDDEN_REPORTS,
    HIDDEN_SUITES,
    LIMITS,
    LONGER,
    REPORTS,
    SEED,
    TUNING,
    UNNAMED_REPORTS,
    UNNAMED_SUITES,
    VARIANTS,
    Job,
    jobs_of_run,
    plan_of,
    run_in_order,
)
from train import SETTINGS, Settings, parse, preset_settings
from unnamed_tasks import SCENES

HELD = json.loads(RESULTS.read_text())
HIDDEN = {name: run for name, run in HELD.items() if name.startswith("goals-")}
UNNAMED = {name: run for name, run in HELD.items() if name.startswith(UNNAMED_SUITES)}
SHIPPED = "ml10-small-seed0"
OLD = {name: run for name, run in HELD.items() if name.startswith(("old-", "before-"))}
ML10 = {name: run for name, run in HELD.items() if name.startswith("ml10-") and name != SHIPPED}

# RESULTS.json keeps every record as it was written, with the names that were used that day. These
# have another one today.
RENAMED = {
    "multi_task_share": "pretrain_fraction",
    "support_only": "task_dropout",
    "facts": "provenance",
}
# These were settings, and have one value today.
SETTLED = {"action_error": "squared"}


def with_new_names(record):
    """A record (name -> value) by the names of today."""
    return {RENAMED.get(name, name): value for name, value in record.items()}


def config_of(run):
    """The configuration of a run's policy, with the fields of today."""
    config = dict(run["training"]["config"])
    for name, value in SETTLED.items():
        assert config.pop(name, value) == value
    return config


def test_the_tables_are_those_of_the_results():
    pages = [(ROOT / name).read_text() for name in ("README.md", "RESULTS.md")]
    assert all(fill(page, HELD) == page for page in pages)
    shown = {name for page in pages for name in re.findall("<!-- results: (.*) -->", page)}
    assert shown == set(TABLES)


@pytest.mark.parametrize("report, column, task", [("base", 0, "reach"), ("novel", 1, "lever-pull")])
def test_a_cell_can_be_recomputed_from_the_episodes(report, column, task):
    runs = [run[report]["successes"] for run in runs_of(HELD, "ml10-dami") if report in run]
    episodes = "".join(list(columns.values())[column][task] for columns in runs)
    low, high = wilson_interval(episodes.count("1"), len(episodes))
    expected = [100 * x for x in (episodes.count("1") / len(episodes), low, high)]
    page = (ROOT / "RESULTS.md").read_text()
    line = next(line for line in page.splitlines() if re.match(rf"\| {task} +\|", line))
    shown = re.search(r"([\d.]+) \[([\d.]+), ([\d.]+)\]", line).groups()  # DAMI comes first
    assert [float(x) for x in shown] == pytest.approx(expected, abs=0.051)


def test_a_comparison_counts_what_is_won_and_lost_on_the_same_goals():
    def run(base, after):
        novel = {"before": {"push": "1111111"}, "after": {"push": after}}
        return {"base": {"successes": {"last": {"reach": base}}}, "novel": {"successes": novel}}

    results = {"a-seed0": run("1100", "1111111"), "b-seed0": run("1011", "0000001")}
    for name, more in {"a-seed0": "111", "b-seed0": "101"}.items():
        results[name]["base-goals2"] = {"successes": {"last": {"reach": more}}}
    results["a-seed1"] = run("1111", "1111111")
    results["b-seed1"] = run("1110", "1111111")
    results["a-seed2"] = run("1111", "1111111")  # these two make no pair
    results["b-seed3"] = run("0000", "0000000")
    rows = [line.split("|")[1:-1] for line in compare(results, "a", "b").splitlines()[2:]]
    rows = [[cell.strip() for cell in row] for row in rows]
    assert rows == [
        ["base", "0", "2", "2", "7", "+0.0", "1.0000"],
        ["base", "1", "1", "0", "4", "+25.0", "1.0000"],
        ["base", "mean", "", "", "", mean_interval([0.0, 25.0]), ""],
        ["novel", "0", "6", "0", "7", "+85.7", "0.0312"],
        ["novel", "1", "0", "0", "7", "+0.0", "1.0000"],
        ["novel", "mean", "", "", "", mean_interval([600 / 7, 0.0]), ""],
    ]


def test_a_report_is_done_unless_it_is_older_than_what_it_measures(tmp_path):
    checkpoint, report = tmp_path / "ema.pt", tmp_path / "success.json"
    job = Job("evaluate.py", result=report, log=tmp_path / "log", measures=checkpoint)
    assert not job.is_done()
    report.touch()
    assert not job.is_done()  # of a training that is not there
    checkpoint.touch()
    for when, done in ((10, False), (30, True)):
        os.utime(checkpoint, (20, 20))
        os.utime(report, (when, when))
        assert job.is_done() == done


def test_only_runs_and_reports_that_stand_for_themselves_are_taken(tmp_path):
    report = {
        "provenance": {"command": "python evaluate.py"},
        "successes": {"a": {"reach": [True]}},
    }
    (tmp_path / "success.json").write_text(json.dumps(report))
    for folder in (tmp_path, tmp_path / "missing"):
        with pytest.raises(UserError, match=r"is no run of train\.py"):
            take({}, folder)
    report["provenance"]["command"] = "python -m tests.controls"
    (tmp_path / "success.json").write_text(json.dumps(report))
    taken = {}
    take(taken, tmp_path)
    assert taken[tmp_path.name]["novel"]["successes"] == {"a": {"reach": "1"}}
    report["provenance"]["command"] = "python rl.py --suite ml10"
    (tmp_path / "success.json").write_text(json.dumps(report))
    take(taken, tmp_path)
    assert taken[tmp_path.name] == {"rl": {**report, "successes": {"a": {"reach": "1"}}}}
    with pytest.raises(UserError, match="has no run of nobody"):
        compare(taken, "nobody", "nobody")


def test_older_runs_are_of_the_variants_that_they_name():
    for name, run in OLD.items():
        suite, variant, seed = re.fullmatch(r"(?:old-)?(ml\d\d-)?(.*)-seed(\d)", name).groups()
        variant = variant.removesuffix("-eight").removesuffix("-cpu")
        arguments = with_new_names(run["training"]["arguments"])
        config = run["training"]["config"]
        stated = re.findall(r"--steps (\d+)", VARIANTS.get(variant, ""))
        steps = int(stated[-1]) if stated else 5_000 if suite == "ml45-" else 10_000
        assert arguments["seed"] == int(seed) and arguments["steps"] == steps
        assert arguments["suite"] == (suite or "ml10-")[:-1]
        policy = variant.removesuffix("-maml")
        assert config.get("policy", "dami") == (policy if policy in POLICIES else "dami")
        multi_task = variant in (*LONGER, *LIMITS, *TUNING, *POLICIES)
        off = "--maml off" in VARIANTS.get(variant.removeprefix("before-"), "")
        assert (arguments["maml"] == "off") == off
        silent = config["demo_encoder"] == "none"
        assert silent == (multi_task or policy in POLICIES or variant == "no-demonstration")
        always_told = arguments.get("instruction_dropout", 0) == 0
        assert always_told == (variant.startswith("before") or silent)
        assert variant in VARIANTS or variant.startswith("before")
        flags = vars(parse(re.sub(r"--data \S+", "", VARIANTS.get(variant, "")).split()))
        if variant in VARIANTS and arguments["maml"] != "off":
            flags["inner_lr"] = flags["inner_lr"] or SETTINGS["small"].inner_lr
        for flag, value in flags.items():
            if value is not None and flag != "resume":
                used = (arguments | config).get(flag, "dami")
                assert used == value, (name, flag)


def test_readme_says_how_well_the_policy_that_ships_does_which_was_trained_by_todays_recipe():
    run = HELD[SHIPPED]
    page = " ".join((ROOT / "README.md").read_text().split())  # without line breaks
    recipe = asdict(replace(preset_settings("small", "ml10"), episodes=0))  # measured afterwards
    assert run["training"]["arguments"] == recipe
    assert PolicyConfig(**config_of(run)) == PRESETS["small"]
    for report, column in (("base", 0), ("novel", 1)):
        for part in ("successes", "successes at the end"):
            episodes = "".join(list(run[report][part].values())[column].values())
            rate = 100 * episodes.count("1") / len(episodes)
            low, high = wilson_interval(episodes.count("1"), len(episodes))
            assert f"{rate:.1f} % [{100 * low:.1f}, {100 * high:.1f}]" in page, (report, part)


@pytest.mark.parametrize("part", ["told", "swap"])
def test_the_policy_that_ships_was_shown_other_inputs_as_the_queue_shows_them(part):
    report = HELD[SHIPPED][part]
    assert report["provenance"]["seed"] == SEED
    queue = REPORTS[part].command.format(run="assets/ml10-small.pt")
    assert queue.partition(" ")[2] in report["provenance"]["command"]
    for tasks in report["successes"].values():
        assert list(tasks) == TASKS["ml10"]["base"]
        assert {len(episodes) for episodes in tasks.values()} == {plan_of("ml10").episodes}


def test_the_settings_of_a_run_are_those_of_today():
    for name, run in HELD.items():
        if "training" not in run:  # of tests.controls
            continue
        arguments = with_new_names(run["training"]["arguments"])
        assert set(arguments) <= {field.name for field in fields(Settings)}, name
        assert set(config_of(run)) <= {field.name for field in fields(PolicyConfig)}, name


def test_every_older_result_says_how_it_was_measured():
    for name, run in OLD.items():
        suite = TASKS["ml45" if name.startswith("old-ml45") else "ml10"]
        training = run["training"]
        assert {"command", "hardware", "arguments", "config", "minutes"} <= set(training)
        assert np.isfinite(training["minutes"])
        shipped = "-no-inner-loop-cpu-seed" in name  # of a file with another configuration
        eight = "-eight-" in name or name.startswith(("before", "old-ml10-inner-3e-2"))
        for report in (with_new_names(run[part]) for part in run if part != "training"):
            provenance = report["provenance"]
            executed = provenance.get("n_action_steps", training["config"]["n_action_steps"])
            assert shipped or (executed == 8) == eight, name  # what stands side by side looks alike
            assert {"command", "hardware", "seed", "date", "text weights"} <= set(provenance)
            for tasks in report["successes"].values():
                assert set(tasks) <= {*suite["base"], *suite["novel"]}
                assert set("".join(tasks.values())) <= {*"01"}
                assert len({len(episodes) for episodes in tasks.values()}) == 1


def check_training(name, suite, flags):
    """A run was trained on this suite, with these flags, from the seed in its name."""
    training = HELD[name]["training"]
    arguments, config = training["arguments"], training["config"]
    for flag, value in vars(parse(re.sub(r"--data \S+", "", flags).split())).items():
        if value is not None and flag != "resume":
            assert {**arguments, **config}[flag] == value, (name, flag)
    assert arguments["seed"] == int(name[-1]) and arguments["suite"] == suite
    assert {"command", "hardware", "minutes"} <= set(training)


def test_a_column_is_found_by_its_place_by_its_name_and_by_what_stands_behind_the_checkpoint():
    columns = {"r/ema-1": "11", "r/ema-1, zeros": "00", "r/ema-1, no-actions": "01", "before": "10"}
    run = {"novel": {"successes": {name: {"reach": won} for name, won in columns.items()}}}
    for told, won in {0: "11", "zeros": "00", "no-actions": "01", "before": "10"}.items():
        assert measured(run, Column("novel", told)) == {"reach": [c == "1" for c in won]}
    for absent in ("actions", "r/ema", "shuffled"):
        assert measured(run, Column("novel", absent)) is None
    assert measured(run, Column("starts")) is None


def test_the_rows_of_readme_are_rows_of_the_tables():
    assert set(HIDDEN_SUMMARY) <= {title for title, _, _ in HIDDEN_ROWS}


def test_a_report_has_the_columns_that_tables_show_of_it():
    shown = [
        (f"goals-{skill}-{variant}", column)
        for _, variant, column in HIDDEN_ROWS
        for skill in SKILLS
    ]
    shown += [
        (f"pairs-{variant}", Column(report or scene, told, other_task=other_task))
        for _, variant, report, told in UNNAMED_ROWS
        for scene in SCENES
        for other_task in (False, True)
    ]
    shown += [
        (f"convention-reach-{variant}", Column(report or "angles", told))
        for _, variant, report, told in UNNAMED_ROWS
    ]
    shown += [(f"goals-reach-{variant}", column) for variant, column in NUMBERS_OF_GOALS.values()]
    found = 0
    for variant, column in shown:
        for run in runs_of(HELD, variant):
            if column.report in run:
                assert measured(run, column) is not None, (variant, column)
                found += 1
    assert found > 50


def test_runs_of_today_are_those_of_the_queue_and_say_how_they_were_measured():
    suites = "|".join(("ml10", *HIDDEN_SUITES, *UNNAMED_SUITES))
    for name, run in {**ML10, **HIDDEN, **UNNAMED}.items():
        if name.endswith("-controls"):
            continue
        suite, variant = re.fullmatch(rf"({suites})-(.+)-seed\d", name).groups()
        plan = plan_of(suite)
        check_training(name, suite, plan.variants[variant])
        commands = [record.get("provenance", record)["command"] for record in run.values()]
        for command in commands:
            world = re.findall(r"tests\.oracle (\S+)", command)
            assert world == ([variant] if variant in WORLDS else []), (name, command)
        for part in run.keys() - {"training"}:
            report, provenance = plan.reports[part], run[part]["provenance"]
            assert variant in report.variants, (name, part)
            assert {"command", "hardware", "date"} <= set(provenance)
            flags = f"--seed {SEED} --episodes {plan.episodes} {report.command}"
            seed = int(re.findall(r"--seed (\d+)", flags)[-1])  # the last one wins
            episodes = int(re.findall(r"--episodes (\d+)", flags)[-1])
            assert provenance["seed"] == seed, (name, part)
            tasks_of_columns = run[part]["successes"].values()
            for tasks in tasks_of_columns:
                assert {len(digits) for digits in tasks.values()} == {episodes}, (name, part)
                if suite in HIDDEN_SUITES:
                    skill = suite.removeprefix("goals-")
                    assert list(tasks) == names_of(skill, "novel"), (name, part)
                elif suite == "ml10":
                    split = "novel" if "novel" in report.command else "base"
                    assert list(tasks) == TASKS["ml10"][split], (name, part)
    for name in (f"{suite}-controls" for suite in HIDDEN_SUITES):  # without a network
        [report] = HELD[name].values()
        assert report["provenance"]["seed"] == SEED  # of the starts: rows are compared


def test_every_result_is_of_one_of_these_kinds():
    assert set(HELD) == {*OLD, *ML10, *HIDDEN, *UNNAMED, SHIPPED, "rl-ml10-seed0"}


@pytest.mark.parametrize("suite", ["ml10", "ml45", *HIDDEN_SUITES, *UNNAMED_SUITES])
def test_every_command_of_the_queue_parses(suite):
    variants = plan_of(suite).variants
    for variant in variants:
        for job in jobs_of_run(variant, 0, suite=suite, flags="", episodes=5, only=None):
            words = job.command.split()
            if words[0] == "-m":  # behind tests.oracle WORLD
                assert oracle.parse(words[2:]).world == variant
            script, *flags = words[3:] if words[0] == "-m" else words
            importlib.import_module(script.removesuffix(".py")).parse(flags)


def test_the_rows_of_tables_are_of_reports_that_are_made():
    hidden = [(variant, column) for _, variant, column in HIDDEN_ROWS]
    for variant, column in [*hidden, *NUMBERS_OF_GOALS.values()]:
        if variant != "controls":
            assert variant in HIDDEN_REPORTS[column.report].variants, (variant, column)
    for _, variant, report, _ in UNNAMED_ROWS:
        if report is not None:
            assert variant in UNNAMED_REPORTS["convention-reach"][report].variants


def test_the_jobs_of_a_run_end_where_its_training_fails(tmp_path, monkeypatch):
    done = []

    def run(job):
        done.append(job.command)
        return int(job.command == "train fails")

    monkeypatch.setattr(Job, "run", run)
    stopped = threading.Event()
    report = Job("report", tmp_path / "a", tmp_path / "log", measures=tmp_path / "b")
    training = Job("train fails", tmp_path / "c", tmp_path / "log")
    assert run_in_order([training, report], stopped) == 1 and done == ["train fails"]
    training = replace(training, command="train")
    assert run_in_order([training, report], stopped) == 0
    assert done[1:] == ["train", "report"]
    stopped.set()
    assert run_in_order([training, report], stopped) == 0 and len(done) == 3
