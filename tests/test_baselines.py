"""Tests of baselines.py against recurrences, scipy, scalars, finite differences; runs at `tiny`."""

import math
import re
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import pytest
import scipy.fft
import torch
from conftest import FEW, fails, metrics, weights
from torch.func import functional_call

import baselines
import data
import evaluate
import finetune
import model
import train
from baselines import PRESETS, FlowPolicy, FreqPolicy, Mamba, MambaPolicy, associative_scan
from maml import meta_gradient
from metaworld_env import MetaWorld

NEW = ("flow", "mamba", "freq")


def new_policy(name, preset="tiny", **changes):
    torch.manual_seed(0)
    return baselines.build_policy(replace(PRESETS[name][preset], **changes)).eval()


def random_batch(policy, windows=6, seed=0, dtype=torch.float32):
    """Random windows, and what the policy draws to make its loss pure."""
    config, generator = policy.config, torch.Generator().manual_seed(seed)
    shapes = {"points": (2, config.num_points, 3), "state": (2, 9), "action": (config.horizon, 4)}
    batch = {}
    for name, shape in shapes.items():
        batch[name] = torch.randn(windows, *shape, generator=generator)
    batch.update(policy.draw_noise_and_timesteps(windows, generator))
    for name, x in batch.items():
        if x.is_floating_point():
            batch[name] = x.to(dtype)
    return batch


