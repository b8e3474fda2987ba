"""Settings, command lines, locks, signals, worker processes."""

import argparse
import contextlib
import functools
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import common
from common import UserError, command_line, run_jobs, setting

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Settings:
    steps: int = setting(10, "how many steps", least=1, most=99)
    rate: float = setting(0.5, "the rate", least=0)
    order: str = setting("first", "which order", choices=("first", "second"))
    limit: int | None = setting(None, "at most so many")
    augment: bool = setting(False, "augment or not")

    def __post_init__(self):
        common.check_settings(self)


# ---- Settings ------------------------------------------------------------------------------------


def parsed(*argv):
    parser = argparse.ArgumentParser()
    presets = {"large": Settings(steps=50), "small": Settings()}
    common.add_settings(parser, Settings, presets)
    return common.with_flags(Settings(steps=20), parser.parse_args(argv)), parser


def test_a_field_is_a_flag_and_what_is_not_given_keeps_its_value():
    settings, _ = parsed("--limit", "3", "--augment", "--order", "second")
    assert settings == Settings(steps=20, limit=3, augment=True, order="second")
    assert parsed("--no-augment")[0] == Settings(steps=20)


def test_help_tells_the_value_in_each_preset():
    text = " ".join(parsed()[1].format_help().split())
    assert "how many steps (large 50, small 10)" in text and "the rate (0.5)" in text


@pytest.mark.parametrize(
    "flags, message",
    [
        (["--steps", "0"], "--steps is 0: use at least 1"),
        (["--steps", "100"], "--steps is 100: use at most 99"),
        (["--rate", "nan"], "--rate is nan: use a finite number"),
        (["--rate", "inf"], "--rate is inf: use a finite number"),
    ],
)
def test_a_setting_out_of_its_bounds_is_refused(flags, message):
    with pytest.raises(UserError, match=message):
        parsed(*flags)


def test_an_unknown_name_suggests_the_nearest_right_one():
    assert common.choose("reach", ["push", "reach"], "task") == "reach"
    with pytest.raises(UserError, match="unknown task 'raech': did you mean 'reach'"):
        common.choose("raech", ["push", "reach"], "task")
    with pytest.raises(UserError, match="choose one of: push, reach"):
        common.choose("0", ["push", "reach"], "task")


def test_a_setting_that_differs_from_its_default_shows_it_also_where_that_is_none(capsys):
    common.print_settings({"goals": 20, "rate": 0.1, "new": 1}, {"goals": None, "rate": 0.1})
    rows = [line.split("|")[1:-1] for line in capsys.readouterr().out.splitlines()[2:]]
    shown = [[cell.strip() for cell in row] for row in rows]
    assert shown == [["goals", "20", "None"], ["rate", "0.1", ""], ["new", "1", ""]]


def test_a_table_is_markdown_with_aligned_columns():
    table = common.format_table([["task", "%"], ["reach", 100.0]])
    assert table == "| task  | %     |\n| ----- | ----- |\n| reach | 100.0 |"


# ---- Command lines -------------------------------------------------------------------------------


class Foreign(Exception):
    pass


def ended(error, capsys):
    """The exit code and stderr of a script that raises this error."""

    def main():
        raise error

    with pytest.raises(SystemExit) as end:
        command_line(main, errors=(Foreign,))
    return end.value.code, capsys.readouterr().err


@pytest.mark.parametrize(
    "error, line",
    [
        (UserError("no such task:\n name another"), "error: no such task: name another\n"),
        (Foreign("x.pt is damaged"), "error: x.pt is damaged\n"),
        (OSError(28, "No space left", "a.pt"), "error: a.pt was not written, No space left: "),
        (MemoryError(), "error: out of memory: use a smaller --preset"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), "error: out of memory"),
    ],
)
def test_an_error_that_is_meant_for_a_user_is_one_line(error, line, capsys):
    code, text = ended(error, capsys)
    assert code == 2 and text.startswith(line) and text.count("\n") == 1


@pytest.mark.parametrize(
    "error", [ValueError("too many values"), OSError("x"), KeyError("x"), RuntimeError("in memory")]
)
def test_a_mistake_in_the_code_keeps_its_traceback(error):
    with pytest.raises(type(error)):
        command_line(lambda: (_ for _ in ()).throw(error))


def test_ctrl_c_ends_in_130_with_what_was_saved(capsys):
    assert ended(KeyboardInterrupt("saved after step 3"), capsys)[0] == 130
    assert ended(KeyboardInterrupt("saved"), capsys)[1] == "interrupted: saved\n"
    assert ended(KeyboardInterrupt(), capsys)[1] == "interrupted\n"


