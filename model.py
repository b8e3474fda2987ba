r"""Everything with weights: the DAMI policy, from CLIP's text tower to the diffusion U-Net.

    instruction -> CLIP text tower (frozen) ----------------------------\
    demonstration -> observation encoder -> VMT (demonstration tokens) --+-> U2T -> condition of the first level -\
    two observations -> observation encoder --\                          |                                        |
    diffusion timestep k -> embedding ---------+-> MLP -> h_k -----------+-> condition of all other levels --------+
                                                                                                                  |
    noisy actions A_k ----------------------------------------------------> U-Net, modulated by FiLM (TCFM) <------/
                                                                              \-> clean actions A_0

The file reads from the small blocks to `DAMIPolicy`, imports nothing from the project and can be copied out alone
(with `assets/bpe_simple_vocab_16e6.txt.gz` for the tokenizer). `python model.py` prints every module and its size.

Letters: B windows, G windows that share one demonstration, D demonstrations (B = D * G), T demonstration frames,
N points, To = 2 observation steps, H = 16 horizon, Ta = 8 executed actions, A action dim, S state dim, K = 100
diffusion steps, C width of a sequence (of the condition: C = timestep_dim + To * observation feature).
Clouds and poses in metres; actions, like everything inside the networks, in [-1, 1] after `Normalizer`.
"""

import argparse
import gzip
import hashlib
import html
import http.client
import math
import os
import pickle
import shutil
import sys
import urllib.request
import warnings
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import ftfy
import regex
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel
from tqdm import tqdm


class InputError(ValueError):
    """Something the user gave cannot be used; the message says what to do."""


# ---- Configuration ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PolicyConfig:
    """The whole architecture. It is stored in every checkpoint, and the policy is rebuilt from it.

    The defaults are the paper's (hyperparameter table), with Meta-World's dimensions.
    """

    state_dim: int = 9  # S: end effector, right finger, left finger, metres
    action_dim: int = 4  # A: dx, dy, dz, gripper
    num_points: int = 512  # N
    horizon: int = 16  # H, the actions of a window
    n_obs_steps: int = 2  # To
    n_action_steps: int = 8  # Ta, executed before the policy looks again
    pointnet_widths: tuple[int, ...] = (64, 128, 256)
    point_feature_dim: int = 64
    state_feature_dim: int = 64
    demo_encoder: str = "vmt"  # vmt | mlp | none
    demo_stride: int = 1  # the demonstration encoder reads every demo_stride-th frame
    demo_positions: int = 200  # learned positions: the longest demonstration, after the stride
    demo_dim: int = 128
    vmt_layers: int = 2
    vmt_heads: int = 4
    tcfm: str = "down"  # which U-Net level reads the demonstration: down | mid | up | none
    u2t_layers: int = 1
    u2t_heads: int = 8
    text_dim: int = 512
    timestep_dim: int = 128
    unet_widths: tuple[int, ...] = (512, 1024, 2048)
    kernel_size: int = 5
    n_groups: int = 8
    diffusion_steps: int = 100  # K
    inference_steps: int = 10

    def __post_init__(self):
        # A checkpoint brings lists back where tuples went in.
        object.__setattr__(self, "pointnet_widths", tuple(self.pointnet_widths))
        object.__setattr__(self, "unet_widths", tuple(self.unet_widths))
        for name, choices in {"demo_encoder": ("vmt", "mlp", "none"), "tcfm": ("down", "mid", "up", "none")}.items():
            if getattr(self, name) not in choices:
                raise InputError(f"{name} is {getattr(self, name)!r}; it must be one of {', '.join(choices)}")
        if self.tcfm == "none" and self.demo_encoder != "none":
            raise InputError(f"tcfm 'none' leaves demo_encoder {self.demo_encoder!r} unread; set both to 'none'")
        if self.n_action_steps > self.horizon - self.n_obs_steps + 1:
            raise InputError(
                f"n_action_steps {self.n_action_steps} is more than the {self.horizon - self.n_obs_steps + 1} actions that "
                f"a horizon of {self.horizon} holds from the last of {self.n_obs_steps} observations on"
            )
        shrink = 2 ** (len(self.unet_widths) - 1)
        if self.horizon % shrink:
            raise InputError(
                f"horizon {self.horizon} must be a multiple of {shrink}: the U-Net halves it between levels"
            )
        if self.diffusion_steps % self.inference_steps:
            raise InputError(
                f"diffusion_steps {self.diffusion_steps} must be a multiple of inference_steps {self.inference_steps}"
            )
        for width, parts, what in [
            (self.demo_dim, self.vmt_heads, "demo_dim by vmt_heads"),
            (self.condition_dim, self.u2t_heads, "condition width by u2t_heads"),
            *((width, self.n_groups, "U-Net width by n_groups") for width in self.unet_widths),
        ]:
            if width % parts:
                raise InputError(f"cannot divide {what}: {width} by {parts}")

    @property
    def observation_feature_dim(self) -> int:
        """Feature width of one frame."""
        return self.point_feature_dim + self.state_feature_dim

    @property
    def condition_dim(self) -> int:
        """C, the width of h_k and of U2T."""
        return self.timestep_dim + self.n_obs_steps * self.observation_feature_dim


PRESETS = {
    "paper": PolicyConfig(),
    "small": PolicyConfig(
        num_points=128,
        pointnet_widths=(32, 64, 128),
        state_feature_dim=32,
        demo_stride=16,
        demo_positions=13,
        timestep_dim=64,
        unet_widths=(32, 64, 128),
    ),
    "tiny": PolicyConfig(
        num_points=64,
        pointnet_widths=(16, 32),
        point_feature_dim=16,
        state_feature_dim=16,
        demo_stride=20,
        demo_positions=10,
        demo_dim=32,
        timestep_dim=32,
        unet_widths=(16, 32),
    ),
}


# ---- Layer normalization ---------------------------------------------------------------------------------------------


class LayerNorm(nn.LayerNorm):
    """Layer normalization whose weight and bias are applied outside the fused function.

    Inside it (torch 2.13), the second derivative is wrong, silently, under `torch.vmap` with another weight for each
    entry: the vectorized meta-gradient, where every task has adapted weights of its own.
    """

    def forward(self, x: Tensor) -> Tensor:
        return F.layer_norm(x, self.normalized_shape, eps=self.eps) * self.weight + self.bias


# ---- Attention: the one block of CLIP, VMT and U2T -------------------------------------------------------------------


