"""Tests of model.py against diffusers, a textbook's DP3, and real demonstrations."""

import itertools
import os
import shutil
import stat
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from diffusers import DDIMScheduler
from diffusers.models.embeddings import get_timestep_embedding

import baselines
import common
import data
import model
import train
from model import (
    PRESETS,
    TASK_INPUTS,
    CheckpointError,
    Conv1d,
    CriticalPoints,
    DAMIPolicy,
    DiffusionSchedule,
    Normalizer,
    PointNetEncoder,
    PolicyConfig,
)
from tests.textbook import TextbookDP3

TINY = PRESETS["tiny"]
# (demo_encoder, tcfm)
ABLATIONS = [("vmt", "down"), ("vmt", "mid"), ("vmt", "up"), ("mlp", "down"), ("none", "down")]
ABLATIONS += [("mlp", "none"), ("vmt", "none"), ("none", "none")]
FURTHER_ABLATIONS = [("mlp", "mid"), ("mlp", "up"), ("none", "mid"), ("none", "up")]
ROOT = Path(model.__file__).parent


def new_policy(seed=0, **changes):
    torch.manual_seed(seed)
    return model.build_policy(replace(TINY, **changes)).eval()


def random_batch(config, windows=6, tasks=1, frames=10, seed=0):
    """Random arguments of `DAMIPolicy.loss`."""
    g = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(shape, generator=g)  # noqa: E731
    return {
        "points": draw(windows, config.n_obs_steps, config.num_points, config.point_dim),
        "state": draw(windows, config.n_obs_steps, config.state_dim),
        "action": draw(windows, config.horizon, config.action_dim),
        "text": draw(tasks, config.text_dim),
        "demo_points": draw(tasks, frames, config.num_points, config.point_dim),
        "demo_state": draw(tasks, frames, config.state_dim),
        "demo_action": draw(tasks, frames, config.action_dim),
        "noise": draw(windows, config.horizon, config.action_dim),
        "timesteps": torch.randint(config.diffusion_steps, (windows,), generator=g),
    }


def context_of(policy, batch, task=slice(None)):
    return policy.encode_demo(
        *(batch[name][task] for name in ("text", "demo_points", "demo_state", "demo_action"))
    )


def sample(policy, batch, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return policy.sample_actions(
        batch["points"], batch["state"], context_of(policy, batch), generator
    )


# ---- Configuration -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes, numbers",
    [
        ({"n_action_steps": 16}, ("16", "15", "2")),
        ({"horizon": 18}, ("18", "multiple of 4")),
        ({"inference_steps": 7}, ("100", "7")),
        ({"demo_dim": 130}, ("130", "4")),
        ({"u2t_heads": 7}, ("384", "7")),
        ({"unet_widths": (512, 1020, 2048)}, ("1020", "8")),
        ({"demo_encoder": "lstm"}, ("lstm", "vmt")),
        ({"timestep_dim": 2}, ("timestep_dim", "2", "4")),
        ({"point_dim": 2}, ("point_dim", "2", "3")),
        ({"denoiser": "mlp"}, ("mlp", "unet")),
        ({"unet_widths": ()}, ("unet_widths", "()")),
        ({"pointnet_widths": (64, 0)}, ("pointnet_widths", "(64, 0)", "1")),
        ({"pointnet_widths": (64, 0.5)}, ("pointnet_widths", "0.5")),
        ({"unet_widths": (2**20, 2**21)}, ("unet_widths", "100000")),
        ({"state_dim": "x"}, ("state_dim", "'x'")),
        ({"horizon": 0}, ("horizon", "0", "1")),
        ({"u2t_layers": 100}, ("u2t_layers", "100", "99")),
        ({"timestep_dim": 31}, ("timestep_dim", "31", "even")),
        ({"tcfm": "left"}, ("left", "mid")),
        ({"tcfm": "up", "unet_widths": (512,)}, ("tcfm", "up", "(512,)")),
        ({"tcfm": "up", "unet_widths": (512,), "denoiser": "mamba-unet"}, ("tcfm", "up", "(512,)")),
    ],
)
def test_a_config_that_contradicts_itself_is_refused_naming_both_values(changes, numbers):
    with pytest.raises(ValueError) as error:
        PolicyConfig(**changes)
    assert all(number in str(error.value) for number in numbers) and "\n" not in str(error.value)


def test_the_preset_paper_has_258_million_parameters_and_the_papers_condition_width():
    with torch.device("meta"):
        policy = DAMIPolicy(PRESETS["paper"])
    assert 255e6 < sum(p.numel() for p in policy.parameters()) < 260e6
    assert policy.config.condition_dim == 384


@pytest.mark.parametrize("demo_encoder, tcfm", ABLATIONS)
def test_every_parameter_has_one_adaptation_learning_rate_and_a_gradient(demo_encoder, tcfm):
    policy = new_policy(demo_encoder=demo_encoder, tcfm=tcfm)
    groups = policy.parameter_groups()
    grouped = [id(p) for group in groups.values() for p in group]
    assert sorted(grouped) == sorted(id(p) for p in policy.parameters())
    assert set(map(id, policy.observation_encoder.parameters())) == set(map(id, groups["vision"]))
    assert set(map(id, groups["diffusion"])) == set(
        map(id, [*policy.condition_encoder.parameters(), *policy.denoiser.parameters()])
    )
    policy.loss(**random_batch(policy.config)).backward()
    without = [name for name, p in policy.named_parameters() if p.grad is None]
    assert without == []


# ---- Diffusion -----------------------------------------------------------------------------------


@pytest.fixture
def peer():
    """diffusers' DDIM with the settings of the paper."""
    scheduler = DDIMScheduler(
        num_train_timesteps=100,
        beta_schedule="squaredcos_cap_v2",
        prediction_type="sample",
        clip_sample=True,
        set_alpha_to_one=True,
        steps_offset=0,
        timestep_spacing="leading",
    )
    scheduler.set_timesteps(10)
    return scheduler


