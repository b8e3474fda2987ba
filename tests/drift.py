"""Whether a policy stands still where its expert does: drawn actions along its own demonstrations.

    python simulator.py --suite ml10
    python -m tests.drift assets/ml10-small.pt --task reach push pick-place

The policy sees the frames of the demonstrations that it was trained on, and draws an action for
each of some of them. A row says how far the expert moves away from the robot (the y of an action,
in centimetres a step) in a part of these episodes, and how far the policy would. What differs there
is no matter of new goals, nor of errors that add up.
"""

import argparse
from pathlib import Path

import torch

import common
import evaluate
from clip import TextWeightsError
from data import RecordingError, WindowSampler, load_demonstrations
from model import CheckpointError

Y = 1  # of an action
PARTS = ((0, 40), (40, 60), (60, 80), (80, 110), (110, 150), (150, 200))  # frames of an episode
FRAMES = 100  # of each part, at most


@torch.no_grad()
def forward_actions(
    policy: evaluate.DAMIPolicy, sampler: WindowSampler, text: torch.Tensor
) -> list[tuple[float, float]]:
    """The mean y of the expert's next action and of the drawn one, in each of PARTS."""
    generator = torch.Generator().manual_seed(0)
    context = policy.encode_demo(text[None], **sampler.demonstration(0))
    before = torch.arange(1 - policy.config.n_obs_steps, 1)  # (To,) the observed frames
    means = []
    for low, high in PARTS:
        frames = [
            (frame + before).clamp(min=episode.start)
            for episode in sampler.episodes
            for frame in range(episode.start, episode.stop)[low:high]
        ]
        chosen = torch.randperm(len(frames), generator=generator)[:FRAMES]
        observed = torch.stack(frames)[chosen]  # (n, To)
        of_each = tuple(x.expand(len(observed), *x.shape[1:]) for x in context)
        points, state = sampler.points[observed].float(), sampler.state[observed]
        drawn = policy.sample_actions(points, state, of_each, generator)  # (n, Ta, A)
        expert = sampler.action[observed[:, -1]]  # (n, A)
        means.append((float(expert[:, Y].mean()), float(drawn[:, 0, Y].mean())))
    return means


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Whether a policy stands still at its goal.")
    parser.add_argument("checkpoint", help="a .pt file, or a folder of train.py")
    parser.add_argument("--task", nargs="+", default=["reach"], help="tasks of ML10 (reach)")
    parser.add_argument("--data", default="data", help="folder of its demonstrations")
    parser.add_argument("--threads", type=int, help="of PyTorch")
    args = parser.parse_args(argv)
    common.pick_device("cpu", args.threads)

    policy, info = evaluate.load_trained(evaluate.checkpoints_of(args.checkpoint)[-1])
    policy.eval()
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
