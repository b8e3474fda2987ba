"""robot.py against an emulated arm, and both against clients and servers that we did not write."""

import asyncio
import contextlib
import ctypes
import json
import math
import os
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from conftest import load_once
from scipy.spatial.transform import Rotation, Slerp

import clip
import common
import convert
import data
import geometry
import model
import report
import robot
from robot import RTDE, Gripper, RobotError, Servo, Settings
from tests.emulator import START_POSE, Emulator, turned, write_scene
from tests.fuzz_robot import fuzz_pose, fuzz_robot, simulated_arm

ROOT = Path(__file__).parents[1]
CAMERA_TO_BASE = [[1, 0, 0, -0.2], [0, -1, 0, -0.55], [0, 0, -1, 0.9], [0, 0, 0, 1]]
BOXES = {
    "tcp_low_m": [-0.6, -0.9, 0.05],
    "tcp_high_m": [0.2, -0.2, 0.6],
    "crop_low_m": [-0.6, -0.9, -0.05],
    "crop_high_m": [0.2, -0.2, 0.5],
    "camera_to_base": CAMERA_TO_BASE,
}
STILL = np.zeros((8, 7))
ERRORS = (RobotError, data.RecordingError, model.CheckpointError)


@pytest.fixture
def emulator():
    with Emulator() as emulator:
        yield emulator


@pytest.fixture
def settings(emulator):
    ports = {f"{name}_port": port for name, port in emulator.ports.items()}
    return Settings(**BOXES, **ports, num_points=64, max_hold_s=0.5, max_state_age_s=0.25)


def connect(settings, write=True):
    return RTDE("127.0.0.1", settings.rtde_port, settings.servo_hz, write)


def steps(n=8, **axes):
    """n equal actions, given by axis."""
    actions = np.zeros((n, 7))
    for name, value in axes.items():
        actions[:, ("dx", "dy", "dz", "drx", "dry", "drz", "gripper").index(name)] = value
    return actions


class Moving:
    """A servo at work on the emulator."""

    def __init__(self, settings):
        self.settings = settings

    def __enter__(self):
        self.rtde = connect(self.settings)
        self.servo = Servo(self.rtde, self.settings)
        try:
            self.servo.start("127.0.0.1")
        except RobotError:
            self.rtde.close()
            raise
        return self.servo

    def __exit__(self, *_):
        self.servo.stop()
        self.rtde.close()


def stops(servo, seconds=2.0):
    """The reason for which the servo stops within so many seconds."""
    deadline = time.monotonic() + seconds
    while servo.error is None and time.monotonic() < deadline:
        time.sleep(0.01)
    with pytest.raises(RobotError) as caught:
        servo.check()
    return str(caught.value)


def assert_stop_is_last(emulator):
    """A stop was sent once, and nothing after it."""
    time.sleep(0.04)
    commands = [fields["input_int_register_24"] for _, fields in emulator.received]
    assert commands and commands[-1] == robot.STOP and robot.STOP not in commands[:-1]
    count = len(commands)
    time.sleep(0.04)
    assert len(emulator.received) == count


# ---- The protocol --------------------------------------------------------------------------------


def test_the_state_is_read_whole_however_the_bytes_arrive(emulator, settings):
    for one_byte, joined in ((False, 1), (True, 1), (False, 5)):
        emulator.faults.one_byte, emulator.faults.joined = one_byte, joined
        rtde = connect(settings, write=False)
        state = rtde.state(0.5)
        np.testing.assert_allclose(state.pose, START_POSE)
        v = state.values
        assert (v["robot_mode"], v["safety_mode"], v["robot_status_bits"]) == (7, 1, 1)
        state.check()
        first = v["timestamp"]
        time.sleep(0.2)
        assert rtde.state(0.5).values["timestamp"] > first
        rtde.close()


def test_what_the_controller_refuses_is_named(emulator, settings):
    emulator.faults.not_found = {"payload"}
    with pytest.raises(RobotError, match="payload is NOT_FOUND"):
        connect(settings)
    emulator.faults.not_found, emulator.faults.in_use = set(), {"input_double_register_26"}
    with pytest.raises(RobotError, match=r"input_double_register_26 is IN_USE .*another client"):
        connect(settings)
    emulator.faults.in_use, emulator.faults.refuse_version = set(), True
    with pytest.raises(RobotError, match="protocol version 2"):
        connect(settings)


def test_old_software_is_refused_with_the_advice_to_update(emulator, settings):
    emulator.faults.not_found, emulator.faults.version = {"tcp_offset"}, (5, 4, 3)
    advice = r"tcp_offset is NOT_FOUND .*software 5\.4\.3: update it, 5\.5\.1 or later is needed"
    with pytest.raises(RobotError, match=advice):
        connect(settings)
    emulator.faults.version = (10, 7, 0)  # of PolyScope X: an update is no cure
    with pytest.raises(RobotError, match=r"not known to the controller's software 10\.7\.0\)"):
        connect(settings)


def test_a_handshake_that_fails_closes_its_connection(emulator, settings, monkeypatch):
    opened, create = [], socket.create_connection

    def remember(*args):
        opened.append(create(*args))
        return opened[-1]

    monkeypatch.setattr(socket, "create_connection", remember)
    for fault in ({"refuse_version": True}, {"not_found": {"payload"}}, {"drop": True}):
        emulator.faults = type(emulator.faults)(**fault)
        with pytest.raises(RobotError):
            connect(settings)
        assert opened.pop().fileno() == -1


def test_two_clients_cannot_both_write_and_the_registers_are_free_again_afterwards(
    emulator, settings
):
    first = connect(settings)
    with pytest.raises(RobotError, match="IN_USE"):
        connect(settings)
    connect(settings, write=False).close()  # reading is everybody's
    first.close()
    time.sleep(0.2)
    connect(settings).close()


def test_nobody_listening_is_one_line(settings):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    for call in (
        lambda: RTDE("127.0.0.1", port),
        lambda: robot.dashboard("127.0.0.1", port, "robotmode"),
        lambda: robot.upload("127.0.0.1", port, ""),
        lambda: Gripper(replace(settings, gripper_port=port), "127.0.0.1"),
    ):
        with pytest.raises(RobotError) as caught:
            call()
        assert str(port) in str(caught.value) and "\n" not in str(caught.value)


UR_RTDE = """import json, sys, time, rtde_receive, rtde_io, dashboard_client
r = rtde_receive.RTDEReceiveInterface("127.0.0.1", 125.0, json.loads(sys.argv[1]))
r.startFileRecording("recorded.csv", ["timestamp", "payload"])
time.sleep(0.2)
print(json.dumps({
    "actual_TCP_pose": r.getActualTCPPose(), "timestamp": r.getTimestamp(),
    "robot_mode": r.getRobotMode(), "safety_mode": r.getSafetyMode(), "payload": r.getPayload(),
    "runtime_state": r.getRuntimeState(), "robot_status_bits": r.getRobotStatus(),
    "safety_status_bits": r.getSafetyStatusBits(),
    "target_speed_fraction": r.getTargetSpeedFraction(),
}))
r.stopFileRecording()
io = rtde_io.RTDEIOInterface("127.0.0.1")  # a control loop with a recipe for each kind of input
for turn in range(5):
    assert io.setInputDoubleRegister(18, turn / 4) and io.setInputIntRegister(19, turn)
assert io.setSpeedSlider(0.5)
time.sleep(0.1)
print(r.getTargetSpeedFraction())
dashboard = dashboard_client.DashboardClient("127.0.0.1")
dashboard.connect()
print(dashboard.isInRemoteControl())
"""  # in a process of its own, since it holds Python's lock while it waits for an answer


def test_ur_rtde_reads_writes_and_records_the_emulator_and_agrees_with_our_client(tmp_path):
    pytest.importorskip("rtde_receive", reason="ur-rtde has wheels for some platforms only")
    others = ("output_int_register_24", "output_int_register_25", "tcp_offset")
    names = [name for name in robot.OUTPUTS if name not in others]
    with Emulator(rtde=30004, dashboard=29999) as emulator:  # the ports that ur-rtde knows
        emulator.faults.safety_mode, emulator.faults.safety_status_bits = 2, 0b10
        ours = RTDE("127.0.0.1", 30004)
        v = ours.state().values
        ours.close()
        command = [sys.executable, "-c", UR_RTDE, json.dumps(names)]
        done = subprocess.run(
            command, capture_output=True, check=True, timeout=20, text=True, cwd=tmp_path
        )
        read, slider, remote = done.stdout.splitlines()
        inputs = emulator.inputs
    theirs = json.loads(read)
    assert set(theirs) == set(names) and v["safety_mode"] == 2
    assert 0 <= theirs.pop("timestamp") - v["timestamp"] < 10
    for name, value in theirs.items():
        np.testing.assert_allclose(value, v[name], err_msg=name)
    recorded = (tmp_path / "recorded.csv").read_text().splitlines()
    assert len(recorded) > 10 and float(recorded[-1].split(",")[1]) == emulator.payload
    assert (inputs["input_double_register_18"], inputs["input_int_register_19"]) == (1.0, 4)
    assert (float(slider), remote) == (0.5, "True")


def raw(emulator, *packages):
    """The answers of the emulator to packages (type, payload), as (type, payload)."""
    with socket.create_connection(("127.0.0.1", emulator.ports["rtde"])) as connection:
        connection.settimeout(2)
        for kind, payload in packages:
            size = 3 + len(payload) if kind != "0" else 0
            connection.sendall(struct.pack(">HB", size, ord(kind.replace("0", "V"))) + payload)
        connection.shutdown(socket.SHUT_WR)
        received = b""
        with contextlib.suppress(ConnectionResetError):
            while len(received) < 1000 and (part := connection.recv(4096)):
                received += part
    answers = []
    while received:
        (size,) = struct.unpack_from(">H", received)
        answers.append((chr(received[2]), received[3:size]))
        received = received[size:]
    return answers


@pytest.mark.parametrize(
    "packages, answers",
    [
        ([("V", b"\0\1")], [("V", b"\0")]),
        ([("S", b"")], [("S", b"\0")]),  # nothing to send
        ([("O", struct.pack(">d", 0) + b"payload")], [("O", b"\0DOUBLE")]),
        ([("O", struct.pack(">d", 9) + b"no"), ("S", b"")], [("O", b"\0NOT_FOUND"), ("S", b"\0")]),
        (
            [("I", b"input_int_register_0"), ("I", b"speed_slider_mask")],
            [("I", b"\1INT32"), ("I", b"\2UINT32")],
        ),
        ([("I", b"input_int_register_0"), ("U", b"\2\0\0\0\1")], [("I", b"\1INT32"), ("M", None)]),
        ([("0", b"")], [("M", None)]),
        ([("Z", b"")], [("M", None)]),
    ],
)
def test_the_emulator_is_as_strict_as_the_controller(emulator, packages, answers):
    found = raw(emulator, *packages)
    assert [kind for kind, _ in found] == [kind for kind, _ in answers]
    assert all(payload in (None, got) for (_, payload), (_, got) in zip(answers, found))


def test_the_program_of_a_client_that_does_not_read_is_discarded(emulator, settings):
    program = "def other():\n  sleep(9)\nend\n"
    with socket.create_connection(("127.0.0.1", settings.script_port)) as connection:
        time.sleep(0.05)  # the controller has said something
        connection.sendall(program.encode())
    time.sleep(0.2)
    assert emulator.programs == []
    robot.upload("127.0.0.1", settings.script_port, program)
    time.sleep(0.2)
    assert emulator.programs == [program]


# ---- Geometry ------------------------------------------------------------------------------------


