"""A few of the cases of `python -m tests.fuzz`, with fixed seeds."""

import math
import os
import random
import time
from contextlib import suppress
from dataclasses import replace

import pytest
import torch
from conftest import FEW, metrics, same_bits, whole_state

import common
import data
import model
import train
from tests import fuzz


@pytest.mark.parametrize("kind", ["flip", "cut"])
def test_no_damage_to_a_checkpoint_goes_unnoticed(tmp_path, kind):
    policy = model.DAMIPolicy(model.PRESETS["tiny"])
    model.save(tmp_path / "policy.pt", policy, step=1)
    refused = fuzz.fuzz_file(tmp_path / "policy.pt", fuzz.read_checkpoint, 200, kind)
    assert refused == 200 if kind == "cut" else refused > 180


@pytest.mark.parametrize("kind", ["flip", "cut"])
def test_no_damage_to_a_recording_goes_unnoticed(recorded, tmp_path, kind):
    small = data.load_demonstrations(recorded / "reach.npz").take(1)
    data.save_demonstrations(tmp_path / "reach.npz", small)
    refused = fuzz.fuzz_file(tmp_path / "reach.npz", fuzz.read_recording, 200, kind)
    assert refused == 200 if kind == "cut" else refused > 180


def test_a_bit_that_makes_a_tensor_a_folder_to_torch_is_noticed(tmp_path):
    path = tmp_path / "policy.pt"
    model.save(path, model.DAMIPolicy(model.PRESETS["tiny"]))
    content = bytearray(path.read_bytes())
    entry = content.rindex(b"PK\x01\x02")  # the last of the zip's directory
    content[entry + 38] ^= 1 << 4
    path.write_bytes(content)
    with pytest.raises(ValueError, match="damaged"):
        model.load(path)


def test_kills_at_random_times_change_no_bit(run, recorded, small_suite, no_pictures, tmp_path):
    """While it starts and between steps; in forks, which need not import anything."""
    rng, kills, runs = random.Random(0), 0, 0
    while kills < 5:
        out = tmp_path / f"run{runs}"
        runs, code = runs + 1, None
        while code != 0:
            argv = [*FEW, "--data", str(recorded), "--out", str(out)]
            if (out / "last.pt").exists():
                argv.append("--resume")
            steps = len(metrics(out)) + rng.randrange(3)
            if (child := os.fork()) == 0:
                train_in_child(argv)
            if kills < 5:  # after that it may end
                wait_for_steps(out, steps, child)
                time.sleep(rng.uniform(0, 0.3))
                os.kill(child, rng.choice(fuzz.SIGNALS))
            code = os.waitpid(child, 0)[1]
            kills += code != 0
        assert same_bits(whole_state(out), whole_state(run))
        results = {"success.json", "success.md", "success.png"}
        assert fuzz.visible_files(out) | results == fuzz.visible_files(run) | results


def wait_for_steps(out, steps, child):
    """Waits until a run has logged so many steps, or the process has ended."""
    options = os.WEXITED | os.WNOHANG | os.WNOWAIT
    while len(metrics(out)) < steps and os.waitid(os.P_PID, child, options) is None:
        time.sleep(0.01)


def train_in_child(argv):
    """Trains in a forked process, which then ends: with 0 only if the training did."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    train.SAVE_SECONDS, train.SAVE_SHARE = 0.0, math.inf  # last.pt is written after every step
    code = 1
    with suppress(SystemExit):
        common.command_line(lambda: train.main(argv))
        code = 0
    os._exit(code)


def test_weights_that_are_not_finite_are_not_saved(tmp_path):
    policy = model.DAMIPolicy(model.PRESETS["tiny"])
    with torch.no_grad():
        policy.denoiser.head[1].weight[0] = torch.nan
    with pytest.raises(ValueError, match="not finite"):
        model.save(tmp_path / "policy.pt", policy)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "changes",
    [
        {"unet_widths": [2**20, 2**21]},
        {"u2t_heads": 0},
        {"demo_dim": 2**40},
        {"state_dim": "x"},
        {"unet_widths": []},
        {"vmt_layers": 100_000},
    ],
)
def test_an_edited_configuration_is_refused_before_memory_is_taken(tmp_path, changes):
    path = tmp_path / "policy.pt"
    model.save(path, model.DAMIPolicy(model.PRESETS["tiny"]))
    content = torch.load(path, weights_only=True)
    torch.save(content | {"config": content["config"] | changes}, path)
    with pytest.raises(ValueError, match="do not fit"):
        model.load(path)


@pytest.mark.parametrize(
    "changes",
    [
        {"noise": (2, 16, 1)},
        {"timesteps": (1,)},
        {"action": (2, 1, 4)},
        {"state": (2, 2, 1)},
        {"points": (2, 2, 8, 2)},
        {"points": (2, 1, 8, 3)},
    ],
)
def test_shapes_that_would_broadcast_are_refused(changes):
    policy = model.DAMIPolicy(replace(model.PRESETS["tiny"], num_points=8))
    shapes = {"points": (2, 2, 8, 3), "state": (2, 2, 9), "action": (2, 16, 4), "noise": (2, 16, 4)}
    batch = {name: torch.zeros(shape) for name, shape in (shapes | changes).items()}
    batch["timesteps"] = torch.zeros(changes.get("timesteps", (2,)), dtype=torch.int64)
    task = {
        "text": torch.zeros(1, 512),
        "demo_points": torch.zeros(1, 3, 8, 3),
        "demo_state": torch.zeros(1, 3, 9),
        "demo_action": torch.zeros(1, 3, 4),
    }
    with pytest.raises(ValueError, match=next(iter(changes))):
        policy.loss(**batch, **task)
