"""The three seams, used as a new user would: a network, a simulator, points with colours.

Each test adds the few lines that README asks for, then calls nothing but the scripts. A toy stands
for what a user brings: toy_simulator.py is the simulator.
"""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from conftest import metrics
from torch import nn
from toy_simulator import ToySimulator

import evaluate
import finetune
import model
import report
import simulator
import train
from data import WindowSampler, load_demonstrations, save_demonstrations

CPU = "--device cpu --threads 1"
QUICK = f"--episodes 0 {CPU}"  # no rollouts


class ToyMLP(nn.Module):
    """A denoiser without any structure: what it reads, flat, through two layers."""

    def __init__(self, config):
        super().__init__()
        size = config.horizon * config.action_dim
        self.layers = nn.Sequential(
            nn.Linear(size + 2 * config.condition_dim, 64), nn.ReLU(), nn.Linear(64, size)
        )

    def forward(self, actions, h, fused):
        """Noisy actions (B, H, A), h_k (B, C), U2T's output (B, C) -> clean actions (B, H, A)."""
        flat = torch.cat([actions.flatten(1), h, fused], dim=1)  # (B, H A + 2 C)
        return self.layers(flat).view_as(actions)


def run_here(job, jobs, **options):
    """In place of `common.run_jobs`: a process more would take seconds."""
    return [job(**arguments) for arguments in jobs]


def random_features(instructions, weights, identity):
    """In place of CLIP, whose text tower takes seconds: random numbers, by the colour named."""
    seeds = [sum(text.encode()) for text in instructions]
    rows = [torch.randn(512, generator=torch.Generator().manual_seed(seed)) for seed in seeds]
    return torch.stack(rows), identity or "random"


@pytest.fixture(autouse=True)
def two_entries(monkeypatch, own_folder):
    """The simulator's entry, and one for the same with colours.

    To save time, nothing is drawn, and recordings are made in this process.
    """
    monkeypatch.setitem(simulator.SIMULATORS, "toy", ToySimulator)
    monkeypatch.setitem(simulator.SIMULATORS, "colored", partial(ToySimulator, colored=True))
    monkeypatch.setattr(evaluate, "text_features", random_features)
    monkeypatch.setattr(report, "save_png", lambda figure, path, dpi: None)
    monkeypatch.setattr(simulator, "run_jobs", run_here)


@pytest.fixture
def here(monkeypatch):
    """Rollouts are in this process, too."""
    monkeypatch.setattr(evaluate, "run_jobs", run_here)


def call(script, options):
    script.main(options.split())


def successes(folder):
    """Of a report: column -> task -> success of each episode."""
    return json.loads((Path(folder) / "success.json").read_text())["successes"]


def lengths(folder):
    """Of a report: column -> task -> number of episodes."""
    columns = successes(folder).items()
    return {name: {task: len(of) for task, of in column.items()} for name, column in columns}


def changed(before, after):
    """The parts of the policy whose parameters differ between two checkpoints."""
    old, new = (dict(model.load(path)[0].named_parameters()) for path in (before, after))
    assert old.keys() == new.keys()
    return {name.split(".")[0] for name in old if not torch.equal(old[name], new[name])}


def test_a_network_is_a_class_and_a_line(here, own_folder, monkeypatch):
    monkeypatch.setitem(model.denoisers, "toy-mlp", ToyMLP)  # the line

    call(simulator, "--suite toy --episodes 2")
    call(train, f"--suite toy --preset tiny --steps 1 --denoiser toy-mlp --out run {QUICK}")
    policy, _ = model.load("run/ema-00001.pt")
    assert isinstance(policy.denoiser, ToyMLP) and policy.config.denoiser == "toy-mlp"
    assert policy.config.reads_task and policy.config.reads_demonstration
    assert "loss_before" in metrics(own_folder / "run")[0]  # there was an inner step

    # Its learning rate in adaptation is that of a denoiser, whatever it is called.
    rates = "--lr-vision 0 --lr-other 0 --lr-diffusion 1e-3"
    adapt = "--suite toy --task touch-blue --demonstrations 2 --steps 2"
    call(finetune, f"--checkpoint run {adapt} --out adapted {rates} {QUICK}")
    parts = changed("run/ema-00001.pt", "adapted/adapted.pt")
    assert parts == {"denoiser", "condition_encoder"}

    call(evaluate, f"--checkpoint run --demonstrations 2 --episodes 1 --out measured {CPU}")
    assert lengths("measured") == {"run/ema-00001": {"touch-red": 1, "touch-green": 1}}


