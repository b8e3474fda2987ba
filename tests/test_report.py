"""Tests of report.py: figures, tables, the paper's columns, charts, pictures of recordings."""

import json
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

import report
from data import Demonstrations

# ---- Numbers -------------------------------------------------------------------------------------


def test_success_is_written_in_percent_with_its_interval():
    assert report.format_success(17, 20) == "85.0 [64.0, 94.8]"
    assert report.format_success(0, 20) == "0.0 [0.0, 16.1]"
    assert report.mean_success({"a": [True, False], "b": [True, True, True]}) == 75.0


def test_the_mean_over_runs_has_students_interval():
    assert report.mean_interval([50.0]) == "50.0 (one run)"
    # 4.303 * 10 / sqrt(3)
    assert report.mean_interval([40.0, 50.0, 60.0]) == "50.0 ± 24.8 (3 runs)"


# ---- Tables --------------------------------------------------------------------------------------


def rows_of(table):
    """The cells of a Markdown table, without the line below its head."""
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()]
    return [rows[0], *rows[2:]]


def test_a_table_has_a_row_for_each_task_and_the_mean_and_is_aligned():
    successes = {"reach": [True, False], "drawer-close": [True, True]}
    table = report.success_table({"ours": successes})
    assert rows_of(table) == [
        ["task", "ours"],
        ["reach", report.format_success(1, 2)],
        ["drawer-close", report.format_success(2, 2)],
        ["**mean**", report.format_success(3, 4)],
    ]
    assert len({len(line) for line in table.splitlines()}) == 1
    assert "mean" not in report.success_table({"ours": {"reach": [True]}})


def test_each_part_of_the_tasks_has_a_mean_of_its_own():
    successes = {"a": [True], "b": [True], "c": [False]}
    parts = {"mean of base": ["a", "b"], "mean of novel": ["c"]}
    rows = rows_of(report.success_table({"ours": successes}, parts))
    assert [row[0] for row in rows[4:]] == ["**mean of base**", "**mean of novel**"]
    assert [row[1].split()[0] for row in rows[4:]] == ["100.0", "0.0"]


def test_a_policy_stands_beside_what_the_paper_reports_of_that_policy():
    dp3 = report.paper_columns("ml10", ["dp3"])
    assert list(dp3) == ["paper, DP3"]
    assert dp3["paper, DP3"]["reach"] == 54.67  # of a base task
    assert dp3["paper, DP3"]["door-close"] == 100  # of a novel one
    both = report.paper_columns("ml10", ["dami", "flow"])
    assert {title: rates["reach"] for title, rates in both.items()} == {
        "paper, DAMI": 58.67,
        "paper, FlowPolicy": 27.33,
    }
    assert report.paper_columns("ml10", ["mine"]) == report.paper_columns("own", ["dami"]) == {}


def test_the_papers_columns_are_left_out_where_it_reports_nothing():
    paper = {"paper, DAMI": {"a": 50.0, "b": 20.0}, "paper, DP3": {"c": 1.0}}
    rows = rows_of(report.success_table({"x": {"a": [True], "b": [True]}}, None, paper))
    assert rows[0] == ["task", "x", "paper, DAMI"]
    assert [row[2] for row in rows[1:]] == ["50.0", "20.0", "35.0"]
    rows = rows_of(report.success_table({"x": {"a": [True], "d": [True]}}, None, paper))
    assert [row[2] for row in rows[1:]] == ["50.0", "", ""]  # nor is half a mean given
    assert rows_of(report.success_table({"x": {"d": [True]}}, None, paper))[0] == ["task", "x"]


def test_held_out_errors_have_a_row_for_each_task_and_the_mean():
    columns = {"step 0": {"a": 0.5, "b": 0.25}, "step 9": {"a": 0.125, "b": 0.0}}
    assert rows_of(report.heldout_table(columns)) == [
        ["held-out action error", "step 0", "step 9"],
        ["a", "0.5000", "0.1250"],
        ["b", "0.2500", "0.0000"],
        ["**mean**", "0.3750", "0.0625"],
    ]
    assert len(rows_of(report.heldout_table({"step 0": {"a": 0.5}}))) == 2


