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
of a demonstration, N points (W winning ones), To = 2 observations (the older first), H = 16
horizon, Ta = 8 executed actions, A action dim, S state dim, K = 100 diffusion steps, C condition
width (timestep_dim + To * observation feature), L length of the action sequence inside the U-Net
(H, then half of it a level). Clouds and poses are in metres; networks see [-1, 1].
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Generator, Tensor, nn
from torch.optim.swa_utils import AveragedModel

# ---- Configuration -------------------------------------------------------------------------------


CHOICES = {"demo_encoder": ("vmt", "mlp", "none"), "tcfm": ("down", "mid", "up", "none")}
CHOICES |= {"policy": ("dami", "dp3", "flow", "mamba", "freq"), "sampler": ("ddim", "dp3")}


@dataclass(frozen=True)
class PolicyConfig:
    """The whole architecture, from which a checkpoint's policy is rebuilt.

    The defaults are the paper's; what it leaves out (PointNet, the U-Net's widths) is DP3's.
    """

    policy: str = "dami"  # dami | dp3 | flow | mamba | freq, see baselines.py
    state_dim: int = 9  # S: end effector, right finger, left finger, metres
    action_dim: int = 4  # A: dx, dy, dz, gripper
    num_points: int = 512  # N
    horizon: int = 16  # H, the actions of a window
    n_obs_steps: int = 2  # To
    n_action_steps: int = 8  # Ta, executed before the policy looks again
    pointnet_widths: tuple[int, ...] = (64, 128, 256)
    point_feature_dim: int = 64
    state_feature_dim: int = 64
    demo_encoder: str = "vmt"  # vmt | mlp (baselines.py) | none
    demo_stride: int = 1  # the demonstration encoder reads every demo_stride-th frame
    demo_positions: int = 200  # learned positions: the longest demonstration, after the stride
    demo_dim: int = 128  # the table calls it "Action Dim"
    vmt_layers: int = 2
    vmt_heads: int = 4
    tcfm: str = "down"  # which U-Net level reads U2T's output: down | mid | up | none
    u2t_layers: int = 1
    u2t_heads: int = 8
    text_dim: int = 512
    timestep_dim: int = 128
    unet_widths: tuple[int, ...] = (512, 1024, 2048)
    kernel_size: int = 5
    n_groups: int = 8
    diffusion_steps: int = 100  # K
    inference_steps: int = 10
    sampler: str = "dp3"  # ddim | dp3, see DiffusionSchedule.step

    def __post_init__(self):
        # A checkpoint brings lists back where tuples went in.
        object.__setattr__(self, "pointnet_widths", tuple(self.pointnet_widths))
        object.__setattr__(self, "unet_widths", tuple(self.unet_widths))

        layers = self.vmt_layers + self.u2t_layers
        if () in (self.pointnet_widths, self.unet_widths) or layers > 99 or self.timestep_dim < 4:
            raise ValueError("networks need widths, timestep_dim >= 4, VMT and U2T <= 99 layers")
        for name, value in vars(self).items():
            if isinstance(value, int) and not 1 <= value <= 100_000:
                raise ValueError(f"{name} is {value}: use at least 1, at most 100000")
        for name, known in CHOICES.items():
            if (value := getattr(self, name)) not in known:
                raise ValueError(f"{name} is {value!r}; use one of {', '.join(known)}")

        H, To, Ta = self.horizon, self.n_obs_steps, self.n_action_steps
        if Ta > (most := H - To + 1):
            raise ValueError(f"n_action_steps {Ta}: horizon {H} has {most} after observation {To}")
        shrink = 2 ** (len(self.unet_widths) - 1)  # the U-Net halves the sequence between levels
        for whole, part, what in [
            (self.horizon, shrink, "horizon by 2 for each level of the U-Net but the last"),
            (self.diffusion_steps, self.inference_steps, "diffusion_steps by inference_steps"),
            (self.kernel_size + 1, 2, "kernel_size + 1 by 2 (use an odd one)"),
            (self.timestep_dim, 2, "timestep_dim by 2"),
            (self.demo_dim, self.vmt_heads, "demo_dim by vmt_heads"),
            (self.condition_dim, self.u2t_heads, "condition width by u2t_heads"),
            (math.gcd(*self.unet_widths), self.n_groups, "U-Net widths by n_groups"),
        ]:
            if whole % part:
                raise ValueError(f"cannot divide {what}: {whole} by {part}")

    @property
    def observation_feature_dim(self) -> int:
        return self.point_feature_dim + self.state_feature_dim

    @property
    def condition_dim(self) -> int:
        """C, the width of h_k and of U2T."""
        return self.timestep_dim + self.n_obs_steps * self.observation_feature_dim

    @property
    def reads_task(self) -> bool:
        """Whether anything names the task. Without, the network is DP3's."""
        return self.demo_encoder != "none" or self.tcfm != "none"


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


