"""A UR10e with an AG95 gripper and a RealSense camera: record demonstrations, run a policy.

    python robot.py check  --config robot.json     # every connection, mode and camera; read only
    python robot.py record --config robot.json --task stack-cube --instruction "..." --episodes 10
    python robot.py run    --config robot.json --checkpoint adapted.pt --data demos/stack-cube.npz

Each with --host ADDRESS. Without an arm: `python -m tests.emulator` and --host 127.0.0.1. With
--dry-run nothing is made to move.

One action, from the network to the arm: `run` draws a chunk with `DAMIPolicy.sample_actions`,
`Servo.follow` turns it into target poses, `Servo.tick` interpolates to 125 Hz and clamps,
`RTDE.send` packs the bytes. On the controller a URScript program (`SERVO_PROGRAM`) reads the pose
from registers, solves the inverse kinematics and calls servoj.

Poses are (x, y, z, rx, ry, rz): metres and axis-angle radians of the tool center point (TCP) in the
robot's base frame. State (7,): TCP pose, gripper. Action (7,): dx, dy, dz in metres, drx, dry, drz
in radians (a rotation in the base frame, applied after the present one), gripper; relative to the
pose commanded last. Gripper: 0 open, 1 closed.

What stops the arm, and how it is stopped, is in `Servo`. Nothing here unlocks a stop or connects
again by itself.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import select
import socket
import struct
import sys
import termios
import threading
import time
import tty
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation  # scipy comes with metaworld

from clip import text_features
from data import (
    Demonstrations,
    WindowSampler,
    farthest_point_sample,
    load_demonstrations,
    save_demonstrations,
)
from scripts import command_line, load_checkpoint

STATE_DIM = ACTION_DIM = 7


class RobotError(Exception):
    """Arm, gripper or camera cannot go on; the message says why. The arm has been stopped."""


class CameraError(RobotError):
    """The camera gives no usable cloud. While the policy runs the arm is held, and stopped after
    `max_hold_s`.
    """


# ---- Settings ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Settings:
    """What the JSON file of --config holds. Lengths are in metres, angles in radians, frames the
    robot's base.

    The first five have no default: they belong to the place where the arm stands.
    """

    tcp_low_m: tuple[float, ...]  # (3,) the box that the TCP stays in
    tcp_high_m: tuple[float, ...]  # (3,)
    crop_low_m: tuple[float, ...]  # (3,) the box that points of the cloud are kept in
    crop_high_m: tuple[float, ...]  # (3,)
    camera_to_base: tuple[
        tuple[float, ...], ...
    ]  # (4, 4) pose of the camera, rotation and translation in metres
    outside_box: str = "stop"  # or "clamp": what happens to a target outside the box
    rotation_near_rad: tuple[float, ...] = (
        0.0,
        3.14159,
        0.0,
    )  # (3,) of a state's two rotation vectors, the nearer one
    num_points: int = 1024
    policy_hz: float = 10.0  # observations and actions a second
    servo_hz: float = 125.0
    max_speed_m_s: float = 0.25
    max_speed_rad_s: float = 0.16
    max_step_m: float = 0.05  # a longer step of one action is a jump, and stops the arm
    max_step_rad: float = 0.2
    max_state_age_s: float = 0.1
    max_lag_m: float = 0.03  # how far the arm may stay behind what it is told
    max_lag_rad: float = 0.2
    max_hold_s: float = 2.0  # how long the arm waits in place for a late policy or camera
    servo_lookahead_s: float = 0.1
    servo_gain: float = 300.0
    gripper_serial: str | None = (
        None  # such as "/dev/ttyUSB0"; null: over TCP, at gripper_port of --host
    )
    gripper_force_percent: int = 30
    rtde_port: int = 30004
    script_port: int = 30002
    dashboard_port: int = 29999
    gripper_port: int = 54321

    def __post_init__(self) -> None:
        def refuse(name: str, why: str) -> None:
            raise ValueError(f"{name} in the robot's settings is {getattr(self, name)!r}: {why}")

        for name in ("tcp_low_m", "tcp_high_m", "crop_low_m", "crop_high_m", "rotation_near_rad"):
            value = np.array(getattr(self, name), dtype=float)
            if value.shape != (3,) or not np.isfinite(value).all():
                refuse(
                    name,
                    f"give three numbers in {'radians' if name.endswith('_rad') else 'metres'}",
                )
        for low, high in (("tcp_low_m", "tcp_high_m"), ("crop_low_m", "crop_high_m")):
            if not (np.array(getattr(self, low)) < np.array(getattr(self, high))).all():
                refuse(low, f"each number must be below that of {high}")
        pose = np.array(self.camera_to_base, dtype=float)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            refuse("camera_to_base", "give four rows of four numbers")
        rotation = pose[:3, :3]
        if not (
            np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
            and np.linalg.det(rotation) > 0
            and np.allclose(pose[3], (0, 0, 0, 1))
        ):
            refuse(
                "camera_to_base", "its upper left 3 x 3 must be a rotation, its last row 0 0 0 1"
            )
        if self.outside_box not in ("stop", "clamp"):
            refuse("outside_box", 'use "stop" or "clamp"')
        limits = {
            "policy_hz": 30,
            "servo_hz": 500,
            "max_speed_m_s": 1.0,
            "max_speed_rad_s": 3.0,
            "max_step_m": 0.5,
        }
        limits |= {
            "max_step_rad": 3.0,
            "max_lag_m": 0.5,
            "max_lag_rad": 3.0,
            "max_state_age_s": 1.0,
            "max_hold_s": 60,
            "num_points": 100_000,
        }
        for name, most in limits.items():
            if not 0 < getattr(self, name) <= most:
                refuse(name, f"use more than 0 and at most {most}")
        for name, (least, most) in {
            "servo_lookahead_s": (0.03, 0.2),
            "servo_gain": (100, 2000),
            "gripper_force_percent": (20, 100),
        }.items():
            if not least <= getattr(self, name) <= most:
                refuse(name, f"the controller takes {least} to {most}")


def load_settings(path: str | Path) -> Settings:
    """Read --config. Raises ValueError, one line, for what is missing, unknown, of the wrong type
    or out of range.
    """
    try:
        given = json.loads(Path(path).read_text())
    except FileNotFoundError:
        raise ValueError(
            f"{path} is missing: copy assets/robot.json and fill in your boxes and camera pose"
        ) from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not JSON: {error}") from None
    if not isinstance(given, dict):
        raise ValueError(f"{path} must hold one JSON object")
    known = {f.name: f for f in fields(Settings)}
    if unknown := sorted(set(given) - set(known)):
        raise ValueError(f"{path}: unknown {', '.join(unknown)}; known are {', '.join(known)}")
    required = [name for name, f in known.items() if f.default is f.default_factory]
    if missing := [name for name in required if name not in given]:
        raise ValueError(f"{path} lacks {', '.join(missing)}")
    for name, value in given.items():
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if (known[name].type in ("int", "float") and not number) or (
            known[name].type == "str" and type(value) is not str
        ):
            raise ValueError(f"{path}: {name} is {value!r}, it must be of type {known[name].type}")
    try:
        return Settings(**given)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None


# ---- RTDE: the controller's real-time data exchange ----------------------------------------------

HEADER = struct.Struct(">HB")  # size of the whole package, type
REQUEST_VERSION, SETUP_OUTPUTS, SETUP_INPUTS, START, DATA, MESSAGE = map(ord, "VOISUM")
FORMATS = {
    "BOOL": "?",
    "UINT8": "B",
    "INT32": "i",
    "UINT32": "I",
    "UINT64": "Q",
    "DOUBLE": "d",
    "VECTOR6D": "6d",
}
OUTPUTS = (
    "timestamp",
    "actual_q",
    "actual_TCP_pose",
    "actual_TCP_speed",
    "robot_mode",
    "safety_mode",
    "runtime_state",
    "robot_status_bits",
    "safety_status_bits",
    "output_int_register_24",  # the session that our program belongs to
    "output_int_register_25",  # counts its turns
)
# Registers 0 to 23 belong to the fieldbus. Written in every package: the pose to go to, and the
# session's number, or STOP.
INPUTS = (*(f"input_double_register_{24 + i}" for i in range(6)), "input_int_register_24")
STOP = 0
RUNNING = 7  # robot_mode
PLAYING = 2  # runtime_state; of a paused program it is 4
PROGRAM_RUNNING = 1 << 1  # of robot_status_bits
SAFETY = {
    1: "normal",
    2: "reduced",
    3: "protective stop",
    4: "recovery",
    5: "safeguard stop",
    6: "emergency stop",
}
SAFETY |= {7: "emergency stop of the robot", 8: "violation", 9: "fault"}


class State(NamedTuple):
    """One data package of the controller."""

    values: dict[str, Any]  # name -> number, or tuple of numbers
    received: float  # time.monotonic()

    @property
    def pose(self) -> np.ndarray:
        """TCP pose (6,), metres and axis-angle, base frame."""
        return np.array(self.values["actual_TCP_pose"])

    @property
    def age(self) -> float:
        """Seconds since it arrived."""
        return time.monotonic() - self.received

    def trouble(self) -> str | None:
        """Why the arm must not be moved in this state; None if it may."""
        v = self.values
        if v["safety_mode"] not in (1, 2) or v["safety_status_bits"] & ~0b11:
            mode, bits = v["safety_mode"], v["safety_status_bits"]
            return f"safety: {SAFETY.get(mode, mode)} (status bits {bits:#x})"
        if v["robot_mode"] != RUNNING:
            return f"the robot is not running (robot mode {v['robot_mode']}, {RUNNING} is running)"
        if not np.isfinite(self.pose).all():
            return "the pose of the TCP is not finite"
        return None


class RTDE:
    """A client of the controller's RTDE interface, protocol version 2: one recipe each way.

    A thread keeps the newest state. Nothing is connected again by itself: after a loss, make a new
    one. `send` and `stop` write the inputs; after `stop` nothing is ever sent. A program that was
    made for this `session` follows them, and no other does.

    Raises RobotError: refused version, a field NOT_FOUND or IN_USE, no answer, lost connection,
    lost framing.
    """

    def __init__(
        self,
        host: str,
        port: int = 30004,
        hz: float = 125.0,
        write: bool = False,
        timeout: float = 2.0,
    ):
        self.name = f"RTDE at {host}:{port}"
        self.buffer, self.newest, self.error, self.stopped = b"", None, None, False
        self.session = random.SystemRandom().randrange(1, 2**31)
        self.rotation: np.ndarray | None = None  # the rotation vector sent last
        self.lock, self.arrived = threading.Lock(), threading.Condition()
        try:
            self.socket = socket.create_connection((host, port), timeout)
        except OSError as error:
            raise RobotError(f"{self.name} cannot be reached: {error}") from None
        try:
            self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if self.request(REQUEST_VERSION, struct.pack(">H", 2))[:1] != b"\x01":
                raise RobotError(
                    f"{self.name} refuses protocol version 2: update the controller's software"
                )
            reply = self.request(SETUP_OUTPUTS, struct.pack(">d", hz) + ",".join(OUTPUTS).encode())
            self.output_recipe, self.output_format = self.recipe(reply, OUTPUTS)
            if write:
                reply = self.request(SETUP_INPUTS, ",".join(INPUTS).encode())
                self.input_recipe, self.input_format = self.recipe(reply, INPUTS)
            if self.request(START, b"")[:1] != b"\x01":
                raise RobotError(f"{self.name} does not start sending")
        except BaseException:
            self.socket.close()
            raise
        self.thread = threading.Thread(target=self.read, name="RTDE", daemon=True)
        self.thread.start()

    def recipe(self, reply: bytes, names: Sequence[str]) -> tuple[int, struct.Struct]:
        """The recipe's id and layout, from the answer to a set-up."""
        types = reply[1:].decode("ascii", "replace").strip(",").split(",")
        for name, kind in zip(names, types):
            if kind not in FORMATS:
                advice = {
                    "IN_USE": "another client holds it",
                    "NOT_FOUND": "the controller does not know it",
                }
                raise RobotError(
                    f"{self.name}: field {name} is {kind} "
                    f"({advice.get(kind, 'of an unknown type')})"
                )
        if len(types) != len(names) or not reply[0]:
            raise RobotError(
                f"{self.name}: the recipe of {len(names)} fields was answered with {len(types)} "
                "types"
            )
        return reply[0], struct.Struct(">" + "".join(FORMATS[kind] for kind in types))

    def package(self) -> tuple[int, bytes]:
        """The next package's type and payload, however the bytes were split or joined."""
        while True:
            if len(self.buffer) >= HEADER.size:
                size, kind = HEADER.unpack_from(self.buffer)
                if size < HEADER.size:
                    raise RobotError(f"{self.name}: framing lost (a package of {size} bytes)")
                if len(self.buffer) >= size:
                    payload, self.buffer = self.buffer[HEADER.size : size], self.buffer[size:]
                    return kind, payload
            try:
                received = self.socket.recv(65536)
            except TimeoutError:
                raise RobotError(
                    f"{self.name}: no answer for {self.socket.gettimeout():g} s"
                ) from None
            except OSError as error:
                raise RobotError(f"{self.name}: connection lost: {error}") from None
            if not received:
                raise RobotError(f"{self.name}: connection closed by the controller")
            self.buffer += received

    def request(self, kind: int, payload: bytes) -> bytes:
        """Sends a package and returns the payload of the answer, which has the same type."""
        self.socket.sendall(HEADER.pack(HEADER.size + len(payload), kind) + payload)
        while True:
            answer, payload = self.package()
            if answer == kind:
                return payload
            if answer not in (MESSAGE, DATA):
                raise RobotError(f"{self.name}: framing lost (type {answer} instead of {kind})")

    def read(self) -> None:
        """The reader's thread: keeps the newest state until the connection ends."""
        try:
            while True:
                kind, payload = self.package()
                if kind == DATA:
                    state = self.parse(payload)
                    with self.arrived:
                        self.newest = state
                        self.arrived.notify_all()
                elif kind != MESSAGE:
                    raise RobotError(f"{self.name}: framing lost (type {kind})")
        except RobotError as error:
            with self.arrived:
                self.error = error
                self.arrived.notify_all()

    def parse(self, payload: bytes) -> State:
        if len(payload) != 1 + self.output_format.size or payload[0] != self.output_recipe:
            raise RobotError(f"{self.name}: framing lost (a data package of {len(payload)} bytes)")
        numbers, values = iter(self.output_format.unpack_from(payload, 1)), {}
        for name, kind in zip(OUTPUTS, self.output_format.format[1:].replace("6d", "V")):
            values[name] = tuple(next(numbers) for _ in range(6)) if kind == "V" else next(numbers)
        return State(values, time.monotonic())

    def state(self, max_age: float = 0.1) -> State:
        """The newest state. Raises RobotError if it is older than `max_age` seconds or the
        connection is lost.
        """
        with self.arrived:
            if self.newest is None and self.error is None:
                self.arrived.wait(2.0)
            state, error = self.newest, self.error
        if error is not None:
            raise RobotError(str(error))
        if state is None or state.age > max_age:
            raise RobotError(
                f"{self.name}: the newest state is "
                f"{'missing' if state is None else f'{state.age:.3f} s old'}"
            )
        return state

    def send(self, pose: np.ndarray) -> bool:
        """Writes a target pose (6,) for the servo program. False, and nothing is sent, after
        `stop`.
        """
        with self.lock:
            if not self.stopped:
                self.write(pose, self.session)
            return not self.stopped

    def stop(self, pose: np.ndarray) -> None:
        """Tells the servo program to end; the last thing ever sent."""
        with self.lock:
            if not self.stopped:
                self.stopped = True
                self.write(pose, STOP)

    def write(self, pose: np.ndarray, command: int) -> None:
        if self.rotation is not None:  # no jump by 2 pi between two packages
            pose = np.concatenate([pose[:3], nearer(pose[3:], self.rotation)])
        self.rotation = pose[3:]
        payload = bytes([self.input_recipe]) + self.input_format.pack(*map(float, pose), command)
        try:
            self.socket.sendall(HEADER.pack(HEADER.size + len(payload), DATA) + payload)
        except OSError as error:
            raise RobotError(f"{self.name}: connection lost: {error}") from None

    def program_runs(self, state: State) -> bool:
        """Whether the program of this session runs, and is not paused."""
        v = state.values
        playing = v["robot_status_bits"] & PROGRAM_RUNNING and v["runtime_state"] == PLAYING
        return playing and v["output_int_register_24"] == self.session

    def close(self) -> None:
        try:
            self.socket.shutdown(socket.SHUT_RDWR)
        except OSError:
            pass  # closed by the controller before
        self.socket.close()
        self.thread.join(1.0)


