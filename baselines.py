"""The paper's other policies, on DAMI's own encoder, diffusion, normalizer and checkpoints.

    python train.py --policy flow                       # or mamba, freq, dp3; dami is the default
    python train.py --policy mamba --maml off           # multi-task training instead of MAML
    python baselines.py                                 # the size of each policy and preset

`dp3` is model.py's policy without demonstration and instruction. The other three, too, read two
observations and nothing else. What each of them changes (`flow` and `mamba` also draw as few
actions as their code does):

    flow    FlowPolicy: what is learned. A velocity from noise to actions, consistent along its way,
            so that one step draws them.
    mamba   Mamba Policy: the network. A state space model and an attention in place of the second
            convolution of every residual block.
    freq    FreqPolicy: what is drawn. Low frequencies of the actions first, then all of them, by a
            masked Transformer and a small diffusion for each action.

Each class is a `DP3Policy` with another `loss`, `sample_actions` or network, so that training,
adaptation, evaluation and checkpoints are the same. All that is random (noise, times, masks) comes
with the batch: a loss is a pure function with a second derivative, as MAML needs, `torch.vmap`
included. What the publications leave open, or their code does otherwise, each class says. Importing
this file adds the policies, their networks and the ablation of VMT to the dictionaries of model.py.

Letters are model.py's: B windows, To observation steps, H horizon, A action dim, C condition width,
L length of a sequence inside the U-Net. Here also W width of a Transformer, M channels inside a
Mamba (twice its width) and J = 16 states of each.
"""

import argparse
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Generator, Tensor, nn

import model
from model import (
    POLICIES,
    Attention,
    ConditionalUNet1d,
    ConfigError,
    Context,
    DP3Policy,
    PolicyConfig,
    ResidualBlock,
    TransformerBlock,
    build_policy,
    demo_encoders,
    denoisers,
    sinusoids,
)

# ---- What the three share ------------------------------------------------------------------------


def draw(
    function: Callable, *shape: int, like: Tensor, generator: Generator | None = None
) -> Tensor:
    """Calls torch.randn or torch.rand on the generator's device, for a result on that of `like`."""
    source = like.device if generator is None else generator.device
    return function(*shape, generator=generator, device=source).to(like.device)


# ---- FlowPolicy ----------------------------------------------------------------------------------


