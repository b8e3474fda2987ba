"""A UR10e with an AG95 gripper and a RealSense camera: record demonstrations, run a policy.

    python robot.py check  --config robot.json     # every connection and mode; nothing moves
    python robot.py record --config robot.json --task stack-cube --instruction "..." --episodes 10
    python robot.py replay --config robot.json --data demos/stack-cube.npz --episode 0
    python robot.py run    --config robot.json --checkpoint adapted.pt --data demos/stack-cube.npz
    python robot.py camera --out scene.npz         # records depth images, for --camera

All but the last need --host ADDRESS, the robot's. Without an arm, `python -m tests.emulator`
emulates one at 127.0.0.1. With --dry-run nothing is made to move.

One action, from the camera to the arm: `Cell.observe` takes a frame, `run` draws a chunk of actions
by `DAMIPolicy.sample_actions`, and `execute` passes it to `Servo.follow`, which makes target poses.
In a thread, 125 times a second, `Servo.step` checks the arm, interpolates and limits the speed
(`Servo.tick`), and never sends a pose that is further ahead of the arm than allowed. `RTDE.send`
packs the bytes; on the controller `PROGRAM` reads the pose from registers and calls servoj.

Poses are (x, y, z, rx, ry, rz): metres and axis-angle radians of the tool center point (TCP) in the
robot's base frame. State (7,): TCP pose, gripper. Action (7,): dx, dy, dz in metres, drx, dry, drz
in radians (a rotation in the base frame, applied after the present one), gripper; relative to the
pose commanded last. Gripper: 0 open, 1 closed. What stops the arm is in `Servo`; nothing here
unlocks a stop or connects again by itself.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import os
import random
import re
import select
import socket
import struct
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

import baselines  # noqa: F401  its policies are registered
import common
import data
import model
import report
from clip import TextWeightsError, text_features
from common import UserError, setting
from data import Demonstrations, RecordingError
from geometry import (
    compose,
    depth_to_points,
    difference,
    distance,
    is_pose,
    lengths,
    nearer,
    other_rotvec,
    thin,
    toward,
    transform,
)
from model import CheckpointError

try:
    import termios
    import tty

    TerminalError = termios.error  # raised by pyserial if an adapter is pulled out
except ImportError:  # Windows has neither
    termios = None
    TerminalError = OSError

STATE_DIM = ACTION_DIM = 7


class RobotError(Exception):
    """Arm, gripper or camera cannot go on; the message says why.

    If no caller handles it, the command ends and the arm is stopped.
    """


class CameraError(RobotError):
    """No usable cloud: a policy's arm is held, and stopped after `max_hold_s`."""


class StaleState(RobotError):
    """The newest state is too old.

    `arrived`: True if newer states wait unread in the socket, because this computer was too busy;
    False if the network or the controller is late.
    """

    def __init__(self, message: str, arrived: bool) -> None:
        super().__init__(message)
        self.arrived = arrived


# ---- Settings ------------------------------------------------------------------------------------

CORNER = {"shape": (3,), "least": -5.0, "most": 5.0}
TRANSFORM = {"shape": (4, 4), "least": -5.0, "most": 5.0, "rigid": True}
PORT = {"least": 1, "most": 65535}
ROUNDING = 1e-6  # metres: a corner of the box that was written as float32 is still in it
STATE_DELAY = 0.025  # seconds from measuring a pose to following the answer


@dataclass(frozen=True)
class Settings:
    """What the JSON file of --config holds, in metres, radians and the robot's base frame.

    The first five have no default, because they depend on where the arm is mounted. Raises
    ValueError, in one line, for a value of the wrong type, out of range, or at odds with another.
    Actions are checked by `check_steps` and `check_poses` before they are sent; a way that
    `Servo.go` takes by `check_poses`, at both ends.
    """

    tcp_low_m: tuple = setting(MISSING, "lower corner of the box that the TCP stays in", **CORNER)
    tcp_high_m: tuple = setting(MISSING, "upper corner of that box", **CORNER)
    crop_low_m: tuple = setting(
        MISSING, "lower corner of the box of points that are kept", **CORNER
    )
    crop_high_m: tuple = setting(MISSING, "upper corner of that box", **CORNER)
    camera_to_base: tuple = setting(MISSING, "pose of the DEPTH frame", **TRANSFORM)
    start_pose: tuple | None = setting(None, "where `run` begins", shape=(6,), least=-6.3, most=6.3)
    outside_box: str = setting("stop", "for targets outside the box", choices=("stop", "clamp"))
    rotation_near_rad: tuple = setting((0, 3.14159, 0), "the reference of `nearer`", **CORNER)
    num_points: int = setting(1024, "points of a cloud", least=1, most=100_000)
    policy_hz: float = setting(10.0, "observations and actions a second", least=1, most=30)
    servo_hz: float = setting(125.0, "poses a second", least=100, most=500)
    max_speed_m_s: float = setting(0.25, "the TCP is never faster", least=0.001, most=1.0)
    max_speed_rad_s: float = setting(0.16, "the TCP never turns faster", least=0.001, most=3.0)
    max_step_m: float = setting(0.05, "a longer step is a jump, which stops", least=0.001, most=0.5)
    max_step_rad: float = setting(0.2, "a larger turn in one step stops", least=0.001, most=3.0)
    max_state_age_s: float = setting(
        0.1, "an older state of the arm stops it", least=0.01, most=1.0
    )
    max_lag_m: float = setting(
        0.03, "stops if the arm is farther from its target", least=0.001, most=0.5
    )
    max_lag_rad: float = setting(
        0.2, "stops if it is turned farther from its target", least=0.001, most=3.0
    )
    max_hold_s: float = setting(
        2.0, "stops if no new actions come for this long", least=0.01, most=60
    )
    servo_lookahead_s: float = setting(
        0.1, "lookahead time of servoj, which smooths", least=0.03, most=0.2
    )
    servo_gain: float = setting(300.0, "gain of servoj", least=100, most=2000)
    gripper_serial: str | None = setting(
        None, "serial port of the gripper, such as /dev/ttyUSB0; null: gripper_port of --host"
    )
    gripper_slave: int = setting(1, "Modbus address of the gripper", least=1, most=247)
    gripper_open_at: int = setting(1000, "per mille where it is open", choices=(0, 1000))
    gripper_force_percent: int = setting(30, "gripping force", least=20, most=100)
    rtde_port: int = setting(30004, "port of RTDE", **PORT)
    script_port: int = setting(30002, "port of the secondary interface", **PORT)
    dashboard_port: int = setting(29999, "port of the dashboard server", **PORT)
    gripper_port: int = setting(54321, "port of the gripper's serial bridge", **PORT)

    def __post_init__(self) -> None:
        for f in fields(self):
            try:
                check_value(getattr(self, f.name), f.type, **f.metadata)
            except ValueError as error:
                self.refuse(f.name, str(error))
        for box in ("tcp", "crop"):
            low, high = getattr(self, f"{box}_low_m"), getattr(self, f"{box}_high_m")
            if not np.less(low, high).all():
                self.refuse(f"{box}_low_m", f"each number must be below that of {box}_high_m")
        for unit in ("m", "rad"):
            speed = getattr(self, f"max_speed_{unit}_s")
            allowed = getattr(self, f"max_lag_{unit}")
            lag = speed * self.servo_lookahead_s  # of a healthy arm at full speed
            if lag > 0.9 * allowed:
                why = f"at max_speed_{unit}_s the arm lags by {lag:.3f}: allow more, or be slower"
                self.refuse(f"max_lag_{unit}", why)
        if self.start_pose is not None:
            try:
                self.check_poses([np.array(self.start_pose, dtype=float)])
            except RobotError as error:
                self.refuse("start_pose", str(error))

    @property
    def lead(self) -> np.ndarray:
        """The most that a sent pose may be ahead of the measured one (2,), metres and radians.

        `Servo` says why.
        """
        return np.array([self.max_speed_m_s, self.max_speed_rad_s]) * self.servo_lookahead_s

    @property
    def target_speed(self) -> np.ndarray:
        """How fast targets move at most: (2,), metres and radians a second."""
        return self.lead / (self.servo_lookahead_s + STATE_DELAY)

    def refuse(self, name: str, why: str) -> None:
        raise ValueError(f"{name} in the robot's settings is {getattr(self, name)!r}: {why}")

    def check_steps(self, steps: Sequence[np.ndarray]) -> None:
        """Raises RobotError if a step (6 or 7,), which takes 1 / policy_hz seconds, is a jump."""
        for step in steps:
            metres, radians = lengths(step)
            if metres > self.max_step_m or radians > self.max_step_rad:
                raise RobotError(
                    f"a step jumps by {metres:.3f} m and {radians:.3f} rad, where max_step_m is "
                    f"{self.max_step_m:g} and max_step_rad {self.max_step_rad:g}"
                )

    def check_poses(self, poses: Sequence[np.ndarray]) -> None:
        """Raises RobotError if the arm must not go through these poses (6,).

        Each must be finite and inside the TCP's box. They are 1 / policy_hz seconds apart, and the
        steps between them must not be jumps.
        """
        if not np.isfinite(poses).all():
            raise RobotError("a pose is not finite")
        self.check_steps([difference(a, b) for a, b in itertools.pairwise(poses)])
        for pose in poses:
            x = pose[:3]
            outside = np.maximum(self.tcp_low_m - x, x - self.tcp_high_m).max()  # metres
            if outside > ROUNDING:
                where = ", ".join(f"{number:.3f}" for number in x)
                raise RobotError(f"the TCP is outside its box, at {where} m")


def check_value(
    value: Any,
    kind: str,
    *,
    shape: tuple = (),
    choices: tuple = (),
    least: float = 0.0,
    most: float = 0.0,
    rigid: bool = False,
    help: str = "",
) -> None:
    """Raises ValueError, saying what to write, if a setting cannot have this value.

    Args:
        value: a number or text, or lists of lists of them.
        kind: its type as the field of `Settings` has it: "int", "str | None", "tuple" ...
        shape: of the lists; () is a single value.
        choices: the values that are possible; () is any.
        least, most: the range of its numbers.
        rigid: whether it is a matrix (4, 4) that moves a rigid body.
        help: is not used; it is in the field's metadata, as those above are.
    """
    if value is None and kind.endswith("None"):
        return
    types = {"int": {int}, "str": {str}}.get(kind.split(" ")[0], {int, float})
    array = np.array(value, dtype=object)
    if array.shape != shape or {type(x) for x in array.flat} - types:
        what = {"int": "a whole number", "str": "text"}.get(kind.split(" ")[0], "a number")
        count = " x ".join(map(str, shape))
        raise ValueError(f"give {count} numbers" if count else f"give {what}")
    if choices and value not in choices:
        raise ValueError(f"use one of {choices}")
    if choices or types == {str}:
        return
    if not all(least <= x <= most for x in array.flat):
        raise ValueError(f"use {least} to {most}; lengths are in metres, angles in radians")
    if rigid and not is_pose(array.astype(float)):
        raise ValueError("its 3 x 3 must be a rotation, its last row 0 0 0 1")