# ---- Dashboard and programs on the controller ----------------------------------------------------

# Both programs run on the controller. They end when told to, when RTDE is late (the watchdog, so
# that no arm moves or stays free whose computer is gone), or when no inverse kinematics is found.
# The session says whose they are, the counter that they still run. The watchdog rests before the
# arm is braked: nobody writes any more, and it would cut the braking short.
PROGRAM = """def dami():
  rtde_set_watchdog("input_int_register_24", {watchdog_hz:.1f}, "stop")
  write_output_integer_register(24, {session})
  n = 0
{before}  while read_input_integer_register(24) == {session}:
    n = n + 1
    write_output_integer_register(25, n)
{turn}  end
  rtde_set_watchdog("input_int_register_24", 0.1, "ignore")
{after}  stopj(2.0)
  write_output_integer_register(24, 0)
end
"""
FREEDRIVE = ("  freedrive_mode()\n", "    sync()\n", "  end_freedrive_mode()\n")
SERVO = """    pose = p[{registers}]
    q = get_inverse_kin(pose, get_actual_joint_positions())
    servoj(q, t={period:.4f}, lookahead_time={lookahead:.3f}, gain={gain:.0f})
"""


def servo_turn(settings: Settings) -> str:
    """What the servo program does in each turn."""
    return SERVO.format(
        registers=", ".join(f"read_input_float_register({24 + i})" for i in range(6)),
        period=1 / settings.servo_hz,
        lookahead=settings.servo_lookahead_s,
        gain=settings.servo_gain,
    )