def test_a_simulator_is_a_file_and_an_entry(own_folder, request):
    call(simulator, "--suite toy --episodes 3")

    # The process that rolls out knows the simulator by the name of its file.
    learn = "--suite toy --preset tiny --maml off --demonstrations 3"
    call(train, f"{learn} --steps 30 --out run --episodes 1 --workers 1 {CPU}")
    assert lengths("run") == {"last checkpoint": {"touch-red": 1, "touch-green": 1}}

    policy, info = model.load("run/ema-00030.pt")
    config = policy.config
    assert (config.state_dim, config.action_dim, config.point_dim) == (3, 3, 3)
    assert config.demo_positions == 1 and info["suite"] == "toy"  # 12 steps, every 20th frame

    # The rest in this process, where it takes less time
    request.getfixturevalue("here")
    call(train, f"{learn} --steps 1 --out untrained {QUICK}")
    measure = f"--demonstrations 3 --episodes 10 {CPU}"
    call(evaluate, f"--checkpoint untrained run --out measured {measure}")
    untrained, trained = (sum(map(sum, of.values())) for of in successes("measured").values())
    assert trained > untrained + 4  # of 20 balls that nothing was trained on: 16 and 7

    adapt = f"--suite toy --task novel --demonstrations 3 --steps 1 --episodes 1 {CPU}"
    call(finetune, f"--checkpoint run {adapt} --out adapted")
    assert lengths("adapted") == {"before": {"touch-blue": 1}, "after": {"touch-blue": 1}}
    again = f"--demonstrations 3 --episodes 1 {CPU}"
    call(evaluate, f"--checkpoint adapted/touch-blue --out again {again}")
    assert lengths("again") == {"touch-blue/adapted": {"touch-blue": 1}}


def test_points_with_colors_need_no_line(here, own_folder):
    call(simulator, "--suite colored --episodes 2")
    points = load_demonstrations("data/touch-blue.npz").points
    assert points.shape[2] == 6 and (points[..., 3:] == (0, 0, 1)).all()

    call(train, f"--suite colored --preset tiny --maml off --steps 1 --out run {QUICK}")
    adapt = "--suite colored --task touch-blue --demonstrations 2 --steps 1 --episodes 1"
    call(finetune, f"--checkpoint run {adapt} --out adapted {CPU}")
    call(evaluate, f"--checkpoint run --demonstrations 2 --episodes 1 --out measured {CPU}")
    assert lengths("measured") == {"run/ema-00001": {"touch-red": 1, "touch-green": 1}}
    check_colors("run/ema-00001.pt", "adapted/adapted.pt")


def test_own_recordings_with_colors_need_no_line(here, own_folder):
    call(simulator, "--suite colored --episodes 2")
    for name in ("touch-red", "touch-green", "touch-blue"):
        recording = load_demonstrations(f"data/{name}.npz")
        own = replace(recording, meta={"positions_in_state": 1})  # so that it can be augmented
        folder = "new" if name == "touch-blue" else "mine"
        save_demonstrations(f"{folder}/{name}.npz", own)

    call(train, f"--data mine --preset tiny --steps 1 --augment --out run {QUICK}")
    call(finetune, f"--data new/touch-blue.npz --checkpoint run --steps 1 --out adapted {QUICK}")
    check_colors("run/ema-00001.pt", "adapted/adapted.pt")


def check_colors(trained, adapted):
    """The policies read six numbers a point, of which only the positions are scaled from data."""
    fitted = []
    for path in (trained, adapted):
        policy, _ = model.load(path)
        assert policy.config.point_dim == 6
        center, scale = policy.normalizer.points_center, policy.normalizer.points_scale
        assert center[3:].tolist() == [0, 0, 0] and scale[3:].tolist() == [1, 1, 1]
        fitted.append(center[:3])

        red = torch.rand(1, 64, 6, generator=torch.Generator().manual_seed(0))
        green = red.clone()
        green[..., 3:] = 1 - red[..., 3:]
        state = torch.zeros(1, 3)
        features = [policy.encode_observations(points, state) for points in (red, green)]
        assert not torch.allclose(*features, atol=1e-3)
    assert (fitted[0] != fitted[1]).all()  # in finetuning, positions are fitted again


