"""Times the pieces that matter, on this machine: `python -m tests.bench [--presets small tiny] [--repeat 5]`.

Each figure is the median of the repetitions, after one that is not counted. Nothing else should be running.
"""

import argparse
import statistics
import time
from collections.abc import Callable

import numpy as np
import torch
from torch.func import functional_call

from data import Demonstrations, MetaWorldPointCloudEnv, demonstration_seed, farthest_point_sample, record_episode
from evaluate import hardware, pick_device, window_sampler
from finetune import BATCH, adapt_policy
from maml import meta_gradient
from model import PRESETS, DAMIPolicy
from train import SETTINGS, mean_loss_gradient, split, task_batch


def median_ms(f: Callable[[], object], repeat: int) -> float:
    f()
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        f()
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        times.append(1000 * (time.perf_counter() - start))
    return statistics.median(times)


def frame_times(task: str, frames: int = 100) -> dict[str, float]:
    """Milliseconds a frame of an expert episode, on one core: physics (and the expert), rays, sampling."""
    env = MetaWorldPointCloudEnv(task)
    env.begin(demonstration_seed(0, 0))
    times = {"physics": [], "rays": [], "sampling": []}
    for _ in range(frames):
        t0 = time.perf_counter()
        env.advance(env.expert_action())
        t1 = time.perf_counter()
        points = env.camera.points(env.simulator.data)
        t2 = time.perf_counter()
        farthest_point_sample(points, env.num_points)
        t3 = time.perf_counter()
        for name, seconds in zip(times, (t1 - t0, t2 - t1, t3 - t2)):
            times[name].append(1000 * seconds)
    return {name: statistics.median(values) for name, values in times.items()}


def demonstration(task: str) -> Demonstrations:
    """One recorded episode of the expert."""
    env = MetaWorldPointCloudEnv(task)
    seed = 0
    while (episode := record_episode(env, demonstration_seed(0, seed))) is None:
        seed += 1
    arrays = {name: np.stack(values) for name, values in episode.items()}
    return Demonstrations(task, "bench", **arrays, episode_ends=np.array([len(arrays["action"])]), meta={})


def preset_times(preset: str, recorded: Demonstrations, tasks: int, device: torch.device, repeat: int) -> list[float]:
    """Milliseconds: outer step in second order, in first order, without MAML; adaptation step; control step; encoding."""
    settings, config = SETTINGS[preset], PRESETS[preset]
    torch.manual_seed(0)
    policy = DAMIPolicy(config).to(device)
    sampler = window_sampler(policy, recorded)
    policy.normalizer.fit(sampler.points, sampler.state, sampler.action)
    text = torch.randn(config.text_dim, generator=torch.Generator().manual_seed(0)).to(device)
    params = dict(policy.named_parameters())
    n = settings["support"] + settings["query"]
    batches = [task_batch(policy, sampler, text, n, (0, 0, task)) for task in range(tasks)]
    pairs = [split(batch, settings["support"]) for batch in batches]
    one = task_batch(policy, sampler, text, 1, (0, 0, 0))
    adaptation_steps = 5

    def loss_fn(params, batch):
        return functional_call(policy, params, (), batch)

    def outer_step(first_order: bool):
        return meta_gradient(loss_fn, params, pairs, settings["inner_lr"], 1, first_order, settings["vectorize"])

    @torch.no_grad()
    def encode():
        return policy.encode_demo(*(one[name] for name in ("text", "demo_points", "demo_state", "demo_action")))

    context = encode()
    return [
        median_ms(lambda: outer_step(first_order=False), repeat),
        median_ms(lambda: outer_step(first_order=True), repeat),
        median_ms(lambda: mean_loss_gradient(policy, batches), repeat),
        median_ms(lambda: adapt_policy(policy, sampler, text, adaptation_steps, BATCH[preset]), repeat)
        / adaptation_steps,
        median_ms(lambda: policy.sample_actions(one["points"], one["state"], context), repeat),
        median_ms(encode, repeat),
    ]


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--presets", nargs="+", default=["small", "tiny"], choices=PRESETS, help="paper takes minutes")
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--tasks", type=int, default=10, help="tasks an outer step (default: 10, as ML10)")
    parser.add_argument("--device")
    args = parser.parse_args(argv)
    device = pick_device(args.device)
    print(f"{hardware(device)}, torch {torch.__version__}, {torch.get_num_threads()} threads; milliseconds, median\n")

    print("| frame, one core | physics | rays | sampling | all |\n|---|---|---|---|---|")
    for task in ("reach", "shelf-place", "basketball"):
        times = frame_times(task)
        cells = [f"{ms:.1f}" for ms in (*times.values(), sum(times.values()))]
        print(f"| {task} | {' | '.join(cells)} |", flush=True)

    names = ["outer step, second order", "first order", "no MAML", "adaptation step", "control step", "demonstration"]
    print(f"\n| {args.tasks} tasks | {' | '.join(names)} |\n|{'---|' * (len(names) + 1)}")
    recorded = demonstration("drawer-close")
    for preset in args.presets:
        times = preset_times(preset, recorded, args.tasks, device, args.repeat)
        print(f"| {preset} | {' | '.join(f'{ms:.1f}' for ms in times)} |", flush=True)


if __name__ == "__main__":
    main()