def start_program(
    rtde: RTDE, settings: Settings, host: str, before: str, turn: str, after: str
) -> State:
    """Starts a program of this session and waits until it runs; preloads the actual pose.

    Returns the state in which it runs. Raises RobotError if the arm must not be moved, or the
    program does not start.
    """
    state = rtde.state(settings.max_state_age_s)
    if trouble := state.trouble():
        raise RobotError(f"the arm is not moved: {trouble}")
    pose, watchdog_hz, session = state.pose, settings.servo_hz / 10, rtde.session
    rtde.send(pose)
    text = PROGRAM.format(
        watchdog_hz=watchdog_hz, session=session, before=before, turn=turn, after=after
    )
    upload(host, settings.script_port, text)
    deadline = time.monotonic() + 5
    while not rtde.program_runs(state := rtde.state(settings.max_state_age_s)):
        if time.monotonic() > deadline:
            hint = "the program does not start: is the robot in remote control?"
            raise RobotError(f"{hint} ({state.trouble()})")
        rtde.send(pose)
        time.sleep(1 / settings.servo_hz)
    return state


def upload(host: str, port: int, program: str) -> None:
    """Sends a URScript program; the controller ends the one that runs and starts this one."""
    try:
        with socket.create_connection((host, port), 2.0) as connection:
            connection.sendall(program.encode())
    except OSError as error:
        raise RobotError(
            f"the script port at {host}:{port} does not take the program: {error}"
        ) from None


