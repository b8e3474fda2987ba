"""Times the pieces that matter, on this machine, side by side: `python -m tests.bench [--paper]`.

`--network` leaves out what a GPU has no part in: frames, episodes, and memory.

Each figure is the median of the repetitions; what is compared takes turns, so that a slow minute of
the machine meets all of it. The first round is not counted. Nothing else should be running.
"""

import argparse
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
import torch
from torch.func import functional_call
from torch.utils.flop_counter import FlopCounterMode

import baselines
from clip import text_features
from data import Demonstrations, WindowSampler, farthest_point_sample, load_demonstrations
from evaluate import EPISODES_A_JOB, SHIPPED_CHECKPOINT, TRAINED, checkpoints_of, rollout
from finetune import BATCH, LEARNING_RATES, adapt_policy
from maml import adapt, meta_gradient
from model import PRESETS, PolicyConfig
from scripts import hardware, load_checkpoint, pick_device
from simulator import (
    MetaWorldPointCloudEnv,
    collect,
    demonstration_seed,
    evaluation_seed,
    record_episode,
    suite_tasks,
)
from tests.textbook import TextbookDP3, training_step
from train import SETTINGS, Settings, multi_task_gradient, split, task_batch

DP3 = {"demo_encoder": "none", "tcfm": "none"}
TASKS = "reach", "shelf-place", "basketball"  # whose frames and episodes are timed


def medians(functions: dict[str, Callable[[], object]], repeat: int) -> dict[str, float]:
    """Milliseconds of each, taking turns."""
    times = {name: [] for name in functions}
    for _ in range(repeat + 1):
        for name, function in functions.items():
            start = time.perf_counter()
            function()
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            times[name].append(1000 * (time.perf_counter() - start))
    return {name: statistics.median(values[1:]) for name, values in times.items()}


def step_medians(
    trainings: dict[str, Callable[[int], list[float]]], steps: int, rounds: int
) -> dict[str, float]:
    """Milliseconds a step of each training, taking turns; a training returns the time at the end of
    each of its steps.
    """
    times = {name: [] for name in trainings}
    for _ in range(rounds):
        for name, training in trainings.items():
            times[name] += np.diff(training(steps + 1)).tolist()
    return {name: 1000 * statistics.median(values) for name, values in times.items()}


def gflop(function: Callable[[], object]) -> float:
    """Billions of operations in a call's matrix products and convolutions, a multiplication and an
    addition each.
    """
    with FlopCounterMode(display=False) as counter:
        function()
    return counter.get_total_flops() / 1e9


def matrix_rate(device: torch.device) -> float:
    """The most this machine does: GFLOP a second in a square matrix product."""
    x = torch.randn(2048, 2048, device=device)
    return 2 * 2048**3 / 1e6 / medians({"product": lambda: x @ x}, 9)["product"]


def frame_times(task: str, frames: int = 100) -> dict[str, float]:
    """Milliseconds a frame of an expert episode, on one core: physics (and the expert), rays,
    sampling.
    """
    env = MetaWorldPointCloudEnv(task, PRESETS["small"].num_points)
    env.begin(demonstration_seed(task, 0, 0))
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
    while (episode := record_episode(env, demonstration_seed(task, 0, seed))) is None:
        seed += 1
    arrays = {name: np.stack(values) for name, values in episode[0].items()}
    return Demonstrations(
        task, "bench", **arrays, episode_ends=np.array([len(arrays["action"])]), meta={}
    )


