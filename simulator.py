"""Simulators, and the demonstrations that their scripted experts record.

    python simulator.py --suite ml10        # ten demonstrations of each of its 15 tasks into data/
    python simulator.py --task shelf-place  # of one task

What trains, adapts and evaluates a policy knows a simulator only by the two Protocols below,
`Simulator` and `Environment`; rl.py also reads states of the simulator, see there. A new simulator
is a file with a class that has their methods, and an entry in SIMULATORS for each of its suites of
tasks. Its packages are imported only when one of its suites is asked for: own recordings are
trained on without them.

Letters: N points of an observation, S state dim, A action dim, T frames of an episode.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

import numpy as np

from common import UserError, choose, command_line, format_table, locked, report_progress, run_jobs
from data import Demonstrations, RecordingError, load_demonstrations, save_demonstrations

# ---- What a simulator is -------------------------------------------------------------------------


class OutOfSightError(Exception):
    """There is nothing to observe: everything is out of the camera's sight."""


class Environment(Protocol):
    """One task of a simulator. An episode is `begin`, then `advance`, again and again.

    `observe` and `render` cost time and change nothing. They are called in between, where their
    result is needed.
    """

    def begin(self, seed: int) -> None:
        """Begins the episode of this seed: the same seed gives the same episode."""

    def observe(self) -> dict[str, np.ndarray]:
        """Returns the observation of the present moment.

        "point_cloud" (N, 3) float32, or (N, point_dim) where points have features such as colours;
        in the order of farthest point sampling, so that its first k points are a good sample, too.
        "agent_pos" (S,) float32. World frame, metres. Raises OutOfSightError where nothing is seen.
        If that happens after a step, the rollout ends there, and its last step counts as no
        success; right after `begin` something must be seen.
        """

    def advance(self, action: np.ndarray) -> tuple[float, bool, dict]:
        """Takes one step with an action (A,) float32, which it clips to what is allowed.

        Returns (reward, truncated, {"success": bool}). An episode succeeds if any of its steps
        does, and it is over when it is truncated: `advance` is not called again before `begin`.
        """

    def expert_action(self) -> np.ndarray:
        """Returns the scripted expert's action (A,) float32 for the present moment."""

    def render(self) -> np.ndarray:
        """Returns a picture (240, 240, 3) uint8 of the present moment."""

    # Two more members are optional. `change_task(task)` turns this environment into one of another
    # task and returns True, or returns False and changes nothing. It saves time where many tasks
    # differ little. `other_successes`, where tasks are pairs, lists for each step of the episode
    # whether it was a success at the pair's other task.


class Simulator(Protocol):
    """A simulator's tasks, and how to make their environments.

    It is pickled for worker processes: it is small, and its class stands in a module. Two
    simulators that make the same environments should compare equal, as frozen dataclasses do;
    otherwise a process makes its environments anew for each job.
    """

    name: str
    # Task -> what the robot is told. A task's place in it, and how many tasks there are, decide the
    # seeds of its demonstrations.
    instructions: dict[str, str]
    # How recordings are made: "simulator" (the name), "num_points" and more. With "success": "at
    # the end" an expert's episode is kept only if its last step is a success, too. With "made_by"
    # there is no expert: it then says how a user makes the recordings.
    recipe: dict[str, Any]
    packages: Sequence[str]  # whose versions are written into recordings
    demonstrations: int  # of a task, unless a command says otherwise
    episode_steps: int  # after so many steps an episode is truncated
    # Two more may be left out. With `one_environment = True` a process uses one environment at a
    # time, and with `one_demonstration = True` all rollouts of a task are shown the same
    # demonstration.

    def tasks(self, suite: str) -> tuple[list[str], list[str]]:
        """Returns a suite's (base, novel) tasks: those to train on, and those to adapt to."""

    def make(self, task: str, num_points: int) -> Environment:
        """Makes an environment of a task whose clouds have `num_points` points."""


def import_simulator(module: str) -> ModuleType:
    """Imports a simulator's file; UserError says what to install where a package is missing."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        if error.name not in ("gymnasium", "metaworld", "mujoco", "scipy"):
            raise
        raise UserError(
            f"the package {error.name} is not installed: pip install -r requirements.txt"
        ) from error


def meta_world() -> Simulator:
    """Returns Meta-World, which is imported only here."""
    return import_simulator("metaworld_env").MetaWorld()


def hidden_goals() -> Simulator:
    """Returns Meta-World's skills with hidden goals, which are imported only here."""
    return import_simulator("hidden_goals").HiddenGoals()


def pairs() -> Simulator:
    """Returns Meta-World's pairs of tasks in one scene, which are imported only here."""
    return import_simulator("unnamed_tasks").Pairs()


