"""robot.py against an emulated arm, and both against clients and servers that we did not write."""

import asyncio
import contextlib
import ctypes
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp

import data
import model
import robot
import scripts
from robot import RTDE, Gripper, RobotError, Servo, Settings
from tests.emulator import START_POSE, Emulator, write_scene

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


@pytest.fixture
def emulator():
    with Emulator() as emulator:
        yield emulator


@pytest.fixture
def settings(emulator):
    ports = {f"{name}_port": port for name, port in emulator.ports.items()}
    return Settings(**BOXES, **ports, num_points=64, max_hold_s=0.5)


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
    time.sleep(0.1)
    commands = [fields["input_int_register_24"] for _, fields in emulator.received]
    assert commands and commands[-1] == robot.STOP and robot.STOP not in commands[:-1]
    count = len(commands)
    time.sleep(0.1)
    assert len(emulator.received) == count


# ---- The protocol --------------------------------------------------------------------------------


def test_the_state_is_read_whole_however_the_bytes_arrive(emulator, settings):
    for one_byte, joined in ((False, 1), (True, 1), (False, 5)):
        emulator.faults.one_byte, emulator.faults.joined = one_byte, joined
        rtde = connect(settings, write=False)
        state = rtde.state(0.5)
        np.testing.assert_allclose(state.pose, START_POSE)
        v = state.values
        assert (v["robot_mode"], v["safety_mode"], v["robot_status_bits"]) == (
            7,
            1,
            1,
        ) and state.trouble() is None
        first = v["timestamp"]
        time.sleep(0.2)
        assert rtde.state(0.5).values["timestamp"] > first
        rtde.close()


def test_what_the_controller_refuses_is_named(emulator, settings):
    emulator.faults.not_found = {"actual_TCP_speed"}
    with pytest.raises(RobotError, match="actual_TCP_speed is NOT_FOUND"):
        connect(settings)
    emulator.faults.not_found, emulator.faults.in_use = set(), {"input_double_register_26"}
    with pytest.raises(RobotError, match=r"input_double_register_26 is IN_USE .*another client"):
        connect(settings)
    emulator.faults.in_use, emulator.faults.refuse_version = set(), True
    with pytest.raises(RobotError, match="protocol version 2"):
        connect(settings)


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


UR_RTDE = """import json, sys, time, rtde_receive
r = rtde_receive.RTDEReceiveInterface("127.0.0.1", 125.0, json.loads(sys.argv[1]))
time.sleep(0.2)
print(json.dumps({
    "actual_TCP_pose": r.getActualTCPPose(), "actual_q": r.getActualQ(),
    "actual_TCP_speed": r.getActualTCPSpeed(), "timestamp": r.getTimestamp(),
    "robot_mode": r.getRobotMode(), "safety_mode": r.getSafetyMode(),
    "runtime_state": r.getRuntimeState(), "robot_status_bits": r.getRobotStatus(),
    "safety_status_bits": r.getSafetyStatusBits(),
}))
"""  # in a process of its own, since it holds Python's lock while it waits for an answer


def test_ur_rtde_reads_the_emulator_and_agrees_with_our_client():
    pytest.importorskip("rtde_receive", reason="ur-rtde has wheels for some platforms only")
    names = [name for name in robot.OUTPUTS if not name.startswith("output_int_register")]
    with Emulator(rtde=30004) as emulator:  # the port that ur-rtde knows
        emulator.faults.safety_mode, emulator.faults.safety_status_bits = 2, 0b10
        command = [sys.executable, "-c", UR_RTDE, json.dumps(names)]
        theirs = json.loads(
            subprocess.run(command, capture_output=True, check=True, timeout=20).stdout
        )
        ours = RTDE("127.0.0.1", 30004)
        v = ours.state().values
        ours.close()
    assert (
        set(theirs) == set(names) and v["safety_mode"] == 2 and v["actual_TCP_pose"] == START_POSE
    )
    assert 0 <= v["timestamp"] - theirs.pop("timestamp") < 10
    for name, value in theirs.items():
        np.testing.assert_allclose(value, v[name], err_msg=name)


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


