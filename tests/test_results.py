"""What the README claims is what RESULTS.json holds."""

import json
import re

import numpy as np
import pytest

from evaluate import wilson_interval
from tests.results import ABLATIONS, BASE, NOVEL, NOVEL_COLUMNS, RESULTS, ROOT, fill, successes

PAGE = (ROOT / "RESULTS.md").read_text()


@pytest.mark.parametrize("name, tables", [("README.md", 1), ("RESULTS.md", 3)])
def test_the_tables_are_those_of_the_results(name, tables):
    text, results = (ROOT / name).read_text(), json.loads(RESULTS.read_text())
    assert text.count("<!-- results: ") == tables and fill(text, results) == text


def test_a_cell_of_the_base_table_can_be_recomputed_from_the_episodes():
    reports = json.loads(RESULTS.read_text())["evaluations"]
    runs = reports["seeds"]["successes"] | reports["seed2"]["successes"]
    assert len(runs) == 3 and all(set(run) == {*BASE, *NOVEL} for run in runs.values())
    episodes = "".join(run["reach"] for run in runs.values())
    low, high = wilson_interval(episodes.count("1"), len(episodes))
    row = re.search(r"^\| reach \| ([\d.]+) \[([\d.]+), ([\d.]+)\]", PAGE, re.M)
    expected = (episodes.count("1") / len(episodes), low, high)
    assert [float(x) for x in row.groups()] == pytest.approx([100 * x for x in expected], abs=0.051)


def test_the_row_of_the_best_five_checkpoints_can_be_recomputed_from_the_episodes():
    reports = json.loads(RESULTS.read_text())["evaluations"]
    best = []
    for seed in range(3):
        checkpoints = reports[f"top5-{seed}"]["checkpoints"]
        means = sorted(
            np.mean([e.count("1") / len(e) for e in run.values()]) for run in checkpoints.values()
        )
        assert len(means) == 10 and all(set(run) == set(BASE) for run in checkpoints.values())
        best.append(100 * sum(means[5:]) / 5)
    row = re.search(r"^\| mean, best 5 checkpoints \| ([\d.]+) ", PAGE, re.M)
    assert float(row[1]) == pytest.approx(sum(best) / 3, abs=0.051)


def test_rows_and_columns_are_of_the_runs_that_they_name():
    results = json.loads(RESULTS.read_text())
    for title, reports in ABLATIONS:
        runs = [results["trainings"][label.split("/")[0]] for label in successes(results, reports)]
        flags = re.findall(r"`(--.*?)`", title)
        variants = flags or ["--maml", "--demo-encoder", "--tcfm", "--inner-lr"]
        assert all((flag in run["command"]) == bool(flags) for run in runs for flag in variants), (
            title
        )
        assert [run["arguments"]["seed"] for run in runs] == list(range(len(runs)))
        assert all(
            results["evaluations"][report]["facts"]["adaptation steps"] == 200 for report in reports
        )
    for title, reports in NOVEL_COLUMNS.items():
        steps = {results["evaluations"][report]["facts"]["adaptation steps"] for report in reports}
        assert steps == {1000 if "1000" in title else 200}


def test_every_result_says_how_it_was_measured():
    results = json.loads(RESULTS.read_text())
    for report in results["evaluations"].values():
        assert {"command", "hardware", "seed", "date", "text weights"} <= set(report["facts"])
        for label, run in report["successes"].items():
            assert label.split("/")[0] in {*results["trainings"], "assets"} and all(
                set(e) <= {"0", "1"} for e in run.values()
            )
            assert len({len(episodes) for episodes in run.values()}) == 1
    for training in results["trainings"].values():
        assert {"command", "hardware", "arguments", "minutes"} <= set(training) and np.isfinite(
            training["minutes"]
        )