class Attention(nn.Module):
    """Multi-head softmax attention, written out: fused kernels have no double backward."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)

    def project(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(B, T, C) -> queries, keys and values, each (B, heads, T, C / heads)."""
        q, k, v = self.qkv(x).chunk(3, dim=-1)  # 3 x (B, T, C)
        return tuple(z.unflatten(-1, (self.heads, -1)).transpose(1, 2) for z in (q, k, v))

    def merge(self, x: Tensor) -> Tensor:
        """(B, heads, T, C / heads) -> (B, T, C), mixed over the heads."""
        return self.out(x.transpose(1, 2).flatten(2))

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        """(B, T, C) -> (B, T, C); `mask` (T, T) is added to the scores: -inf where a query must not look."""
        q, k, v = self.project(x)
        scores = q @ k.transpose(-2, -1) * q.shape[-1] ** -0.5  # (B, heads, T, T)
        if mask is not None:
            scores = scores + mask
        return self.merge(scores.softmax(dim=-1) @ v)  # (B, T, C)


class TransformerBlock(nn.Module):
    """Pre-norm residual block: attention, then an MLP four times as wide."""

    def __init__(self, width: int, heads: int, activation: nn.Module | None = None):
        super().__init__()
        self.norm1 = LayerNorm(width)
        self.attention = Attention(width, heads)
        self.norm2 = LayerNorm(width)
        self.mlp = nn.Sequential(nn.Linear(width, 4 * width), activation or nn.GELU(), nn.Linear(4 * width, width))

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        """(B, T, C) -> (B, T, C)."""
        x = x + self.attention(self.norm1(x), mask)
        return x + self.mlp(self.norm2(x))


# ---- Text: CLIP's tokenizer and text tower ---------------------------------------------------------------------------

CLIP_MERGES = Path(__file__).parent / "assets" / "bpe_simple_vocab_16e6.txt.gz"
CLIP_SHA256 = "40d365715913c9da98579312b702a82c18be219cc2a73407c4526f58eba950af"  # of the official ViT-B-32.pt
CLIP_URL = f"https://openaipublic.azureedge.net/clip/models/{CLIP_SHA256}/ViT-B-32.pt"
START, END = "<|startoftext|>", "<|endoftext|>"
WORD = regex.compile(
    rf"{regex.escape(START)}|{regex.escape(END)}|'s|'t|'re|'ve|'m|'ll|'d|\p{{L}}+|\p{{N}}|[^\s\p{{L}}\p{{N}}]+",
    regex.IGNORECASE,
)


@lru_cache
def clip_vocabulary() -> tuple[dict[int, str], dict[tuple[str, str], int], dict[str, int]]:
    """CLIP's byte -> symbol, pair of symbols -> rank of their merge, symbol -> token id."""
    printable = [byte for byte in range(256) if 33 <= byte <= 126 or 161 <= byte <= 172 or byte >= 174]
    others = [byte for byte in range(256) if byte not in printable]
    symbols = {byte: chr(byte) for byte in printable} | {byte: chr(256 + i) for i, byte in enumerate(others)}
    with gzip.open(CLIP_MERGES, "rt", encoding="utf-8") as lines:
        merges = [tuple(line.split()) for line in lines.read().split("\n")[1:48895]]  # the ones CLIP was trained with
    words = [*symbols.values(), *(s + "</w>" for s in symbols.values()), *(a + b for a, b in merges), START, END]
    return symbols, {pair: rank for rank, pair in enumerate(merges)}, {word: i for i, word in enumerate(words)}


@lru_cache(maxsize=65536)
def tokenize_word(word: str) -> list[int]:
    """Byte-pair encoding of one word: the pair that was merged earliest in training is merged first."""
    symbols, ranks, ids = clip_vocabulary()
    if word in (START, END):
        return [ids[word]]
    parts = [symbols[byte] for byte in word.encode()]
    parts[-1] += "</w>"
    while len(parts) > 1:
        first, second = min(pairwise(parts), key=lambda pair: ranks.get(pair, len(ranks)))
        if (first, second) not in ranks:
            break
        merged = []
        for part in parts:
            if merged and merged[-1] == first and part == second:
                merged[-1] = first + second
            else:
                merged.append(part)
        parts = merged
    return [ids[part] for part in parts]


def tokenize(texts: str | list[str], context_length: int = 77) -> Tensor:
    """CLIP's token ids of one or more texts, (B, context_length) int64: start, words, end, zeros.

    Text is repaired (ftfy), HTML entities are resolved and letters lower-cased; white space only separates words.
    A text with too many tokens is cut, and its last token is the end token (as transformers and open_clip do;
    OpenAI's own function raises).
    """
    texts = [texts] if isinstance(texts, str) else list(texts)
    _, _, ids = clip_vocabulary()
    tokens = torch.zeros(len(texts), context_length, dtype=torch.long)
    for row, text in zip(tokens, texts):
        text = html.unescape(html.unescape(ftfy.fix_text(text))).lower()
        words = [i for word in WORD.findall(text) for i in tokenize_word(word)]
        words = [ids[START], *words[: context_length - 2], ids[END]]
        row[: len(words)] = torch.tensor(words)
    return tokens  # (B, context_length)


class QuickGELU(nn.Module):
    """The approximation of GELU that CLIP was trained with."""

    def forward(self, x: Tensor) -> Tensor:
        return x * torch.sigmoid(1.702 * x)


def clip_text_shapes() -> dict[str, tuple[int, ...]]:
    """Name and shape of each text tensor in OpenAI's ViT-B/32 checkpoint: vocabulary 49408, context 77, width 512."""
    block = {
        "ln_1.weight": (512,),
        "ln_1.bias": (512,),
        "attn.in_proj_weight": (1536, 512),
        "attn.in_proj_bias": (1536,),
        "attn.out_proj.weight": (512, 512),
        "attn.out_proj.bias": (512,),
        "ln_2.weight": (512,),
        "ln_2.bias": (512,),
        "mlp.c_fc.weight": (2048, 512),
        "mlp.c_fc.bias": (2048,),
        "mlp.c_proj.weight": (512, 2048),
        "mlp.c_proj.bias": (512,),
    }
    return {
        "token_embedding.weight": (49408, 512),
        "positional_embedding": (77, 512),
        **{f"transformer.resblocks.{i}.{name}": shape for i in range(12) for name, shape in block.items()},
        "ln_final.weight": (512,),
        "ln_final.bias": (512,),
        "text_projection": (512, 512),
    }


