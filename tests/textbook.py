"""DP3 as a textbook would write it: what our policy without a demonstration is compared with.

PyTorch's own layers, every point through the differentiated PointNet, `diffusers` for the noise, an
optimizer with its defaults, a moving average parameter by parameter. Names of parameters are ours,
so that our weights can be loaded.
"""

import torch
import torch.nn.functional as F
from diffusers import DDPMScheduler
from torch import nn

from model import Normalizer, PolicyConfig


class PointNet(nn.Module):
    def __init__(self, widths, feature_dim):
        super().__init__()
        layers, d_in = [], 3
        for d_out in widths:
            layers += [nn.Linear(d_in, d_out), nn.LayerNorm(d_out), nn.ReLU()]
            d_in = d_out
        self.mlp = nn.Sequential(*layers)
        self.projection = nn.Sequential(nn.Linear(d_in, feature_dim), nn.LayerNorm(feature_dim))

    def forward(self, points):
        return self.projection(self.mlp(points).max(dim=-2).values)


class ObservationEncoder(nn.Module):
    def __init__(self, config):
        super().__init__()
        self.pointnet = PointNet(config.pointnet_widths, config.point_feature_dim)
        width = config.state_feature_dim
        self.state_mlp = nn.Sequential(
            nn.Linear(config.state_dim, width), nn.ReLU(), nn.Linear(width, width)
        )

    def forward(self, points, state):
        return torch.cat([self.pointnet(points), self.state_mlp(state)], dim=-1)


def conv_block(d_in, d_out, config):
    convolution = nn.Conv1d(d_in, d_out, config.kernel_size, padding=config.kernel_size // 2)
    return nn.Sequential(convolution, nn.GroupNorm(config.n_groups, d_out), nn.Mish())


class ResidualBlock(nn.Module):
    def __init__(self, d_in, d_out, config):
        super().__init__()
        self.conv1 = conv_block(d_in, d_out, config)
        self.film = nn.Sequential(nn.Mish(), nn.Linear(config.condition_dim, 2 * d_out))
        self.conv2 = conv_block(d_out, d_out, config)
        self.residual = nn.Conv1d(d_in, d_out, 1) if d_in != d_out else nn.Identity()

    def forward(self, x, condition):
        scale, bias = self.film(condition).unsqueeze(-1).chunk(2, dim=1)
        return self.conv2(self.conv1(x) * scale + bias) + self.residual(x)


class ConditionEncoder(nn.Module):
    def __init__(self, config):
        super().__init__()
        self.width = width = config.timestep_dim
        self.timestep_mlp = nn.Sequential(
            nn.Linear(width, 4 * width), nn.Mish(), nn.Linear(4 * width, width)
        )

    def forward(self, timesteps, observation):
        half = self.width // 2
        rates = 10000 ** (-torch.arange(half, device=timesteps.device) / (half - 1))
        angles = timesteps[:, None] * rates[None]
        step = self.timestep_mlp(torch.cat([torch.sin(angles), torch.cos(angles)], dim=-1))
        return torch.cat([step, observation], dim=-1)


class UNet(nn.Module):
    def __init__(self, config):
        super().__init__()
        levels = [config.action_dim, *config.unet_widths]
        self.down, self.mid, self.up = nn.ModuleList(), nn.ModuleList(), nn.ModuleList()
        for i in range(1, len(levels)):
            inside = i < len(levels) - 1
            downsample = nn.Conv1d(levels[i], levels[i], 3, 2, 1) if inside else nn.Identity()
            first, second = (
                ResidualBlock(levels[i - 1], levels[i], config),
                ResidualBlock(levels[i], levels[i], config),
            )
            self.down.append(nn.ModuleList([first, second, downsample]))
        self.mid.extend(ResidualBlock(levels[-1], levels[-1], config) for _ in range(2))
        for i in range(len(levels) - 1, 1, -1):
            first = ResidualBlock(2 * levels[i], levels[i - 1], config)
            second = ResidualBlock(levels[i - 1], levels[i - 1], config)
            upsample = nn.ConvTranspose1d(levels[i - 1], levels[i - 1], 4, 2, 1)
            self.up.append(nn.ModuleList([first, second, upsample]))
        self.head = nn.Sequential(
            conv_block(levels[1], levels[1], config),
            nn.Conv1d(levels[1], config.action_dim, kernel_size=1),
        )

    def forward(self, noisy, condition):
        x, kept = noisy.permute(0, 2, 1), []
        for first, second, downsample in self.down:
            x = second(first(x, condition), condition)
            kept.append(x)
            x = downsample(x)
        for block in self.mid:
            x = block(x, condition)
        for first, second, upsample in self.up:
            x = torch.cat([x, kept.pop()], dim=1)
            x = upsample(second(first(x, condition), condition))
        return self.head(x).permute(0, 2, 1)


class TextbookDP3(nn.Module):
    def __init__(self, config: PolicyConfig):
        super().__init__()
        self.normalizer = Normalizer(config.state_dim, config.action_dim)
        self.observation_encoder = ObservationEncoder(config)
        self.condition_encoder = ConditionEncoder(config)
        self.denoiser = UNet(config)
        self.scheduler = DDPMScheduler(config.diffusion_steps, beta_schedule="squaredcos_cap_v2")

    def loss(self, points, state, action, noise, timesteps):
        points = self.normalizer.normalize("points", points)
        state = self.normalizer.normalize("state", state)
        action = self.normalizer.normalize("action", action)
        observation = self.observation_encoder(points, state).flatten(1)
        noisy = self.scheduler.add_noise(action, noise, timesteps)
        condition = self.condition_encoder(timesteps, observation)
        return F.mse_loss(self.denoiser(noisy, condition), action)


def training_step(
    policy: TextbookDP3, average: TextbookDP3, optimizer: torch.optim.Optimizer, batch: dict
) -> None:
    """One step of plain training: gradient, AdamW, moving average."""
    loss = policy.loss(**batch)
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    with torch.no_grad():
        for kept, new in zip(average.parameters(), policy.parameters()):
            kept.mul_(0.99).add_(new, alpha=0.01)
