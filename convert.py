"""Draws a recording, or imports those of other projects.

    python convert.py --show data/reach.npz                                # draws it to a PNG
    python convert.py --import stir.zarr --instruction "Stir the soup."    # a replay buffer of DP3
    python convert.py --import folder/of/dataset --camera camera.json      # a dataset of LeRobot

**DP3**: a zarr group (format 2 or 3, a folder or a zip) with data/point_cloud (F, N, 3 or more;
colours are left out), data/state, data/action and meta/episode_ends. It does not name its task.

**LeRobot**, formats 2.0, 2.1 and 3.0: meta/info.json, tasks.jsonl or tasks.parquet, and in
data/*/*.parquet observation.state, action and one array, by its name a cloud (N, 3 or more) or
depth (H, W), uint16 millimetres or float metres. The format has no place for a camera: intrinsics
are a feature of that name, (4,) or (3, 3), or in the file of --camera, which comes first, see
`CAMERA`. Videos are not read.

Every task becomes a file as data.py describes it. Who needs zarr or pyarrow installs it.

Letters: F frames, N points, H x W pixels, S state dim, A action dim, E episodes.
"""

import argparse
import json
import re
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

import numpy as np

from common import UserError, command_line, progress_bar
from data import (
    Demonstrations,
    RecordingError,
    farthest_point_sample,
    load_demonstrations,
    save_demonstrations,
)
from report import plot_demonstration
from robot import CameraError, check_value, cloud

# What the JSON of --camera may hold. Without a pose points stay in the frame of the camera: right,
# down, forward. The positions in a state must be in the frame of the points.
CAMERA = {
    "intrinsics": None,  # fx, fy, cx, cy of the depth image, pixels
    "camera_to_base": np.eye(4).tolist(),
    "crop_low_m": [-99.0] * 3,  # points outside this box are left out
    "crop_high_m": [99.0] * 3,
}

Recordings = dict[str, dict[str, np.ndarray]]  # instruction -> points, state, action, episode_ends


def refuse(path: Any, what: str) -> NoReturn:
    raise RecordingError(f"{path}: {what}")


def package(name: str, path: Path) -> Any:
    """A package that is installed by who needs it."""
    try:
        return import_module(name)
    except ImportError:
        top = name.split(".")[0]
        refuse(path, f"{top} is needed to read it: pip install {top}")


# ---- DP3's zarr ----------------------------------------------------------------------------------

IN_ZARR = {"points": "data/point_cloud", "state": "data/state", "action": "data/action"}
IN_ZARR |= {"episode_ends": "meta/episode_ends"}


def read_zarr(path: Path, instruction: str | None, points: int) -> Recordings:
    """A replay buffer of DP3; of its points the farthest so many are kept."""
    zarr, arrays = package("zarr", path), {}
    if not instruction:
        refuse(path, 'it does not say what is done: add --instruction "Stir the soup."')
    try:
        store = zarr.storage.ZipStore(path, mode="r") if path.is_file() else path
        group = zarr.open_group(store, mode="r")
        missing = [name for name in IN_ZARR.values() if name not in group]
        found = {part: group[name] for part, name in IN_ZARR.items() if not missing}
        for part, array in found.items():
            if array.dtype.kind in "fiu":  # zarr itself unpickles none of these
                arrays[part] = array[:]
    except Exception as error:  # zarr raises many types; each means it cannot be read
        reason = " ".join(str(error).split())[:200]
        refuse(path, f"is damaged or neither zarr nor a dataset of LeRobot: {reason}")
    if missing:
        refuse(path, f"it lacks {', '.join(missing)}: DP3 has {', '.join(IN_ZARR.values())}")
    if odd := [IN_ZARR[part] for part in found if part not in arrays]:
        refuse(path, f"{', '.join(odd)} must be plain numbers")
    if arrays["points"].ndim != 3 or arrays["points"].shape[2] < 3:
        refuse(path, f"data/point_cloud must be (frames, points, 3), not {arrays['points'].shape}")

    clouds = progress_bar(iterable=arrays["points"][..., :3], desc="sampling", unit="frame")
    arrays["points"] = np.stack([farthest_point_sample(np.float32(x), points) for x in clouds])
    return {instruction: arrays}


# ---- LeRobot's parquet ---------------------------------------------------------------------------