def our_clip_name(name: str) -> str:
    """The name in CLIPTextEncoder of a tensor of OpenAI's checkpoint."""
    for theirs, ours in {
        "transformer.resblocks": "blocks",
        "attn.in_proj_": "attention.qkv.",
        "attn.out_proj": "attention.out",
        "ln_1": "norm1",
        "ln_2": "norm2",
        "mlp.c_fc": "mlp.0",
        "mlp.c_proj": "mlp.2",
        "ln_final": "norm",
    }.items():
        name = name.replace(theirs, ours)
    return name


class CLIPTextEncoder(nn.Module):
    """CLIP ViT-B/32's text tower, frozen: 12 causal Transformer blocks, the end token projected to 512 numbers.

    Args:
        weights: the text tensors by their names in OpenAI's checkpoint; others are ignored. float16 becomes float32.
        identity: says which weights these are; checkpoints and results carry it.

    Raises:
        InputError: a tensor is missing or has another shape.

    Source: Radford et al. 2021, "Learning Transferable Visual Models From Natural Language Supervision".
    """

    def __init__(self, weights: dict[str, Tensor], identity: str):
        super().__init__()
        self.identity = identity
        shapes = clip_text_shapes()
        for name, shape in shapes.items():
            if name not in weights:
                raise InputError(f"CLIP weights {identity}: '{name}' is missing; give the text tensors of ViT-B-32.pt")
            if weights[name].shape != shape:
                found = tuple(weights[name].shape)
                raise InputError(f"CLIP weights {identity}: '{name}' has shape {found}, that of ViT-B/32 is {shape}")
        with torch.device("meta"):  # no memory and no random numbers: every tensor comes from `weights`
            self.token_embedding = nn.Embedding(49408, 512)
            self.positional_embedding = nn.Parameter(torch.empty(77, 512))
            self.blocks = nn.ModuleList([TransformerBlock(512, 8, QuickGELU()) for _ in range(12)])
            self.norm = LayerNorm(512)
            self.text_projection = nn.Parameter(torch.empty(512, 512))
        self.load_state_dict({our_clip_name(name): weights[name].float() for name in shapes}, assign=True)
        self.register_buffer("mask", torch.full((77, 77), -math.inf).triu(1), persistent=False)  # no look ahead
        self.requires_grad_(False).eval()

    def forward(self, tokens: Tensor) -> Tensor:
        """Text features (B, 512) of token ids (B, T), T <= 77."""
        end = tokens.argmax(dim=-1)  # (B,) the end token has the highest id
        T = int(end.max()) + 1  # exact: no token sees what stands behind it
        x = self.token_embedding(tokens[:, :T]) + self.positional_embedding[:T]  # (B, T, 512)
        for block in self.blocks:
            x = block(x, self.mask[:T, :T])
        x = x[torch.arange(len(x), device=x.device), end]  # (B, 512)
        return self.norm(x) @ self.text_projection

    @torch.no_grad()
    def encode(self, texts: str | list[str]) -> Tensor:
        """Text features (B, 512) float32 of one or more texts, on the encoder's device."""
        return self(tokenize(texts).to(self.text_projection.device))


class StoredTensor(NamedTuple):
    """Where a TorchScript archive keeps a tensor: the arguments of torch._utils._rebuild_tensor_v2."""

    storage: tuple
    offset: int
    size: tuple[int, ...]
    stride: tuple[int, ...]
    requires_grad: bool
    hooks: dict

    def read(self, archive: zipfile.ZipFile, root: str) -> Tensor:
        _, kind, key, _, _ = self.storage  # ("storage", "HalfStorage", "17", device, elements)
        dtype = {"HalfStorage": torch.float16, "FloatStorage": torch.float32}[kind]
        values = torch.frombuffer(bytearray(archive.read(f"{root}data/{key}")), dtype=dtype)
        return values.as_strided(self.size, self.stride, self.offset)


class ArchiveUnpickler(pickle.Unpickler):
    """Reads the modules of a TorchScript archive as bare attributes; nothing in the archive can run.

    `torch.load(weights_only=True)` refuses such archives, and `torch.jit.load` would compile their code and build
    the image tower.
    """

    def find_class(self, module: str, name: str) -> object:
        if module.startswith("__torch__"):
            return type(name, (), {})  # a scripted module: an object with attributes
        if module == "torch" and name.endswith("Storage"):
            return name
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return StoredTensor
        if (module, name) == ("collections", "OrderedDict"):
            return dict
        if module == "torch.jit._pickle":  # a typed list or dict
            return lambda value, *_: value
        raise pickle.UnpicklingError(f"{module}.{name} is not allowed")

    def persistent_load(self, storage: tuple) -> tuple:
        return storage


def read_clip_archive(path: Path) -> dict[str, Tensor]:
    """The text tensors of a TorchScript archive in the layout of OpenAI's ViT-B-32.pt, by name."""
    weights = {}
    with zipfile.ZipFile(path) as archive:
        root = next(name for name in archive.namelist() if name.endswith("/data.pkl")).removesuffix("data.pkl")
        model = ArchiveUnpickler(archive.open(f"{root}data.pkl")).load()
        for name in clip_text_shapes():
            value = model
            for part in name.split("."):
                value = getattr(value, part, None)
            if isinstance(value, StoredTensor):
                weights[name] = value.read(archive, root)
    return weights


def read_clip_file(path: Path) -> CLIPTextEncoder:
    """The text tower of a file the user gave: OpenAI's own, or a plain state dict with the same names."""
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; give CLIP's ViT-B-32.pt")
    sha256 = file_sha256(path)
    if sha256 == CLIP_SHA256:
        return CLIPTextEncoder(read_clip_archive(path), f"openai-ViT-B-32-{sha256[:8]}")
    with open(path, "rb") as file:
        like_zip = file.read(2) == b"PK"
    try:
        names = zipfile.ZipFile(path).namelist() if zipfile.is_zipfile(path) else []
        cut_off = like_zip and not names  # a zip's table of contents stands at its end
        scripted = any(name.endswith("/constants.pkl") for name in names)
        weights = None if cut_off or scripted else torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file fails in a dozen ways
        reason = str(error).split("\n")[0]
        raise InputError(f"{path}: neither CLIP's ViT-B-32.pt nor a plain state dict ({reason})") from None
    if cut_off:
        raise InputError(f"{path}: the file is cut off after {path.stat().st_size} bytes; fetch it again")
    if scripted:
        raise InputError(
            f"{path}: a TorchScript archive with SHA-256 {sha256[:8]}..., not the official {CLIP_SHA256[:8]}...; "
            "fetch ViT-B-32.pt again, or give other weights as a plain state dict (torch.save)"
        )
    if not isinstance(weights, dict) or not all(isinstance(value, Tensor) for value in weights.values()):
        raise InputError(f"{path}: holds something other than a plain state dict (names and tensors)")
    return CLIPTextEncoder(weights, f"state-dict-{sha256[:8]}")