# ---- Attention: one block for VMT and U2T --------------------------------------------------------


class Attention(nn.Module):
    """Multi-head softmax attention, written out: fused kernels have no double backward."""

    def __init__(self, width: int, heads: int):
        super().__init__()
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
        self.norm1 = LayerNorm(width)
        self.attention = Attention(width, heads)
        self.norm2 = LayerNorm(width)
        wide = 4 * width
        self.mlp = nn.Sequential(nn.Linear(width, wide), nn.GELU(), nn.Linear(wide, width))

    def forward(self, x: Tensor) -> Tensor:
        """(B, T, width) -> (B, T, width)."""
        x = x + self.attention(self.norm1(x))
        return x + self.mlp(self.norm2(x))


# ---- Observation ---------------------------------------------------------------------------------


class PointNetEncoder(nn.Module):
    """A cloud to one feature: the same MLP on every point, the maximum over points, a projection.

    The maximum makes it blind to the order of the points. It passes no gradient to a point that
    wins in no channel, so that only winners are differentiated (`WinningPoints`): a third of them.
    """

    def __init__(self, widths: tuple[int, ...] = (64, 128, 256), feature_dim: int = 64):
        super().__init__()
        layers = []
        for d_in, d_out in pairwise((3, *widths)):
            layers += [nn.Linear(d_in, d_out), LayerNorm(d_out), nn.ReLU()]
        self.mlp = nn.Sequential(*layers)
        self.projection = nn.Sequential(nn.Linear(widths[-1], feature_dim), LayerNorm(feature_dim))

    def forward(self, points: Tensor) -> Tensor:
        """(..., N, 3) float, normalized -> (..., feature_dim)."""
        if torch.is_grad_enabled():
            winners = WinningPoints.apply(points, *self.mlp.parameters())  # (..., W) indices
            points = points.gather(-2, winners[..., None].expand(*winners.shape, 3))  # (..., W, 3)
        x = self.mlp(points)  # (..., N, widths[-1]), or W for N
        return self.projection(x.amax(dim=-2))  # (..., feature_dim)


class ObservationEncoder(nn.Module):
    """A frame to one feature: PointNet on the cloud, an MLP on the robot's state, concatenated."""

    def __init__(self, config: PolicyConfig):
        super().__init__()
        self.pointnet = PointNetEncoder(config.pointnet_widths, config.point_feature_dim)
        S, width = config.state_dim, config.state_feature_dim
        self.state_mlp = nn.Sequential(nn.Linear(S, width), nn.ReLU(), nn.Linear(width, width))

    def forward(self, points: Tensor, state: Tensor) -> Tensor:
        """points (..., N, 3), state (..., S), normalized -> (..., observation_feature_dim)."""
        return torch.cat([self.pointnet(points), self.state_mlp(state)], dim=-1)


# ---- The reference demonstration -----------------------------------------------------------------


