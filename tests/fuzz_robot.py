"""Random scripts of faults against the emulated arm: `python -m tests.fuzz_robot --scripts 50`.

Whatever comes and goes, the arm is never faster than the settings allow.
"""

import argparse
import contextlib
import time

import numpy as np

import robot
from tests.emulator import Emulator

FAULTS = (
    "blocked paused frozen backward silent deaf torn lose_program garbage drop one_byte joined "
    "slider scaling foreign pushed late"
).split()


def fuzz_robot(seed: int, rounds: int = 8) -> tuple[list[float], list[float], str | None]:
    """Faults come and go at random while a policy asks the emulated arm for more than it may.

    Returns the highest speeds of the arm (m/s, rad/s), the limits, and why it was stopped.
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
        assert max(emulator.fastest) > 0, "the arm was never moved"
        return emulator.fastest, [settings.max_speed_m_s, settings.max_speed_rad_s], reason


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scripts", type=int, default=50, help="how many (50)")
    parser.add_argument("--seed", type=int, default=0, help="of the first (0)")
    args = parser.parse_args(argv)
    highest, stopped = 0.0, 0
    for seed in range(args.seed, args.seed + args.scripts):
        fastest, limits, reason = fuzz_robot(seed)
        shares = [speed / limit for speed, limit in zip(fastest, limits)]
        highest, stopped = max(highest, *shares), stopped + (reason is not None)
        shown = "{:.2f}, {:.2f} of the limits (m/s, rad/s)".format(*shares)
        print(f"{seed}: {shown}; stopped: {reason or 'never'}", flush=True)
        assert max(shares) <= 1, (seed, fastest, limits)
    print(f"{args.scripts} scripts, at most {highest:.3f} of a limit; {stopped} stopped the arm")


if __name__ == "__main__":
    main()