def test_relative_actions_compose_and_differ_consistently():
    rng = np.random.default_rng(0)
    for _ in range(50):
        pose, action = rng.normal(size=6), rng.normal(size=6) * 0.3
        np.testing.assert_allclose(
            robot.difference(pose, robot.compose(pose, action)), action, atol=1e-12
        )
        turned = (
            Rotation.from_rotvec(action[3:]).as_matrix()
            @ Rotation.from_rotvec(pose[3:]).as_matrix()
        )
        np.testing.assert_allclose(
            Rotation.from_rotvec(robot.compose(pose, action)[3:]).as_matrix(), turned, atol=1e-12
        )


def test_rotations_compose_as_scipys_do_near_0_and_near_pi_too():
    rng = np.random.default_rng(0)
    for size in (0.0, 1e-12, 1e-6, 1.0, np.pi - 1e-9, np.pi):
        for _ in range(20):
            first, second = rng.normal(size=(2, 3))
            first *= size / np.linalg.norm(first)
            theirs = Rotation.from_rotvec(second) * Rotation.from_rotvec(first)
            for both in (geometry.rotate(first, second), turned(first, second)):
                assert (Rotation.from_rotvec(both) * theirs.inv()).magnitude() < 1e-9
                assert np.linalg.norm(both) < np.pi + 1e-12


def test_interpolation_is_straight_and_scipys_slerp():
    rng = np.random.default_rng(1)
    for _ in range(20):
        pose, target = rng.normal(size=6), rng.normal(size=6)
        step = robot.difference(pose, target)
        share = 0.3
        reached = robot.toward(pose, target, share * robot.lengths(step))
        np.testing.assert_allclose(reached[:3], pose[:3] + share * (target - pose)[:3])
        slerp = Slerp([0, 1], Rotation.from_rotvec([pose[3:], target[3:]]))
        np.testing.assert_allclose(
            (Rotation.from_rotvec(reached[3:]) * slerp(share).inv()).magnitude(), 0, atol=1e-7
        )
    np.testing.assert_allclose(robot.toward(pose, target, np.array([100, 100]))[:3], target[:3])
    assert robot.toward(pose, pose, np.array([0.1, 0.1])) == pytest.approx(pose)


# ---- Motion --------------------------------------------------------------------------------------


def test_a_tool_that_points_down_arrives_although_its_rotation_vector_may_flip():
    settings = Settings(**BOXES, max_speed_rad_s=2.0, max_lag_rad=0.4)
    for angle in np.linspace(0, 6, 60)[[0, 3, 13, 33, 47]]:  # where vectors that are compared fail
        down = np.array([-0.2, -0.5, 0.3, np.pi * np.cos(angle), np.pi * np.sin(angle), 0.0])
        start = robot.compose(down, np.array([0.01, 0.0, 0.0, 0.1, -0.1, 0.05]))
        with simulated_arm(settings, start) as arm:
            arm.servo.go(down)
            assert robot.distance(arm.pose, down).max() < 5e-3


@pytest.mark.parametrize("seed", [0, 1, 59, 74])
def test_every_pose_in_the_box_is_reached_in_the_time_that_the_way_needs(seed):
    """Of these two end where a rotation vector flips its sign."""
    seconds, needed = fuzz_pose(seed)
    assert needed <= seconds <= needed + 1


def test_a_servo_that_does_not_arrive_is_stopped_and_holds_nothing_for_ever(monkeypatch):
    monkeypatch.setattr(Servo, "REACHED", -1.0)  # it can never be near enough
    with simulated_arm(Settings(**BOXES), np.array(START_POSE)) as arm:
        with pytest.raises(RobotError, match="is not reached"):
            arm.servo.go(robot.compose(np.array(START_POSE), np.full(6, 0.01)))
        assert arm.stopped


def test_a_target_that_is_never_reached_does_not_keep_an_arm_from_being_held_too_long(monkeypatch):
    monkeypatch.setattr(Servo, "REACHED", -1.0)
    with simulated_arm(Settings(**BOXES, max_hold_s=0.5), np.array(START_POSE)) as arm:
        arm.servo.follow(steps(dx=0.03, drz=0.02))
        arm.sleep(1.2)  # 0.8 s, and longer for a step that is faster than the arm may go
        with pytest.raises(RobotError, match=r"no new actions for 0\.5 s"):
            arm.sleep(1.5)
        expected = np.array(START_POSE)
        for action in steps(dx=0.03, drz=0.02):
            expected = robot.compose(expected, action)
        assert robot.distance(arm.pose, expected).max() < 1e-3


def test_a_corner_of_the_box_that_was_rounded_to_float32_can_be_gone_to():
    high = np.array([0.2, -0.2, 0.6])
    recorded = np.append(high.astype(np.float32).astype(float), START_POSE[3:])
    assert (recorded[:3] > high).any()
    with simulated_arm(Settings(**BOXES), np.array([0.19, -0.21, 0.59, *START_POSE[3:]])) as arm:
        arm.servo.go(recorded)
    for change, message in (
        ([1e-5, 0, 0, 0, 0, 0], "outside its box"),
        ([np.nan, 0, 0, 0, 0, 0], "not finite"),
        ([0, 0, 0, 0, 0, np.nan], "not finite"),
    ):
        with simulated_arm(Settings(**BOXES), np.array(START_POSE)) as arm:
            with pytest.raises(RobotError, match=message):
                arm.servo.go(recorded + np.array(change))
            assert arm.stopped


def test_the_same_tcp_is_the_same_whatever_its_rotation_vector():
    down = [0.0, 0.0, 0.17, 0.0, 3.1416, 0.0]
    assert robot.same_tcp(down, [0.0, 0.0, 0.17005, 0.0, -3.1416, 0.0])
    assert not robot.same_tcp(down, [0.0, 0.0, 0.171, 0.0, 3.1416, 0.0])
    for other in (None, [0.0], "no list", [None] * 6):
        assert not robot.same_tcp(other, down)


def test_of_the_two_vectors_of_a_rotation_the_nearer_is_taken():
    down = np.array([0.0, np.pi, 0.0])
    for rotvec in np.random.default_rng(0).normal(size=(50, 3)) * 2:
        near = robot.nearer(rotvec, down)
        assert np.allclose(
            Rotation.from_rotvec(near).as_matrix(), Rotation.from_rotvec(rotvec).as_matrix()
        )
    before, after = (
        Rotation.from_euler("y", angle).as_rotvec() for angle in (np.pi - 0.01, np.pi + 0.01)
    )
    assert np.linalg.norm(before - after) > 6  # where scipy, as the controller, jumps
    np.testing.assert_allclose(
        robot.nearer(after, down) - robot.nearer(before, down), [0, 0.02, 0], atol=1e-9
    )
    assert robot.nearer(np.zeros(3), down).tolist() == [0, 0, 0]


def frames_of_a_yawed_tool(settings, wobble=0.01):
    """Frames of a tool that points down, yawed by half a turn from the reference: 20 a second."""
    rng, reference = np.random.default_rng(0), np.array(settings.rotation_near_rad)
    frames = []
    for i in range(200):
        turn = Rotation.from_rotvec(rng.normal(scale=wobble, size=3))
        rotvec = (turn * Rotation.from_rotvec([np.pi, 0.0, 0.0])).as_rotvec()
        state = np.array([*START_POSE[:3], *robot.nearer(rotvec, reference), 0.0], np.float32)
        frames.append(robot.Frame(time=i / 20, points=None, seen=0, state=state))
    return frames


def test_a_recorded_rotation_vector_does_not_flip_unseen(settings):
    settings = replace(settings, policy_hz=20)
    frames = frames_of_a_yawed_tool(settings)
    with pytest.raises(RobotError, match=r"vector flips: write .* to rotation_near_rad") as flips:
        robot.episode_actions(frames, [0.0] * 200, settings)
    advised = json.loads(str(flips.value).split(", ", 1)[1])
    settings = replace(settings, rotation_near_rad=advised)
    frames = frames_of_a_yawed_tool(settings)
    assert len(robot.episode_actions(frames, [0.0] * 200, settings)) == 200
    states = np.array([frame.state for frame in frames])
    assert np.linalg.norm(np.diff(states[:, 3:6], axis=0), axis=1).max() < 0.2


def test_a_chunk_moves_the_arm_to_where_its_actions_add_up(emulator, settings):
    with Moving(settings) as servo:
        servo.follow(steps(dx=0.01, drz=0.01))
        time.sleep(1.1)
        servo.check()
        expected = np.array(START_POSE)
        for action in steps(dx=0.01, drz=0.01):
            expected = robot.compose(expected, action)
        np.testing.assert_allclose(servo.pose, expected, atol=1e-6)
        np.testing.assert_allclose(emulator.pose, expected, atol=2e-3)
    assert_stop_is_last(emulator)


def test_the_actual_pose_is_there_before_the_program_starts_and_speeds_stay_in_their_limits(
    emulator, settings
):
    emulator.pose = [-0.1, -0.5, 0.4, 0.1, 2.9, 0.1]
    fast = replace(settings, max_speed_m_s=0.1, max_speed_rad_s=0.05)
    with Moving(fast) as servo:
        servo.follow(steps(dx=-0.04, drx=0.1))
        time.sleep(0.8)
    poses = [
        np.array([f[f"input_double_register_{24 + i}"] for i in range(6)])
        for _, f in emulator.received
    ]
    np.testing.assert_allclose(poses[0], [-0.1, -0.5, 0.4, 0.1, 2.9, 0.1])
    moved = np.array([robot.difference(a, b) for a, b in pairwise(poses)])
    assert np.linalg.norm(moved[:, :3], axis=1).max() <= 0.1 / 125 + 1e-9
    assert np.linalg.norm(moved[:, 3:], axis=1).max() <= 0.05 / 125 + 1e-9
    assert np.linalg.norm(moved[:, :3], axis=1).sum() > 0.05  # and it did move


@pytest.mark.parametrize(
    "actions, message",
    [
        (np.full((8, 7), np.nan), "not finite"),
        (np.zeros((8, 4)), r"shape \(8, 4\)"),
        (np.zeros((0, 7)), r"shape \(0, 7\)"),
        (np.zeros(7), r"shape \(7,\)"),
        (steps(dx=0.2), "jumps by 0.200 m"),
        (steps(drx=0.5), "0.500 rad"),
        (steps(dz=-0.04), "outside its box"),
    ],
)
def test_a_bad_action_stops_the_arm(emulator, settings, actions, message):
    with Moving(settings) as servo:
        servo.follow(STILL)
        before = list(emulator.pose)
        with pytest.raises(RobotError, match=message):
            servo.follow(actions)
        with pytest.raises(RobotError, match=message):  # and never goes on
            servo.follow(STILL)
        time.sleep(0.1)
        np.testing.assert_allclose(emulator.pose, before, atol=1e-3)
    assert_stop_is_last(emulator)


def test_a_target_outside_the_box_is_clamped_if_asked(emulator, settings):
    emulator.pose[2] = 0.08
    with Moving(replace(settings, outside_box="clamp")) as servo:
        servo.go(np.array([*START_POSE[:2], 0.07, *START_POSE[3:]]))
        servo.follow(steps(dz=-0.04))
        time.sleep(0.3)
        servo.check()
        heights = [pose["input_double_register_26"] for _, pose in emulator.received]
        assert servo.clamped and 0.05 <= min(heights) < 0.051
        with pytest.raises(RobotError, match=r"jumps by 0\.400 m"):  # though clamped it is none
            servo.follow(steps(dz=-0.4))
    assert_stop_is_last(emulator)