def dashboard(host: str, port: int, *questions: str) -> list[str]:
    """Asks the dashboard server, for example `robotmode`; one line of answer for each question."""
    try:
        with (
            socket.create_connection((host, port), 2.0) as connection,
            connection.makefile("rw", newline="\n") as lines,
        ):
            lines.readline()  # the banner
            answers = []
            for question in questions:
                lines.write(f"{question}\n")
                lines.flush()
                answers.append(lines.readline().strip())
            return answers
    except (OSError, UnicodeDecodeError) as error:
        raise RobotError(f"the dashboard at {host}:{port} does not answer: {error}") from None


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


class Gripper:
    """An AG95: frames of Modbus RTU over TCP (a serial bridge) or a serial port, 115200 8N1, slave
    1.

    A bad check sum, a time-out or a foreign answer is retried `RETRIES` times; an exception frame,
    too. Then RobotError.
    """

    RETRIES = 3

    def __init__(self, settings: Settings, host: str, timeout: float = 0.3):
        self.where = settings.gripper_serial or f"{host}:{settings.gripper_port}"
        self.force, self.commanded = settings.gripper_force_percent, None
        if settings.gripper_serial:
            try:
                import serial
            except ImportError:
                raise ValueError(
                    "a gripper on a serial port needs `pip install pyserial`"
                ) from None
            try:
                port = serial.Serial(settings.gripper_serial, 115200, timeout=timeout)
            except serial.SerialException as error:
                raise RobotError(f"the gripper's port cannot be opened: {error}") from None
            self.receive, self.transmit, self.flush, self.close = (
                port.read,
                port.write,
                port.reset_input_buffer,
                port.close,
            )
            return
        try:
            connection = socket.create_connection((host, settings.gripper_port), 2.0)
        except OSError as error:
            raise RobotError(f"the gripper at {self.where} cannot be reached: {error}") from None
        connection.settimeout(timeout)
        self.transmit, self.close = connection.sendall, connection.close

        def receive(n: int) -> bytes:
            received = b""
            while len(received) < n and (part := connection.recv(n - len(received))):
                received += part
            return received

        def flush() -> None:
            connection.setblocking(False)
            try:
                while connection.recv(4096):
                    pass
            except BlockingIOError:
                pass
            connection.settimeout(timeout)

        self.receive, self.flush = receive, flush

    def exchange(self, function: int, register: int, value: int) -> int:
        """Writes a register, or reads one (`value` 1: so many); the value in the answer."""
        request = struct.pack(">BBHH", 1, function, register, value)
        request += crc16(request)
        for _ in range(self.RETRIES):
            try:
                self.flush()
                self.transmit(request)
                head = self.receive(
                    3
                )  # slave, function, then a byte count, an exception or the register's high byte
                if len(head) < 3:
                    problem = "no answer"
                    continue
                rest = self.receive(
                    2 if head[1] & 0x80 else (head[2] + 2 if function == READ else 5)
                )
            except TimeoutError:
                problem = "no answer"
                continue
            except OSError as error:
                problem = str(error)
                continue
            answer = head + rest
            if crc16(answer[:-2]) != answer[-2:]:
                problem = "bad check sum"
            elif answer[1] == function | 0x80:
                problem = EXCEPTIONS.get(answer[2], f"exception {answer[2]}")
            elif answer[:2] != request[:2] or (function == WRITE and answer != request):
                problem = "the answer belongs to another request"
            else:
                return int.from_bytes(answer[3:5] if function == READ else answer[4:6], "big")
        raise RobotError(
            f"the gripper at {self.where}: {problem}, {self.RETRIES} times (register "
            f"{register:#06x})"
        )

    def initialize(self, timeout: float = 10.0) -> None:
        """Initializes it if that was not done yet (it opens and closes), and sets the force."""
        if self.exchange(READ, INITIALIZED, 1) != 1:
            self.exchange(WRITE, INITIALIZE, 1)
            deadline = time.monotonic() + timeout
            while self.exchange(READ, INITIALIZED, 1) != 1:
                if time.monotonic() > deadline:
                    raise RobotError(
                        f"the gripper at {self.where} is not ready after {timeout:g} s"
                    )
                time.sleep(0.05)
        self.exchange(WRITE, FORCE, self.force)

    def move(self, closed: float) -> None:
        """Goes to 0 (open) ... 1 (closed); nothing is sent for a change below 1 %."""
        per_mille = round(1000 * (1 - min(1.0, max(0.0, closed))))
        if self.commanded is None or abs(per_mille - self.commanded) >= 10:
            self.exchange(WRITE, POSITION, per_mille)
            self.commanded = per_mille

    def read(self) -> float:
        """Where it is, 0 (open) ... 1 (closed)."""
        return 1 - self.exchange(READ, POSITION_NOW, 1) / 1000


# ---- Camera: depth to points in the robot's base frame -------------------------------------------


class Intrinsics(NamedTuple):
    """A pinhole camera, in pixels: focal lengths and the principal point. They must be those of the
    depth image.
    """

    fx: float
    fy: float
    cx: float
    cy: float


def depth_to_points(depth: np.ndarray, intrinsics: Intrinsics) -> np.ndarray:
    """Depth (H, W) in metres, 0 where there is none -> points (M, 3) float32, camera frame: right,
    down, forward.
    """
    rows, columns = np.nonzero(np.isfinite(depth) & (depth > 0))
    z = depth[rows, columns]
    x, y = (columns - intrinsics.cx) / intrinsics.fx * z, (rows - intrinsics.cy) / intrinsics.fy * z
    return np.stack([x, y, z], axis=-1).astype(np.float32)


SAMPLED_FROM = 8192  # points at most: 10 ms


def cloud(depth: np.ndarray, intrinsics: Intrinsics, settings: Settings) -> np.ndarray:
    """Depth (H, W) in metres -> the policy's points (N, 3) float32, base frame, cropped and
    farthest point sampled.

    Fewer points than N are repeated; of many, every second, third ... is sampled from: sampling
    keeps Python's lock, in which no other thread runs, and 300 000 points would hold up the servo
    stream for a quarter of a second. Raises CameraError if there is no depth, or none of it inside
    the box.
    """
    points = depth_to_points(depth, intrinsics)
    if len(points) == 0:
        raise CameraError(
            "the camera's depth is empty: check its cable, its power and what it looks at"
        )
    pose = np.array(settings.camera_to_base)
    points = (points @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)  # (M, 3) base frame
    inside = ((points >= settings.crop_low_m) & (points <= settings.crop_high_m)).all(axis=1)
    if not inside.any():
        raise CameraError(
            "no point of the camera lies in the crop box: check camera_to_base and crop_low_m, "
            "crop_high_m"
        )
    points = points[inside]
    return farthest_point_sample(
        points[:: math.ceil(len(points) / SAMPLED_FROM)], settings.num_points
    )


