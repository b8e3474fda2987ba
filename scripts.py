"""What every script does the same way; nothing here is part of the method.

Settings become flags, a mistake ends in one line, a folder belongs to one run, Ctrl-C finishes the
step at hand, work is shared among processes. Skip this file when reading the method.
"""

import argparse
import atexit
import difflib
import functools
import hashlib
import json
import math
import multiprocessing
import os
import platform
import queue
import re
import shlex
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import asdict, field, fields, replace
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import numpy as np
import torch
import torch.distributed as dist
from torch.optim.swa_utils import AveragedModel
from torch.utils._pytree import tree_leaves, tree_map
from tqdm import tqdm

import model
from baselines import PRESETS
from clip import text_features
from common import UserError  # until train.py, finetune.py and evaluate.py use common.command_line
from data import Demonstrations, WindowSampler, write_atomically, write_text
from model import DAMIPolicy, PolicyConfig

try:
    import fcntl
except ImportError:  # Windows
    print("error: this needs Linux or macOS; on Windows, run it under WSL", file=sys.stderr)
    sys.exit(2)

# ---- Settings: each said once, as a field --------------------------------------------------------


def setting(default: Any, help: str, **bounds: Any) -> Any:
    """A field of `Flags`: its default, its line of help, and its bounds: least, most, choices."""
    return field(default=default, metadata={"help": help, **bounds})


class Flags:
    """Base of a frozen dataclass whose fields, made by `setting`, are flags of a script."""

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            largest = sys.float_info.max if isinstance(value, float) else sys.maxsize
            least, most = f.metadata.get("least", -math.inf), f.metadata.get("most", largest)
            if isinstance(value, (int, float)) and not least <= value <= most:
                limit = f"at most {most}" if value > most else f"at least {least}"
                raise ValueError(f"--{f.name.replace('_', '-')} is {value}: use {limit}")

    @classmethod
    def add_flags(cls, parser: Any, presets: dict[str, "Flags"] | None = None) -> None:
        """Adds a flag for each field, which tells each preset's value; None if it is not given."""
        for f in fields(cls):
            kind = next((t for t in get_args(f.type) if t is not type(None)), f.type)
            if kind is bool:
                options = {"action": argparse.BooleanOptionalAction}
            else:
                options = {"type": kind, "choices": f.metadata.get("choices")}
            said = {} if f.name in ("suite", "preset") else presets or {}
            values = {name: getattr(preset, f.name) for name, preset in said.items()}
            help = f.metadata["help"] + of_presets(values)
            parser.add_argument(f"--{f.name.replace('_', '-')}", help=help, **options)

    def given(self, args: argparse.Namespace, **more: Any) -> Any:
        """Returns these settings with what was given on the command line, and `more`."""
        flags = {f.name: getattr(args, f.name) for f in fields(self)} | more
        return replace(self, **{name: value for name, value in flags.items() if value is not None})


def of_presets(values: dict[str, Any]) -> str:
    """` (paper 20, small 4, tiny 4)`, or ` (20)` where all have it: preset -> a setting's value."""
    if len(set(values.values())) > 1:
        return f" ({', '.join(f'{preset} {value}' for preset, value in values.items())})"
    return f" ({next(iter(values.values()))})" if values else ""


def add_architecture_flags(parser: argparse.ArgumentParser) -> None:
    """Adds the flags of what `choose_config` makes a policy's configuration of."""
    add = parser.add_argument_group("architecture (default: the preset's)").add_argument
    flags = {name: {"choices": choices} for name, choices in model.choices().items()}
    for name, options in (flags | {"num_points": {"type": int}}).items():
        values = {preset: getattr(config, name) for preset, config in PRESETS["dami"].items()}
        what = "points of a cloud" if name == "num_points" else "see model.PolicyConfig"
        add(f"--{name.replace('_', '-')}", help=what + of_presets(values), **options)


def add_inference_flags(add: Callable[..., Any]) -> None:
    """Adds the flags of what may be another in a rollout than in the training, see `inference`."""
    add(
        "--sampler", choices=model.choices()["sampler"], help="DDIM as published, or as DP3 runs it"
    )
    add("--n-action-steps", type=int, help="actions until the policy looks again")
    add("--inference-steps", type=int, help="of the diffusion for each draw")


