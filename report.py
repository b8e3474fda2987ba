"""What is made of results: success rates with their intervals, tables, charts, animations.

85.0 [64.0, 94.8]     17 of 20 episodes, in percent, and Wilson's 95 % interval
82.2 ± 1.9 (3 runs)   the mean of runs of several seeds, and Student's 95 % interval

Nothing here knows a simulator or a policy: results are lists of successes by task, and means of
some of the tasks are asked for by name (`parts`). An episode may be a success at one step and
no longer at the next, so success is counted at any step and at the end.

Letters: T frames, N points.
"""

import json
import math
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np

from common import UserError, format_table, progress_bar, read_json_lines
from data import Demonstrations, positions, write_atomically, write_text

Successes = dict[str, list[bool]]  # task -> one entry an episode
Parts = dict[str, list[str]]  # what a mean is called -> the tasks that it is the mean of
PaperColumns = dict[str, dict[str, float]]  # title -> task -> success rate in percent


@dataclass(frozen=True)
class Outcomes:
    """How the episodes of some tasks went."""

    any_step: Successes  # whether any step of an episode reported success
    at_end: Successes | None  # whether the last one did; None: not measured
    other_task: Successes | None = None  # whether any step did the other task of a pair

    def joined(self, others: "Outcomes") -> "Outcomes":
        """Returns these and those of other tasks together; both have `at_end`."""
        other_task = (self.other_task or {}) | (others.other_task or {})
        return Outcomes(
            any_step=self.any_step | others.any_step,
            at_end=self.at_end | others.at_end,
            other_task=other_task or None,
        )


# ---- Numbers -------------------------------------------------------------------------------------