class VisualMotorTrajectory(nn.Module):
    """VMT: a Transformer over a demonstration's frames, each what was seen and done (Eqs. 4-5)."""

    def __init__(self, config: PolicyConfig):
        super().__init__()
        width = config.demo_dim
        self.projection = nn.Linear(config.observation_feature_dim + config.action_dim, width)
        self.positions = nn.Parameter(0.02 * torch.randn(config.demo_positions, width))
        heads, layers = config.vmt_heads, config.vmt_layers
        self.blocks = nn.ModuleList(TransformerBlock(width, heads) for _ in range(layers))

    def forward(self, features: Tensor, actions: Tensor) -> Tensor:
        """features (D, T, feature), actions (D, T, A) -> tokens (D, T, demo_dim)."""
        x = self.projection(torch.cat([features, actions], dim=-1))  # (D, T, demo_dim)   Eq. 4
        x = x + self.positions[: x.shape[1]]
        for block in self.blocks:
            x = block(x)  # Eq. 5
        return x


class UnpairedUnifiedTask(nn.Module):
    """U2T: fuses demonstration, instruction and h_k, and is read at h_k's place (Eqs. 6 and 8).

    The sequence is [demonstration tokens | text token | h_k]. Only h_k differs from window to
    window and from one diffusion step to the next. With one layer (the default) the keys and values
    of the other tokens therefore belong to the task alone: `encode_context` computes them once, and
    every window attends to the same ones. More layers mix the tokens and run on the full sequence.
    """

    def __init__(self, config: PolicyConfig):
        super().__init__()
        demo, text, width = config.demo_dim, config.text_dim, config.condition_dim
        if config.demo_encoder != "none":
            self.demo_projection = nn.Sequential(LayerNorm(demo), nn.Linear(demo, width))
            self.demo_positions = nn.Parameter(0.02 * torch.randn(config.demo_positions, width))
        self.text_projection = nn.Sequential(LayerNorm(text), nn.Linear(text, width))
        self.text_position = nn.Parameter(0.02 * torch.randn(1, width))
        heads, layers = config.u2t_heads, config.u2t_layers
        self.blocks = nn.ModuleList(TransformerBlock(width, heads) for _ in range(layers))

    def embed(self, demo_tokens: Tensor | None, text: Tensor) -> Tensor:
        """demo_tokens (D, T, demo_dim) or None, text (D, text_dim) -> tokens (D, T + 1, C)."""
        tokens = self.text_projection(text)[:, None] + self.text_position  # (D, 1, C)   Eq. 6
        if demo_tokens is not None:
            demo = self.demo_projection(demo_tokens) + self.demo_positions[: demo_tokens.shape[1]]
            tokens = torch.cat([demo, tokens], dim=1)  # (D, T, C) before (D, 1, C)
        return tokens

    def encode_context(self, demo_tokens: Tensor | None, text: Tensor) -> tuple[Tensor, ...]:
        """What a task's windows share: keys, values (D, heads, T + 1, C / heads); or the tokens."""
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
            for block in self.blocks:
                x = block(x)
            return x[:, -1]

        block, attention = self.blocks[0], self.blocks[0].attention
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


# ---- The denoiser --------------------------------------------------------------------------------


class ConvBlock(nn.Sequential):
    """Conv1d, GroupNorm, Mish."""

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


def sinusoids(timesteps: Tensor, dim: int) -> Tensor:
    """(...) int64 -> (..., dim): sines, then cosines, of geometrically falling rates."""
    half = dim // 2
    exponents = torch.arange(half, device=timesteps.device) * (-math.log(10000) / (half - 1))
    angles = timesteps[..., None] * exponents.exp()  # (..., dim / 2)
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


