r"""The policy: what it reads, how it turns that into actions, how it is kept.

    instruction ---> CLIP's text feature (clip.py) --------------------\
    demonstration -> observation encoder -> VMT (demonstration tokens) -+-> U2T -> first level -\
    two observations -> observation encoder --\                         |                       |
    diffusion timestep k -> embedding ---------+-> MLP -> h_k ----------+---> other levels -----+
                                                                                                |
    noisy actions A_k ------------------------------> U-Net, modulated by FiLM (TCFM) <---------/
                                                        \-> clean actions A_0

VMT: visual-motor trajectory encoder. U2T: unpaired unified task encoder. TCFM: task-conditioned
feature modulation. FiLM: feature-wise linear modulation.
The file reads from small blocks to `DAMIPolicy` and imports nothing of the project. Its last
section, PyTorch's layers written out for speed, can be skipped.

Letters: B windows, G windows that share one demonstration, D demonstrations (B = D * G), T frames
of a demonstration, N points (R critical ones), P = 3 numbers of a point, To = 2 observations (the
older first), H = 16 horizon, Ta = 8 executed actions, A action dim, S state dim, K = 100 diffusion
steps, C condition width (timestep_dim + To * observation feature), L length of the action sequence
inside the U-Net (H, then half of it a level). The first three numbers of a point are its position;
others are features such as colours in [0, 1], and there are none by default. Positions and poses
are in metres; networks see [-1, 1].
"""

import math
import os
import tempfile
import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, Protocol

import torch
import torch.nn.functional as F
from torch import Generator, Tensor, nn
from torch.func import functional_call
from torch.optim.swa_utils import AveragedModel

# ---- Configuration -------------------------------------------------------------------------------

# The classes that a configuration can name. Each is registered below its definition, and those of
# baselines.py when that file is imported.
#
# Encoders of demonstrations, by `PolicyConfig.demo_encoder`. Each is built from a PolicyConfig and
# called as VisualMotorTrajectory is; it may return another number of tokens than there are frames,
# up to `demo_positions`.
demo_encoders: dict[str, type[nn.Module]] = {}
# Networks, by `PolicyConfig.denoiser`. Each is built from a PolicyConfig and called as
# ConditionalUNet1d is, with `fused` only where the configuration reads a task. Another network is a
# class and a line.
denoisers: dict[str, type[nn.Module]] = {}
# Policies, by `PolicyConfig.policy`.
POLICIES: dict[str, type["DAMIPolicy"]] = {}


def choices() -> dict[str, tuple[str, ...]]:
    """Field of `PolicyConfig` -> the names that it may hold, registered ones among them."""
    return {
        "policy": tuple(POLICIES),
        "denoiser": tuple(denoisers),
        "demo_encoder": (*demo_encoders, "none"),
        "tcfm": ("down", "mid", "up", "none"),
        "sampler": ("ddim", "dp3"),
    }


class ConfigError(ValueError):
    """A configuration contradicts itself, or names parts that do not fit together."""


@dataclass(frozen=True)
class PolicyConfig:
    """The whole architecture, from which a checkpoint's policy is rebuilt.

    The defaults are the paper's values. Where it gives none they are DP3's (PointNet, the U-Net's
    widths, the sampler) or our own choice (`u2t_layers`).
    """

    policy: str = "dami"  # dami | dp3, and of baselines.py flow | mamba | freq; see `POLICIES`
    state_dim: int = 9  # S: end effector, right finger, left finger, metres
    action_dim: int = 4  # A: dx, dy, dz, gripper
    num_points: int = 512  # N
    point_dim: int = 3  # P: a position, and features such as colours in [0, 1]
    horizon: int = 16  # H, the actions of a window
    n_obs_steps: int = 2  # To
    n_action_steps: int = 8  # Ta, executed before the policy looks again
    pointnet_widths: tuple[int, ...] = (64, 128, 256)
    point_feature_dim: int = 64
    state_feature_dim: int = 64
    demo_encoder: str = "vmt"  # vmt | none, and of baselines.py mlp; see `demo_encoders`
    demo_stride: int = 1  # the demonstration encoder reads every demo_stride-th frame
    demo_positions: int = 200  # learned positions: the longest demonstration, after the stride
    demo_dim: int = 128  # the paper's table calls it "Action Dim"
    vmt_layers: int = 2
    vmt_heads: int = 4
    tcfm: str = "down"  # which level of the denoiser reads U2T's output: down | mid | up | none
    u2t_layers: int = 1
    u2t_heads: int = 8
    text_dim: int = 512
    timestep_dim: int = 128
    denoiser: str = "unet"  # or of baselines.py mamba-unet | frequency-transformer
    unet_widths: tuple[int, ...] = (512, 1024, 2048)
    kernel_size: int = 5
    n_groups: int = 8
    diffusion_steps: int = 100  # K
    inference_steps: int = 10
    sampler: str = "dp3"  # ddim | dp3, see DiffusionSchedule.step

    def __post_init__(self):
        # JSON brings lists back where tuples went in.
        object.__setattr__(self, "pointnet_widths", tuple(self.pointnet_widths))
        object.__setattr__(self, "unet_widths", tuple(self.unet_widths))
        self.check_fields()
        self.check_relations()

    def check_fields(self) -> None:
        """Raises ConfigError for a field whose value no policy can have."""
        for name, known in choices().items():
            value = getattr(self, name)
            if value not in known:
                raise ConfigError(f"{name} is {value!r}; use one of {', '.join(known)}")
        for field in fields(self):
            value = getattr(self, field.name)
            numbers = value if isinstance(value, tuple) else (value,)
            if field.type is not str and not all(is_size(number) for number in numbers):
                raise ConfigError(f"{field.name} is {value!r}: use whole numbers from 1 to 100000")
            if value == ():
                raise ConfigError(f"{field.name} is (): use at least one width")
        for name in ("vmt_layers", "u2t_layers"):
            if getattr(self, name) > 99:
                raise ConfigError(f"{name} is {getattr(self, name)}: use at most 99")
        if self.point_dim < 3:
            raise ConfigError(f"point_dim is {self.point_dim}: a position alone has 3 numbers")
        if self.timestep_dim < 4 or self.timestep_dim % 2:
            raise ConfigError(f"timestep_dim is {self.timestep_dim}: use an even one, at least 4")
        if self.kernel_size % 2 == 0:
            raise ConfigError(f"kernel_size is {self.kernel_size}: use an odd one")

    def check_relations(self) -> None:
        """Raises ConfigError, which names both, for two fields that contradict each other."""
        H, To, Ta = self.horizon, self.n_obs_steps, self.n_action_steps
        most = H - To + 1
        if Ta > most:
            raise ConfigError(
                f"n_action_steps is {Ta}: of horizon {H} there are {most} actions from the newest "
                f"of n_obs_steps {To} on"
            )
        if self.diffusion_steps % self.inference_steps:
            raise ConfigError(
                f"diffusion_steps {self.diffusion_steps} is no multiple of "
                f"inference_steps {self.inference_steps}"
            )
        if self.demo_dim % self.vmt_heads:
            raise ConfigError(
                f"demo_dim {self.demo_dim} is no multiple of vmt_heads {self.vmt_heads}"
            )
        if self.condition_dim % self.u2t_heads:
            raise ConfigError(
                f"the condition's width {self.condition_dim} (timestep_dim and To observation "
                f"features) is no multiple of u2t_heads {self.u2t_heads}"
            )
        if self.denoiser not in ("unet", "mamba-unet"):
            return
        levels = len(self.unet_widths)
        if H % 2 ** (levels - 1):
            raise ConfigError(
                f"horizon {H} is no multiple of {2 ** (levels - 1)}: it is halved between the "
                f"{levels} levels of unet_widths"
            )
        if self.tcfm == "up" and levels == 1:
            raise ConfigError(
                f"tcfm is 'up', and unet_widths {self.unet_widths} have no up-sampling level"
            )
        for width in self.unet_widths:
            if width % self.n_groups:
                raise ConfigError(f"unet_widths {width} is no multiple of n_groups {self.n_groups}")

    @property
    def observation_feature_dim(self) -> int:
        return self.point_feature_dim + self.state_feature_dim

    @property
    def condition_dim(self) -> int:
        """C, the width of h_k and of U2T."""
        return self.timestep_dim + self.n_obs_steps * self.observation_feature_dim

    @property
    def reads_demonstration(self) -> bool:
        return self.demo_encoder != "none"

    @property
    def reads_task(self) -> bool:
        """Whether the policy reads an instruction or a demonstration; without, it is DP3's."""
        return self.reads_demonstration or self.tcfm != "none"