def wilson_interval(successes: int, episodes: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a success rate, as two fractions."""
    from scipy.stats import binomtest  # takes a second to import

    interval = binomtest(successes, episodes).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


def format_success(successes: int, episodes: int) -> str:
    """`17 of 20` -> `85.0 [64.0, 94.8]`: percent, with Wilson's 95 % interval."""
    low, high = wilson_interval(successes, episodes)
    return f"{100 * successes / episodes:.1f} [{100 * low:.1f}, {100 * high:.1f}]"


def pooled_success(results: Successes) -> str:
    """Success over the episodes of all tasks put together, as `format_success` writes it."""
    episodes = [success for task_episodes in results.values() for success in task_episodes]
    return format_success(sum(episodes), len(episodes))


def mean_success(results: Successes) -> float:
    """The mean of the tasks' success rates, in percent; each task counts alike."""
    return 100 * float(np.mean([np.mean(episodes) for episodes in results.values()]))


def mean_interval(values: Sequence[float]) -> str:
    """The mean over runs with Student's 95 % interval, in the unit of the values."""
    if len(values) == 1:
        return f"{values[0]:.1f} (one run)"
    from scipy.stats import t

    margin = t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / math.sqrt(len(values))
    return f"{np.mean(values):.1f} ± {margin:.1f} ({len(values)} runs)"


# ---- The paper's results -------------------------------------------------------------------------

PAPER_RESULTS = Path(__file__).parent / "assets" / "paper_results.json"
PAPER_NAMES = {  # PolicyConfig.policy, or "rl" of rl.py -> what the paper's tables call it
    "dami": "DAMI",
    "dp3": "DP3",
    "flow": "FlowPolicy",
    "mamba": "Mamba",
    "freq": "FreqPolicy",
    "rl": "Meta-World",
}


def paper_columns(suite: str, policies: Iterable[str]) -> PaperColumns:
    """What the paper reports of some policies on the tasks of a suite.

    Args:
        suite: "ml10" or "ml45"; of others the paper says nothing about single tasks.
        policies: keys of PAPER_NAMES; others, which the paper does not have, are skipped.

    Returns:
        "paper, DAMI" -> task -> success rate in percent, for base and novel tasks. The policies
        that are no DAMI were trained without MAML there.
    """
    tables = json.loads(PAPER_RESULTS.read_text()).get(suite)
    if tables is None:
        return {}
    rows = {**tables["base"], **tables["novel"]}  # task -> the paper's name of a policy -> percent
    columns = {}
    for policy in policies:
        if policy in PAPER_NAMES:
            name = PAPER_NAMES[policy]
            columns[f"paper, {name}"] = {task: row[name] for task, row in rows.items()}
    return columns


# ---- Tables --------------------------------------------------------------------------------------


def success_table(
    columns: dict[str, Successes],
    parts: Parts | None = None,
    paper: PaperColumns | None = None,
    first_title: str = "task",
) -> str:
    """A Markdown table: a row for each task, and one for the mean of each part.

    Args:
        columns: title -> results; all of them of the same tasks.
        parts: see `Parts`; by default there is one mean, that of all tasks. A single task has none.
        paper: more columns, see `paper_columns`; those that have none of the tasks are left out.
        first_title: that of the column that names the rows.
    """
    tasks = list(next(iter(columns.values())))
    if parts is None:
        parts = {"mean": tasks}
    paper = with_any_of(tasks, paper or {})

    def row(title: str, row_tasks: Sequence[str]) -> list[str]:
        cells = [title]
        for results in columns.values():
            cells.append(pooled_success({task: results[task] for task in row_tasks}))
        for rates in paper.values():
            known = [rates[task] for task in row_tasks if task in rates]
            cells.append(f"{np.mean(known):.1f}" if len(known) == len(row_tasks) else "")
        return cells

    rows = [[first_title, *columns, *paper]]
    rows += [row(task, [task]) for task in tasks]
    if len(tasks) > 1:
        rows += [row(f"**{name}**", part_tasks) for name, part_tasks in parts.items()]
    return format_table(rows)


def with_any_of(tasks: Sequence[str], paper: PaperColumns) -> PaperColumns:
    """Those of the paper's columns that have at least one of the tasks."""
    return {title: rates for title, rates in paper.items() if any(task in rates for task in tasks)}


def heldout_table(columns: dict[str, dict[str, float]]) -> str:
    """A Markdown table of action errors on held-out episodes: a row for each task, and the mean.

    `columns` are title -> task -> error, the mean over the numbers of an action.
    """
    tasks = list(next(iter(columns.values())))  # all columns have the same
    rows = [["held-out action error", *columns]]
    for task in tasks:
        rows.append([task, *(f"{errors[task]:.4f}" for errors in columns.values())])
    if len(tasks) > 1:
        means = [np.mean([errors[task] for task in tasks]) for errors in columns.values()]
        rows.append(["**mean**", *(f"{mean:.4f}" for mean in means)])
    return format_table(rows)


def action_error_table(rows: dict[str, Sequence[float]], names: Sequence[str]) -> str:
    """A Markdown table of action errors on held-out episodes: a column for each number, and all.

    Args:
        rows: title -> the errors of the numbers of an action, A of them.
        names: what these numbers are called, A of them.
    """
    table = [["held-out action error", *names, "mean"]]
    for title, errors in rows.items():
        table.append([title, *(f"{error:.4f}" for error in (*errors, np.mean(errors)))])
    return format_table(table)


HELDOUT_NOTE = "Mean absolute error of each number of an action, in its own unit."


def write_report(
    folder: Path,
    outcomes: dict[str, Outcomes],
    provenance: dict[str, Any],
    *,
    parts: Parts | None = None,
    paper: PaperColumns | None = None,
    checkpoints: dict[str, Outcomes] | None = None,
    pooled: bool = False,
) -> str:
    """Writes success.json, success.md and success.png to a folder, and returns the table.

    Args:
        folder: it is made if it does not exist.
        outcomes: label -> results; each makes a column of successes at any step, one of those at
            the end if they were measured, and one of those at the other task if tasks are pairs.
        parts, paper: see `success_table`.
        provenance: how the results were measured, name -> value; "title" is the chart's.
        checkpoints: label -> results of all checkpoints, also of those that `outcomes` leaves out.
            They are written into success.json, and stand in no table.
        pooled: the episodes of all tasks are put together; table and chart then have one row for
            each label.
    """
    any_step = {label: o.any_step for label, o in outcomes.items()}
    at_end = {label: o.at_end for label, o in outcomes.items() if o.at_end is not None}
    other_task = {label: o.other_task for label, o in outcomes.items() if o.other_task is not None}
    if pooled:
        kinds = {"any step": any_step, "at the end": at_end, "the other task": other_task}
        columns = {kind: pool_tasks(of_kind) for kind, of_kind in kinds.items() if of_kind}
        table = success_table(columns, parts={}, first_title="success, percent")
    else:
        columns = dict(any_step)
        for label, successes in at_end.items():
            columns[f"{label}, at the end"] = successes
        for label, successes in other_task.items():
            columns[f"{label}, the other task"] = successes
        table = success_table(columns, parts, paper)
    report = {"provenance": provenance, "successes": any_step, "successes at the end": at_end}
    if other_task:
        report["successes at the other task"] = other_task
    if checkpoints:
        report["checkpoints"] = {label: outcome.any_step for label, outcome in checkpoints.items()}
    note = ", ".join(f"{name} {value}" for name, value in provenance.items())
    measured = "at any step, or at the end" if at_end else "at any step"
    if other_task:
        measured += ", or, at any step, at the other task of the pair"

    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "success.json", json.dumps(report, indent=1))
    write_text(
        folder / "success.md",
        f"{table}\n\nPercent of the episodes that were a success {measured}, with Wilson's 95 % "
        f"interval. {note}.\n",
    )
    plot_success(columns, folder / "success.png", provenance.get("title", "Success"), paper)
    return table