def test_noising_equals_that_of_diffusers_at_every_step(peer):
    schedule, every = DiffusionSchedule(100, 10, "ddim"), torch.arange(100)
    clean, noise = torch.randn(2, 100, 16, 4, generator=torch.Generator().manual_seed(0))
    expected = peer.add_noise(clean, noise, every)
    torch.testing.assert_close(
        schedule.add_noise(clean, noise, every), expected, atol=1e-6, rtol=1e-6
    )


def test_sampling_equals_a_full_run_of_diffusers(peer):
    schedule, g = DiffusionSchedule(100, 10, "ddim"), torch.Generator().manual_seed(0)
    assert schedule.timesteps() == peer.timesteps.tolist()
    ours = theirs = torch.randn(3, 16, 4, generator=g)
    clean = 3 * torch.rand(3, 16, 4, generator=g) - 1.5  # a third of it is to be clipped
    for k in schedule.timesteps():
        prediction = clean + 0.1 * torch.randn(3, 16, 4, generator=g)
        ours = schedule.step(prediction, k, ours)
        theirs = peer.step(prediction, k, theirs, eta=0.0).prev_sample
        torch.testing.assert_close(ours, theirs, atol=1e-6, rtol=1e-6)


def test_sampled_actions_are_diffusers_run_of_the_denoiser_from_the_newest_observation_on(peer):
    policy = new_policy(sampler="ddim")
    batch = random_batch(policy.config)
    policy.normalizer.fit([SimpleNamespace(**batch)])
    context = context_of(policy, batch)
    observation = policy.encode_observations(batch["points"], batch["state"]).flatten(1)
    actions = torch.randn(6, 16, 4, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        for k in peer.timesteps:
            prediction = policy.denoise(actions, k.repeat(6), observation, context)
            actions = peer.step(prediction, k, actions, eta=0.0).prev_sample
    expected = policy.normalizer.unnormalize("action", actions)[:, 1:9]
    torch.testing.assert_close(sample(policy, batch), expected, atol=1e-5, rtol=0)


def test_the_timestep_embedding_equals_that_of_diffusers():
    policy, seen = new_policy(), []
    policy.condition_encoder.timestep_mlp.register_forward_pre_hook(
        lambda _, args: seen.append(args[0])
    )
    timesteps = torch.tensor([0, 1, 37, 99])
    policy.condition_encoder(timesteps, torch.zeros(4, 2 * policy.config.observation_feature_dim))
    expected = get_timestep_embedding(timesteps, policy.config.timestep_dim, downscale_freq_shift=1)
    torch.testing.assert_close(seen[0], expected, atol=1e-5, rtol=0)


def test_sampling_is_repeatable_from_a_seed_and_shaped_as_an_action_chunk():
    policy = new_policy(sampler="ddim")  # DP3's keeps little of the noise
    batch = random_batch(policy.config, windows=5)
    first, again, other = (
        sample(policy, batch),
        sample(policy, batch),
        sample(policy, batch, seed=1),
    )
    assert first.shape == (5, 8, 4)
    assert torch.equal(first, again) and not torch.allclose(first, other, atol=1e-2)


def test_loss_is_a_pure_function_of_its_arguments():
    policy = new_policy()
    batch, other = random_batch(policy.config), random_batch(policy.config, seed=1)
    assert torch.equal(policy.loss(**batch), policy.loss(**batch))
    for name in ("noise", "timesteps"):
        assert not torch.equal(policy.loss(**batch), policy.loss(**batch | {name: other[name]}))


def test_noise_is_standard_normal_and_every_window_has_a_timestep_of_its_own_from_0_to_99():
    policy = new_policy()
    drawn = policy.draw_noise_and_timesteps(3000, torch.Generator().manual_seed(0))
    assert drawn["timesteps"].shape == (3000,) and drawn["timesteps"].dtype == torch.int64
    counts = drawn["timesteps"].bincount(minlength=100)
    assert len(counts) == 100 and 10 <= counts.min() and counts.max() <= 60  # 30 of each
    assert drawn["noise"].shape == (3000, 16, 4)
    assert drawn["noise"].mean().abs() < 0.01 and (drawn["noise"].std() - 1).abs() < 0.01
    assert drawn["noise"].std(dim=0).min() > 0.9  # it is not the same for all windows


# ---- The task: demonstration and instruction -----------------------------------------------------


@pytest.mark.parametrize("tasks, windows", [(1, 1), (1, 5), (3, 6)])
def test_the_shared_key_path_of_u2t_equals_the_full_sequence_with_its_gradients(tasks, windows):
    u2t, config = new_policy().double().u2t, TINY
    draw = lambda *shape: torch.randn(shape, dtype=torch.float64, requires_grad=True)  # noqa: E731
    inputs = h, demo, text = (
        draw(windows, config.condition_dim),
        draw(tasks, 7, config.demo_dim),
        draw(tasks, config.text_dim),
    )
    weights = torch.randn(windows, config.condition_dim, dtype=torch.float64)
    fused = u2t(h, u2t.encode_context(demo, text))
    tokens = u2t.embed(demo, text).repeat_interleave(windows // tasks, dim=0)
    naive = u2t.blocks[0](torch.cat([tokens, h[:, None]], dim=1))[:, -1]
    torch.testing.assert_close(fused, naive, atol=1e-6, rtol=0)
    leaves = [*inputs, *u2t.parameters()]
    of_fused = torch.autograd.grad((fused * weights).sum(), leaves)
    of_naive = torch.autograd.grad((naive * weights).sum(), leaves)
    for shared, full in zip(of_fused, of_naive):
        assert full.abs().max() > 0
        torch.testing.assert_close(shared, full, atol=1e-6, rtol=0)


def test_u2t_with_two_layers_is_read_at_the_place_of_h():
    u2t = new_policy(u2t_layers=2).u2t
    h = torch.randn(4, TINY.condition_dim)
    demo, text = torch.randn(2, 7, TINY.demo_dim), torch.randn(2, TINY.text_dim)
    tokens = u2t.embed(demo, text).repeat_interleave(2, dim=0)
    first, second = u2t.blocks
    expected = second(first(torch.cat([h[:, None], tokens], dim=1)))[:, 0]  # order is no matter
    torch.testing.assert_close(u2t(h, u2t.encode_context(demo, text)), expected)


@pytest.mark.parametrize("layers", [1, 2])
def test_the_loss_of_three_tasks_is_the_mean_of_their_losses(layers):
    policy = new_policy(u2t_layers=layers)
    batch = random_batch(policy.config, windows=6, tasks=3)
    losses = [
        policy.loss(
            **{
                name: x[i : i + 1] if len(x) == 3 else x[2 * i : 2 * i + 2]
                for name, x in batch.items()
            }
        )
        for i in range(3)
    ]
    torch.testing.assert_close(policy.loss(**batch), torch.stack(losses).mean())
    assert max(losses) - min(losses) > 1e-3


def test_a_context_computed_once_serves_every_window_and_step():
    policy = new_policy()
    batch = random_batch(policy.config, windows=4)
    context = context_of(policy, batch)
    repeated = policy.encode_demo(
        *(batch[n].repeat_interleave(4, 0) for n in batch if n.startswith(("text", "demo")))
    )
    for again in (context_of(policy, batch), repeated):
        draws = [
            policy.sample_actions(
                batch["points"], batch["state"], c, torch.Generator().manual_seed(0)
            )
            for c in (context, again)
        ]
        torch.testing.assert_close(*draws, atol=1e-5, rtol=0)


def test_vmt_reads_the_order_of_frames_and_its_mlp_ablation_does_not():
    features, actions = (
        torch.randn(2, 10, TINY.observation_feature_dim),
        torch.randn(2, 10, TINY.action_dim),
    )
    vmt = new_policy().demo_encoder
    reversed_tokens = vmt(features.flip(1), actions.flip(1)).flip(
        1
    )  # equal if only the frames, not their times, count
    assert (vmt(features, actions) - reversed_tokens).abs().max() > 1e-2
    mlp = new_policy(demo_encoder="mlp").demo_encoder
    torch.testing.assert_close(
        mlp(features, actions), mlp(features.flip(1), actions.flip(1)), atol=1e-6, rtol=0
    )


@pytest.mark.parametrize("demo_encoder, tcfm", [("vmt", "down"), ("mlp", "none"), ("vmt", "none")])
@pytest.mark.parametrize("name", ["text", "demo_points", "demo_state", "demo_action"])
def test_every_part_of_the_task_reaches_the_actions(name, demo_encoder, tcfm):
    policy = new_policy(demo_encoder=demo_encoder, tcfm=tcfm)
    batch = random_batch(policy.config)
    other = batch | {name: random_batch(policy.config, seed=1)[name]}
    assert (sample(policy, batch) - sample(policy, other)).abs().max() > 1e-4


def test_the_order_of_a_clouds_points_changes_nothing():
    policy = new_policy()
    batch = random_batch(policy.config)
    shuffled = dict(batch)
    for name in ("points", "demo_points"):
        order = (
            torch.rand(batch[name].shape[:-1]).argsort(-1)[..., None].expand(batch[name].shape)
        )  # one for each cloud
        shuffled[name] = batch[name].gather(-2, order)
        assert not torch.equal(shuffled[name], batch[name])
    torch.testing.assert_close(sample(policy, shuffled), sample(policy, batch), atol=1e-6, rtol=0)


@pytest.mark.parametrize("shape", [(5, 2, 40, 3), (40, 3), (5, 2, 40, 6), (40, 4)])
def test_only_critical_points_are_differentiated_and_none_of_them_is_missing(shape):
    torch.manual_seed(0)
    points = torch.randn(shape)
    pointnet = PointNetEncoder((8, 16), 4, point_dim=shape[-1])
    pointnet(points).sum().backward()
    sparse = [p.grad.clone() for p in pointnet.parameters()]
    every = pointnet.mlp(points)  # (..., N, 16)
    pointnet.zero_grad()
    pointnet.projection(every.amax(dim=-2)).sum().backward()
    torch.testing.assert_close(sparse, [p.grad for p in pointnet.parameters()])
    clouds = points.view(-1, 40, shape[-1])
    rows, places = CriticalPoints.apply(points, *pointnet.mlp.parameters())  # (R,), (clouds, 16)
    first_points = 40 * torch.arange(len(clouds))[:, None]  # of each cloud
    winners = pointnet.mlp(clouds).argmax(dim=-2) + first_points  # (clouds, 16)
    assert torch.equal(rows[places], winners)
    assert rows.tolist() == sorted(set(winners.flatten().tolist()))  # each once
    assert len(rows) < len(clouds) * 40 // 2


def test_the_policy_without_a_demonstration_is_the_textbooks_dp3():
    policy = new_policy(demo_encoder="none", tcfm="none")
    assert not list(policy.condition_encoder.condition_mlp.parameters())  # Eq. 7's MLP is DAMI's
    batch = random_batch(policy.config, windows=20)
    batch = {name: x for name, x in batch.items() if name not in TASK_INPUTS}
    recorded = {name: 3 * batch[name] + 1 for name in ("points", "state", "action")}
    batch.update(recorded)
    policy.normalizer.fit([SimpleNamespace(**recorded)])
    textbook = TextbookDP3(policy.config)
    textbook.load_state_dict(policy.state_dict())
    losses = policy.loss(**batch), textbook.loss(**batch)
    torch.testing.assert_close(*losses, rtol=1e-5, atol=0)
    gradients = [
        torch.autograd.grad(loss, list(p.parameters()))
        for loss, p in zip(losses, (policy, textbook))
    ]
    torch.testing.assert_close(*gradients, rtol=1e-3, atol=1e-6)


def test_a_wide_convolution_written_as_a_matrix_product_is_a_convolution():
    torch.manual_seed(0)
    ours, torchs = (
        Conv1d(1024, 1024, 5).double(),
        torch.nn.Conv1d(1024, 1024, 5, padding=2).double(),
    )
    assert ours.wide and not Conv1d(64, 64, 5).wide
    torchs.load_state_dict(ours.state_dict())
    x = torch.randn(2, 1024, 4, dtype=torch.float64, requires_grad=True)
    results = [layer(x) for layer in (ours, torchs)]
    torch.testing.assert_close(*results)
    cotangent = torch.randn_like(results[0])
    torch.testing.assert_close(
        *(
            torch.autograd.grad(y, [x, *layer.parameters()], cotangent)
            for y, layer in zip(results, (ours, torchs))
        )
    )


def test_a_demonstration_longer_than_the_positions_is_refused_with_both_numbers():
    policy = new_policy()
    with pytest.raises(ValueError, match=r"11 frames.* 10 positions"):
        context_of(policy, random_batch(policy.config, frames=11))


@pytest.mark.parametrize("tcfm", ["down", "mid", "up", "none"])
def test_u2t_conditions_the_two_blocks_of_the_named_level_and_h_all_others(tcfm):
    policy = new_policy(
        tcfm=tcfm, demo_encoder="none" if tcfm == "none" else "vmt", unet_widths=(16, 32, 64)
    )
    unet = policy.denoiser
    levels = {"down": unet.down[0][:2], "mid": unet.mid, "up": unet.up[-1][:2], "none": []}
    h, fused = torch.randn(2, 2, policy.config.condition_dim)
    read = {}
    for name, module in unet.named_modules():
        if isinstance(module, model.ResidualBlock):
            module.register_forward_pre_hook(
                lambda _, args, name=name: read.update({name: args[1]})
            )
    unet(torch.randn(2, 16, 4), h, None if tcfm == "none" else fused)
    named = {
        name
        for name, module in unet.named_modules()
        if any(module is block for block in levels[tcfm])
    }
    assert len(read) == 12 and len(named) == (0 if tcfm == "none" else 2)
    assert {name for name, condition in read.items() if condition is fused} == named
    assert all(condition is h for name, condition in read.items() if name not in named)


# ---- Normalization and moving average ------------------------------------------------------------


def test_the_normalizer_maps_the_data_onto_minus_one_to_one_and_back():
    normalizer = Normalizer(state_dim=3, action_dim=2)
    points, state, action = 5 * torch.randn(7, 8, 3) + 2, torch.randn(7, 3), torch.randn(7, 2)
    state[:, 1] = 0.7  # constant
    state[:, 2] = 0.3 + 1e-6 * torch.rand(7)  # as good as constant
    normalizer.fit([SimpleNamespace(points=points, state=state, action=action)])
    for name, x in {"points": points, "state": state, "action": action}.items():
        y = normalizer.normalize(name, x)
        torch.testing.assert_close(normalizer.unnormalize(name, y), x, atol=1e-5, rtol=0)
        low, high = y.flatten(0, -2).amin(0), y.flatten(0, -2).amax(0)
        moving = slice(0, 1) if name == "state" else slice(None)
        torch.testing.assert_close(low[moving], -torch.ones_like(low[moving]))
        torch.testing.assert_close(high[moving], torch.ones_like(high[moving]))
    assert (
        normalizer.normalize("state", state)[:, 1:].abs().max() < 1e-5
    )  # neither stretched nor divided by zero
    torch.testing.assert_close(
        normalizer.normalize("state", torch.tensor([0.0, 0.9, 0.3]))[1], torch.tensor(0.2)
    )
    action[:, 1] = 0.4
    normalizer.fit([SimpleNamespace(points=points, state=state, action=action)])
    drawn = normalizer.unnormalize("action", torch.tensor([[-1.0, -1.0], [1.0, 1.0]]))
    assert (drawn[:, 1] - 0.4).abs().max() < 1e-4  # what no demonstration moved stays


def test_recordings_are_normalized_together_and_colours_never():
    g = torch.Generator().manual_seed(0)
    recordings = []
    for scale in (1.0, 4.0):
        points = torch.cat([scale * torch.randn(5, 8, 3, generator=g), torch.rand(5, 8, 3)], -1)
        recordings.append(
            SimpleNamespace(
                points=points.half(),
                state=scale * torch.randn(5, 2, generator=g),
                action=scale * torch.randn(5, 2, generator=g),
            )
        )
    normalizer = Normalizer(state_dim=2, action_dim=2, point_dim=6)
    for _ in range(2):  # again, as adaptation does
        normalizer.fit(iter(recordings))
    points = torch.cat([r.points for r in recordings]).float()
    y = normalizer.normalize("points", points)
    torch.testing.assert_close(y[..., :3].amin((0, 1)), -torch.ones(3))
    torch.testing.assert_close(y[..., :3].amax((0, 1)), torch.ones(3))
    assert torch.equal(y[..., 3:], points[..., 3:])
    actions = normalizer.normalize("action", torch.cat([r.action for r in recordings]))
    torch.testing.assert_close(actions.amax(0), torch.ones(2))


def test_a_policy_with_coloured_points_reads_their_colours(tmp_path):
    policy = new_policy(point_dim=6)
    batch = random_batch(policy.config)
    model.save(tmp_path / "a.pt", policy)
    policy, _ = model.load(tmp_path / "a.pt")
    for name in ("points", "demo_points"):
        other = batch[name].clone()
        other[..., 3:] = other[..., 3:].flip(0) + 1
        assert (policy.loss(**batch) - policy.loss(**batch | {name: other})).abs() > 1e-5
    with pytest.raises(ValueError, match=r"points is \(6, 2, 64, 3\), .* takes \(6, 2, 64, 6\)"):
        policy.loss(**batch | {"points": batch["points"][..., :3]})


def test_every_part_of_a_demonstration_is_normalized_before_it_is_encoded():
    policy = new_policy()
    batch = random_batch(policy.config)
    parts = ("points", "state", "action")
    raw = {part: 300 + 50 * batch[f"demo_{part}"] for part in parts}
    extremes = {part: x.flatten(0, -2).aminmax(dim=0) for part, x in raw.items()}
    by_hand = {
        f"demo_{part}": 2 * (x - extremes[part].min) / (extremes[part].max - extremes[part].min) - 1
        for part, x in raw.items()
    }
    expected = context_of(policy, batch | by_hand)  # nothing is fitted: as they are
    policy.normalizer.fit([SimpleNamespace(**raw)])
    found = context_of(policy, batch | {f"demo_{part}": x for part, x in raw.items()})
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=0)


def test_the_moving_average_follows_the_papers_decay():
    policy = new_policy()
    ema = model.ema_model(policy)
    parameter, averaged = next(policy.parameters()), next(ema.module.parameters())
    expected = averaged[0, 0].item()
    for step in range(8):
        with torch.no_grad():
            parameter.fill_(step)
        ema.update_parameters(policy)
        decay = min(0.9999, 1 - (1 + step) ** -0.75)
        expected = decay * expected + (1 - decay) * step
        assert averaged[0, 0].item() == pytest.approx(expected, abs=1e-5)
    ema.n_averaged.fill_(10**6)  # where the cap rules
    ema.module.get_parameter("denoiser.head.1.bias").data.zero_()
    policy.get_parameter("denoiser.head.1.bias").data.fill_(1.0)
    ema.update_parameters(policy)
    assert ema.module.get_parameter("denoiser.head.1.bias")[0].item() == pytest.approx(
        1e-4, rel=1e-3
    )


# ---- Learning from real Meta-World ---------------------------------------------------------------


def test_the_policy_overfits_one_real_window_batch_and_samples_its_actions(recorded):
    policy = new_policy().train()
    demonstrations = data.load_demonstrations(recorded / "reach.npz")
    sampler = data.WindowSampler(demonstrations, policy.config)
    policy.normalizer.fit([sampler])
    generator = torch.Generator().manual_seed(0)
    batch = sampler.batch(8, generator) | {"text": torch.randn(1, 512, generator=generator)}
    optimizer = torch.optim.AdamW(policy.parameters(), lr=3e-3)
    losses = []
    for _ in range(150):
        loss = policy.loss(**batch, **policy.draw_noise_and_timesteps(8, generator))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert sum(losses[-20:]) / 20 < 0.05 * losses[0]
    policy.eval()
    context = context_of(policy, batch)
    drawn = policy.sample_actions(batch["points"], batch["state"], context, generator)
    wanted = batch["action"][:, 1:9]
    spread = (wanted - wanted.mean((0, 1))).abs().mean()
    assert (drawn - wanted).abs().mean() < 0.25 * spread


# ---- What a configuration names ------------------------------------------------------------------


def combinations():
    """Every choice of names that `PolicyConfig` accepts, in a policy smaller than tiny."""
    small = replace(TINY, num_points=4, pointnet_widths=(8,), unet_widths=(8, 8), text_dim=8)
    names = model.choices()
    for values in itertools.product(*names.values()):
        changes = dict(zip(names, values))
        yield replace(small, inference_steps=1, **changes)


def test_whatever_a_configuration_names_is_built_and_has_a_loss_or_is_refused_in_one_line():
    built = set()
    for config in combinations():
        try:
            policy = model.build_policy(config)
        except ValueError as error:
            assert "\n" not in str(error) and len(str(error)) > 20
            continue
        built.add((config.policy, config.denoiser, config.demo_encoder, config.tcfm))
        g = torch.Generator().manual_seed(0)
        batch = random_batch(config, windows=2, frames=3)
        batch = {name: batch[name] for name in ("points", "state", "action", *TASK_INPUTS)}
        loss = policy.loss(**batch, **policy.draw_noise_and_timesteps(2, g))
        loss.backward()
        assert torch.isfinite(loss)
        unused = [name for name, p in policy.named_parameters() if p.grad is None]
        assert unused == [], config
        context = context_of(policy, batch)
        assert (context is None) == (not policy.config.reads_task)
        policy.sample_actions(batch["points"], batch["state"], context, g)
    dami = {
        ("dami", net, *rest)
        for net in ("unet", "mamba-unet")
        for rest in [*ABLATIONS, *FURTHER_ABLATIONS]
    }
    assert built == dami | {
        ("dp3", "unet", "none", "none"),
        ("dp3", "mamba-unet", "none", "none"),
        ("flow", "unet", "none", "none"),
        ("flow", "mamba-unet", "none", "none"),
        ("mamba", "mamba-unet", "none", "none"),
        ("freq", "frequency-transformer", "none", "none"),
    }


def test_a_policys_class_refuses_the_configuration_of_another():
    flow = baselines.PRESETS["flow"]["tiny"]
    with pytest.raises(ValueError, match="policy 'flow' is a FlowPolicy and no DAMIPolicy"):
        DAMIPolicy(flow)
    with pytest.raises(ValueError, match="policy flow needs demo_encoder 'none', not 'vmt'"):
        model.build_policy(replace(flow, demo_encoder="vmt"))
    with pytest.raises(ValueError, match="freq needs denoiser 'frequency-transformer', not 'unet'"):
        model.build_policy(replace(baselines.PRESETS["freq"]["tiny"], denoiser="unet"))


class ToyDenoiser(torch.nn.Module):
    """A linear map of everything."""

    def __init__(self, config):
        super().__init__()
        self.shape = (config.horizon, config.action_dim)
        size = config.horizon * config.action_dim
        self.linear = torch.nn.Linear(size + 2 * config.condition_dim, size)

    def forward(self, actions, h, fused=None):
        fused = h if fused is None else fused
        x = torch.cat([actions.flatten(1), h, fused], dim=1)
        return self.linear(x).unflatten(1, self.shape)


def test_a_new_network_is_a_class_and_a_line(monkeypatch, tmp_path):
    monkeypatch.setitem(model.denoisers, "toy", ToyDenoiser)
    policy = new_policy(denoiser="toy")
    batch = random_batch(policy.config)
    model.save(tmp_path / "toy.pt", policy)
    again, _ = model.load(tmp_path / "toy.pt")
    assert isinstance(again.denoiser, ToyDenoiser)
    assert torch.equal(sample(again, batch), sample(policy, batch))
    diffusion = set(policy.parameter_groups()["diffusion"])
    assert set(policy.denoiser.parameters()) < diffusion


def test_a_mistake_in_a_network_keeps_its_own_error_when_a_checkpoint_is_loaded(
    monkeypatch, tmp_path
):
    monkeypatch.setitem(model.denoisers, "toy", ToyDenoiser)
    model.save(tmp_path / "toy.pt", new_policy(denoiser="toy"))

    def broken(config):
        height, width = config.unet_widths, config.horizon, config.action_dim
        return height, width

    monkeypatch.setitem(model.denoisers, "toy", broken)
    with pytest.raises(ValueError, match="too many values to unpack") as error:
        model.load(tmp_path / "toy.pt")
    assert not isinstance(error.value, CheckpointError)
    with pytest.raises(ValueError, match="too many values to unpack") as error:
        train.choose_architecture(train.parse(["--denoiser", "toy"]), "tiny")
    assert not isinstance(error.value, common.UserError)


def test_a_network_that_does_not_fit_the_policy_of_a_checkpoint_is_refused(tmp_path):
    model.save(tmp_path / "dami.pt", new_policy())
    message = "cannot be used like this: frequency-transformer is the denoiser of freq, not dami"
    with pytest.raises(CheckpointError, match=message):
        model.load(tmp_path / "dami.pt", denoiser="frequency-transformer")


# ---- Checkpoints ---------------------------------------------------------------------------------


def test_a_checkpoint_gives_back_policy_normalizer_and_information(tmp_path):
    policy = new_policy(demo_encoder="mlp", tcfm="up")
    batch = random_batch(policy.config)
    policy.normalizer.fit([SimpleNamespace(**batch)])
    model.save(
        tmp_path / "a.pt", policy, step=7, text_weights="random-seed-0", arguments={"lr": 1e-3}
    )
    again, info = model.load(tmp_path / "a.pt")
    assert again.config == policy.config and not again.training
    assert (
        info["step"] == 7
        and info["text_weights"] == "random-seed-0"
        and info["arguments"] == {"lr": 1e-3}
    )
    assert torch.equal(sample(again, batch), sample(policy, batch))
    assert [path.name for path in tmp_path.iterdir()] == ["a.pt"]


def test_a_half_precision_checkpoint_is_half_as_large_and_acts_nearly_alike(tmp_path):
    policy = new_policy()
    batch = random_batch(policy.config)
    policy.normalizer.fit([SimpleNamespace(**batch)])
    for name, half in (("whole.pt", False), ("half.pt", True)):
        model.save(tmp_path / name, policy, half=half)
    again, _ = model.load(tmp_path / "half.pt")
    assert (tmp_path / "half.pt").stat().st_size < 0.6 * (tmp_path / "whole.pt").stat().st_size
    assert all(x.dtype == torch.float32 for x in again.state_dict().values())
    assert all(
        torch.equal(a, b) for a, b in zip(again.normalizer.buffers(), policy.normalizer.buffers())
    )
    torch.testing.assert_close(sample(again, batch), sample(policy, batch), atol=0.02, rtol=0)


def bad_checkpoints(folder, good):
    """Path -> what the message must say."""
    raw = good.read_bytes()
    files = {
        "missing": None,
        "truncated": raw[: len(raw) // 2],
        "empty": b"",
        "text": b"not a checkpoint",
    }
    for name, content in files.items():
        if content is not None:
            (folder / name).write_bytes(content)
    torch.save({"weights": torch.zeros(3)}, folder / "foreign")
    torch.save([1, 2], folder / "list")
    torch.save({"format": "DAMI checkpoint 1", "model": {}}, folder / "old")
    torch.save({"format": model.FORMAT, "model": print}, folder / "pickled")
    info = torch.load(good, weights_only=True)
    torch.save(info | {"config": info["config"] | {"unet_widths": [32, 64]}}, folder / "shape")
    torch.save(info | {"config": info["config"] | {"flavor": 1}}, folder / "newer")
    torch.save(info | {"config": info["config"] | {"policy": ["dami"]}}, folder / "unhashable")
    torch.save(info | {"config": info["config"] | {"sampler": "euler"}}, folder / "setting")
    number = info["model"] | {"normalizer.state_center": 3}
    torch.save(info | {"model": number}, folder / "number")
    torch.save({name: x for name, x in info.items() if name != "model"}, folder / "headless")
    return {
        "missing": "no checkpoint at",
        "truncated": "damaged or no PyTorch checkpoint",
        "empty": "damaged or no PyTorch checkpoint",
        "text": "damaged or no PyTorch checkpoint",
        "pickled": "damaged or no PyTorch checkpoint",
        "foreign": "holds no policy",
        "list": "holds no policy",
        "old": "written by an older version of this code: train again, or use that version",
        "shape": "do not fit: denoiser.down.0.0.conv1.0.weight is (16, 4, 5) in the file, and (32,",
        "newer": "another version of the code, with settings that are unknown here: flavor",
        "headless": "its model is missing",
        "unhashable": "policy ['dami'] is unknown",
        "setting": "its settings do not fit: sampler is 'euler'; use one of ddim, dp3",
        "number": "do not fit: normalizer.state_center is () in the file, and (9,) in the policy",
    }


def test_a_checkpoint_that_cannot_be_used_is_refused_in_one_line(tmp_path):
    model.save(tmp_path / "good.pt", new_policy())
    for name, message in bad_checkpoints(tmp_path, tmp_path / "good.pt").items():
        with pytest.raises(CheckpointError) as error:
            model.load(tmp_path / name)
        assert (
            message in str(error.value)
            and name in str(error.value)
            and "\n" not in str(error.value)
        ), name


def test_a_checkpoint_without_what_a_caller_needs_is_refused_naming_it(tmp_path):
    model.save(tmp_path / "a.pt", new_policy(), step=1)
    assert model.load(tmp_path / "a.pt", needs=("step",))[1] == {"step": 1}
    with pytest.raises(CheckpointError, match=r"a.pt lacks suite, preset: use"):
        model.load(tmp_path / "a.pt", needs=("suite", "step", "preset"))


def test_information_cannot_take_the_place_of_the_weights(tmp_path):
    with pytest.raises(TypeError, match="model"):
        model.save(tmp_path / "a.pt", new_policy(), model="tiny")


def test_weights_that_float16_cannot_hold_are_not_saved_as_such(tmp_path):
    policy = new_policy()
    policy.denoiser.head[1].bias.data.fill_(1e5)
    model.save(tmp_path / "whole.pt", policy)
    with pytest.raises(CheckpointError, match=r"half.pt was not written, because weights are not"):
        model.save(tmp_path / "half.pt", policy, half=True)
    assert [path.name for path in tmp_path.iterdir()] == ["whole.pt"]


def test_saving_removes_nothing_else_and_leaves_a_file_with_usual_permissions(tmp_path):
    others = [tmp_path / name for name in (f".{os.getpid()}.a.pt", ".a.pt", ".2024.d", "notes.md")]
    for path in others:
        path.write_text("mine")
    model.save(tmp_path / "a.pt", new_policy())
    assert sorted(tmp_path.iterdir()) == sorted([*others, tmp_path / "a.pt"])
    assert all(path.read_text() == "mine" for path in others)
    usual, written = others[0].stat().st_mode, (tmp_path / "a.pt").stat().st_mode
    assert stat.S_IMODE(written) == stat.S_IMODE(usual)


def test_two_that_save_to_one_file_at_the_same_time_do_not_mix_their_bytes(tmp_path, monkeypatch):
    path, save_file = tmp_path / "a.pt", torch.save

    def interrupted_by_another(content, temporary):
        monkeypatch.setattr(torch, "save", save_file)
        model.save(path, new_policy(seed=1), step=1)
        save_file(content, temporary)

    monkeypatch.setattr(torch, "save", interrupted_by_another)
    model.save(path, new_policy(), step=2)
    assert model.load(path)[1] == {"step": 2}
    assert list(tmp_path.iterdir()) == [path]


def test_a_checkpoint_cannot_run_code(tmp_path):
    class Bomb:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "ran"),)

    torch.save({"format": model.FORMAT, "config": Bomb()}, tmp_path / "bomb.pt")
    with pytest.raises(CheckpointError):
        model.load(tmp_path / "bomb.pt")
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    "failure", [OSError("disk full"), RuntimeError("disk full"), KeyboardInterrupt()]
)
def test_a_failing_save_leaves_the_old_checkpoint_and_no_temporary_file(
    tmp_path, monkeypatch, failure
):
    model.save(tmp_path / "a.pt", new_policy(), step=1)

    def half(_, path):
        Path(path).write_bytes(b"half")
        raise failure

    monkeypatch.setattr(torch, "save", half)
    with pytest.raises((CheckpointError, KeyboardInterrupt)):
        model.save(tmp_path / "a.pt", new_policy(seed=1), step=2)
    assert model.load(tmp_path / "a.pt")[1]["step"] == 1
    assert [path.name for path in tmp_path.iterdir()] == ["a.pt"]