def test_interpolation_is_straight_and_scipys_slerp():
    rng = np.random.default_rng(1)
    for _ in range(20):
        pose, target = rng.normal(size=6), rng.normal(size=6)
        step = robot.difference(pose, target)
        share = 0.3
        reached = robot.toward(
            pose, target, share * np.linalg.norm(step[:3]), share * np.linalg.norm(step[3:])
        )
        np.testing.assert_allclose(reached[:3], pose[:3] + share * (target - pose)[:3])
        slerp = Slerp([0, 1], Rotation.from_rotvec([pose[3:], target[3:]]))
        np.testing.assert_allclose(
            (Rotation.from_rotvec(reached[3:]) * slerp(share).inv()).magnitude(), 0, atol=1e-7
        )
    np.testing.assert_allclose(robot.toward(pose, target, 100, 100)[:3], target[:3])


# ---- Motion --------------------------------------------------------------------------------------


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
        (steps(dx=0.2), "jumps by 0.200 m"),
        (steps(drx=0.5), "0.500 rad"),
        (steps(dz=-0.04), "outside the box"),
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
        time.sleep(0.2)
        np.testing.assert_allclose(emulator.pose, before, atol=1e-3)
    assert_stop_is_last(emulator)


def test_a_target_outside_the_box_is_clamped_if_asked(emulator, settings):
    with Moving(replace(settings, outside_box="clamp")) as servo:
        servo.follow(steps(dz=-0.04))
        time.sleep(1.4)
        servo.check()
        assert (
            servo.clamped
            and min(pose["input_double_register_26"] for _, pose in emulator.received) >= 0.05
        )
    assert_stop_is_last(emulator)


@pytest.mark.parametrize(
    "fault, message",
    [
        ({"silent": True}, "the newest state is 0.1"),
        ({"drop": True}, "connection"),
        ({"garbage": True}, "framing lost"),
        ({"safety_mode": 3, "safety_status_bits": 0b100}, "safety: protective stop"),
        ({"safety_status_bits": 1 << 7}, "safety"),
        ({"robot_mode": 5}, "not running"),
        ({"lose_program": True}, "the program on the controller has ended"),
        ({"deaf": True}, "the program on the controller has ended"),  # its watchdog
        ({"paused": True}, "is paused"),
        ({"blocked": True}, "m, 0.000 rad behind: blocked"),
        ({"frozen": True}, "the controller's clock"),
    ],
)
def test_trouble_with_the_controller_stops_the_arm_for_good(emulator, settings, fault, message):
    with Moving(replace(settings, max_hold_s=10)) as servo:
        servo.follow(steps(dx=0.01))
        time.sleep(0.1)
        for name, value in fault.items():
            setattr(emulator.faults, name, value)
        assert message in stops(servo)
        time.sleep(0.1)
        count = len(emulator.received)
        emulator.faults = type(emulator.faults)()  # all is well again, but the arm stays stopped
        with pytest.raises(RobotError, match=message):
            servo.follow(STILL)
        time.sleep(0.2)
        later = [fields["input_int_register_24"] for _, fields in emulator.received[count:]]
        assert not any(later) or "deaf" in fault  # what the deaf one had not read
    assert not any(
        line.startswith(("unlock", "power", "brake", "play")) for line in emulator.dashboard_lines
    )
    if not {"drop", "garbage"} & set(fault):
        assert emulator.received[-1][1]["input_int_register_24"] == robot.STOP


def test_a_late_policy_holds_the_arm_then_stops_it(emulator, settings):
    with Moving(settings) as servo:
        servo.follow(steps(n=2, dx=0.01))
        time.sleep(0.5)
        servo.check()  # it holds
        held = list(emulator.pose)
        assert "no new actions for 0.5 s" in stops(servo)
        np.testing.assert_allclose(emulator.pose, held, atol=1e-3)
    assert_stop_is_last(emulator)


def test_a_robot_in_trouble_is_not_moved_at_all(emulator, settings):
    emulator.faults.safety_mode = 3
    with pytest.raises(RobotError, match="protective stop"):
        Moving(settings).__enter__()
    assert emulator.received == []
    time.sleep(0.2)
    emulator.faults.safety_mode, emulator.faults.no_program = 1, True
    with pytest.raises(RobotError, match="does not start"):
        Moving(settings).__enter__()
    (program,) = emulator.programs
    assert robot.servo_turn(settings) in program and 'rtde_set_watchdog("input_int' in program
    emulator.faults.no_program = False
    emulator.pose[0] = 0.25
    with pytest.raises(RobotError, match=r"outside its box, at 0\.250, -0\.550"):
        Moving(settings).__enter__()
    emulator.pose[0] = float("nan")
    with pytest.raises(RobotError, match="not finite"):
        Moving(settings).__enter__()