@pytest.mark.parametrize(
    "fault, message",
    [
        ({"silent": True}, "no newer one has arrived: look for the network or the controller"),
        ({"drop": True}, "connection"),
        ({"garbage": True}, "framing lost"),
        ({"safety_mode": 3, "safety_status_bits": 0b100}, "safety: protective stop"),
        ({"safety_status_bits": 1 << 7}, "safety"),
        ({"robot_mode": 5}, "not running"),
        ({"lose_program": True}, "the controller said: program ended: no inverse kinematics"),
        ({"deaf": True}, "the program on the controller has ended"),  # its watchdog
        ({"slider": 0.5}, "the speed slider is at 50%"),
        ({"scaling": 0.01}, "slowed down"),
        ({"torn": True}, "our program stands still"),  # no pose is read whole
        ({"backward": True}, "the controller's clock runs backwards"),
        ({"paused": True}, "is paused"),
        ({"blocked": True}, "m, 0.000 rad behind: blocked"),
        ({"frozen": True}, "the controller's clock stands still"),
    ],
)
def test_trouble_with_the_controller_stops_the_arm_for_good(emulator, settings, fault, message):
    with Moving(replace(settings, max_hold_s=10)) as servo:
        servo.follow(steps(dx=0.005))
        time.sleep(0.05)
        for name, value in fault.items():
            setattr(emulator.faults, name, value)
        assert message in stops(servo)
        emulator.faults = type(emulator.faults)()  # all is well again, but the arm stays stopped
        with pytest.raises(RobotError, match=message):
            servo.follow(STILL)
        time.sleep(0.05)
        commands = [fields["input_int_register_24"] for _, fields in emulator.received]
        assert robot.STOP not in commands[:-1]  # nothing comes after it
    assert_within_limits(emulator, settings)
    assert not any(
        line.startswith(("unlock", "power", "brake", "play")) for line in emulator.dashboard_lines
    )
    if not {"drop", "garbage"} & set(fault):
        last, stop = (fields for _, fields in emulator.received[-2:])
        assert stop["input_int_register_24"] == robot.STOP
        same = [name for name in stop if "double" in name]
        assert [stop[name] for name in same] == [last[name] for name in same]  # no new pose


def test_a_late_policy_holds_the_arm_then_stops_it(emulator, settings):
    with Moving(settings) as servo:
        servo.follow(steps(n=2, dx=0.01))
        time.sleep(0.5)
        servo.check()  # it holds
        held = list(emulator.pose)
        assert "no new actions for 0.5 s" in stops(servo)
        np.testing.assert_allclose(emulator.pose, held, atol=1e-3)
    assert_stop_is_last(emulator)


def test_a_robot_in_trouble_is_not_moved_at_all(emulator, settings, monkeypatch):
    def assert_refused(problem):
        with pytest.raises(RobotError, match=problem):
            Moving(settings).__enter__()
        deadline = time.monotonic() + 10
        while emulator.owners and time.monotonic() < deadline:
            time.sleep(0.01)
        assert not emulator.owners  # it has noticed that the connection ended

    emulator.faults.safety_mode = 3
    assert_refused("protective stop")
    assert emulator.received == []
    emulator.faults.safety_mode, emulator.faults.no_program = 1, True
    monkeypatch.setattr(Servo, "PATIENCE", 0.3)
    assert_refused("has not started within")
    (program,) = emulator.programs
    assert "servoj(get_inverse_kin(pose, get_actual_joint_positions()), t=0.0080, " in program
    emulator.faults.no_program = False
    emulator.pose[0] = 0.25
    time.sleep(0.05)
    assert_refused(r"outside its box, at 0\.250, -0\.550")
    emulator.pose[0] = float("nan")
    time.sleep(0.05)
    assert_refused("not finite")


# ---- Dangers: nothing jumps, nothing stays free, nobody else's program is taken for ours ---------


def assert_within_limits(emulator, settings):
    """The arm has never been faster than allowed."""
    assert emulator.fastest[0] <= settings.max_speed_m_s
    assert emulator.fastest[1] <= settings.max_speed_rad_s


def test_a_program_is_fed_while_its_port_has_not_answered(emulator, settings):
    emulator.faults.mute = 0.4  # five times as long as the watchdog waits
    with Moving(settings) as servo:
        servo.follow(STILL)
        time.sleep(0.1)
        servo.check()
    assert emulator.ends == ["finished"]


def test_an_arm_that_was_moved_before_the_start_does_not_jump_back(emulator, settings):
    moving = Moving(settings)
    moving.rtde = connect(settings)
    moving.servo = Servo(moving.rtde, settings)  # as `run`, before the gripper initializes
    emulator.pose[1] += 0.12
    time.sleep(0.05)
    moving.servo.start("127.0.0.1")
    moving.servo.follow(steps(dx=0.01))
    time.sleep(0.3)
    moving.servo.check()
    moving.__exit__()
    assert_within_limits(emulator, settings)
    assert emulator.pose[1] == pytest.approx(START_POSE[1] + 0.12, abs=1e-3)


@pytest.mark.parametrize("fault", [{"blocked": True}, {"scaling": 0.01}])
def test_an_arm_that_was_held_back_does_not_leap_when_it_goes_on(emulator, settings, fault):
    with Moving(replace(settings, max_hold_s=10)) as servo:
        for actions, seconds in ((steps(drz=0.0125), 0.3), (steps(dx=0.024, drz=0.015), 0.5)):
            servo.check()  # for a short time it is held back only
            servo.follow(actions)
            time.sleep(0.2)
            for name, value in fault.items():
                setattr(emulator.faults, name, value)
            time.sleep(seconds)
            emulator.faults = type(emulator.faults)()
            time.sleep(0.1)
        assert servo.error is not None  # it was long enough at last
    assert_within_limits(emulator, settings)
    assert emulator.fastest[0] > 0.5 * settings.max_speed_m_s


def test_an_arm_that_was_paused_does_not_leap_when_it_goes_on(emulator, settings):
    with Moving(replace(settings, max_hold_s=10)) as servo:
        servo.follow(steps(dx=0.024, drz=0.015))
        time.sleep(0.2)
        emulator.faults.paused = True
        assert "is paused" in stops(servo)
        emulator.faults.paused = False
        time.sleep(0.2)
    assert_within_limits(emulator, settings)


def test_a_program_that_is_not_ours_is_not_followed_by_more_targets(
    emulator, settings, monkeypatch
):
    with Moving(replace(settings, max_hold_s=10)) as servo:
        servo.follow(steps(dx=0.005))
        time.sleep(0.1)
        program = "def other():\n  sleep(9)\nend\n"
        robot.upload("127.0.0.1", settings.script_port, program)
        while program not in emulator.programs:
            time.sleep(0.01)
        count = len(emulator.received)
        assert "our program stands still" in stops(servo)
        assert len(emulator.received) - count < settings.servo_hz
    # It is not replaced either: whoever started it may count on it.
    with pytest.raises(RobotError, match="another program runs there"):
        Moving(settings).__enter__()
    with emulator.lock:
        emulator.end_program("finished")
    # What a killed process left in the registers is not taken for a program of ours.
    emulator.faults.no_program = True
    emulator.outputs["output_int_register_24"] = 1
    monkeypatch.setattr(Servo, "PATIENCE", 0.3)
    with pytest.raises(RobotError, match="has not started within"):
        Moving(settings).__enter__()


@pytest.mark.parametrize("where", [(0.43, -0.55, 0.3), (-0.2, -0.55, 0.82)])
def test_an_arm_that_begins_outside_the_box_is_not_pulled_inside(emulator, settings, where):
    emulator.pose[:3] = where
    with pytest.raises(RobotError, match="outside its box"):
        Moving(replace(settings, outside_box="clamp")).__enter__()
    assert emulator.told == [] and emulator.pose[:3] == list(where)


def test_the_rotation_vector_does_not_flip_for_a_tool_that_points_down(emulator, settings):
    emulator.pose = [*START_POSE[:3], 0.0, np.pi - 0.02, 0.0]
    with Moving(replace(settings, max_speed_rad_s=1.0)) as servo:
        servo.follow(steps(dry=0.02))
        time.sleep(0.6)
        servo.check()
    sent = [
        np.array([f[f"input_double_register_{27 + i}"] for i in range(3)])
        for _, f in emulator.received
    ]
    assert max(np.linalg.norm(b - a) for a, b in pairwise(sent)) < 0.1
    assert np.linalg.norm(sent[-1]) > np.pi


def test_the_program_follows_no_pose_of_which_it_has_read_only_half(emulator, settings):
    with Moving(replace(settings, max_hold_s=10)) as servo:
        servo.follow(steps(dx=0.01, drz=0.01))
        for _ in range(5):
            time.sleep(0.03)
            emulator.faults.torn = not emulator.faults.torn
    names = [f"input_double_register_{24 + i}" for i in range(6)]
    sent = {tuple(fields[name] for name in names) for _, fields in emulator.received}
    assert len(set(emulator.told)) > 5 and set(emulator.told) <= sent


def test_braking_is_not_cut_short_by_the_watchdog(emulator, settings):
    with Moving(settings) as servo:
        servo.follow(steps(dx=0.02))
        time.sleep(0.3)
    assert emulator.ends == ["finished"]


@pytest.mark.parametrize("free", [False, True])
def test_the_program_is_this_text(settings, free):
    """Each line of it keeps the arm from something: change it here, and say why."""
    servo = "servoj(get_inverse_kin(pose, get_actual_joint_positions()), t=0.0080, "
    servo += "lookahead_time=0.100, gain=300)"
    reads = ", ".join(f"read_input_float_register({n})" for n in (24, 25, 26, 27, 28, 29))
    lines = f"""def dami():
  rtde_set_watchdog("input_int_register_24", 12.5, "stop")
  write_output_integer_register(25, 0)
  write_output_integer_register(24, 7)
  {"freedrive_mode" if free else "sync"}()
  while read_input_integer_register(24) == 7:
    number = read_input_integer_register(26)
    pose = p[{reads}]
    if number == read_input_integer_register(25):
      write_output_integer_register(25, number)
      {"sync()" if free else servo}
    else:
      sync()
    end
  end
  rtde_set_watchdog("input_int_register_24", 0.1, "ignore")
  {"end_freedrive_mode" if free else "sync"}()
  stopj(2.0)
  write_output_integer_register(24, 0)
end
"""
    assert robot.program(7, settings, free) == lines


def test_states_that_come_later_and_later_stop_the_arm(emulator, settings):
    with Moving(replace(settings, max_hold_s=10)) as servo:
        servo.error = "ended by the test"
        servo.thread.join()
        servo.least_delay = math.inf  # the first state below is the promptest
        state, now = servo.rtde.state(), time.monotonic()
        with pytest.raises(RobotError, match="later than at first"):
            for tick in range(200):  # each package is delayed by 2 ms more than the one before
                values = state.values.copy()
                values["timestamp"] += 0.008 * tick
                values["output_int_register_25"] += tick
                servo.check_state(state._replace(values=values), now + 0.010 * tick)
        assert 0.25 < 0.002 * tick < 0.3


@pytest.mark.parametrize(
    "computed, activity, culprit",
    [
        (0.10, "sampling the cloud", "it kept Python's lock, or all processors"),
        (0.01, "sampling the cloud", "other programs had the processors"),
        (0.01, robot.WRITING, "the disk is slow"),
    ],
)
def test_a_state_that_is_late_since_the_computer_is_busy_says_with_what(
    computed, activity, culprit
):
    with simulated_arm(Settings(**BOXES), np.array(START_POSE)) as arm:
        arm.computed = 5.0
        arm.servo.step()
        with arm.servo.activity.during("reading the camera"):
            arm.now += 0.01
        with arm.servo.activity.during(activity):
            arm.now += 0.09
        arm.now += 0.006
        arm.computed += computed
        arm.stale = robot.StaleState("the newest state is 0.106 s old", arrived=True)
        with pytest.raises(RobotError) as caught:
            arm.servo.step()
        arm.stale, arm.runs = None, False
        with pytest.raises(RobotError) as ended:
            arm.servo.step()
    message = str(caught.value)
    assert message.startswith("the newest state is 0.106 s old, but newer ones have arrived")
    stall = message.partition("arrived")[2]
    assert str(ended.value) == f"the program on the controller has ended, or is paused{stall}"
    assert f"For 0.106 s the stream stood still, in which this program computed for {computed:.3f}"
    assert f"longest at {activity}, 0.090 s: {culprit}" in message