def test_a_reader_that_stops_reading_ends_a_script_without_a_word():
    code = (
        "from common import command_line; "
        "command_line(lambda: [print('x' * 100, flush=True) for _ in range(100_000)])"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        process.stdout.readline()
        process.stdout.close()  # as `| head -1` does
        assert process.stderr.read() == b""
    assert process.returncode == 1
    with pytest.raises(BrokenPipeError):  # of something else, such as a robot's socket
        command_line(lambda: (_ for _ in ()).throw(BrokenPipeError()))


def test_threads_are_as_many_as_were_asked_for():
    before = torch.get_num_threads()
    try:
        common.pick_device("cpu", threads=3)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
    with pytest.raises(UserError, match="--threads is 0"):
        common.pick_device("cpu", threads=0)


def test_a_device_that_is_not_there_is_refused():
    with pytest.raises(
        UserError, match=r"--device cuda:77 cannot be used here .*: use --device cpu"
    ):
        common.pick_device("cuda:77")


def test_a_broken_pipe_does_not_end_the_work(monkeypatch):
    class Broken:
        def write(self, *text):
            raise BrokenPipeError

        flush = write

    monkeypatch.setattr(sys, "stderr", Broken())
    with common.progress_bar(total=2) as progress:
        progress.update()
        progress.set_postfix(loss="0")
    with pytest.raises(SystemExit) as end:
        command_line(lambda: (_ for _ in ()).throw(UserError("x")))
    assert end.value.code == 2


def test_a_line_of_json_that_was_cut_is_skipped(tmp_path):
    path = tmp_path / "metrics.jsonl"
    assert common.read_json_lines(path) == []
    common.append_json(path, step=1, loss=0.5)
    common.append_json(path, step=2, loss=0.4)
    path.write_text(path.read_text()[:-5])
    assert common.read_json_lines(path) == [{"step": 1, "loss": 0.5}]


# ---- Folders and signals -------------------------------------------------------------------------


def test_a_folder_in_which_another_process_runs_is_refused_and_freed_by_its_end(tmp_path):
    program = (
        f"import sys, time; sys.path.insert(0, {str(ROOT)!r})\n"
        "import common, pathlib\n"
        f"with common.locked(pathlib.Path({str(tmp_path)!r})):\n"
        "    print('in', flush=True); time.sleep(60)"
    )
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "in\n"
    with pytest.raises(UserError, match="another process runs in"), common.locked(tmp_path):
        pass
    process.kill()
    process.wait()
    with common.locked(tmp_path):
        pass


def test_a_lock_deletes_nothing_of_a_users_whatever_its_name(tmp_path):
    names = [".2024-11-02.notes.md", ".01_todo.txt", ".1.last.pt", ".last.pt.abc123.tmp", "x.tmp"]
    for name in names:
        (tmp_path / name).write_text("mine")
    (tmp_path / ".2024.d").mkdir()
    with common.locked(tmp_path):
        pass
    assert all((tmp_path / name).read_text() == "mine" for name in names)
    assert (tmp_path / ".2024.d").is_dir()


def test_a_folder_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="cannot be written to"), common.locked(tmp_path / "file/x"):
        pass


@pytest.mark.usefixtures("own_folder")  # where `nohup` ignores Ctrl-C, too
def test_a_first_ctrl_c_is_a_request_and_a_second_one_stops():
    before = signal.getsignal(signal.SIGINT)
    with common.StopRequest() as stop:
        assert not stop.requested
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.requested
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1)
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.usefixtures("own_folder")  # where `nohup` ignores Ctrl-C, too
def test_where_a_stop_request_is_suspended_ctrl_c_stops_at_once():
    with common.StopRequest() as stop:
        with pytest.raises(KeyboardInterrupt), stop.suspended():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1)
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.requested


# ---- Worker processes ----------------------------------------------------------------------------


def test_results_come_in_the_order_of_the_jobs_and_a_pool_keeps_its_processes(tmp_path):
    telling = {"total": 3, "description": "telling"}
    with common.WorkerPool(2) as pool:
        (process,) = run_jobs(os.getpid, [{}], pool=pool, **telling)  # one job: one process
        assert run_jobs(os.getpid, [{}] * 3, pool=pool, **telling) == [process] * 3
        assert process != os.getpid()
        run_jobs(os.chdir, [{"path": tmp_path}], pool=pool, **telling)
        names = ["c", "a", "b"]
        found = run_jobs(os.path.abspath, [{"path": name} for name in names], pool=pool, **telling)
    assert found == [str(tmp_path / name) for name in names]
    assert run_jobs(os.getpid, [{}], **telling) != [process]  # of a pool of its own


def test_a_process_that_is_killed_between_two_calls_is_told_in_one_line():
    options = {"total": 1, "description": "waiting"}
    with common.WorkerPool(1) as pool:
        (process,) = run_jobs(os.getpid, [{}], pool=pool, **options)
        os.kill(process, signal.SIGKILL)
        with pytest.raises(UserError, match="killed, perhaps for memory"):
            for _ in range(100):  # until the pool has noticed
                run_jobs(os.getpid, [{}], pool=pool, **options)