class FlowPolicy(DP3Policy):
    """Consistency flow matching with DP3's network (Zhang et al., AAAI 2025, arXiv 2412.04987).

    Noise a0 and data a1 lie at the ends of a line, x_t = t a1 + (1 - t) a0. The network learns a
    velocity v. From two neighbouring times t < r of one line it must lead to the same place, at the
    end s of t's segment ([0, 1/2] or [1/2, 1]):

        f_t = x_t + (s - t) v(x_t)      f_r = x_r + (s - r) v(x_r)
        loss = (|f_t - f_r|^2 + 1e-5 |v(x_t) - v(x_r)|^2) / 0.01^2, the second term only where r < s

    As t comes to s, f_t comes to x_s whatever v is: that alone ties the network to the data.

    Left open: consistency flow matching takes f_r from averaged weights; FlowPolicy's code takes it
    from the same ones and lets the gradient pass through both. So does this: a target held fixed
    would leave the loss without the derivative that MAML differentiates. The division is ours:
    without it the loss is 1e-4 of the others', which AdamW hardly feels, and an inner step moves
    nothing. The code's horizon is 4, of which it executes 3: those from the newest of two
    observations on.
    """

    # `sample_actions` draws in its own way, and reads no sampler: one value is enough.
    requires: ClassVar = {**DP3Policy.requires, "sampler": "ddim"}

    START = 0.01  # of t
    STEP = 0.01  # from t to r
    SEGMENTS = 2  # of the line
    WEIGHT = 1e-5  # of the difference between the velocities
    TIMESTEPS = 99  # the time embedding reads 99 t, as a diffusion's reads 0 to 99

    def draw_noise_and_timesteps(self, n: int, generator: Generator) -> dict[str, Tensor]:
        """Draws what makes `loss` pure: noise (n, H, A), times (n,) in [0.01, 1)."""
        H, A = self.config.horizon, self.config.action_dim
        like = self.normalizer.action_scale
        noise = draw(torch.randn, n, H, A, like=like, generator=generator)
        times = draw(torch.rand, n, like=like, generator=generator)
        return {"noise": noise, "times": self.START + (1 - self.START) * times}

    def shapes(self) -> dict[str, tuple[int | str, ...]]:
        return {**super().shapes(), "times": ("B",)}

    def loss(
        self,
        points: Tensor,
        state: Tensor,
        action: Tensor,
        noise: Tensor,
        times: Tensor,
        **task: Tensor,
    ) -> Tensor:
        """The consistency of the velocity, () float; arguments as of `DAMIPolicy.loss`.

        `noise` (B, H, A) is a0, `times` (B,) float t; of `task` nothing is read.
        """
        self.encode_demo(**task)  # encodes nothing; refuses what is no input of a task
        self.check_shapes(points=points, state=state, action=action, noise=noise, times=times)

        clean = self.normalizer.normalize("action", action)  # a1, (B, H, A)
        t = times.to(clean.dtype)[:, None, None]  # (B, 1, 1)
        r = (t + self.STEP).clamp(max=1)  # where it is 1, f_r is a1
        s = (self.SEGMENTS * t).ceil() / self.SEGMENTS  # the end of t's segment
        x_t = t * clean + (1 - t) * noise  # (B, H, A)
        x_r = r * clean + (1 - r) * noise  # (B, H, A)

        observation = self.encode_observations(points, state).flatten(1)  # (B, To * feature)
        velocities = self.velocity(  # one pass for both times
            torch.cat([x_t, x_r]),  # (2 B, H, A)
            torch.cat([t, r]).flatten(),  # (2 B,)
            observation.repeat(2, 1),  # (2 B, To * feature)
        )
        v_t, v_r = velocities.chunk(2)  # 2 x (B, H, A)
        f_t = x_t + (s - t) * v_t
        f_r = x_r + (s - r) * v_r
        r_before_s = s - t > 1.01 * self.STEP  # r < s, with a margin for rounding
        distance = (f_t - f_r) ** 2 + self.WEIGHT * r_before_s * (v_t - v_r) ** 2  # (B, H, A)
        return distance.mean() / self.STEP**2

    def velocity(self, x: Tensor, t: Tensor, observation: Tensor) -> Tensor:
        """x (B, H, A), t (B,), observation (B, To * feature) -> v (B, H, A)."""
        return self.denoise(x, self.TIMESTEPS * t, observation, None)

    @torch.no_grad()
    def sample_actions(
        self, points: Tensor, state: Tensor, context: Context, generator: Generator | None = None
    ) -> Tensor:
        """Draws an action chunk (B, Ta, A) in one step, a0 + v(a0); as `DAMIPolicy`'s does."""
        self.check_shapes(points=points, state=state)
        observation = self.encode_observations(points, state).flatten(1)  # (B, To * feature)
        B, H, A = len(points), self.config.horizon, self.config.action_dim
        noise = draw(torch.randn, B, H, A, like=points, generator=generator)
        start = torch.full((B,), self.START, device=points.device)
        return self.select_action_chunk(noise + self.velocity(noise, start, observation))


# ---- Mamba Policy --------------------------------------------------------------------------------


def associative_scan(a: Tensor, b: Tensor) -> Tensor:
    """h_l = a_l h_{l-1} + b_l along dim 1, from h_{-1} = 0: (B, L, ...) twice -> (B, L, ...).

    A step (a, b) and then (a', b') are one step (a' a, a' b + b'). Every place is therefore
    joined with the one before it, then with the one two before, four, ...: log2(L) times, each for
    all places at once, where the recurrence takes L. What came before the first changes nothing.
    """
    reach = 1
    while True:  # once even where L is 1, so that `a` has a gradient there: zero
        before_a = torch.cat([torch.ones_like(a[:, :reach]), a[:, :-reach]], dim=1)
        before_b = torch.cat([torch.zeros_like(b[:, :reach]), b[:, :-reach]], dim=1)
        a, b = a * before_a, a * before_b + b
        reach *= 2
        if reach >= b.shape[1]:
            return b