def test_what_the_main_thread_is_at_counts_too_and_what_is_long_ago_does_not(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(robot, "time", SimpleNamespace(monotonic=lambda: now[0]))
    activity = robot.Activity()
    assert activity.longest(0.0, 1.0) == ("waiting", 1.0)
    with activity.during("long ago"):
        now[0] = 5.0
    with activity.during("computing actions"):
        now[0] = 5.5
        assert activity.longest(4.9, 5.5) == ("computing actions", 0.5)


def test_a_late_state_that_has_arrived_is_told_from_one_that_has_not(emulator, settings):
    rtde = connect(settings, write=False)
    rtde.state(0.5)
    rtde.package = lambda: time.sleep(0.5) or ("?", b"")  # the reader's thread gets no turn
    time.sleep(0.2)
    with pytest.raises(robot.StaleState, match="the newest state is") as caught:
        rtde.state(0.05)
    assert caught.value.arrived
    rtde.close()
    rtde = connect(settings, write=False)
    rtde.state(0.5)
    emulator.faults.silent = True
    time.sleep(0.2)
    with pytest.raises(robot.StaleState) as caught:
        rtde.state(0.05)
    assert not caught.value.arrived
    rtde.close()


def test_a_program_that_does_not_end_is_told(emulator, settings, capsys):
    with Moving(settings):
        emulator.faults.paused = True
        emulator.inputs["input_int_register_24"] = -1
        emulator.take = lambda values: None  # what is sent now is lost
        emulator.faults.paused = False
        emulator.run_program = lambda: None
    assert "does not end: stop it by hand" in capsys.readouterr().err


def test_no_script_of_faults_makes_the_arm_faster_than_allowed():
    moved = 0
    for seed in range(4):
        fastest, limits, _ = fuzz_robot(seed)
        assert fastest[0] <= limits[0] and fastest[1] <= limits[1]
        moved += max(fastest) > 0
    assert moved >= 2  # an arm that does not move is never too fast


def test_inference_does_not_hold_up_the_stream(emulator, settings):
    with Moving(replace(settings, max_hold_s=5)) as servo:
        a = torch.randn(600, 600)
        until = time.monotonic() + 0.6
        while time.monotonic() < until:
            a = torch.tanh(a @ a)
        servo.check()
        times = np.array([when for when, _ in emulator.received])
    assert (
        len(times) > 30 and np.diff(times).max() < 0.1
    )  # the watchdog's limit is 0.08 s on average


# ---- Gripper -------------------------------------------------------------------------------------


def test_the_gripper_initializes_moves_and_tells_where_it_is(emulator, settings):
    gripper = Gripper(settings, "127.0.0.1")
    gripper.initialize()
    assert emulator.registers[0x0200] == 1 and emulator.registers[0x0101] == 30
    gripper.move(1.0)
    gripper.move(0.999)  # hardly a change: nothing is sent
    time.sleep(0.8)
    assert gripper.read() == pytest.approx(1.0, abs=0.01)
    assert [frame[:6].hex() for frame in emulator.gripper_frames].count("010601030000") == 1
    gripper.close()


def test_an_adapter_that_is_pulled_out_is_a_gripper_that_fails(emulator, settings):
    termios = pytest.importorskip("termios")

    def pulled_out():
        raise termios.error(5, "Input/output error")

    gripper = Gripper(settings, "127.0.0.1")
    gripper.port = SimpleNamespace(reset_input_buffer=pulled_out)  # as pyserial's does
    with pytest.raises(RobotError, match=r"the gripper at .*Input/output error"):
        gripper.read()
    gripper.close()


def test_a_serial_port_of_the_gripper_belongs_to_one_command(settings, monkeypatch):
    held = set()

    def serial(port, baud, timeout, exclusive=False):
        """As pyserial does it on POSIX systems."""
        if exclusive and port in held:
            raise OSError(f"Could not exclusively lock port {port}")
        held.add(port)
        return SimpleNamespace(close=lambda: held.remove(port))

    monkeypatch.setitem(sys.modules, "serial", SimpleNamespace(Serial=serial))
    settings = replace(settings, gripper_serial="/dev/ttyUSB0")
    first = Gripper(settings, "127.0.0.1")
    with pytest.raises(RobotError, match=r"/dev/ttyUSB0 cannot be reached: .*exclusively"):
        Gripper(settings, "127.0.0.1")
    first.close()
    Gripper(settings, "127.0.0.1").close()


def test_a_late_answer_is_not_taken_for_the_next_one(emulator, settings):
    gripper = Gripper(settings, "127.0.0.1", timeout=0.1)
    gripper.initialize()
    emulator.faults.gripper_late = [0.12, 0.05, 0.05]
    assert gripper.exchange(robot.READ, robot.INITIALIZED, 1) == 1
    assert gripper.read() == 0.0
    gripper.close()


def test_another_address_and_a_gripper_that_opens_the_other_way_are_settings(emulator, settings):
    emulator.slave = 9
    other = replace(settings, gripper_slave=9, gripper_open_at=0)
    gripper = Gripper(other, "127.0.0.1", timeout=0.1)
    assert gripper.read() == pytest.approx(1.0)
    gripper.move(0.0)
    assert emulator.registers[0x0103] == 0
    gripper.close()


def test_the_check_sum_is_modbus():
    assert robot.crc16(bytes.fromhex("010300000001")).hex() == "840a"
    assert robot.crc16(bytes.fromhex("0106010303e8")).hex() == "7888"  # pymodbus says so, too


@pytest.mark.parametrize(
    "fault, message",
    [("bad_crc", "bad check sum"), ("silent", "no answer"), ("exception", "unknown register")],
)
def test_a_faulty_answer_of_the_gripper_is_retried_three_times(emulator, settings, fault, message):
    gripper = Gripper(settings, "127.0.0.1", timeout=0.1)
    setattr(emulator.faults, f"gripper_{fault}", 2)
    assert gripper.read() == pytest.approx(0.0)
    setattr(emulator.faults, f"gripper_{fault}", 3)
    with pytest.raises(RobotError, match=f"{message}, 3 times"):
        gripper.read()
    gripper.close()


def test_pymodbus_understands_our_frames():
    server = pytest.importorskip("pymodbus.server")
    from pymodbus.datastore import (
        ModbusDeviceContext,
        ModbusSequentialDataBlock,
        ModbusServerContext,
    )
    from pymodbus.framer import FramerType

    block = ModbusSequentialDataBlock(1, [0] * 0x300)
    context = ModbusServerContext(ModbusDeviceContext(hr=block), single=True)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    loop = asyncio.new_event_loop()
    started = threading.Event()

    async def serve():
        modbus = server.ModbusTcpServer(context, framer=FramerType.RTU, address=("127.0.0.1", port))
        await modbus.serve_forever(background=True)
        started.set()
        await stop.wait()
        await modbus.shutdown()

    stop = asyncio.Event()
    thread = threading.Thread(target=lambda: loop.run_until_complete(serve()), daemon=True)
    thread.start()
    assert started.wait(5)
    gripper = Gripper(Settings(**BOXES, gripper_port=port), "127.0.0.1", timeout=1.0)
    gripper.move(0.25)
    assert gripper.exchange(robot.READ, robot.POSITION, 1) == 750
    with pytest.raises(RobotError, match="unknown register"):
        gripper.exchange(robot.READ, 0x4000, 1)
    gripper.close()
    loop.call_soon_threadsafe(stop.set)
    thread.join(5)


# ---- Camera --------------------------------------------------------------------------------------


def test_depth_becomes_the_points_of_the_analytic_scene(tmp_path):
    write_scene(tmp_path / "scene.npz")
    camera = robot.RecordedCamera(tmp_path / "scene.npz")
    points, seen = robot.cloud(camera.read(), camera.intrinsics, Settings(**BOXES, num_points=400))
    assert 12000 < seen < 120 * 160
    assert points.shape == (400, 3) and points.dtype == np.float32
    table, top = abs(points[:, 2]) < 2e-3, abs(points[:, 2] - 0.05) < 2e-3
    assert (table | top).all() and top.sum() > 3
    assert (
        abs(points[top, :2] - (-0.2, -0.55)).max() < 0.03
    )  # the cube lies below the camera in the first frame


def test_missing_depth_and_an_empty_crop_are_refused_and_few_points_repeated():
    settings, intrinsics = Settings(**BOXES, num_points=100), (100, 100, 2, 2)
    with pytest.raises(RobotError, match="depth is empty"):
        robot.cloud(np.zeros((4, 4), np.float32), intrinsics, settings)
    with pytest.raises(RobotError, match="crop box"):
        robot.cloud(np.full((4, 4), 3.0, np.float32), intrinsics, settings)
    depth = np.zeros((4, 4), np.float32)
    depth[1, 1] = depth[2, 3] = 0.9
    depth[3, 3] = np.nan
    points, seen = robot.cloud(depth, intrinsics, settings)
    assert seen == 2
    assert points.shape == (100, 3) and len(np.unique(points, axis=0)) == 2


def test_a_large_depth_image_is_thinned_out_before_it_is_sampled(monkeypatch):
    sizes, sample = [], data.farthest_point_sample
    monkeypatch.setattr(
        data,
        "farthest_point_sample",
        lambda points, n: sizes.append(len(points)) or sample(points, n),
    )
    rows, columns = np.mgrid[:480, :640]
    depth = (0.7 + 0.0002 * rows + 0.0001 * columns).astype(np.float32)
    settings = Settings(**BOXES | {"camera_to_base": CAMERA_TO_BASE}, num_points=256)
    points, _ = robot.cloud(depth, (600.0, 600.0, 320.0, 240.0), settings)
    everything, _ = robot.cloud(depth[::8, ::8], (75.0, 75.0, 40.0, 30.0), settings)
    assert sizes[0] <= geometry.SAMPLED_FROM < depth.size
    np.testing.assert_allclose(points.min(0), everything.min(0), atol=0.02)
    np.testing.assert_allclose(points.max(0), everything.max(0), atol=0.02)


def test_the_librealsense_library_delivers_synthetic_depth():
    libusb_package = pytest.importorskip(
        "libusb_package"
    )  # librealsense needs it, and not every machine has it
    ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    rs = pytest.importorskip("pyrealsense2")
    width, height, unit = 64, 48, 0.001
    device = rs.software_device()
    sensor = device.add_sensor("Depth")
    intrinsics = rs.intrinsics()
    (
        intrinsics.width,
        intrinsics.height,
        intrinsics.fx,
        intrinsics.fy,
        intrinsics.ppx,
        intrinsics.ppy,
    ) = (64, 48, 50, 52, 32, 24)
    stream = rs.video_stream()
    stream.type, stream.index, stream.uid, stream.width, stream.height = (
        rs.stream.depth,
        0,
        0,
        width,
        height,
    )
    stream.fps, stream.bpp, stream.fmt, stream.intrinsics = 30, 2, rs.format.z16, intrinsics
    profile = sensor.add_video_stream(stream)
    sensor.add_read_only_option(rs.option.depth_units, unit)
    queue = rs.frame_queue(4)
    sensor.open(profile)
    sensor.start(queue)
    columns = np.mgrid[:height, :width][1]
    slope = (800 + 2 * columns).astype(np.uint16)  # millimetres
    frame = rs.software_video_frame()
    frame.pixels, frame.stride, frame.bpp, frame.timestamp, frame.frame_number = (
        slope,
        2 * width,
        2,
        0.0,
        1,
    )
    frame.domain, frame.profile, frame.depth_units = (
        rs.timestamp_domain.system_time,
        profile.as_video_stream_profile(),
        unit,
    )
    sensor.on_video_frame(frame)
    received = queue.wait_for_frame(1000).as_depth_frame()
    depth = np.asarray(received.get_data()).astype(np.float32) * unit
    ours = geometry.depth_to_points(depth, robot.realsense_intrinsics(received.profile))
    pointcloud = rs.pointcloud()
    theirs = (
        np.asarray(pointcloud.calculate(received).get_vertices()).view(np.float32).reshape(-1, 3)
    )
    np.testing.assert_allclose(ours, theirs, atol=1e-6)
    sensor.stop()
    sensor.close()


def test_frames_without_depth_are_no_traceback():
    camera = object.__new__(robot.RealSense)
    empty = type("Empty", (), {"__bool__": lambda self: False})()
    frames = type("Frames", (), {"get_depth_frame": lambda self: empty})()

    def wait(self, ms):
        time.sleep(ms / 1000)
        return True, frames

    camera.pipeline = type("Pipeline", (), {"try_wait_for_frames": wait})()
    with pytest.raises(robot.CameraError, match="no depth for a second"):
        camera.read()


# ---- Settings ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"tcp_low_m": [0.5, -0.9, 0.05]}, "must be below that of tcp_high_m"),
        ({"crop_low_m": [0, 0]}, "give 3 numbers"),
        ({"crop_low_m": [0, "0", 0]}, "give 3 numbers"),
        ({"crop_low_m": [0, True, 0]}, "give 3 numbers"),
        ({"tcp_high_m": None}, "give 3 numbers"),
        ({"tcp_low_m": [-600, -900, 50]}, "use -5"),  # millimetres
        ({"rotation_near_rad": [0, 180, 0]}, "use -5"),  # degrees
        ({"start_pose": [0, 0, 0.3]}, "give 6 numbers"),
        ({"start_pose": [-0.2, -0.5, 0.9, 0, 3, 0]}, "start_pose .*outside its box"),
        ({"camera_to_base": [[1, 0, 0, 0]] * 4}, "must be a rotation"),
        ({"camera_to_base": [[1, 0, 0, 0]] * 3}, "give 4 x 4 numbers"),
        ({"camera_to_base": [[1, 0, 0, 0], [1]] * 2}, "give 4 x 4 numbers"),
        ({"max_speed": 1.0}, "unexpected keyword argument 'max_speed'"),
        ({"max_speed_m_s": 5.0}, "max_speed_m_s .* to 1"),
        ({"max_speed_m_s": True}, "give a number"),
        ({"max_speed_m_s": "fast"}, "give a number"),
        ({"max_speed_m_s": float("nan")}, "use 0.001 to"),
        ({"max_speed_rad_s": 9}, "to 3"),  # degrees
        ({"max_step_m": 50}, "to 0.5"),
        ({"servo_hz": 5}, "servo_hz .*use 100"),  # a watchdog of 0.5 Hz
        ({"servo_gain": 5}, "100 to 2000"),
        ({"num_points": 64.0}, "give a whole number"),
        ({"num_points": True}, "give a whole number"),
        ({"servo_lookahead_s": 0.2}, "max_lag_m .*the arm lags by 0.050"),
        ({"max_speed_rad_s": 2.0}, "max_lag_rad .*the arm lags by 0.200"),
        ({"outside_box": "ignore"}, "'stop', 'clamp'"),
        ({"outside_box": ["stop"]}, "give text"),
        ({"gripper_open_at": 500}, "0, 1000"),
        ({"gripper_slave": 0}, "1 to 247"),
        ({"gripper_serial": 7}, "give text"),
    ],
)
def test_wrong_settings_are_refused_in_one_line(tmp_path, changes, message):
    path = tmp_path / "robot.json"
    path.write_text(json.dumps(BOXES | changes))
    with pytest.raises(common.UserError, match=message) as caught:
        robot.load_settings(path)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_missing_or_holds_no_settings_is_refused_in_one_line(tmp_path):
    path = tmp_path / "robot.json"
    with pytest.raises(common.UserError, match=r"cannot be read .*--config") as missing:
        robot.load_settings(path)
    assert "\n" not in str(missing.value)
    path.write_text("{")
    with pytest.raises(common.UserError, match="Expecting property name"):
        robot.load_settings(path)
    path.write_text(json.dumps({name: BOXES[name] for name in BOXES if name != "camera_to_base"}))
    with pytest.raises(common.UserError, match=r"missing 1 required .*camera_to_base"):
        robot.load_settings(path)


