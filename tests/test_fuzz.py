"""A few of the cases of `python -m tests.fuzz`, with fixed seeds."""

import os
import random
import time
from contextlib import suppress

import pytest
import torch
from conftest import FEW, same_bits, whole_state

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


def test_twenty_kills_at_random_times_change_no_bit(run, recorded, small_suite, tmp_path):
    """In forks, which need not import anything; saved so often that each kill finds another."""
    rng, kills, runs = random.Random(0), 0, 0
    while kills < 20:
        out, runs, code = tmp_path / f"run{runs}", runs + 1, None
        while code != 0:
            argv = [*FEW, "--data", str(recorded), "--out", str(out)]
            argv += ["--resume"] * (out / "last.pt").exists()
            if (child := os.fork()) == 0:
                os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
                train.SAVE_SECONDS, code = 0.0, 1
                with suppress(SystemExit):
                    scripts.command_line(lambda argv=argv: train.main(argv))
                    code = 0
                os._exit(code)
            if kills < 20:  # after that it may end, however slow the machine is
                time.sleep(rng.uniform(0.1, 0.8))
                with suppress(ProcessLookupError):
                    os.kill(child, rng.choice(fuzz.SIGNALS))
            code = os.waitpid(child, 0)[1]
            kills += code != 0
        assert same_bits(whole_state(out), whole_state(run)) and not list(out.glob(".*"))


def test_weights_that_are_not_finite_are_not_saved(tmp_path):
    policy = model.DAMIPolicy(model.PRESETS["tiny"])
    with torch.no_grad():
        policy.unet.head[1].weight[0] = torch.nan
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
    policy = model.DAMIPolicy(model.PRESETS["tiny"])
    shapes = {"points": (2, 2, 8, 3), "state": (2, 2, 9), "action": (2, 16, 4), "noise": (2, 16, 4)}
    batch = {name: torch.zeros(shape) for name, shape in (shapes | changes).items()}
    batch["timesteps"] = torch.zeros(changes.get("timesteps", (2,)), dtype=torch.int64)
    task = {"text": torch.zeros(1, 512), "demo_points": torch.zeros(1, 3, 8, 3)}
    task |= {"demo_state": torch.zeros(1, 3, 9), "demo_action": torch.zeros(1, 3, 4)}
    with pytest.raises(ValueError, match=next(iter(changes))):
        policy.loss(**batch, **task)
