"""Recordings: draws one, looks for what is wrong in them, and imports those of other projects.

    python convert.py --show data/reach.npz                                # draws it to a PNG
    python convert.py --check recordings                                   # what looks wrong
    python convert.py --import stir.zarr --instruction "Stir the soup."    # a replay buffer of DP3
    python convert.py --import folder/of/dataset --camera camera.json      # a dataset of LeRobot
    python convert.py --import demo.hdf5 --feature obs/front_depth ...     # robomimic, ManiSkill
    python convert.py --import folder/of/dataset --out data                # a data set of RLBench

Each format has one reader (`reader_of`), which yields frames and says what the source tells about
itself: how many frames and episodes there must be, and at which rate. `assemble` then does the same
for all of them: it holds the frames against that, cleans and samples the clouds, and makes a
recording of each task, as data.py describes it. Who needs zarr, pyarrow, h5py or av installs it.

**DP3**: a zarr group (format 2 or 3, a folder or a zip) with data/point_cloud (F, N, 3 or more),
data/state, data/action and meta/episode_ends. It does not name its task.

**LeRobot**, formats 2.0, 2.1 and 3.0: meta/info.json, the tasks, and in data/*/*.parquet
observation.state, action and either a cloud or depth: an array, a TIFF, or a 12-bit video.

**HDF5** of robomimic (data/demo_0 ...) and ManiSkill (traj_0 ...): actions, arrays that --state
names, and a cloud or depth.

**RLBench**: a data set, a task or a variation, as `rlbench-generate-dataset` writes them, with
folders `variation0` or `all_variations`. Points, states and actions are those of rlbench_data.py. A
recording is named by its task, and those of a task's further variations by `TASK-variation1`.
Episodes are counted through all folders, in their order.

A cloud is (N, 3 or more), (3 or more, N) or an image (H, W, 3 or more) of positions in metres.
Depth (H, W) needs its unit and the camera's intrinsics, from the data set or from --camera, see
`Camera`. A color is kept by --color: numbers 4 to 6 of a point, or the image of the same pixels.

Letters: F frames, T frames of an episode, N points, M points of a cloud before sampling, H x W
pixels, P numbers a point, S state dim, A action dim, E episodes.
"""

import argparse
import io
import json
import math
import re
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import PIL.Image

import rlbench_data
from common import UserError, command_line, progress_bar
from data import (
    NAME,
    Demonstrations,
    RecordingError,
    check_file,
    farthest_point_sample,
    is_numbers,
    load_demonstrations,
    save_demonstrations,
    suspicions,
)
from geometry import depth_to_points, has_depth, is_pose, thin, transform
from report import plot_demonstration


def refuse(path: Any, problem: str) -> NoReturn:
    raise RecordingError(f"{path}: {problem}")


def refuse_damaged(path: Path, error: Exception, expected: str) -> NoReturn:
    """Refuses what a library could not read; a pointer of git-lfs in its place is named."""
    files = [path] if path.is_file() else sorted(path.rglob("*"))
    for file in files:
        if file.is_file() and file.stat().st_size < 300:
            if file.read_bytes().startswith(b"version https://git-lfs"):
                refuse(file, "is a pointer of git-lfs, not the file itself: run `git lfs pull`")
    reason = " ".join(str(error).split())[:200]
    refuse(path, f"is damaged or {expected}: {reason}; download it again")


@contextmanager
def reading(path: Path, expected: str) -> Iterator[None]:
    """Turns whatever a library raises inside into a RecordingError that names the file."""
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:  # each library raises types of its own
        refuse_damaged(path, error, expected)


def readable(items: Iterator[Any], path: Path, expected: str) -> Iterator[Any]:
    """What a library reads of a file, piece by piece; RecordingError where it cannot."""
    end = object()
    while True:
        with reading(path, expected):
            item = next(items, end)
        if item is end:
            return
        yield item


def package(name: str, path: Path) -> Any:
    """An optional package; RecordingError says how to install it."""
    try:
        return import_module(name)
    except ImportError:
        top = name.split(".")[0]
        refuse(path, f"{top} is needed to read it: pip install {top}")