def test_settings_are_read_as_utf_8_whatever_the_systems_own_encoding_is(tmp_path, monkeypatch):
    path = tmp_path / "robot.json"
    text = json.dumps(BOXES | {"gripper_serial": "/dev/Übergang"}, ensure_ascii=False)
    path.write_text(text, encoding="utf-8")
    read = Path.read_text
    monkeypatch.setattr(Path, "read_text", lambda path, encoding="ascii": read(path, encoding))
    assert robot.load_settings(path).gripper_serial == "/dev/Übergang"


def test_the_example_settings_keep_the_readmes_advice_about_reach():
    path = ROOT / "assets" / "robot.json"
    settings = robot.load_settings(path)
    assert settings.servo_hz == 125 and "rotation_near_rad" in json.loads(path.read_text())
    low, high = np.array(settings.tcp_low_m), np.array(settings.tcp_high_m)
    nearest = np.zeros(2).clip(low[:2], high[:2])  # to the base's axis
    farthest = np.maximum(abs(low), abs(high))
    assert np.linalg.norm(nearest) > 0.3 and np.linalg.norm(farthest) < 1.0
    for x, z in ((0, 0.3), (-0.05, 0.25), (0.05, 0.25), (0, 0.2)):  # where the emulated hand goes
        settings.check_poses([np.array([START_POSE[0] + x, START_POSE[1], z, *START_POSE[3:]])])


# ---- Commands ------------------------------------------------------------------------------------


@pytest.fixture
def cell(emulator, tmp_path, monkeypatch):
    """A folder with robot.json and scene.npz for the emulator, and arguments that name them."""
    monkeypatch.chdir(tmp_path)
    threads = torch.get_num_threads()
    ports = {f"{name}_port": port for name, port in emulator.ports.items()}
    Path("robot.json").write_text(
        json.dumps(BOXES | ports | {"num_points": 64, "policy_hz": 20, "max_state_age_s": 0.25})
    )
    write_scene("scene.npz")
    yield ["--host", "127.0.0.1", "--camera", "scene.npz"]
    torch.set_num_threads(threads)


def is_held(emulator):
    """Whether the arm was free, and no longer is."""
    time.sleep(0.02)
    return "  freedrive_mode()" in emulator.programs[-1] and not emulator.free


def ends(argv):
    """The exit code of a command."""
    try:
        common.command_line(lambda: robot.main(argv), errors=ERRORS)
    except SystemExit as end:
        return end.code
    return 0


class Typing:
    """Types keys into stdin, each after so many seconds."""

    def __init__(self, monkeypatch, *keys):
        reading, writing = os.pipe()
        monkeypatch.setattr(sys, "stdin", os.fdopen(reading))
        self.thread = threading.Thread(target=self.type, args=(writing, keys), daemon=True)
        self.thread.start()

    def type(self, writing, keys):
        with contextlib.suppress(BrokenPipeError):  # nobody reads any more
            for seconds, key in keys:
                time.sleep(seconds)
                os.write(writing, f"{key}\n".encode())
        time.sleep(20)  # an episode that a busy machine has dropped must not be waited for
        os.close(writing)


class Script:
    """Standard input that a script has written, and closed."""

    def __init__(self, monkeypatch, text):
        reading, writing = os.pipe()
        os.write(writing, text.encode())
        os.close(writing)
        monkeypatch.setattr(sys, "stdin", os.fdopen(reading))


def test_a_script_that_has_written_its_keys_ends_the_recording(monkeypatch, capsys):
    Script(monkeypatch, "s\r\n E\n")
    with robot.Keys() as keys:
        assert [keys.pressed() for _ in range(4)] == ["s", "e", "q", "q"]
    monkeypatch.setattr(sys, "stdin", None)  # of a service
    with pytest.raises(common.UserError, match="standard input is closed"):
        robot.Keys().__enter__()


def test_a_recording_can_be_driven_without_a_terminal(emulator, cell, monkeypatch, capsys):
    Script(monkeypatch, "s\ne\ns\n")  # a key a frame: an episode of one, and one that is not ended
    assert ends(record(cell, 2)) == 0
    assert "dropped: the last episode was not ended" in capsys.readouterr().out
    assert len(data.load_demonstrations("demos/stack-cube.npz")) == 1
    assert is_held(emulator)


def record(cell, episodes, *more):
    task = ["--task", "stack-cube", "--instruction", "Stack the cube."]
    return ["record", *cell, *task, "--episodes", str(episodes), *more]


EPISODE = ((0.2, "s"), (0.3, "e"))


def test_check_reports_everything_and_moves_nothing(emulator, cell, capsys):
    emulator.faults.enabling_bit = True  # means no stop
    assert ends(["check", *cell, "--picture", "cell.png"]) == 0
    printed = capsys.readouterr().out
    for part in (
        "Robotmode: RUNNING",
        "Safetystatus: NORMAL",
        "is in remote control  true",
        "ready",
        "'payload_kg': 1.1",
        "0.00 (0 open, 1 closed)",
        "13625 of 19200 in the crop box",
        "-0.200 -0.550 0.300",
    ):
        assert part in printed, part
    assert Path("cell.png").read_bytes().startswith(b"\x89PNG")
    for faults, message in (
        ({"safety_mode": 3}, "protective stop"),
        ({"safety_mode": 13}, "three-position enabling device"),
        ({"slider": 0.5}, "speed slider is at 50%"),
        ({"remote": "false"}, "not in remote control"),
    ):
        emulator.faults = type(emulator.faults)(**faults)
        assert ends(["check", *cell]) == 2
        assert message in capsys.readouterr().err
    emulator.faults = type(emulator.faults)(gripper_silent=100)
    assert ends(["check", *cell]) == 2
    printed = capsys.readouterr()
    assert re.search(r"gripper +none: the gripper at .*: no answer", printed.out)
    assert "not ready: the gripper at" in printed.err
    emulator.faults = type(emulator.faults)()
    emulator.pose[3:] = [3.1, 0.0, 0.0]
    assert ends(["check", *cell]) == 2
    advice = "the rotation vector may flip: write the tool's own to rotation_near_rad of --config, "
    assert f"{advice}[3.1, 0.0, 0.0]" in capsys.readouterr().err
    assert emulator.received == [] and emulator.programs == []
    assert all(frame[1] == 3 for frame in emulator.gripper_frames)  # reads only


@pytest.mark.parametrize(
    "near, rotation, may_flip",
    [
        ((0, np.pi, 0), (0, 3.1, 0), False),
        ((0, np.pi, 0), (np.pi / 2, 0, 0), False),  # level: both vectors fit, one clearly better
        ((0, np.pi, 0), (0, 0, 0), False),
        ((0, np.pi, 0), (3.1, 0, 0), True),  # as far from either
        ((0, 0, 0), (3.1, 0, 0), True),
        ((0.5, 0, 0), (0, 3.1, 0), True),
    ],
)
def test_a_reference_as_far_from_both_vectors_of_a_rotation_is_told(
    near, rotation, may_flip, settings
):
    expected = pytest.raises(RobotError, match="may flip") if may_flip else contextlib.nullcontext()
    with expected:
        robot.check_reference(
            np.array([0, 0, 0, *rotation]), replace(settings, rotation_near_rad=near)
        )