def test_a_report_is_a_table_a_chart_and_every_episode_with_its_provenance(tmp_path):
    any_step, at_end = {"reach": [True, True]}, {"reach": [True, False]}
    earlier = {"reach": [False, False]}
    table = report.write_report(
        tmp_path / "report",
        {"run/ema": report.Outcomes(any_step, at_end), "stopped": report.Outcomes(earlier, None)},
        {"title": "A title", "seed": 7},
        paper=report.paper_columns("ml10", ["dami"]),
        checkpoints={"run/ema-1": report.Outcomes(earlier, None)},
    )
    titles = ["task", "run/ema", "stopped", "run/ema, at the end", "paper, DAMI"]
    assert [cell.strip() for cell in table.splitlines()[0].strip("|").split("|")] == titles
    written = json.loads((tmp_path / "report" / "success.json").read_text())
    assert written == {
        "provenance": {"title": "A title", "seed": 7},
        "successes": {"run/ema": any_step, "stopped": earlier},
        "successes at the end": {"run/ema": at_end},
        "checkpoints": {"run/ema-1": earlier},
    }
    text = (tmp_path / "report" / "success.md").read_text()
    assert text.startswith(table) and "58.7" in table and "title A title, seed 7." in text
    assert (tmp_path / "report" / "success.png").read_bytes().startswith(b"\x89PNG")


def test_outcomes_of_some_tasks_are_joined_to_those_of_others_all_three_kinds():
    one = report.Outcomes({"open": [True]}, {"open": [False]}, {"open": [True]})
    other = report.Outcomes({"close": [False]}, {"close": [False]}, {"close": [False]})
    both = report.Outcomes({}, {}).joined(one).joined(other)
    assert both.any_step == {"open": [True], "close": [False]}
    assert both.at_end == {"open": [False], "close": [False]}
    assert both.other_task == {"open": [True], "close": [False]}
    alone = report.Outcomes({"reach": [True]}, {"reach": [True]})
    assert report.Outcomes({}, {}).joined(alone) == alone  # None: no pairs


# ---- Charts and pictures -------------------------------------------------------------------------


@pytest.fixture
def figures(monkeypatch):
    """The figures that are saved, in order."""
    saved = []
    monkeypatch.setattr(report, "save_png", lambda figure, path, dpi: saved.append(figure))
    return saved


def test_a_chart_has_a_bar_for_each_column_and_task_with_its_interval(figures, tmp_path):
    columns = {"x": {"a": [True, False], "b": [True, True]}, "y": {"a": [True], "b": [False]}}
    paper = {"paper, DAMI": {"a": 30.0}, "paper, DP3": {"c": 1.0}}
    report.plot_success(columns, tmp_path / "x.png", "A title", paper)
    [axes] = figures[0].axes
    heights = [bar.get_height() for bar in axes.patches]
    assert heights[:5] == pytest.approx([50, 100, 100, 0, 30])
    assert len(heights) == 6 and np.isnan(heights[5])  # the paper has no number for it
    ends = axes.collections[0].get_segments()[0][:, 1]  # the first error bar
    assert ends == pytest.approx(100 * np.array(report.wilson_interval(1, 2)))
    assert axes.get_title() == "A title"
    assert [text.get_text() for text in axes.get_xticklabels()] == ["a", "b"]
    lefts = [bar.get_x() for bar in axes.patches]
    assert len({round(left, 3) for left in lefts}) == len(lefts)  # side by side


@pytest.mark.parametrize("number", [2, 6])
def test_the_legend_of_a_chart_of_one_task_is_whole(number, figures, tmp_path):
    columns = {f"goals-reach-small-seed0/ema-01500, {i}": {"a": [True]} for i in range(number)}
    report.plot_success(columns, tmp_path / "x.png", "A title", {"paper, DAMI": {"a": 30.0}})
    canvas = FigureCanvasAgg(figures[0])
    canvas.draw()
    legend = figures[0].legends[0].get_window_extent(canvas.get_renderer())
    assert legend.x0 >= 0 and legend.x1 <= figures[0].bbox.x1 and legend.y1 <= figures[0].bbox.y1


def test_parts_of_a_chart_have_names_and_a_line_between_them(figures, tmp_path):
    columns = {"x": {"a": [True], "b": [False], "c": [True]}}
    parts = {"first": ["a", "b"], "second": ["c"]}
    report.plot_success(columns, tmp_path / "x.png", "A title", parts=parts)
    [axes] = figures[0].axes
    assert [(text.get_text(), text.get_position()[0]) for text in axes.texts] == [
        ("first", pytest.approx(0.5)),
        ("second", pytest.approx(2)),
    ]
    [line] = [line for line in axes.get_lines() if line.get_linestyle() == ":"]
    assert list(line.get_xdata()) == pytest.approx([1.5, 1.5])


def write_metrics(folder, measured):
    """20 steps whose loss falls from 2 to 0.1, and lines of what was measured."""
    lines = [{"step": step, "loss": 2.1 - 0.1 * step} for step in range(1, 21)] + measured
    text = "".join(json.dumps(line) + "\n" for line in lines)
    (folder / "metrics.jsonl").write_text(text + '{"step": 21, "lo')  # killed while it wrote


