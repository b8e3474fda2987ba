"""Times the pieces that matter, on this machine, side by side: `python -m tests.bench [--paper]`.

`--network` leaves out what a GPU has no part in: frames, episodes, and memory. `--peers FOLDER`
times the second-order meta-gradient of learn2learn and higher beside ours.

Each figure is the median of the repetitions; what is compared takes turns, so that a slow minute of
the machine meets all of it. The first round is not counted. Nothing else should be running.
"""

import argparse
import atexit
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np
import torch
from torch import Tensor
from torch.func import functional_call
from torch.utils.flop_counter import FlopCounterMode

import baselines
import model
from clip import TextWeightsError
from common import command_line, hardware, pick_device
from data import (
    Demonstrations,
    RecordingError,
    WindowSampler,
    farthest_point_sample,
    load_demonstrations,
)
from evaluate import (
    EPISODES_A_JOB,
    SHIPPED_CHECKPOINT,
    checkpoints_of,
    instruction_features,
    load_trained,
    rollout,
)
from finetune import BATCH, LEARNING_RATES, adapt_policy
from maml import adapt, meta_gradient
from metaworld_env import MetaWorld
from model import PRESETS, CheckpointError, DAMIPolicy, PolicyConfig, loss_of, split
from simulator import collect, demonstration_seed, evaluation_seed, record_episode
from tests.textbook import TextbookDP3, training_step
from train import SETTINGS, Settings, multi_task_gradient, task_batch

SIMULATOR = MetaWorld()
SUITE = "ml10"
DP3 = {"demo_encoder": "none", "tcfm": "none"}
TASKS = ("reach", "shelf-place", "basketball")  # whose frames and episodes are timed

Batch = dict[str, Tensor]  # the arguments of a policy's loss

# ---- Measuring -----------------------------------------------------------------------------------


def medians(functions: dict[str, Callable[[], object]], repeat: int) -> dict[str, float]:
    """Milliseconds of each function; they take turns."""
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
    """Milliseconds a step of each training; they take turns.

    A training takes a number of steps, and returns the time at the end of each of them.
    """
    times = {name: [] for name in trainings}
    for _ in range(rounds):
        for name, training in trainings.items():
            times[name] += np.diff(training(steps + 1)).tolist()
    return {name: 1000 * statistics.median(values) for name, values in times.items()}


def gflop(function: Callable[[], object]) -> float:
    """Billions of operations in a call's matrix products and convolutions.

    A multiplication and an addition are two operations.
    """
    with FlopCounterMode(display=False) as counter:
        function()
    return counter.get_total_flops() / 1e9


def matrix_rate(device: torch.device) -> float:
    """The most that this machine does: GFLOP a second in a square matrix product."""
    x = torch.randn(2048, 2048, device=device)
    return 2 * 2048**3 / 1e6 / medians({"product": lambda: x @ x}, 9)["product"]


# ---- The simulator -------------------------------------------------------------------------------


def frame_times(task: str, frames: int = 100) -> dict[str, float]:
    """Milliseconds a frame of an expert's episode, on one core: physics, rays and sampling.

    The expert's own time counts as physics.
    """
    env = SIMULATOR.make(task, PRESETS["small"].num_points)
    env.begin(demonstration_seed(SIMULATOR, task, seed=0, attempt=0))
    times = {"physics": [], "rays": [], "sampling": []}
    for _ in range(frames):
        start = time.perf_counter()
        env.advance(env.expert_action())
        advanced = time.perf_counter()
        points, geoms = env.camera.points(env.sawyer_env.data, segmentation=True)
        cast = time.perf_counter()
        farthest_point_sample(points[~np.isin(geoms, env.arm_geoms)], env.num_points)
        sampled = time.perf_counter()
        times["physics"].append(1000 * (advanced - start))
        times["rays"].append(1000 * (cast - advanced))
        times["sampling"].append(1000 * (sampled - cast))
    return {name: statistics.median(values) for name, values in times.items()}