def pool_tasks(results: dict[str, Successes]) -> Successes:
    """Label -> the episodes of all its tasks, one after the other."""
    return {
        label: [success for episodes in successes.values() for success in episodes]
        for label, successes in results.items()
    }


def read_outcomes(folder: Path) -> dict[str, Outcomes]:
    """The results that `write_report` wrote to a folder: label -> outcomes."""
    written = json.loads((folder / "success.json").read_text())
    at_end = written["successes at the end"]
    other_task = written.get("successes at the other task", {})
    return {
        label: Outcomes(any_step, at_end.get(label), other_task.get(label))
        for label, any_step in written["successes"].items()
    }


# ---- Charts --------------------------------------------------------------------------------------


def plot_success(
    columns: dict[str, Successes],
    path: Path,
    title: str,
    paper: PaperColumns | None = None,
    parts: dict[str, Sequence[str]] | None = None,
) -> None:
    """Writes a bar chart of success with Wilson intervals, a group of bars for each task.

    Arguments as of `success_table`; `path` is that of a PNG. Parts, whose tasks stand side by side,
    have their names above them and a line between them.
    """
    from matplotlib.figure import Figure  # takes a second to import

    tasks = list(next(iter(columns.values())))
    paper = with_any_of(tasks, paper or {})
    n_bars = len(columns) + len(paper)
    places = np.arange(len(tasks))
    width = 0.8 / n_bars
    figure = Figure(figsize=(max(4.5, 2 + 0.9 * len(tasks)), 3.6), layout="constrained")
    axes = figure.subplots()

    for i, (label, results) in enumerate(columns.items()):
        rates = np.array([np.mean(results[task]) for task in tasks])
        bounds = [wilson_interval(sum(results[task]), len(results[task])) for task in tasks]
        axes.bar(
            places + i * width,
            100 * rates,
            width,
            yerr=100 * np.abs(np.array(bounds).T - rates),  # (2, tasks)
            label=label,
            capsize=2,
            error_kw={"linewidth": 0.8},
        )
    for i, (label, rates) in enumerate(paper.items(), start=len(columns)):
        gray = 0.8 - 0.15 * (i - len(columns))
        heights = [rates.get(task, math.nan) for task in tasks]  # no bar where it has none
        axes.bar(places + i * width, heights, width, color=str(gray), label=label)

    middles = places + width * (n_bars - 1) / 2
    for name, of_part in (parts or {}).items():
        first, last = tasks.index(of_part[0]), tasks.index(of_part[-1])
        axes.text((middles[first] + middles[last]) / 2, 104, name, ha="center", fontsize=9)
        if first > 0:
            axes.axvline(middles[first] - 0.5, color="black", linestyle=":", linewidth=1)

    axes.set_xticks(middles, tasks, rotation=30, ha="right")
    axes.set(ylabel="success, %", ylim=(0, 112 if parts else 105), title=title)
    axes.spines[["top", "right"]].set_visible(False)
    # As many columns as fit: a letter takes 0.07 inches.
    longest = max(len(label) for label in (*columns, *paper))
    ncols = max(1, int(figure.get_figwidth() / (0.07 * longest + 0.6)))
    figure.legend(frameon=False, ncols=ncols, loc="outside upper center", fontsize=8)
    save_png(figure, path, dpi=120)


