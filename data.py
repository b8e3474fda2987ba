"""Demonstrations: their files, what looks wrong in them, windows that are trained on, augmentation.

This file knows no simulator and no robot: simulator.py, robot.py or a script of your own make the
recordings. A file is checked when it is written and when it is read. `WindowSampler` holds a
recording as tensors, and its `batch` draws what `DAMIPolicy.loss` takes beside the instruction and
the noise. Nothing of the project is imported.

Letters: W windows, T demonstration frames, F stored frames, N points, P numbers a point (x, y, z
and features), E episodes, H horizon (16 by default), To observation steps (2), Ta executed actions
(8), A action dim, S state dim, M points of a cloud before sampling.
"""

import json
import math
import os
import re
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import fpsample
import numpy as np
import torch
from torch import Tensor


class RecordingError(ValueError):
    """A recording is damaged, inconsistent or foreign, or does not fit what is asked of it."""


# ---- Point clouds --------------------------------------------------------------------------------


def positions(points: Any) -> Any:
    """Returns the positions (..., 3) of points (..., P), an array or a tensor.

    The first three numbers of a point are its position in metres. Any others are its features, such
    as a colour from 0 to 1. Features do not count for distances, and nothing moves or scales them.
    """
    return points[..., :3]


def farthest_point_sample(points: np.ndarray, n: int) -> np.ndarray:
    """Samples n of the points (M, P) float32 so that they lie far from one another.

    It starts with the first point, and then always adds the one that is farthest from all that were
    chosen so far. Distances are those of the positions; a point keeps its features. Returns (n, P)
    float32 in the order of selection, so that the first k of the n are themselves such a sample of
    k. The same cloud always gives the same sample. With M < n the sample is repeated from its
    beginning. Raises ValueError for an empty cloud.
    """
    if len(points) == 0:
        raise ValueError("the cloud is empty: nothing was seen inside the workspace")
    xyz = positions(points)  # (M, 3)
    count = min(n, len(points))
    if len(points) < 8:  # too few for a tree of 2**3 buckets
        order = fpsample.fps_sampling(xyz, count, start_idx=0)
    else:
        order = fpsample.bucket_fps_kdline_sampling(xyz, count, h=3, start_idx=0)
    return points[np.resize(order.astype(np.int64), n)]  # (n, P)


# ---- Recordings ----------------------------------------------------------------------------------

NAME = r"\w[\w.-]{0,99}"  # of a task, and so of files and folders
FLOATS = (np.float16, np.float32, np.float64)  # in this machine's byte order