def test_one_check_of_poses_decides_wherever_they_come_from(
    emulator, settings, cell, monkeypatch, capsys
):
    def refuse(self, poses):
        raise RobotError("refused by the one check")

    monkeypatch.setattr(Settings, "check_poses", refuse)
    with pytest.raises(ValueError, match="the one check"):
        replace(settings, start_pose=START_POSE)
    with pytest.raises(RobotError, match="the one check"):
        Moving(settings).__enter__()
    start = np.array(START_POSE)
    frame = robot.Frame(time=0.0, points=None, seen=0, state=np.append(start, 0.0))
    with pytest.raises(RobotError, match="the one check"):  # a recorded episode
        robot.episode_actions([frame], [0.0], settings)
    for motion in (lambda servo: servo.follow(STILL), lambda servo: servo.go(start)):
        with simulated_arm(settings, start) as arm:
            with pytest.raises(RobotError, match="the one check"):
                motion(arm.servo)
            assert arm.stopped
    assert ends(["check", *cell]) == 2 and "the one check" in capsys.readouterr().err
    assert emulator.received == []


def test_one_check_of_states_decides_wherever_they_are_read(
    emulator, settings, cell, monkeypatch, capsys
):
    def refuse(self):
        raise RobotError("refused by the one check")

    monkeypatch.setattr(robot.State, "check", refuse)
    with pytest.raises(RobotError, match="the one check"):
        Moving(settings).__enter__()
    with simulated_arm(settings, np.array(START_POSE)) as arm:
        with pytest.raises(RobotError, match="the one check"):
            arm.servo.step()
    Script(monkeypatch, "q")
    for argv in (["check", *cell], record(cell, 1)):
        assert ends(argv) == 2 and "the one check" in capsys.readouterr().err
    assert emulator.received == []
    assert all(frame[1] == 3 for frame in emulator.gripper_frames)  # reads only


def test_check_needs_no_dashboard_which_polyscope_x_does_not_have(emulator, cell, capsys):
    emulator.faults.version = (10, 7, 0)
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]  # where nobody listens afterwards
    content = json.loads(Path("robot.json").read_text())
    Path("robot.json").write_text(json.dumps(content | {"dashboard_port": port}))
    assert ends(["check", *cell]) == 0
    printed = capsys.readouterr().out
    for part in ("PolyScope X has none", "unknown: look at the panel", "software 10.7.0", "ready"):
        assert part in printed, part
    emulator.faults.safety_mode = 3
    assert ends(["check", *cell]) == 2 and "protective stop" in capsys.readouterr().err


def test_the_picture_shows_the_cloud_and_both_boxes_of_any_data(tmp_path, monkeypatch):
    from mpl_toolkits.mplot3d import Axes3D

    drawn, scatter, plot = [], Axes3D.scatter, Axes3D.plot

    def keep(what):
        return lambda axes, *args, **more: drawn.append(args[:3]) or what(axes, *args, **more)

    monkeypatch.setattr(Axes3D, "scatter", keep(scatter))
    monkeypatch.setattr(Axes3D, "plot", keep(plot))
    points = np.random.default_rng(0).normal(size=(1, 50, 3)).astype(np.float16)
    meta = robot.boxes(Settings(**BOXES)) | {"positions_in_state": 1}
    for flat in (points, points * np.float16([1, 1, 0])):  # a plane, too
        drawn.clear()
        arrays = (flat, np.zeros((1, 7)), np.zeros((1, 7)), np.array([1]))
        seen = data.Demonstrations("x", r"half: $\frac$", *arrays, meta)
        report.plot_demonstration(seen, tmp_path / "x.png")
        lines = np.array([line for line in drawn if np.shape(line) == (3, 2)])
        assert len(lines) == 24  # the edges of two boxes
        assert {*lines[:12, 2].ravel()} == {-0.05, 0.5}
        np.testing.assert_allclose(np.stack(drawn[0], axis=1), flat[0])


def test_recording_keeps_finished_episodes_and_drops_the_others(
    emulator, cell, monkeypatch, capsys
):
    emulator.hand = 2.0
    keys = [(0.2, "s"), (0.4, "e"), (0.1, "s"), (0.1, "d"), (0.1, "s"), (0.2, "g"), (0.2, "e")]
    Typing(monkeypatch, *keys)
    assert ends(record(cell, 2)) == 0, capsys.readouterr().err
    recorded = data.load_demonstrations("demos/stack-cube.npz")
    assert len(recorded) == 2 and recorded.instruction == "Stack the cube."
    assert recorded.points.shape[1:] == (64, 3)
    assert recorded.state.shape[1] == recorded.action.shape[1] == 7
    frames = recorded.episode(1)
    state, action = recorded.state[frames], recorded.action[frames]
    for now, later, moved in zip(state, state[1:], action):
        np.testing.assert_allclose(robot.compose(now[:6], moved)[:3], later[:3], atol=1e-5)
    assert abs(np.diff(state[:, 0])).sum() > 0.01  # the hand did move the arm
    assert action[0, 6] == 0 and action[-1, 6] == 1  # g closed the gripper on the way
    meta = recorded.meta
    assert meta["positions_in_state"] == 1 and meta["rotation_near_rad"] == [0, 3.14159, 0]
    assert meta["policy_hz"] == 20 and meta["tcp_offset"][2] == 0.17 and meta["payload_kg"] == 1.1
    assert len(meta["time_s"]) == len(meta["points_seen"]) == len(recorded.state)
    assert np.diff(meta["time_s"][: frames.start]).mean() == pytest.approx(0.05, abs=0.01)
    assert is_held(emulator)
    assert ends(record(cell, 1)) == 2 and "exists: add --append" in capsys.readouterr().err

    # An interrupted recording goes on; a picture can be drawn; the robot must be the same.
    Typing(monkeypatch, *EPISODE)
    assert ends(record(cell, 1, "--append")) == 0
    longer = data.load_demonstrations("demos/stack-cube.npz")
    assert len(longer) == 3 and len(longer.meta["time_s"]) == len(longer.state)
    np.testing.assert_array_equal(longer.state[: len(recorded.state)], recorded.state)
    convert.main(["--show", "demos/stack-cube.npz"])
    assert Path("demos/stack-cube.png").read_bytes().startswith(b"\x89PNG")
    emulator.tcp_offset = (0.0, 0.0, 0.2, 0.0, 0.0, 0.0)
    Typing(monkeypatch, (0.1, "q"))
    assert ends(record(cell, 1, "--append")) == 2
    assert "was recorded with tcp_offset [0.0, 0.0, 0.17" in capsys.readouterr().err
    settings = json.loads(Path("robot.json").read_text()) | {"num_points": 32}
    Path("robot.json").write_text(json.dumps(settings))
    assert ends(record(cell, 1, "--append")) == 2
    assert "has clouds of 64 points: set num_points so" in capsys.readouterr().err


@pytest.mark.parametrize(
    "trouble, message",
    [
        ({"hand": 0.3}, "dropped: a step jumps by"),
        ({"pose": [0.3, *START_POSE[1:]]}, "dropped: the TCP is outside its box, at 0.3"),
        ({"silent": 1}, "s: camera or gripper were late"),
    ],
)
def test_an_episode_that_run_would_refuse_is_not_kept(
    emulator, cell, monkeypatch, capsys, trouble, message
):
    Typing(monkeypatch, (0.2, "s"), (0.6, "e"), (0.1, "q"))
    for name, value in trouble.items():
        setattr(emulator, name, value)

    def silence():
        while not emulator.free:
            time.sleep(0.01)
        time.sleep(0.15)
        emulator.faults.gripper_silent = 1

    if "silent" in trouble:
        threading.Thread(target=silence, daemon=True).start()
    assert ends(record(cell, 1)) == 0
    printed = capsys.readouterr().out
    assert message in printed and "nothing was recorded" in printed
    assert not Path("demos/stack-cube.npz").exists()


def test_the_gripper_is_recorded_as_told_after_a_frame_that_does_not_show_it_yet():
    cell = SimpleNamespace(observe=lambda: "frame")
    servo = SimpleNamespace(check=lambda: None, moves=False)
    recorder = robot.Recorder(args=None, cell=cell, out=None, meta={}, kept=None)
    for key in ("s", "", "g", "", "g"):  # in the order in which `record` does it
        recorder.observe()
        recorder.press(key, servo)
    assert recorder.grip == [0, 1, 1, 0] and len(recorder.frames) == 4


@pytest.mark.parametrize("opening", [0, 550])
def test_a_gripper_that_is_closed_or_holds_something_is_recorded_as_closed(
    emulator, cell, monkeypatch, opening
):
    emulator.registers[0x0103] = emulator.opening = opening
    Typing(monkeypatch, *EPISODE)
    assert ends(record(cell, 1)) == 0
    assert emulator.registers[0x0103] == 0  # what holds something goes on holding it
    assert data.load_demonstrations("demos/stack-cube.npz").action[:, 6].tolist()[0] == 1


def test_what_cannot_be_recorded_is_refused_before_connecting(cell, capsys, monkeypatch):
    Path("robot.json").write_text(json.dumps(BOXES | {"rtde_port": 1, "gripper_port": 1}))
    for task in ("../evil", "", "a b", ".hidden"):
        argv = ["record", *cell, "--task", task, "--instruction", "x"]
        assert ends(argv) == 2 and "--task" in capsys.readouterr().err
    with common.locked(Path("demos")):
        assert ends(record(cell, 1)) == 2
    assert "another process runs in demos" in capsys.readouterr().err
    assert ends(record(cell, 1)) == 2 and "cannot be reached" in capsys.readouterr().err
    assert ends(record(cell, 0)) == 2
    assert "--episodes is 0: use at least 1" in capsys.readouterr().err
    monkeypatch.setattr(robot, "termios", None)  # as on Windows
    assert ends(record(cell, 1)) == 2 and "use Linux or macOS" in capsys.readouterr().err


def test_a_file_that_cannot_be_written_is_refused_before_connecting(
    running, capsys, monkeypatch, tmp_path
):
    Path("robot.json").write_text(json.dumps(BOXES | {"rtde_port": 1, "gripper_port": 1}))
    replay = ["replay", *running[1:-4], "--data", "demos.npz"]
    for argv in (record(running[1:-4], 1), running, replay):
        assert ends([*argv, "--out", "log"]) == 2
        assert "--out is log: name an .npz file" in capsys.readouterr().err
    assert ends([*replay, "--out", "robot.json/log.npz"]) == 2
    assert "robot.json/log.npz cannot be written: File exists" in capsys.readouterr().err
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write everywhere
    assert ends([*replay, "--out", "new/log.npz"]) == 2
    assert "new/log.npz cannot be written: no permission" in capsys.readouterr().err


def test_a_full_disk_is_told_with_the_path(emulator, cell, monkeypatch, capsys):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(data, "save_demonstrations", full)
    Typing(monkeypatch, *EPISODE)
    assert ends(record(cell, 1)) == 2
    error = capsys.readouterr().err
    assert "demos/stack-cube.npz cannot be written: No space left" in error
    assert is_held(emulator)