def load_settings(path: str | Path) -> Settings:
    """Reads --config. UserError, one line: missing, unknown, of the wrong type, out of range."""
    try:
        return Settings(**json.loads(Path(path).read_text(encoding="utf-8")))
    except OSError as error:
        reason = f"{path} cannot be read ({error.strerror})"
        raise UserError(f"{reason}: name it by --config, or copy assets/robot.json") from None
    except (TypeError, ValueError) as error:
        reason = str(error).removeprefix("Settings.__init__() ")
        raise UserError(f"{path}: {reason} (an example is assets/robot.json)") from None


# ---- RTDE: the controller's real-time data exchange ----------------------------------------------

HEADER = struct.Struct(">HB")  # size of the whole package, type
REQUEST_PROTOCOL, REQUEST_CONTROLLER = ord("V"), ord("v")
SETUP_OUTPUTS, SETUP_INPUTS, START, DATA, MESSAGE = map(ord, "OISUM")
OLDEST = (5, 5, 1)  # the first software of an e-Series' controller that reports `tcp_offset`
FORMATS = {"INT32": ">i4", "UINT32": ">u4", "DOUBLE": ">f8", "VECTOR6D": "(6,)>f8"}  # for numpy
OUTPUTS = (
    "timestamp",
    "actual_TCP_pose",
    "tcp_offset",
    "payload",
    "target_speed_fraction",
    "robot_mode",
    "safety_mode",
    "runtime_state",
    "robot_status_bits",
    "safety_status_bits",
    "output_int_register_24",  # the session that our program belongs to
    "output_int_register_25",  # the number of the package that our program followed last
)
# Registers 0 to 23 belong to the fieldbus. A package is its number, the pose to go to, the number
# of the session (or STOP), and its own number again. Where its two numbers differ, the program has
# read while the package was being written.
POSE = tuple(f"input_double_register_{24 + i}" for i in range(6))
INPUTS = ("input_int_register_25", *POSE, "input_int_register_24", "input_int_register_26")
STOP = 0  # in the place of the session's number: the program ends
RUNNING = 7  # robot_mode
PLAYING = 2  # runtime_state
PROGRAM_RUNNING = 1 << 1  # of robot_status_bits
STOPPED = 0b111_1111_1100  # of safety_status_bits: all but normal and reduced
SAFETY = {  # safety_mode
    1: "normal",
    2: "reduced",
    3: "protective stop",
    4: "recovery",
    5: "safeguard stop",
    6: "emergency stop",
    7: "emergency stop of the robot",
    8: "violation",
    9: "fault",
    12: "safeguard stop of automatic mode",
    13: "three-position enabling device",
}


class State(NamedTuple):
    """One data package of the controller."""

    values: np.void  # OUTPUTS by name
    received: float  # time.monotonic()

    @property
    def pose(self) -> np.ndarray:
        """TCP pose (6,), metres and axis-angle, base frame."""
        return self.values["actual_TCP_pose"].astype(float)

    @property
    def safety(self) -> str:
        """The name of the safety mode."""
        mode = int(self.values["safety_mode"])
        return SAFETY.get(mode, str(mode))

    def check(self) -> None:
        """Raises RobotError if the arm must not be moved in this state."""
        v = self.values
        if v["safety_mode"] not in (1, 2) or v["safety_status_bits"] & STOPPED:
            raise RobotError(f"safety: {self.safety} (status bits {v['safety_status_bits']:#x})")
        if v["robot_mode"] != RUNNING:
            raise RobotError(
                f"the robot is not running (robot mode {v['robot_mode']}, {RUNNING} is running)"
            )
        slider = v["target_speed_fraction"]
        if slider < 0.99:
            raise RobotError(
                f"the speed slider is at {slider:.0%}, the arm would stay behind: set it to 100%"
            )
        if not np.isfinite(self.pose).all():
            raise RobotError("the pose of the TCP is not finite")


class RTDE:
    """A client of the controller's RTDE interface, protocol version 2: one recipe each way.

    A thread keeps the newest state. A lost connection stays lost: make a new client. Only a program
    that was made for this `session` follows what `send` writes.

    Args:
        hz: how many states a second the controller sends.
        write: claims the input registers; without it `send` must not be called.

    Raises RobotError: refused version, a field NOT_FOUND or IN_USE, lost connection or framing.
    """

    def __init__(self, host: str, port: int = 30004, hz: float = 125.0, write: bool = False):
        self.name = f"RTDE at {host}:{port}"
        self.writes = write
        self.controller_said = ""  # the controller's last text message, as an error ends with it
        self.buffer = b""  # received, and not yet a whole package
        self.newest: State | None = None
        self.error: RobotError | None = None  # why the reader's thread has ended
        self.session = random.SystemRandom().randrange(1, 2**31)
        self.number = 0  # of the package sent last
        self.rotation: np.ndarray | None = None  # the rotation vector sent last
        self.stopped = False  # the program was told to end: nothing is sent any more
        self.lock = threading.Lock()  # of what `send` writes
        self.arrived = threading.Condition()  # a state, or an error
        try:
            self.socket = socket.create_connection((host, port), 2.0)
        except OSError as error:
            raise self.lost(f"cannot be reached: {error}") from None
        try:
            self.handshake(hz, write)
        except BaseException:
            self.socket.close()
            raise
        self.thread = threading.Thread(target=self.read, name="RTDE", daemon=True)
        self.thread.start()

    def handshake(self, hz: float, write: bool) -> None:
        """Agrees on protocol and recipes, and starts the states."""
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if self.request(REQUEST_PROTOCOL, struct.pack(">H", 2))[:1] != b"\x01":
            raise self.lost("protocol version 2 is refused: update the controller's software")
        reply = self.request(REQUEST_CONTROLLER, b"")
        if len(reply) != 16:
            raise self.lost(f"framing lost (a controller's version of {len(reply)} bytes)")
        self.version = struct.unpack(">4I", reply)[:3]  # of the controller's software
        reply = self.request(SETUP_OUTPUTS, struct.pack(">d", hz) + ",".join(OUTPUTS).encode())
        self.output_recipe, self.output_format = self.recipe(reply, OUTPUTS)
        if write:
            reply = self.request(SETUP_INPUTS, ",".join(INPUTS).encode())
            self.input_recipe, self.input_format = self.recipe(reply, INPUTS)
        if self.request(START, b"")[:1] != b"\x01":
            raise self.lost("it does not start sending")

    def lost(self, what: str) -> RobotError:
        """Makes an error, which names the address and ends with the controller's last message."""
        return RobotError(f"{self.name}: {what}{self.controller_said}")

    def recipe(self, reply: bytes, names: Sequence[str]) -> tuple[bytes, np.dtype]:
        """The recipe's id and layout, from the answer to a set-up."""
        types = reply[1:].decode("ascii", "replace").strip(",").split(",")
        software = "software {}.{}.{}".format(*self.version)
        unknown = f"not known to the controller's {software}"
        if self.version < OLDEST:
            unknown += ": update it, {}.{}.{} or later is needed".format(*OLDEST)
        advice = {"IN_USE": "another client holds it", "NOT_FOUND": unknown}
        for name, kind in zip(names, types):
            if kind not in FORMATS:
                raise self.lost(f"field {name} is {kind} ({advice.get(kind, 'an unknown type')})")
        if len(types) != len(names) or not reply[0]:
            raise self.lost(f"the recipe of {len(names)} fields has {len(types)} types")
        return reply[:1], np.dtype([(name, FORMATS[kind]) for name, kind in zip(names, types)])

    def package(self) -> tuple[int, bytes]:
        """The type and payload of the next package. Text messages are skipped; errors quote one."""
        while True:
            kind, payload = self.any_package()
            if kind != MESSAGE:
                return kind, payload
            text = payload[1 : 1 + payload[0]] if payload else b""
            self.controller_said = f"; the controller said: {text.decode('ascii', 'replace')}"

    def any_package(self) -> tuple[int, bytes]:
        """The next package's type and payload, however the bytes were split or joined."""
        while len(self.buffer) < HEADER.size:
            self.receive()
        size, kind = HEADER.unpack_from(self.buffer)
        if size < HEADER.size:
            raise self.lost(f"framing lost (a package of {size} bytes)")
        while len(self.buffer) < size:
            self.receive()
        payload = self.buffer[HEADER.size : size]
        self.buffer = self.buffer[size:]
        return kind, payload

    def receive(self) -> None:
        """Appends to the buffer what arrives next."""
        try:
            received = self.socket.recv(65536)
        except OSError as error:  # a time-out, too
            raise self.lost(f"connection lost, or no answer: {error}") from None
        if not received:
            raise self.lost("connection closed by the controller")
        self.buffer += received

    def request(self, kind: int, payload: bytes) -> bytes:
        """Sends a package and returns the payload of the answer, which has the same type."""
        self.transmit(kind, payload)
        answer, payload = self.package()
        if answer != kind:
            raise self.lost(f"framing lost (type {answer} instead of {kind})")
        return payload

    def transmit(self, kind: int, payload: bytes) -> None:
        try:
            self.socket.sendall(HEADER.pack(HEADER.size + len(payload), kind) + payload)
        except OSError as error:
            raise self.lost(f"connection lost: {error}") from None

    def read(self) -> None:
        """The reader's thread: keeps the newest state until the connection ends."""
        size = 1 + self.output_format.itemsize
        while self.error is None:
            try:
                kind, payload = self.package()
                if (kind, payload[:1], len(payload)) != (DATA, self.output_recipe, size):
                    raise self.lost(f"framing lost (type {kind}, {len(payload)} bytes)")
                values = np.frombuffer(payload, self.output_format, offset=1)[0]
                self.newest = State(values, time.monotonic())
            except RobotError as error:
                self.error = error
            with self.arrived:
                self.arrived.notify_all()

    def state(self, max_age: float = 0.1) -> State:
        """The newest state.

        Raises StaleState if it is older than `max_age` seconds, RobotError if the connection is
        lost.
        """
        with self.arrived:
            self.arrived.wait_for(lambda: self.newest or self.error, 2.0)
        if self.error is not None:
            raise RobotError(str(self.error))
        age = time.monotonic() - self.newest.received if self.newest else math.inf
        if age > max_age:
            try:
                readable, _, _ = select.select([self.socket], [], [], 0)
            except (OSError, ValueError):  # closed meanwhile
                raise self.lost("connection closed") from None
            message = str(self.lost(f"the newest state is {age:.3f} s old"))
            raise StaleState(message, arrived=bool(readable))
        return self.newest

    def send(self, pose: np.ndarray, stop: bool = False) -> None:
        """Writes a target pose (6,) for the program; with `stop` tells it to end.

        After a stop nothing is sent any more.
        """
        with self.lock:
            if self.stopped:
                return
            self.stopped = stop
            self.number += 1
            if self.rotation is None:
                self.rotation = pose[3:]
            # rarely a jump by 2 pi between two packages
            self.rotation = nearer(pose[3:], self.rotation)
            command = STOP if stop else self.session
            inputs = (self.number, *pose[:3], *self.rotation, command, self.number)
            self.transmit(DATA, self.input_recipe + np.array(inputs, self.input_format).tobytes())

    def program_runs(self, state: State) -> bool:
        """Whether the program of this session runs, and is not paused."""
        v = state.values
        playing = v["robot_status_bits"] & PROGRAM_RUNNING and v["runtime_state"] == PLAYING
        return bool(playing and v["output_int_register_24"] == self.session)

    def close(self) -> None:
        with suppress(OSError):  # closed by the controller before
            self.socket.shutdown(socket.SHUT_RDWR)
        self.socket.close()
        self.thread.join(1.0)