def read_json(path: Path) -> dict[str, Any]:
    """The object that a file holds; RecordingError if it holds none."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        refuse(path, f"cannot be read: {error.strerror}")
    except (ValueError, RecursionError) as error:
        refuse(path, f"is no JSON object: {error}")
    if not isinstance(value, dict):
        refuse(path, f"is no JSON object, but {type(value).__name__}")
    return value


# ---- What readers get and yield ------------------------------------------------------------------


@dataclass(frozen=True)
class Camera:
    """What the JSON file of --camera may hold.

    Without a pose, here or in the data set, points stay in their own frame, which is that of the
    camera for depth: right, down, forward. The positions in a state must be in the frame of the
    points. What stands here comes before what the data set says.
    """

    intrinsics: list | None = None  # fx, fy, cx, cy of the depth image, pixels
    depth_scale: float | None = None  # metres a unit of depth: 0.001 for millimetres
    camera_to_base: list | None = None  # (4, 4), the pose of the frame that points are in
    crop_low_m: list | None = None  # points outside this box are left out
    crop_high_m: list | None = None

    def __post_init__(self) -> None:
        """Raises ValueError for a value of another shape, or that no camera has."""
        shapes = {"intrinsics": (4,), "depth_scale": (), "camera_to_base": (4, 4)}
        for f in fields(self):
            value, shape = getattr(self, f.name), shapes.get(f.name, (3,))
            if value is None:
                continue
            if not is_numbers(value, shape):
                count = " x ".join(map(str, shape)) or "1"
                raise ValueError(f"{f.name}: give {count} finite numbers")
        if self.intrinsics is not None and min(self.intrinsics[:2]) <= 0:
            raise ValueError("intrinsics: two focal lengths in pixels, then the principal point")
        if self.depth_scale is not None and self.depth_scale <= 0:
            raise ValueError("depth_scale: metres a unit of depth, such as 0.001")
        if self.camera_to_base is not None:
            if not is_pose(np.array(self.camera_to_base, float)):
                raise ValueError(
                    "camera_to_base: its 3 x 3 must be a rotation, its last row 0 0 0 1"
                )

    def place(self, points: np.ndarray) -> np.ndarray:
        """Points (M, P) in the base frame, those in the crop box."""
        if self.camera_to_base is not None:
            points = transform(points, np.array(self.camera_to_base))
        low = -np.inf if self.crop_low_m is None else self.crop_low_m
        high = np.inf if self.crop_high_m is None else self.crop_high_m
        inside = (points[:, :3] >= low) & (points[:, :3] <= high)  # (M, 3)
        return points[inside.all(axis=1)]


@dataclass(frozen=True)
class Options:
    """What the command line says about a source."""

    instruction: str | None
    feature: str | None  # the name of the cloud or depth
    color: str | None  # None: is left out; "": there is one; otherwise its name
    state: list[str] | None  # the arrays that make a state, of HDF5
    skip: frozenset[int]  # episodes that are left out
    camera: Camera
    wrist: bool = False  # of RLBench: the camera at the wrist, too


@dataclass(frozen=True)
class Frame:
    """One frame, as a reader finds it; the frames of an episode follow each other."""

    episode: int
    index: int | None  # within its episode, from 0, where the source says it
    time: float | None  # seconds, where the source says it
    task: int  # which of the source's tasks
    instruction: Any  # what is done; None: the source does not say
    state: np.ndarray  # (S,)
    action: np.ndarray  # (A,)
    cloud: np.ndarray  # (M, P); positions may be NaN, colors stand in 3 to 5
    name: str | None = None  # of the task; None: it is made of the instruction


def skipped_frame(episode: int) -> Frame:
    """Stands for a frame of an episode that --skip names, so that the episode is counted."""
    nothing = np.zeros(0)
    return Frame(
        episode=episode,
        index=None,
        time=None,
        task=0,
        instruction=None,
        state=nothing,
        action=nothing,
        cloud=nothing,
    )


@dataclass(frozen=True)
class Source:
    """The frames of a data set, one after the other, and what it says about them elsewhere."""

    frames: Iterator[Frame]
    total_frames: int | None = None
    total_episodes: int | None = None
    lengths: dict[int, int] = field(default_factory=dict)  # episode -> frames
    fps: float | None = None
    unread: tuple[str, ...] = ()  # the arrays that the reader does not read
    left_out: tuple[str, ...] = ()  # what else it leaves out, as the line about a file says it
    meta: dict[str, Any] = field(default_factory=dict)  # what a recording's `meta` says of it


# ---- Clouds and depth ----------------------------------------------------------------------------

LENS = "fx, fy, cx, cy"
POINT_DIMS = range(3, 11)  # numbers a point may have


def cloud_axis(shape: tuple[int, ...]) -> int | None:
    """The axis of coordinates: -1 for (N, 3) and (H, W, 3), 0 for (3, N) and (3, H, W).

    None for an array that is no cloud: it has no such axis, or too few points.
    """
    if len(shape) not in (2, 3):
        return None
    for axis in (-1, 0):
        if shape[axis] in POINT_DIMS and math.prod(shape) // shape[axis] > POINT_DIMS[-1]:
            return axis
    return None


def as_cloud(path: Path, array: np.ndarray) -> np.ndarray:
    """A stored cloud -> (M, P) float32; RecordingError where its axes cannot be told apart."""
    axis = cloud_axis(array.shape)
    if axis is None:
        refuse(
            path,
            f"a cloud of shape {array.shape} is neither (points, 3 to 10) nor (3 to 10, points), "
            "with more than 10 points",
        )
    return np.moveaxis(array, axis, -1).reshape(-1, array.shape[axis]).astype(np.float32)


def depth_cloud(
    path: Path,
    row: dict[str, np.ndarray],
    *,
    depth: str,
    scale: float,
    camera: Camera,
    color: str | None = None,
    intrinsics: str | None = None,
    extrinsics: str | None = None,
) -> np.ndarray:
    """The points of the pixels that have depth, (M, 3) float32, or (M, 6) with colors.

    Args:
        row: name -> array of one frame. `depth`, `color`, `intrinsics` and `extrinsics` are names.
        scale: metres a unit of depth.
        camera: if it has intrinsics, they come before those of the row.
    """
    image = depth_image(path, depth, row[depth])  # (H, W)
    lens = camera.intrinsics
    if lens is None:
        lens = intrinsics_of(path, intrinsics, row[intrinsics], image)
    elif is_off_center(lens, image):
        H, W = image.shape
        warnings.warn(  # Python shows it once
            f"the principal point, {lens[2]:g}, {lens[3]:g}, is far from the middle of "
            f"the depth, {W} x {H}: are the intrinsics of --camera those of this resolution?",
            stacklevel=1,
        )
    metres = image.astype(np.float32) * np.float32(scale)
    points = depth_to_points(metres, lens)  # (M, 3)
    if color is not None:
        pixels = color_image(path, color, row[color], image)[has_depth(metres)]  # (M, 3)
        points = np.concatenate([points, pixels.astype(np.float32)], axis=1)
    if extrinsics is not None:  # from world to camera
        points = transform(points, camera_pose(path, extrinsics, row[extrinsics]))
    return points


def depth_image(path: Path, name: str, array: np.ndarray) -> np.ndarray:
    """Depth as (H, W), of (H, W), (H, W, 1) or (1, H, W)."""
    if array.ndim == 3 and 1 in (array.shape[0], array.shape[-1]):
        array = array[..., 0] if array.shape[-1] == 1 else array[0]
    if array.ndim != 2:
        refuse(path, f"{name} is no depth image (H, W), but {array.shape}")
    return array


def color_image(path: Path, name: str, color: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """A color image as (H, W, 3); RecordingError if its pixels are not those of the depth."""
    if color.ndim == 3 and color.shape[-1] not in (3, 4) and color.shape[0] in (3, 4):
        color = np.moveaxis(color, 0, -1)
    if color.ndim != 3 or color.shape[:2] != depth.shape or color.shape[2] not in (3, 4):
        refuse(
            path,
            f"the color {name} is {color.shape}, the depth {depth.shape}: its pixels must be those "
            "of the depth (H, W, 3), so align them first, or leave --color out",
        )
    return color[..., :3]


# What the name of an array may say beside which camera it is of. Not "color": the intrinsics of a
# color image are not those of depth.
NO_CAMERA = set(
    "obs observation observations images image sensor data param params camera cam depth "
    "intrinsic intrinsics extrinsic extrinsics cv k matrix".split()
)


def camera_of(name: str) -> set[str]:
    """What the name of an array says of its camera: of obs/front_depth {"front"}."""
    return set(re.split(r"\W|_", name.lower())) - NO_CAMERA - {""}


def of_same_camera(path: Path, depth: str, found: list[str]) -> str | None:
    """Which of the intrinsics or extrinsics `found` are of the camera of the depth.

    Those whose name says the same camera as the depth's; if there are none, those whose name says
    no camera. None where nothing was found; RecordingError unless exactly one is left.
    """
    if not found:
        return None
    chosen = [name for name in found if camera_of(name) == camera_of(depth)]
    if not chosen:
        chosen = [name for name in found if not camera_of(name)]
    if len(chosen) != 1:
        refuse(path, f"has {', '.join(found)}: write what belongs to {depth} to --camera")
    return chosen[0]


def is_off_center(intrinsics: list[float], depth: np.ndarray) -> bool:
    """Whether the principal point is far from the middle of the depth (H, W)."""
    H, W = depth.shape
    cx, cy = intrinsics[2:]
    return abs(cx - W / 2) >= W / 4 or abs(cy - H / 2) >= H / 4


def intrinsics_of(path: Path, name: str, intrinsics: np.ndarray, depth: np.ndarray) -> list[float]:
    """fx, fy, cx, cy of four numbers or a matrix (3, 3), of the camera that saw `depth` (H, W).

    RecordingError if they are no intrinsics, or the principal point is far from the image's middle.
    """
    if intrinsics.size == 9:
        matrix = intrinsics.reshape(3, 3)
        if matrix[2].tolist() != [0, 0, 1]:
            refuse(path, f"the last row of {name} is not 0, 0, 1: it may be transposed")
        intrinsics = matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    numbers = [float(x) for x in intrinsics.ravel()]
    try:
        Camera(intrinsics=numbers)
    except ValueError as error:
        refuse(path, f"{name} holds no intrinsics; {error}")
    if is_off_center(numbers, depth):
        H, W = depth.shape
        refuse(
            path,
            f"{name} has its principal point at {numbers[2]:g}, {numbers[3]:g}, far from the "
            f"middle of the depth, {W} x {H}: if it is right, write fx, fy, cx, cy to --camera",
        )
    return numbers


def camera_pose(path: Path, name: str, extrinsics: np.ndarray) -> np.ndarray:
    """The pose (4, 4) of a camera whose extrinsics (3, 4) or (4, 4) lead from world to camera."""
    if extrinsics.shape not in ((3, 4), (4, 4)):
        refuse(path, f"{name} has the shape {extrinsics.shape}, where extrinsics have (3, 4)")
    if len(extrinsics) == 3:
        extrinsics = np.vstack([extrinsics, [0, 0, 0, 1]])
    matrix = extrinsics.astype(np.float64)
    if not np.isfinite(matrix).all() or not is_pose(matrix):
        refuse(
            path,
            f"{name} is no pose of a camera: its 3 x 3 must be a rotation, its last row 0 0 0 1 "
            "(it may be transposed)",
        )
    return np.linalg.inv(matrix)


UNITS = {"m": 1.0, "mm": 0.001}  # metres


def unit_in_metres(path: Path, name: str, stated: Any, camera: Camera) -> float:
    """The unit of depth: that of the camera, or what the source says; refused if neither does."""
    if camera.depth_scale is not None:
        return camera.depth_scale
    scale = UNITS.get(stated, stated) if isinstance(stated, str) else stated
    if type(scale) not in (int, float) or not 0 < scale < math.inf:
        problem = "nothing says" if stated is None else f"{stated!r} does not say"
        refuse(path, f"{problem} in which unit {name} is: add --depth-unit mm, m, or metres a unit")
    return float(scale)


def choose_array(
    path: Path, shapes: dict[str, tuple[int, ...]], depth_maps: set[str], chosen: str | None
) -> tuple[str, bool]:
    """The cloud or depth to read, and whether it is depth.

    Args:
        shapes: name -> shape of one frame, of all arrays and images that there are.
        depth_maps: those that the source itself marks as depth.
        chosen: by --feature; None: the only cloud by its name, or else the only depth.
    """

    def is_depth(name: str) -> bool:
        return name in depth_maps or ("depth" in name and not re.search("point|cloud", name))

    clouds = [n for n in shapes if not is_depth(n) and cloud_axis(shapes[n]) is not None]
    depths = [n for n in shapes if is_depth(n) and sum(size > 1 for size in shapes[n]) == 2]
    if chosen in clouds:
        return chosen, False
    if chosen in depths:
        return chosen, True
    named = [n for n in clouds if re.search("point|cloud", n)]
    found = named or depths
    if chosen is None and len(found) == 1:
        return found[0], not named
    there = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
    problem = "name a cloud (N, 3) or depth (H, W) with --feature"
    if chosen is not None:
        problem = (
            f"{chosen} is neither a cloud (N, 3) nor depth (H, W): name another with --feature"
        )
    if chosen in shapes and not is_depth(chosen):
        problem += ", depth by a name that says so"
    refuse(path, f"{problem}; it holds {there}")


def check_color_has_no_name(path: Path, options: Options) -> None:
    """RecordingError for `--color NAME` where the points have colors of their own."""
    if options.color:
        refuse(
            path,
            "--color takes no name here: write --color alone if the points have six numbers, or "
            "leave it out",
        )


def check_flags(path: Path, options: Options, kind: str, useless: tuple[str, ...]) -> None:
    """RecordingError if a flag was given that has no meaning for a source of this kind."""
    for flag in useless:
        if getattr(options, flag):
            refuse(path, f"is {kind}, for which --{flag} has no meaning: leave it out")


# ---- DP3's zarr ----------------------------------------------------------------------------------

IN_ZARR = {
    "points": "data/point_cloud",
    "state": "data/state",
    "action": "data/action",
    "ends": "meta/episode_ends",
}


def read_zarr(path: Path, options: Options) -> Source:
    """A replay buffer of DP3."""
    arrays, unread = open_zarr(path)
    check_zarr(path, arrays)
    check_flags(path, options, "a zarr of DP3", ("feature", "state", "wrist"))
    check_color_has_no_name(path, options)
    with reading(path, "no zarr"):
        ends, state, action = (arrays[part][:] for part in ("ends", "state", "action"))
    if ends.dtype.kind not in "iu" or ends.ndim != 1 or (np.diff(ends, prepend=0) <= 0).any():
        refuse(path, "meta/episode_ends must be growing whole numbers")
    lengths = {name: arrays[part].shape[0] for part, name in IN_ZARR.items() if part != "ends"}
    lengths["meta/episode_ends"] = int(ends[-1]) if len(ends) else 0
    if len(set(lengths.values())) > 1:
        refuse(path, f"lengths differ: {lengths}")

    def frames() -> Iterator[Frame]:
        clouds = zarr_rows(path, arrays["points"])
        for episode, (start, end) in enumerate(pairwise([0, *ends.tolist()])):
            for i, cloud in zip(range(start, end), clouds):
                if episode in options.skip:
                    yield skipped_frame(episode)
                    continue
                yield Frame(
                    episode=episode,
                    index=i - start,
                    time=None,
                    task=0,
                    instruction=None,
                    state=state[i].ravel(),
                    action=action[i].ravel(),
                    cloud=as_cloud(path, cloud),
                )

    return Source(frames=frames(), total_frames=lengths["meta/episode_ends"], unread=unread)


def open_zarr(path: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The arrays of `IN_ZARR` that a folder or zip file has, and the names of others in data/."""
    zarr = package("zarr", path)
    with reading(path, "neither zarr, HDF5 nor a dataset of LeRobot"):
        if path.is_dir():
            group = zarr.open_group(path, mode="r")
        else:
            store = zarr.storage.ZipStore(path, mode="r")
            group = zarr.open_group(store, mode="r", path=folder_in_zip(path))
        arrays = {part: group[name] for part, name in IN_ZARR.items() if name in group}
        stored = [f"data/{name}" for name in group["data"]] if "data" in group else []
    return arrays, tuple(sorted(set(stored) - set(IN_ZARR.values())))