def speeds(emulator, seconds):
    """The emulated arm's speeds in m/s, as long as asked."""
    found, until = [], time.monotonic() + seconds
    while time.monotonic() < until:
        found.append(np.linalg.norm(emulator.speed[:3]))
        time.sleep(0.001)
    return max(found)


def test_an_arm_that_was_moved_before_the_start_does_not_jump_back(emulator, settings):
    moving = Moving(settings)
    emulator.pose[1] += 0.12  # while the gripper initializes
    time.sleep(0.05)
    with moving as servo:
        servo.follow(steps(dx=0.01))
        assert speeds(emulator, 0.5) < 1.2 * settings.max_speed_m_s
        servo.check()


def test_an_arm_that_was_paused_does_not_leap_when_it_goes_on(emulator, settings):
    with Moving(replace(settings, max_hold_s=10)) as servo:
        servo.follow(steps(dx=0.02))
        time.sleep(0.1)
        emulator.faults.paused = True
        assert "is paused" in stops(servo)
        emulator.faults.paused = False
        assert speeds(emulator, 0.4) < 1.2 * settings.max_speed_m_s


def test_a_program_that_is_not_ours_is_not_followed_by_more_targets(emulator, settings):
    with Moving(replace(settings, max_hold_s=10)) as servo:
        servo.follow(steps(dx=0.01))
        time.sleep(0.1)
        upload = robot.upload
        upload("127.0.0.1", settings.script_port, "def other():\n  sleep(9)\nend\n")
        assert "the count of our program stands still" in stops(servo)
    # What a killed process left in the registers is not taken for a program of ours.
    emulator.faults.no_program = True
    emulator.outputs["output_int_register_24"] = 1
    with pytest.raises(RobotError, match="does not start"):
        Moving(settings).__enter__()


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


@pytest.mark.parametrize("seed", range(5))
def test_no_script_of_faults_makes_the_arm_fast(emulator, settings, seed):
    """Faults that come and go at random while the policy asks for all it may."""
    rng = np.random.default_rng(seed)
    names = ["blocked", "paused", "frozen", "silent", "deaf", "lose_program"]
    fastest = 0.0
    with Moving(replace(settings, max_hold_s=10)) as servo:
        for _ in range(8):
            with contextlib.suppress(RobotError):
                servo.follow(rng.uniform(-0.04, 0.04, size=(8, 7)) * (np.arange(7) < 3))
            name = names[rng.integers(len(names))]
            setattr(emulator.faults, name, True)
            fastest = max(fastest, speeds(emulator, rng.uniform(0.01, 0.1)))
            setattr(emulator.faults, name, False)
            fastest = max(fastest, speeds(emulator, 0.05))
    assert fastest < 1.25 * settings.max_speed_m_s, fastest