def conventions() -> Simulator:
    """Returns Meta-World's skills with turned actions, which are imported only here."""
    return import_simulator("unnamed_tasks").Conventions()


def rlbench() -> Simulator:
    """Returns RLBench's few-shot suite; UserError says what to install where it is missing."""
    return import_simulator("rlbench_env").RLBench()


SIMULATORS: dict[str, Callable[[], Simulator]] = {
    "ml10": meta_world,
    "ml45": meta_world,
    "goals-reach": hidden_goals,
    "goals-push": hidden_goals,
    "goals-pick-place": hidden_goals,
    "goals-reach-validation": hidden_goals,
    "goals-push-validation": hidden_goals,
    "goals-pick-place-validation": hidden_goals,
    "pairs": pairs,
    "convention-reach": conventions,
    "convention-push": conventions,
    "convention-reach-validation": conventions,
    "convention-push-validation": conventions,
    "fs25": rlbench,
}


def simulator_of(suite: str) -> Simulator:
    """Returns the simulator of a suite. For an unknown one UserError names the nearest suite."""
    return SIMULATORS[choose(suite, SIMULATORS, "suite")]()


def check_task(simulator: Simulator, task: str) -> str:
    """Returns `task` if the simulator has it. Otherwise UserError names the nearest task."""
    return choose(task, simulator.instructions, "task")


@dataclass
class KeptEnvironments:
    """The environments that this process used last, and what they were made for."""

    made_for: tuple[Simulator, int] | None = None  # and how many points
    task: str | None = None
    environments: list[Environment] = field(default_factory=list)


kept = KeptEnvironments()


def environments_of(
    simulator: Simulator, task: str, number: int, num_points: int
) -> list[Environment]:
    """Returns `number` environments of a task, whose clouds have `num_points` points.

    Environments of the previous call are used again, for another task if they can change to it: the
    caller must have finished with those.
    """
    environments = kept.environments
    kept.environments = []  # should anything fail below, none is kept
    if kept.made_for != (simulator, num_points):
        environments = []
    elif kept.task != task:
        environments = [
            environment
            for environment in environments
            if hasattr(environment, "change_task") and environment.change_task(task)
        ]
    while len(environments) < number:
        environments.append(simulator.make(task, num_points))
    kept.made_for = (simulator, num_points)
    kept.task = task
    kept.environments = environments
    return environments[:number]


# ---- Seeds of episodes ---------------------------------------------------------------------------

RUN_SEEDS = 1_000  # a --seed is below this
EPISODE_SEEDS = 100_000  # episodes that each --seed has


def episode_seed(seed: int, episode: int) -> int:
    """Returns a number below 10**8 that no other pair of `seed` and `episode` has.

    Raises UserError for a seed that is not from 0 to 999, or an episode not below 100,000.
    """
    if not 0 <= seed < RUN_SEEDS:
        raise UserError(f"seed {seed} is out of range: use a seed from 0 to {RUN_SEEDS - 1}")
    if not 0 <= episode < EPISODE_SEEDS:
        raise UserError(
            f"episode {episode} is out of range: a seed has {EPISODE_SEEDS} episodes, counted "
            "from 0; use fewer --episodes"
        )
    return seed * EPISODE_SEEDS + episode


def evaluation_seed(seed: int, episode: int) -> int:
    """Returns the episode seed of a rollout, at least 10**8.

    Those of demonstrations are below, so that no rollout is the episode of a demonstration.
    """
    return RUN_SEEDS * EPISODE_SEEDS + episode_seed(seed, episode)


def seeds_of_a_task(simulator: Simulator) -> int:
    """Returns how many of a seed's episodes are for the demonstrations of one task."""
    return EPISODE_SEEDS // len(simulator.instructions)


def draw_base_tasks(base_tasks: Sequence[str], n: int | None, seed: int) -> list[str]:
    """Returns the tasks to train on, in their order: n of them that the seed draws; None: all."""
    n = len(base_tasks) if n is None else n
    if n > len(base_tasks):
        raise UserError(f"--base-tasks is {n}: there are {len(base_tasks)}, use at most that")
    drawn = np.random.default_rng(seed).choice(len(base_tasks), n, replace=False)
    return [base_tasks[i] for i in sorted(drawn)]


def demonstration_seed(simulator: Simulator, task: str, seed: int, attempt: int) -> int:
    """Returns the episode seed of one attempt at a demonstration, below 10**8.

    No two tasks share a seed: tasks that draw their goals by the same rule would otherwise have the
    same ones. Raises ValueError for an attempt that would have a seed of the next task.
    """
    seeds = seeds_of_a_task(simulator)
    if not 0 <= attempt < seeds:
        raise ValueError(
            f"attempt {attempt} at a demonstration of {task} is out of range: "
            f"each of {len(simulator.instructions)} tasks has {seeds} seeds"
        )
    first = seeds * list(simulator.instructions).index(task)
    return episode_seed(seed, first + attempt)