class Mamba(nn.Module):
    """Mamba v1: a linear recurrence whose step, input and output depend on what is read.

    Written out (Gu and Dao 2023): the fused CUDA kernel has no second derivative. Only the past is
    seen: place l of the result depends on places 0 to l.
    """

    STATES = 16  # J
    KERNEL = 4

    def __init__(self, width: int):
        super().__init__()
        inner = 2 * width  # M
        rank = math.ceil(width / 16)
        self.sizes = (rank, self.STATES, self.STATES)
        self.project_in = nn.Linear(width, 2 * inner, bias=False)
        self.kernel = nn.Parameter(torch.rand(self.KERNEL, inner) - 0.5)  # +-1 / sqrt(KERNEL)
        self.kernel_bias = nn.Parameter(torch.rand(inner) - 0.5)
        self.project_x = nn.Linear(inner, sum(self.sizes), bias=False)
        self.project_step = nn.Linear(rank, inner)
        self.log_decay = nn.Parameter(torch.arange(1.0, self.STATES + 1).log().repeat(inner, 1))
        self.skip = nn.Parameter(torch.ones(inner))
        self.project_out = nn.Linear(inner, width, bias=False)
        with torch.no_grad():  # steps between 0.001 and 0.1, evenly on a log scale
            nn.init.uniform_(self.project_step.weight, -(rank**-0.5), rank**-0.5)
            step = torch.exp(torch.empty(inner).uniform_(math.log(1e-3), math.log(0.1)))
            self.project_step.bias.copy_(step + torch.log(-torch.expm1(-step)))  # softplus^-1

    def forward(self, x: Tensor) -> Tensor:
        """(B, L, width) -> (B, L, width)."""
        x, gate = self.project_in(x).chunk(2, dim=-1)  # 2 x (B, L, M)
        L = x.shape[1]
        padded = F.pad(x, (0, 0, self.KERNEL - 1, 0))  # (B, L + 3, M): nothing came before
        x = sum(padded[:, i : i + L] * self.kernel[i] for i in range(self.KERNEL))
        x = F.silu(x + self.kernel_bias)  # (B, L, M), a causal convolution of each channel

        step, write, read = self.project_x(x).split(self.sizes, dim=-1)  # (B, L, rank), 2 (B, L, J)
        step = F.softplus(self.project_step(step))  # (B, L, M)
        a = torch.exp(step[..., None] * -self.log_decay.exp())  # (B, L, M, J)
        b = (step * x)[..., None] * write[:, :, None]  # (B, L, M, J)
        h = associative_scan(a, b)  # (B, L, M, J)
        y = (h * read[:, :, None]).sum(dim=-1) + self.skip * x  # (B, L, M)
        return self.project_out(y * F.silu(gate))  # (B, L, width)


class MixerBlock(nn.Module):
    """Pre-norm residual block, a mixer of places and an MLP, each dropped for some windows."""

    def __init__(self, mixer: nn.Module, width: int):
        super().__init__()
        self.norm1 = nn.LayerNorm(width)
        self.norm2 = nn.LayerNorm(width)
        self.mixer = mixer
        wide = 4 * width
        self.mlp = nn.Sequential(nn.Linear(width, wide), nn.GELU(), nn.Linear(wide, width))

    def forward(self, x: Tensor, keep: Tensor) -> Tensor:
        """x (B, L, width), keep (B, 2), the factor of either branch -> (B, L, width)."""
        x = x + keep[:, :1, None] * self.mixer(self.norm1(x))
        return x + keep[:, 1:, None] * self.mlp(self.norm2(x))


class MambaResidualBlock(nn.Module):
    """DP3's residual block with a Mamba and an attention in place of the second convolution."""

    HEADS = 8
    BRANCHES = 4  # Mamba and its MLP, attention and its MLP: what stochastic depth may leave out

    def __init__(self, block: ResidualBlock, config: PolicyConfig, index: int):
        super().__init__()
        self.conv1, self.film, self.residual = block.conv1, block.film, block.residual
        self.condition_dim = config.condition_dim
        self.first_branch = index * self.BRANCHES
        width = self.conv1[0].out_channels
        self.mamba = MixerBlock(Mamba(width), width)
        self.attention = MixerBlock(Attention(width, self.HEADS), width)

    def forward(self, x: Tensor, condition_and_drop_path: Tensor) -> Tensor:
        """x (B, d_in, L), [condition | drop_path] (B, C + branches) -> (B, d_out, L)."""
        h, drop_path = condition_and_drop_path.tensor_split([self.condition_dim], dim=1)
        keep = drop_path[:, self.first_branch : self.first_branch + self.BRANCHES]  # (B, 4)
        scale, bias = self.film(h)[..., None].chunk(2, dim=1)  # 2 x (B, d_out, 1)
        y = (scale * self.conv1(x) + bias).transpose(1, 2)  # (B, L, d_out)
        y = self.mamba(y, keep[:, :2])
        y = self.attention(y, keep[:, 2:])
        return y.transpose(1, 2) + self.residual(x)


