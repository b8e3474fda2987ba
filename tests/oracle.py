"""What better eyes, or another constant, would buy: a command of the repository in another world.

    python -m tests.oracle positions simulator.py --data data-positions
    python -m tests.oracle positions train.py --suite ml10 --data data-positions --out runs/oracle
    python -m tests.oracle positions evaluate.py --data data-positions --checkpoint runs/oracle
    python -m tests.oracle pixels train.py --suite ml10 --data data-pixels --out runs/pixels

`positions`: the state also holds where the object and the goal truly are. `pixels`: the camera
casts four times as many rays. `marker`: the goals of hidden_goals.py can be seen. These are
simulators of their own, whose recordings fit no other one; but a checkpoint does not say in which
world it was trained.
`augmented-twice`: scenes are turned and stretched up to twice as much in training.
`not-averaged`: what is kept are the weights themselves, in place of their moving average.
`frozen`: as soon as steps have an inner step, weights stay as they are, and only the learning rates
of the inner step are trained (`train.py --learn-inner-lr`).
"""

import argparse
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import ClassVar

import numpy as np
import torch
from torch.optim.swa_utils import AveragedModel

import common
import data
import simulator
import train
from clip import TextWeightsError
from common import command_line
from hidden_goals import SKILLS, HiddenGoalEnv, HiddenGoals
from metaworld_env import (
    CAMERA,
    CAMERA_PIXELS,
    CAMERA_POSITION,
    RECIPE,
    MetaWorld,
    MetaWorldPointCloudEnv,
)
from model import CheckpointError

OBJECT, GOAL = slice(4, 7), slice(-3, None)  # in what Meta-World tells its experts

# ---- Simulators ----------------------------------------------------------------------------------


class EnvWithPositions(MetaWorldPointCloudEnv):
    def observe(self) -> dict[str, np.ndarray]:
        observation = super().observe()
        positions = [self.expert_observation[OBJECT], self.expert_observation[GOAL]]
        state = np.concatenate([observation["agent_pos"], *positions])  # (9 + 6,)
        return {"point_cloud": observation["point_cloud"], "agent_pos": state.astype(np.float32)}


@dataclass(frozen=True)
class MetaWorldWithPositions(MetaWorld):
    """The state also holds the object's and the goal's position: (15,) instead of (9,)."""

    recipe: ClassVar[dict] = {**RECIPE, "positions_in_state": 5}

    def make(self, task: str, num_points: int) -> EnvWithPositions:
        return EnvWithPositions(task, num_points, episode_steps=self.episode_steps)


class EnvWithPixels(MetaWorldPointCloudEnv):
    camera_pixels = 2 * CAMERA_PIXELS


@dataclass(frozen=True)
class MetaWorldWithPixels(MetaWorld):
    """The camera has twice as many rows and columns."""

    recipe: ClassVar[dict] = {
        **RECIPE,
        "camera": [CAMERA, list(CAMERA_POSITION), 2 * CAMERA_PIXELS],
    }

    def make(self, task: str, num_points: int) -> EnvWithPixels:
        return EnvWithPixels(task, num_points, episode_steps=self.episode_steps)


class EnvWithMarker(HiddenGoalEnv):
    hidden_sites = ()


@dataclass(frozen=True)
class HiddenGoalsWithMarker(HiddenGoals):
    """The goal's marker is in the cloud."""

    name: ClassVar[str] = "meta-world, goals that can be seen"
    recipe: ClassVar[dict] = {**HiddenGoals.recipe, "simulator": name}

    def make(self, task: str, num_points: int) -> EnvWithMarker:
        return EnvWithMarker(task, num_points, episode_steps=self.episode_steps)


# ---- Worlds --------------------------------------------------------------------------------------


def positions() -> None:
    for suite in ("ml10", "ml45"):
        simulator.SIMULATORS[suite] = MetaWorldWithPositions


def pixels() -> None:
    for suite in ("ml10", "ml45"):
        simulator.SIMULATORS[suite] = MetaWorldWithPixels


def marker() -> None:
    for skill in SKILLS:
        simulator.SIMULATORS[f"goals-{skill}"] = HiddenGoalsWithMarker


def augmented_twice() -> None:
    data.TURN *= 2
    data.STRETCH *= 2


def not_averaged() -> None:
    """Keeps the last weights in place of their moving average."""
    train.ema_model = lambda policy: AveragedModel(policy, avg_fn=lambda mean, last, n: last)


def frozen() -> None:
    """The steps without an inner step follow a whole schedule of their own, down to a rate of 0.

    The later ones train the rates of the inner step alone.
    """
    schedule = train.learning_rate

    def learning_rate(step: int, settings: train.Settings, peak: float) -> float:
        assert settings.lr != settings.rate_lr, "--lr and --rate-lr must differ to be told apart"
        if peak == settings.rate_lr:
            return peak
        if step >= settings.pretrain_steps:
            return 0.0
        return schedule(step, replace(settings, steps=settings.pretrain_steps), peak)

    train.learning_rate = learning_rate


WORLDS = {
    "positions": positions,
    "pixels": pixels,
    "marker": marker,
    "augmented-twice": augmented_twice,
    "not-averaged": not_averaged,
    "frozen": frozen,
}


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Runs a command in another world.")
    parser.add_argument("world", choices=WORLDS)
    parser.add_argument("command", choices=("simulator.py", "train.py", "evaluate.py"))
    parser.add_argument("flags", nargs=argparse.REMAINDER, help="the command's")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    args = parse(argv)
    WORLDS[args.world]()

    provenance_of_script = common.provenance

    def provenance(script: str, argv: Sequence[str] | None, device: str | torch.device) -> dict:
        """The script's, but for the command, which is this one."""
        found = provenance_of_script(script, argv, device)
        found["command"] = shlex.join(["python", "-m", "tests.oracle", *sys.argv[1:]])
        return found

    common.provenance = provenance
    import_module(args.command.removesuffix(".py")).main(args.flags)


if __name__ == "__main__":
    command_line(main, errors=(data.RecordingError, CheckpointError, TextWeightsError))