@dataclass(frozen=True)
class Demonstrations:
    """Recorded episodes of one task, one after the other.

    `meta` says how they were made, in values that JSON can hold. Six entries have a meaning here;
    each may be left out:

    - positions_in_state: k, where the first 3 k numbers of a state are k positions x, y, z in the
      frame of the points, and the first three of an action are a change of the first position.
      A pose of seven numbers that begins with x, y, z has 1; joint angles have 0. Only scenes with
      1 or more can be augmented: points, positions and displacement turn and stretch together. An
      orientation in the state or the action turns with them where rotation_near_rad is there;
      otherwise it stays as it is, and so is wrong by up to 16 degrees.
    - rotation_near_rad: three numbers, radians. Numbers 4 to 6 of a state are then a rotation
      vector in the frame of the points: of the two vectors that describe one rotation, the nearer
      to this one. Numbers 4 to 6 of an action are a rotation vector in that frame, applied after
      the present rotation. It is ignored unless positions_in_state is 1. robot.py records so.
    - success_frames: the frame of each episode's first success, counted from the episode's start.
    - workspace: two opposite corners of the box that holds the points, metres.
    - simulator: the name of the simulator that they were made in; own recordings have none.
    - action_names: what the numbers of an action are called, for tables.
    """

    task: str
    instruction: str
    points: np.ndarray  # (F, N, P) float16, in the order of farthest point sampling
    state: np.ndarray  # (F, S) float32
    action: np.ndarray  # (F, A) float32
    episode_ends: np.ndarray  # (E,) int64: one past the last frame of each episode
    meta: dict

    def __post_init__(self) -> None:
        """Raises RecordingError if a field has the wrong type; the methods rely on these types."""
        for name in ("task", "instruction"):
            value = getattr(self, name)
            if not isinstance(value, str):
                raise RecordingError(f"{name} must be text (str), not {type(value).__name__}")
        for name in ("points", "state", "action", "episode_ends"):
            value = getattr(self, name)
            if not isinstance(value, np.ndarray):
                raise RecordingError(
                    f"{name} must be a NumPy array, not {type(value).__name__}: use np.array"
                )
        if not isinstance(self.meta, dict):
            raise RecordingError(
                f"meta must be a dict, not {type(self.meta).__name__}: write {{}} to say nothing"
            )

    def __len__(self) -> int:
        return len(self.episode_ends)

    @property
    def action_names(self) -> list[str]:
        """What the numbers of an action are called: as `meta` says, or by their places."""
        places = range(self.action.shape[1])
        return self.meta.get("action_names", [f"action[{place}]" for place in places])

    def episode(self, index: int) -> slice:
        """The frames of one episode; a negative index counts from the end."""
        index = range(len(self))[index]  # IndexError where there is no such episode
        ends = [0, *self.episode_ends.tolist()]
        return slice(ends[index], ends[index + 1])

    def take(self, n: int | None) -> "Demonstrations":
        """Returns the first n episodes (views, no copies), or all for None.

        Raises RecordingError where there are fewer.
        """
        if n is None:
            return self
        if not 1 <= n <= len(self):
            raise RecordingError(
                f"{n} demonstrations of {self.task} asked for, there are {len(self)}"
            )
        return self.part(0, n)

    def part(self, first: int, stop: int) -> "Demonstrations":
        """Returns the episodes from `first` up to, but without, `stop` (views, no copies).

        The range holds at least one episode, and only episodes that exist.
        """
        start, end = self.episode(first).start, self.episode(stop - 1).stop
        meta = dict(self.meta)
        if "success_frames" in meta:
            meta["success_frames"] = meta["success_frames"][first:stop]
        return replace(
            self,
            points=self.points[start:end],
            state=self.state[start:end],
            action=self.action[start:end],
            episode_ends=self.episode_ends[first:stop] - start,
            meta=meta,
        )

    # -- Checks: each raises RecordingError for what could not be saved, read and trained on

    def check(self) -> None:
        """Raises RecordingError, in one line, for anything that keeps these from being used."""
        self.check_text()
        self.check_shapes()
        self.check_lengths()
        self.check_numbers()
        self.check_points()
        self.check_meta()

    def check_text(self) -> None:
        """Files can be named by the task."""
        if not re.fullmatch(NAME, self.task):
            raise RecordingError(
                f"task {self.task[:100]!r} is no name of at most 100 letters, digits, '-', '_' and "
                "'.' that begins with a letter, a digit or '_'"
            )

    def check_shapes(self) -> None:
        """The fields that are arrays have the number of dimensions and the dtypes they need."""
        for name, dims in (("points", 3), ("state", 2), ("action", 2)):
            array = getattr(self, name)
            if array.ndim != dims or array.dtype not in FLOATS or 0 in array.shape[1:]:
                raise RecordingError(
                    f"{name} must be {dims}-dimensional floats, not {array.dtype} {array.shape}"
                )
        if self.points.shape[2] < 3:
            raise RecordingError(
                f"points must be (frames, points, 3 or more), not {self.points.shape}"
            )
        if self.episode_ends.ndim != 1 or self.episode_ends.dtype.kind not in "iu":
            raise RecordingError(
                "episode_ends must be growing whole numbers, not "
                f"{self.episode_ends.dtype} {self.episode_ends.shape}"
            )

    def check_lengths(self) -> None:
        """Episodes follow each other without a gap, and all arrays have their frames."""
        ends = [0, *self.episode_ends.tolist()]
        if len(ends) == 1:
            raise RecordingError("holds no episodes: record or collect it again")
        if any(end <= start for start, end in pairwise(ends)):
            raise RecordingError(
                "episode_ends must be growing whole numbers, one past each episode's last frame"
            )
        lengths = {name: len(getattr(self, name)) for name in ("points", "state", "action")}
        lengths["episodes"] = ends[-1]
        if len(set(lengths.values())) > 1:
            raise RecordingError(f"lengths differ: {lengths}")

    def check_numbers(self) -> None:
        """All numbers are finite, and far from the largest of float32."""
        for name in ("points", "state", "action"):
            array = getattr(self, name)
            if np.isfinite(array).all() and float(np.abs(array).max()) < 1e30:
                continue
            usable = np.isfinite(array) & (np.abs(array.astype(np.float64)) < 1e30)
            frames = np.flatnonzero(~usable.reshape(len(array), -1).all(axis=1))
            advice = "record it again, in metres"
            if name == "points":
                advice = "leave such points out of a cloud before it is sampled"
            raise RecordingError(
                f"{name} holds NaN, infinite or huge numbers in {len(frames)} of {len(array)} "
                f"frames, first in frame {frames[0]}: {advice}"
            )

    def check_points(self) -> None:
        """Positions are metres, features are small, and something was seen in every frame."""
        xyz = positions(self.points)  # (F, N, 3)
        features = self.points[..., 3:]  # (F, N, P - 3)
        if np.abs(xyz).max() > 100:
            raise RecordingError("points reach beyond 100 metres: write them in metres")
        if features.size and np.abs(features).max() > 1:
            raise RecordingError(
                f"features of points reach {np.abs(features).max():g}: only positions are scaled "
                "in training, so write colours from 0 to 1, and no feature beyond -1 to 1"
            )
        empty = np.flatnonzero((xyz == 0).all(axis=(1, 2)))  # frames whose points are padding
        if len(empty):
            raise RecordingError(
                f"all points of frame {empty[0]} are at 0, 0, 0, which is how an empty cloud is "
                "padded: record it again, with something to be seen"
            )

    def check_meta(self) -> None:
        """What `meta` says can be written as JSON, and its known entries make sense."""
        meta = {}  # as a file gives it back
        for name, value in self.meta.items():
            if not isinstance(name, str):
                raise RecordingError(f"the names in meta must be text, not {name!r}")
            try:
                meta[name] = json.loads(meta_as_json(value))
            except (TypeError, ValueError) as error:
                raise RecordingError(f"meta must hold what JSON can, {name}: {error}") from None
        self.check_positions_in_state(meta)
        self.check_rotation(meta)
        self.check_success_frames(meta)
        self.check_workspace(meta)
        if "simulator" in meta and not isinstance(meta["simulator"], str):
            raise RecordingError(f"simulator must be a name, not {meta['simulator']!r}")
        names = meta.get("action_names", self.action_names)
        action_dim = self.action.shape[1]
        if not isinstance(names, list) or [type(name) for name in names] != [str] * action_dim:
            raise RecordingError(f"action_names must be {action_dim} names, not {names!r}")

    def check_positions_in_state(self, meta: dict) -> None:
        count = meta.get("positions_in_state", 0)
        state_dim = self.state.shape[1]
        if type(count) is not int or not 0 <= 3 * count <= state_dim:
            raise RecordingError(
                f"positions_in_state is {count!r}, a state has {state_dim} numbers: write how many "
                "points x, y, z it begins with, a whole number"
            )
        if count and self.action.shape[1] < 3:
            raise RecordingError("with positions_in_state an action must begin with a displacement")

    def check_rotation(self, meta: dict) -> None:
        near = meta.get("rotation_near_rad")
        if near is None or meta.get("positions_in_state") != 1:
            return
        if not is_numbers(near, (3,)):
            raise RecordingError(f"rotation_near_rad is {near!r}: write three numbers, radians")
        if min(self.state.shape[1], self.action.shape[1]) < 6:
            raise RecordingError(
                "with rotation_near_rad states and actions must begin with three numbers of a "
                f"position and three of a rotation, not have {self.state.shape[1]} and "
                f"{self.action.shape[1]} numbers"
            )

    def check_success_frames(self, meta: dict) -> None:
        if "success_frames" not in meta:
            return
        frames = meta["success_frames"]
        if not isinstance(frames, list) or any(type(frame) is not int for frame in frames):
            raise RecordingError("success_frames must be a list of whole numbers")
        lengths = np.diff(self.episode_ends, prepend=0)
        if len(frames) != len(lengths) or any(
            not 0 <= frame < length for frame, length in zip(frames, lengths)
        ):
            raise RecordingError(
                "success_frames must have a frame of each episode, counted from the episode's start"
            )

    def check_workspace(self, meta: dict) -> None:
        if meta.get("workspace") is not None and not is_numbers(meta["workspace"], (2, 3)):
            raise RecordingError("workspace must be two corners of three numbers, metres")