class Bench:
    """A fresh policy, one recorded episode, and the calls that train.py, finetune.py and
    evaluate.py make with them.
    """

    def __init__(
        self, config: PolicyConfig, preset: str, recorded: Demonstrations, device: torch.device
    ):
        torch.manual_seed(0)
        self.preset, self.settings = preset, SETTINGS[preset]
        self.policy = baselines.build_policy(config).to(device)
        self.sampler: WindowSampler = WindowSampler(recorded, config, device=device)
        self.policy.normalizer.fit(self.sampler.points, self.sampler.state, self.sampler.action)
        self.text = torch.randn(config.text_dim, generator=torch.Generator().manual_seed(0)).to(
            device
        )

    def batches(self, tasks: int) -> list[dict[str, torch.Tensor]]:
        n = self.settings.support + self.settings.query
        return [
            task_batch(self.policy, self.sampler, self.text, n, (0, 0, task), self.settings)
            for task in range(tasks)
        ]

    def outer_step(
        self,
        batches: list[dict[str, torch.Tensor]],
        first_order: bool,
        vectorize: int | None = None,
    ) -> None:
        meta_gradient(
            lambda params, batch: functional_call(self.policy, params, (), batch),
            dict(self.policy.named_parameters()),
            (split(batch, self.settings.support) for batch in batches),
            self.settings.inner_lr,
            first_order=first_order,
            vectorize=vectorize or self.settings.vectorize,
        )

    def one_by_one(self, batches: list[dict[str, torch.Tensor]]) -> None:
        """Multi-task training without a batch over tasks."""
        for batch in batches:
            multi_task_gradient(self.policy, [batch])

    def adapt(self, steps: int) -> list[float]:
        """The time at the end of each step of finetune.py."""
        how = steps, BATCH[self.preset], LEARNING_RATES
        training = adapt_policy(self.policy, self.sampler, self.text, *how)
        return [time.perf_counter() for _ in training]

    def textbook(self, steps: int) -> list[float]:
        """The same for a textbook's training of the same network on the same windows."""
        policy, average = (TextbookDP3(self.policy.config).to(self.text.device) for _ in range(2))
        policy.load_state_dict(self.policy.state_dict())
        optimizer = torch.optim.AdamW(policy.parameters(), lr=1e-4)
        times, generator, n = [], torch.Generator().manual_seed(0), BATCH[self.preset]
        for _ in range(steps):
            noise = self.policy.draw_noise_and_timesteps(n, generator)
            batch = self.sampler.sample(n, generator) | noise
            training_step(policy, average, optimizer, batch)
            times.append(time.perf_counter())
        return times

    @torch.no_grad()
    def encode(self) -> tuple[torch.Tensor, ...] | None:
        return self.policy.encode_demo(self.text[None], **self.sampler.demonstration(0))

    def control(self) -> Callable[[], torch.Tensor]:
        context, frames = self.encode(), self.sampler.gather(torch.tensor([100]))
        return lambda: self.policy.sample_actions(frames["points"], frames["state"], context)


def episode_seconds(task: str, device: torch.device, repeat: int) -> float:
    """Seconds one core takes for one episode of 200 steps, `small`: as in evaluate.py, never
    successful (untrained).
    """
    bench = Bench(PRESETS["small"], "small", demonstration(task), device)
    envs = [
        MetaWorldPointCloudEnv(task, bench.policy.config.num_points) for _ in range(EPISODES_A_JOB)
    ]
    seeds = [evaluation_seed(0, i) for i in range(EPISODES_A_JOB)]
    threads = torch.get_num_threads()
    torch.set_num_threads(1)

    def run() -> None:
        rollout(bench.policy.eval(), envs, seeds, bench.sampler, bench.text, torch.Generator())

    milliseconds = medians({task: run}, repeat)[task]
    torch.set_num_threads(threads)
    return milliseconds / 1000 / EPISODES_A_JOB


def peak_memory(tasks: int) -> float:
    """GB that a process of its own holds at most for second-order outer steps of `small`."""
    command = [sys.executable, "-m", "tests.bench", "--peak-memory", str(tasks)]
    return float(
        subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()[-1]
    )