class MambaUNet1d(ConditionalUNet1d):
    """DP3's U-Net with other residual blocks, whose branches `drop_path` leaves out or scales."""

    def __init__(self, config: PolicyConfig):
        super().__init__(config)
        blocks = [(name, m) for name, m in self.named_modules() if isinstance(m, ResidualBlock)]
        for index, (name, block) in enumerate(blocks):
            self.set_submodule(name, MambaResidualBlock(block, config, index))
        self.branches = len(blocks) * MambaResidualBlock.BRANCHES

    def forward(
        self,
        actions: Tensor,
        h: Tensor,
        fused: Tensor | None = None,
        drop_path: Tensor | None = None,
    ) -> Tensor:
        """As the U-Net's; drop_path (B, branches) has a factor for each branch, None: all are 1."""
        if drop_path is None:
            drop_path = torch.ones(len(h), self.branches, dtype=h.dtype, device=h.device)
        # The U-Net gives one tensor to each of its blocks, and each block takes both from it.
        h = torch.cat([h, drop_path], dim=1)  # (B, C + branches)
        if fused is not None:
            fused = torch.cat([fused, drop_path], dim=1)
        return super().forward(actions, h, fused)


class MambaPolicy(DP3Policy):
    """DP3 with a Mamba and an attention in every residual block (Cao et al., arXiv 2409.07163).

    In training each of a block's four branches is left out for a fifth of the windows, and
    multiplied by 5 / 4 for the others (stochastic depth).

    Left open: the publication describes the attention; the configurations that come with its code
    build it and do not run it. Here it runs, and its queries, keys and values have a bias, as
    elsewhere in this project. Widths, kernel and horizon are that code's.
    """

    requires: ClassVar = {**DP3Policy.requires, "denoiser": "mamba-unet"}

    DROP = 0.2  # the share of windows that a branch is left out for

    def draw_noise_and_timesteps(self, n: int, generator: Generator) -> dict[str, Tensor]:
        """Draws noise and timesteps as `DAMIPolicy` does, and drop_path (n, branches).

        drop_path is 0 for what is left out, and 1.25 for what is kept.
        """
        drawn = super().draw_noise_and_timesteps(n, generator)
        like = self.normalizer.action_scale
        uniform = draw(torch.rand, n, self.denoiser.branches, like=like, generator=generator)
        drawn["drop_path"] = (uniform >= self.DROP) / (1 - self.DROP)
        return drawn

    def shapes(self) -> dict[str, tuple[int | str, ...]]:
        return {**super().shapes(), "drop_path": ("B", self.denoiser.branches)}

    def loss(
        self,
        points: Tensor,
        state: Tensor,
        action: Tensor,
        noise: Tensor,
        timesteps: Tensor,
        drop_path: Tensor,
        **task: Tensor,
    ) -> Tensor:
        """The diffusion loss, () float; arguments as of `DAMIPolicy.loss`.

        drop_path (B, branches) float: the factor of each branch; of `task` nothing is read.
        """
        self.encode_demo(**task)  # encodes nothing; refuses what is no input of a task
        self.check_shapes(
            points=points,
            state=state,
            action=action,
            noise=noise,
            timesteps=timesteps,
            drop_path=drop_path,
        )
        clean = self.normalizer.normalize("action", action)  # A_0, (B, H, A)
        noisy = self.schedule.add_noise(clean, noise, timesteps)  # A_k, (B, H, A)
        observation = self.encode_observations(points, state).flatten(1)  # (B, To * feature)
        h = self.condition_encoder(timesteps, observation)  # (B, C)
        prediction = self.denoiser(noisy, h, drop_path=drop_path.to(h.dtype))  # (B, H, A)
        return F.mse_loss(prediction, clean)