def file_sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while chunk := file.read(1 << 20):
            digest.update(chunk)
    return digest.hexdigest()


def download_clip(path: Path) -> None:
    """Fetch OpenAI's ViT-B-32.pt; it appears at `path` complete and checked, or not at all."""
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        with urllib.request.urlopen(CLIP_URL, timeout=5) as response:
            size = int(response.headers.get("Content-Length", 0))
            path.parent.mkdir(parents=True, exist_ok=True)
            with open(part, "wb") as file, tqdm(total=size, unit="B", unit_scale=True, desc=path.name) as bar:
                while chunk := response.read(1 << 20):
                    bar.update(file.write(chunk))
        if part.stat().st_size < size:
            raise OSError(f"the connection ended after {part.stat().st_size} of {size} bytes")
        if file_sha256(part) != CLIP_SHA256:
            raise InputError(f"{CLIP_URL}: what arrived has another SHA-256 and was thrown away; give a file yourself")
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def random_clip_weights(seed: int) -> dict[str, Tensor]:
    """Weights drawn as OpenAI initializes CLIP (biases zero), a function of the seed alone."""
    generator = torch.Generator().manual_seed(seed)
    scales = {
        "token_embedding.weight": 0.02,
        "positional_embedding": 0.01,
        "attn.in_proj_weight": 512**-0.5,
        "attn.out_proj.weight": 512**-0.5 * 24**-0.5,  # 24 residual additions
        "mlp.c_fc.weight": 1024**-0.5,
        "mlp.c_proj.weight": 512**-0.5 * 24**-0.5,
        "text_projection": 512**-0.5,
    }
    weights = {}
    for name, shape in clip_text_shapes().items():
        scale = next((scale for end, scale in scales.items() if name.endswith(end)), None)
        if scale is not None:
            weights[name] = torch.randn(shape, generator=generator).mul_(scale)
        else:  # LayerNorm's weights are one, biases zero
            weights[name] = torch.ones(shape) if name.endswith("weight") else torch.zeros(shape)
    return weights


def load_clip_text_encoder(weights: str | Path | None = None, seed: int = 0, download: bool = True) -> CLIPTextEncoder:
    """CLIP's frozen text tower: from `weights`, else the cache (~/.cache/clip), else downloaded, else random.

    Args:
        weights: OpenAI's ViT-B-32.pt, a plain state dict with its names (read without unpickling code), or "random".
        seed: draws the random weights, used with a warning where the official ones cannot be had.
        download: False keeps off the network.

    Returns:
        The tower; its `identity` is "openai-ViT-B-32-<hash>", "state-dict-<hash>" or "random-seed-<seed>".

    Raises:
        InputError: the file is missing, cut off, not the official archive, or lacks a tensor.
    """
    if weights == "random":
        return CLIPTextEncoder(random_clip_weights(seed), f"random-seed-{seed}")
    if weights is not None:
        return read_clip_file(Path(weights))
    path = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "clip" / "ViT-B-32.pt"
    if not path.is_file():
        try:
            if not download:
                raise OSError("downloading is off")
            download_clip(path)
        except (OSError, http.client.HTTPException) as error:
            warnings.warn(
                f"No CLIP weights ({error}): text features come from random weights, seed {seed}. They tell instructions "
                f"apart but know no language. To use CLIP, put its ViT-B-32.pt at {path} or name it with --clip-weights.",
                stacklevel=2,
            )
            return CLIPTextEncoder(random_clip_weights(seed), f"random-seed-{seed}")
    if file_sha256(path) != CLIP_SHA256:
        raise InputError(f"{path}: damaged, its SHA-256 is not that of CLIP's ViT-B-32.pt; delete it and run again")
    return CLIPTextEncoder(read_clip_archive(path), f"openai-ViT-B-32-{CLIP_SHA256[:8]}")


# ---- Observation -----------------------------------------------------------------------------------------------------


class WinningPoints(torch.autograd.Function):
    """Which points of each cloud win the maximum over points in some channel of a PointNet.

    The maximum passes no gradient to any other point, so only these need to go through the pass that is differentiated
    (twice, in MAML): about a third of 128 points, a sixth of 512. A pass without gradient finds them, a few clouds at a
    time, whose activations stay in the CPU's cache. Their number depends on the data; `torch.vmap` allows that only in
    the `vmap` rule of a Function.
    """

    @staticmethod
    def forward(points: Tensor, *layers: Tensor) -> Tensor:
        """points (..., N, 3); weight, bias, norm weight, norm bias of each layer -> indices (..., K) int64."""
        return WinningPoints.indices(WinningPoints.wins(points, layers), len(layers[-1]))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.mark_non_differentiable(output)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *inputs: Tensor) -> tuple[Tensor, int]:
        """`forward` for several tasks, one after the other; the indices (tasks, ..., K) have one K for all."""
        won = []
        for task in range(info.batch_size):
            points, *layers = (x if dim is None else x.select(dim, task) for x, dim in zip(inputs, in_dims))
            won.append(WinningPoints.wins(points, layers))
        return WinningPoints.indices(torch.stack(won), layers[-1].numel()), 0

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
            winners.append(x.argmax(dim=-2))  # (at_once, widths[-1])
        won = torch.zeros(clouds.shape[:-1], dtype=torch.int8, device=points.device)
        return won.scatter_(-1, torch.cat(winners), 1).view(points.shape[:-1])

    @staticmethod
    def indices(won: Tensor, channels: int) -> Tensor:
        """(..., N) int8 -> (..., K) int64: each cloud's winners, then others, up to the most winners in any cloud."""
        most = min(channels, won.shape[-1]) if won.is_cuda else int(won.sum(dim=-1).max())  # a GPU is not waited for
        return won.argsort(dim=-1, descending=True, stable=True)[..., :most]