class RealSense:
    """The depth stream of the first RealSense camera found, with that stream's own intrinsics.

    Raises ValueError without pyrealsense2, CameraError if the camera does not start.
    """

    def __init__(self, width: int = 640, height: int = 480, hz: int = 30):
        try:
            import pyrealsense2 as rs
        except ImportError:
            raise ValueError(
                "a RealSense camera needs `pip install pyrealsense2`; or name a recorded --camera"
            ) from None
        self.pipeline, config = rs.pipeline(), rs.config()
        config.enable_stream(rs.stream.depth, width, height, rs.format.z16, hz)
        try:
            profile = self.pipeline.start(config)
        except RuntimeError as error:
            raise CameraError(f"the RealSense camera does not start: {error}") from None
        self.unit = profile.get_device().first_depth_sensor().get_depth_scale()  # metres
        self.intrinsics = realsense_intrinsics(profile.get_stream(rs.stream.depth))

    def read(self) -> np.ndarray:
        """The newest depth image (H, W) float32 in metres. Raises CameraError after a second
        without one.
        """
        try:
            frames = self.pipeline.wait_for_frames(1000)
        except RuntimeError as error:
            raise CameraError(f"the RealSense camera: {error}") from None
        return np.asarray(frames.get_depth_frame().get_data()).astype(np.float32) * self.unit

    def close(self) -> None:
        self.pipeline.stop()


def realsense_intrinsics(stream: Any) -> Intrinsics:
    """Of a pyrealsense2 stream profile."""
    i = stream.as_video_stream_profile().get_intrinsics()
    return Intrinsics(i.fx, i.fy, i.ppx, i.ppy)


class RecordedCamera:
    """Replays a file of depth images, over and over: `.npz` with depth (F, H, W) uint16 in
    millimetres, intrinsics (4,).
    """

    def __init__(self, path: str | Path):
        try:
            with np.load(path, allow_pickle=False) as file:
                self.depth, self.intrinsics = (
                    file["depth"],
                    Intrinsics(*map(float, file["intrinsics"])),
                )
        except (OSError, KeyError, ValueError, TypeError) as error:
            raise ValueError(
                f"{path} is no recorded camera (depth and intrinsics in an .npz file): {error}"
            ) from None
        if self.depth.ndim != 3 or self.depth.dtype != np.uint16 or len(self.depth) == 0:
            raise ValueError(
                f"{path}: depth must be (F, H, W) uint16, not {self.depth.shape} {self.depth.dtype}"
            )
        self.frame = 0

    def read(self) -> np.ndarray:
        """The next depth image (H, W) float32 in metres."""
        self.frame += 1
        return self.depth[(self.frame - 1) % len(self.depth)].astype(np.float32) / 1000

    def close(self) -> None:
        pass


# ---- Streaming motion ----------------------------------------------------------------------------


def compose(pose: np.ndarray, action: np.ndarray) -> np.ndarray:
    """Pose (6,) and relative action (>= 6,) -> the pose (6,) it leads to."""
    rotation = Rotation.from_rotvec(action[3:6]) * Rotation.from_rotvec(pose[3:])
    return np.concatenate([pose[:3] + action[:3], rotation.as_rotvec()])


def difference(pose: np.ndarray, later: np.ndarray) -> np.ndarray:
    """The action (6,) that leads from one pose to a later one; the inverse of `compose`."""
    rotation = Rotation.from_rotvec(later[3:]) * Rotation.from_rotvec(pose[3:]).inv()
    return np.concatenate([later[:3] - pose[:3], rotation.as_rotvec()])