def check_zarr(path: Path, arrays: dict[str, Any]) -> None:
    """RecordingError where an array is missing, holds no numbers, or is not there as a whole."""
    if missing := [name for part, name in IN_ZARR.items() if part not in arrays]:
        refuse(path, f"it lacks {', '.join(missing)}: DP3 has {', '.join(IN_ZARR.values())}")
    for part, array in arrays.items():
        # A group has no dtype, and of an array of objects zarr would unpickle the elements.
        if not hasattr(array, "dtype") or array.dtype.kind not in "fiu" or array.ndim == 0:
            refuse(path, f"{IN_ZARR[part]} must be plain numbers")
    # zarr fills what is missing with zeros. Actions may be zeros, and such chunks are not stored.
    for part in ("points", "state"):
        chunks = arrays[part].nchunks
        missing = chunks - arrays[part].nchunks_initialized
        if missing > 0:
            refuse(
                path,
                f"{missing} of {chunks} chunks of {IN_ZARR[part]} are missing or hold nothing but "
                "zeros: download it again",
            )


def zarr_rows(path: Path, array: Any) -> Iterator[np.ndarray]:
    """The rows of an array, of which not all need fit into memory."""
    for start in range(0, array.shape[0], 64):
        with reading(path, "no zarr"):
            rows = array[start : start + 64]
        yield from rows


def folder_in_zip(path: Path) -> str:
    """Where in a zip file the group stands: at its root, or in the folder that was zipped."""
    with zipfile.ZipFile(path) as file:
        names = [Path(name) for name in file.namelist()]
    roots = [name.parent for name in names if name.name in (".zgroup", "zarr.json")]
    root = min(roots, key=lambda folder: len(folder.parts), default=Path("."))
    return "" if root == Path(".") else root.as_posix()


# ---- LeRobot -------------------------------------------------------------------------------------


def read_lerobot(path: Path, options: Options) -> Source:
    """A dataset of LeRobot."""
    check_flags(path, options, "a dataset of LeRobot", ("state", "wrist"))
    package("pyarrow.parquet", path)
    info = read_lerobot_info(path)
    dataset = LeRobot(path, info, options)
    return Source(
        frames=dataset.frames(),
        total_frames=info.get("total_frames"),
        total_episodes=info.get("total_episodes"),
        lengths={
            episode: row["length"]
            for episode, row in dataset.episodes.items()
            if type(row.get("length")) is int
        },
        fps=info.get("fps"),
        unread=dataset.unread(),
    )


def read_lerobot_info(path: Path) -> dict[str, Any]:
    """meta/info.json; RecordingError where it is of another version, or of another form."""
    file = path / "meta" / "info.json"
    info = read_json(file)
    version = str(info.get("codebase_version"))
    features = info.get("features", {})
    if version not in ("v2.0", "v2.1", "v3.0"):
        refuse(path, f"is of LeRobot's format {version}: convert it to v3.0 with lerobot")
    check_features(file, features)
    if missing := [name for name in ("observation.state", "action") if name not in features]:
        refuse(path, f"it lacks {', '.join(missing)}; it holds {', '.join(features)}")
    for name in ("total_frames", "total_episodes", "chunks_size", "fps"):
        kinds = (int, float) if name == "fps" else (int,)
        if name in info and (type(info[name]) not in kinds or not info[name] > 0):
            refuse(file, f"{name} is {info[name]!r}, no number above 0")
    return info


def check_features(file: Path, features: Any) -> None:
    """RecordingError unless all features say their dtype, shape and, if at all, more in objects."""
    if not isinstance(features, dict):
        refuse(file, "its features must be an object")
    for name, feature in features.items():
        shape = feature.get("shape") if isinstance(feature, dict) else None
        whole = isinstance(shape, list) and all(type(size) is int and size > 0 for size in shape)
        if not whole or not isinstance(feature.get("dtype"), str):
            refuse(file, f"{name} must have a dtype, and a shape of whole numbers")
        if not all(isinstance(feature.get(k) or {}, dict) for k in ("info", "video_info")):
            refuse(file, f"the info of {name} must be an object")


BOOKKEEPING = ("episode_index", "task_index", "frame_index", "timestamp", "index")