def demonstration(task: str) -> Demonstrations:
    """One recorded episode of the expert: the first one that succeeds."""
    env = SIMULATOR.make(task, SIMULATOR.recipe["num_points"])
    attempt, episode = 0, None
    while episode is None:
        seed = demonstration_seed(SIMULATOR, task, seed=0, attempt=attempt)
        episode = record_episode(env, seed)
        attempt += 1
    arrays, _ = episode
    return Demonstrations(
        task=task,
        instruction="bench",
        points=arrays["points"],
        state=arrays["state"],
        action=arrays["action"],
        episode_ends=np.array([len(arrays["action"])]),
        meta={},
    )


# ---- A policy ------------------------------------------------------------------------------------


class Bench:
    """A fresh policy, one recorded episode, and the calls that train.py, finetune.py and
    evaluate.py make with them.
    """

    def __init__(
        self, config: PolicyConfig, preset: str, recording: Demonstrations, device: torch.device
    ):
        torch.manual_seed(0)
        self.preset = preset
        self.settings = SETTINGS[preset]
        self.policy = model.build_policy(config).to(device)
        self.sampler = WindowSampler(recording, config, device=device)
        self.policy.normalizer.fit([self.sampler])
        text = torch.randn(config.text_dim, generator=torch.Generator().manual_seed(0))
        self.text = text.to(device)

    def batches(self, tasks: int) -> list[Batch]:
        """A batch of an outer step for each of so many tasks, all of them of the one recording."""
        n = self.settings.support + self.settings.query
        return [
            task_batch(self.policy, self.sampler, self.text, n, (0, 0, task), self.settings)
            for task in range(tasks)
        ]

    def outer_step(
        self, batches: list[Batch], *, first_order: bool, vectorize: int | None = None
    ) -> None:
        meta_gradient(
            partial(loss_of, self.policy),
            dict(self.policy.named_parameters()),
            (split(batch, self.settings.support) for batch in batches),
            lr=self.settings.inner_lr,
            first_order=first_order,
            vectorize=vectorize or self.settings.vectorize,
        )

    def one_task_at_a_time(self, batches: list[Batch]) -> None:
        """Multi-task training without a batch over tasks."""
        for batch in batches:
            multi_task_gradient(self.policy, [batch])

    def adapt(self, steps: int) -> list[float]:
        """The time at the end of each step of finetune.py."""
        training = adapt_policy(
            self.policy,
            self.sampler,
            self.text,
            steps=steps,
            batch=BATCH[self.preset],
            learning_rates=LEARNING_RATES,
        )
        return [time.perf_counter() for _ in training]

    def textbook(self, steps: int) -> list[float]:
        """The same for a textbook's training of the same network on the same windows."""
        policy = TextbookDP3(self.policy.config).to(self.text.device)
        average = TextbookDP3(self.policy.config).to(self.text.device)
        policy.load_state_dict(self.policy.state_dict())
        optimizer = torch.optim.AdamW(policy.parameters(), lr=1e-4)
        generator = torch.Generator().manual_seed(0)
        n, times = BATCH[self.preset], []
        for _ in range(steps):
            noise = self.policy.draw_noise_and_timesteps(n, generator)
            windows = self.sampler.sample(n, generator)
            training_step(policy, average, optimizer, {**windows, **noise})
            times.append(time.perf_counter())
        return times

    @torch.no_grad()
    def encode(self) -> tuple[Tensor, ...] | None:
        return self.policy.encode_demo(self.text[None], **self.sampler.demonstration(0))

    def control(self) -> Callable[[], Tensor]:
        """What draws one chunk of actions."""
        context = self.encode()
        frames = self.sampler.gather(torch.tensor([100]))
        return lambda: self.policy.sample_actions(frames["points"], frames["state"], context)