class ConditionalUNet1d(nn.Module):
    """DP3's 1D U-Net over time, with task-conditioned feature modulation (TCFM).

    Every residual block is modulated by h_k = MLP([timestep embedding, observation features])
    (Eq. 7), but for the two blocks of the level that `tcfm` names, which take U2T's output (Eq.
    10): the first down-sampling level (`down`, the paper's), the middle (`mid`) or the last
    up-sampling level (`up`). DP3 has no MLP: there h_k is the concatenation itself.
    """

    def __init__(self, config: PolicyConfig):
        super().__init__()
        self.tcfm = config.tcfm
        self.timestep_dim = config.timestep_dim
        width = config.timestep_dim
        wide, c = 4 * width, config.condition_dim
        self.timestep_mlp = nn.Sequential(nn.Linear(width, wide), Mish(), nn.Linear(wide, width))
        mlp = nn.Sequential(nn.Linear(c, c), Mish(), nn.Linear(c, c))
        self.condition_mlp = mlp if config.reads_task else nn.Identity()

        widths = config.unet_widths
        self.down = nn.ModuleList()
        for level, (d_in, d_out) in enumerate(pairwise((config.action_dim, *widths))):
            last = level == len(widths) - 1
            shrink = nn.Identity() if last else nn.Conv1d(d_out, d_out, 3, stride=2, padding=1)
            blocks = [ResidualBlock(d_in, d_out, config), ResidualBlock(d_out, d_out, config)]
            self.down.append(nn.ModuleList([*blocks, shrink]))

        self.mid = nn.ModuleList(ResidualBlock(widths[-1], widths[-1], config) for _ in range(2))
        self.up = nn.ModuleList()
        for d_out, d_in in pairwise(reversed(widths)):
            # d_out channels come up from below, and d_out from the skip connection
            blocks = [ResidualBlock(2 * d_out, d_in, config), ResidualBlock(d_in, d_in, config)]
            grow = nn.ConvTranspose1d(d_in, d_in, 4, stride=2, padding=1)
            self.up.append(nn.ModuleList([*blocks, grow]))
        self.head = nn.Sequential(
            ConvBlock(widths[0], widths[0], config.kernel_size, config.n_groups),
            nn.Conv1d(widths[0], config.action_dim, 1),
        )

    def condition(self, timesteps: Tensor, observation: Tensor) -> Tensor:
        """h_k: timesteps (B,) int64, observation (B, To * feature) -> (B, C)   (Eq. 7)."""
        embedding = sinusoids(timesteps, self.timestep_dim)  # (B, timestep_dim)
        embedding = self.timestep_mlp(embedding.to(observation.dtype))
        return self.condition_mlp(torch.cat([embedding, observation], dim=-1))

    def forward(self, actions: Tensor, h: Tensor, fused: Tensor | None = None) -> Tensor:
        """Noisy actions (B, H, A), h_k (B, C), U2T's output (B, C) -> clean actions (B, H, A)."""
        conditions = {level: h for level in ("down", "mid", "up")}
        if fused is not None:
            conditions[self.tcfm] = fused  # Eq. 10
        x = actions.transpose(1, 2)  # (B, A, H)
        skips = []
        for level, (block1, block2, shrink) in enumerate(self.down):
            c = conditions["down"] if level == 0 else h
            x = block2(block1(x, c), c)  # (B, width, L)
            skips.append(x)
            x = shrink(x)  # (B, width, L / 2), but for the last level
        for block in self.mid:
            x = block(x, conditions["mid"])
        for level, (block1, block2, grow) in enumerate(self.up):
            c = conditions["up"] if level == len(self.up) - 1 else h
            x = torch.cat([x, skips.pop()], dim=1)  # (B, 2 width, L)
            x = grow(block2(block1(x, c), c))  # (B, width above, 2 L)
        return self.head(x).transpose(1, 2)  # (B, H, A)


# ---- Diffusion and normalization -----------------------------------------------------------------