# ---- The controller's program and its other ports ------------------------------------------------

MISSING_PACKAGES = 10  # the watchdog waits for so many: 80 ms at 125 Hz

# What runs on the controller. It ends when it is told to, when no inverse kinematics is found, or
# when RTDE is late: then the watchdog ends it, so that no arm moves or stays free whose computer is
# gone. Output register 24 holds the session, which tells whose program it is, and 25 the number of
# the package that it followed last, which tells that it runs. To read a pose takes six reads, and
# the next package may arrive between them: then the package's two numbers, read before and after
# the pose, are different, and the pose is not followed. The watchdog is switched off before the arm
# is braked: nothing is sent then, and the watchdog would cut the braking short.
PROGRAM = """def dami():
  rtde_set_watchdog("input_int_register_24", {watchdog_hz:.1f}, "stop")
  write_output_integer_register(25, 0)
  write_output_integer_register(24, {session})
  {before}()
  while read_input_integer_register(24) == {session}:
    number = read_input_integer_register(26)
    pose = p[{registers}]
    if number == read_input_integer_register(25):
      write_output_integer_register(25, number)
      {turn}
    else:
      sync()
    end
  end
  rtde_set_watchdog("input_int_register_24", 0.1, "ignore")
  {after}()
  stopj(2.0)
  write_output_integer_register(24, 0)
end
"""
SERVO = (
    "servoj(get_inverse_kin(pose, get_actual_joint_positions()), t={period:.4f}, "
    "lookahead_time={lookahead:.3f}, gain={gain:.0f})"
)


def program(session: int, settings: Settings, free: bool) -> str:
    """The URScript program of a session, which moves the arm or sets it free."""
    servo = SERVO.format(
        period=1 / settings.servo_hz, lookahead=settings.servo_lookahead_s, gain=settings.servo_gain
    )
    return PROGRAM.format(
        session=session,
        watchdog_hz=settings.servo_hz / MISSING_PACKAGES,
        registers=", ".join(f"read_input_float_register({24 + i})" for i in range(6)),
        before="freedrive_mode" if free else "sync",
        turn="sync()" if free else servo,
        after="end_freedrive_mode" if free else "sync",
    )


@contextmanager
def port_of(host: str, port: int, what: str) -> Iterator[socket.socket]:
    """A connection to a port of the controller; what fails inside is a RobotError."""
    try:
        with socket.create_connection((host, port), 2.0) as connection:
            yield connection
    except (OSError, UnicodeDecodeError) as error:
        raise RobotError(f"{what} at {host}:{port} does not answer: {error}") from None


def upload(host: str, port: int, text: str, waiting: Callable = lambda: None) -> None:
    """Sends a URScript program; the controller ends the one that runs and starts this one.

    The program may run before the port has answered, and its watchdog then expects poses: `waiting`
    is called again and again to send them.
    """
    with port_of(host, port, "the script port") as connection:
        connection.sendall(text.encode())
        deadline = time.monotonic() + 2
        received = 0  # bytes
        while received < 79:  # the program of a client that has read less may be discarded
            waiting()
            if not select.select([connection], [], [], 0.01)[0]:
                if time.monotonic() > deadline:
                    raise OSError("it says nothing")
                continue
            part = connection.recv(4096)
            if not part:
                raise OSError("it closed the connection")
            received += len(part)


def dashboard(host: str, port: int, *questions: str) -> dict[str, str]:
    """Asks the dashboard server, for example `robotmode`; one line of answer for each question."""
    with port_of(host, port, "the dashboard") as connection, connection.makefile("r") as lines:
        answers = {"dashboard": lines.readline().strip()}  # the banner
        for question in questions:
            connection.sendall(f"{question}\n".encode())
            answers[question] = lines.readline().strip()
        return answers


# ---- Gripper: AG95 over Modbus RTU ---------------------------------------------------------------

INITIALIZE, FORCE, POSITION = 0x0100, 0x0101, 0x0103
INITIALIZED, POSITION_NOW = 0x0200, 0x0202
READ, WRITE = 3, 6
EXCEPTIONS = {1: "unknown function", 2: "unknown register", 3: "value refused", 4: "device failure"}


def crc16(data: bytes) -> bytes:
    """Modbus RTU's check sum, low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc.to_bytes(2, "little")


class Bridge:
    """A serial port over TCP: the methods of pyserial's `Serial` that the gripper needs."""

    def __init__(self, host: str, port: int, timeout: float) -> None:
        self.connection = socket.create_connection((host, port), 2.0)
        self.connection.settimeout(timeout)
        self.write = self.connection.sendall
        self.close = self.connection.close

    def read(self, n: int) -> bytes:
        received = b""
        with suppress(TimeoutError):
            while len(received) < n and (part := self.connection.recv(n - len(received))):
                received += part
        return received

    def reset_input_buffer(self) -> None:
        while select.select([self.connection], [], [], 0)[0] and self.connection.recv(4096):
            pass


class Gripper:
    """An AG95: frames of Modbus RTU over a serial port, 115200 8N1, or a serial bridge on TCP.

    Raises UserError without pyserial, where a serial port is named, and RobotError if the gripper
    cannot be reached, or if an exchange has failed ATTEMPTS times, which takes about 2 s.
    """

    ATTEMPTS = 3  # each may end in a time-out, a bad check sum or an exception; then RobotError

    def __init__(self, settings: Settings, host: str, timeout: float = 0.3) -> None:
        self.settings = settings
        self.timeout = timeout  # seconds
        self.commanded: int | None = None  # the position written last, per mille
        self.where = settings.gripper_serial or f"{host}:{settings.gripper_port}"
        try:
            if settings.gripper_serial:
                import serial

                self.port = serial.Serial(
                    settings.gripper_serial,
                    115200,
                    timeout=timeout,
                    exclusive=True,  # another command would take our answers for its own
                )
            else:
                self.port = Bridge(host, settings.gripper_port, timeout)
        except ImportError:
            raise UserError("a gripper on a serial port needs `pip install pyserial`") from None
        except OSError as error:  # of pyserial, too
            raise RobotError(f"the gripper at {self.where} cannot be reached: {error}") from None
        self.close = self.port.close

    def read_register(self, register: int) -> int:
        return self.exchange(READ, register, 1)  # one register from there on

    def write_register(self, register: int, value: int) -> None:
        self.exchange(WRITE, register, value)

    def exchange(self, function: int, register: int, argument: int) -> int:
        """Sends a request and returns the value in its answer."""
        request = struct.pack(">BBHH", self.settings.gripper_slave, function, register, argument)
        request += crc16(request)
        for _ in range(self.ATTEMPTS):
            try:
                self.port.reset_input_buffer()
                self.port.write(request)
                answer = self.port.read(5)  # the whole of an exception frame
                if len(answer) == 5 and not answer[1] & 0x80:
                    answer += self.port.read(2 if function == READ else 3)
            except (OSError, TerminalError) as error:
                problem = str(error)
                continue
            if len(answer) < 5:
                problem = "no answer"
                time.sleep(self.timeout)  # a late answer must not be taken for the next one
            elif crc16(answer[:-2]) != answer[-2:]:
                problem = "bad check sum"
            elif answer[1] == function | 0x80:
                problem = EXCEPTIONS.get(answer[2], f"exception {answer[2]}")
            elif answer[:2] != request[:2] or (function == WRITE and answer != request):
                problem = "the answer belongs to another request"
            else:
                return int.from_bytes(answer[3:5] if function == READ else answer[4:6], "big")
        problem = f"{problem}, {self.ATTEMPTS} times (register {register:#06x})"
        raise RobotError(f"the gripper at {self.where}: {problem}")

    def initialize(self, timeout: float = 10.0) -> None:
        """Initializes the gripper, if it is not, which opens and closes it; then sets the force."""
        if self.read_register(INITIALIZED) != 1:
            print("the gripper is initialized: it opens and closes", flush=True)
            self.write_register(INITIALIZE, 1)
            deadline = time.monotonic() + timeout
            while self.read_register(INITIALIZED) != 1:
                if time.monotonic() > deadline:
                    raise RobotError(
                        f"the gripper at {self.where} is not ready after {timeout:g} s"
                    )
                time.sleep(0.05)
        self.write_register(FORCE, self.settings.gripper_force_percent)

    def move(self, closed: float) -> None:
        """Goes to 0 (open) ... 1 (closed); nothing is sent for a change below 1 %.

        It returns at once, and does not wait until the gripper is there.
        """
        open_at = self.settings.gripper_open_at
        closed_at = 1000 - open_at
        share = min(1.0, max(0.0, closed))
        position = round(share * closed_at + (1 - share) * open_at)
        if self.commanded is None or abs(position - self.commanded) >= 10:
            self.write_register(POSITION, position)
            self.commanded = position

    def read(self) -> float:
        """Where it is, 0 (open) ... 1 (closed)."""
        return abs(self.settings.gripper_open_at - self.read_register(POSITION_NOW)) / 1000


# ---- Camera: depth to points in the robot's base frame -------------------------------------------