def inference(args: argparse.Namespace) -> dict[str, Any]:
    """What was given of the flags of `add_inference_flags`, by the names of `PolicyConfig`."""
    given = {name: getattr(args, name) for name in ("sampler", "n_action_steps", "inference_steps")}
    return {name: value for name, value in given.items() if value is not None}


def format_table(rows: Sequence[Sequence[Any]]) -> str:
    """A Markdown table, the first row its head, whose columns are aligned in a terminal too."""
    rows = [[str(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows)]
    rows.insert(1, ["-" * width for width in widths])
    filled = [[cell.ljust(width) for cell, width in zip(row, widths)] for row in rows]
    return "\n".join(f"| {' | '.join(row)} |" for row in filled)


def print_settings(used: dict[str, Any], default: dict[str, Any]) -> None:
    """A table of what a run is made of, and of what that would be by default."""

    def text(value: Any) -> str:
        return f"{value:g}" if isinstance(value, float) else str(value)

    rows = []
    for name, value in used.items():
        if not isinstance(value, dict):
            usual = default.get(name, value)
            rows.append([name, text(value), "" if usual in (value, None) else text(usual)])
    print_once(format_table([["setting", "value", "default"], *rows]))


@functools.cache
def print_once(text: str) -> None:
    """Prints what several tasks have in common for the first of them."""
    print(text, flush=True)


# ---- Command lines -------------------------------------------------------------------------------


def add_common_flags(add: Callable[..., Any]) -> None:
    """Adds the flags that training, adaptation and evaluation share."""
    add("--device", help="cpu, cuda, cuda:1 ... (default: cuda if there is one)")
    add("--workers", type=int, help="processes for collecting and evaluating (default: one a core)")
    add("--threads", type=int, help="of PyTorch; 1 beside busy processes (default: one a core)")
    add("--clip-weights", help="CLIP's ViT-B-32.pt, or `random` (default: as before, or download)")


def at_least(least: int, **values: int | None) -> None:
    """Raises ValueError, in the words of the command line, for a value below `least`."""
    for name, value in values.items():
        if value is not None and value < least:
            raise ValueError(f"--{name} is {value}: use at least {least}")


def choose(name: str, names: Iterable[str], what: str) -> str:
    """Returns `name` if it is one of `names`; otherwise ValueError with the nearest right one."""
    names = sorted(names)
    if name in names:
        return name
    near = difflib.get_close_matches(str(name), names, n=1, cutoff=0.4)
    advice = f"did you mean {near[0]!r}?" if near else f"choose one of: {', '.join(names)}"
    raise ValueError(f"unknown {what} {name!r}: {advice}")


def command_line(main: Callable[[], None], *errors: type[Exception]) -> None:
    """Runs a script's `main`: what a user can cause ends in one line on stderr and exit code 2.

    That is ValueError, OSError and `errors`. Ctrl-C, SIGTERM and a closed terminal end in 130.
    `python -X dev` shows tracebacks.
    """
    warnings.formatwarning = lambda message, *_: f"warning: {message}\n"
    for number in (signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)):
        if signal.getsignal(number) == signal.SIG_DFL:  # `nohup` has them ignored
            signal.signal(number, signal.default_int_handler)
    try:
        return main()
    except KeyboardInterrupt as interrupt:
        line, code = f"interrupted{f': {interrupt}' if str(interrupt) else ''}", 130
    except (ValueError, OSError, UserError, *errors) as error:
        if sys.flags.dev_mode:
            raise
        line, code = f"error: {' '.join(str(error).split())}", 2
        if isinstance(error, OSError) and error.filename and error.strerror:
            path = re.sub(r"/?\.unfinished-\w+", "", str(error.filename))  # of `write_atomically`
            line = f"error: {path}: {error.strerror.lower()}, name another file or folder"
    except (MemoryError, RuntimeError) as error:
        if sys.flags.dev_mode or "memory" not in f"{type(error)} {error}".lower():
            raise
        line, code = "error: out of memory: use a smaller --preset, batch or --vectorize", 2
    with suppress(OSError):  # `2>&1 | tee log` may be gone
        print(line, file=sys.stderr)
    sys.exit(code)