# ---- FreqPolicy ----------------------------------------------------------------------------------


def dct_matrix(n: int) -> Tensor:
    """The orthonormal discrete cosine transform (DCT-II), (n, n): row k has frequency k."""
    k, place = torch.arange(n, dtype=torch.float64)[:, None], torch.arange(n) + 0.5
    matrix = math.sqrt(2 / n) * torch.cos(math.pi / n * k * place)
    return torch.cat([matrix[:1] / math.sqrt(2), matrix[1:]])


class MaskedBlock(TransformerBlock):
    """A Transformer block in which nothing looks at hidden tokens: as if they were not there."""

    def forward(self, x: Tensor, hidden: Tensor) -> Tensor:
        """x (B, T, W), hidden (B, T) bool -> (B, T, W)."""
        q, k, v = self.attention.project(self.norm1(x))  # each (B, heads, T, W / heads)
        scores = q @ k.transpose(-2, -1) * q.shape[-1] ** -0.5  # (B, heads, T, T)
        scores = scores.masked_fill(hidden[:, None, None], -math.inf)
        x = x + self.attention.merge(scores.softmax(dim=-1) @ v)
        return x + self.mlp(self.norm2(x))


class ModulatedMLP(nn.Module):
    """A residual MLP whose input is shifted and scaled, and whose output is gated, by a condition.

    The gate begins at zero: at first the block passes its input on (AdaLN-zero).
    """

    def __init__(self, width: int):
        super().__init__()
        self.mlp = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.modulation = zeroed(nn.Linear(width, 3 * width))

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """x and condition (B, H, width) -> (B, H, width)."""
        shift, scale, gate = self.modulation(F.silu(condition)).chunk(3, dim=-1)
        return x + gate * self.mlp(F.layer_norm(x, x.shape[-1:], eps=1e-6) * (1 + scale) + shift)


def zeroed(layer: nn.Linear) -> nn.Linear:
    """The same layer with all its weights at zero."""
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


class DiffusionHead(nn.Module):
    """Predicts the noise in each action by itself, from what the decoder says about its place."""

    BLOCKS = 3

    def __init__(self, config: PolicyConfig):
        super().__init__()
        W, width = config.unet_widths
        self.horizon, self.timestep_dim = config.horizon, config.timestep_dim
        self.project_x = nn.Linear(config.action_dim, width)
        self.project_z = nn.Linear(W, width)
        self.project_cutoff = nn.Linear(1, width)
        self.timestep_mlp = nn.Sequential(
            nn.Linear(config.timestep_dim, width), nn.SiLU(), nn.Linear(width, width)
        )
        self.blocks = nn.ModuleList(ModulatedMLP(width) for _ in range(self.BLOCKS))
        self.modulation = zeroed(nn.Linear(width, 2 * width))
        self.out = zeroed(nn.Linear(width, config.action_dim))

    def forward(self, noisy: Tensor, timesteps: Tensor, z: Tensor, cutoffs: Tensor) -> Tensor:
        """noisy (B, H, A), timesteps (B, H), z (B, H, W), cutoffs (B,) -> noise (B, H, A)."""
        share = (cutoffs / self.horizon)[:, None, None].to(z.dtype)  # (B, 1, 1)
        k = self.timestep_mlp(sinusoids(timesteps, self.timestep_dim).to(z.dtype))
        condition = k + self.project_z(z) + self.project_cutoff(share)  # (B, H, width)
        x = self.project_x(noisy)  # (B, H, width)
        for block in self.blocks:
            x = block(x, condition)
        shift, scale = self.modulation(F.silu(condition)).chunk(2, dim=-1)
        return self.out(F.layer_norm(x, x.shape[-1:], eps=1e-6) * (1 + scale) + shift)