def to_base(depth: np.ndarray, intrinsics: Sequence[float], settings: Settings) -> np.ndarray:
    """Depth (H, W), metres -> points (M, 3) float32, base frame. Raises CameraError for none."""
    points = depth_to_points(depth, intrinsics)
    if len(points) == 0:
        raise CameraError("the camera's depth is empty: check its cable, power and what it sees")
    return transform(points, np.array(settings.camera_to_base))


def crop(points: np.ndarray, settings: Settings) -> np.ndarray:
    """Points (M, 3), base frame -> those in the crop box (K, 3). Raises CameraError for none."""
    kept = ((points >= settings.crop_low_m) & (points <= settings.crop_high_m)).all(axis=1)
    if not kept.any():
        raise CameraError("no point lies in the crop box: check camera_to_base and crop_low_m")
    return points[kept]


def cloud(
    depth: np.ndarray, intrinsics: Sequence[float], settings: Settings
) -> tuple[np.ndarray, int]:
    """Depth (H, W), metres -> the policy's points (N, 3) float32, base frame, and a number.

    The number is that of the points in the crop box, before sampling.

    The points in the crop box are farthest point sampled. Fewer than N are repeated, and more than
    SAMPLED_FROM are thinned before: sampling holds Python's lock, so that no other thread runs, and
    300 000 points would delay the servo stream by a quarter of a second. Raises CameraError for an
    image without depth, and if no point lies in the crop box.
    """
    points = crop(to_base(depth, intrinsics, settings), settings)
    return data.farthest_point_sample(thin(points), settings.num_points), len(points)


class RealSense:
    """The depth stream of the first RealSense camera found, with that stream's own intrinsics.

    Raises UserError without pyrealsense2, CameraError if the camera does not start.
    """

    def __init__(self, width: int = 640, height: int = 480, hz: int = 30) -> None:
        try:
            import pyrealsense2 as rs
        except ImportError:
            raise UserError("`pip install pyrealsense2`, or name a recorded --camera") from None
        self.pipeline = rs.pipeline()
        config = rs.config()
        config.enable_stream(rs.stream.depth, width, height, rs.format.z16, hz)
        try:
            profile = self.pipeline.start(config)
        except RuntimeError as error:
            raise CameraError(f"the RealSense camera does not start: {error}") from None
        self.unit = profile.get_device().first_depth_sensor().get_depth_scale()  # metres
        self.intrinsics = realsense_intrinsics(profile.get_stream(rs.stream.depth))
        self.close = self.pipeline.stop

    def read(self) -> np.ndarray:
        """The newest depth image (H, W) float32 in metres. CameraError: none within a second."""
        deadline = time.monotonic() + 1.0
        try:
            while time.monotonic() < deadline:
                arrived, frames = self.pipeline.try_wait_for_frames(30)  # ms: Ctrl-C must wait
                frame = frames.get_depth_frame() if arrived else None
                if frame:
                    return np.asarray(frame.get_data()).astype(np.float32) * self.unit
        except RuntimeError as error:
            raise CameraError(f"the RealSense camera: {error}") from None
        raise CameraError("the RealSense camera: no depth for a second")


def realsense_intrinsics(stream: Any) -> tuple[float, ...]:
    """Focal lengths and principal point, in pixels, of a pyrealsense2 stream profile."""
    i = stream.as_video_stream_profile().get_intrinsics()
    return i.fx, i.fy, i.ppx, i.ppy


class RecordedCamera:
    """Replays an `.npz` of depth (F, H, W) uint16, millimetres, and intrinsics (4,) for ever.

    Raises UserError for any other file.
    """

    def __init__(self, path: str | Path) -> None:
        try:
            with np.load(path, allow_pickle=False) as file:
                depth = file["depth"]
                self.intrinsics = tuple(map(float, file["intrinsics"]))
            if depth.ndim != 3 or not depth.size or depth.dtype != np.uint16:
                raise TypeError(f"depth is {depth.dtype} {depth.shape}")
            if len(self.intrinsics) != 4:
                raise TypeError(f"intrinsics are {len(self.intrinsics)} numbers")
        except Exception as error:  # numpy and zipfile raise many types
            what = "no recorded camera: depth (F, H, W) uint16, intrinsics (4,) in an .npz file"
            raise UserError(f"{path} is {what} ({error})") from None
        self.images = itertools.cycle(depth)

    def close(self) -> None:
        """There is nothing to close: the file has been read."""

    def read(self) -> np.ndarray:
        """The next depth image (H, W) float32 in metres."""
        return next(self.images).astype(np.float32) / 1000


# ---- What keeps this computer busy ---------------------------------------------------------------


WRITING = "writing the recording"


class Activity:
    """What the main thread does and did lately: what to blame if the servo's thread runs late."""

    def __init__(self) -> None:
        self.current: tuple[str, float] | None = None  # name, began
        self.ended: deque[tuple[str, float, float]] = deque(maxlen=32)  # name, began, ended

    @contextmanager
    def during(self, name: str) -> Iterator[None]:
        """Inside, the main thread does this."""
        began = time.monotonic()
        self.current = (name, began)
        try:
            yield
        finally:
            self.ended.append((name, began, time.monotonic()))
            self.current = None

    def longest(self, since: float, now: float) -> tuple[str, float]:
        """What the main thread did longest between two times, and for how many seconds of them."""
        intervals = list(self.ended)
        current = self.current  # read once: the main thread changes it meanwhile
        if current is not None:
            name, began = current
            intervals.append((name, began, now))
        seconds: dict[str, float] = {}
        for name, began, ended in intervals:
            overlap = min(ended, now) - max(began, since)
            seconds[name] = seconds.get(name, 0.0) + max(0.0, overlap)
        seconds["waiting"] = now - since - sum(seconds.values())
        return max(seconds.items(), key=lambda item: item[1])


# ---- Streaming motion ----------------------------------------------------------------------------


def write_rotation(rotvec: np.ndarray) -> str:
    """What to do where `nearer` jumps: names the shorter of the tool's two rotation vectors."""
    shorter = nearer(rotvec, np.zeros(3)).round(3) + 0.0  # no -0.0
    return f"write the tool's own to rotation_near_rad of --config, {shorter.tolist()}"


def overspeed(actions: np.ndarray, settings: Settings) -> np.ndarray:
    """How many times as fast as targets may move each action (n, 7) is: (n,)."""
    return (lengths(actions) * settings.policy_hz / settings.target_speed).max(axis=1)


def warn(text: str) -> None:
    print(f"warning: {text}", file=sys.stderr)


