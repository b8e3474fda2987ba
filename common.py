"""What every script does the same way. Nothing here is part of the method: skip it when reading.

Settings become flags; a user's mistake ends in one line and exit code 2; a folder belongs to one
run; Ctrl-C lets the step at hand finish; work is shared among processes. The file imports nothing
of the project, but some flags and messages mention its policies and tasks.
"""

import argparse
import difflib
import errno
import json
import math
import multiprocessing
import os
import platform
import shlex
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import field, fields, replace
from pathlib import Path
from typing import Any, get_args

import filelock
import torch
from torch.utils._pytree import tree_leaves, tree_map
from tqdm import tqdm


class UserError(Exception):
    """A mistake made at the command line. Its message is one line that says what to do instead."""


# ---- Settings: a frozen dataclass whose fields are flags -----------------------------------------


def setting(default: Any, help: str, **bounds: Any) -> Any:
    """A dataclass field with its default, its line of help, and bounds: least, most, choices."""
    return field(default=default, metadata={"help": help, **bounds})


def flag_name(name: str) -> str:
    """The flag of a field: `inner_lr` -> `--inner-lr`."""
    return "--" + name.replace("_", "-")


def check_settings(settings: Any) -> None:
    """Raises UserError for a value of a settings dataclass that is no choice or out of bounds.

    A number that is not finite is out of bounds.
    """
    for f in fields(settings):
        value = getattr(settings, f.name)
        choices = f.metadata.get("choices")
        if choices and value not in choices:
            raise UserError(f"{flag_name(f.name)} is {value!r}: use one of {', '.join(choices)}")
        if not isinstance(value, (int, float)):
            continue
        least, most = f.metadata.get("least", -math.inf), f.metadata.get("most", math.inf)
        if not math.isfinite(value):
            raise UserError(f"{flag_name(f.name)} is {value}: use a finite number")
        if value < least:
            raise UserError(f"{flag_name(f.name)} is {value}: use at least {least}")
        if value > most:
            raise UserError(f"{flag_name(f.name)} is {value}: use at most {most}")


def add_settings(parser: Any, settings_class: type, presets: dict[str, Any] | None = None) -> None:
    """Adds a flag for each field of a settings dataclass; a flag that is not given is None.

    Args:
        parser: a parser of argparse, or a group of one.
        settings_class: its fields are made by `setting`; others get no flag.
        presets: name -> settings; the help of a flag then tells the value in each preset.
    """
    for f in fields(settings_class):
        if "help" not in f.metadata:
            continue
        values = {name: getattr(preset, f.name) for name, preset in (presets or {}).items()}
        help = f.metadata["help"] + describe_presets(values)
        kind = without_none(f.type)
        if kind is bool:
            parser.add_argument(flag_name(f.name), action=argparse.BooleanOptionalAction, help=help)
        else:
            choices = f.metadata.get("choices")
            parser.add_argument(flag_name(f.name), type=kind, choices=choices, help=help)


def without_none(kind: Any) -> type:
    """The type of a field that may also be None: `int | None` -> `int`."""
    others = [part for part in get_args(kind) if part is not type(None)]
    return others[0] if others else kind


def describe_presets(values: dict[str, Any]) -> str:
    """` (paper 20, small 4, tiny 4)`, or ` (20)` where all presets have the same value.

    Where all of them are None nothing is said here, because the help says what None means.
    """
    if set(values.values()) <= {None}:
        return ""
    if len(set(values.values())) == 1:
        return f" ({next(iter(values.values()))})"
    return f" ({', '.join(f'{preset} {value}' for preset, value in values.items())})"


def with_flags(settings: Any, args: argparse.Namespace) -> Any:
    """Returns the settings with what was given on the command line in place of their own values."""
    given = {f.name: getattr(args, f.name) for f in fields(settings) if "help" in f.metadata}
    return replace(settings, **{name: x for name, x in given.items() if x is not None})