class DiffusionSchedule(nn.Module):
    """Forward noising and deterministic DDIM sampling, with networks that predict the clean sample.

    Betas follow the squared-cosine schedule of improved DDPM, capped at 0.999.
    """

    def __init__(self, diffusion_steps: int = 100, inference_steps: int = 10, sampler="ddim"):
        super().__init__()
        self.sampler = sampler
        self.diffusion_steps, self.inference_steps = diffusion_steps, inference_steps
        t = torch.arange(diffusion_steps + 1, dtype=torch.float64) / diffusion_steps
        level = torch.cos((t + 0.008) / 1.008 * math.pi / 2) ** 2  # the ideal cumulative product
        betas = (1 - level[1:] / level[:-1]).clamp(max=0.999)
        products = (1 - betas).cumprod(0).float()  # (K,), not saved: they follow from the steps
        self.register_buffer("alphas_cumprod", products, persistent=False)

    def add_noise(self, sample: Tensor, noise: Tensor, timesteps: Tensor) -> Tensor:
        """A_k = sqrt(a_k) A_0 + sqrt(1 - a_k) noise; both (B, H, A), timesteps (B,) int64."""
        a = self.alphas_cumprod[timesteps][:, None, None].to(sample.dtype)  # (B, 1, 1)
        return a.sqrt() * sample + (1 - a).sqrt() * noise

    def timesteps(self) -> list[int]:
        """The diffusion steps that sampling visits, from noisy to clean: 90, 80, ..., 0."""
        stride = self.diffusion_steps // self.inference_steps
        return list(range(0, self.diffusion_steps, stride))[::-1]

    def step(self, prediction: Tensor, k: int, noisy: Tensor) -> Tensor:
        """One DDIM step from k to k - K / inference_steps, (B, H, A) -> (B, H, A).

        The noise that is put back leads from the prediction, not clipped, to `noisy`. DP3 pins
        diffusers 0.11.1, which puts back the predicted sample itself (sampler `dp3`): every step
        then asks again from a guess without noise, and more rollouts succeed.
        """
        stride = self.diffusion_steps // self.inference_steps
        a = self.alphas_cumprod[k]
        a_next = self.alphas_cumprod[k - stride] if k >= stride else torch.ones_like(a)
        noise = (noisy - a.sqrt() * prediction) / (1 - a).sqrt()
        if self.sampler == "dp3":
            noise = prediction
        return a_next.sqrt() * prediction.clamp(-1, 1) + (1 - a_next).sqrt() * noise


class Normalizer(nn.Module):
    """Maps points, state and action to [-1, 1], each coordinate by its range in the data."""

    def __init__(self, state_dim: int, action_dim: int):
        super().__init__()
        for name, dim in {"points": 3, "state": state_dim, "action": action_dim}.items():
            self.register_buffer(f"{name}_center", torch.zeros(dim))
            self.register_buffer(f"{name}_scale", torch.ones(dim))

    def fit(self, points: Tensor, state: Tensor, action: Tensor) -> None:
        """Sets the ranges from data: points (..., 3), state (..., S), action (..., A).

        A coordinate that hardly moves (range under 1e-4) is centred and not stretched; of an action
        it is, since what is drawn from [-1, 1] must come back as what the demonstrations did.
        """
        for name, data in {"points": points, "state": state, "action": action}.items():
            data = data.flatten(0, -2).float()
            low, high = data.amin(0), data.amax(0)
            half = (high - low) / 2
            getattr(self, f"{name}_center").copy_((low + high) / 2)
            constant = 5e-5 if name == "action" else 1.0
            getattr(self, f"{name}_scale").copy_(torch.where(half < 5e-5, constant, half))

    def normalize(self, name: str, x: Tensor) -> Tensor:
        """x (..., dim) in its own unit -> [-1, 1]; `name` is points, state or action."""
        return (x - getattr(self, f"{name}_center")) / getattr(self, f"{name}_scale")

    def unnormalize(self, name: str, x: Tensor) -> Tensor:
        """The inverse of `normalize`."""
        return x * getattr(self, f"{name}_scale") + getattr(self, f"{name}_center")


# ---- The policy, and its moving average ----------------------------------------------------------

Context = tuple[Tensor, ...] | None  # what `encode_demo` makes of a task; None: no task is read


