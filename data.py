"""Demonstrations: their files, the windows that are trained on, and augmentation.

    python data.py --show data/reach.npz        # draws a recording to a PNG; see convert.py

Nothing here knows a simulator or a robot: simulator.py and robot.py record, and so may you. A file
is checked when it is read, `WindowSampler` holds it as tensors, and its `batch` draws what
`DAMIPolicy.loss` takes beside the instruction and noise. Nothing of the project is imported.

Letters: W windows, T demonstration frames, F stored frames, N points, E episodes, H = 16 horizon,
To = 2 observation steps, Ta = 8 executed actions, A action dim, S state dim, M points to sample.
"""

import json
import math
import os
import re
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

import fpsample
import numpy as np
import torch
from torch import Tensor

# ---- Point clouds --------------------------------------------------------------------------------


def farthest_point_sample(points: np.ndarray, n: int) -> np.ndarray:
    """Samples n of the points (M, 3) float32, each the farthest from all before it.

    Returns (n, 3) float32 in the order of selection, so that the first k of the n are themselves
    such a sample of k. The same cloud always gives the same sample. With M < n the sample is
    repeated from its beginning. Raises ValueError for an empty cloud.
    """
    if len(points) == 0:
        raise ValueError("the cloud is empty: nothing was seen inside the workspace")
    if len(points) < 8:  # too few for a tree of 2**3 buckets
        order = fpsample.fps_sampling(points, min(n, len(points)), start_idx=0)
    else:
        order = fpsample.bucket_fps_kdline_sampling(points, min(n, len(points)), h=3, start_idx=0)
    return points[np.resize(order.astype(np.int64), n)]  # (n, 3)


# ---- Recordings and their files ------------------------------------------------------------------


@dataclass(frozen=True)
class Demonstrations:
    """Recorded episodes of one task, one after the other."""

    task: str
    instruction: str
    points: np.ndarray  # (F, N, 3) float16, metres, in the order of farthest point sampling
    state: np.ndarray  # (F, S) float32
    action: np.ndarray  # (F, A) float32
    episode_ends: np.ndarray  # (E,) int64: one past the last frame of each episode
    meta: dict  # how they were made; training reads success_frames and positions_in_state

    def __len__(self) -> int:
        return len(self.episode_ends)

    def episode(self, index: int) -> slice:
        """The frames of one episode."""
        ends = [0, *self.episode_ends.tolist()]
        return slice(ends[index], ends[index + 1])

    def take(self, n: int | None) -> "Demonstrations":
        """The first n episodes (views, no copies); None: all."""
        if n is None:
            return self
        if not 1 <= n <= len(self):
            raise ValueError(f"{n} demonstrations of {self.task} asked for, there are {len(self)}")
        end = self.episode(n - 1).stop
        arrays = {name: getattr(self, name)[:end] for name in ("points", "state", "action")}
        return replace(self, **arrays, episode_ends=self.episode_ends[:n])

    def problem(self) -> str | None:
        """What keeps these arrays from being trained on; None if nothing does."""
        arrays = {part: getattr(self, part) for part in ("points", "state", "action")}
        for part, array in arrays.items():
            dims, kind = 3 if part == "points" else 2, array.dtype
            if array.ndim != dims or kind.kind != "f" or not kind.isnative or 0 in array.shape[1:]:
                return f"{part} must be {dims}-dimensional floats, not {kind} {array.shape}"
        if self.points.shape[2] != 3:
            return f"points must be (frames, points, 3), not {self.points.shape}"
        ends = self.episode_ends
        if ends.ndim != 1 or ends.dtype.kind not in "iu" or (np.diff(ends, prepend=0) <= 0).any():
            return "episode_ends must be growing whole numbers, one past each episode's last frame"
        if len(ends) == 0:
            return "holds no episodes: record or collect it again"
        lengths = {part: len(array) for part, array in arrays.items()} | {"episodes": int(ends[-1])}
        if len(set(lengths.values())) > 1:
            return f"lengths differ: {lengths}"

        if not re.fullmatch(NAME, self.task):
            return f"task {self.task[:100]!r} is no name of letters, digits, '-', '_' and '.'"
        positions = self.meta.get("positions_in_state", 0)
        if type(positions) is not int or not 0 <= 3 * positions <= self.state.shape[1]:
            return f"positions_in_state is {positions!r}, a state has {self.state.shape[1]} numbers"
        if positions and self.action.shape[1] < 3:
            return "with positions_in_state an action must begin with a displacement"
        try:
            box = np.array(self.meta.get("workspace") or np.zeros((2, 3)), np.float64)
        except (TypeError, ValueError):
            box = np.zeros(0)
        if box.shape != (2, 3) or not np.isfinite(box).all():
            return "workspace must be two corners of three numbers, metres"
        frames = self.meta.get("success_frames", [0] * len(ends))
        listed = isinstance(frames, list) and all(type(f) is int and f >= 0 for f in frames)
        if not listed or len(frames) < len(ends):
            return "success_frames must be a list with one whole number for each episode"

        for part, array in arrays.items():
            if not (np.isfinite(array).all() and float(np.abs(array).max()) < 1e30):
                return f"{part} holds NaN or infinite numbers: record it again, in metres"
        if np.abs(self.points).max() > 100:
            return "points reach beyond 100 metres: write them in metres"
        return None