def episode_seconds(task: str, device: torch.device, repeat: int) -> float:
    """Seconds that one core takes for an episode of 200 steps, rolled out as in evaluate.py.

    The policy is `small`, untrained, so that no episode ends early by success.
    """
    bench = Bench(PRESETS["small"], "small", demonstration(task), device)
    num_points = bench.policy.config.num_points
    environments = [SIMULATOR.make(task, num_points) for _ in range(EPISODES_A_JOB)]
    seeds = [evaluation_seed(0, episode) for episode in range(EPISODES_A_JOB)]
    threads = torch.get_num_threads()
    torch.set_num_threads(1)

    def roll_out() -> None:
        rollout(
            bench.policy.eval(),
            environments=environments,
            seeds=seeds,
            sampler=bench.sampler,
            text=bench.text,
            generator=torch.Generator(),
        )

    milliseconds = medians({task: roll_out}, repeat)[task]
    torch.set_num_threads(threads)
    return milliseconds / 1000 / EPISODES_A_JOB


def peak_memory(tasks: int) -> float:
    """GB that a process of its own holds at most for second-order outer steps of `small`."""
    command = [sys.executable, "-m", "tests.bench", "--peak-memory", str(tasks)]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return float(printed.split()[-1])


def print_peak_memory(tasks: int, device: torch.device) -> None:
    """What that process does."""
    import resource  # POSIX has it

    bench = Bench(PRESETS["small"], "small", demonstration("drawer-close"), device)
    for _ in range(2):
        bench.outer_step(bench.batches(tasks), first_order=False)
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6)


# ---- What an inner step does to a policy ---------------------------------------------------------

INNER_STEP_SEEDS = 5  # windows are drawn of seeds 0 to 4


class InnerStepBench:
    """A trained policy, and windows of every task of ML10, drawn as in its training."""

    def __init__(self, checkpoint: Path, folder: str):
        self.policy, info = load_trained(checkpoint)
        self.arguments = info["arguments"]  # the settings of its training
        base, novel = SIMULATOR.tasks(SUITE)
        self.tasks = {"base": base, "novel": novel}
        recordings = {
            task: load_demonstrations(path)
            for task, path in collect(SIMULATOR, base + novel, folder).items()
        }
        self.text, _ = instruction_features(
            {task: recording.instruction for task, recording in recordings.items()},
            weights=None,
            identity=info["text_weights"],
            device="cpu",
        )
        self.samplers = {
            task: WindowSampler(
                recording,
                self.policy.config,
                after_success=self.arguments["after_success"],
                augment=self.arguments["augment"],
            )
            for task, recording in recordings.items()
        }
        self.params = {name: p.detach() for name, p in self.policy.named_parameters()}
        self.loss_fn = partial(loss_of, self.policy)

    def pairs(self, part: str, seed: int, settings: Settings) -> list[tuple[Batch, Batch]]:
        """The windows of each base or novel task, split into support and query.

        The dropouts of `settings` decide what a batch says of its task.
        """
        support = self.arguments["support"]
        n = support + self.arguments["query"]
        pairs = []
        for index, task in enumerate(self.tasks[part]):
            batch = task_batch(
                self.policy,
                self.samplers[task],
                self.text[task],
                n,
                (seed, 0, index),
                settings,
                inner=True,
            )
            pairs.append(split(batch, support))
        return pairs

    @torch.no_grad()
    def loss(self, params: dict[str, Tensor], batch: Batch) -> float:
        return self.loss_fn(params, batch).item()

    def query_losses(self, part: str, inner_lr: float, settings: Settings) -> tuple[float, float]:
        """The mean query losses before and after an inner step."""
        losses = []
        for seed in range(INNER_STEP_SEEDS):
            for support, query in self.pairs(part, seed, settings):
                adapted = adapt(self.loss_fn, self.params, support, inner_lr)
                losses.append((self.loss(self.params, query), self.loss(adapted, query)))
        before, after = np.mean(losses, axis=0)
        return before, after

    def changes(self, inner_lr: float) -> tuple[float, float, float, float]:
        """What an inner step changes on base tasks, as shares of what was there before; medians.

        Returns the changes of the weights, of the support loss, of the query loss and of the
        meta-gradient. That is compared with the gradient without an inner step.
        """
        weights, support_losses, query_losses, gradients = [], [], [], []
        for seed in range(INNER_STEP_SEEDS):
            pairs = self.pairs("base", seed, Settings())
            for support, query in pairs:
                adapted = adapt(self.loss_fn, self.params, support, inner_lr)
                weights.append(relative_change(adapted, self.params))
                for batch, changes in ((support, support_losses), (query, query_losses)):
                    changes.append(self.loss(adapted, batch) / self.loss(self.params, batch) - 1)
            plain, _, _ = meta_gradient(self.loss_fn, self.params, pairs, lr=0.0)
            gradient, _, _ = meta_gradient(self.loss_fn, self.params, pairs, lr=inner_lr)
            gradients.append(relative_change(gradient, plain))
        return (
            float(np.median(weights)),
            float(np.median(support_losses)),
            float(np.median(query_losses)),
            float(np.median(gradients)),
        )