# ---- Copied alone --------------------------------------------------------------------------------

SCRIPT = """
import numpy as np
import torch
from torch.func import functional_call
import data, maml, model

rng = np.random.default_rng(0)
config = model.PRESETS["tiny"]
samplers = []
for task in ("push", "pull"):
    points = rng.normal(size=(80, 64, 3)).astype(np.float16)
    state, action = rng.normal(size=(80, 9)), rng.uniform(-1, 1, size=(80, 4))
    ends = np.array([40, 80])
    recording = data.Demonstrations(
        task, f"{task} it", points, state.astype(np.float32), action.astype(np.float32), ends, {}
    )
    samplers.append(
        data.WindowSampler(recording, config, device="cpu", after_success=None, augment=False)
    )
policy = model.build_policy(config)
policy.normalizer.fit(samplers)
params, generator = dict(policy.named_parameters()), torch.Generator().manual_seed(0)
optimizer, average = torch.optim.AdamW(policy.parameters(), lr=1e-3), model.ema_model(policy)
for step in range(3):
    tasks = []
    for sampler in samplers:
        batch = sampler.batch(12, generator) | policy.draw_noise_and_timesteps(12, generator)
        tasks.append(model.split(batch | {"text": torch.zeros(1, config.text_dim)}, 4))
    loss = lambda params, batch: functional_call(policy, params, (), batch)
    before = torch.stack([loss(params, query) for _, query in tasks])
    gradients, _, after = maml.meta_gradient(loss, params, tasks, lr=0.01)
    for name, parameter in params.items():
        parameter.grad = gradients[name]
    optimizer.step()
    average.update_parameters(policy)
    print(after.mean().item(), before.mean().item())
model.save("policy.pt", average.module, step=3)
print(model.load("policy.pt")[1])
"""