def is_numbers(value: Any, shape: tuple[int, ...]) -> bool:
    """Whether a value from JSON is finite numbers of that shape, and no text or bool."""
    numbers = np.array(value, dtype=object)
    return numbers.shape == shape and all(
        type(x) in (int, float) and abs(x) < 1e30  # False for NaN, too
        for x in numbers.flat
    )


def meta_as_json(value: Any) -> str:
    """JSON text of `meta` or an entry; numbers and arrays of NumPy become numbers and lists."""

    def plain(value: Any) -> Any:
        if isinstance(value, (np.generic, np.ndarray)):
            return value.tolist()
        raise TypeError(f"{type(value).__name__} cannot be written as JSON")

    return json.dumps(value, default=plain)


def hold_out(
    demonstrations: Demonstrations, n: int
) -> tuple[Demonstrations, Demonstrations | None]:
    """Splits a recording into all but its last n episodes, and those n (None for n = 0).

    Raises RecordingError where nothing would be left to train on.
    """
    if n == 0:
        return demonstrations, None
    if not 0 < n < len(demonstrations):
        raise RecordingError(
            f"{demonstrations.task}: {n} of {len(demonstrations)} episodes cannot be held out, at "
            "least one must be left to train on"
        )
    kept = len(demonstrations) - n
    return demonstrations.part(0, kept), demonstrations.part(kept, len(demonstrations))


# ---- Files ---------------------------------------------------------------------------------------

FIELDS = [field.name for field in fields(Demonstrations)]


def write_atomically(path: str | Path, write: Callable[[Path], Any]) -> None:
    """Writes a file whole or not at all.

    `write` is called with a path of the same name in a new hidden folder beside `path`; then that
    file takes the place of `path`, with the mode of the old one. If `path` is a symbolic link, the
    file that it points to is replaced. If `write` raises, the old file stays as it is. Only a
    process that is killed leaves the hidden folder behind; no other process ever removes it.
    """
    path = Path(path)
    target = path.resolve()  # differs where `path` is a link
    with tempfile.TemporaryDirectory(prefix=".unfinished-", dir=target.parent) as folder:
        temporary = Path(folder) / path.name
        write(temporary)
        if target.exists():
            shutil.copymode(target, temporary)
        os.replace(temporary, target)


def write_text(path: str | Path, text: str) -> None:
    """Writes a text file, whole or not at all."""
    write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def save_demonstrations(path: str | Path, demonstrations: Demonstrations) -> None:
    """Writes one task's demonstrations as an `.npz` file; its folder is made if it is missing.

    Raises RecordingError for demonstrations that could not be read again and trained on.
    """
    check_file(path, demonstrations)

    def write(temporary: Path) -> None:
        with open(temporary, "wb") as file:
            np.savez(  # savez_compressed would halve the file, which would load six times as slowly
                file,
                task=demonstrations.task,
                instruction=demonstrations.instruction,
                points=demonstrations.points,
                state=demonstrations.state,
                action=demonstrations.action,
                episode_ends=demonstrations.episode_ends,
                meta=meta_as_json(demonstrations.meta),
            )

    Path(path).parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, write)