class DAMIPolicy(nn.Module):
    """The policy: two observations, an instruction and a demonstration in; actions out."""

    demo_encoders: ClassVar = {"vmt": VisualMotorTrajectory}  # baselines.py exchanges both
    network = ConditionalUNet1d

    def __init__(self, config: PolicyConfig):
        super().__init__()
        self.config = config
        self.normalizer = Normalizer(config.state_dim, config.action_dim)
        self.observation_encoder = ObservationEncoder(config)
        if config.demo_encoder != "none":
            self.demo_encoder = self.demo_encoders[config.demo_encoder](config)
        if config.tcfm != "none":
            self.u2t = UnpairedUnifiedTask(config)
        self.unet = self.network(config)
        steps = config.diffusion_steps, config.inference_steps
        self.schedule = DiffusionSchedule(*steps, config.sampler)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """The parameters by adaptation learning rate: `vision`, `diffusion`, `other` (VMT, U2T)."""
        groups = {"vision": [], "diffusion": [], "other": []}
        place = {"observation_encoder": "vision", "unet": "diffusion"}
        for name, parameter in self.named_parameters():
            groups[place.get(name.split(".")[0], "other")].append(parameter)
        return groups

    def encode_observations(self, points: Tensor, state: Tensor) -> Tensor:
        """points (..., N, 3) in metres, state (..., S) -> (..., observation_feature_dim)."""
        normalize = self.normalizer.normalize
        return self.observation_encoder(normalize("points", points), normalize("state", state))

    def encode_demo(
        self,
        text: Tensor | None = None,
        demo_points: Tensor | None = None,
        demo_state: Tensor | None = None,
        demo_action: Tensor | None = None,
    ) -> Context:
        """Encodes what names a task. It depends on no observation: once a rollout is enough.

        Takes instruction features (D, text_dim), and complete demonstrations, already strided:
        (D, T, N, 3) in metres, (D, T, S), (D, T, A). Returns what `loss` and `sample_actions`
        condition on. Raises ValueError for more frames than learned positions.
        """
        config = self.config
        if not config.reads_task:
            return None
        tokens = None
        if config.demo_encoder != "none":
            shown = {"demo_points": demo_points, "demo_state": demo_state}
            self.check_shapes(**shown, demo_action=demo_action, text=text)
            if (T := demo_points.shape[1]) > (most := config.demo_positions):
                raise ValueError(f"a demonstration has {T} frames, the policy {most} positions")
            features = self.encode_observations(demo_points, demo_state)  # (D, T, feature)
            actions = self.normalizer.normalize("action", demo_action)  # (D, T, A)
            tokens = self.demo_encoder(features, actions)  # (D, T, demo_dim)
        else:
            self.check_shapes(text=text)
        return self.u2t.encode_context(tokens, text)

    def denoise(
        self, noisy: Tensor, timesteps: Tensor, observation: Tensor, context: Context
    ) -> Tensor:
        """A_k (B, H, A), k (B,) int64, observation (B, To * feature) -> predicted A_0 (B, H, A)."""
        h = self.unet.condition(timesteps, observation)  # (B, C)
        return self.unet(noisy, h, None if context is None else self.u2t(h, context))

    def loss(
        self,
        points: Tensor,
        state: Tensor,
        action: Tensor,
        noise: Tensor,
        timesteps: Tensor,
        **task,
    ) -> Tensor:
        """The diffusion loss, () float: squared error of the predicted clean actions (Eq. 1).

        It is the mean over windows and over a window's H * A numbers, as in DP3's code. The paper
        writes a squared norm, their sum: 64 times as much at H = 16, A = 4. AdamW does not feel the
        factor, an SGD inner step does. The loss is a pure function of parameters and arguments.

        Args:
            points, state, action: B windows, the older observation first, ordered by task:
                (B, To, N, 3) in metres, (B, To, S), (B, H, A).
            noise, timesteps: standard normal (B, H, A), and k in [0, K), (B,) int64.
            task: the arguments of `encode_demo`, of D tasks; D divides B.
        """
        chunks = {"action": action, "noise": noise, "timesteps": timesteps}
        self.check_shapes(points=points, state=state, **chunks)
        context = self.encode_demo(**task)
        clean = self.normalizer.normalize("action", action)  # A_0, (B, H, A)
        noisy = self.schedule.add_noise(clean, noise, timesteps)  # A_k, (B, H, A)
        observation = self.encode_observations(points, state).flatten(1)  # (B, To * feature)
        return F.mse_loss(self.denoise(noisy, timesteps, observation, context), clean)

    forward = loss  # so that torch.func.functional_call(policy, params, (), batch) is the loss

    @torch.no_grad()
    def sample_actions(
        self, points: Tensor, state: Tensor, context: Context, generator: Generator | None = None
    ) -> Tensor:
        """Draws an action chunk by DDIM from Gaussian noise.

        Takes the last To observations, the older first, (B, To, N, 3) in metres and (B, To, S), the
        context of D tasks, and the source of the initial noise. Returns (B, Ta, A), to be executed
        from the newest observation on, in the demonstrations' unit.
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

        return self.executed(actions)

    def executed(self, actions: Tensor) -> Tensor:
        """Normalized (B, H, A) -> (B, Ta, A) from the newest observation on, in their own unit."""
        newest = self.config.n_obs_steps - 1
        chunk = actions[:, newest : newest + self.config.n_action_steps]  # (B, Ta, A)
        return self.normalizer.unnormalize("action", chunk)

    def check_shapes(self, **inputs: Tensor | None) -> None:
        """Raises ValueError for what is missing, or would broadcast to a wrong result silently."""
        sizes = {}  # what each letter stands for; a number for itself
        for name, x in inputs.items():
            expected, found = self.shapes()[name], () if x is None else tuple(x.shape)
            if len(found) == len(expected):
                for n, size in zip(expected, found):
                    sizes.setdefault(n, size if isinstance(n, str) else n)
                expected = tuple(sizes[n] for n in expected)
            if found != expected:
                found, takes = "missing" if x is None else found, str(expected).replace("'", "")
                raise ValueError(f"{name} is {found}, the policy takes {takes}")

    def shapes(self) -> dict[str, tuple[int | str, ...]]:
        """What each input's shape must be, where a letter stands for any size, but one for all."""
        To, S, A = self.config.n_obs_steps, self.config.state_dim, self.config.action_dim
        seen = {"points": ("B", To, "N", 3), "state": ("B", To, S), "timesteps": ("B",)}
        shown = {"demo_points": ("D", "T", "N", 3), "demo_state": ("D", "T", S)}
        shown |= {"demo_action": ("D", "T", A), "text": ("D", self.config.text_dim)}
        chunk = ("B", self.config.horizon, A)
        return {**seen, **shown, "action": chunk, "noise": chunk}

    def draw_noise_and_timesteps(self, n: int, generator: Generator) -> dict[str, Tensor]:
        """Draws what makes `loss` pure: noise (n, H, A) and timesteps (n,) int64."""
        config, device = self.config, self.normalizer.action_scale.device
        source = {"generator": generator, "device": generator.device}
        noise = torch.randn(n, config.horizon, config.action_dim, **source)
        timesteps = torch.randint(config.diffusion_steps, (n,), **source)
        return {"noise": noise.to(device), "timesteps": timesteps.to(device)}