def test_three_files_copied_alone_meta_train_a_policy(tmp_path):
    for name in ("model", "maml", "data"):
        shutil.copy(ROOT / f"{name}.py", tmp_path)
    (tmp_path / "script.py").write_text(SCRIPT)
    command = [sys.executable, "-I", "-c", "import sys; sys.path[0:0] = ['.']; import script"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    *losses, info = done.stdout.splitlines()
    assert len(losses) == 3 and info == "{'step': 3}"
    for line in losses:
        after, before = map(float, line.split())
        assert 0 < after < before  # the inner step helps


def test_a_split_batch_has_all_windows_once_and_its_task_twice():
    batch = random_batch(TINY, windows=6)
    support, query = model.split(batch, 2)
    for name, x in batch.items():
        if name in TASK_INPUTS:
            assert support[name] is x and query[name] is x
        else:
            assert len(support[name]) == 2
            assert torch.equal(torch.cat([support[name], query[name]]), x)
    assert set(TASK_INPUTS) < set(batch)


# ---- Reading the demonstration -------------------------------------------------------------------


def test_where_only_the_demonstration_tells_the_task_it_is_read():
    """Two tasks in the same scenes, move forth and move back; no instruction."""
    torch.manual_seed(0)
    policy = DAMIPolicy(replace(PRESETS["tiny"], num_points=16))
    optimizer = torch.optim.AdamW(policy.parameters(), lr=3e-3)
    generator = torch.Generator().manual_seed(0)
    sign, n = torch.tensor([0.5, -0.5])[:, None, None], 8
    scenes = lambda *shape: torch.randn(shape, generator=generator)  # noqa: E731

    def demonstrations():
        action = sign + 0.1 * scenes(2, 5, 4)
        return {"demo_points": scenes(2, 5, 16, 3), "demo_state": scenes(2, 5, 9)} | {
            "demo_action": action
        }

    text = torch.zeros(2, 512)
    for _ in range(120):
        windows = {"points": scenes(2 * n, 2, 16, 3), "state": scenes(2 * n, 2, 9)}
        windows["action"] = sign.repeat_interleave(n, dim=0).expand(-1, 16, 4)
        noise = policy.draw_noise_and_timesteps(2 * n, generator)
        loss = policy.loss(text=text, **demonstrations(), **windows, **noise)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    def sampled(demos):
        with torch.no_grad():
            context = policy.encode_demo(text, **demos)
        drawn = policy.sample_actions(scenes(2, 2, 16, 3), scenes(2, 2, 9), context, generator)
        return drawn.mean(dim=(1, 2))

    own, other = demonstrations(), {name: x.flip(0) for name, x in demonstrations().items()}
    torch.testing.assert_close(sampled(own), torch.tensor([0.5, -0.5]), atol=0.15, rtol=0)
    torch.testing.assert_close(sampled(other), torch.tensor([-0.5, 0.5]), atol=0.15, rtol=0)


# ---- Used alone: one line for each way of getting it wrong ---------------------------------------


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"demo_points": None}, r"demo_points is missing, the policy takes \(D, T, 64, 3\)"),
        ({"text": None}, r"text is missing, the policy takes \(D, 512\)"),
        ({"text": (512,)}, r"text is \(512,\), the policy takes \(D, 512\)"),
        ({"text": (1, 768)}, r"text is \(1, 768\), the policy takes \(1, 512\)"),
        ({"action": (6, 8, 4)}, r"action is \(6, 8, 4\), the policy takes \(6, 16, 4\)"),
        ({"points": (2, 64, 3)}, r"points is \(2, 64, 3\), the policy takes \(B, 2, 64, 3\)"),
        ({"points": (64, 3)}, r"points is \(64, 3\), the policy takes \(B, 2, 64, 3\)"),
        ({"points": (6, 2, 3)}, r"points is \(6, 2, 3\), the policy takes \(B, 2, 64, 3\)"),
        (
            {"points": (6, 2, 512, 3)},
            r"takes \(6, 2, 64, 3\): `data.farthest_point_sample\(cloud, 64",
        ),
        ({"points": (6, 2, 64, 2)}, r"points is \(6, 2, 64, 2\), the policy takes \(6, 2, 64, 3\)"),
        ({"points": (6, 2, 64, 6)}, r"points is \(6, 2, 64, 6\), the policy takes \(6, 2, 64, 3\)"),
        ({"points": (6, 1, 64, 3)}, r"points is \(6, 1, 64, 3\), the policy takes \(6, 2, 64, 3\)"),
        ({"state": (2, 9)}, r"state is \(2, 9\), the policy takes \(B, 2, 9\)"),
        ({"demo_state": (1, 9, 9)}, r"demo_state is \(1, 9, 9\), the policy takes \(1, 10, 9\)"),
    ],
)
def test_wrong_inputs_are_refused_with_both_shapes(changes, message):
    policy = DAMIPolicy(PRESETS["tiny"])
    given = {name: x and torch.zeros(x) for name, x in changes.items()}
    with pytest.raises(ValueError, match=message):
        policy.loss(**random_batch(policy.config) | given)