class LeRobot:
    """Reads frames of a dataset. Its constructor decides which features are read."""

    def __init__(self, path: Path, info: dict[str, Any], options: Options) -> None:
        self.path, self.info, self.camera = path, info, options.camera
        self.skip = options.skip
        self.features = info["features"]
        self.episodes = self.read_episodes()
        self.tasks = {} if options.instruction else self.read_tasks()
        shapes = {
            name: tuple(feature["shape"])
            for name, feature in self.features.items()
            if feature["dtype"] != "string" and name not in BOOKKEEPING
        }
        depth_maps = {name for name in shapes if self.depth_info(name) is not None}
        colored = {n for n in shapes if self.is_picture(n) and n not in depth_maps}
        data_shapes = {n: shape for n, shape in shapes.items() if n not in colored}
        try:
            self.cloud, self.is_depth = choose_array(path, data_shapes, depth_maps, options.feature)
        except RecordingError as error:
            pictures = ", ".join(f"{n} ({self.features[n]['dtype']})" for n in sorted(colored))
            raise RecordingError(f"{error}{', and ' + pictures if pictures else ''}") from None
        self.color = self.intrinsics = None
        if not self.is_depth:
            check_color_has_no_name(path, options)
        else:
            self.intrinsics = self.choose_intrinsics()
            self.scale = self.read_scale()
            if self.is_video(self.cloud):
                self.quantizer = self.read_quantizer()
            if options.color is not None:
                self.color = self.choose_color(colored, options.color)
        self.videos = {n: Video(self, n) for n in (self.cloud, self.color) if self.is_video(n)}

    def is_video(self, name: str | None) -> bool:
        return name is not None and self.features[name]["dtype"] == "video"

    def is_picture(self, name: str) -> bool:
        return self.features[name]["dtype"] in ("video", "image")

    def info_of(self, name: str) -> dict[str, Any]:
        """What the dataset says of a picture or video."""
        feature = self.features[name]
        return {**(feature.get("video_info") or {}), **(feature.get("info") or {})}

    def depth_info(self, name: str) -> dict[str, Any] | None:
        """What the dataset says of a depth map; None for a feature that is none."""
        info = self.info_of(name)
        return info if info.get("is_depth_map") or info.get("video.is_depth_map") else None

    def read_quantizer(self) -> dict[str, float]:
        """How metres became the codes of a depth video, see `dequantize`."""
        info = self.depth_info(self.cloud) or {}
        names = ("depth_min", "depth_max", "shift", "use_log")
        quantizer = {name: info.get(f"video.{name}") for name in names}
        missing = [n for n, value in quantizer.items() if type(value) not in (int, float, bool)]
        if missing:
            refuse(
                self.path / "meta" / "info.json",
                f"does not say video.{', video.'.join(missing)} of {self.cloud}: its depth cannot "
                "be decoded",
            )
        nearest, farthest = quantizer["depth_min"], quantizer["depth_max"]
        if quantizer["use_log"]:
            nearest, farthest = nearest + quantizer["shift"], farthest + quantizer["shift"]
        if not 0 <= nearest < farthest or (quantizer["use_log"] and nearest == 0):
            refuse(self.path, f"{self.cloud} has a range of depth that cannot be: {quantizer}")
        return quantizer

    def read_scale(self) -> float:
        """Metres a unit of the depth that is read.

        A video is decoded to metres, by what lerobot took for the unit of the depth it was given.
        If --camera names another unit, depth is multiplied by the ratio of that unit to lerobot's.
        """
        stated = self.info_of(self.cloud).get("depth_unit")
        if not self.is_video(self.cloud):
            return unit_in_metres(self.path, self.cloud, stated, self.camera)
        if self.camera.depth_scale is None:
            return 1.0
        if stated is None:
            refuse(
                self.path / "meta" / "info.json",
                f"does not say the depth_unit of {self.cloud}, with which another unit could be "
                "compared: leave out --depth-unit and depth_scale",
            )
        return self.camera.depth_scale / unit_in_metres(self.path, self.cloud, stated, Camera())

    def choose_intrinsics(self) -> str | None:
        if self.camera.intrinsics is not None:
            return None
        found = [name for name in self.features if "intrinsics" in name]
        if not found:
            refuse(self.path, f"{self.cloud} needs the camera's {LENS}: write them to --camera")
        return of_same_camera(self.path, self.cloud, found)

    def choose_color(self, colored: set[str], chosen: str) -> str:
        """The picture whose pixels are those of the depth."""
        if chosen in colored or (chosen == "" and len(colored) == 1):
            return chosen or next(iter(colored))
        there = ", ".join(sorted(colored)) or "none"
        refuse(self.path, f"name the color of {self.cloud}, --color NAME; its pictures: {there}")

    def unread(self) -> tuple[str, ...]:
        read = {"observation.state", "action", self.cloud, self.color, self.intrinsics}
        return tuple(n for n in self.features if n not in read and n not in BOOKKEEPING)

    def open_parquet(self, file: Path) -> Any:
        parquet = package("pyarrow.parquet", self.path)
        with reading(file, "no parquet file"):
            return parquet.ParquetFile(file)

    def read_table(self, file: Path) -> Any:
        """A whole table of meta/, but for the statistics in it."""
        stored = self.open_parquet(file)
        columns = [n for n in stored.schema_arrow.names if not n.startswith("stats/")]
        with reading(file, "no parquet file"):
            return stored.read(columns=columns)

    def read_episodes(self) -> dict[int, dict[str, Any]]:
        """episode -> what meta/ says of it: its length, and where in the videos it stands."""
        rows = []
        meta = self.path / "meta"
        if (meta / "episodes.jsonl").is_file():
            rows = read_all_json_lines(meta / "episodes.jsonl")
        for file in sorted((meta / "episodes").glob("*/*.parquet"), key=natural):
            rows += self.read_table(file).to_pylist()
        return {row["episode_index"]: row for row in rows if type(row.get("episode_index")) is int}

    def read_tasks(self) -> dict[int, Any]:
        """task_index -> instruction."""
        meta = self.path / "meta"
        if (meta / "tasks.parquet").exists():  # 3.0: the tasks are the index of a table of pandas
            table = self.read_table(meta / "tasks.parquet").to_pydict()
            index = table.pop("task_index", None)
            texts = [n for n in ("task", "__index_level_0__") if n in table] or list(table)
            if index is None or len(texts) != 1:
                refuse(meta / "tasks.parquet", "lacks task_index or task: add --instruction")
            return dict(zip(index, table[texts[0]]))
        if (meta / "tasks.jsonl").exists():
            rows = read_all_json_lines(meta / "tasks.jsonl")
            return {
                row["task_index"]: row.get("task")
                for row in rows
                if type(row.get("task_index")) is int
            }
        return {}

    def frames(self) -> Iterator[Frame]:
        """All frames, in the order of the files."""
        for file in sorted((self.path / "data").glob("*/*.parquet"), key=natural):
            stored = self.open_parquet(file)
            names = ["observation.state", "action", "episode_index", "task_index"]
            names += [n for n in (self.cloud, self.color, self.intrinsics) if n is not None]
            names = [n for n in names if n not in self.videos]
            there = set(stored.schema_arrow.names)
            names += [n for n in ("frame_index", "timestamp") if n in there]
            if missing := [n for n in names if n not in there]:
                refuse(file, f"lacks {', '.join(missing)}")
            batches = stored.iter_batches(64, columns=names)  # not all depth fits into memory
            for batch in readable(batches, file, "no parquet file"):
                yield from self.frames_of(file, {n: self.values(file, batch, n) for n in names})

    def values(self, file: Path, batch: Any, name: str) -> Any:
        """A column of nested lists -> (frames, *shape), the shape that the dataset says."""
        column = batch.column(name)
        if name in self.features and self.is_picture(name):
            return [(value or {}).get("bytes") for value in column.to_pylist()]
        shape = self.features.get(name, {}).get("shape", [1])
        while hasattr(column.type, "value_type"):
            column = column.flatten()
        values = column.to_numpy(zero_copy_only=False)
        if len(values) != len(batch) * math.prod(shape) or values.dtype.kind not in "fiu":
            refuse(file, f"{name} holds other than numbers of shape {shape}")
        if name in BOOKKEEPING and not np.isfinite(values).all():
            refuse(file, f"{name} is missing in some rows")
        return values.reshape(len(batch), *shape)

    def frames_of(self, file: Path, columns: dict[str, Any]) -> Iterator[Frame]:
        """The frames of one batch of rows."""
        for i in range(len(columns["action"])):
            row = {name: values[i] for name, values in columns.items()}
            episode = int(row["episode_index"].item())
            if episode in self.skip:
                yield skipped_frame(episode)
                continue
            index = int(row["frame_index"].item()) if "frame_index" in row else None
            time = float(row["timestamp"].item()) if "timestamp" in row else None
            task = int(row["task_index"].item())
            yield Frame(
                episode=episode,
                index=index,
                time=time,
                task=task,
                instruction=self.tasks.get(task),
                state=row["observation.state"].ravel(),
                action=row["action"].ravel(),
                cloud=self.make_cloud(file, row, episode, time),
            )

    def make_cloud(
        self, file: Path, row: dict[str, Any], episode: int, time: float | None
    ) -> np.ndarray:
        """The cloud of a row: as it is stored, or of its depth."""
        if not self.is_depth:
            return as_cloud(file, row[self.cloud])
        row = dict(row)  # with pictures decoded
        if self.is_video(self.cloud):
            codes = self.videos[self.cloud].at(episode, time, "gray12le")
            row[self.cloud] = dequantize(codes, **self.quantizer)
        elif self.is_picture(self.cloud):
            row[self.cloud] = decode_image(file, row[self.cloud], None)
        if self.color in self.videos:
            row[self.color] = self.videos[self.color].at(episode, time, "rgb24")
        elif self.color is not None:
            row[self.color] = decode_image(file, row[self.color], "RGB")
        return depth_cloud(
            file,
            row,
            depth=self.cloud,
            scale=self.scale,
            camera=self.camera,
            color=self.color,
            intrinsics=self.intrinsics,
        )


def natural(file: Path) -> list[int]:
    """The numbers in a path: file-999 comes before file-1000."""
    return [int(number) for number in re.findall(r"\d+", "/".join(file.parts[-2:]))]


def read_all_json_lines(path: Path) -> list[dict[str, Any]]:
    """The objects of a file, one a line; RecordingError where a line is none."""
    with reading(path, "no JSON, line by line"):
        lines = path.read_text(encoding="utf-8").splitlines()
        return [dict(json.loads(line)) for line in lines if line.strip()]


def decode_image(path: Path, data: Any, mode: str | None) -> np.ndarray:
    """An encoded image: (H, W) as it is for a depth map, or (H, W, 3) for the mode RGB."""
    if not isinstance(data, bytes):
        refuse(path, "its images are not in the file itself: download it with its images")
    with reading(path, "holds no images"), PIL.Image.open(io.BytesIO(data)) as opened:
        return np.asarray(opened.convert(mode) if mode else opened)