def inner_step_table(checkpoint: Path, folder: str, rate: float | None, seeds: int = 5) -> None:
    """What an inner step does to a policy: windows of each task as in its training, seeds 0 to 4.

    First at the rate of its training, on base and on novel tasks, by what the policy is shown. Then
    on base tasks with the mean over a window's H x A numbers, as DP3 and this code have it, and
    with their sum, as the paper writes the loss: an inner rate H x A times as large.
    """
    policy, info = load_checkpoint(checkpoint, needs=TRAINED)
    (base, novel), trained = suite_tasks("ml10"), info["arguments"]
    recorded = [load_demonstrations(path) for path in collect(base + novel, folder).values()]
    text, _ = text_features([d.instruction for d in recorded], None, info["text_weights"])
    samplers = [
        WindowSampler(
            demonstrations,
            policy.config,
            after_success=trained["after_success"],
            augment=trained["augment"],
        )
        for demonstrations in recorded
    ]
    params = {name: p.detach() for name, p in policy.named_parameters()}
    n = trained["support"] + trained["query"]

    def loss_fn(params: dict[str, torch.Tensor], batch: dict[str, torch.Tensor]) -> torch.Tensor:
        return functional_call(policy, params, (), batch)

    def change(new: dict[str, torch.Tensor], old: dict[str, torch.Tensor]) -> float:
        new, old = (torch.cat([x.flatten() for x in each.values()]) for each in (new, old))
        return ((new - old).norm() / old.norm()).item()

    def pairs_of(seed: int, split_: str, **shares: float) -> list[tuple[dict, dict]]:
        how = Settings(**shares), True
        of_tasks = slice(len(base)) if split_ == "base" else slice(len(base), None)
        batches = [
            task_batch(policy, sampler, feature, n, (seed, 0, index), *how)
            for index, (sampler, feature) in enumerate(list(zip(samplers, text))[of_tasks])
        ]
        return [split(batch, trained["support"]) for batch in batches]

    rate = trained["inner_lr"] if rate is None else rate
    print(f"\n{checkpoint}: query loss before -> after an inner step at {rate:g}, means\n")
    print("| the policy is shown | base tasks | novel tasks |\n|---|---|---|")
    for shown, shares in {
        "instruction, demonstration": {},
        "demonstration": {"instruction_dropout": 1.0},
        "nothing but the support windows": {"support_only": 1.0},
    }.items():
        cells = []
        for split_ in ("base", "novel"):
            losses = []
            for support, query in chain(*(pairs_of(s, split_, **shares) for s in range(seeds))):
                adapted = adapt(loss_fn, params, support, rate)
                with torch.no_grad():
                    losses.append([loss_fn(p, query).item() for p in (params, adapted)])
            cells.append("{:.4f} -> {:.4f}".format(*np.mean(losses, axis=0)))
        print(f"| {shown} | {' | '.join(cells)} |", flush=True)

    print("\n| inner step at 1e-4 on the | weights | support loss | query loss | meta-gradient |")
    print("|---|---|---|---|---|")
    for name, numbers in {
        "mean": 1,
        "sum": policy.config.horizon * policy.config.action_dim,
    }.items():
        lr, moved, losses, gradient = 1e-4 * numbers, [], [], []
        for seed in range(seeds):
            pairs = pairs_of(seed, "base")
            for support, query in pairs:
                adapted = adapt(loss_fn, params, support, lr)
                moved.append(change(adapted, params))
                with torch.no_grad():
                    after, before = (
                        [loss_fn(p, b) for b in (support, query)] for p in (adapted, params)
                    )
                losses.append([(a / b - 1).item() for a, b in zip(after, before)])
            plain, *_ = meta_gradient(loss_fn, params, pairs, lr=0.0)
            gradient.append(change(meta_gradient(loss_fn, params, pairs, lr)[0], plain))
        support, query = np.median(losses, axis=0)
        cells = (
            f"{np.median(moved):.1e} | {support:+.1%} | {query:+.1%} | {np.median(gradient):.1%}"
        )
        print(f"| {name} (medians) | {cells} |", flush=True)


def table(title: str, rows: dict[str, float], unit: str = "") -> None:
    print(f"\n| {title} | |\n|---|---|")
    for name, value in rows.items():
        print(f"| {name} | {value:.{2 if value < 20 else 0}f}{unit} |", flush=True)


def preset_table(bench: Bench, rate: float, repeat: int) -> None:
    """Every kind of step of a preset, and how far it is from the machine's limit."""
    batches, control = bench.batches(10), bench.control()
    steps = {
        "outer step, second order": lambda n=None: bench.outer_step(
            batches, first_order=False, vectorize=n
        ),
        "outer step, first order": lambda n=None: bench.outer_step(
            batches, first_order=True, vectorize=n
        ),
        "multi-task step, all windows in one batch": lambda: multi_task_gradient(
            bench.policy, batches
        ),
        "multi-task step, one task at a time": lambda: bench.one_by_one(batches),
    }
    ms = medians(steps, repeat)
    second, first, batch, single = ms.values()
    ms |= step_medians({"adaptation step": bench.adapt}, steps=5, rounds=3)
    ms |= medians({"control step": control, "encoding the demonstration": bench.encode}, repeat)
    # Grouped convolutions, which vmap makes, are not counted rightly: outer steps are counted task
    # by task.
    counted = [lambda s=s: s(1) for s in list(steps.values())[:2]] + list(steps.values())[2:]
    counted += [lambda: bench.adapt(1), control, bench.encode]
    print(
        f"\n| `{bench.preset}`, 10 tasks | ms | GFLOP | of the matrix product's rate "
        "|\n|---|---|---|---|"
    )
    for (name, value), call in zip(ms.items(), counted):
        operations = gflop(call)
        print(
            f"| {name} | {value:.1f} | {operations:.2f} | {operations / value * 1000 / rate:.0%} |",
            flush=True,
        )
    ratios = {
        "first order": second / first,
        "one batch": second / batch,
        "one task at a time": second / single,
    }
    table(f"`{bench.preset}`: second order over", ratios)