@pytest.mark.parametrize(
    "measured, label",
    [
        ([], None),
        ([{"step": 10, "success": 20.0}, {"step": 20, "success": 60.0}], "success"),
        ([{"step": 10, "action_error": 20.0}, {"step": 20, "action_error": 60.0}], "action error"),
        ([{"step": 20, "success": 60.0}, {"step": 20, "action_error": 0.1}], "success"),
    ],
)
def test_curves_show_the_loss_and_what_was_measured(figures, tmp_path, measured, label):
    write_metrics(tmp_path, measured)
    report.plot_curves(tmp_path)
    left, *right = figures[0].axes
    loss, mean = left.get_lines()
    assert loss.get_xdata().tolist() == list(range(1, 21)) and mean.get_ydata()[-1] <= 0.15
    names = [text.get_text() for text in left.get_legend().get_texts()]
    assert names[0] == "training loss" and len(names) == 2 + bool(label)
    if label:
        [line] = right[0].get_lines()
        assert names[2] == f"{label} (right)" and line.get_ydata()[-1] == 60
    else:
        assert right == []


def recording(points, **meta):
    """One episode of as many frames as points (T, N, P) has."""
    T = len(points)
    state = np.tile(np.float32([[0.5, 0.5, 0.5]]), (T, 1))
    action = np.linspace(-1, 1, T, dtype=np.float32)[:, None].repeat(4, axis=1)
    return Demonstrations(
        task="stir",
        instruction="Stir for $5.",
        points=points.astype(np.float16),
        state=state,
        action=action,
        episode_ends=np.array([T]),
        meta=meta,
    )


def test_a_recording_is_drawn_as_clouds_along_time_and_its_actions(figures, tmp_path):
    points = np.random.default_rng(0).uniform(-0.2, 0.2, size=(30, 32, 3))
    box = [[-0.3, -0.3, -0.3], [0.6, 0.6, 0.6]]
    shown = recording(points, positions_in_state=1, workspace=box)
    report.plot_demonstration(shown, tmp_path / "x.png", columns=4)
    *clouds, actions = figures[0].axes
    assert [axes.get_title() for axes in clouds] == ["frame 0", "frame 10", "frame 19", "frame 29"]
    seen, hand = clouds[1].collections[:2]
    np.testing.assert_allclose(np.stack(seen._offsets3d, axis=1), shown.points[10])
    np.testing.assert_allclose(np.stack(hand._offsets3d, axis=1), [[0.5, 0.5, 0.5]])
    assert len(clouds[0].lines) == 12  # the edges of the box
    assert clouds[0].get_xlim() == pytest.approx((-0.3, 0.6))
    assert len(actions.lines) == 4 and len(actions.lines[0].get_ydata()) == 30
    assert figures[0].get_suptitle() == r"stir, episode 0: Stir for \$5."


def drawn_colors(figure):
    """The colors of the first cloud's points, without their opacity."""
    seen = figure.axes[0].collections[0]
    return {tuple(color) for color in np.round(seen.get_facecolors()[:, :3], 2)}


def test_points_are_drawn_where_they_are_in_their_colors_or_in_that_of_their_height(
    figures, tmp_path
):
    points = np.random.default_rng(0).uniform(0, 0.2, size=(5, 32, 3))
    features = np.random.default_rng(1).integers(0, 11, size=(5, 32, 3)) / 10
    for more in (features, features[:, :, :2], -features):
        shown = recording(np.concatenate([points, more], axis=2))
        report.plot_demonstration(shown, tmp_path / "x.png", columns=2)
    report.plot_demonstration(recording(points), tmp_path / "x.png", columns=2)
    colored, *others, plain = figures
    drawn = drawn_colors(colored)  # Matplotlib leaves out a point at the very edge
    assert len(drawn) > 28 and drawn <= {tuple(color) for color in features[0]}
    assert all(drawn_colors(figure) == drawn_colors(plain) for figure in others)
    places = [np.stack(f.axes[0].collections[0]._offsets3d, axis=1) for f in figures]
    assert all(np.array_equal(place, places[0]) for place in places)


def test_a_single_frame_of_a_plane_or_a_point_is_drawn_too(tmp_path):
    plane = np.random.default_rng(0).uniform(0, 0.2, size=(1, 32, 3))
    plane[..., 2] = 0.1
    for i, points in enumerate([plane, np.ones((1, 4, 3))]):
        shown = replace(recording(points), action=np.zeros((1, 7), np.float32))
        report.plot_demonstration(shown, tmp_path / f"{i}.png")
        assert (tmp_path / f"{i}.png").read_bytes().startswith(b"\x89PNG")
