"""Random faults against the emulated arm, and random poses for a simulated one.

    python -m tests.fuzz_robot --scripts 50 --poses 1000

Whatever faults come and go, the arm is never faster than the settings allow. Whatever pose it is
sent to, it is there in the time that the way needs, and one second. Faults need sockets, threads
and real time; poses need neither: their clock is simulated, so that no busy machine disturbs them.
"""

import argparse
import contextlib
import math
import time
from unittest import mock

import numpy as np
from scipy.spatial.transform import Rotation

import robot
from tests.emulator import Emulator, pose_difference

FAULTS = (
    "blocked paused frozen backward silent deaf torn lose_program garbage drop one_byte joined "
    "slider scaling foreign pushed late"
).split()


def fuzz_robot(seed: int, rounds: int = 8) -> tuple[list[float], list[float], str | None]:
    """Faults come and go at random while a policy asks the emulated arm for more than it may.

    Returns the highest speeds of the arm (m/s, rad/s), the limits, and why it was stopped. The
    speeds are 0 where it was stopped before it moved, as on a machine that is too busy.
    """
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=6)
    with Emulator() as emulator:
        settings = robot.Settings(
            **{f"{name}_port": port for name, port in emulator.ports.items()},
            tcp_low_m=[-1.2, -1.5, -0.7],
            tcp_high_m=[0.8, 0.5, 1.3],
            crop_low_m=[-1, -1, -1],
            crop_high_m=[1, 1, 1],
            max_speed_m_s=rng.uniform(0.05, 0.5),
            max_speed_rad_s=rng.uniform(0.1, 1),
            camera_to_base=np.eye(4, dtype=int).tolist(),
            servo_lookahead_s=rng.uniform(0.03, 0.2),
            max_lag_m=0.12,
            max_lag_rad=0.3,
            max_step_m=0.5,
            max_step_rad=3.0,
            max_hold_s=10,
        )
        if rng.random() < 0.3:  # a tool that points down
            emulator.pose[3:] = [0.0, np.pi, 0.0]
        rtde = robot.RTDE("127.0.0.1", settings.rtde_port, settings.servo_hz, True)
        servo = robot.Servo(rtde, settings)
        servo.start("127.0.0.1")
        with contextlib.suppress(robot.RobotError):
            for _ in range(rounds):
                name = FAULTS[rng.integers(len(FAULTS))]
                if rng.random() < 0.2:
                    direction = rng.normal(size=6)
                step = 0.06 * direction / np.linalg.norm(direction) * rng.uniform(0.2, 1)
                servo.follow(np.tile(np.append(step, 0), (8, 1)))
                time.sleep(rng.uniform(0.02, 0.2))
                if name == "foreign":
                    emulator.load("def other():\n  sleep(9)\nend\n")
                elif name == "pushed":  # held, moved by somebody, let go
                    emulator.faults.blocked = True
                    with emulator.lock:
                        emulator.pose[rng.integers(3)] += rng.uniform(-0.05, 0.05)
                    time.sleep(0.05)
                    emulator.faults.blocked = False
                elif name == "late":
                    time.sleep(rng.uniform(0.1, 0.4))
                else:
                    values = {"joined": 12, "slider": 0.5, "scaling": rng.uniform(0.05, 0.9)}
                    setattr(emulator.faults, name, values.get(name, True))
                    time.sleep(rng.uniform(0.005, 0.15))
                    emulator.faults = type(emulator.faults)()
            servo.check()
        reason = servo.error
        time.sleep(0.3)  # whatever was held back goes on now
        servo.stop()
        rtde.close()
        return emulator.fastest, [settings.max_speed_m_s, settings.max_speed_rad_s], reason


# ---- Poses, in simulated time --------------------------------------------------------------------


class SimulatedArm:
    """An arm that a `robot.Servo` moves; it also replaces `time` and the RTDE connection for both.

    The arm follows what was sent last as servoj does, behind by its lookahead time. It has no
    sockets, and no thread: to sleep is to let both go on for so long.
    """

    controller_said = ""
    writes = True

    def __init__(self, settings: robot.Settings, pose: np.ndarray) -> None:
        self.settings, self.pose, self.sent, self.count = settings, pose, pose, 0
        self.now, self.due, self.stopped = 100.0, 100.0, False
        self.computed = 0.0  # seconds of a processor
        self.stale: robot.StaleState | None = None  # why there is no state
        self.runs = True  # the program
        self.servo = robot.Servo(self, settings)
        self.servo.held_since = self.now

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        until = self.now + seconds
        while self.due <= until:
            self.now = self.due
            self.due += 1 / self.settings.servo_hz
            share = 1 - math.exp(-1 / self.settings.servo_hz / self.settings.servo_lookahead_s)
            self.pose = robot.compose(self.pose, share * robot.difference(self.pose, self.sent))
            if self.servo.error is None:
                self.servo.step()
        self.now = until

    def state(self, max_age: float = 0.1) -> robot.State:
        if self.stale is not None:
            raise self.stale
        values = {
            "timestamp": self.now,
            "actual_TCP_pose": self.pose,
            "target_speed_fraction": 1.0,
            "robot_mode": 7,
            "safety_mode": 1,
            "safety_status_bits": 1,
            "output_int_register_25": self.count,
        }
        return robot.State(values, self.now)

    def program_runs(self, state: robot.State) -> bool:
        return self.runs

    def send(self, pose: np.ndarray, stop: bool = False) -> None:
        self.sent, self.stopped = pose, stop
        self.count += 1