def read_lerobot(
    path: Path, instruction: str | None, points: int, camera: dict, feature: str | None
) -> Recordings:
    """A dataset of LeRobot, by task; `instruction` takes the place of its own, if it has one."""
    parquet = package("pyarrow.parquet", path)
    info = read_json(path / "meta" / "info.json")
    version, features = str(info.get("codebase_version")), info.get("features", {})
    if version not in ("v2.0", "v2.1", "v3.0"):
        refuse(path, f"is of LeRobot's format {version}: convert it to v3.0 with lerobot")
    if missing := [name for name in ("observation.state", "action") if name not in features]:
        refuse(path, f"it lacks {', '.join(missing)}; it holds {', '.join(features)}")
    seen = choose_feature(path, features, feature)
    parts = {"points": seen, "state": "observation.state", "action": "action"}
    lenses = [] if camera["intrinsics"] else [name for name in features if "intrinsics" in name]
    if len(lenses) > 1:
        refuse(path, f"has the lenses {', '.join(lenses)}: write one's intrinsics to --camera")
    lens = next(iter(lenses), None)
    index = ["episode_index", "task_index"]

    # Frame by frame, since the depth of a whole dataset need not fit into memory
    frames = {name: [] for name in (*parts, *index)}
    files = sorted((path / "data").glob("*/*.parquet"))
    with progress_bar(desc="reading", total=info.get("total_frames"), unit="frame") as progress:
        for file in files:
            names = [*parts.values(), *index, *([lens] if lens else [])]
            for batch in parquet.ParquetFile(file).iter_batches(64, columns=names):
                column = {name: flat(path, features, batch, name) for name in names}
                look = camera | ({"intrinsics": pixels(column[lens][0])} if lens else {})
                clouds = [to_points(path, x, look, points, seen) for x in column.pop(seen)]
                frames["points"] += clouds
                for part in ("state", "action"):
                    frames[part] += [x.ravel() for x in column[parts[part]]]
                for name in index:
                    frames[name] += column[name].ravel().tolist()
                progress.update(len(clouds))
    if not frames["points"]:
        refuse(path, "holds no frames: record or download it again")

    # Episodes of one task, one after the other
    tasks = read_tasks(path, parquet)
    arrays = {name: np.stack(values) for name, values in frames.items()}
    recordings = {}
    for task in np.unique(arrays["task_index"]):
        of_task = arrays["task_index"] == task
        episode = arrays["episode_index"][of_task]
        own = {name: arrays[name][of_task] for name in parts}
        ends = np.append(np.flatnonzero(np.diff(episode)) + 1, len(episode))
        said = instruction or tasks.get(int(task)) or refuse(path, "add --instruction")
        recordings[said] = own | {"episode_ends": ends}
    if len(recordings) < len(np.unique(arrays["task_index"])):
        refuse(path, "holds several tasks: leave --instruction out, each brings its own")
    return recordings


def choose_feature(path: Path, features: dict[str, Any], chosen: str | None) -> str:
    """The cloud or depth to read; RecordingError, with what there is, if that is not clear."""
    arrays = {k: f for k, f in features.items() if f["dtype"] not in ("video", "image", "string")}
    square = [k for k, f in arrays.items() if sum(n > 1 for n in f["shape"]) == 2]
    clouds = [name for name in square if is_cloud(name)]
    depths = [name for name in square if "depth" in name and not is_cloud(name)]
    found = [name for name in clouds + depths if name == chosen] if chosen else clouds or depths
    if len(found) != 1:
        there = ", ".join(f"{name} ({f['dtype']})" for name, f in features.items())
        what = "whose name says `cloud`, `point` or `depth`"
        refuse(path, f"name the array, {what}, with --feature; it holds {there}")
    return found[0]


def is_cloud(name: str) -> bool:
    return re.search("point|cloud", name) is not None


def flat(path: Path, features: dict[str, Any], batch: Any, name: str) -> np.ndarray:
    """A column of nested lists -> (frames, *shape), the shape that the dataset says."""
    if name not in features or name not in batch.schema.names:
        refuse(path, f"lacks {name} in meta/info.json or in data/")
    column, shape = batch.column(name), features[name]["shape"]
    while hasattr(column.type, "value_type"):
        column = column.flatten()
    values = column.to_numpy(zero_copy_only=False)
    if len(values) != len(batch) * np.prod(shape) or values.dtype.kind not in "fiu":
        refuse(path, f"{name} holds other than numbers of shape {shape}")
    return values.reshape(len(batch), *shape)


def pixels(intrinsics: np.ndarray) -> list[float]:
    """fx, fy, cx, cy of four numbers, or of a matrix (3, 3)."""
    if intrinsics.size == 9:
        intrinsics = intrinsics.reshape(3, 3)[[0, 1, 0, 1], [0, 1, 2, 2]]
    return [float(x) for x in intrinsics.ravel()]


def to_points(path: Path, x: np.ndarray, camera: dict, points: int, seen: str) -> np.ndarray:
    """A cloud (N, 3 or more), or depth (H, W), -> (points, 3) float16, farthest points."""
    if is_cloud(seen):
        return farthest_point_sample(np.float32(x.reshape(-1, x.shape[-1])[:, :3]), points)
    if len(camera["intrinsics"] or ()) != 4:
        refuse(path, f"{seen} needs the camera's fx, fy, cx, cy: write them to --camera")
    depth = x.squeeze() * (0.001 if x.dtype.kind in "iu" else 1.0)
    try:
        return cloud(depth, camera["intrinsics"], SimpleNamespace(**camera, num_points=points))[0]
    except CameraError as error:
        refuse(path, str(error))