def load_demonstrations(path: str | Path) -> Demonstrations:
    """Reads what `save_demonstrations`, or a recorder of your own, wrote.

    Raises RecordingError, in one line, for a file that is missing, damaged, foreign or
    inconsistent, or that may not be read.
    """
    path = Path(path)
    if path.is_dir():
        raise RecordingError(f"{path} is a folder: name one of the .npz files in it")
    if not path.is_file():
        raise RecordingError(
            f"{path} is missing: collect it with `python simulator.py`, or record it"
        )
    try:
        with open(path, "rb") as file:
            is_archive = zipfile.is_zipfile(file)
    except PermissionError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from error
    if not is_archive:
        raise RecordingError(f"{path} is truncated or no .npz file: record or collect it again")
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in FIELDS if name in file.files}
    except Exception as error:  # numpy and zipfile raise many types; each means it cannot be read
        reason = " ".join(str(error).split())
        raise RecordingError(f"{path} is damaged or no file of demonstrations: {reason}") from None
    if missing := [name for name in FIELDS if name not in arrays]:
        raise RecordingError(f"{path} is no file of demonstrations: it lacks {', '.join(missing)}")

    task = read_text(path, "task", arrays["task"])
    instruction = read_text(path, "instruction", arrays["instruction"])
    meta = read_text(path, "meta", arrays["meta"])
    try:
        demonstrations = Demonstrations(
            task=task,
            instruction=instruction,
            points=arrays["points"],
            state=arrays["state"],
            action=arrays["action"],
            episode_ends=arrays["episode_ends"],
            meta=json.loads(meta),
        )
        demonstrations.check()
    except (json.JSONDecodeError, RecursionError) as error:
        raise RecordingError(f"{path}: meta is no JSON: {error}") from None
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from None
    return demonstrations


def check_file(path: str | Path, demonstrations: Demonstrations) -> None:
    """`Demonstrations.check`, whose message begins with the path of the file."""
    try:
        demonstrations.check()
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from None


def read_text(path: Path, name: str, array: np.ndarray) -> str:
    """The text that an array of a file holds; RecordingError if it holds anything else."""
    if array.shape != () or array.dtype.kind != "U":
        raise RecordingError(f"{path}: {name} must be text (str), not {array.dtype} {array.shape}")
    return array.item()


# ---- Suspicions ----------------------------------------------------------------------------------

SPREADS = 20  # an outlier is outside the usual range by more than this many times its width
SCENE = (0.05, 10.0)  # metres: the diagonal of what a manipulator works on
LAGS = range(-2, 3)  # frames by which actions may be shifted


def suspicions(demonstrations: Demonstrations) -> list[str]:
    """What looks like a mistake of the recorder, though it could be trained on; one line each.

    Errors are not among them: those are raised by `Demonstrations.check`. A good recording has no
    suspicions, but not every mistake can be seen: a controller that follows its actions several
    frames later, such as Meta-World's, hides actions that are stored one frame late.
    """
    return [
        *suspect_outliers("state", demonstrations),
        *suspect_outliers("action", demonstrations),
        *suspect_scale(demonstrations),
        *suspect_shifted_actions(demonstrations),
        *suspect_episode_ends(demonstrations),
    ]


def suspect_outliers(name: str, demonstrations: Demonstrations) -> list[str]:
    """Single numbers of `state` or `action` that stretch the range that training scales by."""
    values = getattr(demonstrations, name).astype(np.float64)  # (F, D)
    low = np.percentile(values, 1, axis=0, method="higher")  # never the smallest number itself
    high = np.percentile(values, 99, axis=0, method="lower")
    outside = np.maximum(values - high, low - values)  # (F, D)
    lines = []
    for d in np.flatnonzero((high > low) & (outside.max(axis=0) > SPREADS * (high - low))):
        frame = int(outside[:, d].argmax())
        episode = int(np.searchsorted(demonstrations.episode_ends, frame, side="right"))
        lines.append(
            f"{name} {d} is {values[frame, d]:.6g} in frame {frame} (episode {episode}), while 98 "
            f"percent of the frames lie from {low[d]:.4g} to {high[d]:.4g}: training scales by the "
            "whole range, and everything else would come close to one value"
        )
    return lines


