"""A simulator of a few lines: a hand, which is a ball, moves to another ball.

It has all that simulator.py's Protocols ask for and needs neither Meta-World nor MuJoCo, so tests
collect, train and evaluate in it within seconds. A test adds it to the simulators by

    monkeypatch.setitem(simulator.SIMULATORS, "toy", tests.toy.Toy)
"""

import numpy as np

from data import farthest_point_sample

PLACES = {"left": (-0.3, 0.0, 0.1), "right": (0.3, 0.0, 0.1), "ahead": (0.0, 0.3, 0.1)}  # metres
SPEED = 0.02  # metres a step, along each axis
RADIUS = 0.05  # metres
BLUE, RED = (0.1, 0.2, 0.9), (0.9, 0.1, 0.1)  # of the hand and of the goal


def ball(center, radius=RADIUS, n=64):
    """n points (n, 3) spread over a sphere, by the golden angle."""
    i = np.arange(n) + 0.5
    polar, turn = np.arccos(1 - 2 * i / n), np.pi * (1 + 5**0.5) * i
    unit = [np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)]
    return (np.array(center) + radius * np.stack(unit, axis=1)).astype(np.float32)


class ToyEnvironment:
    def __init__(self, task, num_points, episode_steps, colored):
        self.place, self.num_points = np.array(PLACES[task]), num_points
        self.episode_steps, self.colored = episode_steps, colored
        self.steps = 0

    def begin(self, seed):
        generator = np.random.default_rng(seed)
        self.hand = generator.uniform(-0.05, 0.05, 3)
        self.goal = self.place + generator.uniform(-0.05, 0.05, 3)
        self.steps = 0

    def observe(self):
        balls = []
        for center, color in ((self.hand, BLUE), (self.goal, RED)):
            points = ball(center)
            features = (
                np.tile(np.float32(color), (len(points), 1)) if self.colored else points[:, :0]
            )
            balls.append(np.concatenate([points, features], axis=1))
        cloud = farthest_point_sample(np.concatenate(balls), self.num_points)
        return {"point_cloud": cloud, "agent_pos": self.hand.astype(np.float32)}

    def advance(self, action):
        self.hand = self.hand + SPEED * np.clip(action, -1, 1)
        self.steps += 1
        success = bool(np.linalg.norm(self.hand - self.goal) < RADIUS)
        return 0.0, self.steps >= self.episode_steps, {"success": success}

    def expert_action(self):
        return np.clip((self.goal - self.hand) / SPEED, -1, 1).astype(np.float32)

    def render(self):
        """From above, a pixel 5 mm."""
        picture = np.full((240, 240, 3), 255, np.uint8)
        y, x = np.mgrid[:240, :240]
        for center, color in ((self.goal, RED), (self.hand, BLUE)):
            across, down = 120 + 200 * center[0], 120 - 200 * center[1]
            picture[(x - across) ** 2 + (y - down) ** 2 < (200 * RADIUS) ** 2] = np.multiply(
                255, color
            )
        return picture


class Toy:
    name = "toy"
    packages = ()

    def __init__(self, colored=False, episode_steps=24):
        self.instructions = {task: f"Move to the ball {task}." for task in PLACES}
        self.colored, self.episode_steps = colored, episode_steps
        self.recipe = {"simulator": self.name, "num_points": 64, "positions_in_state": 1}
        self.recipe["colored"] = colored

    def tasks(self, suite):
        return ["left", "right"], ["ahead"]

    def make(self, task, num_points):
        return ToyEnvironment(task, num_points, self.episode_steps, self.colored)