def dequantize(
    codes: np.ndarray, *, depth_min: float, depth_max: float, shift: float, use_log: float
) -> np.ndarray:
    """12-bit codes -> metres float32; 0 for the first and last code, which hold what is beyond."""
    fraction = codes.astype(np.float32) / 4095
    if use_log:
        low, high = math.log(depth_min + shift), math.log(depth_max + shift)
        metres = np.exp(low + fraction * (high - low)) - shift
    else:
        metres = depth_min + fraction * (depth_max - depth_min)
    return np.where((codes > 0) & (codes < 4095), metres, 0).astype(np.float32)


class Video:
    """The pictures of one feature of LeRobot, decoded from the first frame to the last."""

    def __init__(self, dataset: LeRobot, name: str) -> None:
        self.dataset, self.name = dataset, name
        self.av = package("av", dataset.path)
        self.fps = dataset.info.get("fps") or refuse(dataset.path, "meta/info.json lacks fps")
        self.file: Path | None = None

    def place(self, episode: int) -> tuple[Path, float]:
        """The file that an episode is in, and the second where it begins there."""
        info, row = self.dataset.info, self.dataset.episodes.get(episode, {})
        if info["codebase_version"] != "v3.0":
            chunk = episode // info.get("chunks_size", 1000)
            file = f"videos/chunk-{chunk:03d}/{self.name}/episode_{episode:06d}.mp4"
            return self.dataset.path / file, 0.0
        keys = [f"videos/{self.name}/{k}" for k in ("chunk_index", "file_index", "from_timestamp")]
        if missing := [key for key in keys if row.get(key) is None]:
            refuse(self.dataset.path, f"meta/episodes lacks {missing[0]} of episode {episode}")
        chunk, number, start = (row[key] for key in keys)
        file = f"videos/{self.name}/chunk-{chunk:03d}/file-{number:03d}.mp4"
        return self.dataset.path / file, float(start)

    def at(self, episode: int, time: float | None, pixel_format: str) -> np.ndarray:
        """The picture of an episode at a time in seconds, within half a frame."""
        if time is None:
            refuse(self.dataset.path, "data/ lacks timestamp, which a video needs")
        file, start = self.place(episode)
        if file != self.file:
            self.file, self.pictures, self.time = file, self.decode(file, pixel_format), -math.inf
        while self.time < start + time - 0.5 / self.fps:
            self.time, self.picture = next(self.pictures, (math.inf, None))
        if self.time > start + time + 0.5 / self.fps:
            refuse(file, f"lacks the picture at {start + time:.3f} s, episode {episode}")
        return self.picture

    def decode(self, file: Path, pixel_format: str) -> Iterator[tuple[float, np.ndarray]]:
        """Times and pictures of a file; depth must have 12 bits, or it was scaled by an encoder."""
        if not file.is_file():
            refuse(file, "is missing: download it again")
        with reading(file, "no video"):
            container = self.av.open(str(file))
        with container:
            for picture in readable(container.decode(video=0), file, "no video"):
                if pixel_format == "gray12le" and picture.format.components[0].bits != 12:
                    refuse(file, f"is {picture.format.name}, not depth in 12 bits")
                with reading(file, "no video"):
                    seconds = float(picture.pts * picture.time_base)
                    image = picture.to_ndarray(format=pixel_format)
                yield seconds, image


# ---- HDF5 of robomimic and ManiSkill -------------------------------------------------------------

HDF5_STATES = (  # of robomimic, LIBERO and ManiSkill; --state names others
    ["obs/robot0_eef_pos", "obs/robot0_eef_quat", "obs/robot0_gripper_qpos"],
    ["obs/ee_pos", "obs/ee_ori", "obs/gripper_states"],
    ["obs/agent/qpos", "obs/extra/tcp_pose"],
)


OF_DAMAGED_HDF5 = (OSError, KeyError, RuntimeError, ValueError)  # what h5py raises


def read_hdf5(path: Path, options: Options) -> Source:
    """Demonstrations of robomimic (data/demo_0 ...) or ManiSkill (traj_0 ...)."""
    check_flags(path, options, "a file of HDF5", ("wrist",))
    h5py = package("h5py", path)
    groups = {}
    with reading(path, "no HDF5 file"):
        file = h5py.File(path, "r")
        parent = file["data"] if isinstance(file.get("data"), h5py.Group) else file
        for name in parent:
            number = re.fullmatch(r"(?:demo|traj|episode)_(\d+)", name)
            if number and isinstance(parent.get(name), h5py.Group):
                groups[int(number[1])] = parent[name]
    groups = dict(sorted(groups.items()))
    if not groups:
        refuse(path, f"holds no data/demo_0 or traj_0; it holds {', '.join(file)}")
    kept = [group for episode, group in groups.items() if episode not in options.skip]
    if not kept:
        refuse(path, "--skip leaves no episode")
    first = hdf5_arrays(path, kept[0])
    if "actions" not in first:
        refuse(path, f"it lacks actions; an episode holds {', '.join(first)}")
    data = HDF5(path, first, options)
    longer = len(first[data.cloud]) == len(first["actions"]) + 1
    return Source(
        frames=data.frames(groups, libero_instruction(parent), options.skip),
        total_frames=hdf5_count(parent, "total"),
        lengths=hdf5_lengths(path, groups),
        unread=tuple(name for name in first if name not in data.read),
        left_out=("1 observation after each last action",) if longer else (),
    )


def hdf5_arrays(path: Path, group: Any) -> dict[str, Any]:
    """All arrays of numbers in a group of a file, by their path."""
    found = {}

    def visit(name: str, item: Any) -> None:
        if hasattr(item, "shape") and item.ndim > 0 and item.dtype.kind in "fiu":
            found[name] = item

    with reading(path, "no HDF5 file"):
        group.visititems(visit)
    return found


def hdf5_count(group: Any, name: str) -> int | None:
    """A whole number among the attributes of a group; None where it cannot be read."""
    try:
        value = np.asarray(group.attrs.get(name, np.nan))
    except OF_DAMAGED_HDF5:
        return None
    return int(value) if value.shape == () and value.dtype.kind in "iu" else None


def hdf5_lengths(path: Path, groups: dict[int, Any]) -> dict[int, int]:
    """episode -> frames, from attributes and from the JSON file beside those of ManiSkill."""
    lengths = {episode: hdf5_count(group, "num_samples") for episode, group in groups.items()}
    lengths = {episode: length for episode, length in lengths.items() if length is not None}
    beside = path.with_suffix(".json")
    if not lengths and beside.is_file():
        rows = read_json(beside).get("episodes")
        for row in rows if isinstance(rows, list) else []:
            if not isinstance(row, dict):
                continue
            episode, length = row.get("episode_id"), row.get("elapsed_steps")
            if type(episode) is int and type(length) is int:
                lengths[episode] = length
    return lengths


def libero_instruction(group: Any) -> str | None:
    """The instruction that LIBERO's files hold; others have none."""
    try:
        return json.loads(group.attrs["problem_info"])["language_instruction"]
    except (*OF_DAMAGED_HDF5, TypeError):
        return None