@pytest.mark.parametrize("tcfm", ["down", "none"])
@pytest.mark.parametrize("windows, tasks", [(1, 2), (6, 4)])
def test_windows_that_the_tasks_do_not_divide_are_refused(tcfm, windows, tasks):
    policy = new_policy(tcfm=tcfm)
    batch = random_batch(policy.config, windows=windows, tasks=tasks)
    with pytest.raises(
        ValueError, match=f"{windows} windows cannot be shared equally by {tasks} tasks"
    ):
        policy.loss(**batch)


def test_a_policy_that_reads_a_task_does_not_act_without_one():
    policy = DAMIPolicy(PRESETS["tiny"])
    batch = random_batch(policy.config)
    with pytest.raises(ValueError, match="context is missing: it is what `encode_demo` makes"):
        policy.sample_actions(batch["points"], batch["state"], None)
    alone = new_policy(demo_encoder="none", tcfm="none")
    assert alone.sample_actions(batch["points"], batch["state"], None).shape == (6, 8, 4)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"kernel_size": 4}, "kernel_size is 4: use an odd one"),
        ({"horizon": 15}, "horizon 15 is no multiple of 2: it is halved between the 2 levels"),
        (
            {"horizon": 4},
            "n_action_steps is 8: of horizon 4 there are 3 actions from the newest of n_obs_steps",
        ),
    ],
)
def test_a_policy_that_cannot_be_is_refused_where_it_is_made(changes, message):
    with pytest.raises(ValueError, match=message):
        replace(PRESETS["tiny"], **changes)