def sample(policy, batch, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return policy.sample_actions(batch["points"], batch["state"], None, generator)


# ---- FlowPolicy ----------------------------------------------------------------------------------


def test_flow_matches_a_transcription_on_scalars():
    """One number an action, a velocity that is a known function of place and time."""
    policy = new_policy("flow")
    windows, (H, A) = 400, (4, 4)
    batch = random_batch(policy, windows)
    batch["times"][:3] = torch.tensor([0.495, 0.5, 0.995])  # crosses, at, and beyond the last step
    policy.velocity = lambda x, t, _: torch.sin(3 * x) + t[:, None, None]
    loss = policy.loss(**batch)

    total = 0.0
    for a1, a0, t in zip(
        batch["action"].tolist(), batch["noise"].tolist(), batch["times"].tolist()
    ):
        r, s = min(t + 0.01, 1.0), 0.5 if t <= 0.5 else 1.0
        for row1, row0 in zip(a1, a0):
            for one, zero in zip(row1, row0):
                x_t, x_r = t * one + (1 - t) * zero, r * one + (1 - r) * zero
                v_t, v_r = math.sin(3 * x_t) + t, math.sin(3 * x_r) + r
                f_t = x_t + (s - t) * v_t
                f_r = x_r + (s - r) * v_r if r < 1 else s * one + (1 - s) * zero
                total += (f_t - f_r) ** 2
                total += 1e-5 * (v_t - v_r) ** 2 if s - t > 0.0101 else 0.0
    assert loss.item() == pytest.approx(total / (windows * H * A) / 1e-4, rel=1e-4)


def test_flow_weighs_velocities_only_away_from_the_end_of_a_segment():
    policy = new_policy("flow")
    batch = random_batch(policy, 2)
    line = batch["action"] - batch["noise"]
    constant = lambda x, t, _: line.repeat(2, 1, 1) + 30 * t[:, None, None]  # noqa: E731
    policy.velocity = constant
    weight, losses = policy.WEIGHT, {}
    for t in (0.3, 0.495):
        batch["times"][:] = t
        policy.WEIGHT = weight
        losses[t] = policy.loss(**batch)
        policy.WEIGHT = 0.0
        losses[t] = (losses[t] - policy.loss(**batch)).item()
    assert losses[0.3] == pytest.approx(0.1 * 0.3**2, rel=1e-2) and losses[0.495] == 0


def test_flow_draws_in_one_step_from_the_first_time():
    policy = new_policy("flow")
    batch, seen = random_batch(policy), []
    policy.denoiser.register_forward_hook(lambda _, args, out: seen.append((args[0], out)))
    times = []
    policy.condition_encoder.register_forward_pre_hook(lambda _, args: times.append(args[0]))
    drawn = sample(policy, batch)
    ((noise, velocity),) = seen
    torch.testing.assert_close(drawn, (noise + velocity)[:, 1:4])
    torch.testing.assert_close(times, [torch.full((6,), 0.99)])
    times = policy.draw_noise_and_timesteps(1000, torch.Generator().manual_seed(0))["times"]
    assert 0.01 <= times.min() < 0.015 and 0.99 < times.max() < 1


# ---- Mamba Policy --------------------------------------------------------------------------------


@pytest.mark.parametrize("length", [1, 2, 3, 4, 5, 16])
def test_the_associative_scan_is_the_recurrence(length):
    a, b = torch.randn(2, 3, length, 5, 4, dtype=torch.float64)
    h, expected = torch.zeros(3, 5, 4, dtype=torch.float64), []
    for step in range(length):
        h = a[:, step] * h + b[:, step]
        expected.append(h)
    torch.testing.assert_close(associative_scan(a, b), torch.stack(expected, dim=1))


def test_mamba_is_the_published_recurrence_one_channel_at_a_time():
    torch.manual_seed(0)
    mamba, x = Mamba(8).double(), torch.randn(2, 5, 8, dtype=torch.float64)
    weights, sigmoid = mamba.state_dict(), torch.sigmoid
    u, gate = (x @ weights["project_in.weight"].T).split(16, dim=-1)
    convolution = torch.nn.Conv1d(16, 16, 4, groups=16, padding=3).double()
    convolution.weight.data = weights["kernel"].T[:, None].clone()
    convolution.bias.data = weights["kernel_bias"].clone()
    u = convolution(u.transpose(1, 2))[..., :5].transpose(1, 2)
    u = u * sigmoid(u)
    rank, write, read = (u @ weights["project_x.weight"].T).split([1, 16, 16], dim=-1)
    step = rank @ weights["project_step.weight"].T + weights["project_step.bias"]
    step = torch.log1p(step.exp())
    y = torch.zeros_like(u)
    for window in range(2):
        for channel in range(16):
            h = torch.zeros(16, dtype=torch.float64)
            for place in range(5):
                delta, value = step[window, place, channel], u[window, place, channel]
                decay = -torch.arange(1, 17, dtype=torch.float64)  # A at the beginning
                h = (delta * decay).exp() * h + delta * write[window, place] * value
                y[window, place, channel] = h @ read[window, place] + value  # D = 1
    expected = (y * gate * sigmoid(gate)) @ weights["project_out.weight"].T
    torch.testing.assert_close(mamba(x), expected, atol=1e-6, rtol=0)  # log 1 ... 16 is float32


def test_mamba_sees_no_later_place():
    torch.manual_seed(0)
    mamba, x = Mamba(16), torch.randn(2, 6, 16)
    changed = x.clone()
    changed[:, 4:] = 0
    same = (mamba(x) - mamba(changed)).abs().amax(dim=(0, 2))
    assert same[:4].max() < 1e-6 and same[4:].min() > 1e-4


def test_mambas_branches_are_dropped_by_the_batch_and_never_when_it_draws():
    policy = new_policy("mamba")
    assert isinstance(policy, MambaPolicy) and policy.denoiser.branches == 4 * 8
    batch = random_batch(policy, 500)
    factors = batch["drop_path"]
    assert factors.shape == (500, 32) and set(factors.unique().tolist()) == {0, 1.25}
    assert factors.eq(0).float().mean().item() == pytest.approx(0.2, abs=0.02)

    few, losses = {k: x[:2] for k, x in batch.items()}, set()
    for branch in range(-1, 32):
        keep = torch.ones(2, 32)
        keep[:, branch] = 0 if branch >= 0 else 1
        losses.add(policy.loss(**few | {"drop_path": keep}).item())
    assert len(losses) == 33  # each branch counts
    observation = policy.encode_observations(few["points"], few["state"]).flatten(1)
    clean = policy.denoise(few["action"], few["timesteps"], observation, None)
    h = policy.condition_encoder(few["timesteps"], observation)
    nothing_dropped = policy.denoiser(few["action"], h, drop_path=torch.ones(2, 32))
    torch.testing.assert_close(clean, nothing_dropped)
    with pytest.raises(ValueError, match=r"drop_path is \(2, 31\), the policy takes \(2, 32\)"):
        policy.loss(**few | {"drop_path": torch.ones(2, 31)})


# ---- FreqPolicy ----------------------------------------------------------------------------------


def test_the_cosine_transform_is_scipys_and_a_low_pass_keeps_the_first_frequencies():
    policy = new_policy("freq")
    actions, cutoffs = torch.randn(18, 16, 4), torch.arange(18).clamp(max=16)
    spectrum = scipy.fft.dct(actions.numpy(), axis=1, norm="ortho")
    torch.testing.assert_close(policy.denoiser.dct @ actions, torch.from_numpy(spectrum))
    for row, cutoff in zip(spectrum, cutoffs):
        row[cutoff:] = 0
    expected = torch.from_numpy(scipy.fft.idct(spectrum, axis=1, norm="ortho"))
    torch.testing.assert_close(policy.denoiser.low_pass(actions, cutoffs), expected)


def test_hidden_places_do_not_reach_the_transformer_and_shown_ones_do():
    policy = new_policy("freq")
    batch = random_batch(policy)
    observation = policy.encode_observations(batch["points"], batch["state"])
    read = lambda low: policy.denoiser(observation, low, batch["mask"], batch["cutoffs"])  # noqa: E731
    hidden, z = batch["mask"][..., None], read(batch["action"])
    torch.testing.assert_close(read(torch.where(hidden, 7.0, batch["action"])), z)
    shown = ~batch["mask"].all(dim=1)
    assert shown.any()
    moved = (read(torch.where(hidden, batch["action"], 7.0)) - z).abs().amax(dim=(1, 2))
    assert (moved > 1e-4).equal(shown)


def test_freq_draws_cutoffs_of_all_kinds_and_hides_most_places():
    policy = new_policy("freq")
    drawn = policy.draw_noise_and_timesteps(2000, torch.Generator().manual_seed(0))
    assert set(drawn["cutoffs"].tolist()) == set(range(17))
    assert set(drawn["timesteps"].unique().tolist()) == set(range(100))
    hidden = drawn["mask"].sum(dim=1)
    assert set(hidden.tolist()) == {12, 13, 14, 15, 16}
    # ceil(16 share) <= n where share <= n / 16, of a normal around 1 cut to [0.7, 1]
    normal = torch.distributions.Normal(1.0, 0.25).cdf
    low = normal(torch.tensor(0.7))
    for n in (12, 14, 15):
        expected = (normal(torch.tensor(n / 16)) - low) / (0.5 - low)
        assert (hidden <= n).float().mean().item() == pytest.approx(expected.item(), abs=0.04)
    assert drawn["mask"].float().mean(dim=0).std() < 0.02  # no place is preferred


def test_freq_draws_in_four_rounds_of_rising_cutoff_and_shrinking_mask():
    policy, rounds = new_policy("freq"), []
    policy.denoiser.register_forward_pre_hook(lambda _, args: rounds.append(args[1:]))
    steps = []
    policy.denoiser.head.register_forward_pre_hook(
        lambda _, args: steps.append(args[1][0, 0].item())
    )
    drawn = sample(policy, random_batch(policy))
    assert drawn.shape == (6, 8, 4) and drawn.abs().max() <= 1
    assert [cutoffs.unique().tolist() for _, _, cutoffs in rounds] == [[0], [5], [10], [16]]
    assert [set(mask.sum(dim=1).tolist()) for _, mask, _ in rounds] == [{16}, {14}, {11}, {6}]
    for (_, before, _), (_, after, _) in pairwise(rounds):
        assert not (after & ~before).any()  # what was shown stays shown
    assert steps == 4 * list(range(90, -1, -10))


def test_freq_recovers_actions_from_the_right_noise():
    policy = new_policy("freq")
    clean = 0.9 * torch.randn(6, 16, 4).clamp(-1, 1)
    policy.denoiser.head.forward = lambda x, k, *_: (
        (x - (a := policy.schedule.alphas_cumprod[k][..., None]).sqrt() * clean) / (1 - a).sqrt()
    )
    drawn = sample(policy, random_batch(policy))
    torch.testing.assert_close(drawn, clean[:, 1:9], atol=1e-4, rtol=0)


# ---- All of them ---------------------------------------------------------------------------------


@pytest.mark.parametrize("preset", ["tiny", "small"])
@pytest.mark.parametrize("name", NEW)
def test_every_parameter_is_adapted_and_has_a_gradient_and_a_loss_is_pure(name, preset):
    policy = new_policy(name, preset)
    grouped = [id(p) for group in policy.parameter_groups().values() for p in group]
    assert sorted(grouped) == sorted(map(id, policy.parameters()))
    batch = random_batch(policy)
    loss = policy.loss(**batch)
    loss.backward()
    assert [n for n, p in policy.named_parameters() if p.grad is None] == []
    assert torch.equal(loss, policy(**batch)) and policy.encode_demo(torch.zeros(1, 512)) is None
    for key in policy.draw_noise_and_timesteps(2, torch.Generator()):
        assert key not in model.TASK_INPUTS and len(batch[key]) == 6
        with pytest.raises(ValueError, match=key):
            policy.loss(**batch | {key: batch[key][:1]})  # would broadcast
    with pytest.raises(TypeError):
        policy.loss(**batch, demonstration=batch["points"])


@pytest.mark.parametrize("name, steps", [("flow", 110), ("mamba", 40), ("freq", 140)])
def test_a_policy_overfits_one_batch_and_draws_its_actions(name, steps, monkeypatch):
    """Smooth action chunks, one for each of four observations; see what may differ for a policy."""
    monkeypatch.setattr(baselines.FrequencyTransformer, "LAYERS", 1)  # seconds
    policy, copies, g = new_policy(name, num_points=16), 4, torch.Generator().manual_seed(0)
    few, H = random_batch(policy, 4), policy.config.horizon
    phase, time = torch.arange(4)[:, None, None] + torch.arange(4), torch.arange(H) / H
    few["action"] = 0.8 * torch.sin(phase + 3 * time[:, None])
    batch = {key: x.repeat(copies, *[1] * (x.dim() - 1)) for key, x in few.items()}
    noise = torch.randn(4, H, 4, generator=torch.Generator().manual_seed(0)).repeat(copies, 1, 1)
    optimizer, average = torch.optim.AdamW(policy.parameters(), lr=3e-3), model.ema_model(policy)
    for _ in range(steps):
        drawn = policy.draw_noise_and_timesteps(4 * copies, g)
        if name == "flow":  # only along the lines that will be drawn: it takes long to learn others
            drawn["noise"] = noise
        loss = policy.loss(**batch | drawn)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        average.update_parameters(policy)
    wanted = few["action"][:, 1 : 1 + policy.config.n_action_steps]
    error = (sample(average.module, few) - wanted).abs().mean()
    spread = (wanted - wanted.mean(dim=0)).abs().mean()
    assert error < 0.5 * spread, (error / spread).item()


# The loss of flow is so curved (it is divided by 1e-4) that steps must be short.
CURVED = [("flow", 1e-5, 1e-7), ("mamba", 0.1, 1e-6), ("freq", 0.3, 1e-6)]


@pytest.mark.parametrize("name, lr, h", CURVED)
def test_the_meta_gradient_equals_finite_differences_one_by_one_and_vectorized(name, lr, h):
    policy = new_policy(name, num_points=16).double()
    with torch.no_grad():  # away from the gates that begin at zero
        for p in policy.parameters():
            p += 0.05 * torch.randn_like(p)
    params = dict(policy.named_parameters())
    batches = [random_batch(policy, 5, seed, torch.float64) for seed in range(2)]
    tasks = [model.split(batch, 2) for batch in batches]
    loss = lambda params, batch: functional_call(policy, params, (), batch)  # noqa: E731

    def flat(**options):
        gradients, _, after = meta_gradient(loss, params, tasks, lr, **options)
        return torch.cat([g.flatten() for g in gradients.values()]), after

    (second, losses), (first, _) = flat(), flat(first_order=True)
    vectorized, again = flat(vectorize=2)
    torch.testing.assert_close(losses, again)
    torch.testing.assert_close(second, vectorized, atol=1e-10, rtol=1e-8)

    start = torch.cat([p.detach().flatten() for p in params.values()])

    def objective(vector):
        """The mean query loss after one step, by plain autograd, without torch.func."""
        total, parts = 0.0, vector.split([p.numel() for p in params.values()])
        at = {n: x.view_as(p).requires_grad_() for (n, p), x in zip(params.items(), parts)}
        for support, query in tasks:
            gradients = torch.autograd.grad(loss(at, support), list(at.values()))
            with torch.no_grad():
                moved = {n: p - lr * g for (n, p), g in zip(at.items(), gradients)}
                total += loss(moved, query).item() / len(tasks)
        return total

    torch.manual_seed(1)
    for direction in (second - first, torch.randn_like(start)):
        direction = direction / direction.norm()
        slope = (objective(start + h * direction) - objective(start - h * direction)) / (2 * h)
        assert float(second @ direction) == pytest.approx(slope, rel=1e-5, abs=1e-9)
    assert (second - first).norm() > 0.05 * first.norm(), (second - first).norm() / first.norm()


@pytest.mark.parametrize("name", ["dp3", *NEW])
def test_a_checkpoint_gives_back_the_policy_of_its_name(name, tmp_path):
    policy = new_policy(name)
    batch = random_batch(policy)
    policy.normalizer.fit([SimpleNamespace(**batch)])
    model.save(tmp_path / "a.pt", policy)
    again, _ = model.load(tmp_path / "a.pt")
    assert type(again) is baselines.POLICIES[name] and again.config == policy.config
    assert torch.equal(sample(again, batch), sample(policy, batch))


def test_an_unknown_or_contradictory_policy_is_refused_in_one_line(tmp_path):
    model.save(tmp_path / "a.pt", new_policy("flow"))
    info = torch.load(tmp_path / "a.pt", weights_only=True)
    for config, message in (
        ({"policy": "fast"}, "policy 'fast' is unknown: import the file that adds it"),
        ({"demo_encoder": "vmt"}, "flow needs demo_encoder 'none', not 'vmt'"),
        ({"sampler": "dp3"}, "flow needs sampler 'ddim', not 'dp3'"),
        ({"policy": "freq"}, "freq needs denoiser 'frequency-transformer', not 'unet'"),
    ):
        torch.save(info | {"config": info["config"] | config}, tmp_path / "b.pt")
        with pytest.raises(ValueError, match=message) as error:
            model.load(tmp_path / "b.pt")
        assert "\n" not in str(error.value) and "b.pt" in str(error.value)


def test_dp3s_sampler_puts_back_the_prediction_and_another_can_be_chosen_at_a_checkpoint(tmp_path):
    model.save(tmp_path / "a.pt", new_policy("dp3"))
    (dp3, _), (plain, _) = (
        model.load(tmp_path / "a.pt", **changed) for changed in ({}, {"sampler": "ddim"})
    )
    assert (plain.config.sampler, dp3.config.sampler) == ("ddim", "dp3")
    batch = random_batch(plain)
    assert (sample(plain, batch) - sample(dp3, batch)).abs().max() > 1e-3
    prediction, noisy = 1.5 * torch.randn(2, 3, 4, 4)
    for k, before in ((90, 80), (10, 0), (0, None)):
        a = 1.0 if before is None else plain.schedule.alphas_cumprod[before].item()
        expected = math.sqrt(a) * prediction.clamp(-1, 1) + math.sqrt(1 - a) * prediction
        torch.testing.assert_close(dp3.schedule.step(prediction, k, noisy), expected)


def test_presets_are_of_one_size_and_the_table_counts_them(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["baselines.py"])
    baselines.main()
    rows = {row.split()[0]: row.split()[1:] for row in capsys.readouterr().out.splitlines()}
    assert rows.pop("parameters") == ["paper", "small", "tiny"]
    assert list(rows) == ["dami", "dp3", *NEW]
    for policy, counts in rows.items():
        assert 2.8e6 < int(counts[1].replace(",", "")) < 3.1e6
        small = baselines.build_policy(PRESETS[policy]["tiny"])
        assert re.sub(",", "", counts[2]) == str(sum(p.numel() for p in small.parameters()))
    assert isinstance(new_policy("freq"), FreqPolicy) and isinstance(new_policy("flow"), FlowPolicy)
    assert not list(
        new_policy("dp3").condition_encoder.condition_mlp.parameters()
    )  # Eq. 7's MLP is DAMI's


# ---- Whole runs ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["dp3", *NEW])
def test_a_policy_is_trained_resumed_adapted_and_rolled_out(
    name, recorded, small_suite, own_folder, no_pictures, monkeypatch
):
    argv = [*FEW, "--policy", name, "--data", str(recorded), "--vectorize", "3"]
    argv += ["--steps", "2", "--checkpoint-every", "2"]
    built, ema = [], model.ema_model
    monkeypatch.setattr(train, "ema_model", lambda policy: (built.append(policy), ema(policy))[1])
    train.main([*argv, "--out", "run"])
    assert type(built[0]) is baselines.POLICIES[name]
    losses = [line for line in metrics(own_folder / "run") if "loss" in line]
    assert [line["step"] for line in losses] == [1, 2]
    assert all(math.isfinite(line["loss"]) for line in losses)
    assert losses[0]["loss"] != losses[0]["loss_before"]  # there was an inner step
    _, info = weights("run/last.pt")
    arguments = info["arguments"]
    assert arguments["instruction_dropout"] == arguments["task_dropout"] == 0
    train.main([*argv, "--out", "run", "--resume"])

    adapt = ["--task", "door-close", "--checkpoint", "run", "--data", str(recorded), "--out", "new"]
    adapt += "--steps 2 --demonstrations 2 --episodes 0 --clip-weights random --device cpu".split()
    finetune.main(adapt)
    policy, info = model.load("new/adapted.pt")
    assert policy.config.policy == name and info["adapted_to"] == "door-close"

    demonstrations = data.load_demonstrations(recorded / "door-close.npz")
    sampler = data.WindowSampler(demonstrations, policy.config)
    env = MetaWorld(episode_steps=24).make("door-close", policy.config.num_points)
    generator = torch.Generator().manual_seed(0)
    successes = evaluate.rollout(policy, [env], [1], sampler, torch.zeros(512), generator)
    assert len(successes) == 1 and env.steps > 0


def test_a_policy_that_reads_no_task_is_not_given_one(recorded, small_suite, own_folder, capsys):
    argv = [*FEW, "--data", recorded, "--out", "run", "--policy", "mamba"]
    assert "mamba needs demo_encoder 'none', not 'vmt'" in fails(
        train, [*argv, "--demo-encoder", "vmt"], capsys
    )
    argv[-1] = "freq"
    assert "freq needs sampler 'ddim', not 'dp3'" in fails(
        train, [*argv, "--sampler", "dp3"], capsys
    )
