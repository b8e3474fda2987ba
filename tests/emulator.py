"""An emulated UR10e with an AG95 gripper on loopback: RTDE, script port, dashboard, Modbus RTU; and
their faults.

    python -m tests.emulator                # on the real ports, until Ctrl-C: follow the README's
    robot section with it python -m tests.emulator --hand 2       # and a hand that moves the arm
    while it is free, for recording

It shares no code with robot.py, so that both can be wrong only in different ways;
`tests/test_robot.py` has `ur-rtde` read it. Emulated are: recipes and their ownership by a
connection, data packages at the asked frequency, a program that follows input registers (read from
its text: registers, loop condition, watchdog), first-order motion of the arm, and the gripper's
registers. Not emulated: kinematics (joints are made up), dynamics, collisions, URScript in general.
"""

import argparse
import contextlib
import math
import re
import select
import socket
import struct
import threading
import time
from dataclasses import dataclass, field

import numpy as np

TYPES = {
    "timestamp": "DOUBLE",
    "target_q": "VECTOR6D",
    "actual_q": "VECTOR6D",
    "actual_TCP_pose": "VECTOR6D",
    "actual_TCP_speed": "VECTOR6D",
    "robot_mode": "INT32",
    "safety_mode": "INT32",
    "runtime_state": "UINT32",
    "robot_status_bits": "UINT32",
    "safety_status_bits": "UINT32",
    "speed_scaling": "DOUBLE",
    **{f"output_int_register_{i}": "INT32" for i in range(48)},
}
INPUT_TYPES = {f"input_double_register_{i}": "DOUBLE" for i in range(48)}
INPUT_TYPES |= {f"input_int_register_{i}": "INT32" for i in range(48)}
CODES = {"DOUBLE": "d", "INT32": "i", "UINT32": "I", "VECTOR6D": "6d"}
START_POSE = (-0.20, -0.55, 0.30, 0.0, 3.0, 0.0)  # metres and axis-angle radians, base frame
CAMERA = (-0.20, -0.55, 0.90)  # of the scene, metres, base frame
ARM_SECONDS, GRIPPER_SECONDS = 0.03, 0.1  # time constants of the first-order motion


@dataclass
class Faults:
    """What goes wrong; set at any time."""

    refuse_version: bool = False
    not_found: set[str] = field(default_factory=set)
    in_use: set[str] = field(default_factory=set)
    silent: bool = False  # no more data packages: the state grows stale
    one_byte: bool = False  # packages arrive in pieces of a byte
    joined: int = 1  # so many data packages in one write
    garbage: bool = False  # the next data package's size is wrong
    drop: bool = False  # the connections are closed
    deaf: bool = False  # inputs are not read
    safety_mode: int = 1
    safety_status_bits: int = 0b1
    robot_mode: int = 7
    lose_program: bool = False  # the program ends
    no_program: bool = False  # programs are taken and not started
    blocked: bool = False  # the arm stands, whatever it is told
    paused: bool = False  # the program is paused at the panel
    frozen: bool = False  # the same state again and again
    gripper_bad_crc: int = 0  # so many answers
    gripper_silent: int = 0
    gripper_exception: int = 0