def test_a_camera_is_recorded_to_a_file_that_is_replayed(cell, capsys):
    assert ends(["camera", "--camera", "scene.npz", "--out", "again.npz", "--frames", "3"]) == 0
    first, again = robot.RecordedCamera("scene.npz"), robot.RecordedCamera("again.npz")
    assert again.intrinsics == first.intrinsics
    begin = first.read()
    for image in (begin, first.read(), first.read(), begin):  # the fourth is the first again
        np.testing.assert_array_equal(again.read(), image)
    Path("folder.npz").mkdir()
    for out, message in (
        ("again", "--out is again: name an .npz file"),
        ("scene.npz/again.npz", "scene.npz/again.npz cannot be written: "),
        ("folder.npz", "folder.npz cannot be written: it is a folder"),
    ):  # said before anything is recorded
        assert ends(["camera", "--camera", "scene.npz", "--out", out]) == 2
        assert message in capsys.readouterr().err
    assert ends(["camera", "--camera", "scene.npz", "--out", "a.npz", "--frames", "0"]) == 2
    assert "--frames is 0: use at least 1" in capsys.readouterr().err


def test_a_camera_lost_while_recording_ends_it_and_keeps_the_earlier_episodes(
    emulator, cell, monkeypatch, capsys
):
    Typing(monkeypatch, (0.2, "s"), (0.4, "e"), (0.1, "s"))
    read = robot.RecordedCamera.read

    def lost(self):
        nothing = np.zeros((120, 160), np.float32)
        return nothing if Path("demos/stack-cube.npz").exists() else read(self)

    monkeypatch.setattr(robot.RecordedCamera, "read", lost)
    assert ends(record(cell, 5)) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "depth is empty" in error
    assert len(data.load_demonstrations("demos/stack-cube.npz")) == 1
    assert is_held(emulator)


def test_ctrl_c_while_recording_keeps_the_earlier_episodes(emulator, cell, monkeypatch, capsys):
    Typing(monkeypatch, (0.2, "s"), (0.4, "e"), (0.1, "s"))
    observe = robot.Cell.observe
    calls = []

    def interrupted(self):
        calls.append(None)
        if Path("demos/stack-cube.npz").exists() and len(calls) > 20:
            raise KeyboardInterrupt
        return observe(self)

    monkeypatch.setattr(robot.Cell, "observe", interrupted)
    assert ends(record(cell, 5)) == 130
    assert len(data.load_demonstrations("demos/stack-cube.npz")) == 1
    assert is_held(emulator)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGHUP])
def test_an_arm_is_not_left_free_by_a_process_that_is_gone(emulator, cell, number):
    reading, writing = os.pipe()
    child = os.fork()  # all is imported there already
    if child == 0:
        signal.signal(number, signal.SIG_DFL) if number != signal.SIGKILL else None
        sys.stdin = os.fdopen(reading)
        code = ends(record(cell, 2))
        os._exit(code)
    deadline = time.monotonic() + 5
    while not emulator.free and time.monotonic() < deadline:
        time.sleep(0.01)
    assert emulator.free
    os.kill(child, number)
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == (-number if number == signal.SIGKILL else 130)
    time.sleep(0.2)  # the watchdog's 80 ms
    assert not emulator.free
    assert emulator.ends == ["watchdog" if number == signal.SIGKILL else "finished"]
    os.close(writing)


RUN = ["--checkpoint", "policy.pt", "--data", "demos.npz"]


def robot_policy(path, **changes):
    """A checkpoint of an untrained policy with the robot's dimensions, and demonstrations."""
    torch.manual_seed(0)
    config = replace(model.PRESETS["tiny"], state_dim=7, action_dim=7, **changes)
    policy = model.DAMIPolicy(config)
    rng = np.random.default_rng(0)
    state = np.tile(np.append(START_POSE, 0.0), (30, 1)) + 0.01 * rng.normal(size=(30, 7))
    small, grip = rng.uniform(-0.004, 0.004, (30, 6)), rng.uniform(0, 1, (30, 1))
    action = np.concatenate([small, grip], axis=1)
    points = rng.uniform(-0.5, 0.5, (30, 64, 3)).astype(np.float16)
    arrays = (points, state.astype(np.float32), action.astype(np.float32), np.array([30]))
    meta = {"policy_hz": 20.0, "tcp_offset": [0.0, 0.0, 0.17, 0.0, 0.0, 0.0], "payload_kg": 1.1}
    meta |= {"gripper_open_at": 1000, **robot.boxes(Settings(**BOXES))}
    meta["rotation_near_rad"] = list(Settings(**BOXES).rotation_near_rad)
    recorded = data.Demonstrations("stack-cube", "Stack the cube.", *arrays, meta)
    policy.normalizer.fit(
        [
            SimpleNamespace(
                points=torch.from_numpy(recorded.points),
                state=torch.from_numpy(recorded.state),
                action=torch.from_numpy(recorded.action),
            )
        ]
    )
    data.save_demonstrations(Path(path).with_name("demos.npz"), recorded)
    info = {"suite": "own", "preset": "tiny", "arguments": {}, "step": 0}
    model.save(path, policy, text_weights="random-seed-0", **info)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("policy")
    robot_policy(folder / "policy.pt")
    return folder


@pytest.fixture
def running(cell, trained, monkeypatch):
    """Arguments of `run`, with a checkpoint and demonstrations."""
    monkeypatch.setattr(clip, "load_clip_text_encoder", load_once)
    monkeypatch.setattr(robot, "warm_up", lambda *_: None)  # so that tests count what is executed
    for name in ("policy.pt", "demos.npz"):
        shutil.copy(trained / name, name)
    return ["run", *cell, *RUN]


def the_log():
    """The recording that a run has left."""
    (path,) = Path("runs/robot").glob("stack-cube-*.npz")
    return data.load_demonstrations(path)


def test_running_moves_the_arm_within_its_limits_and_ends_with_a_stop(
    emulator, settings, running, capsys
):
    assert ends([*running, "--seconds", "1"]) == 0, capsys.readouterr().err
    printed = capsys.readouterr().out
    assert "stack-cube: run" in printed and "packages at 125 Hz" in printed
    assert np.linalg.norm(np.subtract(emulator.pose, START_POSE)[:3]) > 1e-3
    assert emulator.registers[0x0200] == 1
    assert any(frame[3] == 3 for frame in emulator.gripper_frames)
    assert_stop_is_last(emulator)
    assert_within_limits(emulator, settings)

    # What it saw and did can be looked at, and trained on.
    log = the_log()
    assert log.meta["ended"] == "done" and log.meta["made_by"] == "robot.run"
    assert len(log.state) == len(log.meta["commanded"]) == len(log.meta["points_seen"]) >= 16
    policy, _ = model.load("policy.pt")
    assert len(data.WindowSampler(log, policy.config)) > 0


def test_a_folder_of_finetune_is_run_as_its_checkpoint_is(running, capsys):
    os.mkdir("adapted")
    argv = [*running, "--checkpoint", "adapted", "--seconds", "0"]
    assert ends(argv) == 2
    assert "no checkpoint at adapted/adapted.pt" in capsys.readouterr().err
    os.rename("policy.pt", "adapted/adapted.pt")
    assert ends(argv) == 0


def test_a_policy_sees_the_last_two_frames_and_what_it_draws_is_followed(running, monkeypatch):
    seen, drawn, followed, rng = [], [], [], np.random.default_rng(0)

    def sample(policy, points, state, context, generator):
        seen.append(state[0].numpy())
        drawn.append(rng.choice([-1, 1], (8, 7)) * [*[0.004] * 3, *[0.001] * 3, 0.0])
        return torch.tensor(drawn[-1], dtype=torch.float32)[None]

    follow = Servo.follow
    monkeypatch.setattr(model.DAMIPolicy, "sample_actions", sample)
    monkeypatch.setattr(
        Servo, "follow", lambda servo, actions: followed.append(actions) or follow(servo, actions)
    )
    assert ends([*running, "--seconds", "1"]) == 0
    log = the_log()
    assert len(seen) > 1
    np.testing.assert_allclose(followed, drawn, atol=1e-7)
    states = [tuple(state) for state in log.state]
    pairs = {(states[max(i - 1, 0)], states[i]) for i in range(len(states))}
    assert {(tuple(older), tuple(newest)) for older, newest in seen} <= pairs


def test_the_first_frames_are_seen_after_the_gripper_is_ready(emulator, settings, running):
    emulator.faults.initializing = 0.3

    def bump():
        while emulator.registers[0x0200] != 2:
            time.sleep(0.005)
        emulator.pose[1] += 0.12  # somebody moves the arm meanwhile

    threading.Thread(target=bump, daemon=True).start()
    assert ends([*running, "--seconds", "0.5"]) == 0
    assert the_log().state[0, 1] == pytest.approx(START_POSE[1] + 0.12, abs=0.005)
    assert_within_limits(emulator, settings)


def test_the_gripper_stays_as_it_is_if_the_arm_may_not_start(emulator, running, capsys):
    emulator.pose[0] = 0.25
    assert ends([*running, "--seconds", "0.5"]) == 2
    assert "outside its box" in capsys.readouterr().err
    assert emulator.registers[0x0200] == 0  # not initialized: it would have opened and closed


def test_a_start_pose_is_reached_slowly(emulator, settings, running):
    content = json.loads(Path("robot.json").read_text())
    start = [-0.22, -0.55, 0.31, 0.0, 3.0, 0.02]
    Path("robot.json").write_text(json.dumps(content | {"start_pose": start}))
    assert ends([*running, "--seconds", "0"]) == 0
    np.testing.assert_allclose(emulator.pose, start, atol=2e-3)
    assert emulator.fastest[0] < 0.3 * settings.max_speed_m_s


def test_a_recorded_episode_is_replayed_from_where_it_began(emulator, settings, running, capsys):
    recorded = data.load_demonstrations("demos.npz")
    argv = ["replay", *running[1:-4], "--data", "demos.npz"]
    assert ends(argv) == 0, capsys.readouterr().err
    expected = recorded.state[0, :6].astype(float)
    log = the_log()
    np.testing.assert_allclose(log.meta["commanded"][0], expected, atol=1e-5)
    np.testing.assert_allclose(log.action[:30], recorded.action, atol=1e-6)
    for action in recorded.action:
        expected = robot.compose(expected, action)
    np.testing.assert_allclose(emulator.pose, expected, atol=4e-3)
    assert_within_limits(emulator, settings)

    # The gripper was told each new position, 1000 for open, that is a hundredth away at least.
    moves = [frame for frame in emulator.gripper_frames if frame[1:4] == b"\x06\x01\x03"]
    positions = []
    for closed in recorded.action[:, 6].tolist():
        position = round((1 - closed) * 1000)
        if not positions or abs(position - positions[-1]) >= 10:
            positions.append(position)
    assert [int.from_bytes(frame[4:6], "big") for frame in moves] == positions

    assert ends([*argv, "--episode", "7"]) == 2 and "no --episode 7" in capsys.readouterr().err
    data.save_demonstrations("flat.npz", replace(recorded, action=recorded.action[:, :4]))
    assert ends(["replay", *running[1:-4], "--data", "flat.npz"]) == 2
    assert "has (7, 4) dimensions of state and action" in capsys.readouterr().err


def test_actions_that_are_too_fast_are_replayed_in_more_time(settings):
    actions = np.concatenate([steps(2, dx=0.03, drz=-0.002), steps(1, dy=0.001, gripper=1.0)])
    parts = robot.at_allowed_speed(actions, replace(settings, policy_hz=10.0))
    metres, radians = robot.lengths(parts).max(axis=0) * 10.0
    assert metres <= settings.target_speed[0] and radians <= settings.target_speed[1]
    assert len(parts) == 5 and parts[-1].tolist() == actions[-1].tolist()  # 0.3 m/s of 0.2 allowed
    np.testing.assert_allclose(parts[:, :6].sum(axis=0), actions[:, :6].sum(axis=0))