class Servo:
    """Streams poses at `servo_hz` from a thread of its own, which inference never holds up.

    It interpolates from the pose commanded last (not from the measured one), clamps the speed and
    holds the last target when all are reached. With `free` it only keeps the arm free to be moved
    by hand. It stops for good, and says why, when

    - the newest state is older than `max_state_age_s`, or took longer by as much to arrive than the
      quickest one did; the connection or its framing is lost; the controller's clock
      stands still or runs backwards;
    - the robot is not running, its safety mode is neither normal nor reduced, its speed slider is
      not at 100 %, or our program is paused, has ended, or has been replaced by another;
    - the arm is farther than `max_lag_m` or `max_lag_rad` from where it should be;
    - it begins outside the box, or a target lies there (unless `outside_box` is "clamp");
    - an action has the wrong shape, NaN, or a jump; no new ones come for `max_hold_s`.

    To stop is to tell the program on the controller to end, once; nothing is sent after that.

    An arm that follows `servoj` is behind by about its lookahead time. So no pose is sent that is
    farther ahead of the measured one than the arm may go in that time: an arm that was held back
    by force, and is let go, is then not faster than allowed. The measured pose is `STATE_DELAY`
    old, so that targets move at lookahead / (lookahead + STATE_DELAY) of the arm's greatest speed:
    at 80 % of it where the lookahead time is 0.1 s.
    """

    PATIENCE = 5.0  # seconds for the program to start
    REACHED = 1e-6  # metres and radians: a target that is nearer has been reached
    STANDS = 1e-7  # metres and radians: even the slowest arm allowed goes further in a step
    SLOW = "the policy or the camera is too slow"

    def __init__(
        self, rtde: RTDE, settings: Settings, free: bool = False, activity: Activity | None = None
    ) -> None:
        self.rtde = rtde
        self.settings = settings
        self.moves = rtde.writes  # False: a dry run
        self.free = free  # True: the arm is only kept free to be moved by hand
        self.activity = activity or Activity()

        self.pose = rtde.state(settings.max_state_age_s).pose  # commanded last
        self.sent = self.pose  # sent last: ahead of the measured pose by no more than `lead`
        self.lead = settings.lead
        self.speed = settings.target_speed
        self.targets: list[tuple[float, np.ndarray]] = []  # (when, pose)
        self.broken_off = False  # targets were left out, by `hold`
        self.held_since = time.monotonic()
        self.hold_reason = self.SLOW  # why the arm holds

        self.lock = threading.Lock()  # of the targets
        self.error: str | None = None  # why the arm was stopped
        self.counters: dict[str, tuple[float, float]] = {}  # name -> its value, and since when
        # The smallest difference between the arrival of a state and its time stamp. The two clocks
        # began at different times, so only differences of delays mean anything.
        self.least_delay = math.inf
        self.last_step = (time.monotonic(), time.process_time())  # of the stream
        self.stall = ""  # why the stream stood still for so long that the watchdog may have struck
        self.stalled_at = -math.inf  # when that was noticed

        self.lateness: list[float] = []  # seconds, of each package
        self.ages: list[float] = []  # seconds, of the state that each package answers
        self.clamped = 0  # targets
        self.slowed = 0  # actions
        self.thread = threading.Thread(target=self.stream, name="servo", daemon=True)

    def start(self, host: str) -> None:
        """Starts the program on the controller where the arm now is, and begins to stream."""
        state = self.check_start()
        if self.moves:
            self.send(state.pose)  # in the registers before the program reads them
            text = program(self.rtde.session, self.settings, self.free)
            upload(host, self.settings.script_port, text, waiting=lambda: self.send(self.sent))
            state = self.wait_for_program()
        self.pose = state.pose
        self.held_since = time.monotonic()
        self.last_step = (self.held_since, time.process_time())
        self.thread.start()

    def check_start(self) -> State:
        """The present state. Raises RobotError if no program must be started in it."""
        state = self.movable_state()
        if self.moves and state.values["robot_status_bits"] & PROGRAM_RUNNING:
            raise RobotError("the arm is not moved: another program runs there, stop it first")
        return state

    def movable_state(self) -> State:
        """The present state. Raises RobotError if the arm must not be moved in it."""
        state = self.rtde.state(self.settings.max_state_age_s)
        try:
            state.check()
            if not self.free:
                self.settings.check_poses([state.pose])
        except RobotError as error:
            raise RobotError(f"the arm is not moved: {error}") from None
        return state

    def wait_for_program(self) -> State:
        """Sends where the arm is until the program runs, and returns the state in which it does."""
        deadline = time.monotonic() + self.PATIENCE
        while True:
            state = self.movable_state()
            if self.rtde.program_runs(state):
                return state
            if time.monotonic() > deadline:
                raise RobotError(
                    f"the arm is not moved: its program has not started within {self.PATIENCE:g} s "
                    "(is the robot in remote control, and the secondary interface allowed?)"
                    f"{self.rtde.controller_said}"
                )
            self.send(state.pose)
            time.sleep(1 / self.settings.servo_hz)

    def send(self, pose: np.ndarray) -> None:
        self.sent = pose
        self.rtde.send(pose)

    def follow(self, actions: np.ndarray) -> None:
        """Takes relative actions (n, 7), one every 1 / policy_hz from now on, or stops the arm."""
        actions = np.asarray(actions, dtype=float)
        with self.stopping(), self.lock:
            if actions.shape != (len(actions), ACTION_DIM) or len(actions) == 0:
                raise RobotError(f"actions have the shape {actions.shape}, not (n, {ACTION_DIM})")
            if not np.isfinite(actions).all():
                raise RobotError("an action is not finite")
            self.settings.check_steps(actions)  # before a jump is cut short by the box
            poses = [self.pose]
            for action in actions:
                poses.append(self.into_box(compose(poses[-1], action)))
            self.settings.check_poses(poses)
            times = time.monotonic() + np.arange(1, len(poses)) / self.settings.policy_hz
            self.targets = list(zip(times, poses[1:]))
            self.broken_off = False
        self.slowed += int((overspeed(actions, self.settings) > 1).sum())

    @contextmanager
    def stopping(self) -> Iterator[None]:
        """Raises why the arm was stopped, before and after the block; an error inside stops it."""
        self.check()
        try:
            yield
        except RobotError as error:
            self.fail(str(error))
        self.check()

    def begin_here(self) -> None:
        """Sets the commanded pose to the measured one: in a dry run the arm stays where it is."""
        with self.lock:
            self.pose = self.rtde.state(self.settings.max_state_age_s).pose
            self.targets = []

    def hold(self) -> None:
        """Holds the arm where it is now: the targets that it has not reached are left out."""
        with self.lock:
            self.broken_off = self.broken_off or bool(self.targets)
            self.targets = []

    def go(self, pose: np.ndarray) -> None:
        """Goes straight to a pose (6,), at a quarter of a target's top speed; returns when there.

        The line is divided into targets that are 0.1 s apart; `policy_hz` and `max_step_m` are for
        a policy's steps alone. The last target is repeated, until the arm, which lags by servoj's
        lookahead time, has arrived, too. The box is convex: with both ends the line lies in it.
        """
        with self.stopping(), self.lock:
            start = self.pose
            pose = self.into_box(pose)
            for end in (start, pose):
                self.settings.check_poses([end])
            step = difference(start, pose)
            seconds = 4 * float((lengths(step) / self.speed).max())
            n = max(1, math.ceil(seconds / 0.1))
            now = time.monotonic()
            self.targets = [
                (now + seconds * i / n, compose(start, step * i / n)) for i in range(1, n + 1)
            ]
            arrival = now + seconds + 3 * self.settings.servo_lookahead_s
            self.targets.append((arrival, self.targets[-1][1]))
            self.broken_off = False
        while self.targets:
            with self.stopping():
                if time.monotonic() > arrival + 1.0:
                    raise RobotError("the pose that the arm was sent to is not reached")
            time.sleep(0.01)
        self.check()

    def into_box(self, pose: np.ndarray) -> np.ndarray:
        """The pose (6,), or with `outside_box` "clamp" the nearest one inside the box."""
        if self.settings.outside_box != "clamp":
            return pose
        inside = pose[:3].clip(self.settings.tcp_low_m, self.settings.tcp_high_m)
        self.clamped += bool(abs(inside - pose[:3]).max() > ROUNDING)
        return np.concatenate([inside, pose[3:]])

    def tick(self, now: float) -> np.ndarray:
        """The pose to command now: toward the next target, on time, no faster than allowed."""
        dt = 1 / self.settings.servo_hz
        with self.lock:
            while len(self.targets) > 1 and self.targets[0][0] <= now:
                self.targets.pop(0)
            if self.targets:
                when, target = self.targets[0]
                share = dt / (max(when - now, 0.0) + dt)  # of what is left, in this tick
                before = self.pose
                goal = compose(before, share * difference(before, target))
                self.pose = toward(before, goal, self.speed * dt)
                if when <= now and distance(self.pose, target).max() < self.REACHED:
                    self.targets = []
                if when > now or distance(self.pose, before).max() > self.STANDS:
                    self.held_since = now  # it still moves, even if its target was due earlier
            return self.pose

    def stream(self) -> None:
        """The thread: a package every 1 / servo_hz, until something is wrong or `stop` comes."""
        period = 1 / self.settings.servo_hz
        due = time.monotonic()
        try:
            while self.error is None:
                now = time.monotonic()
                self.lateness.append(now - due)
                self.step()
                due = max(due + period, now - period)  # no burst to catch up after a pause
                time.sleep(max(0.0, due - time.monotonic()))
        except RobotError as error:
            self.fail(str(error))
        except Exception as error:  # whatever it is: without this thread the arm must not go on
            self.fail(f"the stream broke off: {error!r}")

    def step(self) -> None:
        """One package: the pose to command now, if the newest state allows it."""
        settings = self.settings
        try:
            state = self.rtde.state(settings.max_state_age_s)
        except StaleState as error:
            if error.arrived:
                reason = f", but newer ones have arrived{self.describe_stall()}"
            else:
                reason = ", and no newer one has arrived: look for the network or the controller"
            raise RobotError(f"{error}{reason}") from error
        now = time.monotonic()
        if now - self.last_step[0] > MISSING_PACKAGES / settings.servo_hz:
            self.stall = self.describe_stall()
            self.stalled_at = now
        self.check_state(state, now)
        self.last_step = (now, time.process_time())
        pose = state.pose if self.free else self.tick(now)
        if self.moves:
            self.send(toward(state.pose, pose, self.lead))
        self.ages.append(now - state.received)

    def describe_stall(self) -> str:
        """With what this computer was busy since the last step of the stream.

        If this program has computed most of the time, a thread of it has kept Python's lock, in a
        library perhaps, so that no other thread ran. If it has not, it waited for the disk, or
        other programs had the processors.
        """
        before, computed_before = self.last_step
        now = time.monotonic()
        computed = time.process_time() - computed_before
        name, seconds = self.activity.longest(before, now)
        if computed > 0.5 * (now - before):
            culprit = "it kept Python's lock, or all processors"
        elif name == WRITING:
            culprit = "the disk is slow"
        else:
            culprit = "other programs had the processors"
        return (
            f"; this computer was busy. For {now - before:.3f} s the stream stood still, in which "
            f"this program computed for {computed:.3f} s and was longest at {name}, "
            f"{seconds:.3f} s: {culprit}"
        )

    def check_state(self, state: State, now: float) -> None:
        """Raises RobotError if the arm must stop in this state, at this time."""
        state.check()
        self.check_progress(state, now)
        if self.free:
            return
        settings = self.settings
        metres, radians = distance(state.pose, self.pose)
        if self.moves and (metres > settings.max_lag_m or radians > settings.max_lag_rad):
            raise RobotError(
                f"the arm is {metres:.3f} m, {radians:.3f} rad behind: blocked, or slowed down"
            )
        if now - self.held_since > settings.max_hold_s:
            raise RobotError(f"no new actions for {settings.max_hold_s:g} s: {self.hold_reason}")

    def check_progress(self, state: State, now: float) -> None:
        """Raises RobotError if controller or program do not go on, or states come later."""
        max_age = self.settings.max_state_age_s
        values = state.values
        counters = {"the controller's clock": values["timestamp"]}
        if self.moves:
            if not self.rtde.program_runs(state):
                stall = self.stall if now - self.stalled_at < 1 else ""  # the watchdog ended it
                raise RobotError(
                    "the program on the controller has ended, or is paused"
                    f"{self.rtde.controller_said}{stall}"
                )
            counters["our program"] = values["output_int_register_25"]
        for name, value in counters.items():
            old, since = self.counters.get(name, (value, now))
            if value < old:
                raise RobotError(f"{name} runs backwards")
            if now - since > 2 * max_age:
                raise RobotError(f"{name} stands still")
            self.counters[name] = (value, now if value > old else since)

        delay = now - values["timestamp"]  # plus a constant: the clocks began at different times
        drift = 1e-3 / self.settings.servo_hz  # clocks may drift apart by a thousandth
        self.least_delay = min(self.least_delay + drift, delay)
        _, since = self.counters["the controller's clock"]
        state_is_new = since == now  # its clock went on just now
        if state_is_new and delay - self.least_delay > max_age:
            raise RobotError(f"states arrive {delay - self.least_delay:.3f} s later than at first")

    def check(self) -> None:
        """Raises RobotError if the arm was stopped."""
        if self.error is not None:
            raise RobotError(self.error)

    def fail(self, reason: str) -> None:
        """Stops the arm; the first reason is kept."""
        self.error = self.error or reason
        with suppress(RobotError):  # a lost connection: the watchdog on the controller stops it
            if self.moves:
                self.rtde.send(self.sent, stop=True)  # with the old pose: no new one is followed

    def stop(self) -> None:
        """Ends the stream and the program on the controller, and warns if a program goes on."""
        self.fail("stopped")
        age = self.settings.max_state_age_s
        deadline = time.monotonic() + 1
        with suppress(RobotError):  # a lost connection says nothing about the program
            while self.moves and self.rtde.program_runs(self.rtde.state(age)):
                if time.monotonic() > deadline:
                    warn("a program on the controller does not end: stop it by hand")
                    break
                time.sleep(0.01)

    def report(self) -> str:
        """Says how regular the stream was, and warns of what was not done as asked."""
        if self.clamped:
            warn(f"{self.clamped} targets lay outside the box and were clamped")
        if self.slowed:
            metres, radians = self.speed
            warn(
                f"{self.slowed} actions were faster than {metres:.2f} m/s, {radians:.2f} rad/s: "
                "cut short"
            )
        if not self.lateness:
            return "the stream had not begun"
        late = 1000 * np.array(self.lateness)  # milliseconds
        oldest = 1000 * max(self.ages, default=0.0)
        sent = "packages" if self.moves else "steps, in which nothing was sent,"
        return (
            f"{len(self.lateness)} {sent} at {self.settings.servo_hz:g} Hz: late by "
            f"{np.percentile(late, 50):.2f} ms (median), {np.percentile(late, 99):.2f} ms (99 %), "
            f"{late.max():.2f} ms (worst); oldest state {oldest:.1f} ms"
        )