def relative_change(new: dict[str, Tensor], old: dict[str, Tensor]) -> float:
    """The norm of the difference of two dictionaries of tensors over the norm of the old one."""
    new_vector = torch.cat([x.flatten() for x in new.values()])
    old_vector = torch.cat([x.flatten() for x in old.values()])
    return ((new_vector - old_vector).norm() / old_vector.norm()).item()


def print_inner_step(checkpoint: Path, folder: str, inner_lr: float | None) -> None:
    """Prints what an inner step does to a policy, on windows of each task as in its training.

    The first table has it at the rate of the training, on base and on novel tasks, by what the
    policy is shown. The second has it on base tasks with the mean over a window's H x A numbers, as
    DP3 and this code have it, and with their sum, as the paper writes the loss: that is an inner
    rate H x A times as large.
    """
    bench = InnerStepBench(checkpoint, folder)
    if inner_lr is None:
        inner_lr = bench.arguments["inner_lr"]
    print(f"\n{checkpoint}: query loss before -> after an inner step at {inner_lr:g}, means\n")
    print("| the policy is shown | base tasks | novel tasks |\n|---|---|---|")
    inputs = {
        "instruction, demonstration": Settings(),
        "demonstration": Settings(instruction_dropout=1.0),
        "nothing but the support windows": Settings(task_dropout=1.0),
    }
    for title, settings in inputs.items():
        cells = []
        for part in bench.tasks:
            before, after = bench.query_losses(part, inner_lr, settings)
            cells.append(f"{before:.4f} -> {after:.4f}")
        print(f"| {title} | {' | '.join(cells)} |", flush=True)

    print("\n| inner step at 1e-4 on the | weights | support loss | query loss | meta-gradient |")
    print("|---|---|---|---|---|")
    config = bench.policy.config
    for title, factor in {"mean": 1, "sum": config.horizon * config.action_dim}.items():
        weights, support_loss, query_loss, gradient = bench.changes(1e-4 * factor)
        cells = f"{weights:.1e} | {support_loss:+.1%} | {query_loss:+.1%} | {gradient:.1%}"
        print(f"| {title} (medians) | {cells} |", flush=True)


# ---- Second-order MAML of other libraries --------------------------------------------------------

PEERS = {  # archive on PyPI -> the package in it
    "learn2learn-0.2.0.tar.gz": "learn2learn",
    "higher-0.2.1-py3-none-any.whl": "higher",
}


def unpack_peers(folder: Path) -> list[str]:
    """Makes the packages in a folder's archives importable; returns those that are there.

    They are not installed, since neither builds with a current Python, nor are their `__init__`
    files run, which import much that MAML does not need.
    """
    found = []
    unpacked = Path(tempfile.mkdtemp(prefix="peers-"))
    atexit.register(shutil.rmtree, unpacked, ignore_errors=True)
    for archive, package in PEERS.items():
        if not (folder / archive).is_file():
            print(f"{folder / archive} is missing, and is left out: download it from PyPI")
            continue
        file_format = "zip" if archive.endswith(".whl") else "gztar"
        shutil.unpack_archive(folder / archive, unpacked / package, file_format)
        [source] = [path for path in unpacked.glob(f"{package}/**/{package}") if path.is_dir()]
        for name, place in ((package, source), (f"{package}.algorithms", source / "algorithms")):
            sys.modules[name] = ModuleType(name)
            sys.modules[name].__path__ = [str(place)]
        found.append(package)
    return found