def add_common_flags(parser: Any) -> None:
    """Adds the flags that training, adaptation and evaluation share."""
    parser.add_argument("--device", help="cpu, cuda, cuda:1 ... (default: cuda if there is one)")
    parser.add_argument(
        "--workers", type=int, help="processes for collecting and evaluating (default: one a core)"
    )
    parser.add_argument(
        "--threads",
        type=int,
        help="PyTorch's CPU threads; use 1 beside busy processes (default: one a core)",
    )
    parser.add_argument(
        "--clip-weights",
        help="CLIP's ViT-B-32.pt, or `random` (default: those of the checkpoint, or a download)",
    )


def choose(name: str, names: Iterable[str], kind: str) -> str:
    """Returns `name` if it is one of `names`; otherwise UserError with the nearest right one."""
    names = sorted(names)
    if name in names:
        return name
    near = difflib.get_close_matches(str(name), names, n=1, cutoff=0.4)
    listed = ", ".join(names[:60]) + (" ..." if len(names) > 60 else "")
    advice = f"did you mean {near[0]!r}?" if near else f"choose one of: {listed}"
    raise UserError(f"unknown {kind} {name!r}: {advice}")


# ---- Command lines -------------------------------------------------------------------------------

FULL_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
SIGNALS = tuple(  # that end a process; Windows has no SIGHUP
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)


def command_line(main: Callable[[], None], errors: tuple[type[Exception], ...] = ()) -> None:
    """Runs a script's `main` and turns what a user can cause into one line on stderr.

    UserError, the exception types in `errors` (those of damaged or foreign files), a full disk and
    too little memory end in exit code 2; Ctrl-C, SIGTERM and a closed terminal in 130; on POSIX
    systems a closed pipe, such as `| head`, in 1 and without a word. Every other exception is a
    mistake in the code and keeps its traceback; `python -X dev` shows all of them.
    """
    warnings.formatwarning = lambda message, *_: f"warning: {message}\n"
    for number in SIGNALS:
        if signal.getsignal(number) == signal.SIG_DFL:  # `nohup` has SIGHUP ignored
            signal.signal(number, signal.default_int_handler)
    try:
        main()
        print(end="", flush=True)  # or what cannot be written is found out when Python ends
        return
    except KeyboardInterrupt as interrupt:
        line, code = f"interrupted: {interrupt}".removesuffix(": "), 130
    except BrokenPipeError:
        if not nobody_reads_the_output():
            raise
        devnull = os.open(os.devnull, os.O_WRONLY)
        os.dup2(devnull, sys.stdout.fileno())  # for what is still unwritten
        sys.exit(1)
    except Exception as error:
        line, code = describe_user_error(error, errors), 2
        if line is None or sys.flags.dev_mode:
            raise
    with suppress(OSError):  # the terminal may be gone
        print(line, file=sys.stderr)
    sys.exit(code)


def nobody_reads_the_output() -> bool:
    """Whether standard output leads into a pipe that was closed, as by `| head`."""
    try:
        print(flush=True)
    except BrokenPipeError:
        return True
    return False


def describe_user_error(error: Exception, errors: tuple[type[Exception], ...]) -> str | None:
    """The line for an error that is meant for a user; None for a mistake in the code."""
    if isinstance(error, (UserError, *errors)):
        return f"error: {' '.join(str(error).split())}"
    if isinstance(error, OSError) and error.errno in FULL_DISK:
        return f"error: {error.filename or 'a file'} was not written, {error.strerror}: make room"
    out_of_memory = isinstance(error, (MemoryError, torch.OutOfMemoryError))
    if out_of_memory or "DefaultCPUAllocator" in str(error):  # a RuntimeError on a CPU
        return "error: out of memory: use a smaller --preset, or fewer windows, tasks or workers"
    return None