class FrequencyTransformer(nn.Module):
    """FreqPolicy's network alone: a masked autoencoder over the H actions, and a diffusion head.

    The sequence is [To observations | cut-off | H actions]. The encoder sees the actions that are
    not hidden, the decoder a learned token in place of those that are. Of the configuration it
    reads `unet_widths` as its own width and the head's.
    """

    LAYERS = 4  # of the encoder, and of the decoder
    HEADS = 8

    def __init__(self, config: PolicyConfig):
        super().__init__()
        if config.policy != "freq":
            raise ConfigError(f"frequency-transformer is the denoiser of freq, not {config.policy}")
        if len(config.unet_widths) != 2:
            raise ConfigError(f"freq takes two widths, Transformer and head: {config.unet_widths}")
        H, W, prefix = config.horizon, config.unet_widths[0], config.n_obs_steps + 1
        self.register_buffer("dct", dct_matrix(H).float(), persistent=False)
        self.project_observation = nn.Linear(config.observation_feature_dim, W)
        self.project_cutoff = nn.Linear(1, W)
        self.project_action = nn.Linear(config.action_dim, W)
        self.encoder_positions = nn.Parameter(0.02 * torch.randn(prefix + H, W))
        self.decoder_positions = nn.Parameter(0.02 * torch.randn(prefix + H, W))
        self.head_positions = nn.Parameter(0.02 * torch.randn(H, W))
        self.hidden_token = nn.Parameter(0.02 * torch.randn(W))
        self.encoder = nn.ModuleList(MaskedBlock(W, self.HEADS) for _ in range(self.LAYERS))
        self.decoder = nn.ModuleList(TransformerBlock(W, self.HEADS) for _ in range(self.LAYERS))
        self.norm_in = nn.LayerNorm(W)
        self.norm_encoder = nn.LayerNorm(W)
        self.norm_decoder = nn.LayerNorm(W)
        self.project_decoder = nn.Linear(W, W)
        self.head = DiffusionHead(config)

    def low_pass(self, actions: Tensor, cutoffs: Tensor) -> Tensor:
        """(B, H, A) -> (B, H, A): what the first c of H frequencies make, cutoffs c (B,) int64."""
        dct = self.dct.to(actions.dtype)
        kept = torch.arange(len(dct), device=actions.device) < cutoffs[:, None]  # (B, H)
        return dct.T @ (kept[..., None] * (dct @ actions))

    def forward(self, observation: Tensor, low: Tensor, mask: Tensor, cutoffs: Tensor) -> Tensor:
        """observation (B, To, feature), low (B, H, A), mask (B, H), cutoffs (B,) -> z (B, H, W)."""
        share = (cutoffs / low.shape[1])[:, None, None].to(low.dtype)  # (B, 1, 1)
        tokens = [
            self.project_observation(observation),
            self.project_cutoff(share),
            self.project_action(low),
        ]
        x = torch.cat(tokens, dim=1)  # (B, To + 1 + H, W)
        visible = torch.zeros_like(observation[..., 0], dtype=torch.bool)  # (B, To)
        hidden = torch.cat([visible, visible[:, :1], mask], dim=1)  # (B, To + 1 + H)

        x = self.norm_in(x + self.encoder_positions)
        for block in self.encoder:
            x = block(x, hidden)
        x = self.project_decoder(self.norm_encoder(x))
        x = torch.where(hidden[..., None], self.hidden_token, x) + self.decoder_positions
        for block in self.decoder:
            x = block(x)
        return self.norm_decoder(x)[:, -low.shape[1] :] + self.head_positions  # (B, H, W)