# ---- How a recording was made --------------------------------------------------------------------


def made_by_simulator(demonstrations: Demonstrations) -> bool:
    """Whether a recording was made by `collect`, and not by a robot or by other software."""
    return "simulator" in demonstrations.meta


def has_expert(simulator: Simulator) -> bool:
    """Whether an expert records the demonstrations; otherwise a user has to import them."""
    return "made_by" not in simulator.recipe


def check_recipe(demonstrations: Demonstrations, path: str | Path, recipe: dict[str, Any]) -> None:
    """Raises UserError for a recording, read from `path`, that was not made by this recipe."""
    if "simulator" in recipe and not made_by_simulator(demonstrations):
        raise UserError(
            f"{path} was recorded by an older version, or is a recording of your own: "
            "move it or use another --data"
        )
    changed = [
        name
        for name, value in recipe.items()
        if demonstrations.meta.get(name) != value and name != "made_by"  # which is advice
    ]
    if changed:
        raise UserError(
            f"{path} was recorded with another {', '.join(changed)}: move it or use another --data"
        )


# ---- Collecting demonstrations of the scripted experts -------------------------------------------

ATTEMPTS_PER_EPISODE = 20  # an expert that needs more of them for each success is given up


def collect(
    simulator: Simulator,
    tasks: Sequence[str],
    folder: str | Path,
    *,
    episodes: int = 10,
    seed: int = 0,
    workers: int | None = None,
) -> dict[str, Path]:
    """Collects successful episodes of each task; each worker process records one task at a time.

    A file that already holds enough episodes is kept, and one that holds fewer is made again. Of
    several processes that collect into one folder, one works at a time.

    Args:
        simulator: whose experts act.
        tasks: some of the simulator's.
        folder: `TASK.npz` of each task is written into it; see data.py.
        episodes: how many of each task.
        seed: chooses objects and goals, 0 to 999.
        workers: processes; None: one a core.

    Returns:
        task -> file.

    Raises:
        UserError: an unknown task, a seed or number of episodes out of range, a folder that cannot
            be written to, a file in it that was recorded otherwise (it is never overwritten), an
            expert that hardly ever succeeds, or a missing file of a simulator without experts.
        RecordingError: a damaged file.
    """
    folder = Path(folder)
    paths = {check_task(simulator, task): folder / f"{task}.npz" for task in tasks}
    if not 1 <= episodes <= seeds_of_a_task(simulator):
        bound = "at least 1" if episodes < 1 else f"at most {seeds_of_a_task(simulator)}"
        raise UserError(f"{episodes} demonstrations of a task: use {bound}")
    episode_seed(seed, 0)  # refuses a seed out of range

    missing = missing_tasks(simulator, paths, episodes, seed)
    if not missing:
        return paths  # the folder may be read-only
    if not has_expert(simulator):
        raise UserError(
            f"{paths[missing[0]]} is missing or holds fewer than {episodes} demonstrations: make "
            f"it by {simulator.recipe['made_by']}"
        )
    waiting = f"another process collects into {folder}: waiting until it is done"
    with locked(folder, name=".collecting.lock", flag="--data", waiting=waiting):
        jobs = [
            {
                "simulator": simulator,
                "task": task,
                "path": paths[task],
                "episodes": episodes,
                "seed": seed,
            }
            for task in missing_tasks(simulator, paths, episodes, seed)  # now, after waiting
        ]
        try:
            run_jobs(
                collect_task,
                jobs,
                workers=workers,
                total=len(jobs) * episodes,
                description="collecting",
            )
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"the tasks that were finished are kept in {folder}, the same command goes on"
            ) from None
    return paths


def missing_tasks(
    simulator: Simulator, paths: dict[str, Path], episodes: int, seed: int
) -> list[str]:
    """Returns the tasks whose file is not there or holds too few episodes; paths: task -> file.

    Raises UserError for a file that was made in another way.
    """
    recipe = dict(simulator.recipe)
    if has_expert(simulator):
        recipe["seed"] = seed
    missing = []
    for task, path in paths.items():
        if not path.exists():
            missing.append(task)
            continue
        demonstrations = load_demonstrations(path)
        check_recipe(demonstrations, path, recipe)
        if demonstrations.task != task:
            raise UserError(
                f"{path} is a recording of {demonstrations.task}: move it or use another --data"
            )
        if len(demonstrations) < episodes:
            missing.append(task)
    return missing