class HDF5:
    """Reads frames of demonstrations. The first one's arrays decide which are read."""

    def __init__(self, path: Path, first: dict[str, Any], options: Options) -> None:
        self.path, self.camera = path, options.camera
        self.state = options.state or next((s for s in HDF5_STATES if set(s) <= set(first)), None)
        if self.state is None or not set(self.state) <= set(first):
            refuse(path, f"name the arrays of the state with --state; there are {', '.join(first)}")

        observed = {
            name: array.shape[1:] for name, array in first.items() if name.startswith("obs/")
        }
        pictures = {n for n in observed if re.search(r"(rgb|image|color)[^/]*$", n)}
        pictures -= {n for n in pictures if re.search(r"(point|cloud|depth)[^/]*$", n)}
        shapes = {name: shape for name, shape in observed.items() if name not in pictures}
        self.cloud, self.is_depth = choose_array(path, shapes, set(), options.feature)

        self.color = self.intrinsics = self.extrinsics = None
        shape = observed[self.cloud]
        has_color = not self.is_depth and shape[cloud_axis(shape)] >= 6  # in the points themselves
        if has_color:
            check_color_has_no_name(path, options)
        elif options.color is not None:
            self.color = self.choose_color(pictures, options.color)
        if self.is_depth:
            self.scale = unit_in_metres(path, self.cloud, self.stated_unit(first), options.camera)
            if self.camera.intrinsics is None:
                self.intrinsics = self.choose_camera("intrinsic", first)
            if self.camera.camera_to_base is None:
                self.extrinsics = self.choose_camera("extrinsic_cv", first)
            if self.intrinsics is None and self.camera.intrinsics is None:
                refuse(path, f"{self.cloud} needs the camera's {LENS}: write them to --camera")
        cameras = (self.intrinsics, self.extrinsics)
        self.read = {"actions", *self.state, self.cloud, self.color, *cameras}

    def stated_unit(self, first: dict[str, Any]) -> Any:
        """The unit of depth, if an attribute of the array says it."""
        attributes = first[self.cloud].attrs
        for name in ("depth_unit", "unit", "depth_scale"):
            if name in attributes:
                unit = attributes[name]
                unit = unit.item() if isinstance(unit, np.generic) else unit
                return unit.decode(errors="replace") if isinstance(unit, bytes) else unit
        return None

    def choose_color(self, pictures: set[str], chosen: str) -> str:
        """The only picture, or the one that is named as the cloud or depth is."""
        beginning = re.sub("(depth|xyzw?)$", "", self.cloud)
        found = [n for n in pictures if n.startswith(beginning)] or list(pictures)
        if chosen in pictures or (chosen == "" and len(found) == 1):
            return chosen or found[0]
        there = ", ".join(sorted(pictures)) or "none"
        refuse(self.path, f"name the color of {self.cloud}, --color NAME; its pictures: {there}")

    def choose_camera(self, kind: str, first: dict[str, Any]) -> str | None:
        """The intrinsics or extrinsics of the camera of the depth, if there are any.

        ManiSkill has obs/sensor_data/CAMERA/depth and obs/sensor_param/CAMERA/intrinsic_cv.
        """
        found = [name for name in first if kind in name.rpartition("/")[2]]
        return of_same_camera(self.path, self.cloud, found)

    def frames(
        self, groups: dict[int, Any], instruction: str | None, skip: frozenset[int]
    ) -> Iterator[Frame]:
        """The frames of all episodes; an observation after the last action is left out."""
        for episode, group in groups.items():
            if episode in skip:
                yield skipped_frame(episode)
                continue
            arrays = hdf5_arrays(self.path, group)
            T = len(arrays["actions"]) if "actions" in arrays else 0
            advice = f"leave it out by --skip {episode}"
            if T == 0:
                refuse(self.path, f"episode {episode} has no actions: {advice}")
            for name in sorted(self.read - {None}):
                if name not in arrays or len(arrays[name]) not in (T, T + 1):
                    refuse(
                        self.path,
                        f"episode {episode} has {T} actions, but not as many of {name}: {advice}",
                    )
            with reading(self.path, "no HDF5 file"):
                action = arrays["actions"][:].reshape(T, -1)
                parts = [arrays[name][:T].reshape(T, -1) for name in self.state]
            state = np.concatenate(parts, axis=1)
            for i in range(T):
                yield Frame(
                    episode=episode,
                    index=i,
                    time=None,
                    task=0,
                    instruction=instruction,
                    state=state[i],
                    action=action[i],
                    cloud=self.make_cloud(arrays, i),
                )

    def make_cloud(self, arrays: dict[str, Any], i: int) -> np.ndarray:
        """The cloud of frame i of an episode: as it is stored, or of its depth."""
        names = {self.cloud, self.color, self.intrinsics, self.extrinsics} - {None}
        with reading(self.path, "no HDF5 file"):
            row = {name: arrays[name][i] for name in names}
        if not self.is_depth:
            return self.colored_cloud(row)
        return depth_cloud(
            self.path,
            row,
            depth=self.cloud,
            scale=self.scale,
            camera=self.camera,
            color=self.color,
            intrinsics=self.intrinsics,
            extrinsics=self.extrinsics,
        )

    def colored_cloud(self, row: dict[str, np.ndarray]) -> np.ndarray:
        """A stored cloud, with the colors that stand beside it."""
        points = as_cloud(self.path, row[self.cloud])
        if self.cloud.endswith("xyzw"):  # homogeneous: w is 0 where nothing was seen
            points = np.where(points[:, 3:] > 0, points[:, :3], np.float32(np.nan))
        if self.color is None:
            return points
        colors = row[self.color]
        colors = colors.reshape(-1, colors.shape[-1])[:, :3]
        if colors.shape != (len(points), 3):
            refuse(self.path, f"{self.color} has {len(colors)} colors for {len(points)} points")
        return np.concatenate([points[:, :3], colors], axis=1).astype(np.float32)


# ---- RLBench -------------------------------------------------------------------------------------


def read_rlbench(path: Path, options: Options) -> Source:
    """A data set of RLBench, or one of its tasks or variations."""
    check_flags(path, options, "a data set of RLBench", ("feature", "state"))
    camera = options.camera
    if (camera.intrinsics, camera.depth_scale, camera.camera_to_base) != (None, None, None):
        refuse(path, "says itself how its cameras stand: of --camera only the crop box is used")
    low, high = rlbench_data.WORKSPACE
    workspace = [list(camera.crop_low_m or low), list(camera.crop_high_m or high)]
    cameras = [*rlbench_data.CAMERAS, *([rlbench_data.WRIST] if options.wrist else [])]

    episodes = rlbench_data.find_episodes(path)
    folders = {entry.name for entry in episodes[0].folder.iterdir() if entry.is_dir()}
    unread = folders - {f"{name}_depth" for name in cameras}
    return Source(
        frames=rlbench_frames(episodes, cameras, workspace, options),
        total_episodes=len(episodes),
        unread=tuple(sorted(unread)),
        left_out=("the last frame of each episode, after which nothing is done",),
        meta={**rlbench_data.RECIPE, "cameras": cameras, "workspace": workspace},
    )


def rlbench_frames(
    episodes: list[rlbench_data.EpisodeFolder],
    cameras: list[str],
    workspace: list[list[float]],
    options: Options,
) -> Iterator[Frame]:
    """The frames of all episodes but the last of each.

    The action of a frame is what leads to the next one.
    """
    tasks: dict[str, int] = {}  # name -> its number
    for number, episode in enumerate(episodes):
        if number in options.skip:
            yield skipped_frame(number)
            continue
        moments = rlbench_data.read_moments(episode)
        if len(moments) < 2:
            refuse(
                episode.folder,
                "has a single frame, so that nothing is done in it: leave it out by "
                f"--skip {number}",
            )
        files = {
            camera: rlbench_data.depth_files(episode, camera, len(moments)) for camera in cameras
        }
        variation = rlbench_data.read_variation(episode, moments)
        name = rlbench_data.task_name(episode.task, variation)
        task = tasks.setdefault(name, len(tasks))
        described = None if options.instruction else rlbench_data.read_instruction(episode)
        for i, (moment, following) in enumerate(pairwise(moments)):
            yield Frame(
                episode=number,
                index=i,
                time=None,
                task=task,
                instruction=described,
                state=moment.state,
                action=rlbench_data.action_between(moment.state, following.state),
                cloud=rlbench_cloud(
                    moment, {camera: files[camera][i] for camera in cameras}, workspace
                ),
                name=name,
            )


def rlbench_cloud(
    moment: rlbench_data.Moment, files: dict[str, Path], workspace: list[list[float]]
) -> np.ndarray:
    """What the cameras see, of a frame's depth images: camera -> file."""
    views = [
        rlbench_data.read_view(file, moment.misc, camera, rlbench_data.read_depth(file))
        for camera, file in files.items()
    ]
    return rlbench_data.seen_points(views, workspace)


# ---- The formats ---------------------------------------------------------------------------------