def test_a_dry_run_begins_each_chunk_where_the_arm_is(emulator, running, monkeypatch, capsys):
    """Otherwise the motion that is never made would add up, and leave the box."""

    def sample(policy, points, state, context, generator):
        chunk = torch.zeros(1, 8, 7)
        chunk[..., 0] = 0.008
        return chunk

    monkeypatch.setattr(model.DAMIPolicy, "sample_actions", sample)
    content = json.loads(Path("robot.json").read_text())
    high = [START_POSE[0] + 0.1, *content["tcp_high_m"][1:]]  # two chunks of 6.4 cm lead out of it
    Path("robot.json").write_text(json.dumps(content | {"tcp_high_m": high}))
    assert ends([*running, "--seconds", "1.5", "--dry-run"]) == 0, capsys.readouterr().err
    np.testing.assert_allclose(emulator.pose, START_POSE, atol=1e-6)


def test_a_jump_is_not_replayed_in_parts(emulator, running, capsys):
    recorded = data.load_demonstrations("demos.npz")
    action = recorded.action.copy()
    action[3, 0] = 0.2
    data.save_demonstrations("jump.npz", replace(recorded, action=action))
    assert ends(["replay", *running[1:-4], "--data", "jump.npz"]) == 2
    assert "a step jumps by 0.200 m" in capsys.readouterr().err
    np.testing.assert_allclose(emulator.pose, START_POSE, atol=1e-6)


def test_actions_that_are_cut_short_are_told(emulator, settings, capsys):
    with Moving(settings) as servo:
        servo.follow(steps(drz=0.05))
        time.sleep(0.1)
    servo.report()
    assert "8 actions were faster than 0.20 m/s, 0.13 rad/s" in capsys.readouterr().err


@pytest.mark.parametrize(
    "changes, arguments, message",
    [
        ({"policy_hz": 10}, [], "recorded with policy_hz 20.0, now it is 10.0"),
        ({}, ["--device", "cuda:99"], "--device cuda:99 cannot be used here"),
        ({}, ["--device", "nonsense"], "--device nonsense cannot be used here"),
        ({}, ["--out", "demos.npz"], "demos.npz exists"),
    ],
)
def test_a_robot_or_device_that_does_not_fit_is_refused(
    emulator, running, capsys, changes, arguments, message
):
    content = json.loads(Path("robot.json").read_text())
    Path("robot.json").write_text(json.dumps(content | changes))
    assert ends([*running, *arguments]) == 2
    assert message in capsys.readouterr().err and emulator.received == []


def test_a_policy_that_is_too_slow_is_refused_before_the_arm_waits_for_it(settings, monkeypatch):
    took = iter([0.3, 0.0, 0.3, 0.3])

    def slow(policy, points, state, context, generator):
        time.sleep(next(took))
        return torch.zeros(len(points), 8, 7)

    policy = model.DAMIPolicy(replace(model.PRESETS["tiny"], state_dim=7, action_dim=7))
    monkeypatch.setattr(model.DAMIPolicy, "sample_actions", slow)
    patient = replace(settings, max_hold_s=0.2)
    robot.warm_up(policy, None, patient, "cpu")  # the first chunk may be slow
    with pytest.raises(common.UserError, match="for a chunk, and max_hold_s is 0"):
        robot.warm_up(policy, None, patient, "cpu")


def test_an_error_of_the_policy_stops_the_arm(emulator, running, monkeypatch, capsys):
    def broken(*_):
        raise IndexError("shapes")

    monkeypatch.setattr(model.DAMIPolicy, "sample_actions", broken)
    assert ends(running) == 2
    assert "the policy failed: IndexError('shapes')" in capsys.readouterr().err
    assert_stop_is_last(emulator)


def test_a_dry_run_does_everything_but_motion(emulator, running, capsys):
    assert ends([*running, "--seconds", "0.5", "--dry-run"]) == 0, capsys.readouterr().err
    assert "steps, in which nothing was sent, at 125 Hz" in capsys.readouterr().out
    assert emulator.received == [] and emulator.programs == [] and emulator.owners == {}
    assert all(frame[1] == 3 for frame in emulator.gripper_frames)
    np.testing.assert_allclose(emulator.pose, START_POSE)


def when_it_runs(emulator, act):
    """Calls `act` as soon as a program, or a dry run, is on its way."""

    def wait():
        while not emulator.received and len(emulator.gripper_frames) < 8:
            time.sleep(0.01)
        time.sleep(0.6)  # in which some actions are taken, on a busy machine, too
        act()

    threading.Thread(target=wait, daemon=True).start()


def test_trouble_in_a_dry_run_ends_it_with_the_reason_and_sends_nothing(emulator, running, capsys):
    when_it_runs(emulator, lambda: setattr(emulator.faults, "safety_mode", 3))
    assert ends([*running, "--dry-run"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "protective stop" in error and emulator.received == []


def test_keys_that_arrive_together_are_all_read(monkeypatch):
    Typing(monkeypatch, (0.0, "s\ne"))
    time.sleep(0.1)
    with robot.Keys() as keys:
        assert [keys.pressed() for _ in range(3)] == ["s", "e", ""]


def test_a_late_camera_breaks_off_a_chunk_so_that_the_gripper_acts_in_its_place(
    emulator, running, monkeypatch, capsys
):
    read, sample, chunks = robot.RecordedCamera.read, model.DAMIPolicy.sample_actions, []

    def late(self):
        time.sleep(0.12)
        return read(self)

    monkeypatch.setattr(robot.RecordedCamera, "read", late)
    monkeypatch.setattr(
        model.DAMIPolicy, "sample_actions", lambda *args: chunks.append(1) or sample(*args)
    )
    assert ends([*running, "--seconds", "1"]) == 0, capsys.readouterr().err
    log = the_log()
    assert len(log.action) == len(chunks) >= 3  # of each chunk of 8 the first action
    # The arm went on while the camera was late, so that no episode goes on over a break.
    assert log.episode_ends.tolist() == list(range(1, len(chunks) + 1))
    assert ends(["replay", *running[1:-4], "--data", "demos.npz"]) == 2
    assert "camera or gripper were late" in capsys.readouterr().err


def test_the_gripper_is_not_moved_once_the_arm_was_stopped(emulator, running, monkeypatch, capsys):
    observe, count = robot.Cell.observe_or_hold, []

    def stopped(cell, servo):
        frame = observe(cell, servo)
        if len(emulator.received) > 20:
            emulator.faults.safety_mode = 7  # while nothing else is looked at
            time.sleep(0.05)
            count.append(len(emulator.gripper_frames))
        return frame

    monkeypatch.setattr(robot.Cell, "observe_or_hold", stopped)
    assert ends(["replay", *running[1:-4], "--data", "demos.npz"]) == 2
    assert "emergency stop" in capsys.readouterr().err
    assert len(emulator.gripper_frames) == count[0]
    assert ends(["replay", *running[1:-4], "--data", "demos.npz"]) == 2
    assert all(frame[1] == 3 for frame in emulator.gripper_frames[count[0] :])  # reads only


def test_a_stop_during_the_last_observation_is_no_success_and_no_late_camera(
    emulator, running, monkeypatch, capsys
):
    observe, frames, stops = robot.Cell.observe_or_hold, [], []
    recorded = data.load_demonstrations("demos.npz")
    settings = robot.load_settings("robot.json")
    actions = robot.at_allowed_speed(recorded.action[recorded.episode(0)], settings)

    def stopped(cell, servo):
        frames.append(observe(cell, servo))
        if len(frames) == stops[-1]:
            emulator.faults.safety_mode = 7
            time.sleep(0.25)  # longer than a frame takes: it is late, too
        return frames[-1]

    monkeypatch.setattr(robot.Cell, "observe_or_hold", stopped)
    for last in (len(actions) + 1, 3):  # after the last action, and in the middle of a chunk
        stops.append(last)
        assert ends(["replay", *running[1:-4], "--data", "demos.npz"]) == 2
        error = capsys.readouterr().err
        assert "emergency stop" in error and "late" not in error
        emulator.faults.safety_mode = 1
        frames.clear()


def test_an_arm_is_not_driven_by_a_recorded_camera_or_an_unknown_recording(running, capsys):
    elsewhere = [word if word != "127.0.0.1" else "10.9.9.9" for word in running]
    assert ends(elsewhere) == 2 and "--camera shows an arm" in capsys.readouterr().err
    recorded = data.load_demonstrations("demos.npz")
    data.save_demonstrations("demos.npz", replace(recorded, meta={"imported_from": "x.zarr"}))
    assert ends(["replay", *running[1:-4], "--data", "demos.npz"]) == 2
    assert "was recorded with policy_hz None" in capsys.readouterr().err


@pytest.mark.parametrize(
    "fault, value, message",
    [
        ("safety_mode", 3, "protective stop"),
        ("gripper_silent", 1000, "gripper at 127.0.0.1"),
        ("drop", True, "closed"),
    ],
)
def test_trouble_while_running_stops_the_arm_and_ends_the_command_with_the_reason(
    emulator, running, capsys, fault, value, message
):
    when_it_runs(emulator, lambda: setattr(emulator.faults, fault, value))
    assert ends(running) == 2
    assert message in the_log().meta["ended"]
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and message in error
    if fault != "drop":  # there the watchdog stops it
        assert_stop_is_last(emulator)


def test_ctrl_c_while_running_stops_the_arm(emulator, running, monkeypatch):
    sample, chunks = model.DAMIPolicy.sample_actions, []

    def interrupted(*args):
        chunks.append(None)
        if len(chunks) == 2:
            raise KeyboardInterrupt
        return sample(*args)

    monkeypatch.setattr(model.DAMIPolicy, "sample_actions", interrupted)
    assert ends(running) == 130
    assert_stop_is_last(emulator)
    assert the_log().meta["ended"] == "KeyboardInterrupt"


@pytest.mark.parametrize("lost_for", [0.2, 60])
def test_a_camera_that_gives_nothing_holds_the_arm_and_then_stops_it(
    emulator, running, monkeypatch, capsys, lost_for
):
    content = json.loads(Path("robot.json").read_text())
    max_hold_s = 0.5 if lost_for > 1 else 2.0  # a policy on a busy machine is waited for, too
    Path("robot.json").write_text(json.dumps(content | {"max_hold_s": max_hold_s}))
    read, began = robot.RecordedCamera.read, []

    def failing(self):
        began.append(time.monotonic())
        lost = 0.6 < time.monotonic() - began[0] < 0.6 + lost_for
        return np.zeros((120, 160), np.float32) if lost else read(self)

    monkeypatch.setattr(robot.RecordedCamera, "read", failing)
    assert ends([*running, "--seconds", "1.5"]) == (2 if lost_for > 1 else 0)
    error = capsys.readouterr().err
    message = "no new actions for 0.5 s: the camera's depth is empty"
    assert lost_for < 1 or (error.count("\n") == 1 and message in error)
    assert_stop_is_last(emulator)


def test_a_policy_that_does_not_fit_the_robot_is_refused_before_connecting(cell, capsys):
    robot_policy("policy.pt", num_points=128)
    content = BOXES | {"num_points": 64, "rtde_port": 1}  # nobody listens there
    Path("robot.json").write_text(json.dumps(content))
    assert ends(["run", *cell, *RUN]) == 2
    assert "reads 128 points, num_points of the settings is 64: raise it" in capsys.readouterr().err
    policy, info = model.load("policy.pt")
    model.save("other.pt", policy, **info, adapted_to="pour-tea")
    Path("robot.json").write_text(json.dumps(content | {"num_points": 128}))
    assert ends(["run", *cell, *RUN, "--checkpoint", "other.pt"]) == 2
    assert "was adapted to pour-tea, demos.npz is of another task" in capsys.readouterr().err
