"""Whether a policy stands still where its expert does: drawn actions along its own demonstrations.

    python simulator.py --suite ml10
    python -m tests.drift assets/ml10-small.pt --task reach push pick-place

The policy is shown frames of the demonstrations that it was trained on, and draws an action for
each. A row says, for a part of these episodes, how far the expert moves away from the robot (the y
of an action, which is positive in that direction, in centimetres a step), and how far the policy
would. Where the two differ, neither new goals nor errors that add up are the reason.
"""

import argparse
from pathlib import Path

import torch
from torch import Tensor

import common
import evaluate
from clip import TextWeightsError
from data import RecordingError, WindowSampler, load_demonstrations
from model import CheckpointError, DAMIPolicy

Y = 1  # of an action
PARTS = ((0, 40), (40, 60), (60, 80), (80, 110), (110, 150), (150, 200))  # frames of an episode
FRAMES = 100  # of each part, at most


@torch.no_grad()
def forward_actions(
    policy: DAMIPolicy, sampler: WindowSampler, text: Tensor
) -> list[tuple[float, float]]:
    """The mean y of the expert's next action and of the drawn one, in each of PARTS.

    Args:
        policy: in evaluation mode.
        sampler: of the episodes that it was trained on, none of them shorter than PARTS say.
        text: instruction feature, (text_dim,).

    Returns:
        A pair for each part, in the action's unit: centimetres in Meta-World.
    """
    generator = torch.Generator().manual_seed(0)
    context = policy.encode_demo(text[None], **sampler.demonstration(0))
    before = torch.arange(1 - policy.config.n_obs_steps, 1)  # (To,) -1 and 0: the observed frames
    means = []
    for low, high in PARTS:
        observed = torch.stack(
            [
                (frame + before).clamp(min=episode.start)
                for episode in sampler.episodes
                for frame in range(episode.start + low, min(episode.start + high, episode.stop))
            ]
        )  # (frames, To)
        chosen = torch.randperm(len(observed), generator=generator)[:FRAMES]
        observed = observed[chosen]  # (n, To)
        drawn = policy.sample_actions(
            points=sampler.points[observed].float(),
            state=sampler.state[observed],
            context=context,
            generator=generator,
        )  # (n, Ta, A)
        expert = sampler.action[observed[:, -1]]  # (n, A)
        means.append((float(expert[:, Y].mean()), float(drawn[:, 0, Y].mean())))
    return means


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Whether a policy stands still at its goal.")
    parser.add_argument("checkpoint", help="a .pt file, or a folder of train.py")
    parser.add_argument("--task", nargs="+", default=["reach"], help="tasks of ML10 (reach)")
    parser.add_argument("--data", default="data", help="folder of its demonstrations")
    parser.add_argument("--threads", type=int, help="of PyTorch")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    args = parse(argv)
    common.pick_device("cpu", args.threads)

    policy, info = evaluate.load_trained(evaluate.checkpoints_of(args.checkpoint)[-1])
    recordings = {task: load_demonstrations(Path(args.data) / f"{task}.npz") for task in args.task}
    instructions = {task: recorded.instruction for task, recorded in recordings.items()}
    identity = info["text_weights"]
    text, _ = evaluate.instruction_features(instructions, None, identity, "cpu")
    columns = {
        task: forward_actions(policy, WindowSampler(recorded, policy.config), text[task])
        for task, recorded in recordings.items()
    }

    head = [f"{task}, {who}" for task in columns for who in ("expert", "policy")]
    rows = [["frames", *head]]
    for part, (low, high) in enumerate(PARTS):
        cells = [f"{y:.3f}" for means in columns.values() for y in means[part]]
        rows.append([f"{low} to {high}", *cells])
    print(common.format_table(rows))


if __name__ == "__main__":
    common.command_line(main, errors=(RecordingError, CheckpointError, TextWeightsError))