def collect_task(simulator: Simulator, task: str, path: Path, episodes: int, seed: int) -> None:
    """Records `episodes` successful episodes of one task into a file."""
    start = time.perf_counter()
    recipe = simulator.recipe
    (env,) = environments_of(simulator, task, 1, recipe["num_points"])
    most_attempts = min(ATTEMPTS_PER_EPISODE * episodes, seeds_of_a_task(simulator))

    recorded, episode_seeds, success_frames = [], [], []  # of each successful episode
    attempts = 0
    while len(recorded) < episodes:
        if attempts == most_attempts:
            raise UserError(
                f"{task}: the expert succeeded in {len(recorded)} of {attempts} episodes; "
                "ask for fewer demonstrations of it, or leave the task out"
            )
        drawn_seed = demonstration_seed(simulator, task, seed, attempts)
        attempts += 1
        episode = record_episode(env, drawn_seed, at_end=recipe.get("success") == "at the end")
        if episode is None:
            continue
        arrays, success_frame = episode
        recorded.append(arrays)
        episode_seeds.append(drawn_seed)
        success_frames.append(success_frame)
        report_progress(task, 1)

    packages = (*simulator.packages, "fpsample", "numpy")
    demonstrations = Demonstrations(
        task=task,
        instruction=simulator.instructions[task],
        points=np.concatenate([arrays["points"] for arrays in recorded]),
        state=np.concatenate([arrays["state"] for arrays in recorded]),
        action=np.concatenate([arrays["action"] for arrays in recorded]),
        episode_ends=np.cumsum([len(arrays["action"]) for arrays in recorded]),
        meta={
            **recipe,
            "made_by": "simulator.collect",
            "seed": seed,
            "episode_seeds": episode_seeds,
            "success_frames": success_frames,
            "expert_success_rate": episodes / attempts,
            "seconds": round(time.perf_counter() - start, 1),
            "versions": {package: version(package) for package in packages},
        },
    )
    save_demonstrations(path, demonstrations)


def record_episode(
    env: Environment, seed: int, at_end: bool = False
) -> tuple[dict[str, np.ndarray], int] | None:
    """Lets the expert act for one episode.

    Returns its "points" (T, N, P) float16, "state" (T, S) and "action" (T, A) float32, each of the
    moment before the step, and the frame of its first success; None if it had none, if there was a
    moment in which nothing was seen, or with `at_end` if its last step was no success.
    """
    points, state, actions = [], [], []  # of each frame
    success_frame = None
    env.begin(seed)
    truncated = False
    while not truncated:
        try:
            observation = env.observe()
        except OutOfSightError:
            return None
        action = env.expert_action()
        points.append(observation["point_cloud"].astype(np.float16))
        state.append(observation["agent_pos"].astype(np.float32))
        actions.append(action.astype(np.float32))

        _, truncated, info = env.advance(action)
        if info["success"] and success_frame is None:
            success_frame = len(actions) - 1

    if success_frame is None or (at_end and not info["success"]):
        return None
    arrays = {"points": np.stack(points), "state": np.stack(state), "action": np.stack(actions)}
    return arrays, success_frame


# ---- Command line --------------------------------------------------------------------------------


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Collects expert demonstrations in a simulator.")
    parser.add_argument(
        "--suite", default="ml10", help=f"whose tasks, one of {', '.join(SIMULATORS)} (ml10)"
    )
    parser.add_argument("--task", help="only this task")
    parser.add_argument("--data", default="data", help="folder of the files (data)")
    parser.add_argument(
        "--episodes", type=int, help="successful episodes a task (10 or 5, as the suite says)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of objects and goals, 0 to 999 (0)")
    parser.add_argument("--workers", type=int, help="processes (one a core)")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    args = parse(argv)
    simulator = simulator_of(args.suite)
    if args.task:
        tasks = [args.task]
    else:
        base, novel = simulator.tasks(args.suite)
        tasks = base + novel

    paths = collect(
        simulator,
        tasks,
        args.data,
        episodes=simulator.demonstrations if args.episodes is None else args.episodes,
        seed=args.seed,
        workers=args.workers,
    )

    rows = [["task", "episodes", "expert", "frames", "seconds", "MB"]]
    for task, path in paths.items():
        demonstrations = load_demonstrations(path)
        expert, seconds = "", ""  # of what was imported
        if has_expert(simulator):
            expert = f"{demonstrations.meta['expert_success_rate']:.0%}"
            seconds = f"{demonstrations.meta['seconds']:.1f}"
        rows.append(
            [
                task,
                len(demonstrations),
                expert,
                len(demonstrations.points),
                seconds,
                f"{path.stat().st_size / 1e6:.1f}",
            ]
        )
    print(format_table(rows))


if __name__ == "__main__":
    command_line(main, errors=(RecordingError,))