def exit_at_once(code):
    os._exit(code)


def sleep_or_fail(seconds):
    time.sleep(float(seconds))


@pytest.mark.parametrize(
    "job, jobs, error, message",
    [
        (exit_at_once, [{"code": 1}], UserError, "killed, perhaps for memory"),
        (sleep_or_fail, [{"seconds": 60}, {"seconds": "long"}], ValueError, "long"),
    ],
)
def test_a_fault_in_one_process_ends_all(job, jobs, error, message, capfd):
    handler = signal.getsignal(signal.SIGINT)
    start = time.monotonic()
    with pytest.raises(error, match=message):
        run_jobs(job, jobs, workers=2, total=len(jobs), description="failing")
    assert time.monotonic() - start < 50 and not multiprocessing.active_children()
    assert "Traceback" not in capfd.readouterr().err
    assert signal.getsignal(signal.SIGINT) is handler  # Ctrl-C works again


UNGUARDED = """
import time, common
common.command_line(lambda: common.run_jobs(
    time.localtime, [{}], workers=1, total=1, description="telling"))
"""


def test_a_script_without_a_main_guard_is_told_that_it_needs_one(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(UNGUARDED)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(script)]
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert ran.returncode == 2
    assert 'under `if __name__ == "__main__":`' in ran.stderr.splitlines()[-1]


SLEEPERS = """
import os, signal, sys, threading
import common
from tests.test_common import sleep_or_fail
signal.signal(signal.SIGINT, signal.default_int_handler)  # also under `nohup`
signal.signal(signal.SIGHUP, signal.SIG_DFL)
kill, target = (os.kill, os.getpid()) if sys.argv[1] == "SIGKILL" else (os.killpg, 0)
threading.Timer(0.3, kill, (target, signal.Signals[sys.argv[1]])).start()
common.command_line(lambda: common.run_jobs(
    sleep_or_fail, [{"seconds": 60}] * 2, workers=2, total=2, description="sleeping"))
"""


@pytest.mark.parametrize(
    "name, code", [("SIGINT", 130), ("SIGTERM", 130), ("SIGHUP", 130), ("SIGKILL", -signal.SIGKILL)]
)
def test_ctrl_c_or_a_kill_while_workers_import_leaves_no_process_and_no_traceback(name, code):
    command = [sys.executable, "-c", SLEEPERS, name]
    process = subprocess.Popen(
        command, cwd=ROOT, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        _, error = process.communicate(timeout=120)  # until the last process closes its stderr
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == code and "Traceback" not in error
    assert ("interrupted" in error) == (code == 130)


def test_jobs_run_from_a_thread_too():
    found = []
    job = functools.partial(run_jobs, time.gmtime, [{}], workers=1, total=1, description="telling")
    thread = threading.Thread(target=lambda: found.extend(job()))
    thread.start()
    thread.join(timeout=60)
    assert len(found) == 1


# ---- CUDA ----------------------------------------------------------------------------------------


class Replayed:
    """What stands in for a recorded graph where there is no GPU: it runs the function again."""

    graphed: common.CUDAGraphed

    def replay(self):
        again = self.graphed.function(*self.graphed.inputs)
        torch._foreach_copy_(list(self.graphed.outputs), list(again))


def test_a_graphed_function_is_the_function_until_the_next_call(monkeypatch):
    device = "cuda" if torch.cuda.is_available() else "cpu"
    weight, calls = torch.full((3,), 2.0, device=device, requires_grad=True), []

    def function(batch, more):
        calls.append(batch)
        loss = ((weight * batch["x"]) ** 2).sum() + more[0].sum()
        return loss.detach(), torch.autograd.grad(loss, weight)[0]

    graphed = common.CUDAGraphed(function)
    if device == "cpu":
        graph = Replayed()
        graph.graphed = graphed
        stream = SimpleNamespace(wait_stream=lambda stream: None)
        monkeypatch.setattr(torch.cuda, "CUDAGraph", lambda: graph)
        for name in ("Stream", "current_stream"):
            monkeypatch.setattr(torch.cuda, name, lambda: stream)
        for name in ("stream", "graph"):
            monkeypatch.setattr(torch.cuda, name, lambda *_: contextlib.nullcontext())

    generator = torch.Generator().manual_seed(0)
    for _ in range(3):
        x, y = torch.randn(2, 3, generator=generator).to(device)
        given = ({"x": x.clone()}, [y.clone()])
        found = graphed({"x": x}, [y])
        assert all(batch["x"] is not x for batch in calls)  # it works on copies
        assert all(torch.allclose(a, b) for a, b in zip(found, function(*given)))
        with torch.no_grad():
            weight += 1  # in place, as an optimizer does
        assert torch.equal(x, given[0]["x"])  # the caller's own stays as it was