class FreqPolicy(DP3Policy):
    """Masked autoregression over frequencies (Zhong et al., arXiv 2506.01583).

    Training: the Transformer sees an action chunk reduced to its first c frequencies, c from 0 to
    H, with most of its places hidden. A diffusion head recovers each of the clean actions.
    Sampling: four rounds, with c = 0, 5, 10, 16 of 16. Each sees the low frequencies of the actions
    of the round before, and in each fewer places are hidden.

    Left open, and chosen: condition tokens stand in the sequence (the code also attends to them
    separately, and has gated MLPs); the share of hidden places is drawn for each window (there: for
    each batch); the head learns the noise and no variance, reads c / H, and takes ten deterministic
    DDIM steps (`small`: five) whose clean action is clipped (there: ten random ones, unclipped).
    Within the head, the cut-off is added to the condition (there: concatenated), and timestep
    features, initialization and LayerNorms, which have no weights, are this project's.
    """

    requires: ClassVar = {
        **DP3Policy.requires,
        "denoiser": "frequency-transformer",
        "sampler": "ddim",
    }
    conditioned_by_h = False  # its network embeds timesteps and observations itself

    ROUNDS = 4
    LEAST_HIDDEN, DEVIATION = 0.7, 0.25  # of the share of hidden places, see below

    def draw_noise_and_timesteps(self, n: int, generator: Generator) -> dict[str, Tensor]:
        """Draws noise (n, H, A), timesteps (n, H), cutoffs (n,), mask (n, H) of n windows."""
        H, A, K = self.config.horizon, self.config.action_dim, self.config.diffusion_steps

        def uniform(*shape: int) -> Tensor:
            return draw(torch.rand, *shape, like=self.normalizer.action_scale, generator=generator)

        noise = draw(torch.randn, n, H, A, like=self.normalizer.action_scale, generator=generator)
        timesteps = (K * uniform(n, H)).long().clamp(max=K - 1)
        cutoffs = ((H + 1) * uniform(n)).long().clamp(max=H)
        # The normal distribution around 1, cut to [LEAST_HIDDEN, 1], by the inverse of its
        # distribution function, which is `below` at the lower end and 1 / 2 at the upper one.
        lowest = torch.tensor((self.LEAST_HIDDEN - 1) / self.DEVIATION, device=noise.device)
        below = torch.special.ndtr(lowest)
        quantile = below + (0.5 - below) * uniform(n)
        share = 1 + self.DEVIATION * torch.special.ndtri(quantile)  # (n,)
        rank = uniform(n, H).argsort(dim=1)  # (n, H)
        mask = rank < (H * share).ceil()[:, None]
        return {"noise": noise, "timesteps": timesteps, "cutoffs": cutoffs, "mask": mask}

    def shapes(self) -> dict[str, tuple[int | str, ...]]:
        H = self.config.horizon
        return {**super().shapes(), "timesteps": ("B", H), "cutoffs": ("B",), "mask": ("B", H)}

    def loss(
        self,
        points: Tensor,
        state: Tensor,
        action: Tensor,
        noise: Tensor,
        timesteps: Tensor,
        cutoffs: Tensor,
        mask: Tensor,
        **task: Tensor,
    ) -> Tensor:
        """Squared error of the predicted noise, () float; arguments as of `DAMIPolicy.loss`.

        timesteps (B, H) int64: each action has its own; cutoffs (B,) int64; mask (B, H) bool, true
        for hidden places. Of `task` nothing is read.
        """
        self.encode_demo(**task)  # encodes nothing; refuses what is no input of a task
        self.check_shapes(
            points=points,
            state=state,
            action=action,
            noise=noise,
            timesteps=timesteps,
            cutoffs=cutoffs,
            mask=mask,
        )
        clean = self.normalizer.normalize("action", action)  # A_0, (B, H, A)
        noisy = self.schedule.add_noise(  # each action has its own timestep
            clean.flatten(0, 1)[:, None],  # (B * H, 1, A)
            noise.flatten(0, 1)[:, None],
            timesteps.flatten(),
        ).view_as(clean)  # (B, H, A)
        observation = self.encode_observations(points, state)  # (B, To, feature)
        low = self.denoiser.low_pass(clean, cutoffs)  # (B, H, A)
        z = self.denoiser(observation, low, mask, cutoffs)  # (B, H, W)
        return F.mse_loss(self.denoiser.head(noisy, timesteps, z, cutoffs), noise)

    @torch.no_grad()
    def sample_actions(
        self, points: Tensor, state: Tensor, context: Context, generator: Generator | None = None
    ) -> Tensor:
        """Draws an action chunk (B, Ta, A) in four rounds, from low frequencies to all of them."""
        self.check_shapes(points=points, state=state)
        observation = self.encode_observations(points, state)  # (B, To, feature)
        B, H, A = len(points), self.config.horizon, self.config.action_dim
        order = draw(torch.rand, B, H, like=points, generator=generator)  # (B, H)
        rank = order.argsort(dim=1)  # (B, H): places of high rank are shown first
        actions = torch.zeros(B, H, A, device=points.device)

        for done in range(self.ROUNDS):
            cutoffs = torch.full((B,), done * H // (self.ROUNDS - 1), device=points.device)
            mask = rank < int(H * math.cos(math.pi / 2 * done / self.ROUNDS))  # 16, 14, 11, 6 of 16
            low = self.denoiser.low_pass(actions, cutoffs)
            z = self.denoiser(observation, low, mask, cutoffs)  # (B, H, W)
            actions = draw(torch.randn, B, H, A, like=points, generator=generator)
            for k in self.schedule.timesteps():
                timesteps = torch.full((B, H), k, device=points.device)
                noise = self.denoiser.head(actions, timesteps, z, cutoffs)
                a = self.schedule.alphas_cumprod[k]
                clean = (actions - (1 - a).sqrt() * noise) / a.sqrt()
                actions = self.schedule.step(clean, k, actions)
        return self.select_action_chunk(actions)


# ---- The ablation of VMT -------------------------------------------------------------------------


class DemonstrationMLP(nn.Module):
    """What stands in for VMT in the ablation: an MLP on every frame, averaged over time."""

    def __init__(self, config: PolicyConfig):
        super().__init__()
        width = config.demo_dim
        d_in = config.observation_feature_dim + config.action_dim
        self.mlp = nn.Sequential(nn.Linear(d_in, width), nn.ReLU(), nn.Linear(width, width))

    def forward(self, features: Tensor, actions: Tensor) -> Tensor:
        """features (D, T, feature), actions (D, T, A) -> one token (D, 1, demo_dim)."""
        return self.mlp(torch.cat([features, actions], dim=-1)).mean(dim=1, keepdim=True)


# ---- Names, presets and sizes --------------------------------------------------------------------

POLICIES["flow"] = FlowPolicy
POLICIES["mamba"] = MambaPolicy
POLICIES["freq"] = FreqPolicy
denoisers["mamba-unet"] = MambaUNet1d
denoisers["frequency-transformer"] = FrequencyTransformer
demo_encoders["mlp"] = DemonstrationMLP


def preset(policy: str, size: str, **changes: Any) -> PolicyConfig:
    """DAMI's preset of a size, with what a policy requires of its configuration, and `changes`."""
    required = POLICIES[policy].requires
    return replace(model.PRESETS[size], policy=policy, **required, **changes)


SHORT_CHUNKS = {"horizon": 4, "n_action_steps": 3}  # of FlowPolicy and Mamba Policy

# The configurations by policy and preset. `paper`: as the published code is run; `small`: about
# 3 million parameters, as many as DAMI's.
PRESETS = {
    "dami": model.PRESETS,
    "dp3": {
        "paper": preset("dp3", "paper"),
        "small": preset("dp3", "small", unet_widths=(48, 96, 192)),
        "tiny": preset("dp3", "tiny"),
    },
    "flow": {
        "paper": preset("flow", "paper", **SHORT_CHUNKS),
        "small": preset("flow", "small", **SHORT_CHUNKS, unet_widths=(48, 96, 192)),
        "tiny": preset("flow", "tiny", **SHORT_CHUNKS),
    },
    "mamba": {
        "paper": preset("mamba", "paper", **SHORT_CHUNKS, unet_widths=(128, 256, 512)),
        "small": preset("mamba", "small", **SHORT_CHUNKS, unet_widths=(32, 64, 112)),
        "tiny": preset("mamba", "tiny", **SHORT_CHUNKS),
    },
    "freq": {
        "paper": preset("freq", "paper", unet_widths=(512, 1024)),
        "small": preset("freq", "small", unet_widths=(128, 256)),
        "tiny": preset("freq", "tiny", unet_widths=(32, 64)),
    },
}


def main() -> None:
    """Prints the size of each policy and preset."""
    argparse.ArgumentParser(description=main.__doc__).parse_args()
    print(f"{'parameters':<10} " + " ".join(f"{preset:>13}" for preset in model.PRESETS))
    for name, presets in PRESETS.items():
        sizes = []
        for config in presets.values():
            with torch.device("meta"):  # weights are neither drawn nor stored
                policy = build_policy(config)
            sizes.append(sum(p.numel() for p in policy.parameters()))
        print(f"{name:<10} " + " ".join(f"{size:>13,}" for size in sizes))


if __name__ == "__main__":
    main()