def is_size(value: Any) -> bool:
    return isinstance(value, int) and 1 <= value <= 100_000


# ---- Attention: one block for VMT and U2T --------------------------------------------------------


class Attention(nn.Module):
    """Multi-head softmax attention, written out: fused kernels have no double backward."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        if width % heads:
            raise ConfigError(f"an attention of width {width} cannot have {heads} heads")
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)

    def project(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(B, T, width) -> queries, keys and values, each (B, heads, T, width / heads)."""
        parts = self.qkv(x).chunk(3, dim=-1)  # 3 x (B, T, width)
        return tuple(z.unflatten(-1, (self.heads, -1)).transpose(1, 2) for z in parts)

    def merge(self, x: Tensor) -> Tensor:
        """(B, heads, T, width / heads) -> (B, T, width), mixed over the heads."""
        return self.out(x.transpose(1, 2).flatten(2))

    def forward(self, x: Tensor) -> Tensor:
        """(B, T, width) -> (B, T, width); every token looks at every other."""
        q, k, v = self.project(x)
        scores = q @ k.transpose(-2, -1) * q.shape[-1] ** -0.5  # (B, heads, T, T)
        return self.merge(scores.softmax(dim=-1) @ v)  # (B, T, width)


class TransformerBlock(nn.Module):
    """Pre-norm residual block: attention, then an MLP four times as wide."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.norm1 = nn.LayerNorm(width)
        self.attention = Attention(width, heads)
        self.norm2 = nn.LayerNorm(width)
        wide = 4 * width
        self.mlp = nn.Sequential(nn.Linear(width, wide), nn.GELU(), nn.Linear(wide, width))

    def forward(self, x: Tensor) -> Tensor:
        """(B, T, width) -> (B, T, width)."""
        x = x + self.attention(self.norm1(x))
        return x + self.mlp(self.norm2(x))


# ---- Observation ---------------------------------------------------------------------------------


class PointNetEncoder(nn.Module):
    """A cloud to one feature: the same MLP on every point, the maximum over points, a projection.

    Only the maximum over the points is kept, so their order does not matter. Only points that have
    the maximum in some channel, PointNet's critical points, have a gradient, so only they are
    differentiated, see `CriticalPoints`.
    """

    def __init__(
        self, widths: tuple[int, ...] = (64, 128, 256), feature_dim: int = 64, point_dim: int = 3
    ):
        super().__init__()
        layers = []
        for d_in, d_out in pairwise((point_dim, *widths)):
            layers += [nn.Linear(d_in, d_out), nn.LayerNorm(d_out), nn.ReLU()]
        self.mlp = nn.Sequential(*layers)
        self.projection = nn.Sequential(
            nn.Linear(widths[-1], feature_dim), nn.LayerNorm(feature_dim)
        )

    def forward(self, points: Tensor) -> Tensor:
        """(..., N, P) float, normalized -> (..., feature_dim)."""
        if not torch.is_grad_enabled():
            largest = self.mlp(points).amax(dim=-2)  # (..., widths[-1])
        else:  # the same numbers, but only the critical points go through the differentiated MLP
            # rows (R,): the critical points, as indices into all clouds' points; place (clouds,
            # widths[-1]): for each maximum, the index of its point in `rows`
            rows, place = CriticalPoints.apply(points, *self.mlp.parameters())
            critical = points.flatten(0, -2)[rows]  # (R, P)
            largest = self.mlp(critical).gather(0, place)  # (clouds, widths[-1])
            largest = largest.view(*points.shape[:-2], -1)  # (..., widths[-1])
        return self.projection(largest)  # (..., feature_dim)


class ObservationEncoder(nn.Module):
    """A frame to one feature: PointNet on the cloud, an MLP on the robot's state, concatenated."""

    def __init__(self, config: PolicyConfig):
        super().__init__()
        self.pointnet = PointNetEncoder(
            config.pointnet_widths, config.point_feature_dim, config.point_dim
        )
        S, width = config.state_dim, config.state_feature_dim
        self.state_mlp = nn.Sequential(nn.Linear(S, width), nn.ReLU(), nn.Linear(width, width))

    def forward(self, points: Tensor, state: Tensor) -> Tensor:
        """points (..., N, P), state (..., S), normalized -> (..., observation_feature_dim)."""
        return torch.cat([self.pointnet(points), self.state_mlp(state)], dim=-1)


# ---- The reference demonstration -----------------------------------------------------------------


class VisualMotorTrajectory(nn.Module):
    """VMT: a Transformer over a demonstration's frames, each what was seen and done (Eqs. 4-5)."""

    def __init__(self, config: PolicyConfig):
        super().__init__()
        width = config.demo_dim
        self.projection = nn.Linear(config.observation_feature_dim + config.action_dim, width)
        self.positions = nn.Parameter(0.02 * torch.randn(config.demo_positions, width))
        blocks = (TransformerBlock(width, config.vmt_heads) for _ in range(config.vmt_layers))
        self.blocks = nn.Sequential(*blocks)

    def forward(self, features: Tensor, actions: Tensor) -> Tensor:
        """features (D, T, feature), actions (D, T, A) -> tokens (D, T, demo_dim)."""
        x = self.projection(torch.cat([features, actions], dim=-1))  # (D, T, demo_dim)   Eq. 4
        x = x + self.positions[: x.shape[1]]
        return self.blocks(x)  # Eq. 5