def policies_table(recorded: Demonstrations, device: torch.device, repeat: int) -> None:
    """`small`: what training and control of each policy of baselines.py cost, taking turns."""
    calls, actions = {}, {}
    for policy, presets in baselines.PRESETS.items():
        bench = Bench(presets["small"], "small", recorded, device)
        batches, actions[policy] = bench.batches(10), presets["small"].n_action_steps
        calls |= {
            (policy, "multi-task step"): lambda bench=bench, batches=batches: multi_task_gradient(
                bench.policy, batches
            ),
            (policy, "in bfloat16"): lambda bench=bench, batches=batches: multi_task_gradient(
                bench.policy, batches, bfloat16=True
            ),
            (policy, "second order"): lambda bench=bench, batches=batches: bench.outer_step(
                batches, first_order=False
            ),
            (policy, "control step"): bench.control(),
        }
    ms = medians(calls, repeat)
    steps = "multi-task step | in bfloat16 | second order | control step | of so many actions"
    print(f"\n| `small`, ms | {steps} |\n|---|---|---|---|---|---|")
    for policy, n in actions.items():
        cells = [f"{value:.0f}" for (name, _), value in ms.items() if name == policy]
        print(f"| {policy} | {' | '.join(cells)} | {n} |", flush=True)


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--paper",
        action="store_true",
        help="the ratios at the paper's size too (10 minutes more, 16 GB)",
    )
    parser.add_argument("--network", action="store_true", help="only its steps")
    parser.add_argument("--inner-step", action="store_true", help="only what it does to a policy")
    parser.add_argument("--data", default="data", help="demonstrations that --inner-step reads")
    parser.add_argument("--inner-lr", type=float, help="its rate (default: of the training)")
    parser.add_argument(
        "--checkpoint", default=SHIPPED_CHECKPOINT, help="its policy, or run folder"
    )
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--device")
    parser.add_argument("--peak-memory", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    device = pick_device(args.device)
    if args.peak_memory:
        import resource

        bench = Bench(PRESETS["small"], "small", demonstration("drawer-close"), device)
        for _ in range(2):
            bench.outer_step(bench.batches(args.peak_memory), first_order=False)
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6)
        return
    if args.inner_step:
        return inner_step_table(checkpoints_of(args.checkpoint)[-1], args.data, args.inner_lr)
    threads = torch.get_num_threads()
    print(
        f"{hardware(device)}, torch {torch.__version__}, {threads} threads, "
        f"{time.strftime('%Y-%m-%d')}"
    )

    if not args.network:
        print("\n| frame, one core, ms | physics | rays | sampling | all |\n|---|---|---|---|---|")
        for task in TASKS:
            times = frame_times(task)
            cells = [f"{ms:.1f}" for ms in (*times.values(), sum(times.values()))]
            print(f"| {task} | {' | '.join(cells)} |", flush=True)
        episodes = {task: episode_seconds(task, device, args.repeat) for task in TASKS}
        table("evaluation, one core, `small`: seconds an episode of 200 steps", episodes)
        memory = {f"{tasks} tasks": peak_memory(tasks) for tasks in (10, 20, 40)}
        table("`small`, second order, peak memory, GB", memory)

    recorded = demonstration("drawer-close")
    rate = matrix_rate(device)
    print(f"\nmatrix product: {rate:.0f} GFLOP a second")
    for preset in ("small", "tiny"):
        preset_table(Bench(PRESETS[preset], preset, recorded, device), rate, args.repeat)
    policies_table(recorded, device, args.repeat)
    for preset, steps, rounds in (("small", 4, 5), ("paper", 2, 3)):
        if preset == "paper" and not args.paper:
            continue
        dami = Bench(PRESETS[preset], preset, recorded, device)
        dp3 = Bench(replace(PRESETS[preset], **DP3), preset, recorded, device)
        ms = step_medians(
            {"DAMI": dami.adapt, "DP3": dp3.adapt, "DP3 as a textbook writes it": dp3.textbook},
            steps,
            rounds,
        )
        table(f"`{preset}`, adaptation step, {BATCH[preset]} windows, ms", ms)
        control = medians({"DAMI": dami.control(), "DP3": dp3.control()}, args.repeat)
        table(f"`{preset}`, control step, ms", control)
        ratios = {
            "adaptation step, DAMI over DP3": ms["DAMI"] / ms["DP3"],
            "control step, DAMI over DP3": control["DAMI"] / control["DP3"],
            "training step of DP3, ours over the textbook's": ms["DP3"]
            / ms["DP3 as a textbook writes it"],
        }
        table(f"`{preset}`, ratios", ratios)
        del dami, dp3
    if args.paper:
        bench = Bench(PRESETS["paper"], "paper", recorded, device)
        batches = bench.batches(1)
        orders = {"second order": False, "first order": True}
        ms = medians(
            {k: lambda f=f: bench.outer_step(batches, first_order=f) for k, f in orders.items()},
            args.repeat,
        )
        table(
            "`paper`, outer step, one task, s", {name: value / 1000 for name, value in ms.items()}
        )


if __name__ == "__main__":
    main()