def write_atomically(path: str | Path, write: Callable[[Path], Any]) -> None:
    """Calls `write` with a temporary name beside `path`, then renames: whole, or the old file."""
    path = Path(path)
    temporary = path.with_name(f".{os.getpid()}.{path.name}")  # with its suffix: some go by it
    try:
        write(temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


PARTS = [part.name for part in fields(Demonstrations)]
NAME = r"\w[\w.-]{0,99}"  # of a task, and so of files and folders


def save_demonstrations(path: str | Path, demonstrations: Demonstrations) -> None:
    """Writes one task's demonstrations as an `.npz` file; ValueError if they have a problem."""
    if problem := demonstrations.problem():
        raise ValueError(f"{path}: {problem}")
    arrays = {part: getattr(demonstrations, part) for part in PARTS}
    arrays["meta"] = json.dumps(demonstrations.meta)

    def write(temporary: Path) -> None:
        with open(temporary, "wb") as file:
            np.savez(file, **arrays)  # compressed: half the size, six times the loading time

    Path(path).parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, write)


def load_demonstrations(path: str | Path) -> Demonstrations:
    """Reads what `save_demonstrations`, or a recorder of your own, wrote.

    Raises ValueError, one line: missing, damaged, inconsistent, not finite; OSError: unreadable.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path} is missing: collect it with `python simulator.py`, or record it")
    with open(path, "rb") as file:
        if not zipfile.is_zipfile(file):
            raise ValueError(f"{path} is truncated or no .npz file: record or collect it again")
    try:
        with np.load(path, allow_pickle=False) as file:
            missing = [part for part in PARTS if part not in file.files]
            arrays = {part: file[part] for part in PARTS if part not in missing}
        meta = dict(json.loads(str(arrays.pop("meta", "{}"))))
    except Exception as error:  # numpy and zipfile raise many types; each means it cannot be read
        reason = " ".join(str(error).split())
        raise ValueError(f"{path} is damaged or no file of demonstrations: {reason}") from None
    if missing:
        raise ValueError(f"{path} is no file of demonstrations: it lacks {', '.join(missing)}")

    task, instruction = str(arrays.pop("task")), str(arrays.pop("instruction"))
    demonstrations = Demonstrations(task, instruction, **arrays, meta=meta)
    if problem := demonstrations.problem():
        raise ValueError(f"{path}: {problem}")
    return demonstrations


# ---- Augmentation --------------------------------------------------------------------------------

SHIFT = (0.1, 0.1, 0.05)  # metres along each axis, at most
TURN = math.radians(10)  # about the vertical, at most
STRETCH = 0.1  # share of shear and stretch, at most


def draw_affine_maps(n: int, middle: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Draws n affine maps of space, x -> x A^T + b: a shear and stretch, a turn, a shift.

    The turn is about the vertical through `middle` (1, 3). Returns A (n, 3, 3), b (n, 1, 3).
    """

    def symmetric(*shape: int) -> Tensor:
        return 2 * torch.rand(shape, generator=generator, device=generator.device).cpu() - 1

    angle, zero, one = TURN * symmetric(n), torch.zeros(n), torch.ones(n)
    cos, sin = angle.cos(), angle.sin()
    turn = torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], dim=-1).view(n, 3, 3)
    a = turn @ (torch.eye(3) + STRETCH * symmetric(n, 3, 3))
    b = middle - middle @ a.mT + torch.tensor(SHIFT) * symmetric(n, 3)[:, None]
    return a, b