def ema_model(policy: DAMIPolicy) -> AveragedModel:
    """The exponential moving average of a policy in training; the averaged policy is its `.module`.

    `.update_parameters(policy)` belongs after each step. The decay grows as the paper's.
    """

    @torch.no_grad()
    def update(averaged: list[Tensor], current: list[Tensor], step: Tensor) -> None:
        decay = min(0.9999, 1 - (1 + int(step)) ** -0.75)
        torch._foreach_lerp_(averaged, current, 1 - decay)

    return AveragedModel(policy, multi_avg_fn=update)


# ---- Written out for speed, or for PyTorch's bug: skip this when reading the method --------------


class LayerNorm(nn.LayerNorm):
    """Layer normalization, its weight and bias applied outside PyTorch's fused function (2.13).

    Inside it the second derivative is wrong, silently, under `torch.vmap` with another weight for
    each entry: the vectorized meta-gradient, where every task has adapted weights.
    """

    def forward(self, x: Tensor) -> Tensor:
        return F.layer_norm(x, self.normalized_shape, eps=self.eps) * self.weight + self.bias


class GroupNorm(nn.GroupNorm):
    """Group normalization through `layer_norm`: 40 % fewer operations in the second derivative."""

    def forward(self, x: Tensor) -> Tensor:
        """(B, channels, L) -> (B, channels, L)."""
        groups = x.unflatten(1, (self.num_groups, -1)).flatten(2)  # (B, groups, channels / .. * L)
        x = F.layer_norm(groups, groups.shape[-1:], eps=self.eps).view_as(x)
        return x * self.weight[:, None] + self.bias[:, None]