def pick_device(name: str | None, threads: int | None = None) -> torch.device:
    """`cuda` where there is one unless a name is given; ValueError for a missing device.

    On the CPU PyTorch takes so many `threads`. They wait for each other, so one whose core is busy
    with another process delays all. Rounding depends on their number.
    """
    at_least(1, threads=threads)
    if threads is not None:
        torch.set_num_threads(threads)
    name = name or ("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError) as error:
        reason = str(error).split("\n")[0]
        raise ValueError(
            f"--device {name} cannot be used here ({reason}): use --device cpu"
        ) from error
    if device.type == "cuda":
        torch.set_float32_matmul_precision("high")  # TF32, as PyTorch has convolutions anyway
        torch.cuda.set_device(device.index or 0)  # for streams and graphs
    return device


def hardware(device: str | torch.device = "cpu") -> str:
    """The processor that results are measured on."""
    if torch.device(device).type == "cuda":
        return torch.cuda.get_device_name(device)
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next(
            line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")
        )
    except (OSError, StopIteration):
        name = platform.processor() or platform.machine()
    return f"{name}, {os.cpu_count()} cores"


def report_facts(
    script: str, argv: Sequence[str] | None, device: str | torch.device
) -> dict[str, str]:
    """What stands beside every number: the hardware, the date, and the command that made it."""
    command = shlex.join(["python", script, *(sys.argv[1:] if argv is None else argv)])
    date = time.strftime("%Y-%m-%d")
    return {"hardware": hardware(device), "date": date, "command": command}


# ---- Own recordings ------------------------------------------------------------------------------

OWN_FRAMES = 500  # the paper's positions on the real robot


def choose_config(
    args: argparse.Namespace, preset: str, recorded: dict[str, Demonstrations], own: bool
) -> PolicyConfig:
    """A preset's architecture with what was given, and with the dimensions of own recordings."""
    recordings = list(recorded.values())
    names = (*model.choices(), "num_points")
    given = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    config = replace(PRESETS[args.policy or "dami"][preset], **given)
    if own:
        episodes = [d.episode(i) for d in recordings for i in range(len(d))]
        longest = max(OWN_FRAMES, *(e.stop - e.start for e in episodes))
        config = replace(
            config,
            state_dim=recordings[0].state.shape[1],
            action_dim=recordings[0].action.shape[1],
            num_points=args.num_points
            or min(config.num_points, *(d.points.shape[1] for d in recordings)),
            demo_positions=math.ceil(longest / config.demo_stride),
        )
    return config


def windows(
    recorded: dict[str, Demonstrations],
    config: PolicyConfig,
    device: str | torch.device = "cpu",
    after_success: int | None = None,
    augment: bool = False,
) -> dict[str, WindowSampler]:
    """The windows of each task's recording, as WindowSampler takes it."""
    return {
        task: WindowSampler(d, config, device=device, after_success=after_success, augment=augment)
        for task, d in recorded.items()
    }


def is_told(info: dict[str, Any]) -> bool:
    """Whether a checkpoint's policy is told its instruction: unless it was adapted without."""
    return info.get("adaptation", {}).get("instruction", True)


def instruction_features(
    recorded: dict[str, Demonstrations],
    weights: str | None,
    identity: str | None,
    device: str | torch.device,
    told: bool = True,
) -> tuple[dict[str, torch.Tensor], str]:
    """Task -> feature of its instruction (text_dim,), zeros if not told; the weights' identity.

    `weights` are those of --clip-weights, `identity` those that must be used; see clip.py.
    """
    said = [demonstrations.instruction for demonstrations in recorded.values()]
    features, identity = text_features(said, weights, identity)
    return dict(zip(recorded, features.to(device) * told)), identity


# ---- Pictures of recordings ----------------------------------------------------------------------


def draw_demonstration(
    demonstrations: Demonstrations, out: str | Path, episode: int = 0, columns: int = 6
) -> None:
    """Draws one episode to a picture: its clouds along time, colored by height, and the actions.

    A recording's boxes, `workspace` and `tcp_box` in its meta, are drawn where they are known.
    """
    from itertools import combinations, product

    from matplotlib.figure import Figure  # only here: training draws nothing

    frames, meta = demonstrations.episode(episode), demonstrations.meta
    clouds = demonstrations.points[frames].astype(np.float32)  # (T, N, 3)
    positions = 3 * meta.get("positions_in_state", 0)
    known = demonstrations.state[frames, :positions].reshape(len(clouds), -1, 3)
    boxes = {name: np.array(meta[name]) for name in ("workspace", "tcp_box") if name in meta}
    seen = np.concatenate([clouds.reshape(-1, 3), known.reshape(-1, 3), *boxes.values()])
    low, high = seen.min(0), seen.max(0)
    margin = np.maximum(high - low, 0.1 * max((high - low).max(), 1e-3)) / 2  # of a plane, too
    low, high = (low + high) / 2 - margin, (low + high) / 2 + margin

    columns = min(columns, len(clouds))
    figure = Figure(figsize=(max(2.6 * columns, 8), 6 if columns > 1 else 9), layout="constrained")
    grid = figure.add_gridspec(2, columns, height_ratios=(1.5 if columns > 1 else 5, 1))
    for column, index in enumerate(np.linspace(0, len(clouds) - 1, columns).round().astype(int)):
        axes = figure.add_subplot(grid[0, column], projection="3d", computed_zorder=False)
        height = {"c": clouds[index, :, 2], "vmin": low[2], "vmax": high[2]}
        axes.scatter(*clouds[index].T, s=2, cmap="viridis", **height)
        axes.scatter(*known[index].T, c="red", s=14)  # hand and fingers
        for box, color in zip(boxes.values(), ("black", "red")):
            for a, b in combinations(product(*box.T), 2):
                if np.equal(a, b).sum() == 2:  # an edge
                    axes.plot(*zip(a, b), color=color, lw=0.5)
        axes.set(**{f"{axis}lim": ends for axis, ends in zip("xyz", zip(low, high))})
        axes.set_title(f"frame {index}")
        axes.set_box_aspect(high - low, zoom=1.3 if columns > 1 else 1)
        axes.view_init(35, -30)
        axes.tick_params(labelsize=5, pad=-3)

    axes = figure.add_subplot(grid[1, :])
    for index, values in enumerate(demonstrations.action[frames].T):
        axes.plot(values, marker=".", label=f"action {index}")
    axes.set(xlabel="frame", ylabel="action")
    axes.legend(loc="upper right", ncols=4)
    title = f"{demonstrations.task}, episode {episode}: {demonstrations.instruction}"
    figure.suptitle(title.replace("$", r"\$"))  # no formula
    write_atomically(out, lambda temporary: figure.savefig(temporary, dpi=110, format="png"))


# ---- Checkpoints ---------------------------------------------------------------------------------


def save_checkpoint(path: str | Path, policy: DAMIPolicy, half: bool = False, **info: Any) -> None:
    """`model.save`."""  # old name, until the scripts call that
    model.save(path, policy, half=half, **info)


def checkpoints_of(path: str | Path) -> list[Path]:
    """A file as it is; of a run's folder all its EMA checkpoints, the last one last."""
    path = Path(path)
    if not path.is_dir():
        return [path]
    by_step = sorted(path.glob("ema-*.pt"), key=lambda file: (len(file.name), file.name))
    if not (found := by_step or sorted(path.glob("adapted.pt"))):
        inside = ", ".join(str(file.parent) for file in sorted(path.glob("*/adapted.pt")))
        instead = inside or "a folder of train.py or finetune.py, or a .pt file"
        raise ValueError(f"{path} holds no checkpoint: name {instead}")
    return found


def load_checkpoint(
    path: str | Path, device: str | torch.device = "cpu", needs: Sequence[str] = (), **changed: Any
) -> tuple[DAMIPolicy, dict[str, Any]]:
    """`model.load`, of a folder its last."""  # old name, until the scripts call that
    return model.load(checkpoints_of(path)[-1], device, needs=needs, **changed)


def digest(samplers: dict[str, WindowSampler]) -> str:
    """A fingerprint of everything that is trained on."""
    sha = hashlib.sha256()
    for sampler in samplers.values():
        sha.update(f"{sampler.task} {sampler.instruction}".encode())
        if sampler.augment:  # scenes are moved about
            sha.update(f"{sampler.positions_in_state} {sampler.center.tolist()}".encode())
        for part in (sampler.points, sampler.state, sampler.action, sampler.windows):
            sha.update(part.cpu().numpy().tobytes())
    return sha.hexdigest()


def save_run(
    folder: Path,
    policy: DAMIPolicy,
    ema: AveragedModel,
    optimizer: torch.optim.Optimizer,
    **info: Any,
) -> None:
    """Writes last.pt: all that `restore` needs, and `info`."""
    training = {"policy": policy.state_dict(), "optimizer": optimizer.state_dict()}
    training["n_averaged"] = ema.n_averaged
    save_checkpoint(folder / "last.pt", ema.module, training=training, **info)


def restore(
    path: Path,
    policy: DAMIPolicy,
    ema: AveragedModel,
    optimizer: torch.optim.Optimizer,
    settings: Flags,
    data: str,
) -> dict[str, Any]:
    """Puts all three in the state of last.pt; returns the rest of it: step, seconds, text_weights.

    Raises ValueError if the run was started with other settings, or on other data (its digest).
    What concerns the inner step alone may differ before the first one.
    """
    device = policy.normalizer.action_scale.device
    averaged, left = load_checkpoint(path, device, needs=("training", "data"))
    old = asdict(type(settings)()) | left["arguments"] | asdict(averaged.config)
    new = asdict(settings) | asdict(policy.config)
    if left["step"] <= old.get("multi_task_share", 0) * old["steps"]:
        old |= {name: new[name] for name in ("maml", "inner_lr", "support_only")}
    changed = [f"{k} {old.get(k)} -> {new[k]}" for k in new if old.get(k) != new[k]]
    if changed:
        what = f"other settings ({', '.join(changed)})"
        raise ValueError(f"{path.parent} was started with {what}: give the old ones to resume it")
    if left["data"] != data:
        raise ValueError(f"{path.parent} was started on other recordings: bring those back")
    policy.load_state_dict(left["training"]["policy"])
    ema.module.load_state_dict(averaged.state_dict())
    ema.n_averaged.copy_(left["training"]["n_averaged"])
    optimizer.load_state_dict(left["training"]["optimizer"])
    return left


# ---- Folders of runs -----------------------------------------------------------------------------

RESULTS = "adapted.pt", "adapted-*.pt", "success.json", "success.md", "success.png", "held-out.md"
OF_ADAPTING = "config.json", "metrics.jsonl", "events.out.tfevents.*"


def claim_folder(folder: Path, overwrite: bool) -> list[Path]:
    """Makes a folder for results; ValueError if there are any, or a run, that would be lost.

    With `overwrite` returns the old results. They are to go, so that none of them stands beside new
    ones, once nothing more can be refused. A training run is never overwritten.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.glob("ema-*.pt")) or (folder / "last.pt").exists():
        raise ValueError(f"{folder} holds a training run: choose another --out")
    old = [path for name in RESULTS + OF_ADAPTING for path in folder.glob(name)]
    if old and not overwrite:
        raise ValueError(f"{folder} already holds {old[0].name}: add --overwrite, or another --out")
    return old


def check_run(folder: Path, resume: bool) -> None:
    """Raises ValueError for a run that cannot be resumed, or that a new one would overwrite."""
    if resume and not (folder / "last.pt").exists():
        raise ValueError(f"there is no run to resume in {folder}: look at --out")
    if not resume and any(folder.glob("*.pt")):
        raise ValueError(f"{folder} already holds a run: add --resume, or another --out")


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Makes a folder that no other process may run in, and clears what killed ones left half done.

    The operating system frees it when this process ends, however that comes about.
    """
    folder.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(f"another process runs in {folder}: use another --out") from None
        if not os.access(folder, os.W_OK):
            raise ValueError(f"{folder} cannot be written to: use another --out")
        remove_temporaries(folder)
        yield
    finally:
        os.close(descriptor)


def remove_temporaries(folder: Path) -> None:
    """Removes what killed processes left of files they were writing."""
    for temporary in folder.glob(".[0-9]*.*"):  # of `write_atomically`
        try:
            os.kill(int(temporary.name.split(".")[1]), 0)
        except (ProcessLookupError, ValueError, OverflowError):
            temporary.unlink(missing_ok=True)
        except PermissionError:
            pass  # another user's process, which lives


class Captured:
    """A function of tensors as one CUDA graph: Python starts it at once, not kernel by kernel.

    The first call records it, on copies of what it is given. Each call copies what it is given over
    those, in the same shapes, and runs the recording. What the function reads besides, such as
    weights, must stay in its place in memory; what it returns holds until the next call.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function, self.inputs = function, None

    def __call__(self, *inputs: Any) -> Any:
        if self.inputs is None:
            self.inputs = tree_map(torch.clone, inputs)
            self.graph, aside = torch.cuda.CUDAGraph(), torch.cuda.Stream()
            aside.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(aside):
                self.function(*self.inputs)  # libraries prepare themselves at their first call
            torch.cuda.current_stream().wait_stream(aside)
            with torch.cuda.graph(self.graph):
                self.outputs = self.function(*self.inputs)
        torch._foreach_copy_(tree_leaves(self.inputs), tree_leaves(inputs))
        self.graph.replay()
        return self.outputs


def join_processes(device: torch.device, tasks: int) -> tuple[torch.device, int, int]:
    """Joins the processes of torchrun, which share the tasks; returns (device, rank, how many).

    One of them, the leader, collects, logs, saves and evaluates, while the others wait for it.
    """
    world, rank = int(os.environ.get("WORLD_SIZE", 1)), int(os.environ.get("RANK", 0))
    if world > tasks:
        raise ValueError(f"{world} processes for {tasks} tasks: use at most one a task")
    if world > 1:
        if device.type == "cuda" and device.index is None:
            device = torch.device("cuda", int(os.environ["LOCAL_RANK"]))
            torch.cuda.set_device(device)
        backend = "nccl" if device.type == "cuda" else "gloo"
        dist.init_process_group(backend, timeout=timedelta(hours=6))  # an evaluation is long
    return device, rank, world


class StopRequest:
    """Turns Ctrl-C, SIGTERM and a closed terminal into a request to stop after the step at hand.

    A second one stops at once.
    """

    def __enter__(self) -> "StopRequest":
        self.requested, self.previous = False, {}
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) != signal.SIG_IGN:  # `nohup` has it ignored
                self.previous[number] = signal.signal(number, self.handle)
        return self

    def __exit__(self, *_: Any) -> None:
        for number, handler in self.previous.items():
            signal.signal(number, handler)

    def handle(self, *_: Any) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """Where all is saved: there a request, one made just before, too, stops at once."""
        saved = KeyboardInterrupt("all is saved, add --resume to go on")
        if self.requested:
            raise saved
        self.requested = True
        try:
            yield
        except KeyboardInterrupt:
            raise saved from None
        self.requested = False


def log(folder: Path, **values: Any) -> None:
    """Appends a line to metrics.jsonl, and its numbers to TensorBoard's file if it is installed."""
    with (folder / "metrics.jsonl").open("a") as file:
        file.write(json.dumps(values) + "\n")
    if (writer := tensorboard(folder)) is not None:
        for name, value in values.items():
            if isinstance(value, (int, float)) and name != "step":
                writer.add_scalar(name, value, values["step"])


@functools.cache
def tensorboard(folder: Path) -> Any:
    """TensorBoard's writer for a folder; None without that package."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    writer = SummaryWriter(folder, flush_secs=10)
    atexit.register(writer.close)
    return writer


def begin_run(
    folder: Path,
    start: int,
    settings: Flags,
    preset: Flags,
    config: PolicyConfig,
    facts: dict[str, Any],
) -> None:
    """Prints the settings, writes them to config.json, drops what was logged later than `start`."""
    used = asdict(settings) | asdict(config)
    usual = asdict(preset) | asdict(PRESETS[config.policy][settings.preset])
    print_settings(used, usual)
    path = folder / "config.json"
    if start:  # it began as that file says, if the file can be read
        with suppress(OSError, ValueError, TypeError):
            facts = facts | dict(json.loads(path.read_text()))
    written = facts | {"arguments": asdict(settings), "config": asdict(config)}
    write_text(path, json.dumps(written, indent=1))
    rewind_metrics(folder, start)


def rewind_metrics(folder: Path, step: int) -> None:
    """Drops the lines that a killed run wrote after its last save; all of them for step 0."""
    path = folder / "metrics.jsonl"
    lines = path.read_text().splitlines() if path.exists() else []
    kept = [line for line in lines if is_whole(line) and 0 < json.loads(line)["step"] <= step]
    write_text(path, "".join(f"{line}\n" for line in kept))


def is_whole(line: str) -> bool:
    """Whether a line of metrics.jsonl was written to its end."""
    try:
        return isinstance(json.loads(line)["step"], int)
    except (ValueError, TypeError, KeyError):
        return False


# ---- Worker processes, for collecting and for evaluating -----------------------------------------

GRACE = 0.5  # seconds that workers have to end by themselves

# What a job sees of the process that started it; `run_jobs` replaces both in a worker process.
worker = SimpleNamespace(
    stop=threading.Event(),  # set when the starting process was interrupted: the job should return
    finished=queue.SimpleQueue(),  # put (text, number of episodes) here to move the progress bar
)


class StandardError:
    """stderr, as a progress bar needs it, that a closed pipe (`2>&1 | tee log`) does not break."""

    def write(self, text: str) -> None:
        with suppress(OSError, ValueError):
            sys.stderr.write(text)

    def flush(self) -> None:
        with suppress(OSError, ValueError):
            sys.stderr.flush()

    def fileno(self) -> int:  # tqdm asks for the width of the terminal
        return sys.stderr.fileno()


def progress_bar(**options: Any) -> tqdm:
    """A progress bar that no closed terminal or pipe ends the work with."""
    return tqdm(file=StandardError(), dynamic_ncols=True, **options)


def run_jobs(
    job: Callable[..., Any],
    jobs: Sequence[tuple],
    workers: int | None,
    total: int,
    label: str,
    setup: tuple | None = None,
) -> list:
    """Calls `job(*arguments)` for each tuple of arguments, in several processes.

    Args:
        job: a function of a module; it may use `worker.stop` and `worker.finished`.
        jobs: the arguments of each call.
        workers: processes; None: one a core.
        total, label: how many episodes the progress bar counts to, and what it is called.
        setup: (function, *arguments), called once in each process before its first job.

    Returns:
        What the calls returned, in the order of `jobs`.

    Raises:
        ValueError: `workers` is below 1, or a worker process was killed.
        Exception: what a job raised. By then the other jobs were stopped and no process is left.
    """
    at_least(1, workers=workers)
    if not jobs:
        return []

    context = multiprocessing.get_context("spawn")  # neither threads nor a GPU survive a fork
    with ignored_interrupts():  # Python's resource tracker, which starts here, inherits it
        stop, finished = context.Event(), context.SimpleQueue()
    workers = min(workers or os.cpu_count() or 1, len(jobs))
    pool = ProcessPoolExecutor(workers, context, start_worker, (stop, finished, setup))
    try:
        with ignored_interrupts():  # submitting launches the processes
            futures = [pool.submit(run_job, job, arguments) for arguments in jobs]

        with progress_bar(total=total, desc=label, unit="episode") as progress:
            pending = set(futures)
            while pending:
                done, pending = wait(pending, timeout=0.1, return_when=FIRST_COMPLETED)
                while not finished.empty():
                    text, episodes = finished.get()
                    progress.set_postfix_str(text)
                    progress.update(episodes)
                for future in done:
                    future.result()  # raises what the job raised

        return [future.result() for future in futures]
    except BrokenProcessPool:
        message = "a worker process was killed, perhaps for memory: try fewer --workers"
        raise ValueError(message) from None
    except BaseException:
        stop.set()
        raise
    finally:
        with ignored_interrupts():
            timer = threading.Timer(GRACE, kill, [list(pool._processes.values())])
            timer.start()
            pool.shutdown(cancel_futures=True)  # waits for the processes
            timer.cancel()


@contextmanager
def ignored_interrupts() -> Iterator[None]:
    """Ignores Ctrl-C and a closing terminal inside, also in the processes that are started there.

    A terminal sends both to all of them, yet what to do is up to the starting process alone: it
    sets `stop`. Processes inherit the ignoring, so it holds from their first instruction on, while
    they still import. Only the main thread may set handlers, and only it is ever interrupted.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    signals = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP) if in_main_thread else ()
    handlers = {number: signal.signal(number, signal.SIG_IGN) for number in signals}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def kill(processes: Sequence[multiprocessing.Process]) -> None:
    for process in processes:
        process.kill()


def start_worker(stop: Any, finished: Any, setup: tuple | None) -> None:
    """Prepares a worker process."""
    import torch

    torch.set_num_threads(1)  # the other cores have processes of their own
    worker.stop, worker.finished, worker.setup = stop, finished, setup
    threading.Thread(target=end_with_parent, daemon=True).start()


def end_with_parent() -> None:
    """Ends this process as soon as the one that started it is gone, killed perhaps."""
    multiprocessing.parent_process().join()
    os._exit(1)


def run_job(job: Callable[..., Any], arguments: tuple) -> Any:
    # Not in `start_worker`: an exception there would break the pool and print a traceback.
    if worker.setup is not None:
        function, *rest = worker.setup
        function(*rest)
        worker.setup = None
    return job(*arguments)