def test_inference_does_not_hold_up_the_stream(emulator, settings):
    with Moving(replace(settings, max_hold_s=5)) as servo:
        a = torch.randn(600, 600)
        until = time.monotonic() + 1.0
        while time.monotonic() < until:
            a = torch.tanh(a @ a)
        servo.check()
        times = np.array([when for when, _ in emulator.received])
    assert (
        len(times) > 60 and np.diff(times).max() < 0.1
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


def test_the_check_sum_is_modbus():
    assert robot.crc16(bytes.fromhex("010300000001")).hex() == "840a"
    assert robot.crc16(bytes.fromhex("01060103 03e8")) == robot.crc16(bytes.fromhex("0106010303e8"))


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
    points = robot.cloud(camera.read(), camera.intrinsics, Settings(**BOXES, num_points=400))
    assert points.shape == (400, 3) and points.dtype == np.float32
    table, top = abs(points[:, 2]) < 2e-3, abs(points[:, 2] - 0.05) < 2e-3
    assert (table | top).all() and top.sum() > 3
    assert (
        abs(points[top, :2] - (-0.2, -0.55)).max() < 0.03
    )  # the cube lies below the camera in the first frame


def test_missing_depth_and_an_empty_crop_are_refused_and_few_points_repeated():
    settings, intrinsics = Settings(**BOXES, num_points=100), robot.Intrinsics(100, 100, 2, 2)
    with pytest.raises(RobotError, match="depth is empty"):
        robot.cloud(np.zeros((4, 4), np.float32), intrinsics, settings)
    with pytest.raises(RobotError, match="crop box"):
        robot.cloud(np.full((4, 4), 3.0, np.float32), intrinsics, settings)
    depth = np.zeros((4, 4), np.float32)
    depth[1, 1] = depth[2, 3] = 0.9
    depth[3, 3] = np.nan
    points = robot.cloud(depth, intrinsics, settings)
    assert points.shape == (100, 3) and len(np.unique(points, axis=0)) == 2


def test_a_large_depth_image_is_thinned_out_before_it_is_sampled(monkeypatch):
    sizes, sample = [], robot.farthest_point_sample
    monkeypatch.setattr(
        robot,
        "farthest_point_sample",
        lambda points, n: sizes.append(len(points)) or sample(points, n),
    )
    rows, columns = np.mgrid[:480, :640]
    depth = (0.7 + 0.0002 * rows + 0.0001 * columns).astype(np.float32)
    settings = Settings(**BOXES | {"camera_to_base": CAMERA_TO_BASE}, num_points=256)
    points = robot.cloud(depth, robot.Intrinsics(600.0, 600.0, 320.0, 240.0), settings)
    everything = robot.cloud(depth[::8, ::8], robot.Intrinsics(75.0, 75.0, 40.0, 30.0), settings)
    assert sizes[0] <= robot.SAMPLED_FROM < depth.size
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
    ours = robot.depth_to_points(depth, robot.realsense_intrinsics(received.profile))
    pointcloud = rs.pointcloud()
    theirs = (
        np.asarray(pointcloud.calculate(received).get_vertices()).view(np.float32).reshape(-1, 3)
    )
    np.testing.assert_allclose(ours, theirs, atol=1e-6)
    sensor.stop()
    sensor.close()


# ---- Settings ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"tcp_low_m": [0.5, -0.9, 0.05]}, "tcp_low_m"),
        ({"crop_low_m": [0, 0]}, "three numbers in metres"),
        ({"camera_to_base": [[1, 0, 0, 0]] * 4}, "must be a rotation"),
        ({"max_speed": 1.0}, "unknown max_speed"),
        ({"max_speed_m_s": 5.0}, "at most 1.0"),
        ({"max_speed_m_s": "fast"}, "must be of type float"),
        ({"servo_gain": 5}, "100 to 2000"),
        ({"outside_box": "ignore"}, 'use "stop" or "clamp"'),
        ({"tcp_high_m": None}, "three numbers in metres"),
    ],
)
def test_wrong_settings_are_refused_in_one_line(tmp_path, changes, message):
    path = tmp_path / "robot.json"
    path.write_text(json.dumps(BOXES | changes))
    with pytest.raises(ValueError, match=message) as caught:
        robot.load_settings(path)
    assert "\n" not in str(caught.value)
    path.write_text("{")
    with pytest.raises(ValueError, match="not JSON"):
        robot.load_settings(path)
    path.write_text(json.dumps({name: BOXES[name] for name in BOXES if name != "camera_to_base"}))
    with pytest.raises(ValueError, match="lacks camera_to_base"):
        robot.load_settings(path)


def test_the_example_settings_are_valid():
    assert robot.load_settings(ROOT / "assets" / "robot.json").servo_hz == 125


# ---- Commands ------------------------------------------------------------------------------------


@pytest.fixture
def cell(emulator, tmp_path, monkeypatch):
    """A folder with robot.json and scene.npz for the emulator, and arguments that name them."""
    monkeypatch.chdir(tmp_path)
    ports = {f"{name}_port": port for name, port in emulator.ports.items()}
    Path("robot.json").write_text(json.dumps(BOXES | ports | {"num_points": 64, "policy_hz": 20}))
    write_scene("scene.npz")
    return ["--host", "127.0.0.1", "--camera", "scene.npz"]


def is_held(emulator):
    """Whether the arm was free, and soon no longer is."""
    time.sleep(0.3)
    return "  freedrive_mode()" in emulator.programs[-1] and not emulator.free


def ends(argv):
    """The exit code of a command."""
    try:
        scripts.command_line(lambda: robot.main(argv), robot.RobotError)
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
        for seconds, key in keys:
            time.sleep(seconds)
            os.write(writing, f"{key}\n".encode())


def record(cell, episodes):
    return [
        "record",
        *cell,
        "--task",
        "stack-cube",
        "--instruction",
        "Stack the cube.",
        "--episodes",
        str(episodes),
    ]