def nearer(rotvec: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Of the two vectors (3,), of angles a and a - 2 pi, that mean one rotation: the one nearer to
    `reference` (3,).

    A tool that points down is half a turn from the base, where the controller's vector jumps from
    one to the other.
    """
    angle = np.linalg.norm(rotvec)
    other = rotvec * (1 - 2 * np.pi / angle) if angle > 0 else rotvec
    return min(rotvec, other, key=lambda v: np.linalg.norm(v - reference))


def toward(pose: np.ndarray, target: np.ndarray, metres: float, radians: float) -> np.ndarray:
    """From pose to target (6,), but no farther than so many metres and radians: straight, and on
    SO(3).
    """
    step = difference(pose, target)
    for part, limit in ((slice(0, 3), metres), (slice(3, 6), radians)):
        length = np.linalg.norm(step[part])
        if length > limit:
            step[part] *= limit / length
    return compose(pose, step)


class Servo:
    """Streams poses at `servo_hz` from a thread of its own; the policy's inference never holds it
    up.

    It interpolates from the pose commanded last (not from the measured one) and clamps the speed.
    When all targets are reached it holds the last one. It stops for good, and says why, when

    - the newest state is older than `max_state_age_s`, or the connection or its framing is lost;
    - the robot is not running, its safety mode is neither normal nor reduced, or our program is
    paused, has ended, or no longer counts (another has taken its place);
    - the controller's clock stands still or runs backwards;
    - the arm is farther than `max_lag_m` or `max_lag_rad` from where it was told to be: blocked, or
    slowed by the speed slider;
    - it begins outside the box;
    - an action has the wrong shape, NaN, or a jump; a target lies outside the box (unless
    `outside_box` is "clamp");
    - no new targets come for `max_hold_s`, since the policy is too slow or the camera gives
    nothing.

    To stop is to tell the program on the controller to end, once; nothing is sent after that.
    """

    def __init__(self, rtde: RTDE, settings: Settings, moves: bool = True):
        self.rtde, self.settings, self.moves = rtde, settings, moves
        self.pose = rtde.state(settings.max_state_age_s).pose  # commanded last
        self.targets: list[tuple[float, np.ndarray]] = []  # (when, pose)
        self.held_since, self.missing = (
            time.monotonic(),
            "the policy or the camera is too slow",
        )  # why it holds
        self.lock, self.error, self.ended = threading.Lock(), None, threading.Event()
        self.changed: dict[str, tuple[float, float]] = {}  # name -> its value, and since when
        self.lateness, self.ages, self.clamped = [], [], False

    def start(self, host: str) -> None:
        """Starts the program on the controller where the arm now is, and begins to stream."""
        settings = self.settings
        state = self.rtde.state(settings.max_state_age_s)
        if trouble := state.trouble():
            raise RobotError(f"the arm is not moved: {trouble}")
        if not self.holds(state.pose):
            where = ", ".join(f"{x:.3f}" for x in state.pose[:3])
            raise RobotError(f"the TCP is outside its box, at {where} m: move it inside first")
        self.pose = state.pose  # not an older one: the arm may have been moved meanwhile
        if self.moves:
            self.pose = start_program(self.rtde, settings, host, "", servo_turn(settings), "").pose
        self.held_since = time.monotonic()
        self.thread = threading.Thread(target=self.stream, name="servo", daemon=True)
        self.thread.start()

    def holds(self, pose: np.ndarray) -> bool:
        """Whether the TCP's box holds a pose."""
        low, high = self.settings.tcp_low_m, self.settings.tcp_high_m
        return bool(((pose[:3] >= low) & (pose[:3] <= high)).all())

    def stale(self, state: State, now: float) -> str | None:
        """What in the state should change all the time and does not; None if all does."""
        watched = {"the controller's clock": state.values["timestamp"]}
        if self.moves:
            watched["the count of our program"] = state.values["output_int_register_25"]
        for name, value in watched.items():
            old, since = self.changed.get(name, (value, now))
            if value < old:
                return f"{name} runs backwards"
            if now - since > 2 * self.settings.max_state_age_s:
                return f"{name} stands still"
            self.changed[name] = (value, now if value > old else since)
        return None

    def lag(self, state: State) -> str | None:
        """Why the arm does not follow, if it does not."""
        settings, behind = self.settings, difference(state.pose, self.pose)
        metres, radians = np.linalg.norm(behind[:3]), np.linalg.norm(behind[3:])
        if metres <= settings.max_lag_m and radians <= settings.max_lag_rad:
            return None
        return f"the arm is {metres:.3f} m, {radians:.3f} rad behind: blocked, or slowed down"

    def follow(self, actions: np.ndarray) -> None:
        """Takes relative actions (n, 7), one every 1 / policy_hz from now on; raises RobotError for
        what is refused.
        """
        settings = self.settings
        actions = np.asarray(actions, dtype=float)
        if actions.ndim != 2 or actions.shape[1] != ACTION_DIM:
            self.fail(f"actions have the shape {actions.shape}, not (n, {ACTION_DIM})")
        elif not np.isfinite(actions).all():
            self.fail("an action is not finite")
        else:
            metres = np.linalg.norm(actions[:, :3], axis=1).max()
            radians = np.linalg.norm(actions[:, 3:6], axis=1).max()
            if metres > settings.max_step_m or radians > settings.max_step_rad:
                self.fail(
                    f"an action jumps by {metres:.3f} m, {radians:.3f} rad (max_step_m, "
                    "max_step_rad)"
                )
        self.check()
        with self.lock:
            pose, now = self.pose, time.monotonic()
            targets = []
            for step, action in enumerate(actions, start=1):
                pose = self.inside(compose(pose, action))
                targets.append((now + step / settings.policy_hz, pose))
            self.targets = targets
        self.check()

    def inside(self, pose: np.ndarray) -> np.ndarray:
        """The pose if the TCP's box holds it; else stops, or clamps it, as the settings say."""
        if self.holds(pose):
            return pose
        if self.settings.outside_box == "stop":
            self.fail(f"a target lies outside the box: {', '.join(f'{x:.3f}' for x in pose[:3])} m")
        self.clamped = True
        low, high = self.settings.tcp_low_m, self.settings.tcp_high_m
        return np.concatenate([pose[:3].clip(low, high), pose[3:]])

    def check(self) -> None:
        """Raises RobotError if the arm was stopped."""
        if self.error is not None:
            raise RobotError(self.error)

    def fail(self, reason: str) -> None:
        """Stops the arm; the first reason is kept."""
        if self.error is None:
            self.error = reason
        if not self.moves:
            return  # nothing was sent, and nothing can be
        try:
            self.rtde.stop(self.pose)
        except RobotError:
            pass  # the connection is lost: the watchdog on the controller stops the arm

    def tick(self, now: float) -> np.ndarray:
        """The pose to command now: toward the next target, on time, no faster than allowed."""
        settings, dt = self.settings, 1 / self.settings.servo_hz
        with self.lock:
            while len(self.targets) > 1 and self.targets[0][0] <= now:
                self.targets.pop(0)
            if self.targets:
                when, target = self.targets[0]
                share = min(1.0, dt / max(when - now + dt, dt))
                goal = compose(self.pose, share * difference(self.pose, target))
                self.pose = toward(
                    self.pose, goal, settings.max_speed_m_s * dt, settings.max_speed_rad_s * dt
                )
                if when <= now and np.allclose(self.pose, target, atol=1e-6):
                    self.targets = []
                self.held_since = now
            return self.pose

    def stream(self) -> None:
        """The thread: a package every 1 / servo_hz, until something is wrong or `stop` comes."""
        period, settings = 1 / self.settings.servo_hz, self.settings
        due = time.monotonic()
        while not self.ended.is_set() and self.error is None:
            try:
                state = self.rtde.state(settings.max_state_age_s)
                trouble = state.trouble()
                now = time.monotonic()
                if trouble is None and self.moves and not self.rtde.program_runs(state):
                    trouble = "the program on the controller has ended, or is paused"
                if trouble is None and self.moves:
                    trouble = self.lag(state)
                trouble = trouble or self.stale(state, now)
                if trouble is None and now - self.held_since > settings.max_hold_s:
                    trouble = f"no new actions for {settings.max_hold_s:g} s: {self.missing}"
                if trouble is not None:
                    self.fail(trouble)
                    return
                pose = self.tick(now)
                if self.moves:
                    self.rtde.send(pose)
            except Exception as error:  # whatever it is: without this thread the arm must not go on
                self.fail(
                    str(error)
                    if isinstance(error, RobotError)
                    else f"the stream broke off: {error!r}"
                )
                return
            self.lateness.append(now - due)
            self.ages.append(state.age)
            due = max(due + period, now - period)  # after a pause it does not catch up with a burst
            time.sleep(max(0.0, due - time.monotonic()))

    def stop(self) -> None:
        """Ends the stream and the program on the controller."""
        self.ended.set()
        if hasattr(self, "thread"):
            self.thread.join(1.0)
        self.fail("stopped")

    def report(self) -> str:
        """How regular the stream was."""
        if not self.lateness:
            return "nothing was streamed"
        late, age = 1000 * np.array(self.lateness), 1000 * np.array(self.ages)
        return (
            f"{len(late)} packages at {self.settings.servo_hz:g} Hz: late by {np.median(late):.2f} "
            "ms (median), "
            f"{np.percentile(late, 99):.2f} ms (99 %), {late.max():.2f} ms (worst); oldest state "
            f"{age.max():.1f} ms"
        )


# ---- The policy's loop ---------------------------------------------------------------------------


@dataclass
class Cell:
    """Arm, gripper and camera together."""

    settings: Settings
    rtde: RTDE
    gripper: Gripper
    camera: RealSense | RecordedCamera

    def observe(self) -> tuple[np.ndarray, np.ndarray]:
        """The present observation: points (N, 3) float32, base frame; state (7,) float32: TCP pose
        and gripper.
        """
        points = cloud(self.camera.read(), self.camera.intrinsics, self.settings)
        pose = self.rtde.state(self.settings.max_state_age_s).pose
        pose[3:] = nearer(pose[3:], np.array(self.settings.rotation_near_rad))
        return points, np.append(pose, self.gripper.read()).astype(np.float32)

    def wait_for_observation(self, servo: Servo) -> tuple[np.ndarray, np.ndarray]:
        """`observe`; while the camera gives nothing the arm is held, until `servo` stops it. Then
        raises RobotError.
        """
        while True:
            try:
                return self.observe()
            except CameraError as error:
                servo.missing = str(error)
                servo.check()
                time.sleep(0.02)


@contextmanager
def connect(args: argparse.Namespace, settings: Settings, write: bool) -> Iterator[Cell]:
    """Camera, gripper and arm; whatever was opened is closed again."""
    with ExitStack() as stack:
        camera = RecordedCamera(args.camera) if args.camera else RealSense()
        stack.callback(camera.close)
        gripper = Gripper(settings, args.host)
        stack.callback(gripper.close)
        rtde = RTDE(args.host, settings.rtde_port, settings.servo_hz, write)
        stack.callback(rtde.close)
        yield Cell(settings, rtde, gripper, camera)


def run(args: argparse.Namespace, settings: Settings) -> None:
    """Runs the policy: observes To frames, draws a chunk of Ta actions, executes it, and again."""
    policy, info = load_checkpoint(args.checkpoint, needs=("text_weights",))
    config = policy.config
    if (config.state_dim, config.action_dim) != (
        STATE_DIM,
        ACTION_DIM,
    ) or config.num_points > settings.num_points:
        raise ValueError(
            f"{args.checkpoint} has {config.state_dim} state, {config.action_dim} action "
            f"dimensions and {config.num_points} "
            f"points; the robot {STATE_DIM}, {ACTION_DIM} and {settings.num_points}: use a policy "
            "trained on its recordings"
        )
    demonstrations = load_demonstrations(args.data)
    sampler = WindowSampler(demonstrations, policy.config)
    text, _ = text_features([demonstrations.instruction], args.clip_weights, info["text_weights"])
    torch.set_num_threads(max(1, (os.cpu_count() or 1) - 1))  # a core is left to the servo stream
    generator = torch.Generator().manual_seed(args.seed)
    demo = sampler.demonstration(sampler.draw_episode(generator))  # held for the whole run
    with torch.no_grad():
        context = policy.encode_demo(text, **demo)

    with connect(args, settings, write=not args.dry_run) as cell:
        servo = Servo(cell.rtde, settings, moves=not args.dry_run)
        try:
            cell.observe()  # camera, gripper and arm answer, before anything moves
            if not args.dry_run:
                cell.gripper.initialize()
            servo.start(args.host)
            frames = [cell.wait_for_observation(servo)] * config.n_obs_steps
            print(
                f"{demonstrations.task}: running{' without motion' if args.dry_run else ''}; "
                "Ctrl-C stops",
                flush=True,
            )
            until = time.monotonic() + args.seconds
            while time.monotonic() < until:
                points, state = (torch.from_numpy(np.stack(part))[None] for part in zip(*frames))
                points = points[:, :, : config.num_points]  # (1, To, N, 3), (1, To, S)
                actions = policy.sample_actions(points, state, context, generator)[
                    0
                ].numpy()  # (Ta, A)
                frames = execute(cell, servo, actions, config.n_obs_steps, args.dry_run)
        finally:
            servo.stop()
            print(servo.report())
    if servo.clamped:
        print("warning: some targets lay outside the box and were clamped", file=sys.stderr)


def execute(
    cell: Cell, servo: Servo, actions: np.ndarray, n_obs_steps: int, dry_run: bool
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Executes a chunk (Ta, 7); returns the observations of its last steps. Raises RobotError if
    the arm was stopped.
    """
    servo.follow(actions)
    began, frames = time.monotonic(), []
    for step, action in enumerate(actions, start=1):
        if not dry_run:
            cell.gripper.move(action[6])
        while (left := began + step / cell.settings.policy_hz - time.monotonic()) > 0:
            servo.check()
            time.sleep(min(left, 0.02))
        servo.check()
        if step > len(actions) - n_obs_steps:
            frames.append(cell.wait_for_observation(servo))
    return frames


# ---- Recording -----------------------------------------------------------------------------------


class Keys:
    """The keys pressed so far, one at a time, without waiting: of a terminal, without Enter, or of
    what stdin brings.
    """

    def __enter__(self) -> Keys:
        self.old = termios.tcgetattr(sys.stdin) if sys.stdin.isatty() else None
        if self.old is not None:
            tty.setcbreak(sys.stdin)
        return self

    def __exit__(self, *_: Any) -> None:
        if self.old is not None:
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self.old)

    def pressed(self) -> str:
        """One key, or an empty string. Raises RobotError at the end of the input."""
        while select.select([sys.stdin], [], [], 0)[0]:
            key = os.read(sys.stdin.fileno(), 1).decode(
                "ascii", "replace"
            )  # past Python's buffer, which hides keys
            if key == "":
                raise RobotError("the input has ended: the episode at hand is dropped")
            if key != "\n":
                return key
        return ""


def to_demonstrations(
    task: str, instruction: str, episodes: list[list[tuple]], meta: dict
) -> Demonstrations:
    """Episodes of frames (points, state, gripper commanded) -> Demonstrations; actions lead from a
    frame to the next.
    """
    points, state, action, ends = [], [], [], []
    for episode in episodes:
        poses = [frame[1][:6].astype(float) for frame in episode]
        for index, (cloud_, state_, closed) in enumerate(episode):
            points.append(cloud_.astype(np.float16))
            state.append(state_)
            action.append(
                np.append(difference(poses[index], poses[min(index + 1, len(poses) - 1)]), closed)
            )
        ends.append(len(points))
    arrays = (
        np.stack(points),
        np.stack(state),
        np.stack(action).astype(np.float32),
        np.array(ends, np.int64),
    )
    return Demonstrations(task, instruction, *arrays, meta)


def keep_free(rtde: RTDE, settings: Settings) -> None:
    """The thread that keeps the arm free: without it the watchdog on the controller ends that."""
    with suppress(RobotError):  # the connection is lost: the watchdog does it
        while rtde.send(rtde.state(settings.max_state_age_s).pose):
            time.sleep(1 / settings.servo_hz)


def record(args: argparse.Namespace, settings: Settings) -> None:
    """Records demonstrations by hand guidance: the arm is free to be moved, keys begin and end an
    episode.
    """
    out = Path(args.out or f"demos/{args.task}.npz")
    episodes: list[list[tuple]] = []
    if out.exists():
        raise ValueError(f"{out} exists: move it, or give another --out")
    meta = {
        "made_by": "robot.record",
        "policy_hz": settings.policy_hz,
        "num_points": settings.num_points,
    }
    with connect(args, settings, write=not args.dry_run) as cell, Keys() as keys:
        cell.observe()  # camera, gripper and arm answer, before anything is set free
        if not args.dry_run:
            cell.gripper.initialize()
            start_program(cell.rtde, settings, args.host, *FREEDRIVE)
            threading.Thread(target=keep_free, args=(cell.rtde, settings), daemon=True).start()
        print(
            "keys: s starts an episode, e ends and keeps it, d drops it, g opens or closes the "
            "gripper, q quits",
            flush=True,
        )
        try:
            closed, episode, due = 0.0, None, time.monotonic()
            while len(episodes) < args.episodes:
                key = keys.pressed()
                if key == "g":
                    closed = 1.0 - closed
                    if not args.dry_run:
                        cell.gripper.move(closed)
                elif key == "s" and episode is None:
                    episode = []
                    print(f"episode {len(episodes) + 1}: recording", flush=True)
                elif key == "d" and episode is not None:
                    episode = None
                    print("dropped", flush=True)
                elif key == "e" and episode:
                    episodes.append(episode)
                    save_demonstrations(
                        out, to_demonstrations(args.task, args.instruction, episodes, meta)
                    )
                    print(
                        f"episode {len(episodes)}: {len(episode)} frames, saved in {out}",
                        flush=True,
                    )
                    episode = None
                elif key == "q":
                    break
                state = cell.rtde.state(settings.max_state_age_s)
                trouble = state.trouble()
                if trouble is None and not args.dry_run and not cell.rtde.program_runs(state):
                    trouble = "the arm is no longer free: the program on the controller has ended"
                if trouble:
                    raise RobotError(
                        f"{trouble}; the episode at hand is dropped, {len(episodes)} are in {out}"
                    )
                if episode is not None:
                    episode.append((*cell.observe(), closed))
                due += 1 / settings.policy_hz
                time.sleep(max(0.0, due - time.monotonic()))
        finally:
            if not args.dry_run:
                cell.rtde.stop(cell.rtde.newest.pose)
    print(f"{len(episodes)} episodes in {out}" if episodes else "nothing was recorded")


def check(args: argparse.Namespace, settings: Settings) -> None:
    """Connects to everything, moves nothing, and says what it found."""
    names = ("robotmode", "safetystatus", "programState")
    rows = list(zip(names, dashboard(args.host, settings.dashboard_port, *names)))
    with connect(args, settings, write=False) as cell:
        state = cell.rtde.state(settings.max_state_age_s)
        inside = (state.pose[:3] >= settings.tcp_low_m).all() and (
            state.pose[:3] <= settings.tcp_high_m
        ).all()
        rows += [
            (
                "TCP, m and rad",
                " ".join(f"{x:.3f}" for x in state.pose) + ("" if inside else " (outside the box)"),
            ),
            ("state", f"{1000 * state.age:.1f} ms old; {state.trouble() or 'ready'}"),
            (
                "gripper",
                f"{cell.gripper.read():.2f} (0 open, 1 closed), state "
                f"{cell.gripper.exchange(READ, INITIALIZED, 1)}",
            ),
        ]
        depth = cell.camera.read()
        points = cloud(depth, cell.camera.intrinsics, settings)
        rows.append(
            (
                "camera",
                f"{(depth > 0).mean():.0%} of {depth.shape[1]} x {depth.shape[0]} pixels have "
                "depth",
            )
        )
        rows.append(
            (
                "points",
                f"{len(points)}, from {points.min(0).round(3)} to {points.max(0).round(3)} m, "
                "base frame",
            )
        )
    for name, value in rows:
        print(f"{name:16}{value}")
    if trouble := state.trouble():
        raise RobotError(f"the arm cannot be moved: {trouble}")


# ---- Command line --------------------------------------------------------------------------------


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Record, check and run on a UR10e. Keep a hand on the emergency stop."
    )
    commands = parser.add_subparsers(dest="command", required=True)
    for name, text in (("check", check.__doc__), ("record", record.__doc__), ("run", run.__doc__)):
        command = commands.add_parser(name, help=text.split("\n")[0], description=text)
        command.add_argument(
            "--host", required=True, help="address of the robot; nothing else is contacted"
        )
        command.add_argument(
            "--config", default="robot.json", help="poses, boxes and limits (default: robot.json)"
        )
        command.add_argument(
            "--camera", metavar="FILE", help="replay a recorded camera instead of the RealSense"
        )
        if name != "check":
            command.add_argument("--dry-run", action="store_true", help="everything but motion")
        if name == "record":
            command.add_argument("--task", required=True, help="name of the task, and of the file")
            command.add_argument("--instruction", required=True, help="what to do, one sentence")
            command.add_argument(
                "--episodes", type=int, default=10, help="how many to record (default: 10)"
            )
            command.add_argument("--out", help="file to write (default: demos/TASK.npz)")
        if name == "run":
            command.add_argument(
                "--checkpoint", required=True, help="adapted policy of finetune.py"
            )
            command.add_argument(
                "--data", required=True, help="the task's demonstrations: one is the reference"
            )
            command.add_argument("--seconds", type=float, default=60, help="how long (default: 60)")
            command.add_argument(
                "--seed",
                type=int,
                default=0,
                help="of noise and reference demonstration (default: 0)",
            )
            command.add_argument(
                "--clip-weights",
                help="CLIP's ViT-B-32.pt, or `random` (default: as in the checkpoint)",
            )
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    args = parse(argv)
    {"check": check, "record": record, "run": run}[args.command](args, load_settings(args.config))


if __name__ == "__main__":
    command_line(main, RobotError)