# ---- Windows -------------------------------------------------------------------------------------


class WindowSampler:
    """Windows of H actions that begin with To observations, from one task's demonstrations.

    A window may begin To - 1 frames before an episode and end Ta - 1 frames after it, the edge
    frames repeated: 193 windows in an episode of 200 frames. An episode too short for a window
    keeps one. The clouds are held once, as float16. All that is drawn is float32: n windows are
    points (n, To, N, 3), state (n, To, S) and action (n, H, A), a demonstration is demo_points
    (1, T, N, 3), demo_state (1, T, S) and demo_action (1, T, A).

    Args:
        demonstrations: of one task.
        config: a `model.PolicyConfig`, or anything with its dimensions.
        device: where the tensors are held.
        after_success: how many frames after its episode's first success a window may begin, where
            the recording tells that frame; None: any number.
        augment: `batch` moves each scene by an affine map of its own, where the recording tells the
            positions in a state. No other direction or rotation in it is turned.

    Raises ValueError for demonstrations that do not fit the policy: dimensions, points or length.
    """

    def __init__(
        self,
        demonstrations: Demonstrations,
        config: Any,
        device: str | torch.device = "cpu",
        after_success: int | None = None,
        augment: bool = False,
    ) -> None:
        self.task, self.instruction = demonstrations.task, demonstrations.instruction
        self.config = config
        self.episodes = [demonstrations.episode(index) for index in range(len(demonstrations))]
        self.check_fit(demonstrations)

        points = demonstrations.points[:, : config.num_points]  # the first are a sample themselves
        self.points = torch.tensor(points, dtype=torch.float16, device=device)  # (F, N, 3)
        self.state = torch.tensor(demonstrations.state, dtype=torch.float32, device=device)
        self.action = torch.tensor(demonstrations.action, dtype=torch.float32, device=device)

        meta = demonstrations.meta
        self.positions = meta.get("positions_in_state", 0) if augment else 0
        box = meta.get("workspace") or [points.min((0, 1)).tolist(), points.max((0, 1)).tolist()]
        self.middle = torch.tensor(box).float().mean(dim=0, keepdim=True)  # (1, 3) turned about
        self.limit = max(1.0, float(self.action[:, :3].abs().max()))  # of a displacement, its unit

        successes = meta.get("success_frames", []) if after_success is not None else []
        windows, counts = [], []
        for episode, success in zip_longest(self.episodes, successes[: len(self.episodes)]):
            earliest = episode.start - (config.n_obs_steps - 1)
            latest = max(episode.stop - config.horizon + config.n_action_steps - 1, earliest)
            if success is not None:
                latest = min(latest, episode.start + success + after_success)
            frames = torch.arange(earliest, latest + 1)[:, None] + torch.arange(config.horizon)
            windows.append(frames.clamp(episode.start, episode.stop - 1))  # (windows, H)
            counts.append(len(frames))
        self.windows = torch.cat(windows).to(device)  # (W, H) the frame of each action
        self.episode_of = torch.arange(len(counts)).repeat_interleave(torch.tensor(counts))  # (W,)

    def check_fit(self, demonstrations: Demonstrations) -> None:
        config, (_, N, _) = self.config, demonstrations.points.shape
        found = (demonstrations.state.shape[1], demonstrations.action.shape[1], N)
        known = (config.state_dim, config.action_dim, config.num_points)
        if found[:2] != known[:2] or N < config.num_points:
            what = f"state, action, points have {found} dimensions, the policy's have {known}"
            raise ValueError(f"{self.task}: {what}: use recordings, and a checkpoint, that agree")
        T = max(math.ceil((e.stop - e.start) / config.demo_stride) for e in self.episodes)
        if config.demo_encoder != "none" and T > config.demo_positions:
            what = f"a demonstration has {T} frames (every {config.demo_stride}th)"
            most = f"the policy {config.demo_positions} positions"
            raise ValueError(f"{self.task}: {what}, {most}: cut it, or train on such data")

    def __len__(self) -> int:
        return len(self.windows)

    def sample(self, n: int, generator: torch.Generator, without: int = -1) -> dict[str, Tensor]:
        """Draws n different windows (with repetition only where there are fewer than n).

        None is of the episode `without`, unless that is the only one.
        """
        others = (self.episode_of != without).nonzero()[:, 0]
        W, how = len(others) or len(self), {"generator": generator, "device": generator.device}
        chosen = torch.randperm(W, **how)[:n] if n <= W else torch.randint(W, (n,), **how)
        return self.gather(others[chosen.cpu()] if len(others) else chosen)

    def gather(self, indices: Tensor) -> dict[str, Tensor]:
        """The windows of these indices (n,)."""
        frames = self.windows[indices.to(self.windows.device)]  # (n, H)
        observed = frames[:, : self.config.n_obs_steps]  # (n, To)
        return {
            "points": self.points[observed].float(),  # (n, To, N, 3)
            "state": self.state[observed],  # (n, To, S)
            "action": self.action[frames],  # (n, H, A)
        }

    def draw_episode(self, generator: torch.Generator) -> int:
        n, device = len(self.episodes), generator.device
        return int(torch.randint(n, (1,), generator=generator, device=device))

    def demonstration(self, episode: int) -> dict[str, Tensor]:
        """A complete episode, every demo_stride-th frame of it, as `encode_demo` takes it."""
        whole = self.episodes[episode]
        frames = slice(whole.start, whole.stop, self.config.demo_stride)
        return {
            "demo_points": self.points[None, frames].float(),
            "demo_state": self.state[None, frames],
            "demo_action": self.action[None, frames],
        }

    def batch(self, n: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Draws a reference demonstration, and n windows of other episodes where there are any."""
        reference = self.draw_episode(generator)
        demo = self.demonstration(reference)
        windows = self.sample(n, generator, without=reference)
        if self.positions:
            demo = self.augment(demo, generator, prefix="demo_")
            windows = self.augment(windows, generator)
        return windows | demo

    def augment(
        self, scenes: dict[str, Tensor], generator: torch.Generator, prefix: str = ""
    ) -> dict[str, Tensor]:
        """Moves each scene by an affine map of its own.

        Points and the positions in a state move together, and the displacement that an action
        begins with turns and stretches with them: the scene stays one of the same task.
        """
        names = [f"{prefix}{part}" for part in ("points", "state", "action")]
        points, state, action = (scenes[name] for name in names)
        a, b = draw_affine_maps(len(points), self.middle, generator)
        a, b = a.to(points.device), b.to(points.device)

        def place(x: Tensor) -> Tensor:
            return (x.flatten(1, -2) @ a.mT + b).view_as(x)

        at = 3 * self.positions
        positions = place(state[..., :at].unflatten(-1, (-1, 3))).flatten(-2)  # (n, T, at)
        state = torch.cat([positions, state[..., at:]], dim=-1)
        displacement = (action[..., :3] @ a.mT).clamp(-self.limit, self.limit)  # (n, T', 3)
        action = torch.cat([displacement, action[..., 3:]], dim=-1)
        return dict(zip(names, (place(points), state, action)))


if __name__ == "__main__":
    from convert import main  # neither is needed where this file is copied to
    from scripts import command_line

    command_line(main)