def suspect_scale(demonstrations: Demonstrations) -> list[str]:
    """Clouds that are no scene in metres, and positions in the state that are far from them."""
    frames = np.linspace(0, len(demonstrations.points) - 1, 100).round().astype(int)
    frames = np.unique(frames)
    xyz = positions(demonstrations.points[frames]).astype(np.float64)  # (f, N, 3)
    low, high = np.percentile(xyz, [1, 99], axis=(0, 1))  # (3,) and (3,)
    size = float(np.linalg.norm(high - low))
    if not SCENE[0] <= size <= SCENE[1]:
        return [
            f"the points span {size:.3g} m: are they in metres, and only those of the workspace?"
        ]

    count = int(demonstrations.meta.get("positions_in_state", 0))
    in_state = demonstrations.state[frames, : 3 * count].reshape(len(frames), count, 3)
    outside = np.maximum(np.maximum(low - in_state, in_state - high), 0)  # (f, positions, 3)
    distance = np.linalg.norm(outside, axis=-1)  # (f, positions), 0 inside of the points' box
    far = np.flatnonzero(np.median(distance, axis=0) > size)
    if len(far) == 0:
        return []
    middle = np.argsort(distance[:, far[0]])[len(frames) // 2]  # the frame of the median
    x, y, z = in_state[middle, far[0]]
    return [
        f"position {', '.join(map(str, far))} of the state lies far from the points, which span "
        f"{size:.3g} m ({x:.4g}, {y:.4g}, {z:.4g} in frame {frames[middle]}): is it in metres, and "
        "in the frame of the points?"
    ]


def suspect_shifted_actions(demonstrations: Demonstrations) -> list[str]:
    """Actions that go with the state's change at another frame better than at their own.

    An action may be a velocity or a displacement; where it is a target position, its own change
    from the frame before is compared instead. Either is compared with the change of the state that
    follows it. A negative lag is a mistake, since nothing moves before its action. A positive one
    may come from the controller, which spreads an action over several frames, so it is reported
    only if the fit is nearly perfect.
    """
    dims = min(demonstrations.state.shape[1], demonstrations.action.shape[1])
    action = demonstrations.action[:, :dims].astype(np.float64)  # (F, D)
    change = np.diff(demonstrations.state[:, :dims].astype(np.float64), axis=0)  # (F - 1, D)
    margin = max(LAGS)  # to both ends of an episode, so that no lag leaves it
    episodes = [demonstrations.episode(index) for index in range(len(demonstrations))]
    inner = np.concatenate([np.arange(e.start + margin, e.stop - 1 - margin) for e in episodes])
    if len(inner) < 8:
        return []

    acted = np.stack([action[inner], action[inner] - action[inner - 1]])  # (2, t, D)
    curves = np.stack([correlation(acted, change[inner + lag]) for lag in LAGS])  # (lags, 2, D)
    kind = curves.max(axis=0).argmax(axis=0)  # (D,) 0: the action, 1: its change
    curves = curves[:, kind, np.arange(dims)]  # (lags, D)
    related = curves.max(axis=0) > 0.9
    if not related.any():
        return []
    curve = curves[:, related].mean(axis=1)  # (lags,)
    best, own = int(curve.argmax()), LAGS.index(0)
    lag = LAGS[best]
    ratio = (1 - curve[own]) / max(1 - curve[best], 1e-9)  # of what each leaves unexplained
    if curve[best] - curve[own] < 0.005 or ratio < (2 if lag < 0 else 10):
        return []
    frames = "1 frame" if abs(lag) == 1 else f"{abs(lag)} frames"
    when = "earlier" if lag < 0 else "later"
    return [
        f"actions go best with the change of the state {frames} {when} "
        f"(correlation {curve[best]:.3f}), and less well with the change right after them "
        f"({curve[own]:.3f}): store with each frame the action that is done after it"
    ]


def correlation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Correlation coefficients of a (..., t, D) and b (t, D) over time; 0 where one is constant."""
    a, b = a - a.mean(axis=-2, keepdims=True), b - b.mean(axis=-2, keepdims=True)
    scale = np.sqrt((a * a).sum(axis=-2) * (b * b).sum(axis=-2))
    return np.divide((a * b).sum(axis=-2), scale, out=np.zeros_like(scale), where=scale > 1e-12)


def suspect_episode_ends(demonstrations: Demonstrations) -> list[str]:
    """Episodes at whose end the state goes on smoothly, but jumps one or two frames beside it."""
    state = demonstrations.state.astype(np.float64)
    spread = np.ptp(state, axis=0)
    state = state[:, spread > 0] / spread[spread > 0]
    step = np.linalg.norm(np.diff(state, axis=0), axis=1)  # (F - 1,) from frame i to i + 1
    if len(step) == 0:
        return []
    usual = np.percentile(step, 90, method="lower")
    ends = demonstrations.episode_ends[:-1] - 1  # the last frames, but for that of the recording
    found = []  # frame that is jumped from, episode, how far that is from its end
    for episode, end in enumerate(ends.tolist()):
        for offset in (-1, 1, -2, 2):
            frame = end + offset
            inside = 0 <= frame < len(step) and frame not in ends
            if inside and step[frame] > 5 * max(usual, step[end]):
                found.append((frame, episode, offset))
                break  # this end is found
    if not found:
        return []
    frame, episode, offset = found[0]
    return [
        f"the state jumps from frame {frame} to {frame + 1}, but not from {frame - offset} to "
        f"{frame - offset + 1}, where episode {episode} ends ({len(found)} such ends in all): is "
        f"episode_ends {abs(offset)} too {'large' if offset < 0 else 'small'}?"
    ]


# ---- Augmentation --------------------------------------------------------------------------------

SHIFT = (0.1, 0.1, 0.05)  # metres along each axis, at most
TURN = math.radians(10)  # about the vertical, at most
STRETCH = 0.1  # added to each entry of an identity matrix, at most


def sample_affine_maps(n: int, center: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Draws n affine maps of space, x -> x A^T + b: a shear and stretch, a turn, a shift.

    Before the shift `center` (1, 3) stays where it is; the turn is about the vertical. Returns
    A (n, 3, 3) and b (n, 1, 3).
    """

    def uniform(*shape: int) -> Tensor:
        """Uniform numbers in [-1, 1), on the CPU whatever the generator's device."""
        return 2 * torch.rand(shape, generator=generator, device=generator.device).cpu() - 1

    angle = TURN * uniform(n)
    cos, sin = angle.cos(), angle.sin()
    zero, one = torch.zeros(n), torch.ones(n)
    turn = torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], dim=-1).view(n, 3, 3)
    a = turn @ (torch.eye(3) + STRETCH * uniform(n, 3, 3))  # (n, 3, 3)
    b = center - center @ a.mT + torch.tensor(SHIFT) * uniform(n, 3)[:, None]  # (n, 1, 3)
    return a, b