def learn2learn_gradient(policy: DAMIPolicy, pairs: list[tuple[Batch, Batch]], lr: float) -> None:
    """The gradient of the mean query loss, left in the parameters' `grad`, by learn2learn."""
    learner = import_module("learn2learn.algorithms.maml").MAML(policy, lr=lr)
    for support, query in pairs:
        adapted = learner.clone()
        adapted.adapt(adapted(**support))
        (adapted(**query) / len(pairs)).backward()


def higher_gradient(policy: DAMIPolicy, pairs: list[tuple[Batch, Batch]], lr: float) -> None:
    """The same by higher."""
    patch, optim = import_module("higher.patch"), import_module("higher.optim")
    optimizer = torch.optim.SGD(policy.parameters(), lr=lr)
    for support, query in pairs:
        adapted = patch.monkeypatch(policy, copy_initial_weights=False, track_higher_grads=True)
        inner = optim.get_diff_optim(optimizer, policy.parameters(), fmodel=adapted)
        inner.step(adapted(**support))
        (adapted(**query) / len(pairs)).backward()


def autograd_gradient(policy: DAMIPolicy, pairs: list[tuple[Batch, Batch]], lr: float) -> None:
    """The same by plain autograd, task by task."""
    parameters = dict(policy.named_parameters())
    for support, query in pairs:
        gradients = torch.autograd.grad(
            policy(**support), list(parameters.values()), create_graph=True
        )
        adapted = {name: p - lr * g for (name, p), g in zip(parameters.items(), gradients)}
        (functional_call(policy, adapted, (), query) / len(pairs)).backward()


def print_peers(folder: Path, recording: Demonstrations, device: torch.device, repeat: int) -> None:
    """The time of a second-order meta-gradient of ten tasks, ours and others', taking turns."""
    bench = Bench(PRESETS["small"], "small", recording, device)
    settings, policy = bench.settings, bench.policy
    batches = bench.batches(10)
    pairs = [split(batch, settings.support) for batch in batches]
    ours, _, _ = meta_gradient(
        partial(loss_of, policy),
        dict(policy.named_parameters()),
        pairs,
        lr=settings.inner_lr,
        vectorize=settings.vectorize,
    )
    others = {"plain autograd, task by task": autograd_gradient}
    found = unpack_peers(folder)
    if "learn2learn" in found:
        others["learn2learn 0.2.0"] = learn2learn_gradient
    if "higher" in found:
        others["higher 0.2.1"] = higher_gradient

    calls = {
        "this code": partial(bench.outer_step, batches, first_order=False),
        "this code, task by task": partial(
            bench.outer_step, batches, first_order=False, vectorize=1
        ),
    }
    for name, gradient_of in others.items():
        calls[name] = partial(gradient_of, policy, pairs, settings.inner_lr)
    for name in others:  # they agree
        policy.zero_grad()
        calls[name]()
        theirs = {name: parameter.grad.clone() for name, parameter in policy.named_parameters()}
        print(f"{name}: differs from this code's by {relative_change(theirs, ours):.1e}")
    policy.zero_grad()
    ms = medians(calls, repeat)
    print("\n| second-order meta-gradient, `small`, 10 tasks | ms | over this code's |")
    print("|---|---|---|")
    for name, value in ms.items():
        print(f"| {name} | {value:.0f} | {value / ms['this code']:.2f} |", flush=True)


# ---- Tables --------------------------------------------------------------------------------------


def print_table(title: str, rows: dict[str, float]) -> None:
    print(f"\n| {title} | |\n|---|---|")
    for name, value in rows.items():
        digits = 2 if value < 20 else 0
        print(f"| {name} | {value:.{digits}f} |", flush=True)