# ---- What is seen, and its file ------------------------------------------------------------------


class Frame(NamedTuple):
    """What is seen at one time."""

    time: float  # time.monotonic()
    points: np.ndarray  # (N, 3) float32, base frame
    seen: int  # points in the crop box, before sampling
    state: np.ndarray  # (7,) float32: TCP pose and gripper


@dataclass
class Cell:
    """Arm, gripper and camera together."""

    settings: Settings
    rtde: RTDE
    gripper: Gripper
    camera: RealSense | RecordedCamera
    activity: Activity

    def observe(self) -> Frame:
        """The present observation. Raises CameraError if the camera gives no cloud."""
        with self.activity.during("reading the camera"):
            depth = self.camera.read()
        with self.activity.during("sampling the cloud"):
            points, seen = cloud(depth, self.camera.intrinsics, self.settings)
        pose = self.rtde.state(self.settings.max_state_age_s).pose
        pose[3:] = nearer(pose[3:], np.array(self.settings.rotation_near_rad))
        with self.activity.during("reading the gripper"):
            closed = self.gripper.read()
        state = np.append(pose, closed).astype(np.float32)
        return Frame(time=time.monotonic(), points=points, seen=seen, state=state)

    def observe_or_hold(self, servo: Servo) -> Frame:
        """`observe`, again and again while the camera gives no cloud.

        Meanwhile `servo` holds the arm, and stops it after `max_hold_s`. Reading a RealSense may
        take a second before it fails, in which the arm goes on with its chunk.
        """
        while True:
            try:
                frame = self.observe()
            except CameraError as error:
                servo.hold_reason = str(error)
                servo.hold()
                servo.check()
                time.sleep(0.02)
            else:
                servo.hold_reason = Servo.SLOW
                return frame

    def prepare(self, servo: Servo) -> None:
        """Raises RobotError if camera, gripper or arm are not ready; then initializes the gripper.

        Nothing moves before all three have answered, and the arm could start. Where the servo does
        not move the arm, the gripper does not move either.
        """
        self.observe()
        servo.check_start()
        if servo.moves:
            self.gripper.initialize()

    def describe(self) -> dict:
        """What a recording's `meta` tells of the robot."""
        settings = self.settings
        values = self.rtde.state(settings.max_state_age_s).values
        return {
            "policy_hz": float(settings.policy_hz),
            "payload_kg": round(float(values["payload"]), 3),
            "tcp_offset": values["tcp_offset"].round(4).tolist(),
            "rotation_near_rad": [float(x) for x in settings.rotation_near_rad],
            "gripper_open_at": settings.gripper_open_at,
            **boxes(settings),
            "positions_in_state": 1,
        }


def check_same_robot(recording: Demonstrations, meta: dict) -> None:
    """Raises UserError if `recording` was made with a robot that `meta` does not describe."""
    for name, value in meta.items():
        if name in ("tcp_box", "positions_in_state"):  # free to differ
            continue
        recorded = recording.meta.get(name)
        same = same_tcp(recorded, value) if name == "tcp_offset" else recorded == value
        if not same:
            raise UserError(
                f"{recording.task} was recorded with {name} {recorded}, now it is {value}: "
                "set it as it was, or record again"
            )


def same_tcp(recorded: Any, offset: list[float]) -> bool:
    """Whether two offsets of the TCP are the same pose, to 0.2 mm and 0.2 mrad."""
    if not isinstance(recorded, list) or {type(x) for x in recorded} - {int, float}:
        return False
    if len(recorded) != 6:
        return False
    return bool(distance(np.array(recorded), np.array(offset)).max() < 2e-4)


def boxes(settings: Settings) -> dict:
    """The two boxes as recordings name them, two corners each.

    `workspace` is that of the points: augmentation turns scenes about its middle.
    """
    return {
        "workspace": [list(settings.crop_low_m), list(settings.crop_high_m)],
        "tcp_box": [list(settings.tcp_low_m), list(settings.tcp_high_m)],
    }


@contextmanager
def connect(args: argparse.Namespace, settings: Settings, write: bool) -> Iterator[Cell]:
    """Camera, gripper and arm; whatever was opened is closed again."""
    if args.camera and write and args.host not in ("localhost", "127.0.0.1"):
        raise UserError("--camera shows an arm what was recorded: leave it out, or add --dry-run")
    with ExitStack() as stack:
        camera = RecordedCamera(args.camera) if args.camera else RealSense()
        stack.callback(camera.close)
        gripper = Gripper(settings, args.host)
        stack.callback(gripper.close)
        rtde = RTDE(args.host, settings.rtde_port, settings.servo_hz, write)
        stack.callback(rtde.close)
        yield Cell(
            settings=settings, rtde=rtde, gripper=gripper, camera=camera, activity=Activity()
        )


def to_recording(
    frames: list[Frame],
    actions: Any,
    *,
    task: str,
    instruction: str,
    meta: dict,
    earlier: Demonstrations | None = None,
) -> Demonstrations:
    """An episode of frames (T) and actions (T, 7), behind those of an earlier recording.

    Points are stored as float16, states and actions as float32. The times of the frames, in
    seconds, and how many points they were sampled from are added to `meta`.
    """
    times = [round(frame.time - frames[0].time, 4) for frame in frames]
    points_seen = [frame.seen for frame in frames]
    points = np.stack([frame.points for frame in frames]).astype(np.float16)  # (T, N, 3)
    state = np.stack([frame.state for frame in frames])  # (T, 7)
    action = np.array(actions, np.float32)  # (T, 7)
    episode_ends = np.array([len(frames)])
    if earlier is not None:
        times = [*earlier.meta.get("time_s", []), *times]
        points_seen = [*earlier.meta.get("points_seen", []), *points_seen]
        points = np.concatenate([earlier.points, points])
        state = np.concatenate([earlier.state, state])
        action = np.concatenate([earlier.action, action])
        episode_ends = np.append(earlier.episode_ends, len(state))
    return Demonstrations(
        task=task,
        instruction=instruction,
        points=points,
        state=state,
        action=action,
        episode_ends=episode_ends,
        meta={**meta, "time_s": times, "points_seen": points_seen},
    )


