"""What better eyes, or another constant, would buy: a command of the repository in another world.

    python -m tests.oracle positions simulator.py --data data-positions
    python -m tests.oracle positions train.py --suite ml10 --data data-positions --out runs/oracle
    python -m tests.oracle positions evaluate.py --data data-positions --checkpoint runs/oracle
    python -m tests.oracle pixels train.py --suite ml10 --data data-pixels --out runs/pixels

`positions`: the state also holds where the object and the goal truly are. `pixels`: the camera
casts four times as many rays. Recordings, and checkpoints, are of one of these two.
`augmented-twice`: scenes are turned and stretched up to twice as much in training.
`not-averaged`: what is kept are the weights themselves, in place of their moving average.
"""

import argparse
import shlex
import sys
from importlib import import_module

import numpy as np
from torch.optim.swa_utils import AveragedModel

import common
import data
import metaworld_env
import train
from clip import TextWeightsError
from data import RecordingError
from metaworld_env import MetaWorldPointCloudEnv
from model import CheckpointError

OBJECT, GOAL = slice(4, 7), slice(-3, None)  # in what Meta-World tells its experts


def positions() -> None:
    """Puts the object's and the goal's position into the state: (15,) instead of (9,)."""
    observe = MetaWorldPointCloudEnv.observe

    def observe_more(env: MetaWorldPointCloudEnv) -> dict[str, np.ndarray]:
        observation = observe(env)
        object_position, goal = env.expert_observation[OBJECT], env.expert_observation[GOAL]
        state = np.concatenate([observation["agent_pos"], object_position, goal])  # (9 + 6,)
        return {"point_cloud": observation["point_cloud"], "agent_pos": state.astype(np.float32)}

    MetaWorldPointCloudEnv.observe = observe_more
    metaworld_env.RECIPE["positions_in_state"] += 2


def pixels() -> None:
    """Doubles the camera's rows and columns."""
    metaworld_env.CAMERA_PIXELS *= 2
    metaworld_env.RECIPE["camera"][2] *= 2


def augmented_twice() -> None:
    """Doubles the turns and the stretch of a training's scenes."""
    data.TURN *= 2
    data.STRETCH *= 2


def not_averaged() -> None:
    """Makes a training's moving average one of the last weights alone."""
    train.ema_model = lambda policy: AveragedModel(policy, avg_fn=lambda mean, last, n: last)


WORLDS = {
    "positions": positions,
    "pixels": pixels,
    "augmented-twice": augmented_twice,
    "not-averaged": not_averaged,
}


def main() -> None:
    parser = argparse.ArgumentParser(description="Runs a command in another world.")
    parser.add_argument("world", choices=WORLDS)
    parser.add_argument("command", choices=("simulator.py", "train.py", "evaluate.py"))
    parser.add_argument("flags", nargs=argparse.REMAINDER, help="the command's")
    args = parser.parse_args()
    WORLDS[args.world]()

    # Results name this command, and not the one that it runs.
    provenance = common.provenance
    command = shlex.join(["python", "-m", "tests.oracle", *sys.argv[1:]])
    common.provenance = lambda *arguments: {**provenance(*arguments), "command": command}
    import_module(args.command.removesuffix(".py")).main(args.flags)


if __name__ == "__mp_main__":  # a worker process of `main` lives in the same world
    WORLDS[sys.argv[1]]()
if __name__ == "__main__":
    common.command_line(main, errors=(RecordingError, CheckpointError, TextWeightsError))