def is_hdf5(path: Path) -> bool:
    """By its name, so that a damaged one is called that, or by how the file begins."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return path.suffix in (".h5", ".hdf5") or file.read(8) == b"\x89HDF\r\n\x1a\n"


def reader_of(path: Path) -> Callable[[Path, Options], Source]:
    """The function that reads a data set of its format."""
    if (path / "meta" / "info.json").is_file():
        return read_lerobot
    if is_hdf5(path):
        return read_hdf5
    if rlbench_data.is_data_set(path):
        return read_rlbench
    return read_zarr


# ---- One check for all of them -------------------------------------------------------------------


@dataclass
class Episode:
    """The frames of one episode, or of a part of it that does one task."""

    number: int  # what the source calls it
    task: int
    instruction: str
    name: str | None = None  # of the task, where the source says it
    clouds: list[np.ndarray | None] = field(default_factory=list)  # None: nothing was seen
    states: list[np.ndarray] = field(default_factory=list)
    actions: list[np.ndarray] = field(default_factory=list)
    unseen_points: int = 0  # at NaN or at the origin; left out
    extra_numbers: int = 0  # of each point, beside its position and color; left out
    empty_clouds: int = 0  # in whose place stands the one before


def assemble(
    path: Path, source: Source, options: Options, *, num_points: int, incomplete: bool
) -> tuple[list[list[Episode]], list[str]]:
    """Reads all frames, and checks and cleans them: the one way from a reader to a recording.

    Returns the episodes of each task, in the order of the source, and what is left out of all of
    them. A task is what has one instruction, and one name where the source says names. Raises
    RecordingError where the source contradicts itself or lacks something.
    """
    episodes, lengths = read_episodes(path, source, options, num_points)
    notes = list(source.left_out)
    if unknown := sorted(options.skip - set(lengths)):
        refuse(path, f"has no episode {unknown[0]} to --skip")
    notes += [f"episode {number} (--skip)" for number in sorted(options.skip)]
    if problem := wrong_totals(source, lengths, options.skip):
        if not incomplete:
            refuse(path, f"{problem}: download it again, or import what there is by --incomplete")
        notes.append(f"what is missing ({problem})")
    if not episodes and options.skip:
        refuse(path, "--skip leaves no episode of it")
    if not episodes:
        refuse(path, "holds no frames: record or download it again")
    if parts := len(episodes) - len({episode.number for episode in episodes}):
        notes.append(f"{parts} changes of task within an episode, which is cut there")
    if source.unread:
        names = ", ".join(source.unread[:6]) + (", ..." if len(source.unread) > 6 else "")
        notes.append(f"{len(source.unread)} arrays ({names})")

    for episode in episodes:
        fill_empty(path, episode)
    if options.color is not None:
        scale_colors(path, episodes)
    tasks: dict[tuple[str | None, str], list[Episode]] = {}
    for episode in episodes:
        tasks.setdefault((episode.name, episode.instruction), []).append(episode)
    return list(tasks.values()), notes


def read_episodes(
    path: Path, source: Source, options: Options, num_points: int
) -> tuple[list[Episode], Counter]:
    """The episodes that --skip does not name, and how many frames each of the source has."""
    episodes: list[Episode] = []
    lengths: Counter = Counter()  # episode -> frames
    previous = None
    with progress_bar(desc="reading", total=source.total_frames, unit="frame") as progress:
        for frame in source.frames:
            progress.update()
            first = lengths[frame.episode] == 0
            lengths[frame.episode] += 1
            if frame.episode not in options.skip:
                check_order(path, frame, None if first else previous, source.fps)
                if first or frame.task != previous.task:
                    instruction = choose_instruction(path, frame, options.instruction)
                    episodes.append(Episode(frame.episode, frame.task, instruction, frame.name))
                    if options.instruction and frame.task != episodes[0].task:
                        refuse(path, "holds several tasks: leave --instruction out")
                add_frame(path, episodes[-1], frame, options, num_points)
            previous = frame
    return episodes, lengths


def choose_instruction(path: Path, frame: Frame, given: str | None) -> str:
    """What is done: the instruction that is given, or else what the source says."""
    instruction = given or frame.instruction
    if isinstance(instruction, str) and instruction.strip():
        return instruction
    problem = "does not say"
    if instruction is not None:
        problem = f"says by {instruction!r}, which is no text,"
    refuse(path, f'it {problem} what is done: add --instruction "Stir the soup."')


def check_order(path: Path, frame: Frame, previous: Frame | None, fps: float | None) -> None:
    """RecordingError if a frame does not follow the one before it in its episode (None: is first).

    Frames are numbered from 0 without a gap, and the times of two in a row are one period of the
    data set's rate apart.
    """
    skip = f"download it again, or leave the episode out by --skip {frame.episode}"
    expected = 0 if previous is None or previous.index is None else previous.index + 1
    if previous is not None and frame.episode != previous.episode:
        refuse(path, f"episode {frame.episode} goes on after episode {previous.episode}: {skip}")
    if frame.index is not None and frame.index != expected:
        refuse(
            path, f"episode {frame.episode}: frame {frame.index} where {expected} belongs: {skip}"
        )
    if fps and previous is not None and frame.time is not None and previous.time is not None:
        step = (frame.time - previous.time) * fps
        if not 0.5 < step < 1.5:
            before = "a frame" if previous.index is None else f"frame {previous.index}"
            refuse(
                path,
                f"episode {frame.episode}: {step / fps:.3f} s lie between {before} and "
                f"the next, where {fps:g} frames a second are {1 / fps:.3f} s apart: {skip}",
            )


def wrong_totals(source: Source, lengths: Counter, skip: frozenset[int]) -> str | None:
    """How the frames that were read differ from what the source says about itself elsewhere.

    Args:
        lengths: episode -> frames that were read.
        skip: episodes that may have any length.
    """
    numbers = set(range(source.total_episodes or 0)) | set(source.lengths)
    if missing := sorted(numbers - set(lengths)):
        listed = ", ".join(map(str, missing[:8])) + (", ..." if len(missing) > 8 else "")
        return f"of {len(numbers)} episodes {len(missing)} are missing ({listed})"
    for episode, length in source.lengths.items():
        if lengths[episode] != length and episode not in skip:
            return f"episode {episode} should have {length} frames, but has {lengths[episode]}"
    total, episodes = sum(lengths.values()), len(lengths)
    if source.total_episodes not in (None, episodes):
        return f"it should have {source.total_episodes} episodes, but has {episodes}"
    if source.total_frames not in (None, total) and not skip:
        return f"it should have {source.total_frames} frames, but has {total}"
    return None


def add_frame(
    path: Path, episode: Episode, frame: Frame, options: Options, num_points: int
) -> None:
    """Appends state and action unchanged, and the cloud cleaned, cropped and sampled."""
    index = len(episode.states) if frame.index is None else frame.index
    for name, value in (("state", frame.state), ("action", frame.action)):
        if not np.isfinite(value).all():
            refuse(
                path,
                f"{name} of episode {frame.episode} holds NaN or infinity in frame {index}: "
                f"leave the episode out by --skip {frame.episode}",
            )
    episode.states.append(np.float64(frame.state))
    episode.actions.append(np.float64(frame.action))

    points = frame.cloud  # (M, P)
    xyz = points[:, :3]
    seen = np.isfinite(xyz).all(axis=1) & (xyz != 0).any(axis=1)
    episode.unseen_points += int((~seen).sum())
    points = options.camera.place(points[seen])
    kept = 3 if options.color is None else 6
    if points.shape[1] < kept:
        refuse(path, f"its points have {points.shape[1]} numbers, so no color: leave --color out")
    episode.extra_numbers = points.shape[1] - kept
    if len(points) == 0:
        episode.clouds.append(None)
        return
    points = np.ascontiguousarray(thin(points)[:, :kept])
    episode.clouds.append(farthest_point_sample(points, num_points))


def fill_empty(path: Path, episode: Episode) -> None:
    """Frames in which nothing is seen show what was seen before them, if they are few.

    At the beginning they show what is seen first.
    """
    clouds = episode.clouds
    empty = [i for i, cloud in enumerate(clouds) if cloud is None]
    if len(empty) > max(1, len(clouds) // 10) or len(empty) == len(clouds):
        refuse(
            path,
            f"nothing is seen in {len(empty)} of {len(clouds)} frames of episode {episode.number}, "
            f"first in frame {empty[0]}: look at the unit, at --camera's crop box and pose, or "
            f"leave the episode out by --skip {episode.number}",
        )
    first_seen = next(cloud for cloud in clouds if cloud is not None)
    for i in empty:  # in their order, so that the cloud before is never empty
        clouds[i] = (clouds[i - 1] if i > 0 else first_seen).copy()
    episode.empty_clouds = len(empty)


def scale_colors(path: Path, episodes: list[Episode]) -> None:
    """Colors from 0 to 1, of colors that reach 1 or 255 in the whole data set."""
    clouds = [cloud for episode in episodes for cloud in episode.clouds]
    low = min(float(cloud[:, 3:].min()) for cloud in clouds)
    high = max(float(cloud[:, 3:].max()) for cloud in clouds)
    if not 0 <= low <= high <= 255:
        refuse(
            path,
            f"numbers 4 to 6 of its points reach from {low:g} to {high:g}, where colors reach from "
            "0 to 1 or 255: leave --color out",
        )
    for cloud in clouds:
        if high > 1.5:  # of 255
            cloud[:, 3:] /= 255
        else:  # of 1, which rounding may exceed
            cloud[:, 3:] = cloud[:, 3:].clip(0, 1)


def as_float16(path: Path, points: np.ndarray) -> np.ndarray:
    """Points (F, N, P) float16; RecordingError where that keeps too little of their positions."""
    xyz = points[..., :3]
    reach, span = float(np.abs(xyz).max()), float(np.ptp(xyz, axis=(0, 1)).max())
    if reach > 100:
        refuse(path, f"points reach {reach:g}, beyond 100 metres: write them in metres")
    step = float(np.spacing(np.float16(reach)))
    if step > max(0.02 * span, 0.005):
        refuse(
            path,
            f"points lie {reach:.3g} m from the origin, but span {span:.3g} m: float16 keeps them "
            f"to {step:.2g} m, so move the origin to them by camera_to_base of --camera",
        )
    return np.float16(points)


# ---- Command line --------------------------------------------------------------------------------


def read_camera(path: Path) -> Camera:
    """The file of --camera; RecordingError for what `Camera` does not have."""
    given = read_json(path)
    names = [f.name for f in fields(Camera)]
    if unknown := [name for name in given if name not in names]:
        refuse(path, f"{unknown[0]} is none of {', '.join(names)}")
    try:
        return Camera(**given)
    except ValueError as error:
        refuse(path, str(error))


def read_options(args: argparse.Namespace) -> Options:
    camera = read_camera(Path(args.camera)) if args.camera else Camera()
    if args.depth_unit is not None:
        try:
            scale = UNITS.get(args.depth_unit) or float(args.depth_unit)
            camera = replace(camera, depth_scale=scale)
        except ValueError:
            raise UserError(
                f"--depth-unit is {args.depth_unit}: use mm, m, or metres a unit, such as 0.0001"
            ) from None
    return Options(
        instruction=args.instruction,
        feature=args.feature,
        color=args.color,
        state=args.state,
        skip=frozenset(args.skip),
        camera=camera,
        wrist=args.wrist,
    )


def import_recordings(args: argparse.Namespace) -> None:
    """Writes a file for each task that was found, and says what was left out of it."""
    path = Path(args.import_)
    out = Path(args.out or "recordings")
    if args.num_points < 1:
        raise UserError(f"--num-points is {args.num_points}: use at least 1")
    if out.suffix == ".npz" or any(folder.is_file() for folder in (out, *out.parents)):
        raise UserError(f"--out is {out}: name a folder, in which each task will have a file")
    if args.task is not None and not re.fullmatch(NAME, args.task):
        raise UserError(f"--task {args.task!r}: use letters, digits, '-', '_' and '.'")
    if not path.exists():
        refuse(path, "is missing: look at --import")
    options = read_options(args)
    if args.task and (out / f"{args.task}.npz").exists():  # before all is read
        refuse(out / f"{args.task}.npz", "already exists: move it, or use another --task or --out")
    read = reader_of(path)
    source = read(path, options)
    tasks, notes = assemble(
        path, source, options, num_points=args.num_points, incomplete=args.incomplete
    )
    if args.task and len(tasks) > 1:
        refuse(
            path, f"holds {len(tasks)} tasks, which are named by what they say: leave --task out"
        )

    meta = {
        **source.meta,
        "imported_from": path.name,
        "num_points": args.num_points,
        "positions_in_state": source.meta.get("positions_in_state", 0),
    }
    if args.positions_in_state is not None:
        meta["positions_in_state"] = args.positions_in_state
    recordings = {}
    for name, episodes in zip(task_names(tasks, args.task), tasks):
        file = out / f"{name}.npz"
        if file.exists():
            other = "another --out" if len(tasks) > 1 else "another --task or --out"
            refuse(file, f"already exists: move it, or use {other}")
        recordings[file] = to_recording(path, name, episodes, meta)
    for (file, recording), episodes in zip(recordings.items(), tasks):
        save_demonstrations(file, recording)
        print(describe(file, recording, episodes, notes))
        print_suspicions(file, recording)


def task_names(tasks: list[list[Episode]], given: str | None) -> list[str]:
    """A name for each task, the source's or else made of the words of its instruction.

    The second of two equal ones ends in 2.
    """
    names: list[str] = []
    for episode, *_ in tasks:
        words = re.sub(r"\W+", "-", episode.instruction.lower()).strip("-")[:60]
        name = given or episode.name or words or "task"
        number, unique = 1, name
        while unique in names:
            number += 1
            unique = f"{name}-{number}"
        names.append(unique)
    return names


def to_recording(
    path: Path, name: str, episodes: list[Episode], meta: dict[str, Any]
) -> Demonstrations:
    """The episodes of a task, one after the other, checked."""
    for part in ("states", "actions"):
        sizes = {len(value) for episode in episodes for value in getattr(episode, part)}
        if len(sizes) > 1:
            refuse(path, f"{part} have {' or '.join(map(str, sorted(sizes)))} numbers")
    clouds = [cloud for episode in episodes for cloud in episode.clouds]
    recording = Demonstrations(
        task=name,
        instruction=episodes[0].instruction,
        points=as_float16(path, np.stack(clouds)),
        state=np.float32([state for episode in episodes for state in episode.states]),
        action=np.float32([action for episode in episodes for action in episode.actions]),
        episode_ends=np.cumsum([len(episode.states) for episode in episodes]),
        meta=meta,
    )
    check_file(path, recording)
    return recording


def describe(
    file: Path, recording: Demonstrations, episodes: list[Episode], notes: list[str]
) -> str:
    """The line about a file: what it holds, and what was left out."""
    shapes = [f"{part} {getattr(recording, part).shape}" for part in ("points", "state", "action")]
    beside = "x, y, z of each point (--color keeps colors)"
    if recording.points.shape[2] == 6:
        beside = "position and color of each point"
    counts = {
        "points at NaN or at the origin": sum(e.unseen_points for e in episodes),
        f"numbers beside {beside}": max(e.extra_numbers for e in episodes),
        "empty clouds, in whose place stands the one before": sum(e.empty_clouds for e in episodes),
    }
    left_out = [f"{count} {what}" for what, count in counts.items() if count] + notes
    return (
        f"wrote {file}: {len(recording)} episodes of {recording.instruction!r}, "
        f"{', '.join(shapes)}; left out: {'; '.join(left_out) or 'nothing'}"
    )


def print_suspicions(file: Path, recording: Demonstrations) -> int:
    """Prints what looks wrong in a recording, one line each; returns how many."""
    lines = suspicions(recording)
    for line in lines:
        print(f"{file}: {line}")
    return len(lines)


def check(path: Path) -> None:
    """Prints the suspicions about a recording, or all those of a folder; errors end it."""
    files = sorted(path.glob("*.npz")) if path.is_dir() else [path]
    if not files:
        refuse(path, "holds no recordings (.npz)")
    found = sum(print_suspicions(file, load_demonstrations(file)) for file in files)
    print(f"files checked: {len(files)}, suspicions: {found}")


def show(path: str, out: str | None, episode: int) -> None:
    """Draws an episode of a recording."""
    picture = Path(out) if out else Path(path).parent / f"{Path(path).stem}.png"
    if out and picture.suffix != ".png":
        raise UserError(f"--out is {out}: name a .png file")
    if out and not picture.parent.is_dir():
        raise UserError(f"--out is {out}: its folder does not exist")
    recording = load_demonstrations(path)
    if not 0 <= episode < len(recording):
        refuse(path, f"holds episodes 0 to {len(recording) - 1}, not {episode}")
    plot_demonstration(recording, picture, episode)
    print(f"wrote {picture}")
    print_suspicions(Path(path), recording)


POSITIONS_HELP = (
    "how many points x, y, z a state begins with, in metres and in the frame of the points: 1 for "
    "a pose (x, y, z, then a rotation and a gripper) whose actions begin with the change of x, y, "
    "z; 0 for joint angles, or if unsure. Augmentation moves these with the points; rotations stay "
    "as they are, wrong by up to 16 degrees (default: 0; for RLBench 1, whose rotations turn, too)"
)


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Draws or checks recordings, or imports those of DP3, LeRobot, HDF5 or RLBench."
    )
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--show", metavar="FILE", help="draw an episode of a recording")
    what.add_argument("--check", metavar="PATH", help="say what looks wrong in a file or folder")
    what.add_argument("--import", dest="import_", metavar="PATH", help="other projects' recordings")
    parser.add_argument("--out", help="picture (FILE with .png), or folder of files (recordings)")
    add = parser.add_argument_group("to show").add_argument
    add("--episode", type=int, default=0, help="which (default: 0, the first)")
    add = parser.add_argument_group("to import").add_argument
    add("--instruction", help="what is done, a sentence (default: the data set's own)")
    add("--task", help="its name, and the file's (default: made of the instruction)")
    add("--num-points", type=int, default=512, help="points that are kept of a cloud (512)")
    add("--positions-in-state", type=int, help=POSITIONS_HELP)
    add("--feature", metavar="NAME", help="the clouds or depth, if there are several")
    add("--state", metavar="NAME", nargs="+", help="of HDF5: the arrays of a state, in order")
    add("--camera", metavar="JSON", help="intrinsics, and its pose and crop box: convert.Camera")
    add("--depth-unit", metavar="UNIT", help="of depth: mm, m, or metres a unit, such as 0.0001")
    color = "keep colors, from 0 to 1; the name of their image, if there are several"
    add("--color", metavar="NAME", nargs="?", const="", help=color)
    add("--wrist", action="store_true", help="of RLBench: use the camera at the wrist, too")
    add("--skip", metavar="EPISODE", type=int, nargs="+", default=[], help="leave these out")
    add("--incomplete", action="store_true", help="though frames or episodes are missing")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    args = parse(argv)
    if args.import_ is not None:
        import_recordings(args)
    elif args.check is not None:
        check(Path(args.check))
    else:
        show(args.show, args.out, args.episode)


if __name__ == "__main__":
    command_line(main, errors=(RecordingError,))