class PointNetEncoder(nn.Module):
    """A cloud to one feature: the same MLP on every point, the maximum over points, a projection.

    The maximum makes it blind to the order of the points and, at most, sensitive to one point a channel.
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
        if torch.is_grad_enabled():  # the same feature and gradients as from all points, for less
            winners = WinningPoints.apply(points, *self.mlp.parameters())  # (..., K)
            points = points.gather(-2, winners[..., None].expand(*winners.shape, 3))  # (..., K, 3)
        x = self.mlp(points)  # (..., N, widths[-1]), or K for N
        return self.projection(x.amax(dim=-2))  # (..., feature_dim)


class ObservationEncoder(nn.Module):
    """A frame to one feature: PointNet on the cloud, an MLP on the robot's state, concatenated."""

    def __init__(self, config: PolicyConfig):
        super().__init__()
        self.pointnet = PointNetEncoder(config.pointnet_widths, config.point_feature_dim)
        width = config.state_feature_dim
        self.state_mlp = nn.Sequential(nn.Linear(config.state_dim, width), nn.ReLU(), nn.Linear(width, width))

    def forward(self, points: Tensor, state: Tensor) -> Tensor:
        """points (..., N, 3), state (..., S), both normalized -> (..., observation_feature_dim)."""
        return torch.cat([self.pointnet(points), self.state_mlp(state)], dim=-1)


# ---- The reference demonstration -------------------------------------------------------------------------------------


class VisualMotorTrajectory(nn.Module):
    """VMT: a Transformer over the frames of a demonstration, each frame what was seen and what was done (Eqs. 4-5)."""

    def __init__(self, config: PolicyConfig):
        super().__init__()
        width = config.demo_dim
        self.projection = nn.Linear(config.observation_feature_dim + config.action_dim, width)
        self.positions = nn.Parameter(0.02 * torch.randn(config.demo_positions, width))
        self.blocks = nn.ModuleList(TransformerBlock(width, config.vmt_heads) for _ in range(config.vmt_layers))

    def forward(self, features: Tensor, actions: Tensor) -> Tensor:
        """features (D, T, observation_feature_dim), actions (D, T, A) -> demonstration tokens (D, T, demo_dim)."""
        x = self.projection(torch.cat([features, actions], dim=-1))  # (D, T, demo_dim)   Eq. 4
        x = x + self.positions[: x.shape[1]]
        for block in self.blocks:
            x = block(x)  # Eq. 5
        return x


class DemonstrationMLP(nn.Module):
    """The ablation of VMT: an MLP on every frame, averaged over time. It keeps no order."""

    def __init__(self, config: PolicyConfig):
        super().__init__()
        width = config.demo_dim
        d_in = config.observation_feature_dim + config.action_dim
        self.mlp = nn.Sequential(nn.Linear(d_in, width), nn.ReLU(), nn.Linear(width, width))

    def forward(self, features: Tensor, actions: Tensor) -> Tensor:
        """features (D, T, observation_feature_dim), actions (D, T, A) -> one token (D, 1, demo_dim)."""
        return self.mlp(torch.cat([features, actions], dim=-1)).mean(dim=1, keepdim=True)