def print_simulator(device: torch.device, repeat: int) -> None:
    """What a GPU has no part in: frames, episodes, and memory."""
    print("\n| frame, one core, ms | physics | rays | sampling | all |\n|---|---|---|---|---|")
    for task in TASKS:
        times = list(frame_times(task).values())
        cells = [f"{milliseconds:.1f}" for milliseconds in (*times, sum(times))]
        print(f"| {task} | {' | '.join(cells)} |", flush=True)
    print_table(
        "evaluation, one core, `small`: seconds an episode of 200 steps",
        {task: episode_seconds(task, device, repeat) for task in TASKS},
    )
    print_table(
        "`small`, second order, peak memory, GB",
        {f"{tasks} tasks": peak_memory(tasks) for tasks in (10, 20, 40)},
    )


def print_preset(bench: Bench, rate: float, repeat: int) -> None:
    """Every kind of step of a preset, and how far it is from the machine's limit.

    `rate` is that limit, see `matrix_rate`.
    """
    batches, control = bench.batches(10), bench.control()
    second_order = partial(bench.outer_step, batches, first_order=False)
    first_order = partial(bench.outer_step, batches, first_order=True)
    one_batch = partial(multi_task_gradient, bench.policy, batches)
    one_task_at_a_time = partial(bench.one_task_at_a_time, batches)
    ms = {
        **medians(
            {
                "outer step, second order": second_order,
                "outer step, first order": first_order,
                "multi-task step, all windows in one batch": one_batch,
                "multi-task step, one task at a time": one_task_at_a_time,
            },
            repeat,
        ),
        **step_medians({"adaptation step": bench.adapt}, steps=5, rounds=3),
        **medians({"control step": control, "encoding the demonstration": bench.encode}, repeat),
    }
    # The operations of outer steps are counted task by task, since those of grouped convolutions,
    # which vmap makes, are not counted rightly.
    operations = {
        "outer step, second order": gflop(partial(second_order, vectorize=1)),
        "outer step, first order": gflop(partial(first_order, vectorize=1)),
        "multi-task step, all windows in one batch": gflop(one_batch),
        "multi-task step, one task at a time": gflop(one_task_at_a_time),
        "adaptation step": gflop(lambda: bench.adapt(1)),
        "control step": gflop(control),
        "encoding the demonstration": gflop(bench.encode),
    }
    print(f"\n| `{bench.preset}`, 10 tasks | ms | GFLOP | of the matrix product's rate |")
    print("|---|---|---|---|")
    for name, value in ms.items():
        share = operations[name] / value * 1000 / rate
        print(f"| {name} | {value:.1f} | {operations[name]:.2f} | {share:.0%} |", flush=True)
    second = ms["outer step, second order"]
    print_table(
        f"`{bench.preset}`: second order over",
        {
            "first order": second / ms["outer step, first order"],
            "one batch": second / ms["multi-task step, all windows in one batch"],
            "one task at a time": second / ms["multi-task step, one task at a time"],
        },
    )


def print_policies(recording: Demonstrations, device: torch.device, repeat: int) -> None:
    """What training and control of each policy of baselines.py cost, `small`, taking turns."""
    columns = ("multi-task step", "in bfloat16", "second order", "control step")
    calls = {}
    for policy, presets in baselines.PRESETS.items():
        bench = Bench(presets["small"], "small", recording, device)
        batches = bench.batches(10)
        step = partial(multi_task_gradient, bench.policy, batches)
        calls[policy, "multi-task step"] = step
        calls[policy, "in bfloat16"] = partial(step, bfloat16=True)
        calls[policy, "second order"] = partial(bench.outer_step, batches, first_order=False)
        calls[policy, "control step"] = bench.control()
    ms = medians(calls, repeat)
    print(
        f"\n| `small`, ms | {' | '.join(columns)} | of so many actions |\n|---|---|---|---|---|---|"
    )
    for policy, presets in baselines.PRESETS.items():
        cells = [f"{ms[policy, column]:.0f}" for column in columns]
        print(f"| {policy} | {' | '.join(cells)} | {presets['small'].n_action_steps} |", flush=True)