def map_positions(x: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Applies n affine maps, A (n, 3, 3) and b (n, 1, 3), to n scenes' positions (n, ..., 3)."""
    return (x.flatten(1, -2) @ a.mT + b).view(x.shape)


def nearest_rotations(a: Tensor) -> Tensor:
    """The rotations (n, 3, 3) nearest to linear maps A (n, 3, 3), by their polar decomposition."""
    u, _, vh = torch.linalg.svd(a)
    return u @ vh  # a rotation, since these maps mirror nothing


def turn_rotation_vectors(rotvec: Tensor, turn: Tensor, near: Tensor) -> Tensor:
    """Turns the rotations of rotation vectors (n, L, 3) further by rotations (n, 3, 3).

    It returns rotation vectors (n, L, 3), and calculates by quaternions (w, x, y, z). A rotation
    has two vectors, of an angle v and, about the same axis, of v - 2 pi. The one nearer to `near`
    (3,) is returned. Each turn must be by less than 180 degrees.
    """
    w = (1 + turn.diagonal(dim1=-2, dim2=-1).sum(-1)).sqrt() / 2  # (n,)
    skew = turn - turn.mT
    xyz = torch.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], dim=-1) / (4 * w[:, None])
    aw, a = w[:, None, None], xyz[:, None]  # (n, 1, 1), (n, 1, 3): of the turn

    angle = rotvec.norm(dim=-1, keepdim=True)  # (n, L, 1)
    bw, b = (angle / 2).cos(), rotvec * (angle / (2 * math.pi)).sinc() / 2  # of the vectors

    w = aw * bw - (a * b).sum(-1, keepdim=True)  # (n, L, 1)
    xyz = aw * b + bw * a + torch.linalg.cross(a.expand_as(b), b)  # (n, L, 3)
    sine = xyz.norm(dim=-1, keepdim=True)
    axis = xyz / sine.clamp_min(1e-12)
    angle = 2 * torch.atan2(sine, w)  # 0 to 2 pi
    one, other = axis * angle, axis * (angle - 2 * math.pi)
    closer = (one - near).norm(dim=-1, keepdim=True) <= (other - near).norm(dim=-1, keepdim=True)
    return torch.where(closer, one, other)


def workspace_center(points: np.ndarray, workspace: Any) -> Tensor:
    """The middle (1, 3) of a workspace's two corners; of the points' own box if that is None."""
    if workspace is None:
        xyz = positions(points)
        workspace = [xyz.min((0, 1)).tolist(), xyz.max((0, 1)).tolist()]
    return torch.tensor(workspace).float().mean(dim=0, keepdim=True)


# ---- Windows -------------------------------------------------------------------------------------


def choose_indices(candidates: Tensor, n: int, generator: torch.Generator) -> Tensor:
    """Draws n of the candidates (W,) in a random order; with repetition only where W < n."""
    W, device = len(candidates), generator.device
    if n <= W:
        chosen = torch.randperm(W, generator=generator, device=device)[:n]
    else:
        chosen = torch.randint(W, (n,), generator=generator, device=device)
    return candidates[chosen.cpu()]