def read_tasks(path: Path, parquet: Any) -> dict[int, str]:
    """task_index -> instruction."""
    if (file := path / "meta" / "tasks.parquet").exists():  # 3.0: the tasks are the table's index
        table = parquet.read_table(file).to_pydict()
        (said,) = (values for name, values in table.items() if name != "task_index")
        return dict(zip(table["task_index"], said))
    lines = (path / "meta" / "tasks.jsonl").read_text().splitlines()
    return {line["task_index"]: line["task"] for line in map(json.loads, lines)}


def read_camera(path: Path) -> dict[str, Any]:
    """What the file of --camera says; RecordingError for what `CAMERA` does not have."""
    given = read_json(path)
    for name, value in given.items():
        if name not in CAMERA:
            refuse(path, f"{name} is none of {', '.join(CAMERA)}")
        shape = (4,) if name == "intrinsics" else np.shape(CAMERA[name])
        try:
            check_value(
                value, "float", shape=shape, least=-1e5, most=1e5, rigid=name == "camera_to_base"
            )
        except ValueError as error:
            refuse(path, f"{name}: {error}")
        if name == "intrinsics" and min(value[:2]) <= 0:
            refuse(path, "intrinsics: two focal lengths in pixels, then the principal point")
    return given


def read_json(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text()))
    except (TypeError, ValueError) as error:
        refuse(path, f"is no JSON object: {error}")


# ---- Command line --------------------------------------------------------------------------------


def import_recordings(args: argparse.Namespace) -> list[Path]:
    """Writes a file for each task that was found; returns their paths."""
    path = Path(args.import_)
    if args.num_points < 1:
        raise UserError(f"--num-points is {args.num_points}: use at least 1")
    if not path.exists():
        refuse(path, "is missing: look at --import")
    if (path / "meta" / "info.json").is_file():
        camera = CAMERA | (read_camera(Path(args.camera)) if args.camera else {})
        found = read_lerobot(path, args.instruction, args.num_points, camera, args.feature)
    else:
        found = read_zarr(path, args.instruction, args.num_points)
    if args.task and len(found) > 1:
        refuse(path, f"holds {len(found)} tasks, which are named by what they say: no --task")

    files = {}
    for said, arrays in found.items():
        name = args.task or re.sub(r"\W+", "-", said.lower()).strip("-")[:60]
        file = Path(args.out or "recordings") / f"{name}.npz"
        if file in files or file.exists():
            refuse(file, "already exists: move it, or use another --task or --out")
        arrays |= {"points": np.float16(arrays["points"])}
        arrays |= {part: np.float32(arrays[part]) for part in ("state", "action")}
        meta = {"imported_from": path.name, "positions_in_state": args.positions_in_state}
        files[file] = Demonstrations(name, said, **arrays, meta=meta)
        try:
            files[file].check()
        except RecordingError as error:
            refuse(path, str(error))
    for file, demonstrations in files.items():
        save_demonstrations(file, demonstrations)
    return list(files)


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Draws a recording, or imports one of DP3 or LeRobot."
    )
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--show", metavar="FILE", help="draw an episode of a recording")
    what.add_argument("--import", dest="import_", metavar="PATH", help="of DP3 or LeRobot")
    parser.add_argument("--out", help="picture (FILE with .png), or folder of files (recordings)")
    add = parser.add_argument_group("to show").add_argument
    add("--episode", type=int, default=0, help="which (default: 0, the first)")
    add = parser.add_argument_group("to import").add_argument
    add("--instruction", help="what is done, a sentence (default: LeRobot's own)")
    add("--task", help="its name, and the file's (default: made of the instruction)")
    add("--num-points", type=int, default=512, help="points that are kept of a cloud (512)")
    positions = "points of space, x y z, that a state begins with, if actions begin with a change"
    positions += " of the first, and neither holds a rotation (0)"
    add("--positions-in-state", type=int, default=0, help=positions)
    add("--feature", help="LeRobot's array of clouds or depth, if there are several")
    add("--camera", metavar="JSON", help="of depth: intrinsics, and its pose if known")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    args = parse(argv)
    if args.import_:
        for file in import_recordings(args):
            found = load_demonstrations(file)
            parts = {part: getattr(found, part).shape for part in ("points", "state", "action")}
            print(f"wrote {file}: {len(found)} episodes of {found.instruction!r}, {parts}")
        return
    out = Path(args.out or args.show).with_suffix(".png")
    recorded = load_demonstrations(args.show)
    if not 0 <= args.episode < len(recorded):
        refuse(args.show, f"holds episodes 0 to {len(recorded) - 1}, not {args.episode}")
    plot_demonstration(recorded, out, args.episode)
    print(f"wrote {out}")


if __name__ == "__main__":
    command_line(main, errors=(RecordingError,))
