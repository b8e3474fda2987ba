"""What RLBench's recordings and its environment have in common: clouds, states, actions, files.

convert.py imports data sets of RLBench with this file, and rlbench_env.py evaluates with it, so
that both see the same clouds and mean the same by an action. RLBench itself is not needed here.

A state (7,) is the gripper's position x, y, z in metres, its orientation as a rotation vector (of
its two equivalent forms the one nearer to `ROTATION_NEAR`), and 1 for an open gripper, 0 for a
closed one.

An action (7,) leads from one frame to the next. It is the displacement of the gripper in metres, a
rotation vector in radians, which is applied after the present orientation, and 1 or 0 for a gripper
that is open or closed then. All of this is in the world frame. `action_between` makes an action of
two states, and `target_of` makes of state and action what RLBench's own actions are: the pose that
`EndEffectorPoseViaIK` takes, and the gripper.

A data set is read from the folders that RLBench writes:

    TASK/variation0/variation_descriptions.pkl              # what may be said for this task
    TASK/variation0/episodes/episode0/low_dim_obs.pkl       # all frames, without images
    TASK/variation0/episodes/episode0/front_depth/0.png     # a depth image of each frame and camera

`all_variations` in the place of `variation0` holds episodes of several variations; each of them has
a `variation_number.pkl` and a `variation_descriptions.pkl` of its own. Pickles could run any code.
Here they are read in such a way that they run none, see `read_pickle`.

Letters: H x W pixels, M points of a cloud before sampling, T frames of an episode.
"""

import math
import os
import pickle
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import PIL.Image

from data import RecordingError
from geometry import compose, depth_to_points, difference, nearer, quaternion, thin, transform

CAMERAS = ("front", "left_shoulder", "right_shoulder")
WRIST = "wrist"  # one camera more, where it is asked for
WORKSPACE = ((-0.3, -0.5, 0.6), (0.7, 0.5, 1.6))  # the table top and what stands on it
ROTATION_NEAR = (0.0, 3.14159, 0.0)  # the gripper points down

# How recordings are made. The suite `fs25` refuses those that were made in another way.
RECIPE = {
    "format": "RLBench",
    "cameras": list(CAMERAS),
    "workspace": [list(corner) for corner in WORKSPACE],
    "num_points": 512,
    "sampling": "farthest points",
    "positions_in_state": 1,
    "rotation_near_rad": list(ROTATION_NEAR),
    "action_names": ["dx", "dy", "dz", "rx", "ry", "rz", "open"],
    "made_by": "`python convert.py --import FOLDER --out DATA`, where FOLDER is what RLBench's own "
    "`rlbench-generate-dataset --tasks TASK --variations 1 --save_path FOLDER` wrote",
}


def refuse(path: Path | str, problem: str) -> NoReturn:
    raise RecordingError(f"{path}: {problem}")


# ---- States and actions --------------------------------------------------------------------------


def state_of(gripper_pose: np.ndarray, gripper_open: float) -> np.ndarray:
    """RLBench's pose (x, y, z, qx, qy, qz, qw) and gripper (1: open) -> the state (7,) float64."""
    x, y, z, w = gripper_pose[3:] / np.linalg.norm(gripper_pose[3:])
    sine = math.sqrt(x * x + y * y + z * z)
    angle = 2 * math.atan2(sine, w)  # 0 to 2 pi
    rotvec = np.array([x, y, z]) * (angle / sine if sine > 1e-9 else 2.0)
    rotvec = nearer(rotvec, np.array(ROTATION_NEAR))
    return np.array([*gripper_pose[:3], *rotvec, gripper_open], np.float64)


def action_between(state: np.ndarray, next_state: np.ndarray) -> np.ndarray:
    """The action (7,) that leads from one state to the next one."""
    return np.append(difference(state[:6], next_state[:6]), next_state[6])


def target_of(state: np.ndarray, action: np.ndarray) -> np.ndarray:
    """State (7,) and action (7,) -> RLBench's action (8,): the pose to go to, then the gripper.

    The pose is x, y, z, qx, qy, qz, qw in the world frame, and the gripper is 1 (open) or 0.
    """
    pose = compose(state[:6], np.asarray(action, np.float64))  # (6,)
    w, x, y, z = quaternion(pose[3:])
    return np.array([*pose[:3], x, y, z, w, float(action[6] > 0.5)])