def test_check_reports_everything_and_moves_nothing(emulator, cell, capsys):
    assert ends(["check", *cell]) == 0
    printed = capsys.readouterr().out
    for part in (
        "Robotmode: RUNNING",
        "Safetystatus: NORMAL",
        "ready",
        "gripper",
        "64, from",
        "-0.200 -0.550 0.300",
    ):
        assert part in printed
    emulator.faults.safety_mode = 3
    assert ends(["check", *cell]) == 2
    assert "protective stop" in capsys.readouterr().err
    assert emulator.received == [] and emulator.programs == []
    assert all(frame[1] == 3 for frame in emulator.gripper_frames)  # reads only


def test_recording_keeps_finished_episodes_and_drops_the_others(
    emulator, cell, monkeypatch, capsys
):
    emulator.hand = 2.0
    Typing(
        monkeypatch,
        (0.3, "s"),
        (0.6, "e"),
        (0.1, "s"),
        (0.3, "d"),
        (0.1, "s"),
        (0.3, "g"),
        (0.3, "e"),
    )
    assert ends(record(cell, 2)) == 0, capsys.readouterr().err
    recorded = data.load_demonstrations("demos/stack-cube.npz")
    assert len(recorded) == 2 and recorded.instruction == "Stack the cube."
    assert (
        recorded.points.shape[1:] == (64, 3)
        and recorded.state.shape[1] == recorded.action.shape[1] == 7
    )
    frames = recorded.episode(1)
    state, action = recorded.state[frames], recorded.action[frames]
    for now, later, moved in zip(state, state[1:], action):
        np.testing.assert_allclose(robot.compose(now[:6], moved)[:3], later[:3], atol=1e-5)
    assert abs(np.diff(state[:, 0])).sum() > 0.01  # the hand did move the arm
    assert action[0, 6] == 0 and action[-1, 6] == 1  # g closed the gripper on the way
    assert is_held(emulator)
    assert ends(record(cell, 1)) == 2 and "exists" in capsys.readouterr().err