def test_training_where_no_observation_tells_the_task_ends_with_what_tells_it(
    here, own_folder, monkeypatch, capsys
):
    """Own, another's and no demonstration, each also after an inner step; and an animation."""
    films = []
    monkeypatch.setattr(evaluate, "animate", lambda of_tasks, *_: films.append(list(of_tasks)))
    measured, biases = [], []  # of each job; and a parameter of the policy that is rolled out
    rollout_job, rollout = evaluate.rollout_job, evaluate.rollout

    def watched_job(**arguments):
        wanted = arguments["wanted"]
        measured.append((wanted.demonstration_control, wanted.inner_steps))
        return rollout_job(**arguments)

    def watched_rollout(policy, *arguments, **options):
        biases.append(policy.denoiser.head[1].bias.detach().clone())
        return rollout(policy, *arguments, **options)

    monkeypatch.setattr(evaluate, "rollout_job", watched_job)
    monkeypatch.setattr(evaluate, "rollout", watched_rollout)
    novel = ["touch-green", "touch-blue"]
    monkeypatch.setattr(ToySimulator, "tasks", lambda self, suite: (["touch-red"], novel))
    training = "--suite toy --preset tiny --steps 2 --demonstrations 3"
    call(train, f"{training} --evaluate-on novel --episodes 1 --out run {CPU}")
    titles = ["own demonstration", "another task's", "none"]
    expected = [*titles, *(f"{title}, after an inner step" for title in titles)]
    assert lengths("run") == {title: dict.fromkeys(novel, 1) for title in expected}
    of_each_task = [(control, steps) for steps in (0, 1) for control in (None, None, "zeros")]
    assert measured == [how for how in of_each_task for _ in novel]
    assert films == [novel]
    trained = model.load("run/ema-00002.pt")[0].denoiser.head[1].bias
    adapted = [not torch.equal(bias, trained) for bias in biases]
    assert adapted == [False] * 6 + [True] * 6 + [False] * 2  # the last two are the animation's
    printed = capsys.readouterr().out
    assert all(f"| {title} " in printed for title in expected)
    assert len(load_demonstrations("data/touch-blue.npz")) == ToySimulator.demonstrations

    measured.clear()
    call(train, f"{training} --evaluate-on novel --episodes 1 --maml off --out off {CPU}")
    assert list(lengths("off")) == titles and len(measured) == 6
    call(train, f"{training} --evaluate-on novel --episodes 1 --demo-encoder none --out no {CPU}")
    assert list(lengths("no")) == ["no demonstration", "no demonstration, after an inner step"]

    # Of a single task there is no other one.
    monkeypatch.setattr(ToySimulator, "tasks", lambda self, suite: (["touch-red"], novel[:1]))
    call(train, f"{training} --evaluate-on novel --episodes 1 --maml off --out one {CPU}")
    assert list(lengths("one")) == ["own demonstration", "none"]


def test_inner_steps_before_a_rollout_change_the_policy_by_its_own_rate(here, own_folder):
    call(simulator, "--suite toy --episodes 2")
    call(train, f"--suite toy --preset tiny --steps 2 --inner-lr 0.01 --out run {QUICK}")
    policy, info = model.load("run/ema-00002.pt")
    sampler = WindowSampler(load_demonstrations("data/touch-blue.npz"), policy.config)
    text = torch.zeros(512)
    steps = evaluate.take_inner_steps(
        policy, sampler, text, steps=2, batch=4, lr=evaluate.rate_of_checkpoint(info, "cpu")
    )
    (_, first_loss, _), (_, second_loss, adapted) = steps
    assert second_loss < first_loss
    assert not torch.equal(adapted.denoiser.head[1].bias, policy.denoiser.head[1].bias)
    learned = {**info, "inner_rates": {name: 0.0 for name, _ in policy.named_parameters()}}
    *_, (_, _, still) = evaluate.take_inner_steps(
        policy, sampler, text, steps=2, batch=4, lr=evaluate.rate_of_checkpoint(learned, "cpu")
    )
    assert all(torch.equal(a, b) for a, b in zip(still.parameters(), policy.parameters()))
    assert evaluate.rate_of_checkpoint(learned, "cpu", override=0.2) == 0.2


def test_evaluation_adapts_at_the_rate_that_is_given(here, own_folder, monkeypatch):
    call(simulator, "--suite toy --episodes 2")
    call(train, f"--suite toy --preset tiny --steps 2 --inner-lr 0.01 --out run {QUICK}")
    rates = []
    take_inner_steps = evaluate.take_inner_steps

    def watched(*arguments, lr, **options):
        rates.append(lr)
        return take_inner_steps(*arguments, lr=lr, **options)

    monkeypatch.setattr(evaluate, "take_inner_steps", watched)
    for more in ("", "--inner-lr 0.5"):
        options = f"--checkpoint run --task touch-blue --inner-steps 1 {more}"
        call(evaluate, f"{options} --demonstrations 2 --episodes 1 --overwrite {CPU}")
    assert rates == [0.01, 0.5]