demo_encoders["vmt"] = VisualMotorTrajectory


class UnpairedUnifiedTask(nn.Module):
    """U2T: fuses demonstration, instruction and h_k, and returns h_k's token (Eqs. 6 and 8).

    The sequence is [demonstration tokens | text token | h_k]. The first two are the same for all
    windows and diffusion steps of a task. With one layer (the default) their keys and values
    therefore depend on the task alone: `encode_context` computes them once, and every window
    attends to the same ones. More layers mix the tokens and run on the full sequence.
    """

    def __init__(self, config: PolicyConfig):
        super().__init__()
        demo, text, width = config.demo_dim, config.text_dim, config.condition_dim
        if config.reads_demonstration:
            self.demo_projection = nn.Sequential(nn.LayerNorm(demo), nn.Linear(demo, width))
            self.demo_positions = nn.Parameter(0.02 * torch.randn(config.demo_positions, width))
        self.text_projection = nn.Sequential(nn.LayerNorm(text), nn.Linear(text, width))
        self.text_position = nn.Parameter(0.02 * torch.randn(1, width))
        blocks = (TransformerBlock(width, config.u2t_heads) for _ in range(config.u2t_layers))
        self.blocks = nn.Sequential(*blocks)

    def embed(self, demo_tokens: Tensor | None, text: Tensor) -> Tensor:
        """demo_tokens (D, T, demo_dim) or None, text (D, text_dim) -> tokens (D, T + 1, C)."""
        tokens = self.text_projection(text)[:, None] + self.text_position  # (D, 1, C)   Eq. 6
        if demo_tokens is not None:
            demo = self.demo_projection(demo_tokens) + self.demo_positions[: demo_tokens.shape[1]]
            tokens = torch.cat([demo, tokens], dim=1)  # (D, T, C) before (D, 1, C)
        return tokens

    def encode_context(self, demo_tokens: Tensor | None, text: Tensor) -> tuple[Tensor, ...]:
        """Returns what all windows of a task share, for D tasks.

        With one layer these are the keys and the values of the tasks' tokens, each
        (D, heads, T + 1, C / heads); with more, the tokens (D, T + 1, C).
        """
        tokens = self.embed(demo_tokens, text)
        if len(self.blocks) > 1:
            return (tokens,)
        _, k, v = self.blocks[0].attention.project(self.blocks[0].norm1(tokens))
        return k, v

    def forward(self, h: Tensor, context: tuple[Tensor, ...]) -> Tensor:
        """h_k (B, C) and the context of D = B / G tasks -> the fused condition (B, C).

        Windows are ordered by task: window i belongs to demonstration i // G.
        """
        if len(self.blocks) > 1:
            tokens = context[0].repeat_interleave(len(h) // len(context[0]), dim=0)  # (B, T + 1, C)
            x = torch.cat([tokens, h[:, None]], dim=1)  # (B, T + 2, C)
            return self.blocks(x)[:, -1]

        # The block's own forward, for the last token alone, with keys and values of the task shared
        block = self.blocks[0]
        attention = block.attention
        keys, values = context  # (D, heads, T + 1, d), with d = C / heads
        x = h.unflatten(0, (len(keys), -1))  # (D, G, C): the windows of a task, beside each other
        q, own_key, own_value = attention.project(block.norm1(x))  # (D, heads, G, d)

        # Each window's h_k attends to the task's tokens and to itself.
        to_task = q @ keys.transpose(-2, -1)  # (D, heads, G, T + 1)
        to_itself = (q * own_key).sum(-1, keepdim=True)  # (D, heads, G, 1)
        scores = torch.cat([to_task, to_itself], dim=-1) * q.shape[-1] ** -0.5
        weights = scores.softmax(dim=-1)  # (D, heads, G, T + 2)
        fused = weights[..., :-1] @ values + weights[..., -1:] * own_value  # (D, heads, G, d)

        x = x + attention.merge(fused)  # (D, G, C)
        x = x + block.mlp(block.norm2(x))
        return x.flatten(0, 1)  # (B, C)   Eq. 8


class PooledTask(nn.Module):
    """What stands in for U2T in the ablation's rows without TCFM, "Baseline" (mlp) and "+ VMT".

    The paper does not say how a demonstration enters there. Here its tokens, averaged over time,
    and the instruction go through one linear layer and are added to h_k, for every level.
    """

    def __init__(self, config: PolicyConfig):
        super().__init__()
        self.projection = nn.Linear(config.demo_dim + config.text_dim, config.condition_dim)

    def encode_context(self, demo_tokens: Tensor, text: Tensor) -> tuple[Tensor, ...]:
        """demo_tokens (D, T, demo_dim), text (D, text_dim) -> ((D, C),)."""
        return (self.projection(torch.cat([demo_tokens.mean(dim=1), text], dim=-1)),)

    def forward(self, h: Tensor, context: tuple[Tensor, ...]) -> Tensor:
        """h_k (B, C) and the context of D = B / G tasks -> (B, C)."""
        return h + context[0].repeat_interleave(len(h) // len(context[0]), dim=0)


# ---- h_k, and the denoiser that it modulates -----------------------------------------------------


def sinusoids(timesteps: Tensor, dim: int) -> Tensor:
    """(...) of any dtype -> (..., dim): sines, then cosines, of geometrically falling rates."""
    half = dim // 2
    exponents = torch.arange(half, device=timesteps.device) * (-math.log(10000) / (half - 1))
    angles = timesteps[..., None] * exponents.exp()  # (..., dim / 2)
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


class ConditionEncoder(nn.Module):
    """h_k = MLP([embedding of the diffusion timestep, observation features])   (Eq. 7).

    DP3 has no such MLP: where no task is read, h_k is the concatenation itself.
    """

    def __init__(self, config: PolicyConfig):
        super().__init__()
        self.timestep_dim = config.timestep_dim
        width, C = config.timestep_dim, config.condition_dim
        self.timestep_mlp = nn.Sequential(
            nn.Linear(width, 4 * width), Mish(), nn.Linear(4 * width, width)
        )
        # It is built even where it is not used: building it draws random numbers, without which a
        # seed would give all later layers other weights than the published policies began with.
        condition_mlp = nn.Sequential(nn.Linear(C, C), Mish(), nn.Linear(C, C))
        self.condition_mlp = condition_mlp if config.reads_task else nn.Identity()

    def forward(self, timesteps: Tensor, observation: Tensor) -> Tensor:
        """timesteps (B,), observation (B, To * feature) -> h_k (B, C)."""
        embedding = sinusoids(timesteps, self.timestep_dim)  # (B, timestep_dim)
        embedding = self.timestep_mlp(embedding.to(observation.dtype))
        return self.condition_mlp(torch.cat([embedding, observation], dim=-1))


class ConvBlock(nn.Sequential):
    """Conv1d, GroupNorm, Mish: PyTorch's layers, written out for speed at the end of this file.

    Their Conv1d pads, so that the length L stays.
    """

    def __init__(self, d_in: int, d_out: int, kernel_size: int, n_groups: int):
        super().__init__(Conv1d(d_in, d_out, kernel_size), GroupNorm(n_groups, d_out), Mish())


class ResidualBlock(nn.Module):
    """Two convolutions; the feature between them is modulated by the condition (FiLM, Eq. 9)."""

    def __init__(self, d_in: int, d_out: int, config: PolicyConfig):
        super().__init__()
        self.conv1 = ConvBlock(d_in, d_out, config.kernel_size, config.n_groups)
        self.film = nn.Sequential(Mish(), nn.Linear(config.condition_dim, 2 * d_out))
        self.conv2 = ConvBlock(d_out, d_out, config.kernel_size, config.n_groups)
        self.residual = nn.Conv1d(d_in, d_out, 1) if d_in != d_out else nn.Identity()

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """x (B, d_in, L), condition (B, C) -> (B, d_out, L)."""
        scale, bias = self.film(condition)[..., None].chunk(2, dim=1)  # 2 x (B, d_out, 1)
        return self.conv2(scale * self.conv1(x) + bias) + self.residual(x)


class ConditionalUNet1d(nn.Module):
    """DP3's 1D U-Net over time, with task-conditioned feature modulation (TCFM).

    Every residual block is modulated by h_k, but for the two blocks of the level that `tcfm` names,
    which take U2T's output (Eq. 10): the first down-sampling level (`down`, the paper's), the
    middle (`mid`) or the last up-sampling level (`up`).
    """

    def __init__(self, config: PolicyConfig):
        super().__init__()
        self.tcfm = config.tcfm
        widths = config.unet_widths
        self.down = nn.ModuleList()
        for level, (d_in, d_out) in enumerate(pairwise((config.action_dim, *widths))):
            if level < len(widths) - 1:
                downsample = nn.Conv1d(d_out, d_out, 3, stride=2, padding=1)
            else:
                downsample = nn.Identity()
            block1 = ResidualBlock(d_in, d_out, config)
            block2 = ResidualBlock(d_out, d_out, config)
            self.down.append(nn.ModuleList([block1, block2, downsample]))

        self.mid = nn.ModuleList(ResidualBlock(widths[-1], widths[-1], config) for _ in range(2))
        self.up = nn.ModuleList()
        for below, width in pairwise(reversed(widths)):
            # `below` channels come up from the level below, and as many from the skip connection
            block1 = ResidualBlock(2 * below, width, config)
            block2 = ResidualBlock(width, width, config)
            upsample = nn.ConvTranspose1d(width, width, 4, stride=2, padding=1)
            self.up.append(nn.ModuleList([block1, block2, upsample]))
        self.head = nn.Sequential(
            ConvBlock(widths[0], widths[0], config.kernel_size, config.n_groups),
            nn.Conv1d(widths[0], config.action_dim, 1),
        )

    def forward(self, actions: Tensor, h: Tensor, fused: Tensor | None = None) -> Tensor:
        """Noisy actions (B, H, A), h_k (B, C), U2T's output (B, C) -> clean actions (B, H, A)."""
        conditions = {"down": h, "mid": h, "up": h}
        if fused is not None:
            conditions[self.tcfm] = fused  # Eq. 10
        x = actions.transpose(1, 2)  # (B, A, H)
        skips = []
        for level, (block1, block2, downsample) in enumerate(self.down):
            c = conditions["down"] if level == 0 else h
            x = block2(block1(x, c), c)  # (B, width, L)
            skips.append(x)
            x = downsample(x)  # (B, width, L / 2), but for the last level
        for block in self.mid:
            x = block(x, conditions["mid"])
        # There is one level less on the way up. As in DP3, the first level's skip stays unused.
        for level, (block1, block2, upsample) in enumerate(self.up):
            c = conditions["up"] if level == len(self.up) - 1 else h
            x = torch.cat([x, skips.pop()], dim=1)  # (B, 2 width, L)
            x = upsample(block2(block1(x, c), c))  # (B, width above, 2 L)
        return self.head(x).transpose(1, 2)  # (B, H, A)


denoisers["unet"] = ConditionalUNet1d


# ---- Diffusion and normalization -----------------------------------------------------------------


class DiffusionSchedule(nn.Module):
    """Forward noising and deterministic DDIM sampling, with networks that predict the clean sample.

    Betas follow the squared-cosine schedule of improved DDPM, capped at 0.999.
    """

    def __init__(self, diffusion_steps: int = 100, inference_steps: int = 10, sampler: str = "dp3"):
        super().__init__()
        self.sampler = sampler
        self.stride = diffusion_steps // inference_steps
        t = torch.arange(diffusion_steps + 1, dtype=torch.float64) / diffusion_steps
        ideal_products = torch.cos((t + 0.008) / 1.008 * math.pi / 2) ** 2
        betas = (1 - ideal_products[1:] / ideal_products[:-1]).clamp(max=0.999)
        products = (1 - betas).cumprod(0).float()  # (K,), not saved: they follow from the steps
        self.register_buffer("alphas_cumprod", products, persistent=False)

    def add_noise(self, sample: Tensor, noise: Tensor, timesteps: Tensor) -> Tensor:
        """A_k = sqrt(a_k) A_0 + sqrt(1 - a_k) noise; both (B, H, A), timesteps (B,) int64."""
        a = self.alphas_cumprod[timesteps][:, None, None].to(sample.dtype)  # (B, 1, 1)
        return a.sqrt() * sample + (1 - a).sqrt() * noise

    def timesteps(self) -> list[int]:
        """The diffusion steps that sampling visits, from noisy to clean: 90, 80, ..., 0."""
        return list(range(0, len(self.alphas_cumprod), self.stride))[::-1]

    def step(self, prediction: Tensor, k: int, noisy: Tensor) -> Tensor:
        """One DDIM step from k to k - K / inference_steps, (B, H, A) -> (B, H, A).

        Sampler `ddim` adds back the noise that turns the unclipped prediction into `noisy`. DP3
        pins diffusers 0.11.1, which adds back the predicted sample instead of noise (sampler
        `dp3`): every step then starts from a guess without noise, and more rollouts succeed.
        """
        a = self.alphas_cumprod[k]
        a_next = self.alphas_cumprod[k - self.stride] if k >= self.stride else torch.ones_like(a)
        if self.sampler == "dp3":
            noise = prediction
        else:
            noise = (noisy - a.sqrt() * prediction) / (1 - a).sqrt()
        return a_next.sqrt() * prediction.clamp(-1, 1) + (1 - a_next).sqrt() * noise


class Recording(Protocol):
    """What a normalizer is fitted to, for example a `data.WindowSampler`."""

    points: Tensor  # (..., P)
    state: Tensor  # (..., S)
    action: Tensor  # (..., A)


class Normalizer(nn.Module):
    """Maps points, state and action to [-1, 1], each coordinate by its range in the data.

    Only a point's position is mapped; its features, such as colours in [0, 1], pass unchanged.
    """

    def __init__(self, state_dim: int, action_dim: int, point_dim: int = 3):
        super().__init__()
        for name, dim in {"points": point_dim, "state": state_dim, "action": action_dim}.items():
            self.register_buffer(f"{name}_center", torch.zeros(dim))
            self.register_buffer(f"{name}_scale", torch.ones(dim))

    def fit(self, recordings: Iterable[Recording]) -> None:
        """Sets the ranges to those of all recordings together.

        A coordinate that hardly moves (range under 1e-4) is centred and not stretched. Such a
        coordinate of an action is divided by 5e-5 instead, so that any number drawn in [-1, 1] maps
        back to within 5e-5 of the constant.
        """
        recordings = list(recordings)
        for name in ("points", "state", "action"):
            tensors = [getattr(recording, name).flatten(0, -2) for recording in recordings]
            low = torch.stack([x.amin(0) for x in tensors]).amin(0).float()  # (dim,)
            high = torch.stack([x.amax(0) for x in tensors]).amax(0).float()
            center, half = (low + high) / 2, (high - low) / 2
            scale = torch.where(half < 5e-5, 5e-5 if name == "action" else 1.0, half)
            if name == "points":
                center[3:], scale[3:] = 0.0, 1.0
            getattr(self, f"{name}_center").copy_(center)
            getattr(self, f"{name}_scale").copy_(scale)

    def normalize(self, name: str, x: Tensor) -> Tensor:
        """x (..., dim) in its own unit -> [-1, 1]; `name` is points, state or action."""
        return (x - getattr(self, f"{name}_center")) / getattr(self, f"{name}_scale")

    def unnormalize(self, name: str, x: Tensor) -> Tensor:
        """The inverse of `normalize`."""
        return x * getattr(self, f"{name}_scale") + getattr(self, f"{name}_center")


# ---- The policies --------------------------------------------------------------------------------

Context = tuple[Tensor, ...] | None  # what `encode_demo` makes of a task; None: no task is read


class DAMIPolicy(nn.Module):
    """The policy: two observations, an instruction and a demonstration in; actions out.

    Raises ConfigError for the configuration of another policy, or one that does not fit this class.
    """

    # What a subclass may override:
    requires: ClassVar[dict[str, str]] = {}  # fields of its configuration that it fixes
    conditioned_by_h: ClassVar[bool] = True  # whether its denoiser is modulated by h_k

    def __init__(self, config: PolicyConfig):
        super().__init__()
        self.check_config(config)
        self.config = config
        self.normalizer = Normalizer(config.state_dim, config.action_dim, config.point_dim)
        self.observation_encoder = ObservationEncoder(config)
        if config.reads_demonstration:
            self.demo_encoder = demo_encoders[config.demo_encoder](config)
        if config.tcfm != "none":
            self.u2t = UnpairedUnifiedTask(config)
        if self.conditioned_by_h:
            self.condition_encoder = ConditionEncoder(config)
        self.denoiser = denoisers[config.denoiser](config)
        # An ablation. It comes last, so that a seed draws the rest as without it.
        if config.tcfm == "none" and config.reads_task:
            self.u2t = PooledTask(config)
        self.schedule = DiffusionSchedule(
            config.diffusion_steps, config.inference_steps, config.sampler
        )

    @classmethod
    def check_config(cls, config: PolicyConfig) -> None:
        """Raises ConfigError for a configuration that names another class, or does not fit this."""
        named = POLICIES[config.policy]
        if named is not cls:
            raise ConfigError(
                f"policy {config.policy!r} is a {named.__name__} and no {cls.__name__}: "
                "use build_policy, or name this class in model.POLICIES"
            )
        for name, needed in cls.requires.items():
            value = getattr(config, name)
            if value != needed:
                raise ConfigError(f"policy {config.policy} needs {name} {needed!r}, not {value!r}")

    @property
    def device(self) -> torch.device:
        return self.normalizer.action_scale.device

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """The parameters by adaptation learning rate: `vision`, `diffusion`, `other` (VMT, U2T)."""
        groups = {"vision": [], "diffusion": [], "other": []}
        group_of = {
            "observation_encoder": "vision",
            "condition_encoder": "diffusion",
            "denoiser": "diffusion",
        }
        for name, parameter in self.named_parameters():
            part = name.split(".")[0]
            groups[group_of.get(part, "other")].append(parameter)
        return groups

    def encode_observations(self, points: Tensor, state: Tensor) -> Tensor:
        """points (..., N, P), positions in metres, state (..., S) -> (..., feature)."""
        points = self.normalizer.normalize("points", points)
        state = self.normalizer.normalize("state", state)
        return self.observation_encoder(points, state)  # (..., observation_feature_dim)

    def encode_demo(
        self,
        text: Tensor | None = None,
        demo_points: Tensor | None = None,
        demo_state: Tensor | None = None,
        demo_action: Tensor | None = None,
    ) -> Context:
        """Encodes the instruction and the demonstration. One call serves a whole rollout.

        Args:
            text: instruction features (D, text_dim).
            demo_points, demo_state, demo_action: complete demonstrations, already strided:
                (D, T, N, P) in metres, (D, T, S), (D, T, A).

        Returns:
            A tuple of tensors whose first axis is D, for `sample_actions`; None where the policy
            reads no task. `loss` takes the inputs themselves.

        Raises:
            ValueError: an input is missing or has a wrong shape, or a demonstration has more frames
                than there are learned positions.
        """
        if not self.config.reads_task:
            return None
        if not self.config.reads_demonstration:
            self.check_shapes(text=text)
            return self.u2t.encode_context(None, text)
        self.check_shapes(
            demo_points=demo_points, demo_state=demo_state, demo_action=demo_action, text=text
        )
        T, most = demo_points.shape[1], self.config.demo_positions
        if T > most:
            raise ValueError(f"a demonstration has {T} frames, the policy {most} positions")
        features = self.encode_observations(demo_points, demo_state)  # (D, T, feature)
        actions = self.normalizer.normalize("action", demo_action)  # (D, T, A)
        tokens = self.demo_encoder(features, actions)  # (D, T, demo_dim)
        if tokens.shape[1] > most:
            raise ValueError(f"the encoder made {tokens.shape[1]} tokens of {most} positions")
        return self.u2t.encode_context(tokens, text)

    def denoise(
        self, noisy: Tensor, timesteps: Tensor, observation: Tensor, context: Context
    ) -> Tensor:
        """A_k (B, H, A), k (B,), observation (B, To * feature) -> predicted A_0 (B, H, A)."""
        h = self.condition_encoder(timesteps, observation)  # (B, C)   Eq. 7
        if context is None:
            return self.denoiser(noisy, h)
        B, D = len(h), len(context[0])
        if B % D != 0:
            raise ValueError(f"{B} windows cannot be shared equally by {D} tasks")
        fused = self.u2t(h, context)  # (B, C)
        if self.config.tcfm == "none":  # the ablation, in which it modulates every level
            return self.denoiser(noisy, fused)
        return self.denoiser(noisy, h, fused)

    def loss(
        self,
        points: Tensor,
        state: Tensor,
        action: Tensor,
        noise: Tensor,
        timesteps: Tensor,
        **task: Tensor,
    ) -> Tensor:
        """The diffusion loss, () float: the error of the predicted clean actions (Eq. 1).

        It is the mean over windows and over a window's H * A numbers, as in DP3's code. The paper
        writes a squared norm, their sum: 64 times as much at H = 16, A = 4. AdamW does not feel the
        factor, an SGD inner step does. The loss is a pure function of parameters and arguments.

        Args:
            points, state, action: B windows, the older observation first, ordered by task:
                (B, To, N, P) in metres, (B, To, S), (B, H, A).
            noise, timesteps: standard normal (B, H, A), and k in [0, K), (B,) int64.
            task: the arguments of `encode_demo`, of D tasks; D divides B.

        Raises:
            ValueError: an input is missing or has a wrong shape, or D does not divide B.
        """
        self.check_shapes(
            points=points, state=state, action=action, noise=noise, timesteps=timesteps
        )
        context = self.encode_demo(**task)
        clean = self.normalizer.normalize("action", action)  # A_0, (B, H, A)
        noisy = self.schedule.add_noise(clean, noise, timesteps)  # A_k, (B, H, A)
        observation = self.encode_observations(points, state).flatten(1)  # (B, To * feature)
        return F.mse_loss(self.denoise(noisy, timesteps, observation, context), clean)

    def forward(self, **batch: Tensor) -> Tensor:
        """`loss`, so that torch.func.functional_call(policy, params, (), batch) is the loss."""
        return self.loss(**batch)

    @torch.no_grad()
    def sample_actions(
        self, points: Tensor, state: Tensor, context: Context, generator: Generator | None = None
    ) -> Tensor:
        """Draws an action chunk by DDIM from Gaussian noise.

        Args:
            points, state: the last To observations, the older first: (B, To, N, P) in metres, and
                (B, To, S).
            context: what `encode_demo` makes of D tasks; D divides B.
            generator: the source of the initial noise; None: PyTorch's global one.

        Returns:
            (B, Ta, A), to be executed from the newest observation on, in the demonstrations' unit.

        Raises:
            ValueError: the context is missing, an input has a wrong shape, or D does not divide B.
        """
        self.check_shapes(points=points, state=state)
        if context is None and self.config.reads_task:
            raise ValueError("context is missing: it is what `encode_demo` makes of a task")
        observation = self.encode_observations(points, state).flatten(1)  # (B, To * feature)
        shape = (len(points), self.config.horizon, self.config.action_dim)
        source = points.device if generator is None else generator.device
        actions = torch.randn(shape, generator=generator, device=source).to(points.device)
        for k in self.schedule.timesteps():
            timesteps = torch.full((len(points),), k, device=points.device)
            prediction = self.denoise(actions, timesteps, observation, context)  # (B, H, A)
            actions = self.schedule.step(prediction, k, actions)
        return self.select_action_chunk(actions)

    def select_action_chunk(self, actions: Tensor) -> Tensor:
        """Normalized (B, H, A) -> (B, Ta, A) from the newest observation on, in their own unit."""
        newest = self.config.n_obs_steps - 1
        chunk = actions[:, newest : newest + self.config.n_action_steps]  # (B, Ta, A)
        return self.normalizer.unnormalize("action", chunk)

    def shapes(self) -> dict[str, tuple[int | str, ...]]:
        """The shape that each input must have.

        A letter stands for a size that is not given, and that is the same in all inputs of a call.
        """
        To, H, N = self.config.n_obs_steps, self.config.horizon, self.config.num_points
        P, S, A = self.config.point_dim, self.config.state_dim, self.config.action_dim
        return {
            "points": ("B", To, N, P),
            "state": ("B", To, S),
            "action": ("B", H, A),
            "noise": ("B", H, A),
            "timesteps": ("B",),
            "text": ("D", self.config.text_dim),
            "demo_points": ("D", "T", N, P),
            "demo_state": ("D", "T", S),
            "demo_action": ("D", "T", A),
        }

    def check_shapes(self, **inputs: Tensor | None) -> None:
        """Raises ValueError for what is missing, or would broadcast to a wrong result silently."""
        shapes = self.shapes()
        sizes = {}  # letter -> its size in the first input that has it
        for name, x in inputs.items():
            expected = shapes[name]
            if x is None:
                takes = str(expected).replace("'", "")
                raise ValueError(f"{name} is missing, the policy takes {takes}")
            if x.dim() == len(expected):
                for letter, size in zip(expected, x.shape):
                    if isinstance(letter, str):
                        sizes.setdefault(letter, size)
                expected = tuple(sizes.get(letter, letter) for letter in expected)
            if tuple(x.shape) != expected:
                takes = str(expected).replace("'", "")
                advice, N = "", self.config.num_points
                if "points" in name and x.dim() == len(expected) and x.shape[-2] > N:
                    advice = f": `data.farthest_point_sample(cloud, {N})` draws so many points"
                raise ValueError(f"{name} is {tuple(x.shape)}, the policy takes {takes}{advice}")

    def draw_noise_and_timesteps(self, n: int, generator: Generator) -> dict[str, Tensor]:
        """Draws what makes `loss` pure: noise (n, H, A) float32 and timesteps (n,) int64.

        They are on the policy's device, whatever the generator's.
        """
        H, A, K = self.config.horizon, self.config.action_dim, self.config.diffusion_steps
        source = generator.device
        noise = torch.randn(n, H, A, generator=generator, device=source)
        timesteps = torch.randint(K, (n,), generator=generator, device=source)
        return {"noise": noise.to(self.device), "timesteps": timesteps.to(self.device)}

    def draw_batch(
        self, sampler: Any, text: Tensor, n: int, generator: Generator, support: int = 0
    ) -> dict[str, Tensor]:
        """Draws the arguments of `loss`: n windows, a demonstration, noise and timesteps.

        Args:
            sampler: a `data.WindowSampler` of one task.
            text: the task's instruction feature (text_dim,); the batch is on its device.
            n: windows.
            generator: draws all of it.
            support: see `WindowSampler.batch`.
        """
        batch = {
            "text": text[None],
            **sampler.batch(n, generator, support=support),
            **self.draw_noise_and_timesteps(n, generator),
        }
        return {name: x.to(text.device) for name, x in batch.items()}


class DP3Policy(DAMIPolicy):
    """DP3: the policy without demonstration and instruction."""

    requires: ClassVar = {"demo_encoder": "none", "tcfm": "none"}


POLICIES["dami"] = DAMIPolicy
POLICIES["dp3"] = DP3Policy


def build_policy(config: PolicyConfig) -> DAMIPolicy:
    """The policy that a configuration names, with fresh weights.

    Raises ConfigError, as the policy's class does, for a configuration that does not fit it.
    """
    return POLICIES[config.policy](config)


# ---- For training --------------------------------------------------------------------------------

# The entries of a batch that describe its task, one row for each demonstration. All others have one
# row for each window.
TASK_INPUTS = ("text", "demo_points", "demo_state", "demo_action")


def split(batch: dict[str, Tensor], n: int) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Splits a task's windows by index: the first n for support, the others for query.

    `batch` holds the arguments of `DAMIPolicy.loss`. Both parts keep the entries of `TASK_INPUTS`
    whole.
    """
    support, query = {}, {}
    for name, x in batch.items():
        support[name] = x if name in TASK_INPUTS else x[:n]
        query[name] = x if name in TASK_INPUTS else x[n:]
    return support, query


def ema_model(policy: DAMIPolicy) -> AveragedModel:
    """Makes the exponential moving average of a policy, whose decay grows as in the paper.

    Its `.module` is the averaged policy, in evaluation mode. `.update_parameters(policy)` must be
    called after each step.
    """

    @torch.no_grad()
    def update(averaged: list[Tensor], current: list[Tensor], step: Tensor) -> None:
        decay = min(0.9999, 1 - (1 + int(step)) ** -0.75)
        torch._foreach_lerp_(averaged, current, 1 - decay)

    average = AveragedModel(policy, multi_avg_fn=update)
    average.module.eval()
    return average


def loss_of(policy: DAMIPolicy, params: dict[str, Tensor], batch: dict[str, Tensor]) -> Tensor:
    """The loss () of a policy with these parameters in place of its own, as maml.py takes it."""
    return functional_call(policy, params, (), batch)


# ---- Presets -------------------------------------------------------------------------------------

# `small` is for two CPU cores, `tiny` to see everything run. What is not named here is the paper's.
# fmt: off
PRESETS = {
    "paper": PolicyConfig(),
    "small": PolicyConfig(
        num_points=128, pointnet_widths=(32, 64, 128), state_feature_dim=32, timestep_dim=64,
        demo_stride=16, demo_positions=13,  # 13 of a demonstration's 200 frames
        unet_widths=(32, 64, 128), n_action_steps=4, inference_steps=5,
    ),
    "tiny": PolicyConfig(
        num_points=64, pointnet_widths=(16, 32), point_feature_dim=16, state_feature_dim=16,
        demo_stride=20, demo_positions=10, demo_dim=32, timestep_dim=32, unet_widths=(16, 32),
    ),
}
# fmt: on


# ---- Files of policies ---------------------------------------------------------------------------

FORMAT = "DAMI checkpoint 2"


class CheckpointError(ValueError):
    """A file holds no policy, is damaged or cannot be written; the message is one line."""


def save(path: str | Path, policy: DAMIPolicy, *, half: bool = False, **info: Any) -> None:
    """Writes a policy to a file: its configuration, weights and normalizer, and `info`.

    The file is written whole or not at all: the old file stays until the new one is complete.

    Args:
        half: stores the weights as float16, half the size; `load` gives float32 again.
        info: tensors and plain values, which `load` returns beside the policy.

    Raises:
        CheckpointError: the weights are not finite, or the file cannot be written.
    """
    path = Path(path)
    weights = policy.state_dict()
    if half:
        for name, parameter in policy.named_parameters():
            weights[name] = parameter.detach().half()
    if not all(torch.isfinite(x).all() for x in weights.values()):
        raise CheckpointError(
            f"{path} was not written, because weights are not finite: lower the learning rates"
        )
    content = dict(format=FORMAT, config=asdict(policy.config), model=weights, **info)
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
            temporary = Path(folder) / path.name
            torch.save(content, temporary)
            os.replace(temporary, path)
    except (OSError, RuntimeError) as error:  # torch.save reports a full disk as RuntimeError
        raise CheckpointError(
            f"cannot write {path}, look at the space and the permissions there: {one_line(error)}"
        ) from error


def load(
    path: str | Path,
    device: str | torch.device = "cpu",
    *,
    needs: Sequence[str] = (),
    **config_overrides: Any,
) -> tuple[DAMIPolicy, dict[str, Any]]:
    """Rebuilds the policy that `save` wrote to a file, in evaluation mode on `device`.

    It draws fresh weights before it reads those of the file, from PyTorch's global generator.

    Args:
        needs: the names that `info` must have.
        config_overrides: fields of the configuration that take the place of those in the file.

    Returns:
        (policy, info): info is what `save` was given.

    Raises:
        CheckpointError: the file is missing or damaged, was not written by `save`, or by an older
            version of it, or lacks one of `needs`; its weights and its configuration do not fit; or
            it cannot be used with `config_overrides`.
    """
    path = Path(path)
    content = read_archive(path, device)
    check_content(path, content, needs)
    del content["format"]
    config, weights = content.pop("config"), content.pop("model")

    if unknown := sorted(set(config) - {field.name for field in fields(PolicyConfig)}):
        raise CheckpointError(
            f"{path} is of another version of the code, with settings that are unknown here: "
            f"{', '.join(unknown)}"
        )
    if config.get("policy", "dami") not in tuple(POLICIES):  # a damaged file may hold a list
        raise CheckpointError(
            f"{path}: policy {config['policy']!r} is unknown: import the file that adds it first, "
            "such as baselines.py"
        )
    try:
        config = PolicyConfig(**config)
        POLICIES[config.policy].check_config(config)
    except (TypeError, ConfigError) as error:  # TypeError: a number in place of a tuple
        raise CheckpointError(f"{path}: its settings do not fit: {one_line(error)}") from error
    try:
        config = replace(config, **config_overrides)
        with torch.device("meta"):  # takes no memory, for a size that the file may not hold
            empty = build_policy(config)
    except ConfigError as error:
        raise CheckpointError(f"{path} cannot be used like this: {one_line(error)}") from error
    expected = {name: tuple(x.shape) for name, x in empty.state_dict().items()}
    stored = {name: tuple(getattr(x, "shape", ())) for name, x in weights.items()}
    for name in [*expected, *stored]:
        if stored.get(name) != expected.get(name):
            raise CheckpointError(
                f"{path}: weights and configuration do not fit: {name} is {stored.get(name)} in "
                f"the file, and {expected.get(name)} in the policy"
            )

    policy = build_policy(config).to(device)
    policy.load_state_dict(weights)
    return policy.eval(), content


def read_archive(path: Path, device: str | torch.device) -> Any:
    """What torch.save wrote to a file, none of it code; CheckpointError for a damaged file."""
    if not path.is_file():
        raise CheckpointError(f"no checkpoint at {path}: name a .pt file")
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()  # torch.load does not compare the check sums
            for entry in archive.infolist():
                if entry.external_attr:  # not of torch.save; torch could take it for a folder
                    damaged = entry.filename
        if damaged is None:
            return torch.load(path, map_location=device, weights_only=True)
    except PermissionError as error:
        raise CheckpointError(f"{path} cannot be read: {error.strerror}") from error
    except Exception as error:  # zipfile and torch raise many types; each means it is damaged
        raise CheckpointError(
            f"{path} is damaged or no PyTorch checkpoint: use another file"
        ) from error
    raise CheckpointError(f"{path} is damaged (in {damaged!r}): use another file")


def check_content(path: Path, content: Any, needs: Sequence[str]) -> None:
    """Raises CheckpointError unless `save` wrote the content of a file, and `needs` are in it."""
    version = content.get("format") if isinstance(content, dict) else None
    if version == "DAMI checkpoint 1":
        raise CheckpointError(
            f"{path} was written by an older version of this code: train again, or use that version"
        )
    if version != FORMAT:
        raise CheckpointError(f"{path} holds no policy that this code saved: use another file")
    for part in ("config", "model"):
        if not isinstance(content.get(part), dict):
            raise CheckpointError(f"{path} holds no policy (its {part} is missing): use another")
    missing = [name for name in needs if name not in content]
    if missing:
        raise CheckpointError(
            f"{path} lacks {', '.join(missing)}: use a file of train.py or finetune.py"
        )


def one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]


# ---- Written out for speed: skip this when reading the method ------------------------------------


class GroupNorm(nn.GroupNorm):
    """Group normalization through `layer_norm`: 40 % fewer operations in the second derivative."""

    def forward(self, x: Tensor) -> Tensor:
        """(B, channels, L) -> (B, channels, L)."""
        if not torch.is_grad_enabled():
            return super().forward(x)
        groups = x.unflatten(1, (self.num_groups, -1)).flatten(2)  # (B, groups, channels / .. * L)
        x = F.layer_norm(groups, groups.shape[-1:], eps=self.eps).view_as(x)
        return x * self.weight[:, None] + self.bias[:, None]


class Mish(nn.Module):
    """x tanh(log(1 + e^x)): faster than PyTorch's own, above all in the second derivative."""

    def forward(self, x: Tensor) -> Tensor:
        if not torch.is_grad_enabled():
            return F.mish(x)
        return x * torch.tanh(F.softplus(x))


class Conv1d(nn.Conv1d):
    """A convolution that keeps the length; on a CPU a wide or short one is a matrix product.

    PyTorch's own (2.13) takes up to eight times as long for the gradient of a wide one's weight,
    and half as long again where the sequence is shorter than the kernel.
    """

    def __init__(self, d_in: int, d_out: int, kernel_size: int):
        super().__init__(d_in, d_out, kernel_size, padding=kernel_size // 2)
        self.wide = d_in * d_out >= 1024**2

    def forward(self, x: Tensor) -> Tensor:
        """(B, d_in, L) -> (B, d_out, L)."""
        short = x.shape[-1] < self.kernel_size[0]
        if x.is_cuda or not (self.wide or short):
            return super().forward(x)
        pad = self.padding[0]
        padded = F.pad(x, (pad, pad)).transpose(1, 2)  # (B, L + k - 1, d_in)
        shifted = [padded[:, i : i + x.shape[-1]] for i in range(self.kernel_size[0])]
        windows = torch.stack(shifted, dim=-1).flatten(2)  # (B, L, d_in * k)
        return F.linear(windows, self.weight.flatten(1), self.bias).transpose(1, 2)


class CriticalPoints(torch.autograd.Function):
    """Which points have the maximum over their cloud in some channel of a PointNet.

    Of 128 points a third do, of 512 a sixth. A pass without gradient finds them, a few clouds at a
    time, which stay in the CPU's cache. Their number depends on the data, which is why `vmap` needs
    a rule of its own.
    """

    @staticmethod
    def forward(points: Tensor, *layers: Tensor) -> tuple[Tensor, Tensor]:
        """points (..., N, P); weight, bias, norm's weight and bias of each layer.

        Returns the critical points of all clouds, (R,) int64 in [0, clouds * N), each once, behind
        which others may follow (see `rows`); and for each cloud and channel the place of its
        maximum among them, (clouds, channels) int64.
        """
        argmax = CriticalPoints.argmax(points, layers)  # (clouds, channels)
        clouds, N = points.shape[:-2].numel(), points.shape[-2]
        marked, place = CriticalPoints.mark(argmax, clouds * N)
        return CriticalPoints.rows(marked, min(clouds * N, argmax.numel())), place

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, Tensor]) -> None:
        ctx.mark_non_differentiable(*output)

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int | None, ...], *inputs: Tensor
    ) -> tuple[tuple[Tensor, Tensor], tuple[int, int]]:
        """`forward` for several tasks, one after the other; all have the largest R of them."""
        marked, places = [], []
        for task in range(info.batch_size):
            points, *layers = (
                x if dim is None else x.select(dim, task) for x, dim in zip(inputs, in_dims)
            )
            argmax = CriticalPoints.argmax(points, layers)
            in_task, place = CriticalPoints.mark(argmax, points.shape[:-1].numel())
            marked.append(in_task)
            places.append(place)
        rows = CriticalPoints.rows(torch.stack(marked), min(len(in_task), argmax.numel()))
        return (rows, torch.stack(places)), (0, 0)

    @staticmethod
    def argmax(points: Tensor, layers: Sequence[Tensor]) -> Tensor:
        """points (..., N, P) -> of each cloud and channel the point in [0, clouds * N)."""
        clouds = points.reshape(-1, *points.shape[-2:])  # (clouds, N, P)
        N = clouds.shape[-2]
        at_once = len(clouds) if points.is_cuda else max(1, 4096 // N)
        places = []
        for x in clouds.split(at_once):
            for layer in range(0, len(layers), 4):
                weight, bias, norm_weight, norm_bias = layers[layer : layer + 4]
                x = F.linear(x, weight, bias)  # (at_once, N, width)
                x = F.layer_norm(x, bias.shape, norm_weight, norm_bias).relu_()
            places.append(x.max(dim=-2).indices)  # (at_once, channels); faster than x.argmax
        first_points = N * torch.arange(len(clouds), device=points.device)  # of each cloud
        return torch.cat(places) + first_points[:, None]  # (clouds, channels)

    @staticmethod
    def mark(argmax: Tensor, n: int) -> tuple[Tensor, Tensor]:
        """The n points of all clouds, 1 for critical ones, (n,) int8; and the places, see above."""
        marked = torch.zeros(n, dtype=torch.int8, device=argmax.device)
        marked.scatter_(0, argmax.flatten(), 1)
        return marked, (marked.cumsum(0) - 1)[argmax]

    @staticmethod
    def rows(marked: Tensor, bound: int) -> Tensor:
        """(..., n) int8 -> (..., R) int64: the critical points in their order, then others.

        R is the largest number of critical points that a row of `marked` has. On a GPU it is
        `bound`, so that the host need not wait for the count.
        """
        if marked.is_cuda:
            most = bound
        else:
            most = int(marked.sum(dim=-1).max())
        return marked.argsort(dim=-1, descending=True, stable=True)[..., :most]
