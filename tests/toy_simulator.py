"""A simulator in a page, for tests: a hand that moves to a ball. It needs NumPy alone."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from data import farthest_point_sample

RADIUS = 0.1  # metres, of the ball; a hand that is inside succeeds
SPEED = 0.05  # metres a step, along each axis


class ToyEnvironment:
    """Observes N points on a ball and where the hand is; an action (3,) moves the hand."""

    def __init__(self, color, num_points, episode_steps):
        self.color, self.episode_steps = color, episode_steps
        directions = np.random.default_rng(0).normal(size=(num_points, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        self.surface = farthest_point_sample(np.float32(RADIUS * directions), num_points)

    def begin(self, seed):
        self.steps, self.hand = 0, np.zeros(3)
        self.ball = np.random.default_rng(seed).uniform(0.2, 0.4, size=3)

    def observe(self):
        points = self.surface + self.ball
        if self.color is not None:
            points = np.concatenate([points, np.tile(self.color, (len(points), 1))], axis=1)
        return {"point_cloud": np.float32(points), "agent_pos": np.float32(self.hand)}

    def advance(self, action):
        self.hand = self.hand + SPEED * np.clip(action, -1, 1)
        self.steps += 1
        success = bool(np.linalg.norm(self.hand - self.ball) < RADIUS)
        return 0.0, self.steps >= self.episode_steps, {"success": success}

    def expert_action(self):
        return np.float32(np.clip((self.ball - self.hand) / SPEED, -1, 1))

    def render(self):
        picture = np.zeros((240, 240, 3), np.uint8)
        for color, position in (((255, 255, 255), self.hand), ((255, 0, 0), self.ball)):
            column, row = np.int64(480 * np.clip(position[:2], 0, 0.48))
            picture[row : row + 8, column : column + 8] = color
        return picture


COLORS = {"red": (1, 0, 0), "green": (0, 1, 0), "blue": (0, 0, 1)}


@dataclass(frozen=True)
class ToySimulator:
    """A `simulator.Simulator` of three tasks; its points have a colour (point_dim 6) if asked."""

    colored: bool = False
    episode_steps: int = 12
    name: ClassVar[str] = "toy"
    instructions: ClassVar[dict] = {
        f"touch-{color}": f"Touch the {color} ball." for color in COLORS
    }
    packages: ClassVar[tuple] = ()
    demonstrations: ClassVar[int] = 10

    @property
    def recipe(self):
        return {"simulator": self.name, "num_points": 64, "colored": self.colored}

    def tasks(self, suite):
        return ["touch-red", "touch-green"], ["touch-blue"]

    def make(self, task, num_points):
        color = COLORS[task.removeprefix("touch-")] if self.colored else None
        return ToyEnvironment(color, num_points, self.episode_steps)