@contextlib.contextmanager
def simulated_arm(settings: robot.Settings, pose: np.ndarray):
    """A simulated arm at a pose (6,); inside, the clock of robot.py is that of the arm."""
    clock = mock.Mock(wraps=time)
    with mock.patch.object(robot, "time", clock):
        clock.monotonic = lambda: 100.0
        arm = SimulatedArm(settings, pose)
        clock.monotonic, clock.sleep = arm.monotonic, arm.sleep
        clock.process_time = lambda: arm.computed
        yield arm


def random_pose(rng: np.random.Generator, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """A pose (6,) in a box: any rotation, or one near 0 or pi; anywhere, or at a corner."""
    position = rng.uniform(low, high)
    if rng.random() < 0.3:
        position = np.where(rng.random(3) < 0.5, low, high)
        if rng.random() < 0.5:  # as a recording holds it
            position = position.astype(np.float32).astype(float)
    axis = rng.normal(size=3) * rng.choice([[1, 1, 1], [1, 1, 0], [1, 0, 0], [0, 1, 0]])
    axis /= np.linalg.norm(axis)  # a tool turned by pi about a horizontal axis points down
    near = rng.choice([0.0, 1e-9, 1e-6, 1e-3, 0.03], p=[0.6, 0.1, 0.1, 0.1, 0.1])
    near *= rng.choice([-1.0, 1.0])
    kind = rng.choice(["any", "near pi", "near 0"], p=[0.4, 0.4, 0.2])
    if kind == "any":
        rotation = Rotation.random(rng=rng).as_rotvec()
    else:
        rotation = axis * (near + (math.pi if kind == "near pi" else 0.0))
    return np.concatenate([position, rotation])


def fuzz_pose(seed: int) -> tuple[float, float]:
    """Sends a simulated arm from one random pose to another.

    Returns the seconds that it took and those that the way needs at a quarter of the speed allowed.
    Raises AssertionError where the arm ends elsewhere, and RobotError where it was stopped.
    """
    rng = np.random.default_rng(seed)
    low, high = np.array([-0.6, -0.9, 0.05]), np.array([0.2, -0.2, 0.6])
    settings = robot.Settings(
        tcp_low_m=low.tolist(),
        tcp_high_m=high.tolist(),
        crop_low_m=[-1, -1, -1],
        crop_high_m=[1, 1, 1],
        camera_to_base=np.eye(4, dtype=int).tolist(),
        servo_hz=100,
        policy_hz=rng.uniform(1, 30),
        max_speed_m_s=rng.uniform(0.5, 1),
        max_speed_rad_s=rng.uniform(2, 3),  # fast, so that there are few steps to simulate
        max_lag_m=0.12,
        max_lag_rad=0.4,
        servo_lookahead_s=rng.uniform(0.03, 0.1),
        max_hold_s=0.1,
    )
    start, target = random_pose(rng, low, high), random_pose(rng, low, high)
    if rng.random() < 0.6:  # not far from it
        start[3:] = robot.compose(target, np.append(np.zeros(3), 0.2 * rng.normal(size=3)))[3:]
    with simulated_arm(settings, start) as arm:
        began = arm.now
        arm.servo.go(target)
        metres, radians = lengths(pose_difference(start, target))
        needed = 4 * max(metres / arm.servo.speed[0], radians / arm.servo.speed[1])
        metres_left, radians_left = lengths(pose_difference(arm.pose, target))
        assert metres_left < 5e-3 and radians_left < 5e-3, (seed, start, target)
        return arm.now - began, needed


def lengths(step: np.ndarray) -> tuple[float, float]:
    """Metres and radians of a step (6,)."""
    return math.hypot(*step[:3]), math.hypot(*step[3:])


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scripts", type=int, default=50, help="how many of faults (50)")
    parser.add_argument("--poses", type=int, default=1000, help="how many (1000)")
    parser.add_argument("--seed", type=int, default=0, help="of the first (0)")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    args = parse(argv)
    longest = 0.0
    for seed in range(args.seed, args.seed + args.poses):
        seconds, needed = fuzz_pose(seed)
        longest = max(longest, seconds - needed)
        assert seconds <= needed + 1, (seed, seconds, needed)
    print(f"{args.poses} poses reached, at most {longest:.2f} s later than their way needs")
    highest, moved, stopped = 0.0, 0, 0
    for seed in range(args.seed, args.seed + args.scripts):
        fastest, limits, reason = fuzz_robot(seed)
        shares = [speed / limit for speed, limit in zip(fastest, limits)]
        highest = max(highest, *shares)
        moved += max(shares) > 0
        stopped += reason is not None
        shown = "{:.2f}, {:.2f} of the limits (m/s, rad/s)".format(*shares)
        print(f"{seed}: {shown}; stopped: {reason or 'never'}", flush=True)
        assert max(shares) <= 1, (seed, fastest, limits)
    if args.scripts:
        print(
            f"{args.scripts} scripts: {moved} moved the arm, at most at {highest:.3f} of a limit, "
            f"and {stopped} stopped it"
        )
        assert moved >= 0.9 * args.scripts, "the arm was hardly ever moved: is the machine busy?"


if __name__ == "__main__":
    main()