def make_folder(out: Path) -> None:
    """Makes the folder of a file; UserError if it cannot be made, or not be written to."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{out} cannot be written: {error.strerror}") from None
    if not os.access(out.parent, os.W_OK):
        raise UserError(f"{out} cannot be written: no permission to write to its folder")
    if out.is_dir():
        raise UserError(f"{out} cannot be written: it is a folder, name a file")


def save(out: Path, recording: Demonstrations) -> Demonstrations:
    """Writes a recording and returns it; UserError names the path where the disk is full."""
    try:
        data.save_demonstrations(out, recording)
    except OSError as error:
        raise UserError(f"{out} cannot be written: {error.strerror}") from error
    return recording


# ---- The policy's loop ---------------------------------------------------------------------------


@dataclass
class Log:
    """What was seen and done since the start; `driving` writes it in the end.

    Where the rest of a chunk was left out, the arm may have gone further than the last action says.
    The log's episode ends there, and what is seen next begins another.
    """

    frames: list[Frame] = field(default_factory=list)
    actions: list[np.ndarray] = field(default_factory=list)  # (7,)
    breaks: list[int] = field(default_factory=list)  # after so many actions a chunk was broken off
    commanded: list[list[float]] = field(default_factory=list)  # the pose (6,) before each action
    ended: str = "done"  # or the reason

    def seconds(self) -> float:
        """From the first frame to the newest one."""
        return self.frames[-1].time - self.frames[0].time

    def write(self, out: Path, recording: Demonstrations, meta: dict) -> None:
        """Writes whole steps, a frame and its action, in the format of recordings."""
        count = min(len(self.frames), len(self.actions))
        if count == 0:
            return
        done = to_recording(
            self.frames[:count],
            self.actions[:count],
            task=recording.task,
            instruction=recording.instruction,
            meta={**meta, "commanded": self.commanded[:count], "ended": self.ended},
        )
        ends = sorted({count, *(end for end in self.breaks if end < count)})
        try:
            save(out, replace(done, episode_ends=np.array(ends)))
            print(f"wrote {out}")
        except (UserError, RecordingError) as error:
            warn(str(error))


def execute(chunk: np.ndarray, cell: Cell, servo: Servo, log: Log) -> None:
    """Executes the actions (Ta, 7) of a chunk; logs them, and what is seen after each.

    If the camera is late or fails, or the gripper is late, the rest of the chunk is left out, and
    `servo.broken_off` is set; a gripper that fails raises RobotError.
    """
    period = 1 / servo.settings.policy_hz
    servo.follow(chunk)
    began = time.monotonic()
    for step, action in enumerate(chunk, start=1):
        servo.check()
        log.actions.append(action)
        log.commanded.append(servo.pose.tolist())
        if servo.moves:
            with cell.activity.during("moving the gripper"):
                cell.gripper.move(action[6])
        due = began + step * period
        while time.monotonic() < due:
            servo.check()
            time.sleep(max(0.0, min(due - time.monotonic(), 0.02)))
        servo.check()
        log.frames.append(cell.observe_or_hold(servo))
        servo.check()  # why the arm was stopped comes before "late"
        late = time.monotonic() - due
        if step < len(chunk) and late > period:
            servo.hold()  # the arm moved on meanwhile: the gripper would act in the wrong place
        if servo.broken_off:
            log.breaks.append(len(log.actions))
            return


@contextmanager
def driving(
    args: argparse.Namespace,
    settings: Settings,
    recording: Demonstrations,
    start: Sequence[float] | None,
) -> Iterator[tuple[Cell, Servo, Log]]:
    """Connects to the robot, goes to the pose `start`, if any, and stops the arm at the end.

    The block inside executes chunks of actions by `execute`. However it ends, frames and actions
    are written to a file in the format of recordings; only a second Ctrl-C may prevent that.
    """
    name = f"{recording.task}-{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}.npz"
    out = Path(args.out or f"runs/robot/{name}")
    if out.exists():
        raise UserError(f"{out} exists: move it, or give another --out")
    make_folder(out)
    log = Log()
    with connect(args, settings, write=not args.dry_run) as cell:
        meta = cell.describe()
        check_same_robot(recording, meta)
        meta["made_by"] = f"robot.{args.command}"
        servo = Servo(cell.rtde, settings, activity=cell.activity)
        try:
            cell.prepare(servo)
            servo.start(args.host)
            print(f"{recording.task}: {args.command}; Ctrl-C stops", flush=True)
            if start is not None:
                metres, radians = distance(servo.pose, np.array(start))
                print(f"going to the start, {metres:.2f} m and {radians:.2f} rad away", flush=True)
                servo.go(np.array(start))
            log.frames.append(cell.observe_or_hold(servo))
            yield cell, servo, log
        except BaseException as error:  # Ctrl-C, too
            log.ended = str(error) or type(error).__name__
            raise
        finally:
            servo.stop()
            log.write(out, recording, meta)
            print(servo.report())


def load_policy(args: argparse.Namespace, settings: Settings) -> tuple[model.DAMIPolicy, dict]:
    """The policy of --checkpoint, and what its file says beside the weights.

    Raises UserError for one that this robot's frames do not fit.
    """
    checkpoint = Path(args.checkpoint)
    if checkpoint.is_dir():
        checkpoint = checkpoint / "adapted.pt"
    policy, info = model.load(checkpoint, args.device, needs=("text_weights",))
    config = policy.config
    if (config.state_dim, config.action_dim) != (STATE_DIM, ACTION_DIM):
        raise UserError(
            f"{args.checkpoint} has states of {config.state_dim} and actions of "
            f"{config.action_dim} numbers, this robot {STATE_DIM} and {ACTION_DIM}: use a policy "
            "trained on its recordings"
        )
    if config.point_dim != 3:
        raise UserError(
            f"{args.checkpoint} reads points of {config.point_dim} numbers, this robot sees "
            "positions alone: use a policy trained on its recordings"
        )
    if config.num_points > settings.num_points:
        raise UserError(
            f"{args.checkpoint} reads {config.num_points} points, num_points of the settings is "
            f"{settings.num_points}: raise it"
        )
    return policy, info


def warm_up(policy: model.DAMIPolicy, context: Any, settings: Settings, device: str) -> None:
    """Draws two chunks before an arm waits for them: on a GPU the first may take seconds.

    Raises UserError if the second takes longer than the arm may wait.
    """
    config = policy.config
    points = torch.zeros(1, config.n_obs_steps, config.num_points, 3, device=device)
    state = torch.zeros(1, config.n_obs_steps, config.state_dim, device=device)
    for _ in range(2):
        began = time.monotonic()
        policy.sample_actions(points, state, context, torch.Generator().manual_seed(0)).cpu()
        seconds = time.monotonic() - began
    if seconds > settings.max_hold_s:
        raise UserError(
            f"the policy takes {seconds:.1f} s for a chunk, and max_hold_s is "
            f"{settings.max_hold_s:g}: use a faster computer or a smaller policy"
        )


def run(args: argparse.Namespace, settings: Settings) -> None:
    """Runs the policy: observes To frames, draws a chunk of Ta actions, executes it, and so on."""
    common.pick_device(args.device)
    policy, info = load_policy(args, settings)
    config = policy.config
    recording = data.load_demonstrations(args.data)
    task = info.get("adapted_to", recording.task)
    if task != recording.task:
        raise UserError(f"{args.checkpoint} was adapted to {task}, {args.data} is of another task")
    sampler = data.WindowSampler(recording, config, device=args.device)
    text, _ = text_features([recording.instruction], args.clip_weights, info["text_weights"])
    if not info.get("adaptation", {}).get("instruction", True):  # adapted without it
        text = torch.zeros_like(text)
    torch.set_num_threads(max(1, common.usable_cores() - 1))  # a core is left to the servo stream
    generator = torch.Generator().manual_seed(args.seed)
    demo = sampler.demonstration(sampler.sample_episode(generator))  # held for the whole run
    with torch.no_grad():
        context = policy.encode_demo(text.to(args.device), **demo)

    warm_up(policy, context, settings, args.device)
    with driving(args, settings, recording, start=settings.start_pose) as (cell, servo, log):
        while log.seconds() < args.seconds:
            with cell.activity.during("computing actions"):
                newest = log.frames[-config.n_obs_steps :]
                observed = [newest[0]] * (config.n_obs_steps - len(newest)) + newest  # To frames
                points = torch.tensor(np.stack([frame.points for frame in observed]))[None]
                points = points[:, :, : config.num_points].to(args.device)  # (1, To, N, 3)
                state = torch.tensor(np.stack([frame.state for frame in observed]))[None]
                state = state.to(args.device)  # (1, To, S)
                try:
                    actions = policy.sample_actions(points, state, context, generator)
                except Exception as error:
                    raise RobotError(f"the policy failed: {error!r}") from error
                chunk = actions[0].cpu().numpy()  # (Ta, A)
            if args.dry_run:
                servo.begin_here()  # the policy sees that the arm has not moved
            execute(chunk, cell, servo, log)


def at_allowed_speed(actions: np.ndarray, settings: Settings) -> np.ndarray:
    """Divides each action (T, 7) that is faster than targets may move into equal parts, (n, 7).

    The way remains the same, and the gripper's place on it; only the time is longer.
    """
    parts = np.ceil(overspeed(actions, settings)).clip(1).astype(int)  # (T,)
    divided = actions.copy()
    divided[:, :6] /= parts[:, None]
    return np.repeat(divided, parts, axis=0)


def replay(args: argparse.Namespace, settings: Settings) -> None:
    """Goes slowly to where a recorded episode began, and executes its actions."""
    recording = data.load_demonstrations(args.data)
    dims = recording.state.shape[1], recording.action.shape[1]
    if dims != (STATE_DIM, ACTION_DIM):
        raise UserError(f"{args.data} has {dims} dimensions of state and action: of another robot")
    if not 0 <= args.episode < len(recording):
        raise UserError(f"{args.data} has {len(recording)} episodes: no --episode {args.episode}")
    frames = recording.episode(args.episode)
    recorded = recording.action[frames]  # (T, A)
    settings.check_steps(recorded)  # divided into parts, a jump would be none
    actions = at_allowed_speed(recorded, settings)
    if len(actions) > len(recorded):
        print(
            f"some actions are faster than the arm may go: {len(recorded)} are replayed as "
            f"{len(actions)}"
        )
    start = recording.state[frames.start, :6].tolist()
    with driving(args, settings, recording, start=start) as (cell, servo, log):
        for chunk in np.array_split(actions, math.ceil(len(actions) / 8)):
            execute(chunk, cell, servo, log)
            if servo.broken_off:
                raise RobotError("camera or gripper were late: the rest would begin elsewhere")


# ---- Recording -----------------------------------------------------------------------------------


class Keys:
    """Reads keys one at a time, without waiting, from a terminal or other standard input.

    In a terminal no Enter is needed.
    """

    def __enter__(self) -> Keys:
        if sys.stdin is None or sys.stdin.closed:
            raise UserError("standard input is closed: use a terminal, or write the keys into it")
        self.terminal = sys.stdin.isatty()
        if self.terminal:
            self.attributes = termios.tcgetattr(sys.stdin)
            tty.setcbreak(sys.stdin)
        return self

    def __exit__(self, *_: Any) -> None:
        if self.terminal:
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self.attributes)

    def pressed(self) -> str:
        """One key, or an empty string if none was pressed. RobotError: the terminal is gone."""
        while select.select([sys.stdin], [], [], 0)[0]:
            key = os.read(sys.stdin.fileno(), 1).decode("ascii", "replace")  # unbuffered
            if key == "" and self.terminal:
                raise RobotError("the terminal is gone")
            if key == "":
                return "q"
            if not key.isspace():
                return key.lower()
        return ""


def episode_actions(frames: list[Frame], grip: list[float], settings: Settings) -> np.ndarray:
    """The actions (T, 7) that lead from each frame to the next; `grip` is commanded after each.

    Raises RobotError for an episode that `run` could not execute.
    """
    poses = [frame.state[:6].astype(float) for frame in frames]
    settings.check_poses(poses)
    rotvecs = np.array(poses)[:, 3:]  # (T, 3)
    if (np.linalg.norm(np.diff(rotvecs, axis=0), axis=1) > np.pi).any():
        raise RobotError(f"the rotation vector flips: {write_rotation(rotvecs[0])}")
    times = [frame.time for frame in frames]
    gaps = np.diff(times) if len(times) > 1 else np.zeros(1)  # seconds
    # An action takes 1 / policy_hz seconds: `replay` would be faster than the hand was.
    if gaps.max() > 2 / settings.policy_hz or gaps.mean() > 1.2 / settings.policy_hz:
        raise RobotError(
            f"frames are {gaps.mean():.2f}, up to {gaps.max():.2f} s apart, where an action takes "
            f"{1 / settings.policy_hz:.2f} s: camera or gripper were late"
        )
    moves = [difference(a, b) for a, b in itertools.pairwise(poses)]
    return np.column_stack([[*moves, np.zeros(6)], grip])


@dataclass
class Recorder:
    """The episode that is being recorded, and those that are kept."""

    args: argparse.Namespace
    cell: Cell
    out: Path
    meta: dict
    kept: Demonstrations | None  # all episodes of the file
    count: int = 0  # episodes kept since the start
    closed: float = 0.0  # the gripper's command: 0 open, 1 closed
    frames: list[Frame] | None = None  # of the episode that is being recorded; None: there is none
    grip: list[float] = field(default_factory=list)  # the gripper's command after each frame

    def press(self, key: str, servo: Servo) -> None:
        """Does what a key asks for."""
        if key == "g":
            self.closed = 1.0 - self.closed
            if self.frames:  # the last one was taken before this key, so the command belongs to it
                self.grip[-1] = self.closed
            servo.check()
            if servo.moves:
                with self.cell.activity.during("moving the gripper"):
                    self.cell.gripper.move(self.closed)
        elif key == "s" and self.frames is None:
            self.frames, self.grip = [], []
            print(f"episode {self.count + 1}: recording", flush=True)
        elif key == "d" and self.frames is not None:
            self.frames = None
            print("dropped", flush=True)
        elif key == "e" and self.frames:
            self.keep()
            self.frames = None

    def observe(self) -> None:
        """Adds what is seen now to the episode that is being recorded."""
        if self.frames is not None:
            self.frames.append(self.cell.observe())
            self.grip.append(self.closed)

    def keep(self) -> None:
        """Writes the recorded episode behind the others, if `run` could execute it."""
        try:
            actions = episode_actions(self.frames, self.grip, self.cell.settings)
        except RobotError as error:
            print(f"dropped: {error}", flush=True)
            return
        with self.cell.activity.during(WRITING):
            recording = to_recording(
                self.frames,
                actions,
                task=self.args.task,
                instruction=self.args.instruction,
                meta=self.meta,
                earlier=self.kept,
            )
            self.kept = save(self.out, recording)
        self.count += 1
        too_fast = int((overspeed(actions, self.cell.settings) > 1).sum())
        print(
            f"episode {self.count}: {len(self.frames)} frames, {too_fast} of them "
            f"faster than targets may move; saved in {self.out}",
            flush=True,
        )


def record(args: argparse.Namespace, settings: Settings) -> None:
    """Records demonstrations by hand guidance: the arm is free, keys begin and end an episode.

    The keys are those of the terminal. Where standard input is no terminal, they are read from it,
    as a script or a foot pedal writes them, and its end means q.
    """
    if termios is None:
        raise UserError("record reads keys as POSIX systems do: use Linux or macOS")
    if not re.fullmatch(data.NAME, args.task):
        raise UserError(f"--task {args.task!r}: use letters, digits, '-', '_' and '.'")
    if args.episodes < 1:
        raise UserError(f"--episodes is {args.episodes}: use at least 1")
    out = Path(args.out or f"demos/{args.task}.npz")
    if out.exists() and not args.append:
        raise UserError(f"{out} exists: add --append, move it, or give another --out")
    with common.locked(out.parent):
        kept = data.load_demonstrations(out) if out.exists() else None
        if kept and (kept.task, kept.instruction) != (args.task, args.instruction):
            raise UserError(f"{out} holds {kept.task}, {kept.instruction!r}: use another --out")
        if kept and kept.points.shape[1] != settings.num_points:
            n = kept.points.shape[1]
            raise UserError(
                f"{out} has clouds of {n} points: set num_points so, or use another --out"
            )
        record_episodes(args, settings, out, kept)


def record_episodes(
    args: argparse.Namespace, settings: Settings, out: Path, kept: Demonstrations | None
) -> None:
    """`record`, behind the episodes that the file holds already."""
    moves = not args.dry_run
    with connect(args, settings, write=moves) as cell, Keys() as keys:
        meta = cell.describe()
        if kept is not None:
            check_same_robot(kept, meta)
        meta["made_by"] = "robot.record"
        meta["camera"] = args.camera
        servo = Servo(cell.rtde, settings, free=True, activity=cell.activity)
        cell.prepare(servo)
        recorder = Recorder(args=args, cell=cell, out=out, meta=meta, kept=kept)
        closed = cell.gripper.read()
        if moves and 0.1 < closed < 0.9:
            # between open and closed: it may hold something, so it is told to close
            cell.gripper.move(1.0)
            closed = 1.0
        recorder.closed = float(closed > 0.5)
        try:
            servo.start(args.host)
            print("keys: s starts an episode, e ends and keeps it, d drops it, ", end="")
            print("g opens or closes the gripper, q quits", flush=True)
            due = time.monotonic()
            while recorder.count < args.episodes:
                key = keys.pressed()
                if key == "q":
                    break
                recorder.observe()
                recorder.press(key, servo)
                servo.check()
                due = max(due + 1 / settings.policy_hz, time.monotonic())
                time.sleep(max(0.0, due - time.monotonic()))
            if recorder.frames is not None:
                print("dropped: the last episode was not ended by e", flush=True)
        except RobotError as error:
            kept = recorder.kept
            before = f"{len(kept)} are in {out}" if kept else "none was kept before"
            if recorder.frames is not None:
                before = f"the episode at hand is dropped, {before}"
            raise RobotError(f"{error}; {before}") from error
        finally:
            servo.stop()
    kept = recorder.kept
    print(f"{len(kept)} episodes in {out}" if kept else "nothing was recorded")


# ---- Looking at it -------------------------------------------------------------------------------


def check(args: argparse.Namespace, settings: Settings) -> None:
    """Connects to everything, moves nothing, and says what is there."""
    if args.picture:
        make_folder(Path(args.picture))
    asked = ("robotmode", "safetystatus", "programState", "is in remote control")
    try:
        answers = dashboard(args.host, settings.dashboard_port, *asked)
    except RobotError as error:  # the other commands do without it
        answers = {
            "dashboard": f"none ({error}): PolyScope X has none, elsewhere enable it",
            "is in remote control": "unknown: look at the panel",
        }
    with connect(args, settings, write=False) as cell:
        state = cell.rtde.state(settings.max_state_age_s)
        trouble = None
        try:
            state.check()
            settings.check_poses([state.pose])
            check_reference(state.pose, settings)
            if answers["is in remote control"] == "false":
                raise RobotError("it is not in remote control: switch that at the panel")
        except RobotError as error:
            trouble = str(error)
        depth, points, kept = np.zeros((0, 0)), np.zeros((0, 3)), np.zeros((0, 3))
        try:
            depth = cell.camera.read()
            points = to_base(depth, cell.camera.intrinsics, settings)
            kept = crop(points, settings)
            low, high = kept.min(0).round(3), kept.max(0).round(3)
            box = f"{len(kept)} of {len(points)} in the crop box, {low} to {high} m"
        except CameraError as error:
            box = f"none: {error}"
            trouble = trouble or str(error)
        try:
            gripper_state = cell.gripper.read_register(INITIALIZED)
            gripper = f"{cell.gripper.read():.2f} (0 open, 1 closed), state {gripper_state}"
        except RobotError as error:
            gripper = f"none: {error}"
            trouble = trouble or str(error)
        version = ".".join(map(str, cell.rtde.version))
        meta = cell.describe()
        rows = {
            **answers,
            "controller": f"software {version}, robot mode {state.values['robot_mode']}, "
            f"safety {state.safety}",
            "TCP, m and rad": " ".join(f"{x:.3f}" for x in state.pose),
            "state": trouble or "ready",
            "recorded with": meta,
            "gripper": gripper,
            "depth": f"in {np.count_nonzero(depth) / max(1, depth.size):.0%} of {depth.shape[1]} x "
            f"{depth.shape[0]} pixels",
            "points": box,
        }
    for name, value in rows.items():
        print(f"{name:22}{value}")
    if args.picture and len(points) > 0:
        snapshot = Demonstrations(
            task="check",
            instruction="the robot's base frame",
            points=thin(points)[None].astype(np.float16),  # (1, M, 3)
            state=np.append(state.pose, 0.0)[None],  # (1, 7)
            action=np.zeros((1, ACTION_DIM)),
            episode_ends=np.array([1]),
            meta=meta,
        )
        report.plot_demonstration(snapshot, args.picture)
        print(f"wrote {args.picture}")
    if trouble:
        raise RobotError(f"not ready: {trouble}")


def check_reference(pose: np.ndarray, settings: Settings) -> None:
    """Raises RobotError if the rotation vector of a pose (6,) may flip while the arm works.

    Where both vectors of the tool's rotation are about equally far from rotation_near_rad, a small
    motion switches from one to the other.
    """
    reference = np.array(settings.rotation_near_rad)
    if not pose[3:].any():  # no rotation: there is no other vector
        return
    both = (pose[3:], other_rotvec(pose[3:]))
    near, far = sorted(np.linalg.norm(rotvec - reference) for rotvec in both)
    if far - near < 1.5:
        raise RobotError(f"the rotation vector may flip: {write_rotation(pose[3:])}")


def record_camera(args: argparse.Namespace) -> None:
    """Records depth images to a file that --camera replays."""
    out = Path(args.out)
    make_folder(out)
    if args.frames < 1:
        raise UserError(f"--frames is {args.frames}: use at least 1")
    camera = RecordedCamera(args.camera) if args.camera else RealSense()
    try:
        depth = np.stack([camera.read() for _ in range(args.frames)])  # (F, H, W) metres
    finally:
        camera.close()
    millimetres = (1000 * depth).round().clip(0, 65535).astype(np.uint16)
    intrinsics = np.array(camera.intrinsics)
    data.write_atomically(
        out, lambda path: np.savez_compressed(path, depth=millimetres, intrinsics=intrinsics)
    )
    print(f"wrote {out}: {len(depth)} images of {depth.shape[2]} x {depth.shape[1]} pixels")


# ---- Command line --------------------------------------------------------------------------------

COMMANDS = {"check": check, "record": record, "replay": replay, "run": run, "camera": record_camera}


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Record, check and run on a UR10e. Keep a hand on the emergency stop."
    )
    commands = parser.add_subparsers(dest="command", required=True)
    add = {}  # command -> the function that adds a flag to it
    for name, function in COMMANDS.items():
        text = function.__doc__
        command = commands.add_parser(name, help=text.split("\n")[0], description=text)
        add[name] = command.add_argument
        add[name](
            "--camera", metavar="FILE", help="replay a recorded camera instead of the RealSense"
        )
    for name in ("check", "record", "replay", "run"):
        add[name]("--host", required=True, help="address of the robot; nothing else is contacted")
        add[name](
            "--config", default="robot.json", help="poses, boxes, limits (default: robot.json)"
        )
    for name in ("record", "replay", "run"):
        add[name]("--dry-run", action="store_true", help="everything but motion")
    for name in ("replay", "run"):
        add[name]("--data", required=True, help="the task's demonstrations")
        add[name]("--out", help="file to write (default: runs/robot/TASK-TIME-PROCESS.npz)")

    flag = add["check"]
    flag("--picture", metavar="PNG", help="draw cloud, crop box and the TCP's box")

    flag = add["record"]
    flag("--task", required=True, help="name of the task, and of the file")
    flag("--instruction", required=True, help="what to do, one sentence")
    flag("--episodes", type=int, default=10, help="how many to record (default: 10)")
    flag("--append", action="store_true", help="go on with a file that exists")
    flag("--out", help="file to write (default: demos/TASK.npz)")

    flag = add["replay"]
    flag("--episode", type=int, default=0, help="which, from 0 (default: 0)")

    flag = add["run"]
    flag("--checkpoint", required=True, help="adapted policy of finetune.py, or its folder")
    flag("--seconds", type=float, default=60, help="how long (default: 60)")
    flag("--seed", type=int, default=0, help="of noise and reference demonstration (default: 0)")
    flag("--device", default="cpu", help="where the policy computes: cpu, cuda (default: cpu)")
    flag("--clip-weights", help="ViT-B-32.pt, or `random` (default: as in the checkpoint)")

    flag = add["camera"]
    flag("--out", required=True, help="file to write, .npz")
    flag("--frames", type=int, default=30, help="how many images (default: 30)")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    args = parse(argv)
    if getattr(args, "out", None) is not None and Path(args.out).suffix != ".npz":
        raise UserError(f"--out is {args.out}: name an .npz file")
    if args.command == "camera":
        record_camera(args)
    else:
        COMMANDS[args.command](args, load_settings(args.config))


if __name__ == "__main__":
    common.command_line(
        main, errors=(RobotError, RecordingError, CheckpointError, TextWeightsError)
    )