class Emulator:
    """All of it, in threads; a context manager. Ports of 0 are chosen freely; see `ports`."""

    def __init__(
        self,
        rtde: int = 0,
        script: int = 0,
        dashboard: int = 0,
        gripper: int = 0,
        hand: float = 0.0,
    ):
        self.faults, self.lock = Faults(), threading.RLock()
        self.ended, self.clock = threading.Event(), time.monotonic()
        self.pose, self.speed, self.free = list(START_POSE), [0.0] * 6, False
        self.inputs = {name: 0 if kind == "INT32" else 0.0 for name, kind in INPUT_TYPES.items()}
        self.outputs = {name: 0 for name in TYPES if name.startswith("output_")}
        self.owners: dict[str, int] = {}  # input field -> the connection that holds it
        self.received: list[tuple[float, dict]] = []  # when, and the fields of each input package
        self.written: dict[str, float] = {}  # when each input was written last
        self.program: dict | None = None
        self.programs: list[str] = []
        self.dashboard_lines: list[str] = []
        self.registers = {0x0100: 0, 0x0101: 50, 0x0103: 1000, 0x0200: 0, 0x0201: 1, 0x0202: 1000}
        self.gripper_frames: list[bytes] = []
        self.opening, self.hand, self.began = 1000.0, hand, time.monotonic()
        self.servers = {
            name: socket.create_server(("127.0.0.1", port))
            for name, port in {
                "rtde": rtde,
                "script": script,
                "dashboard": dashboard,
                "gripper": gripper,
            }.items()
        }
        self.ports = {name: server.getsockname()[1] for name, server in self.servers.items()}

    def __enter__(self) -> "Emulator":
        handlers = {"rtde": self.serve_rtde, "script": self.serve_script}
        handlers |= {"dashboard": self.serve_dashboard, "gripper": self.serve_gripper}
        for name, server in self.servers.items():
            threading.Thread(target=self.accept, args=(server, handlers[name]), daemon=True).start()
        threading.Thread(target=self.move, daemon=True).start()
        return self

    def __exit__(self, *_) -> None:
        self.ended.set()
        for server in self.servers.values():
            server.close()

    def accept(self, server: socket.socket, handler) -> None:
        while not self.ended.is_set():
            with contextlib.suppress(OSError):
                if select.select([server], [], [], 0.1)[0]:
                    threading.Thread(
                        target=self.guard, args=(handler, server.accept()[0]), daemon=True
                    ).start()

    def guard(self, handler, connection: socket.socket) -> None:
        with connection, contextlib.suppress(OSError):  # the client is gone
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            handler(connection)

    # ---- Motion

    def move(self) -> None:
        """500 steps a second of program, arm and gripper."""
        dt, due = 0.002, time.monotonic()
        while not self.ended.is_set():
            with self.lock:
                self.step(dt)
            due += dt
            time.sleep(max(0.0, due - time.monotonic()))

    def step(self, dt: float) -> None:
        target = None
        if self.program is not None:
            target = self.run_program()
        if self.free and self.hand:
            phase = 2 * math.pi * (time.monotonic() - self.began) / self.hand
            target = [
                START_POSE[0] + 0.05 * math.sin(phase),
                *START_POSE[1:2],
                0.25 + 0.05 * math.cos(phase),
                *START_POSE[3:],
            ]
        share = 1 - math.exp(-dt / ARM_SECONDS)
        before = list(self.pose)
        if target is not None and not self.faults.blocked:
            self.pose = [p + share * (t - p) for p, t in zip(self.pose, target)]
        self.speed = [(p - b) / dt for p, b in zip(self.pose, before)]
        self.opening += (1 - math.exp(-dt / GRIPPER_SECONDS)) * (
            self.registers[0x0103] - self.opening
        )
        self.registers[0x0202] = round(self.opening)
        self.registers[0x0201] = 1 if abs(self.opening - self.registers[0x0103]) < 5 else 0

    def run_program(self) -> list[float] | None:
        """One turn of the servo program's loop; None when it has ended."""
        p = self.program
        stopped = (
            self.faults.safety_mode not in (1, 2)
            or self.faults.robot_mode != 7
            or self.faults.lose_program
        )
        late = (
            p["watchdog"]
            and time.monotonic() - self.written.get(p["watchdog"], p["began"]) > 1 / p["hz"]
        )
        if p["kind"] == "foreign":
            self.program = None if stopped else p
            return None
        if self.faults.paused:
            return None
        ended = self.inputs[p["while"]] != p["value"]
        if stopped or late or ended:
            self.program, self.free = None, False
            if not stopped and not late:
                self.outputs[p["state"]] = 0  # the line after the loop
            return None
        self.outputs[p["state"]] = p["value"]
        self.outputs[p["counter"]] += 1
        self.free = p["kind"] == "freedrive"
        if self.free:
            return None
        return [self.inputs[name] for name in p["pose"]]

    # ---- Script port

    def serve_script(self, connection: socket.socket) -> None:
        text = b""
        while part := connection.recv(65536):
            text += part
        program = text.decode()
        with self.lock:
            self.programs.append(program)
            self.program, self.free = None, False
            if self.faults.no_program or not re.match(r"def \w+\(\):\n(  .*\n)+end\n$", program):
                return
            self.program = {"kind": "foreign", "watchdog": None}
            loop = re.search(r"while read_input_integer_register\((\d+)\) == (\d+):", program)
            pose = re.search(r"p\[(.*)\]", program)
            servo = pose and "get_inverse_kin(pose" in program and "servoj(q, t=" in program
            free = "  freedrive_mode()\n" in program and "  end_freedrive_mode()\n" in program
            if loop and (servo or free):
                watchdog = re.search(r'rtde_set_watchdog\("(\w+)", ([\d.]+), "stop"\)', program)
                state = re.search(rf"write_output_integer_register\((\d+), {loop[2]}\)", program)
                counter = re.search(r"write_output_integer_register\((\d+), n\)", program)
                self.began = time.monotonic()
                self.outputs[f"output_int_register_{counter[1]}"] = 0
                self.program = {
                    "kind": "servo" if servo else "freedrive",
                    "counter": f"output_int_register_{counter[1]}",
                    "while": f"input_int_register_{loop[1]}",
                    "value": int(loop[2]),
                    "pose": [
                        f"input_double_register_{n}"
                        for n in re.findall(r"float_register\((\d+)\)", pose[1] if pose else "")
                    ],
                    "watchdog": watchdog and watchdog[1],
                    "hz": watchdog and float(watchdog[2]),
                    "state": f"output_int_register_{state[1]}",
                    "began": time.monotonic(),
                }

    # ---- Dashboard

    def serve_dashboard(self, connection: socket.socket) -> None:
        connection.sendall(b"Connected: Universal Robots Dashboard Server\n")
        modes = {7: "RUNNING", 3: "POWER_OFF", 5: "IDLE"}
        safety = {1: "NORMAL", 2: "REDUCED", 3: "PROTECTIVE_STOP", 7: "ROBOT_EMERGENCY_STOP"}
        with connection.makefile("r") as lines:
            for line in lines:
                self.dashboard_lines.append(line.strip())
                answers = {
                    "robotmode": f"Robotmode: {modes.get(self.faults.robot_mode, 'UNKNOWN')}",
                    "safetystatus": f"Safetystatus: {safety.get(self.faults.safety_mode, 'FAULT')}",
                    "programState": f"{'PLAYING' if self.program else 'STOPPED'} dami",
                }
                answer = answers.get(line.strip(), f"could not understand: {line.strip()}")
                connection.sendall(f"{answer}\n".encode())

    # ---- RTDE

    def value(self, name: str):
        faults, angle = self.faults, self.pose
        if name in self.outputs:
            return self.outputs[name]
        return {
            "timestamp": 1.0 if faults.frozen else time.monotonic() - self.clock,
            "target_q": tuple(angle),
            "actual_q": tuple(angle),  # no kinematics here
            "actual_TCP_pose": tuple(self.pose),
            "actual_TCP_speed": tuple(self.speed),
            "robot_mode": faults.robot_mode,
            "safety_mode": faults.safety_mode,
            "runtime_state": 4 if self.faults.paused else 2 if self.program else 1,
            "robot_status_bits": 0b1 | (0b10 if self.program else 0),
            "safety_status_bits": faults.safety_status_bits,
            "speed_scaling": 1.0,
        }[name]

    def serve_rtde(self, connection: socket.socket) -> None:
        me, names, frequency, inputs, sending, buffer, due = (
            id(connection),
            [],
            125.0,
            [],
            False,
            b"",
            0.0,
        )
        batch: list[bytes] = []

        def send(kind: str, payload: bytes) -> None:
            package = struct.pack(">HB", 3 + len(payload), ord(kind)) + payload
            if self.faults.one_byte:
                for byte in package:
                    connection.sendall(bytes([byte]))
            else:
                connection.sendall(package)

        def set_up(asked: bytes, types: dict[str, str]) -> tuple[list[str], list[str]]:
            fields = [name for name in asked.decode().split(",") if name]
            kinds = [
                "NOT_FOUND" if n in self.faults.not_found else types.get(n, "NOT_FOUND")
                for n in fields
            ]
            return fields, kinds

        try:
            while not self.ended.is_set() and not self.faults.drop:
                wait = max(0.0, due - time.monotonic()) if sending else 0.05
                readable = (
                    not self.faults.deaf and select.select([connection], [], [], min(wait, 0.05))[0]
                )
                if self.faults.deaf:
                    time.sleep(min(wait, 0.05))
                if readable:
                    part = connection.recv(65536)
                    if not part:
                        return
                    buffer += part
                while len(buffer) >= 3 and len(buffer) >= (
                    size := struct.unpack_from(">H", buffer)[0]
                ):
                    kind, payload, buffer = chr(buffer[2]), buffer[3:size], buffer[size:]
                    if kind == "V":
                        send("V", bytes([not self.faults.refuse_version]))
                    elif kind == "v":
                        send("v", struct.pack(">IIII", 5, 15, 0, 0))
                    elif kind == "O":
                        frequency = struct.unpack_from(">d", payload)[0]
                        names, kinds = set_up(payload[8:], TYPES)
                        send("O", bytes(["NOT_FOUND" not in kinds]) + ",".join(kinds).encode())
                    elif kind == "I":
                        with self.lock:
                            inputs, kinds = set_up(payload, INPUT_TYPES)
                            for i, name in enumerate(inputs):
                                if name in self.faults.in_use or self.owners.get(name, me) != me:
                                    kinds[i] = "IN_USE"
                            accepted = all(kind in CODES for kind in kinds)
                            if accepted:
                                self.owners |= dict.fromkeys(inputs, me)
                        send("I", bytes([7 if accepted else 0]) + ",".join(kinds).encode())
                    elif kind == "S":
                        sending, due = bool(names), time.monotonic()
                        send("S", bytes([sending]))
                    elif kind == "P":
                        sending = False
                        send("P", b"\x01")
                    elif kind == "U":
                        layout = struct.Struct(
                            ">B" + "".join(CODES[INPUT_TYPES[name]] for name in inputs)
                        )
                        _, *values = layout.unpack(payload)
                        with self.lock:
                            now = time.monotonic()
                            self.inputs |= dict(zip(inputs, values))
                            self.written |= dict.fromkeys(inputs, now)
                            self.received.append((now, dict(zip(inputs, values))))
                if sending and not self.faults.silent and time.monotonic() >= due:
                    due = max(due + 1 / frequency, time.monotonic() - 1 / frequency)
                    payload = b"\x01"
                    with self.lock:
                        for name in names:
                            value = self.value(name)
                            payload += struct.pack(
                                ">" + CODES[TYPES[name]],
                                *(value if isinstance(value, tuple) else (value,)),
                            )
                    if self.faults.garbage:
                        connection.sendall(struct.pack(">HB", 1, ord("U")) + payload)
                        return
                    batch.append(struct.pack(">HB", 3 + len(payload), ord("U")) + payload)
                    if self.faults.one_byte:
                        send("U", payload)
                        batch = []
                    elif len(batch) >= self.faults.joined:
                        connection.sendall(b"".join(batch))
                        batch = []
        finally:
            with self.lock:
                self.owners = {name: owner for name, owner in self.owners.items() if owner != me}

    # ---- Gripper

    def serve_gripper(self, connection: socket.socket) -> None:
        buffer = b""
        while not self.ended.is_set() and (part := connection.recv(4096)):
            buffer += part
            while len(buffer) >= 8:
                frame, buffer = buffer[:8], buffer[8:]
                if modbus_crc(frame[:6]) != frame[6:]:
                    continue  # as a slave does: no answer
                self.gripper_frames.append(frame)
                answer = self.answer(frame)
                if self.faults.gripper_silent:
                    self.faults.gripper_silent -= 1
                    continue
                if self.faults.gripper_bad_crc:
                    self.faults.gripper_bad_crc -= 1
                    answer = answer[:-1] + bytes([answer[-1] ^ 0xFF])
                connection.sendall(answer)

    def answer(self, frame: bytes) -> bytes:
        slave, function, register, value = struct.unpack(">BBHH", frame[:6])
        with self.lock:
            if (
                self.faults.gripper_exception
                or register not in self.registers
                or function not in (3, 6)
            ):
                self.faults.gripper_exception = max(0, self.faults.gripper_exception - 1)
                body = bytes([slave, function | 0x80, 2])
            elif function == 3:
                body = struct.pack(">BBBH", slave, 3, 2, self.registers[register])
            else:
                self.registers[register] = value
                if register == 0x0100:
                    self.registers[0x0200] = 1
                body = frame[:6]
        return body + modbus_crc(body)