# ---- Clouds --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class View:
    """What one camera sees in one frame."""

    depth: np.ndarray  # (H, W), from 0 at the near plane to 1 at the far plane
    near: float  # metres
    far: float
    intrinsics: list[float]  # fx, fy, cx, cy in pixels; RLBench's focal lengths are negative
    pose: np.ndarray  # (4, 4) of the camera in the world frame

    def points(self) -> np.ndarray:
        """The point of each pixel, (H W, 3) float32, world frame."""
        metres = self.near + self.depth.astype(np.float64) * (self.far - self.near)
        points = depth_to_points(metres, self.intrinsics)  # camera frame
        return transform(points, self.pose)


def read_view(where: Path | str, misc: Mapping[str, Any], camera: str, depth: np.ndarray) -> View:
    """A camera's view, from its depth image and what `misc` of the frame says of the camera.

    Raises RecordingError, which names `where`, if `misc` lacks something, or if the image has
    another size than the intrinsics are for.
    """
    numbers = {}
    shapes = {"near": (), "far": (), "intrinsics": (3, 3), "extrinsics": (4, 4)}
    for name, shape in shapes.items():
        key = f"{camera}_camera_{name}"
        if key not in misc:
            refuse(where, f"does not say {key}: record it again with a newer RLBench")
        numbers[name] = read_numbers(where, key, misc[key], shape)
    near, far, matrix = float(numbers["near"]), float(numbers["far"]), numbers["intrinsics"]
    if not 0 < near < far:
        refuse(where, f"{camera}_camera_near is {near:g}, its far {far:g}: record it again")
    height, width = depth.shape
    if abs(matrix[0, 2] - width / 2) > 1 or abs(matrix[1, 2] - height / 2) > 1:
        refuse(
            where,
            f"{camera}_depth has {width} x {height} pixels, but its intrinsics are for "
            f"{2 * matrix[0, 2]:g} x {2 * matrix[1, 2]:g}: use the images as they were recorded",
        )
    intrinsics = [float(matrix[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))]
    return View(depth=depth, near=near, far=far, intrinsics=intrinsics, pose=numbers["extrinsics"])


def seen_points(
    views: Sequence[View], workspace: Sequence[Sequence[float]] = WORKSPACE
) -> np.ndarray:
    """What all cameras see of the workspace, (M, 3) float32, thinned as `geometry.thin` does.

    A cloud is made of these by `data.farthest_point_sample`.
    """
    points = np.concatenate([view.points() for view in views])
    low, high = workspace
    points = points[((points >= low) & (points <= high)).all(axis=1)]
    return thin(points)


# ---- Pickles, without running any code -----------------------------------------------------------


class Kept:
    """What stands for a class or function in a pickle: it keeps what it is given, and does nothing.

    NumPy's functions trust the sizes and types that a file states, so that not even those are
    called. `read_numbers` checks what was kept.
    """

    __slots__ = ("arguments", "state")

    def __new__(cls, *arguments: Any) -> "Kept":
        kept = super().__new__(cls)
        kept.arguments, kept.state = arguments, None
        return kept

    def __setstate__(self, state: Any) -> None:
        self.state = state


class Demo(Kept):
    """An episode."""


class Observation(Kept):
    """A frame."""


class Array(Kept):
    """An array as `_reconstruct` begins it: the rest of it comes as its state."""


class BufferArray(Kept):
    """An array as `_frombuffer` makes it."""


class Scalar(Kept):
    """A number of NumPy."""


class DType(Kept):
    """The type of an array."""


class NDArray(Kept):
    """The class of arrays, which is only named."""


KNOWN_NAMES = {
    ("rlbench.demo", "Demo"): Demo,
    ("rlbench.backend.observation", "Observation"): Observation,
    ("numpy", "ndarray"): NDArray,
    ("numpy", "dtype"): DType,
    # NumPy 1 wrote numpy.core, NumPy 2 writes numpy._core.
    ("numpy.core.multiarray", "_reconstruct"): Array,
    ("numpy._core.multiarray", "_reconstruct"): Array,
    ("numpy.core.multiarray", "scalar"): Scalar,
    ("numpy._core.multiarray", "scalar"): Scalar,
    ("numpy.core.numeric", "_frombuffer"): BufferArray,
    ("numpy._core.numeric", "_frombuffer"): BufferArray,
}


class KeepingUnpickler(pickle.Unpickler):
    """Reads a pickle in which only KNOWN_NAMES stand; RecordingError for any other name."""

    def find_class(self, module: str, name: str) -> type[Kept]:
        # A dotted name such as `ndarray.tofile` is not taken apart, and so it is unknown.
        known = KNOWN_NAMES.get((module, name))
        if known is None:
            raise RecordingError(
                f"names {f'{module}.{name}'[:100]!r}, which no recording of RLBench needs: a "
                "pickle could run any code, so it is not read"
            )
        return known