def test_a_camera_lost_while_recording_ends_it_and_keeps_the_earlier_episodes(
    emulator, cell, monkeypatch, capsys
):
    Typing(monkeypatch, (0.2, "s"), (0.4, "e"), (0.1, "s"))
    read = robot.RecordedCamera.read
    lost = lambda self: np.zeros((120, 160), np.float32) if Path("demos").exists() else read(self)  # noqa: E731
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
    command = [sys.executable, str(Path(robot.__file__)), *record(cell, 2)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline().startswith("keys:")
    time.sleep(0.3)
    assert emulator.free
    process.send_signal(number)
    time.sleep(0.5)
    assert not emulator.free
    process.communicate()
    assert process.returncode == (130 if number != signal.SIGKILL else -signal.SIGKILL)


def robot_policy(path, **changes):
    """A checkpoint of an untrained policy with the robot's dimensions, and demonstrations for "
    "it."""
    torch.manual_seed(0)
    config = replace(model.PRESETS["tiny"], state_dim=7, action_dim=7, **changes)
    policy = model.DAMIPolicy(config)
    rng = np.random.default_rng(0)
    state = np.tile(np.append(START_POSE, 0.0), (30, 1)) + 0.01 * rng.normal(size=(30, 7))
    action = np.concatenate(
        [rng.uniform(-0.004, 0.004, (30, 6)), rng.uniform(0, 1, (30, 1))], axis=1
    )
    points = rng.uniform(-0.5, 0.5, (30, 64, 3)).astype(np.float16)
    arrays = (points, state.astype(np.float32), action.astype(np.float32), np.array([30]))
    recorded = data.Demonstrations("stack-cube", "Stack the cube.", *arrays, {})
    policy.normalizer.fit(*(torch.from_numpy(x) for x in (points.astype(np.float32), *arrays[1:3])))
    data.save_demonstrations("demos.npz", recorded)
    info = {
        "suite": "own",
        "preset": "tiny",
        "arguments": {},
        "text_weights": "random-seed-0",
        "step": 0,
    }
    scripts.save_checkpoint(path, policy, **info)


def test_running_moves_the_arm_within_its_limits_and_ends_with_a_stop(emulator, cell, capsys):
    robot_policy("policy.pt")
    argv = ["run", *cell, "--checkpoint", "policy.pt", "--data", "demos.npz", "--seconds", "1.5"]
    assert ends(argv) == 0, capsys.readouterr().err
    printed = capsys.readouterr().out
    assert "stack-cube: running" in printed and "packages at 125 Hz" in printed
    assert np.linalg.norm(np.subtract(emulator.pose, START_POSE)[:3]) > 1e-3
    assert emulator.registers[0x0200] == 1 and any(
        frame[3] == 3 for frame in emulator.gripper_frames
    )
    assert_stop_is_last(emulator)


def test_a_dry_run_does_everything_but_motion(emulator, cell, capsys):
    robot_policy("policy.pt")
    argv = [
        "run",
        *cell,
        "--checkpoint",
        "policy.pt",
        "--data",
        "demos.npz",
        "--seconds",
        "1",
        "--dry-run",
    ]
    assert ends(argv) == 0, capsys.readouterr().err
    assert emulator.received == [] and emulator.programs == [] and emulator.owners == {}
    assert all(frame[1] == 3 for frame in emulator.gripper_frames)
    np.testing.assert_allclose(emulator.pose, START_POSE)


def test_trouble_in_a_dry_run_ends_it_with_the_reason_and_sends_nothing(emulator, cell, capsys):
    robot_policy("policy.pt")
    threading.Timer(1.5, lambda: setattr(emulator.faults, "safety_mode", 3)).start()
    argv = [
        "run",
        *cell,
        "--checkpoint",
        "policy.pt",
        "--data",
        "demos.npz",
        "--seconds",
        "20",
        "--dry-run",
    ]
    assert ends(argv) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "protective stop" in error and emulator.received == []


def test_keys_that_arrive_together_are_all_read(monkeypatch):
    Typing(monkeypatch, (0.0, "s\ne"))
    time.sleep(0.1)
    with robot.Keys() as keys:
        assert [keys.pressed() for _ in range(3)] == ["s", "e", ""]


@pytest.mark.parametrize(
    "fault, value, message",
    [
        ("safety_mode", 3, "protective stop"),
        ("gripper_silent", 1000, "gripper at 127.0.0.1"),
        ("drop", True, "closed"),
    ],
)
def test_trouble_while_running_stops_the_arm_and_ends_the_command_with_the_reason(
    emulator, cell, capsys, fault, value, message
):
    robot_policy("policy.pt")
    threading.Timer(1.5, lambda: setattr(emulator.faults, fault, value)).start()
    argv = ["run", *cell, "--checkpoint", "policy.pt", "--data", "demos.npz", "--seconds", "20"]
    assert ends(argv) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and message in error
    if fault != "drop":  # there the watchdog stops it
        assert_stop_is_last(emulator)


def test_ctrl_c_while_running_stops_the_arm(emulator, cell, monkeypatch):
    robot_policy("policy.pt")
    execute, chunks = robot.execute, []

    def interrupted(*args):
        chunks.append(None)
        if len(chunks) == 2:
            raise KeyboardInterrupt
        return execute(*args)

    monkeypatch.setattr(robot, "execute", interrupted)
    assert ends(["run", *cell, "--checkpoint", "policy.pt", "--data", "demos.npz"]) == 130
    assert_stop_is_last(emulator)


@pytest.mark.parametrize("lost_for", [0.4, 60])
def test_a_camera_that_gives_nothing_holds_the_arm_and_then_stops_it(
    emulator, cell, monkeypatch, capsys, lost_for
):
    robot_policy("policy.pt")
    read, began = robot.RecordedCamera.read, []

    def failing(self):
        began.append(time.monotonic())
        lost = 1.0 < time.monotonic() - began[0] < 1.0 + lost_for
        return np.zeros((120, 160), np.float32) if lost else read(self)

    monkeypatch.setattr(robot.RecordedCamera, "read", failing)
    argv = ["run", *cell, "--checkpoint", "policy.pt", "--data", "demos.npz", "--seconds", "4"]
    assert ends(argv) == (2 if lost_for > 1 else 0)
    error = capsys.readouterr().err
    assert lost_for < 1 or (
        error.count("\n") == 1 and "no new actions for 2 s: the camera's depth is empty" in error
    )
    assert_stop_is_last(emulator)


def test_a_policy_that_does_not_fit_the_robot_is_refused_before_connecting(cell, capsys):
    robot_policy("policy.pt", num_points=128)
    argv = ["run", *cell, "--checkpoint", "policy.pt", "--data", "demos.npz"]
    Path("robot.json").write_text(
        json.dumps(BOXES | {"num_points": 64, "rtde_port": 1})
    )  # nobody listens there
    assert ends(argv) == 2
    assert "128 points; the robot 7, 7 and 64" in capsys.readouterr().err