def write_scene(path, frames: int = 20) -> None:
    """A recorded camera: 0.9 m above a table, looking straight down at a cube of 5 cm that slides
    to and fro.
    """
    height, width, focal = 120, 160, 140.0
    rows, columns = np.mgrid[:height, :width]
    depth = np.empty((frames, height, width), np.uint16)
    for frame in range(frames):
        x = (
            CAMERA[0] + (columns - width / 2) / focal * 0.85
        )  # where a ray meets the plane of the cube's top
        y = CAMERA[1] - (rows - height / 2) / focal * 0.85
        center = CAMERA[0] + 0.05 * math.sin(2 * math.pi * frame / frames)
        on_top = (abs(x - center) < 0.025) & (abs(y - CAMERA[1]) < 0.025)
        depth[frame] = np.where(on_top, 850, 900)  # millimetres
    np.savez(path, depth=depth, intrinsics=np.array([focal, focal, width / 2, height / 2]))


def modbus_crc(data: bytes) -> bytes:
    """CRC-16/MODBUS by its table, low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc = (crc >> 8) ^ CRC_TABLE[(crc ^ byte) & 0xFF]
    return struct.pack("<H", crc)


def table_entry(value: int) -> int:
    for _ in range(8):
        value = (value >> 1) ^ (0xA001 * (value & 1))
    return value


CRC_TABLE = [table_entry(value) for value in range(256)]


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Emulate a UR10e and its gripper on loopback.")
    parser.add_argument(
        "--hand", type=float, default=4.0, help="seconds a round of the hand that guides a free arm"
    )
    parser.add_argument(
        "--scene", metavar="FILE", default="scene.npz", help="recorded camera to write (scene.npz)"
    )
    args = parser.parse_args(argv)
    write_scene(args.scene)
    print(f"wrote {args.scene}, a recorded camera")
    with Emulator(30004, 30002, 29999, 54321, args.hand) as emulator:
        print(f"emulating a UR10e on 127.0.0.1, ports {emulator.ports}; Ctrl-C ends it", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            threading.Event().wait()


if __name__ == "__main__":
    main()