class Mish(nn.Module):
    """x tanh(log(1 + e^x)): faster than PyTorch's own, above all in the second derivative."""

    def forward(self, x: Tensor) -> Tensor:
        return x * torch.tanh(F.softplus(x))


class Conv1d(nn.Conv1d):
    """A convolution that keeps the length; a wide one, on a CPU, is written as a matrix product.

    PyTorch's own (2.13) takes up to eight times as long there for the gradient of the weight.
    """

    def __init__(self, d_in: int, d_out: int, kernel_size: int):
        super().__init__(d_in, d_out, kernel_size, padding=kernel_size // 2)
        self.wide = d_in * d_out >= 1024**2

    def forward(self, x: Tensor) -> Tensor:
        """(B, d_in, L) -> (B, d_out, L)."""
        if x.is_cuda or not self.wide:
            return super().forward(x)
        pad = self.padding[0]
        padded = F.pad(x, (pad, pad)).transpose(1, 2)  # (B, L + k - 1, d_in)
        shifted = [padded[:, i : i + x.shape[-1]] for i in range(self.kernel_size[0])]
        windows = torch.stack(shifted, dim=-1).flatten(2)  # (B, L, d_in * k)
        return F.linear(windows, self.weight.flatten(1), self.bias).transpose(1, 2)


class WinningPoints(torch.autograd.Function):
    """Which points of each cloud win the maximum over points in some channel of a PointNet.

    A third of 128 do, a sixth of 512. A pass without gradient finds them, a few clouds at a time,
    which stay in the CPU's cache. Their number depends on the data: `vmap` needs a rule of its own.
    """

    @staticmethod
    def forward(points: Tensor, *layers: Tensor) -> Tensor:
        """points (..., N, 3); weight, bias, norm's weight and bias of each layer -> (..., W)."""
        return WinningPoints.indices(WinningPoints.wins(points, layers), len(layers[-1]))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.mark_non_differentiable(output)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *inputs: Tensor) -> tuple[Tensor, int]:
        """`forward` for several tasks, one after the other; (tasks, ..., W) has one W for all."""
        won = []
        for task in range(info.batch_size):
            entries = [x if dim is None else x.select(dim, task) for x, dim in zip(inputs, in_dims)]
            won.append(WinningPoints.wins(entries[0], entries[1:]))
        return WinningPoints.indices(torch.stack(won), inputs[-1].shape[-1]), 0

    @staticmethod
    def wins(points: Tensor, layers: Sequence[Tensor]) -> Tensor:
        """points (..., N, 3) -> (..., N) int8: 1 for those that win a channel."""
        clouds = points.reshape(-1, *points.shape[-2:])  # (clouds, N, 3)
        at_once = len(clouds) if points.is_cuda else max(1, 4096 // points.shape[-2])
        winners = []
        for x in clouds.split(at_once):
            for weight, bias, norm_weight, norm_bias in zip(*(layers[i::4] for i in range(4))):
                x = F.linear(x, weight, bias)  # (at_once, N, width)
                x = F.layer_norm(x, bias.shape, norm_weight, norm_bias).relu_()
            winners.append(x.max(dim=-2).indices)  # (at_once, widths[-1]); faster than argmax
        won = torch.zeros(clouds.shape[:-1], dtype=torch.int8, device=points.device)
        return won.scatter_(-1, torch.cat(winners), 1).view(points.shape[:-1])

    @staticmethod
    def indices(won: Tensor, channels: int) -> Tensor:
        """(..., N) int8 -> (..., W) int64: winners first, then others, W the most in any cloud."""
        if won.is_cuda:
            most = min(channels, won.shape[-1])  # a bound: the host does not wait for the GPU
        else:
            most = int(won.sum(dim=-1).max())
        return won.argsort(dim=-1, descending=True, stable=True)[..., :most]