class UnpairedUnifiedTask(nn.Module):
    """U2T: Transformer fusion of demonstration, instruction and h_k, read out at h_k's place (Eqs. 6 and 8).

    The input sequence is [demonstration tokens | text token | h_k]. Only h_k differs from window to window and from
    one diffusion step to the next. In the first layer the keys and values of the other tokens therefore belong to the
    task alone: `encode_context` computes them once, and every window attends to the same ones. With one layer (the
    default) that is exact and complete. Further layers, if asked for, mix the tokens and run on the full sequence.
    """

    def __init__(self, config: PolicyConfig):
        super().__init__()
        width = config.condition_dim
        if config.demo_encoder != "none":
            self.demo_projection = nn.Sequential(LayerNorm(config.demo_dim), nn.Linear(config.demo_dim, width))
            self.demo_positions = nn.Parameter(0.02 * torch.randn(config.demo_positions, width))
        self.text_projection = nn.Sequential(LayerNorm(config.text_dim), nn.Linear(config.text_dim, width))
        self.text_position = nn.Parameter(0.02 * torch.randn(1, width))
        self.blocks = nn.ModuleList(TransformerBlock(width, config.u2t_heads) for _ in range(config.u2t_layers))

    def embed(self, demo_tokens: Tensor | None, text: Tensor) -> Tensor:
        """demo_tokens (D, T, demo_dim) or None, text (D, text_dim) -> the tokens before h_k, (D, T + 1, C)."""
        tokens = self.text_projection(text)[:, None] + self.text_position  # (D, 1, C)   Eq. 6
        if demo_tokens is not None:
            demo = self.demo_projection(demo_tokens) + self.demo_positions[: demo_tokens.shape[1]]  # (D, T, C)
            tokens = torch.cat([demo, tokens], dim=1)  # (D, T + 1, C)
        return tokens

    def encode_context(self, demo_tokens: Tensor | None, text: Tensor) -> tuple[Tensor, ...]:
        """What all windows of a task share: keys and values (D, heads, T + 1, C / heads), or the tokens themselves."""
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
            (tokens,) = context
            tokens = tokens.repeat_interleave(len(h) // len(tokens), dim=0)  # (B, T + 1, C)
            return self.full_sequence(h, tokens)
        block, attention = self.blocks[0], self.blocks[0].attention
        keys, values = context  # (D, heads, T + 1, d), with d = C / heads
        x = h.unflatten(0, (len(keys), -1))  # (D, G, C): the windows of a task, beside each other
        q, own_key, own_value = attention.project(block.norm1(x))  # (D, heads, G, d)
        scale = q.shape[-1] ** -0.5
        scores = torch.cat([q @ keys.transpose(-2, -1), (q * own_key).sum(-1, keepdim=True)], dim=-1)  # (.., G, T + 2)
        weights = (scores * scale).softmax(dim=-1)
        fused = weights[..., :-1] @ values + weights[..., -1:] * own_value  # (D, heads, G, d)
        x = x + attention.merge(fused)  # (D, G, C)
        x = x + block.mlp(block.norm2(x))
        return x.flatten(0, 1)  # (B, C)   Eq. 8

    def full_sequence(self, h: Tensor, tokens: Tensor) -> Tensor:
        """The same, written as in the paper: h (B, C), tokens (B, T + 1, C) -> (B, C)."""
        x = torch.cat([tokens, h[:, None]], dim=1)  # (B, T + 2, C)
        for block in self.blocks:
            x = block(x)
        return x[:, -1]


# ---- The denoiser ----------------------------------------------------------------------------------------------------


class Conv1d(nn.Conv1d):
    """A convolution over time that keeps the length; a wide one, on a CPU, is written as a matrix product.

    PyTorch's own (2.13) takes up to eight times as long there for the gradient of the weight.
    """

    def __init__(self, d_in: int, d_out: int, kernel_size: int):
        super().__init__(d_in, d_out, kernel_size, padding=kernel_size // 2)
        self.wide = d_in * d_out >= 1024**2

    def forward(self, x: Tensor) -> Tensor:
        """(B, d_in, L) -> (B, d_out, L)."""
        if x.is_cuda or not self.wide:
            return super().forward(x)
        padded = F.pad(x, (self.padding[0], self.padding[0])).transpose(1, 2)  # (B, L + k - 1, d_in)
        shifted = [padded[:, i : i + x.shape[-1]] for i in range(self.kernel_size[0])]  # k x (B, L, d_in)
        windows = torch.stack(shifted, dim=-1).flatten(2)  # (B, L, d_in * k)
        return F.linear(windows, self.weight.flatten(1), self.bias).transpose(1, 2)


class GroupNorm(nn.GroupNorm):
    """Group normalization through `layer_norm`, whose second derivative takes 40 % fewer operations under vmap."""

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, L) -> (B, C, L)."""
        groups = x.unflatten(1, (self.num_groups, -1)).flatten(2)  # (B, groups, C / groups * L)
        x = F.layer_norm(groups, groups.shape[-1:], eps=self.eps).view_as(x)
        return x * self.weight[:, None] + self.bias[:, None]


class Mish(nn.Module):
    """x tanh(log(1 + e^x)), written out: faster than PyTorch's own, above all in the second derivative."""

    def forward(self, x: Tensor) -> Tensor:
        return x * torch.tanh(F.softplus(x))


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


class ConditionalUNet1d(nn.Module):
    """DP3's 1D U-Net over the time axis of an action sequence, with task-conditioned feature modulation (TCFM).

    Every residual block is modulated by h_k = MLP([timestep embedding, observation features]) (Eq. 7), but for the
    two blocks of the level that `tcfm` names, which take U2T's output instead (Eq. 10): the first down-sampling level
    (`down`, the paper's), the middle (`mid`) or the last up-sampling level (`up`).
    """

    def __init__(self, config: PolicyConfig):
        super().__init__()
        self.tcfm = config.tcfm
        self.timestep_dim = config.timestep_dim
        width = config.timestep_dim
        self.timestep_mlp = nn.Sequential(nn.Linear(width, 4 * width), Mish(), nn.Linear(4 * width, width))
        c = config.condition_dim
        self.condition_mlp = nn.Sequential(nn.Linear(c, c), Mish(), nn.Linear(c, c))

        widths = config.unet_widths
        self.down = nn.ModuleList()
        for level, (d_in, d_out) in enumerate(pairwise((config.action_dim, *widths))):
            last = level == len(widths) - 1
            shrink = nn.Identity() if last else nn.Conv1d(d_out, d_out, 3, stride=2, padding=1)
            blocks = [ResidualBlock(d_in, d_out, config), ResidualBlock(d_out, d_out, config)]
            self.down.append(nn.ModuleList([*blocks, shrink]))
        self.mid = nn.ModuleList(ResidualBlock(widths[-1], widths[-1], config) for _ in range(2))
        self.up = nn.ModuleList()
        for d_out, d_in in pairwise(reversed(widths)):  # d_out channels come up from below, and d_out from the skip
            blocks = [ResidualBlock(2 * d_out, d_in, config), ResidualBlock(d_in, d_in, config)]
            self.up.append(nn.ModuleList([*blocks, nn.ConvTranspose1d(d_in, d_in, 4, stride=2, padding=1)]))
        self.head = nn.Sequential(
            ConvBlock(widths[0], widths[0], config.kernel_size, config.n_groups),
            nn.Conv1d(widths[0], config.action_dim, 1),
        )

    def condition(self, timesteps: Tensor, observation: Tensor) -> Tensor:
        """h_k: timesteps (B,) int64, observation (B, To * feature) -> (B, C)   (Eq. 7)."""
        half = self.timestep_dim // 2
        frequencies = torch.exp(torch.arange(half, device=observation.device) * (-math.log(10000) / (half - 1)))
        angles = timesteps[:, None] * frequencies  # (B, timestep_dim / 2)
        embedding = torch.cat([angles.sin(), angles.cos()], dim=-1).to(observation.dtype)  # (B, timestep_dim)
        return self.condition_mlp(torch.cat([self.timestep_mlp(embedding), observation], dim=-1))

    def forward(self, actions: Tensor, h: Tensor, fused: Tensor | None = None) -> Tensor:
        """Noisy actions (B, H, A), h_k (B, C), U2T's condition (B, C) -> predicted clean actions (B, H, A)."""
        conditions = {level: h for level in ("down", "mid", "up")}
        if self.tcfm != "none":
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


# ---- Diffusion -------------------------------------------------------------------------------------------------------


class DiffusionSchedule(nn.Module):
    """Forward noising and deterministic DDIM sampling, with networks that predict the clean sample.

    Betas follow the squared-cosine schedule of improved DDPM, capped at 0.999. Holds no parameters; the table of
    cumulative products is a buffer that is not saved, since it follows from `diffusion_steps`.
    """

    def __init__(self, diffusion_steps: int = 100, inference_steps: int = 10):
        super().__init__()
        self.diffusion_steps, self.inference_steps = diffusion_steps, inference_steps
        t = torch.arange(diffusion_steps + 1, dtype=torch.float64) / diffusion_steps
        level = torch.cos((t + 0.008) / 1.008 * math.pi / 2) ** 2  # the ideal cumulative product
        betas = (1 - level[1:] / level[:-1]).clamp(max=0.999)
        self.register_buffer("alphas_cumprod", (1 - betas).cumprod(0).float(), persistent=False)  # (K,)

    def add_noise(self, sample: Tensor, noise: Tensor, timesteps: Tensor) -> Tensor:
        """A_k = sqrt(a_k) A_0 + sqrt(1 - a_k) noise: sample and noise (B, H, A), timesteps (B,) int64 -> (B, H, A)."""
        a = self.alphas_cumprod[timesteps][:, None, None].to(sample.dtype)  # (B, 1, 1)
        return a.sqrt() * sample + (1 - a).sqrt() * noise

    def timesteps(self) -> list[int]:
        """The diffusion steps that sampling visits, from noisy to clean: 90, 80, ..., 0."""
        stride = self.diffusion_steps // self.inference_steps
        return list(range(0, self.diffusion_steps, stride))[::-1]

    def step(self, prediction: Tensor, k: int, noisy: Tensor) -> Tensor:
        """One DDIM step from k to k - K / inference_steps: predicted A_0 and A_k, (B, H, A) -> the less noisy (B, H, A)."""
        stride = self.diffusion_steps // self.inference_steps
        a = self.alphas_cumprod[k]
        a_next = self.alphas_cumprod[k - stride] if k >= stride else torch.ones_like(a)
        noise = (noisy - a.sqrt() * prediction) / (1 - a).sqrt()
        return a_next.sqrt() * prediction.clamp(-1, 1) + (1 - a_next).sqrt() * noise


# ---- Normalization ---------------------------------------------------------------------------------------------------


class Normalizer(nn.Module):
    """Maps points, state and action to [-1, 1], each coordinate by the smallest and largest value seen in the data.

    The six buffers travel with the weights in every checkpoint.
    """

    def __init__(self, state_dim: int, action_dim: int):
        super().__init__()
        for name, dim in {"points": 3, "state": state_dim, "action": action_dim}.items():
            self.register_buffer(f"{name}_center", torch.zeros(dim))
            self.register_buffer(f"{name}_scale", torch.ones(dim))

    def fit(self, points: Tensor, state: Tensor, action: Tensor) -> None:
        """Sets the ranges from data: points (..., 3), state (..., S), action (..., A).

        A coordinate that hardly moves (range under 1e-4) is centred and not stretched; of an action it is, since what
        is drawn from [-1, 1] must come back as what the demonstrations did.
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


# ---- The policy ------------------------------------------------------------------------------------------------------


class DAMIPolicy(nn.Module):
    """The policy: two observations, an instruction and one complete demonstration in; eight actions out."""

    def __init__(self, config: PolicyConfig):
        super().__init__()
        self.config = config
        self.normalizer = Normalizer(config.state_dim, config.action_dim)
        self.observation_encoder = ObservationEncoder(config)
        if config.demo_encoder != "none":
            encoder = {"vmt": VisualMotorTrajectory, "mlp": DemonstrationMLP}[config.demo_encoder]
            self.demo_encoder = encoder(config)
        if config.tcfm != "none":
            self.u2t = UnpairedUnifiedTask(config)
        self.unet = ConditionalUNet1d(config)
        self.schedule = DiffusionSchedule(config.diffusion_steps, config.inference_steps)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """The trainable parameters by adaptation learning rate: `vision`, `diffusion` and `other` (VMT and U2T)."""
        groups = {"vision": [], "diffusion": [], "other": []}
        place = {"observation_encoder": "vision", "unet": "diffusion", "demo_encoder": "other", "u2t": "other"}
        for name, parameter in self.named_parameters():
            groups[place[name.split(".")[0]]].append(parameter)
        return groups

    def encode_demo(
        self,
        text: Tensor | None = None,
        demo_points: Tensor | None = None,
        demo_state: Tensor | None = None,
        demo_action: Tensor | None = None,
    ) -> tuple[Tensor, ...] | None:
        """Encodes what names a task. It depends on no observation: once a rollout is enough.

        Args:
            text: instruction features, (D, text_dim).
            demo_points, demo_state, demo_action: complete reference demonstrations, already strided,
                (D, T, N, 3) in metres, (D, T, S), (D, T, A).

        Returns:
            The context that `loss` and `sample_actions` condition on; None if the architecture reads no task.

        Raises:
            InputError: more demonstration frames than learned positions.
        """
        if self.config.tcfm == "none":
            return None
        tokens = None
        if self.config.demo_encoder != "none":
            if demo_points.shape[1] > self.config.demo_positions:
                raise InputError(
                    f"the demonstration has {demo_points.shape[1]} frames, the policy has {self.config.demo_positions} "
                    f"positions: cut the demonstration or train with a larger demo_stride"
                )
            features = self.encode_observations(demo_points, demo_state)  # (D, T, feature)
            tokens = self.demo_encoder(features, self.normalizer.normalize("action", demo_action))  # (D, T, demo_dim)
        return self.u2t.encode_context(tokens, text)

    def encode_observations(self, points: Tensor, state: Tensor) -> Tensor:
        """points (..., N, 3) in metres, state (..., S) -> (..., observation_feature_dim)."""
        normalize = self.normalizer.normalize
        return self.observation_encoder(normalize("points", points), normalize("state", state))

    def denoise(
        self, noisy: Tensor, timesteps: Tensor, observation: Tensor, context: tuple[Tensor, ...] | None
    ) -> Tensor:
        """Predicts the clean actions: noisy (B, H, A), timesteps (B,), observation (B, To * feature) -> (B, H, A)."""
        h = self.unet.condition(timesteps, observation)  # (B, C)
        fused = None if context is None else self.u2t(h, context)  # (B, C)
        return self.unet(noisy, h, fused)

    def loss(
        self,
        points: Tensor,
        state: Tensor,
        action: Tensor,
        text: Tensor | None = None,
        demo_points: Tensor | None = None,
        demo_state: Tensor | None = None,
        demo_action: Tensor | None = None,
        noise: Tensor | None = None,
        timesteps: Tensor | None = None,
    ) -> Tensor:
        """The diffusion loss, the mean squared error of the predicted clean actions (Eq. 1).

        With `noise` and `timesteps` given it is a pure function of the parameters and its arguments.

        Args:
            points, state, action: B windows, (B, To, N, 3) in metres, (B, To, S), (B, H, A); ordered by task.
            text, demo_points, demo_state, demo_action: D tasks, as in `encode_demo`; D divides B.
            noise: standard normal, (B, H, A).
            timesteps: diffusion steps in [0, K), (B,) int64.

        Returns:
            () float.
        """
        context = self.encode_demo(text, demo_points, demo_state, demo_action)
        clean = self.normalizer.normalize("action", action)  # (B, H, A)
        if noise is None:
            noise = torch.randn_like(clean)
        if timesteps is None:
            timesteps = torch.randint(self.config.diffusion_steps, clean.shape[:1], device=clean.device)
        noisy = self.schedule.add_noise(clean, noise, timesteps)  # (B, H, A)
        observation = self.encode_observations(points, state).flatten(1)  # (B, To * feature)
        return F.mse_loss(self.denoise(noisy, timesteps, observation, context), clean)

    forward = loss  # so that torch.func.functional_call(policy, params, (), batch) is the loss

    @torch.no_grad()
    def sample_actions(
        self,
        points: Tensor,
        state: Tensor,
        context: tuple[Tensor, ...] | None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Draws an action chunk by DDIM from Gaussian noise.

        Args:
            points, state: the last To observations, oldest first, (B, To, N, 3) in metres, (B, To, S).
            context: from `encode_demo`, of D tasks; D divides B.
            generator: source of the initial noise, on any device.

        Returns:
            (B, Ta, A), to be executed from the newest observation on, in the unit of the demonstrations.
        """
        config = self.config
        observation = self.encode_observations(points, state).flatten(1)  # (B, To * feature)
        shape = (len(points), config.horizon, config.action_dim)
        source = points.device if generator is None else generator.device
        actions = torch.randn(shape, generator=generator, device=source).to(points.device)  # (B, H, A)
        for k in self.schedule.timesteps():
            timesteps = torch.full((len(points),), k, device=points.device)
            actions = self.schedule.step(self.denoise(actions, timesteps, observation, context), k, actions)
        first = config.n_obs_steps - 1  # the action that belongs to the newest observation
        return self.normalizer.unnormalize("action", actions[:, first : first + config.n_action_steps])

    def draw_noise(self, windows: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Draws what `loss` needs to be pure: noise (windows, H, A) and timesteps (windows,), on the policy's device."""
        config, source, device = self.config, generator.device, self.normalizer.action_scale.device
        shape = (windows, config.horizon, config.action_dim)
        return {
            "noise": torch.randn(shape, generator=generator, device=source).to(device),
            "timesteps": torch.randint(config.diffusion_steps, shape[:1], generator=generator, device=source).to(
                device
            ),
        }


# ---- Moving average and checkpoints ----------------------------------------------------------------------------------


def ema_model(policy: DAMIPolicy) -> AveragedModel:
    """The exponential moving average of a policy in training: `.update_parameters(policy)` after each step, `.module`.

    The decay grows with the step, min(0.9999, 1 - (1 + step)^-0.75): the paper's EMA power and maximum.
    """

    def update(averaged: list[Tensor], current: list[Tensor], step: Tensor) -> None:
        decay = min(0.9999, 1 - (1 + int(step)) ** -0.75)
        torch._foreach_lerp_(averaged, current, 1 - decay)

    return AveragedModel(policy, multi_avg_fn=torch.no_grad()(update))


CHECKPOINT_FORMAT = "DAMI checkpoint 1"


def save_checkpoint(path: str | Path, policy: DAMIPolicy, half: bool = False, **info: Any) -> None:
    """Writes configuration, weights, normalizer and `info` (tensors and plain Python values) to one file, atomically.

    `half`: the weights as float16, half the size (`load_checkpoint` gives float32 again); the normalizer stays float32.
    """
    path = Path(path)
    weights = policy.state_dict()
    if half:
        weights |= {name: parameter.detach().half() for name, parameter in policy.named_parameters()}
    config = {name: list(v) if isinstance(v, tuple) else v for name, v in asdict(policy.config).items()}
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        torch.save({"format": CHECKPOINT_FORMAT, "config": config, "model": weights, **info}, temporary)
        os.replace(temporary, path)
    except RuntimeError as error:  # how torch.save reports a full disk
        free = shutil.disk_usage(path.parent).free
        raise OSError(
            f"cannot write {path}: {free / 1e6:.1f} MB are free there; make room, or use another --out"
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


def load_checkpoint(path: str | Path, device: str | torch.device = "cpu") -> tuple[DAMIPolicy, dict[str, Any]]:
    """Rebuilds the policy from a checkpoint: (policy in evaluation mode on `device`, everything else in the file).

    Raises:
        InputError: the file is missing, truncated, not one of ours, or its weights do not fit its configuration.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"no checkpoint at {path}: name an existing .pt file, or train one with `python train.py`")
    try:
        info = torch.load(path, map_location=device, weights_only=True)
    except Exception as error:  # torch raises many types here; every one means the file cannot be read
        raise InputError(f"{path} is damaged or not a PyTorch checkpoint: use another file") from error
    if not isinstance(info, dict) or info.get("format") != CHECKPOINT_FORMAT:
        raise InputError(f"{path} is not a {CHECKPOINT_FORMAT!r} file: use one that train.py or finetune.py wrote")
    try:
        policy = DAMIPolicy(PolicyConfig(**info.pop("config"))).to(device)
        policy.load_state_dict(info.pop("model"))
    except (KeyError, TypeError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: weights and configuration do not fit this version: {reason[:200]}") from error
    return policy.eval(), info


# ---- python model.py -------------------------------------------------------------------------------------------------


def main(argv: list[str] | None = None) -> None:
    """Prints the modules, shapes and parameter counts of the presets. Weights are neither drawn nor stored."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--preset", choices=PRESETS, help="one preset, every parameter with its shape")
    parser.add_argument("--half", nargs=2, metavar=("CHECKPOINT", "OUT"), help="copy a checkpoint, weights as float16")
    args = parser.parse_args(argv)
    if args.half:
        policy, info = load_checkpoint(args.half[0])
        kept = {name: value for name, value in info.items() if name not in ("format", "training")}
        save_checkpoint(args.half[1], policy, half=True, **kept)
        return
    count = lambda module: sum(p.numel() for p in module.parameters())  # noqa: E731
    with torch.device("meta"):
        for preset in [args.preset] if args.preset else PRESETS:
            policy = DAMIPolicy(PRESETS[preset])
            print(f"\n{preset}: {count(policy):,} trainable parameters, condition width {policy.config.condition_dim}")
            for name, module in policy.named_children():
                if count(module):
                    shapes = [tuple(p.shape) for p in module.parameters()]
                    print(
                        f"  {name:<20} {count(module):>12,}  {len(shapes):>3} tensors, from {shapes[0]} to {shapes[-1]}"
                    )
            if args.preset:
                for name, p in policy.named_parameters():
                    print(f"    {name:<60} {tuple(p.shape)!s:<20} {p.numel():>12,}")
    tower = sum(math.prod(shape) for shape in clip_text_shapes().values())
    print(f"\nfrozen CLIP text tower, the same for all: {tower:,} parameters")


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