class WindowSampler:
    """Windows of H actions that begin with To observations, from one task's demonstrations.

    A window may begin To - 1 frames before an episode and end Ta - 1 frames after it, the edge
    frames repeated: 193 windows in an episode of 200 frames. An episode too short for a window
    keeps one. The clouds are held once, as float16. What the methods return is float32: n windows
    are points (n, To, N, P), state (n, To, S) and action (n, H, A); a demonstration is demo_points
    (1, T, N, P), demo_state (1, T, S) and demo_action (1, T, A).

    Args:
        demonstrations: of one task.
        config: a `model.PolicyConfig`, or anything with its dimensions.
        device: where the tensors are held.
        after_success: windows that begin more than this many frames after their episode's first
            success are late. With None, or in a recording without `success_frames`, none is late.
        late_fraction: the share of late windows among those that are drawn. They teach a policy to
            stay where the task is done, and are so much alike that a few are enough. With 0 they
            are left out.
        augment: `batch` moves each scene by an affine map of its own, where the recording says
            which numbers of a state are positions. Rotations turn along where it says which they
            are (`rotation_near_rad`); other directions in the state or the action stay as they are.
        one_map: all scenes of a batch, its demonstration included, are moved by one map. That is
            for tasks whose goal only the demonstration shows: with maps of their own, windows would
            have another goal than the demonstration.

    Raises RecordingError for demonstrations that do not fit the policy: dimensions, points, length.
    """

    def __init__(
        self,
        demonstrations: Demonstrations,
        config: Any,
        *,
        device: str | torch.device = "cpu",
        after_success: int | None = None,
        late_fraction: float = 0.0,
        augment: bool = False,
        one_map: bool = False,
    ) -> None:
        self.task = demonstrations.task
        self.instruction = demonstrations.instruction
        self.action_names = demonstrations.action_names
        self.config = config
        self.episodes = [demonstrations.episode(index) for index in range(len(demonstrations))]
        self.check_dimensions(demonstrations)
        self.check_demonstration_length()

        # The first points of a farthest point sample are such a sample themselves.
        points = demonstrations.points[:, : config.num_points]
        self.points = torch.tensor(points, dtype=torch.float16, device=device)  # (F, N, P)
        self.state = torch.tensor(demonstrations.state, dtype=torch.float32, device=device)
        self.action = torch.tensor(demonstrations.action, dtype=torch.float32, device=device)

        # For augmentation
        self.positions_in_state = demonstrations.meta.get("positions_in_state", 0)
        self.augment = augment and self.positions_in_state > 0
        self.one_map = one_map
        near = demonstrations.meta.get("rotation_near_rad")
        self.rotation_near: Tensor | None = None  # (3,)
        if self.positions_in_state == 1 and near is not None:
            self.rotation_near = torch.tensor(near, dtype=torch.float32, device=device)
        self.center = workspace_center(points, demonstrations.meta.get("workspace"))  # (1, 3)
        largest = float(self.action[:, :3].abs().max())
        self.max_displacement = max(1.0, largest)  # moved actions are clipped to this

        success_frames = demonstrations.meta.get("success_frames")
        windows_of_episodes = [self.windows_of(episode) for episode in self.episodes]
        windows = torch.cat(windows_of_episodes)  # (W, H) the frame of each action
        counts = torch.tensor([len(of_episode) for of_episode in windows_of_episodes])
        episode_of = torch.arange(len(counts)).repeat_interleave(counts)  # (W,)
        late = torch.zeros(len(windows), dtype=torch.bool)
        if after_success is not None and success_frames is not None:
            starts = torch.tensor([episode.start for episode in self.episodes])
            last_early_start = starts + torch.tensor(success_frames) + after_success  # (E,)
            late = windows[:, 0] > last_early_start[episode_of]
        if late_fraction == 0:
            windows, episode_of, late = windows[~late], episode_of[~late], late[~late]
        self.windows = windows.to(device)
        self.episode_of = episode_of
        self.late = late
        self.late_fraction = late_fraction

    def check_dimensions(self, demonstrations: Demonstrations) -> None:
        """Raises RecordingError where the policy has other dimensions, or wants more points."""
        config = self.config
        _, num_points, point_dim = demonstrations.points.shape
        for label, recorded, expected in (
            ("numbers a state", demonstrations.state.shape[1], config.state_dim),
            ("numbers an action", demonstrations.action.shape[1], config.action_dim),
            ("numbers a point", point_dim, config.point_dim),
        ):
            if recorded != expected:
                raise RecordingError(
                    f"{self.task} has {recorded} {label}, the policy {expected}: "
                    "use recordings, and a checkpoint, that agree"
                )
        if num_points < config.num_points:
            raise RecordingError(
                f"{self.task} has {num_points} points a cloud, the policy {config.num_points}: "
                "use recordings, and a checkpoint, that agree"
            )

    def check_demonstration_length(self) -> None:
        """Raises RecordingError for an episode that is longer than the policy has positions for."""
        if self.config.demo_encoder == "none":
            return
        stride = self.config.demo_stride
        T = max(math.ceil((episode.stop - episode.start) / stride) for episode in self.episodes)
        if T > self.config.demo_positions:
            raise RecordingError(
                f"{self.task}: a demonstration has {T} frames (one in {stride}), the policy "
                f"{self.config.demo_positions} positions: cut it, or train on such data"
            )

    def windows_of(self, episode: slice) -> Tensor:
        """Returns the frames of each window of an episode, (windows, H)."""
        config = self.config
        first = episode.start - (config.n_obs_steps - 1)
        last = episode.stop - config.horizon + (config.n_action_steps - 1)
        last = max(last, first)  # a short episode keeps one
        frames = torch.arange(first, last + 1)[:, None] + torch.arange(config.horizon)
        return frames.clamp(episode.start, episode.stop - 1)

    def __len__(self) -> int:
        return len(self.windows)

    def sample(
        self, n: int, generator: torch.Generator, episodes: Sequence[int] | None = None
    ) -> dict[str, Tensor]:
        """Draws n different windows (with repetition only where there are too few of a kind).

        They are of the episodes of these indices; None: of all. If there are no late windows, early
        ones take their place.
        """
        allowed = torch.ones(len(self), dtype=torch.bool)
        if episodes is not None:
            allowed = torch.isin(self.episode_of, torch.tensor(episodes))
        early = torch.nonzero(allowed & ~self.late).flatten()
        late = torch.nonzero(allowed & self.late).flatten()
        if len(late) == 0:
            return self.gather(choose_indices(early, n, generator))

        chances = torch.rand(n, generator=generator, device=generator.device)
        n_late = int((chances < self.late_fraction).sum())
        chosen = torch.cat(
            [choose_indices(early, n - n_late, generator), choose_indices(late, n_late, generator)]
        )
        # In a random order, since a batch is split into support and query
        return self.gather(choose_indices(chosen, n, generator))

    def gather(self, indices: Tensor) -> dict[str, Tensor]:
        """Returns the windows of these indices (n,)."""
        frames = self.windows[indices.to(self.windows.device)]  # (n, H)
        observed = frames[:, : self.config.n_obs_steps]  # (n, To)
        return {
            "points": self.points[observed].float(),  # (n, To, N, P)
            "state": self.state[observed],  # (n, To, S)
            "action": self.action[frames],  # (n, H, A)
        }

    def sample_episode(self, generator: torch.Generator) -> int:
        """Draws the index of an episode."""
        n, device = len(self.episodes), generator.device
        return int(torch.randint(n, (1,), generator=generator, device=device))

    def demonstration(self, episode: int) -> dict[str, Tensor]:
        """Returns every demo_stride-th frame of an episode, as `encode_demo` takes it."""
        whole = self.episodes[episode]
        frames = slice(whole.start, whole.stop, self.config.demo_stride)
        return {
            "demo_points": self.points[None, frames].float(),  # (1, T, N, P)
            "demo_state": self.state[None, frames],  # (1, T, S)
            "demo_action": self.action[None, frames],  # (1, T, A)
        }

    def batch(self, n: int, generator: torch.Generator, support: int = 0) -> dict[str, Tensor]:
        """Draws a reference demonstration, and n windows of other episodes if there are any.

        With three or more episodes, the first `support` windows also come from other episodes than
        the rest. Otherwise the inner step could lower the loss of the rest by remembering episodes
        that both share.
        """
        reference = self.sample_episode(generator)
        demo = self.demonstration(reference)
        others = [e for e in range(len(self.episodes)) if e != reference] or [reference]
        if 0 < support < n and len(others) > 1:
            order = torch.randperm(len(others), generator=generator, device=generator.device)
            shuffled = [others[i] for i in order.tolist()]
            half = len(others) // 2
            of_support = self.sample(support, generator, episodes=shuffled[:half])
            of_query = self.sample(n - support, generator, episodes=shuffled[half:])
            windows = {name: torch.cat([of_support[name], of_query[name]]) for name in of_query}
        else:
            windows = self.sample(n, generator, episodes=others)

        if self.augment:
            demo_map = sample_affine_maps(1, self.center, generator)
            maps = demo_map if self.one_map else sample_affine_maps(n, self.center, generator)
            demo["demo_points"], demo["demo_state"], demo["demo_action"] = self.move_scenes(
                demo["demo_points"], demo["demo_state"], demo["demo_action"], *demo_map
            )
            windows["points"], windows["state"], windows["action"] = self.move_scenes(
                windows["points"], windows["state"], windows["action"], *maps
            )
        return {**windows, **demo}

    def move_scenes(
        self, points: Tensor, state: Tensor, action: Tensor, a: Tensor, b: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Moves n scenes by affine maps: A (n, 3, 3) and b (n, 1, 3), or one map for all.

        Points and the positions in a state move together, and the displacement that an action
        begins with turns and stretches with them: the scene stays one of the same task. Rotations
        turn by the rotation nearest to the map. Takes and returns points (n, L, N, P), state
        (n, L, S) and action (n, K, A): L = To and K = H for windows, L = K = T for a demonstration.
        """
        n = len(points)
        a, b = a.expand(n, 3, 3).to(points.device), b.expand(n, 1, 3).to(points.device)

        moved_points = map_positions(positions(points), a, b)  # (n, L, N, 3)
        points = torch.cat([moved_points, points[..., 3:]], dim=-1)  # features stay as they are

        size = 3 * self.positions_in_state
        in_state = state[..., :size].unflatten(-1, (-1, 3))  # (n, L, positions, 3)
        moved_in_state = map_positions(in_state, a, b).flatten(-2)  # (n, L, size)
        state = torch.cat([moved_in_state, state[..., size:]], dim=-1)

        limit = self.max_displacement
        displacement = (action[..., :3] @ a.mT).clamp(-limit, limit)  # (n, K, 3)
        action = torch.cat([displacement, action[..., 3:]], dim=-1)

        if self.rotation_near is not None:
            turn = nearest_rotations(a)  # (n, 3, 3)
            turned = turn_rotation_vectors(state[..., 3:6], turn, self.rotation_near)  # (n, L, 3)
            state = torch.cat([state[..., :3], turned, state[..., 6:]], dim=-1)
            turned = action[..., 3:6] @ turn.mT  # (n, K, 3): its axis turns, its angle stays
            action = torch.cat([action[..., :3], turned, action[..., 6:]], dim=-1)
        return points, state, action