def read_pickle(path: Path) -> Any:
    """What a pickle of RLBench holds: plain Python values, and `Kept` for everything else.

    Nothing that a file names is called, whatever it is. Raises RecordingError, in one line, for a
    file that is missing or damaged, or that names what is not in KNOWN_NAMES.
    """
    if not path.is_file():
        refuse(path, "is missing: record or download it again, or move its episode away")
    try:
        with path.open("rb") as file:
            return KeepingUnpickler(file).load()
    except RecordingError as error:
        refuse(path, str(error))
    except PermissionError as error:
        refuse(path, f"cannot be read: {error.strerror}")
    except Exception as error:  # pickle raises many types; each means it cannot be read
        reason = " ".join(str(error).split())[:200]
        refuse(path, f"is damaged or no pickle: {reason}; download it again")


NUMBER_TYPES = "b1|[iu][1248]|f[248]"


def read_numbers(
    where: Path | str, name: str, value: Any, shape: tuple[int, ...] | None = None
) -> np.ndarray:
    """Numbers as an array float64: a number, a list, an array, or an array that a pickle kept.

    Raises RecordingError for anything else, or (unless it is None) for another shape.
    """
    try:
        array = np.asarray(kept_array(value) if isinstance(value, Kept) else value)
    except (AttributeError, IndexError, TypeError, ValueError):
        array = np.array(None)
    if array.dtype.kind not in "biuf":
        refuse(where, f"{name} holds no numbers: record or download it again")
    if shape is not None and array.shape != shape:
        refuse(where, f"{name} has the shape {array.shape}, not {shape}: record it again")
    return array.astype(np.float64)


def kept_array(kept: Kept) -> np.ndarray:
    """The array that a `Kept` stands for. Raises errors of many types if it is none.

    The type is one of NUMBER_TYPES, and NumPy checks the shape against the number of bytes.
    """
    if isinstance(kept, Array):
        _, shape, dtype, fortran, data = kept.state
        return plain_array(data, dtype).reshape(shape, order="F" if fortran else "C")
    if isinstance(kept, BufferArray):
        data, dtype, shape, order = kept.arguments[:4]
        if order == "K":
            return plain_array(data, dtype).reshape(shape).transpose(kept.arguments[4])
        return plain_array(data, dtype).reshape(shape, order=order)
    if isinstance(kept, Scalar):
        dtype, data = kept.arguments
        return plain_array(data, dtype).reshape(())
    raise TypeError(f"{type(kept).__name__} is no array")


def plain_array(data: Any, dtype: Any) -> np.ndarray:
    """Bytes -> their numbers, one after the other."""
    kind, order = dtype.arguments[0], dtype.state[1]
    if not isinstance(data, (bytes, bytearray)) or order not in ("<", ">", "|"):
        raise TypeError("no plain bytes")
    if not isinstance(kind, str) or not re.fullmatch(NUMBER_TYPES, kind):
        raise TypeError("no plain numbers")
    return np.frombuffer(bytes(data), np.dtype(order + kind))


# ---- Files ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class EpisodeFolder:
    """Where an episode is, and what its folders say of it."""

    folder: Path
    task: str  # RLBench's own name of it, such as close_box
    variation: int | None  # None: all_variations, so that the episode says it itself


@dataclass(frozen=True)
class Moment:
    """A frame of an episode, without its images."""

    state: np.ndarray  # (7,)
    misc: dict[str, Any]  # what `read_view` reads


def is_data_set(path: Path) -> bool:
    """Whether a folder is a data set, a task or a variation of RLBench."""
    return next(episode_paths(path), None) is not None


def episode_paths(path: Path) -> Iterator[Path]:
    """The folders of the episodes in a variation, a task or a whole data set."""
    for episodes in ("episodes", "*/episodes", "*/*/episodes"):
        for folder in path.glob(f"{episodes}/episode*"):
            if folder.is_dir() and re.fullmatch(r"episode\d+", folder.name):
                yield folder


def variation_folder_of(folder: Path) -> Path:
    """The folder of an episode's variation, as an absolute path.

    Its name, and that of its parent, the task, are read from it.
    """
    return Path(os.path.abspath(folder)).parent.parent