def pick_device(name: str | None, threads: int | None = None) -> torch.device:
    """The device of that name; without a name `cuda` where there is one, else `cpu`.

    `threads` is the number of PyTorch's CPU threads. An operation ends when all of its threads have
    ended, so one thread on a busy core delays the whole operation. With another number of threads
    results may differ in their last digits. Raises UserError for a device that cannot be used here.
    """
    if threads is not None:
        if threads < 1:
            raise UserError(f"--threads is {threads}: use at least 1")
        torch.set_num_threads(threads)
    name = name or ("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError) as error:
        reason = str(error).split("\n")[0]
        raise UserError(
            f"--device {name} cannot be used here ({reason}): use --device cpu"
        ) from error
    if device.type == "cuda":
        torch.set_float32_matmul_precision("high")  # TF32, as in convolutions by default
        torch.cuda.set_device(device.index or 0)  # for streams and graphs
    return device


def usable_cores() -> int:
    """The cores that this process may use, which on shared machines are not all that there are."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def hardware(device: str | torch.device = "cpu") -> str:
    """The name of the processor that results are measured on, and how many cores it has."""
    if torch.device(device).type == "cuda":
        return torch.cuda.get_device_name(device)
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    except OSError:
        models = []
    name = models[0] if models else platform.processor() or platform.machine()
    return f"{name}, {usable_cores()} cores"


def provenance(script: str, argv: Sequence[str] | None, device: str | torch.device) -> dict:
    """What stands beside every number: the hardware, the date, and the command that made it."""
    arguments = sys.argv[1:] if argv is None else argv
    return {
        "hardware": hardware(device),
        "date": time.strftime("%Y-%m-%d"),
        "command": shlex.join(["python", script, *arguments]),
    }


# ---- Tables, bars, lines of JSON -----------------------------------------------------------------


def format_table(rows: Sequence[Sequence[Any]]) -> str:
    """A Markdown table, the first row its head, whose columns are aligned in a terminal too."""
    cells = [[str(cell) for cell in row] for row in rows]
    widths = [max(len(cell) for cell in column) for column in zip(*cells)]
    cells.insert(1, ["-" * width for width in widths])
    padded = [[cell.ljust(width) for cell, width in zip(row, widths)] for row in cells]
    return "\n".join(f"| {' | '.join(row)} |" for row in padded)


def count(number: int, noun: str) -> str:
    """`1 task`, `2 tasks`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def print_settings(used: dict[str, Any], default: dict[str, Any]) -> None:
    """Prints a table of a run's settings, with the default beside a value that differs from it."""
    rows = [["setting", "value", "default"]]
    for name, value in used.items():
        usual = default.get(name, value)
        other = "" if usual == value else format_value(usual)
        rows.append([name, format_value(value), other])
    print(format_table(rows), flush=True)


def format_value(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


class StandardError:
    """stderr for a progress bar. It may be gone: Ctrl-C in `command 2>&1 | tee` ends tee."""

    def write(self, text: str) -> None:
        with suppress(OSError, ValueError):
            sys.stderr.write(text)

    def flush(self) -> None:
        with suppress(OSError, ValueError):
            sys.stderr.flush()

    def fileno(self) -> int:  # tqdm asks for the width of the terminal
        return sys.stderr.fileno()


def progress_bar(**options: Any) -> tqdm:
    """A progress bar on stderr, as wide as the terminal; `options` are those of tqdm."""
    return tqdm(file=StandardError(), dynamic_ncols=True, **options)


def append_json(path: Path, **values: Any) -> None:
    """Appends one line of JSON to a file."""
    with path.open("a") as file:
        file.write(json.dumps(values) + "\n")


def read_json_lines(path: Path) -> list[dict[str, Any]]:
    """The lines of such a file, without one that a killed process did not finish.

    A run that goes on rewrites the file from these lines, or the cut line would stay in the middle.
    """
    if not path.exists():
        return []
    lines = []
    for text in path.read_text(errors="replace").splitlines():
        with suppress(ValueError):
            lines.append(json.loads(text))
    return [line for line in lines if isinstance(line, dict)]


# ---- Folders and signals -------------------------------------------------------------------------


@contextmanager
def locked(
    folder: Path, name: str = ".lock", flag: str = "--out", waiting: str | None = None
) -> Iterator[None]:
    """Makes a folder, and holds a lock in it that one process can have at a time.

    The operating system frees the lock when this process ends, however that comes about.

    Args:
        folder, name: of the lock's file.
        flag: names the folder on the command line.
        waiting: printed before waiting for the process that has the lock; None: nobody waits, and
            UserError is raised.

    Raises:
        UserError: another process has the lock, or the folder cannot be written to.
    """
    lock = filelock.FileLock(folder / name)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=0)
    except filelock.Timeout:
        if waiting is None:
            raise UserError(f"another process runs in {folder}: use another {flag}") from None
        print(waiting, flush=True)
        lock.acquire()
    except OSError as error:
        reason = error.strerror or error
        raise UserError(f"{folder} cannot be written to ({reason}): use another {flag}") from None
    try:
        yield
    finally:
        lock.release()


class StopRequest:
    """Turns Ctrl-C, SIGTERM and a closed terminal into a request to stop after the step at hand.

        with StopRequest() as stop:
            for step in steps:
                ...
                if stop.requested:
                    save()
                    raise KeyboardInterrupt("saved")

    A second signal stops at once. Inside `stop.suspended()` the first one already does.
    """

    def __init__(self) -> None:
        self.requested = False
        self.previous: dict[int, Any] = {}

    def __enter__(self) -> "StopRequest":
        for number in SIGNALS:
            if signal.getsignal(number) != signal.SIG_IGN:  # `nohup` has SIGHUP ignored
                self.previous[number] = signal.signal(number, self.handle)
        return self

    def __exit__(self, *_: Any) -> None:
        for number, handler in self.previous.items():
            signal.signal(number, handler)

    def handle(self, *_: Any) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
        with suppress(OSError):  # print is not safe in a signal handler
            os.write(2, b"\nstopping after the step at hand; once more stops at once\n")

    @contextmanager
    def suspended(self) -> Iterator[None]:
        """Restores the previous handlers inside, for long work that has nothing to save.

        Raises KeyboardInterrupt if a stop was requested before.
        """
        if self.requested:
            raise KeyboardInterrupt
        self.__exit__()
        try:
            yield
        finally:
            self.__enter__()


# ---- Worker processes ----------------------------------------------------------------------------

# In a worker process, the queue that `report_progress` writes to.
worker: dict[str, Any] = {"progress": None}


def check_workers(workers: int | None) -> None:
    """Raises UserError for a number of processes below 1."""
    if workers is not None and workers < 1:
        raise UserError(f"--workers is {workers}: use at least 1")


class WorkerPool:
    """Processes that call jobs, kept from one call of `run` to the next.

        with WorkerPool(workers) as pool:
            for ...:
                results = pool.run(job, jobs, bar)

    Args:
        workers: processes at most; None: one a core. A process starts only when there is a job for
            it.

    Raises UserError if `workers` is below 1.
    """

    def __init__(self, workers: int | None = None):
        check_workers(workers)
        self.workers = workers or usable_cores()
        if sys.platform == "win32":
            self.workers = min(self.workers, 61)  # Python waits for no more of them there
        context = multiprocessing.get_context("spawn")  # neither threads nor a GPU survive a fork
        self.existing_children = set(multiprocessing.active_children())
        self.started = False  # whether a process ever was
        with ignored_signals():
            self.progress = context.SimpleQueue()
            self.executor = ProcessPoolExecutor(
                self.workers, context, start_worker, (self.progress,)
            )

    def run(
        self, job: Callable[..., Any], jobs: Sequence[dict[str, Any]], bar: tqdm | None = None
    ) -> list:
        """Calls `job(**arguments)` for each dictionary of arguments.

        Args:
            job: a function of a module; it may call `report_progress`, which moves `bar`.
            jobs: the keyword arguments of each call.

        Returns:
            What the calls returned, in the order of `jobs`.

        Raises:
            UserError: a worker process was killed or could not start.
            Exception: what a job raised. The other jobs are ended by then, and no process is left.
        """
        finished = False
        try:
            with ignored_signals():  # workers inherit that: a terminal sends Ctrl-C to them, too
                futures = [self.executor.submit(job, **arguments) for arguments in jobs]
            pending = set(futures)
            while pending:
                done, pending = wait(pending, timeout=0.1, return_when=FIRST_COMPLETED)
                while not self.progress.empty():
                    text, amount = self.progress.get()
                    self.started = True
                    if bar is not None:
                        bar.set_postfix_str(text)
                        bar.update(amount)
                for future in done:
                    future.result()  # raises what the job raised
            finished = True
            return [future.result() for future in futures]
        except BrokenProcessPool:
            if self.started:
                problem = "a worker process was killed, perhaps for memory: try fewer --workers"
            else:
                problem = (
                    "worker processes could not start: a script that collects or evaluates must do "
                    'so under `if __name__ == "__main__":`, since each process imports it once more'
                )
            raise UserError(problem) from None
        finally:
            if not finished:
                self.end(at_once=True)

    def end(self, at_once: bool = False) -> None:
        """Ends the processes, after the jobs at hand or `at_once`, and waits for them."""
        with ignored_signals():
            if at_once:
                for process in set(multiprocessing.active_children()) - self.existing_children:
                    process.kill()
            self.executor.shutdown(cancel_futures=True)

    def __enter__(self) -> "WorkerPool":
        return self

    def __exit__(self, *_: Any) -> None:
        self.end()


def run_jobs(
    job: Callable[..., Any],
    jobs: Sequence[dict[str, Any]],
    *,
    total: int,
    description: str,
    unit: str = "episode",
    workers: int | None = None,
    pool: WorkerPool | None = None,
) -> list:
    """Calls jobs in the processes of a `WorkerPool`, with a progress bar.

    Args:
        job, jobs: see `WorkerPool.run`.
        total, description, unit: what the progress bar counts to, its name, what it counts.
        workers: see `WorkerPool`; ignored if a `pool` is given.
        pool: whose processes work; None: those of a pool that lives as long as the jobs.

    Returns and raises what `WorkerPool.run` does.
    """
    with nullcontext(pool) if pool else WorkerPool(workers) as pool:
        with progress_bar(total=total, desc=description, unit=unit) as bar:
            return pool.run(job, jobs, bar)


@contextmanager
def ignored_signals() -> Iterator[None]:
    """Ignores Ctrl-C, SIGTERM and a closed terminal, also in the processes that are started inside.

    Only the main thread can set handlers, and only the main thread is interrupted.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = {number: signal.signal(number, signal.SIG_IGN) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def start_worker(progress: Any) -> None:
    """Prepares a worker process, which ends as soon as the one that started it is gone."""

    def end_with_parent() -> None:
        multiprocessing.parent_process().join()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    torch.set_num_threads(1)  # the other cores have processes of their own
    worker["progress"] = progress
    report_progress("", 0)  # the process has started


def report_progress(text: str, amount: int) -> None:
    """Moves the progress bar of the process that runs the jobs; elsewhere it does nothing."""
    if worker["progress"] is not None:
        worker["progress"].put((text, amount))


# ---- CUDA ----------------------------------------------------------------------------------------


class CUDAGraphed:
    """A function of tensors as one CUDA graph, so that its kernels are launched together.

    The first call clones its inputs and captures the graph on the clones. Every call copies its
    inputs into the clones, so their shapes must never change, and replays the graph. Other tensors
    that the function reads, such as weights, must stay at their place in memory. The tensors that
    are returned are overwritten by the next call.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        self.inputs: Any = None

    def __call__(self, *inputs: Any) -> Any:
        if self.inputs is None:
            self.capture(inputs)
        torch._foreach_copy_(tree_leaves(self.inputs), tree_leaves(inputs))
        self.graph.replay()
        return self.outputs

    def capture(self, inputs: Any) -> None:
        self.inputs = tree_map(torch.clone, inputs)
        self.graph, stream = torch.cuda.CUDAGraph(), torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            self.function(*self.inputs)  # libraries prepare themselves at their first call
        torch.cuda.current_stream().wait_stream(stream)
        with torch.cuda.graph(self.graph):
            self.outputs = self.function(*self.inputs)