def print_beside_dp3(
    preset: str,
    recording: Demonstrations,
    device: torch.device,
    *,
    steps: int,
    rounds: int,
    repeat: int,
) -> None:
    """DAMI's steps beside those of the same network without a demonstration, which is DP3's."""
    dami = Bench(PRESETS[preset], preset, recording, device)
    dp3 = Bench(replace(PRESETS[preset], **DP3), preset, recording, device)
    ms = step_medians(
        {"DAMI": dami.adapt, "DP3": dp3.adapt, "DP3 as a textbook writes it": dp3.textbook},
        steps,
        rounds,
    )
    print_table(f"`{preset}`, adaptation step, {BATCH[preset]} windows, ms", ms)
    control = medians({"DAMI": dami.control(), "DP3": dp3.control()}, repeat)
    print_table(f"`{preset}`, control step, ms", control)
    ours_over_the_textbooks = ms["DP3"] / ms["DP3 as a textbook writes it"]
    print_table(
        f"`{preset}`, ratios",
        {
            "adaptation step, DAMI over DP3": ms["DAMI"] / ms["DP3"],
            "control step, DAMI over DP3": control["DAMI"] / control["DP3"],
            "training step of DP3, ours over the textbook's": ours_over_the_textbooks,
        },
    )


def print_paper(recording: Demonstrations, device: torch.device, repeat: int) -> None:
    """The outer step at the paper's size."""
    bench = Bench(PRESETS["paper"], "paper", recording, device)
    batches = bench.batches(1)
    ms = medians(
        {
            "second order": partial(bench.outer_step, batches, first_order=False),
            "first order": partial(bench.outer_step, batches, first_order=True),
        },
        repeat,
    )
    seconds = {name: value / 1000 for name, value in ms.items()}
    print_table("`paper`, outer step, one task, s", seconds)


# ---- Command line --------------------------------------------------------------------------------


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--paper", action="store_true", help="the paper's size too (10 minutes more, 16 GB)")
    add("--network", action="store_true", help="only the network's steps")
    add(
        "--peers",
        type=Path,
        metavar="FOLDER",
        help="only other libraries' second-order MAML beside ours: the folder has their archives "
        f"from PyPI, {' and '.join(PEERS)}",
    )
    add("--inner-step", action="store_true", help="only what it does to a policy")
    add("--data", default="data", help="demonstrations that --inner-step reads")
    add("--inner-lr", type=float, help="its rate (default: of the training)")
    add("--checkpoint", default=SHIPPED_CHECKPOINT, help="its policy, or run folder")
    add("--repeat", type=int, default=5)
    add("--device")
    add("--peak-memory", type=int, help=argparse.SUPPRESS)
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    args = parse(argv)
    device = pick_device(args.device)
    if args.peak_memory:
        print_peak_memory(args.peak_memory, device)
        return
    if args.inner_step:
        print_inner_step(checkpoints_of(args.checkpoint)[-1], args.data, args.inner_lr)
        return

    threads, today = torch.get_num_threads(), time.strftime("%Y-%m-%d")
    print(f"{hardware(device)}, torch {torch.__version__}, {threads} threads, {today}")
    if not (args.network or args.peers):
        print_simulator(device, args.repeat)
    recording = demonstration("drawer-close")
    if args.peers:
        print_peers(args.peers, recording, device, args.repeat)
        return
    rate = matrix_rate(device)
    print(f"\nmatrix product: {rate:.0f} GFLOP a second")
    for preset in ("small", "tiny"):
        print_preset(Bench(PRESETS[preset], preset, recording, device), rate, args.repeat)
    print_policies(recording, device, args.repeat)
    print_beside_dp3("small", recording, device, steps=4, rounds=5, repeat=args.repeat)
    if args.paper:
        print_beside_dp3("paper", recording, device, steps=2, rounds=3, repeat=args.repeat)
        print_paper(recording, device, args.repeat)


if __name__ == "__main__":
    command_line(main, errors=(RecordingError, CheckpointError, TextWeightsError))
