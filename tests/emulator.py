"""An emulated UR10e with an AG95 gripper on loopback: RTDE, script port, dashboard, Modbus RTU; and
their faults.

    python -m tests.emulator                # on the real ports, until Ctrl-C: follow the README
    python -m tests.emulator --hand 2       # a hand moves the arm while it is free: 2 s a round

It shares no code with robot.py, so that both can be wrong only in different ways;
`tests/test_robot.py` has `ur-rtde` read and write it. Emulated are: recipes with their ids and
their ownership by a connection, data packages at the asked frequency, text messages, a program that
follows input registers (read from its text: registers, loop condition, watchdog), which takes time
to start and to brake, first-order motion of the arm with servoj's lookahead time, a script port
that talks and discards the program of a client that does not listen, and the gripper's registers.
Not emulated: kinematics (joints are made up), dynamics, collisions, URScript in general.
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
    "target_speed_fraction": "DOUBLE",
    "tcp_offset": "VECTOR6D",
    "payload": "DOUBLE",
    **{f"output_int_register_{i}": "INT32" for i in range(48)},
}
INPUT_TYPES = {
    **{f"input_double_register_{i}": "DOUBLE" for i in range(48)},
    **{f"input_int_register_{i}": "INT32" for i in range(48)},
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    "standard_digital_output_mask": "UINT8",
    "standard_digital_output": "UINT8",
    "configurable_digital_output_mask": "UINT8",
    "configurable_digital_output": "UINT8",
    "tool_digital_output_mask": "UINT8",
    "tool_digital_output": "UINT8",
    "standard_analog_output_mask": "UINT8",
    "standard_analog_output_type": "UINT8",
    "standard_analog_output_0": "DOUBLE",
    "standard_analog_output_1": "DOUBLE",
}
CODES = {"DOUBLE": "d", "INT32": "i", "UINT32": "I", "UINT8": "B", "VECTOR6D": "6d"}
START_POSE = (-0.20, -0.55, 0.30, 0.0, 3.0, 0.0)  # metres and axis-angle radians, base frame
CAMERA = (-0.20, -0.55, 0.90)  # of the scene, metres, base frame
GRIPPER_SECONDS, BRAKE_SECONDS = 0.1, 0.03  # time constants
START_SECONDS, STOPJ_SECONDS = 0.05, 0.12  # of a program, and of its braking


@dataclass
class Faults:
    """What goes wrong; set at any time."""

    refuse_version: bool = False
    version: tuple = (5, 15, 0)  # of the controller's software; 10 is PolyScope X
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
    mute: float = 0.0  # the script port says nothing until so many seconds after it took a program
    blocked: bool = False  # the arm stands, whatever it is told
    paused: bool = False  # the program is paused at the panel
    frozen: bool = False  # the controller's clock stands still
    backward: bool = False  # the controller's clock runs backwards
    torn: bool = False  # the program reads one half of a package, and another of the one before
    scaling: float = 1.0  # the program's motion is slower by this factor
    slider: float = 1.0  # what the speed slider says
    remote: str = "true"
    enabling_bit: bool = False  # a bit of the status that means no stop
    initializing: float = 0.05  # seconds that the gripper takes to initialize
    gripper_bad_crc: int = 0  # so many answers
    gripper_silent: int = 0
    gripper_exception: int = 0
    gripper_late: list[float] = field(default_factory=list)  # seconds that the next answers take


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
        self.messages: list[str] = []  # to all RTDE clients
        self.told: list[tuple] = []  # every pose that the program has followed
        self.ends: list[str] = []  # how programs have ended
        self.previous: dict[str, float] = {}  # the inputs before the newest package
        self.fastest = [0.0, 0.0]  # the arm, moved by a program: m/s, rad/s
        self.tcp_offset, self.payload = (0.0, 0.0, 0.17, 0.0, 0.0, 0.0), 1.1
        self.slave, self.ready_at = 1, 0.0
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
        handlers = {
            "rtde": self.serve_rtde,
            "script": self.serve_script,
            "dashboard": self.serve_dashboard,
            "gripper": self.serve_gripper,
        }
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
        """The arm follows a program's target, or a hand, or brakes."""
        target = self.run_program() if self.program is not None else None
        before = self.pose
        if self.free and self.hand:
            phase = 2 * math.pi * (time.monotonic() - self.began) / self.hand
            x, z = 0.05 * math.sin(phase), 0.05 * math.cos(phase)
            target = [START_POSE[0] + x, START_POSE[1], 0.25 + z, *START_POSE[3:]]
        if self.faults.blocked or (self.faults.paused and not self.free):
            step = np.zeros(6)
        elif target is not None:
            seconds = (self.program or {}).get("lookahead", 0.1) / self.faults.scaling
            seconds = 0.01 if self.free else seconds  # of the hand
            step = (1 - math.exp(-dt / seconds)) * pose_difference(before, target)
        else:
            step = dt * math.exp(-dt / BRAKE_SECONDS) * np.array(self.speed)
        if step.any():
            rotvec = turned(before[3:], step[3:]) if step[3:].any() else before[3:]
            self.pose = [*(np.array(before[:3]) + step[:3]).tolist(), *rotvec]
        self.speed = (step / dt).tolist()
        if not self.free:
            for part in (0, 1):
                speed = math.hypot(*self.speed[3 * part : 3 * part + 3])
                self.fastest[part] = max(self.fastest[part], speed)
        self.opening += (1 - math.exp(-dt / GRIPPER_SECONDS)) * (
            self.registers[0x0103] - self.opening
        )
        self.registers[0x0202] = round(self.opening)
        self.registers[0x0201] = 1 if abs(self.opening - self.registers[0x0103]) < 5 else 0
        if self.registers[0x0200] == 2 and time.monotonic() > self.ready_at:
            self.registers[0x0200] = 1

    def run_program(self) -> list[float] | None:
        """One turn of the program's loop: the pose to follow; None when there is none."""
        p, now = self.program, time.monotonic()
        if self.faults.safety_mode not in (1, 2) or self.faults.robot_mode != 7:
            return self.end_program("stopped for safety")
        if self.faults.lose_program:
            return self.end_program("no inverse kinematics")
        if p["kind"] == "foreign" or now < p["begins"]:
            return None
        if (
            p["watchdog"]
            and now - max(self.written.get(p["watchdog"], 0), p["begins"]) > 1 / p["hz"]
        ):
            return self.end_program("watchdog")
        if self.faults.paused:
            return None
        if p["braking"]:
            if now > p["braking"]:
                self.outputs[p["state"]] = 0  # the line after stopj
                self.end_program("finished")
            return None
        if "old" not in p:  # the first lines
            self.outputs[p["state"]] = p["value"]
            if p["counter"]:
                self.outputs[p["counter"]] = 0
            p["old"] = None
        if self.inputs[p["while"]] != p["value"]:
            p["braking"], self.free = now + STOPJ_SECONDS, False
            if p["rests"]:
                p["watchdog"] = None
            return None
        inputs = self.inputs
        if self.faults.torn:  # the newest package has arrived as far as its middle
            names = list(self.previous)
            inputs = inputs | {name: self.previous[name] for name in names[len(names) // 2 :]}
        if p["numbers"] and inputs[p["numbers"][0]] != inputs[p["numbers"][1]]:
            return p["old"]
        if p["counter"]:
            self.outputs[p["counter"]] = inputs[p["numbers"][0]]
        self.free = p["kind"] == "freedrive"
        if self.free:
            return None
        p["old"] = [inputs[name] for name in p["pose"]]
        self.told.append(tuple(p["old"]))
        return p["old"]

    def end_program(self, why: str) -> None:
        """The program is gone; its registers stay as they are."""
        self.program, self.free = None, False
        self.ends.append(why)
        if why not in ("finished", "replaced"):
            self.messages.append(f"program ended: {why}")

    # ---- Script port

    def serve_script(self, connection: socket.socket) -> None:
        """Takes a program when its last line is there, and tells its state all the time."""
        if not self.faults.mute:
            connection.sendall(struct.pack(">iB", 100, 16) + bytes(95))
        text = b""
        while not text.endswith(b"\nend\n"):
            part = connection.recv(65536)
            if not part:
                return
            text += part
        time.sleep(START_SECONDS / 2)
        if select.select([connection], [], [], START_SECONDS / 2)[0]:
            # The client has closed. If it had read nothing, recv raises an error, or the socket
            # keeps one.
            connection.recv(65536)
            if connection.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
                return
        self.load(text.decode())
        time.sleep(self.faults.mute)
        with contextlib.suppress(OSError):
            while not self.ended.is_set() and not select.select([connection], [], [], 0.1)[0]:
                connection.sendall(struct.pack(">iB", 100, 16) + bytes(95))

    def load(self, program: str) -> None:
        def register(pattern: str, name: str) -> str | None:
            found = re.search(pattern, program)
            return found and f"{name}_register_{found[1]}"

        with self.lock:
            self.programs.append(program)
            if self.program:
                self.end_program("replaced")
            opened = len(re.findall(r"^ *(?:def|while|if) ", program, flags=re.M))
            whole = re.match(r"def \w+\(\):\n(  .*\n)+end\n$", program)
            whole = whole and opened == len(re.findall(r"^ *end$", program, flags=re.M))
            if self.faults.no_program or not whole:  # it does not compile
                return
            self.program = {"kind": "foreign", "watchdog": None}
            loop = re.search(r"while read_input_integer_register\((\d+)\) == (\d+):", program)
            pose = re.search(r"p\[(.*)\]", program)
            servo = pose and "get_inverse_kin(pose" in program and "servoj(" in program
            free = "  freedrive_mode()\n" in program and "  end_freedrive_mode()\n" in program
            if not loop or not (servo or free):
                self.free = "  freedrive_mode()\n" in program  # until somebody ends it
                return
            armed = program[: loop.start()]  # before the arm is moved, or free
            watchdog = re.search(r'rtde_set_watchdog\("(\w+)", ([\d.]+), "stop"\)', armed)
            lookahead = re.search(r"lookahead_time=([\d.]+)", program)
            first = register(r"number = read_input_integer_register\((\d+)\)", "input_int")
            second = register(r"number == read_input_integer_register\((\d+)\)", "input_int")
            state = rf"write_output_integer_register\((\d+), {loop[2]}\)"
            self.began = time.monotonic()
            registers = re.findall(r"float_register\((\d+)\)", pose[1] if pose else "")
            braking = program.split("  stopj(")[0].rsplit("rtde_set_watchdog", 1)[-1]
            self.program = {
                "kind": "servo" if servo else "freedrive",
                "counter": register(
                    r"write_output_integer_register\((\d+), number\)", "output_int"
                ),
                "while": f"input_int_register_{loop[1]}",
                "value": int(loop[2]),
                "pose": [f"input_double_register_{n}" for n in registers],
                "numbers": (first, second) if first and second else None,
                "watchdog": watchdog and watchdog[1],
                "hz": watchdog and float(watchdog[2]),
                "state": register(state, "output_int"),
                "lookahead": float(lookahead[1]) if lookahead else 0.1,
                "rests": '"ignore")' in braking,  # the watchdog, while the arm is braked
                "begins": self.began + START_SECONDS,
                "braking": 0.0,
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
                    "is in remote control": self.faults.remote,
                    "PolyscopeVersion": "URSoftware 5.15.0.126650 (Sep 10 2023)",
                }
                answer = answers.get(line.strip(), f"could not understand: {line.strip()}")
                connection.sendall(f"{answer}\n".encode())

    # ---- RTDE

    def value(self, name: str):
        faults = self.faults
        if name in self.outputs:
            return self.outputs[name]
        clock = time.monotonic() - self.clock
        return {
            "timestamp": 1.0 if faults.frozen else 1e6 - clock if faults.backward else clock,
            "target_q": tuple(self.pose),  # no kinematics here
            "actual_q": tuple(self.pose),
            "actual_TCP_pose": tuple(self.pose),
            "actual_TCP_speed": tuple(self.speed),
            "robot_mode": faults.robot_mode,
            "safety_mode": faults.safety_mode,
            "runtime_state": 1 if not self.program else 4 if self.faults.paused else 2,
            "robot_status_bits": 0b1 | (0b10 if self.program else 0),
            "safety_status_bits": faults.safety_status_bits | faults.enabling_bit << 11,
            "speed_scaling": faults.scaling * faults.slider,
            "target_speed_fraction": faults.slider,
            "tcp_offset": self.tcp_offset,
            "payload": self.payload,
        }[name]

    def serve_rtde(self, connection: socket.socket) -> None:
        """One client: one output recipe, up to 255 input recipes, each known by its id."""
        me, names, frequency, sending, buffer, due = id(connection), [], 125.0, False, b"", 0.0
        recipes: dict[int, list[str]] = {}
        batch: list[bytes] = []
        messages_sent = len(self.messages)

        def send(kind: str, payload: bytes) -> None:
            package = struct.pack(">HB", 3 + len(payload), ord(kind)) + payload
            pieces = [package] if not self.faults.one_byte else [bytes([b]) for b in package]
            for piece in pieces:
                connection.sendall(piece)

        def say(text: str, level: int = 0) -> None:
            source = b"RTDE"
            lengths = bytes([len(text)]) + text.encode() + bytes([len(source)])
            send("M", lengths + source + bytes([level]))

        def set_up(asked: bytes, types: dict[str, str]) -> tuple[list[str], list[str]]:
            fields = [name for name in asked.decode().split(",") if name]
            unknown = self.faults.not_found
            return fields, [
                "NOT_FOUND" if n in unknown else types.get(n, "NOT_FOUND") for n in fields
            ]

        def handle(kind: str, payload: bytes) -> bool:
            """Answers one package; False ends the connection."""
            nonlocal names, frequency, sending, due
            if kind == "V":
                send("V", bytes([payload == b"\0\2" and not self.faults.refuse_version]))
            elif kind == "v":
                send("v", struct.pack(">IIII", *self.faults.version, 0))
            elif kind == "O":
                (frequency,) = struct.unpack_from(">d", payload)
                fields, kinds = set_up(payload[8:], TYPES)
                valid = bool(fields) and "NOT_FOUND" not in kinds and 1 <= frequency <= 500
                names = fields if valid else []
                send("O", bytes([valid]) + ",".join(kinds).encode())
            elif kind == "I":
                with self.lock:
                    fields, kinds = set_up(payload, INPUT_TYPES)
                    for i, name in enumerate(fields):
                        if name in self.faults.in_use or self.owners.get(name, me) != me:
                            kinds[i] = "IN_USE"  # by another client
                    number = len(recipes) + 1 if all(kind in CODES for kind in kinds) else 0
                    if number:
                        recipes[number] = fields
                        for name in fields:
                            self.owners[name] = me
                send("I", bytes([number]) + ",".join(kinds).encode())
            elif kind == "S":
                sending, due = bool(names), time.monotonic()
                send("S", bytes([sending]))
            elif kind == "P":
                sending = False
                send("P", b"\x01")
            elif kind == "U":
                fields = recipes.get(payload[0] if payload else 0)
                codes = "".join(CODES[INPUT_TYPES[name]] for name in fields or [])
                layout = struct.Struct(f">B{codes}")
                if fields is None or layout.size != len(payload):
                    say("an input package of an unknown recipe, or of a wrong size")
                    return False
                self.take(dict(zip(fields, layout.unpack(payload)[1:])))
            elif kind != "M":
                say(f"unknown package type {kind}")
                return False
            return True

        try:
            while not self.ended.is_set() and not self.faults.drop:
                wait = min(max(0.0, due - time.monotonic()) if sending else 0.05, 0.05)
                if self.faults.deaf:
                    time.sleep(wait)
                elif select.select([connection], [], [], wait)[0]:
                    part = connection.recv(65536)
                    if not part:
                        return
                    buffer += part
                while len(buffer) >= 3:
                    (size,) = struct.unpack_from(">H", buffer)
                    if size < 3:
                        return say(f"a package of {size} bytes")
                    if len(buffer) < size:
                        break
                    kind, payload, buffer = chr(buffer[2]), buffer[3:size], buffer[size:]
                    if not handle(kind, payload):
                        return
                while messages_sent < len(self.messages):
                    messages_sent += 1
                    if sending:
                        say(self.messages[messages_sent - 1], 1)
                if sending and not self.faults.silent and time.monotonic() >= due:
                    due = max(due + 1 / frequency, time.monotonic() - 1 / frequency)
                    payload = b"\x01"
                    with self.lock:
                        for name in names:
                            value = self.value(name)
                            values = value if isinstance(value, tuple) else (value,)
                            payload += struct.pack(">" + CODES[TYPES[name]], *values)
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
            if self.faults.drop:  # in order: closed with packages unread it would be reset instead
                connection.shutdown(socket.SHUT_WR)
                connection.settimeout(1)
                while connection.recv(65536):
                    pass
        finally:
            with self.lock:
                self.owners = {name: owner for name, owner in self.owners.items() if owner != me}

    def take(self, values: dict[str, float]) -> None:
        """Writes the inputs of one package."""
        with self.lock:
            now = time.monotonic()
            self.previous = {name: self.inputs.get(name, 0) for name in values}
            for name, value in values.items():
                self.inputs[name] = value
                self.written[name] = now
            if values.get("speed_slider_mask"):
                self.faults.slider = values["speed_slider_fraction"]
            self.received.append((now, values))

    # ---- Gripper

    def serve_gripper(self, connection: socket.socket) -> None:
        buffer = b""
        while not self.ended.is_set() and (part := connection.recv(4096)):
            buffer += part
            while len(buffer) >= 8:
                frame, buffer = buffer[:8], buffer[8:]
                if modbus_crc(frame[:6]) != frame[6:] or frame[0] != self.slave:
                    continue  # as a slave does: no answer
                self.gripper_frames.append(frame)
                answer = self.answer(frame)
                time.sleep(self.faults.gripper_late.pop(0) if self.faults.gripper_late else 0)
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
                    self.registers[0x0200] = 2
                    self.ready_at = time.monotonic() + self.faults.initializing
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
        # Where a ray meets the plane of the cube's top
        x = CAMERA[0] + (columns - width / 2) / focal * 0.85
        y = CAMERA[1] - (rows - height / 2) / focal * 0.85
        center = CAMERA[0] + 0.05 * math.sin(2 * math.pi * frame / frames)
        on_top = (abs(x - center) < 0.025) & (abs(y - CAMERA[1]) < 0.025)
        depth[frame] = np.where(on_top, 850, 900)  # millimetres
    np.savez(path, depth=depth, intrinsics=np.array([focal, focal, width / 2, height / 2]))


def pose_difference(pose, target) -> np.ndarray:
    """The step (6,) in metres and radians from one pose to another."""
    turn = turned([-x for x in pose[3:]], target[3:])
    return np.array([b - a for a, b in zip(pose[:3], target[:3])] + turn)


def turned(rotvec, by) -> list[float]:
    """A rotation vector, turned by another: half angles are added on the sphere.

    In plain numbers: 500 times a second, in a process that is busy with what is tested.
    """
    halves = []
    for vector in (rotvec, by):
        angle = math.hypot(*vector)
        axis = [float(x) / angle for x in vector] if angle else [0.0, 0.0, 0.0]
        halves.append((math.cos(angle / 2), [math.sin(angle / 2) * x for x in axis]))
    (cos_a, a), (cos_b, b) = halves
    cos = cos_a * cos_b - sum(x * y for x, y in zip(a, b))
    cross = [b[1] * a[2] - b[2] * a[1], b[2] * a[0] - b[0] * a[2], b[0] * a[1] - b[1] * a[0]]
    sin = [cos_a * y + cos_b * x + z for x, y, z in zip(a, b, cross)]
    length = math.hypot(*sin)
    if length == 0.0:
        return [0.0, 0.0, 0.0]
    angle = 2 * math.atan2(length, cos)
    return [x / length * (angle if angle <= math.pi else angle - 2 * math.pi) for x in sin]


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


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Emulate a UR10e and its gripper on loopback.")
    parser.add_argument(
        "--hand", type=float, default=4.0, help="seconds a round of the hand that guides a free arm"
    )
    parser.add_argument(
        "--scene", metavar="FILE", default="scene.npz", help="recorded camera to write (scene.npz)"
    )
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    args = parse(argv)
    write_scene(args.scene)
    print(f"wrote {args.scene}, a recorded camera")
    with Emulator(30004, 30002, 29999, 54321, args.hand) as emulator:
        print(f"emulating a UR10e on 127.0.0.1, ports {emulator.ports}; Ctrl-C ends it", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            threading.Event().wait()


if __name__ == "__main__":
    main()