def find_episodes(path: Path) -> list[EpisodeFolder]:
    """The episodes in a folder, by task, variation and number.

    Raises RecordingError for a folder whose variation has a name that RLBench does not use.
    """
    episodes = []
    for folder in episode_paths(path):
        variation_folder = variation_folder_of(folder)
        variation = None
        if variation_folder.name != "all_variations":
            number = re.fullmatch(r"variation(\d+)", variation_folder.name)
            if number is None:
                refuse(folder, "is in no folder variation0, variation1 ... or all_variations")
            variation = int(number[1])
        episodes.append(EpisodeFolder(folder, variation_folder.parent.name, variation))

    def order(episode: EpisodeFolder) -> tuple[str, int, int]:
        variation = -1 if episode.variation is None else episode.variation
        number = re.search(r"\d*$", episode.folder.name)[0]
        return episode.task, variation, int(number or 0)

    return sorted(episodes, key=order)


def read_variation(episode: EpisodeFolder, moments: Sequence[Moment]) -> int:
    """Which variation of its task an episode is of; RecordingError if nothing says it."""
    if episode.variation is not None:
        return episode.variation
    file = episode.folder / "variation_number.pkl"
    number = read_pickle(file) if file.is_file() else moments[0].misc.get("variation_index")
    if number is None:
        refuse(episode.folder, "does not say its variation: move it to variation0, variation1 ...")
    variation = float(read_numbers(episode.folder, "its variation", number, ()))
    if not (variation.is_integer() and variation >= 0):
        refuse(episode.folder, f"its variation is {variation:g}, no whole number from 0")
    return int(variation)


def task_name(task: str, variation: int) -> str:
    """A recording's name: that of the task for its first variation, and one of its own for others.

    Variations have other instructions, so that each has a recording of its own.
    """
    return task if variation == 0 else f"{task}-variation{variation}"


def read_instruction(episode: EpisodeFolder) -> str | None:
    """The first description of an episode's variation; None if there is no text in its place."""
    for folder in (episode.folder, variation_folder_of(episode.folder)):
        file = folder / "variation_descriptions.pkl"
        if file.is_file():
            descriptions = read_pickle(file)
            first = descriptions
            if isinstance(descriptions, (list, tuple)):
                first = next(iter(descriptions), None)
            return first if isinstance(first, str) and first.strip() else None
    return None


def read_moments(episode: EpisodeFolder) -> list[Moment]:
    """The T frames of an episode; RecordingError, in one line, if they are not what RLBench writes.

    Actions are made of poses and of the gripper, so that files which hold no actions will do.
    """
    file = episode.folder / "low_dim_obs.pkl"
    demo = read_pickle(file)
    state = demo.state if isinstance(demo, Demo) else None
    observations = state.get("_observations") if isinstance(state, dict) else None
    if not isinstance(observations, list) or not observations:
        refuse(file, "holds no frames of RLBench: record or download it again")
    moments = []
    for index, observation in enumerate(observations):
        values = observation.state if isinstance(observation, Observation) else None
        misc = values.get("misc") if isinstance(values, dict) else None
        if not isinstance(misc, dict):
            refuse(file, f"frame {index} does not say how its cameras stand: use a newer RLBench")
        pose = read_numbers(file, "gripper_pose", values.get("gripper_pose"), (7,))
        if not abs(np.linalg.norm(pose[3:]) - 1) < 1e-3:
            refuse(file, f"gripper_pose of frame {index} has no unit quaternion: record it again")
        gripper_open = read_numbers(file, "gripper_open", values.get("gripper_open"), ())
        moments.append(Moment(state_of(pose, float(gripper_open)), misc))
    return moments


def depth_files(episode: EpisodeFolder, camera: str, frames: int) -> list[Path]:
    """The depth image of each frame; RecordingError if there are more or fewer, or others."""
    folder = episode.folder / f"{camera}_depth"
    if not folder.is_dir():
        refuse(folder, "is missing: record depth, too, or download it again")
    files = [folder / f"{frame}.png" for frame in range(frames)]
    count = len(list(folder.glob("*.png")))
    missing = [file.name for file in files if not file.is_file()]
    if count != frames or missing:
        which = f", and {missing[0]} is none of them" if missing else ""
        refuse(folder, f"has {count} images of {frames} frames{which}: download it again")
    return files


def read_depth(file: Path) -> np.ndarray:
    """An image of 24 bits -> depth (H, W) float64, from 0 at the near plane to 1 at the far one."""
    try:
        with PIL.Image.open(file) as image:
            pixels = np.asarray(image)
    except PermissionError as error:
        refuse(file, f"cannot be read: {error.strerror}")
    except (OSError, ValueError, SyntaxError, PIL.Image.DecompressionBombError) as error:
        refuse(file, f"is damaged or no image: {' '.join(str(error).split())}; download it again")
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.dtype != np.uint8:
        refuse(file, "is no depth in 24 bits (RGB): record it again with a newer RLBench")
    return pixels.astype(np.int64) @ [65536, 256, 1] / (2**24 - 1)