def plot_curves(folder: Path) -> None:
    """Writes curves.png of a run from its metrics.jsonl.

    It shows the training loss of each step and its running mean; on the right axis the success
    measured during training, or the action error on held-out episodes where there is no success.
    """
    from matplotlib.figure import Figure

    metrics = read_json_lines(folder / "metrics.jsonl")
    steps = np.array([line["step"] for line in metrics if "loss" in line])
    losses = np.array([line["loss"] for line in metrics if "loss" in line])
    successes = [(line["step"], line["success"]) for line in metrics if "success" in line]
    errors = [(line["step"], line["action_error"]) for line in metrics if "action_error" in line]

    figure = Figure(figsize=(7, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.plot(steps, losses, color="C0", alpha=0.3, linewidth=0.8, label="training loss")
    width = max(1, len(losses) // 50)
    mean = np.convolve(losses, np.ones(width) / width, mode="valid")
    axes.plot(steps[width - 1 :], mean, color="C0", label=f"mean of {width} steps")
    axes.set(xlabel="outer step", ylabel="loss (actions in [-1, 1])", yscale="log")
    axes.spines["top"].set_visible(False)

    handles = axes.get_lines()
    if successes or errors:
        right = axes.twinx()
        right.spines["top"].set_visible(False)
        if successes:
            handles += right.plot(*zip(*successes), "o-", color="C1", label="success (right)")
            right.set(ylabel="mean success, %", ylim=(0, 100))
        else:
            handles += right.plot(*zip(*errors), "o-", color="C1", label="action error (right)")
            right.set_ylabel("held-out action error")
            right.set_ylim(bottom=0)
    axes.legend(handles=handles, frameon=False)
    save_png(figure, folder / "curves.png", dpi=120)


def save_png(figure: Any, path: str | Path, dpi: int) -> None:
    """Writes a figure of Matplotlib, whole or not at all."""
    write_atomically(path, lambda temporary: figure.savefig(temporary, dpi=dpi, format="png"))


# ---- Pictures of recordings ----------------------------------------------------------------------


def plot_demonstration(
    demonstrations: Demonstrations, path: str | Path, episode: int = 0, columns: int = 6
) -> None:
    """Writes a picture of one episode: its clouds along time, and its actions.

    Points with three features, none below 0, are drawn in that color; all others are colored by
    their height. Positions in the state (hand and fingers) are red dots. The boxes
    `workspace` and `tcp_box` are drawn where the recording's meta has them.

    Args:
        demonstrations: a recording.
        path: of a PNG.
        episode: which of its episodes.
        columns: how many clouds are drawn, from the first frame to the last.
    """
    from matplotlib.figure import Figure

    frames = demonstrations.episode(episode)
    meta = demonstrations.meta
    clouds = positions(demonstrations.points[frames]).astype(np.float32)  # (T, N, 3)
    features = demonstrations.points[frames, :, 3:].astype(np.float32)  # (T, N, P - 3)
    have_color = features.shape[2] == 3 and features.min() >= 0
    n_positions = meta.get("positions_in_state", 0)
    state_positions = demonstrations.state[frames, : 3 * n_positions]
    state_positions = state_positions.reshape(len(clouds), n_positions, 3)  # (T, positions, 3)
    boxes = {
        name: np.array(meta[name])
        for name in ("workspace", "tcp_box")
        if meta.get(name) is not None
    }
    low, high = bounding_box([clouds, state_positions, *boxes.values()])

    columns = min(columns, len(clouds))
    if columns > 1:
        figure = Figure(figsize=(max(2.6 * columns, 8), 6), layout="constrained")
        grid = figure.add_gridspec(2, columns, height_ratios=(1.5, 1))
    else:
        figure = Figure(figsize=(8, 9), layout="constrained")
        grid = figure.add_gridspec(2, 1, height_ratios=(5, 1))

    picked_frames = np.linspace(0, len(clouds) - 1, columns).round().astype(int)
    for column, t in enumerate(picked_frames):
        axes = figure.add_subplot(grid[0, column], projection="3d", computed_zorder=False)
        if have_color:
            axes.scatter(*clouds[t].T, c=features[t], s=2)
        else:
            height = clouds[t, :, 2]
            axes.scatter(*clouds[t].T, c=height, vmin=low[2], vmax=high[2], cmap="viridis", s=2)
        axes.scatter(*state_positions[t].T, c="red", s=14)
        plot_box(axes, boxes.get("workspace"), color="black")
        plot_box(axes, boxes.get("tcp_box"), color="red")
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        axes.set_title(f"frame {t}")
        axes.set_box_aspect(high - low, zoom=1.3 if columns > 1 else 1)
        axes.view_init(35, -30)
        axes.tick_params(labelsize=5, pad=-3)

    axes = figure.add_subplot(grid[1, :])
    for index, values in enumerate(demonstrations.action[frames].T):
        axes.plot(values, marker=".", label=f"action {index}")
    axes.set(xlabel="frame", ylabel="action")
    axes.legend(loc="upper right", ncols=4)
    title = f"{demonstrations.task}, episode {episode}: {demonstrations.instruction}"
    # Matplotlib would typeset a formula between dollars.
    figure.suptitle(title.replace("$", r"\$"), wrap=True)
    save_png(figure, path, dpi=110)


def bounding_box(arrays: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The corners (3,) and (3,) of the box that arrays (..., 3) fill.

    Each side is at least a tenth of the longest one, and at least 0.1 mm long, so that a plane and
    a single point can be drawn, too.
    """
    points = np.concatenate([array.reshape(-1, 3) for array in arrays])
    low, high = points.min(axis=0), points.max(axis=0)
    longest = max((high - low).max(), 1e-3)
    half = np.maximum(high - low, 0.1 * longest) / 2
    middle = (low + high) / 2
    return middle - half, middle + half


def plot_box(axes: Any, corners: np.ndarray | None, color: str) -> None:
    """Draws the twelve edges of a box that is given by two corners (2, 3); None: there is none."""
    if corners is None:
        return
    vertices = product(*corners.T)  # 8 of them
    for a, b in combinations(vertices, 2):
        if np.equal(a, b).sum() == 2:  # they differ along one axis: an edge
            axes.plot(*zip(a, b), color=color, lw=0.5)


# ---- Animations of rollouts ----------------------------------------------------------------------

FPS = 30


@dataclass(frozen=True)
class Frame:
    """A moment of a rollout, as an animation shows it."""

    step: int
    success: bool  # whether the step before it reported success
    picture: np.ndarray  # (240, 240, 3) uint8
    cloud: np.ndarray  # (N, 3), metres


def animate(films: dict[str, Sequence[Frame]], writer: Any, path: str | Path) -> None:
    """Writes films, task -> frames, as an animation, with a writer of Matplotlib.

    There is a row for each film, whose title says which of its frames are a success. The last frame
    stays a while.
    """
    from matplotlib.animation import FuncAnimation
    from matplotlib.figure import Figure

    low, high = bounding_box([frame.cloud for frames in films.values() for frame in frames])
    figure = Figure(figsize=(6, 3 * len(films)), layout="constrained")
    rows = []
    for row in range(len(films)):
        picture = figure.add_subplot(len(films), 2, 2 * row + 1)
        cloud = figure.add_subplot(len(films), 2, 2 * row + 2, projection="3d")
        rows.append((picture, cloud))

    def show(index: int) -> None:
        for (task, frames), (left, right) in zip(films.items(), rows):
            frame = frames[min(index, len(frames) - 1)]
            left.clear()
            left.imshow(frame.picture)
            left.set_axis_off()
            left.set_title(f"{task}: success" if frame.success else task, fontsize=9)

            right.clear()
            height = frame.cloud[:, 2]
            right.scatter(*frame.cloud.T, c=height, vmin=low[2], vmax=high[2], cmap="viridis", s=9)
            right.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
            right.set(xticklabels=[], yticklabels=[], zticklabels=[])
            right.set_box_aspect(high - low)
            right.view_init(elev=25, azim=-30)
            right.set_title(f"{len(frame.cloud)} points, step {frame.step}", fontsize=9)

    num_pictures = max(len(frames) for frames in films.values()) + 10
    animation = FuncAnimation(figure, show, frames=num_pictures)

    def save(temporary: Path) -> None:
        with progress_bar(desc="drawing", unit="frame", total=num_pictures) as progress:
            animation.save(
                temporary,
                writer=writer,
                dpi=70,
                progress_callback=lambda index, total: progress.update(),
            )

    write_atomically(path, save)


def movie_writer(path: str | Path) -> Any:
    """Matplotlib's writer of a .gif, or of an .mp4 where there is ffmpeg or imageio-ffmpeg.

    Raises UserError for a file of another kind, one of no folder, or where there is neither.
    """
    import matplotlib
    from matplotlib.animation import FFMpegWriter, PillowWriter

    path = Path(path)
    if not path.resolve().parent.is_dir():
        raise UserError(f"cannot write {path}: there is no such folder")
    if path.suffix == ".gif":
        return PillowWriter(fps=FPS)
    if path.suffix != ".mp4":
        raise UserError(f"cannot write {path}: name it .gif or .mp4")
    with suppress(ImportError):
        import imageio_ffmpeg

        matplotlib.rcParams["animation.ffmpeg_path"] = imageio_ffmpeg.get_ffmpeg_exe()
    if not FFMpegWriter.isAvailable():
        raise UserError(
            f"cannot write {path}: install ffmpeg or `pip install imageio-ffmpeg`, or name it .gif"
        )
    return FFMpegWriter(fps=FPS)
