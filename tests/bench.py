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


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--presets", nargs="+", default=["small", "tiny"], choices=PRESETS)
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

    recorded = demonstration("drawer-close")
    text = torch.randn(512, generator=torch.Generator().manual_seed(0)).to(device)
    names = ["outer step, second order", "first order", "no MAML", "adaptation step", "control step", "demonstration"]
    print(f"\n| {args.tasks} tasks | {' | '.join(names)} |\n|{'---|' * (len(names) + 1)}")
    for preset in args.presets:
        settings, config = SETTINGS[preset], PRESETS[preset]
        torch.manual_seed(0)
        policy = DAMIPolicy(config).to(device)
        sampler = window_sampler(policy, recorded)
        policy.normalizer.fit(sampler.points, sampler.state, sampler.action)
        params = dict(policy.named_parameters())
        n = settings["support"] + settings["query"]
        batches = [task_batch(policy, sampler, text, n, (0, 0, task)) for task in range(args.tasks)]
        pairs = [split(batch, settings["support"]) for batch in batches]

        def loss_fn(params, batch, policy=policy):
            return functional_call(policy, params, (), batch)

        def outer_step(first_order, params=params, pairs=pairs, settings=settings, loss_fn=loss_fn):
            return meta_gradient(loss_fn, params, pairs, settings["inner_lr"], 1, first_order, settings["vectorize"])

        demo = sampler.batch(1, torch.Generator().manual_seed(0))
        with torch.no_grad():
            encode = lambda: policy.encode_demo(text[None], demo["demo_points"], demo["demo_state"], demo["demo_action"])  # noqa: E731, B023
            context = encode()
            demo_ms = median_ms(encode, args.repeat)
        steps = 5
        times = [
            median_ms(lambda: outer_step(False), args.repeat),  # noqa: B023
            median_ms(lambda: outer_step(True), args.repeat),  # noqa: B023
            median_ms(lambda: mean_loss_gradient(policy, batches), args.repeat),  # noqa: B023
            median_ms(lambda: adapt_policy(policy, sampler, text, steps, BATCH[preset]), args.repeat) / steps,  # noqa: B023
            median_ms(lambda: policy.sample_actions(demo["points"], demo["state"], context), args.repeat),  # noqa: B023
            demo_ms,
        ]
        print(f"| {preset} | {' | '.join(f'{ms:.1f}' for ms in times)} |", flush=True)


if __name__ == "__main__":
    main()
