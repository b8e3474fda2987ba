"""CLIP's text side: the tokenizer, the frozen text tower of ViT-B/32, and its weights.

    features, identity = text_features(["Close the drawer."])  # (1, 512); identity: of the weights

Source: Radford et al. 2021, "Learning Transferable Visual Models From Natural Language
Supervision". Modules and tensors carry the names of OpenAI's checkpoint. The tower is never
trained and never differentiated, so PyTorch's own attention serves. The official `ViT-B-32.pt` is
looked for in the cache, then downloaded. Where neither works, seeded random weights take its
place, and every checkpoint and result says so.

The file imports nothing from the project and can be copied out alone, with
`assets/bpe_simple_vocab_16e6.txt.gz`.

Letters: B texts, T tokens.
"""

import gzip
import hashlib
import html
import http.client
import math
import os
import re
import tempfile
import urllib.request
import warnings
import zipfile
from collections import OrderedDict
from collections.abc import Sequence
from functools import lru_cache
from importlib import import_module
from itertools import pairwise
from pathlib import Path

import ftfy
import regex
import torch
from torch import Tensor, nn
from tqdm import tqdm

CLIP_MERGES = Path(__file__).parent / "assets" / "bpe_simple_vocab_16e6.txt.gz"
CLIP_SHA256 = "40d365715913c9da98579312b702a82c18be219cc2a73407c4526f58eba950af"
CLIP_URL = f"https://openaipublic.azureedge.net/clip/models/{CLIP_SHA256}/ViT-B-32.pt"


class TextWeightsError(ValueError):
    """A file of CLIP's weights is damaged or foreign, or not the one a checkpoint was made with."""


# ---- Tokenizer -----------------------------------------------------------------------------------

START, END = "<|startoftext|>", "<|endoftext|>"
WORD = regex.compile(
    rf"{regex.escape(START)}|{regex.escape(END)}|'s|'t|'re|'ve|'m|'ll|'d"
    r"|\p{L}+|\p{N}|[^\s\p{L}\p{N}]+",
    regex.IGNORECASE,
)


@lru_cache
def clip_vocabulary() -> tuple[dict[int, str], dict[tuple[str, str], int], dict[str, int]]:
    """CLIP's byte -> symbol, pair of symbols -> rank of their merge, symbol -> token id."""
    printable = [b for b in range(256) if 33 <= b <= 126 or 161 <= b <= 172 or b >= 174]
    others = [b for b in range(256) if b not in printable]
    symbols = {b: chr(b) for b in printable}
    for i, b in enumerate(others):  # GPT-2's printable symbols for the other bytes
        symbols[b] = chr(256 + i)
    with gzip.open(CLIP_MERGES, "rt", encoding="utf-8") as file:
        lines = file.read().split("\n")[1:48895]  # a head line; CLIP uses 49152 - 256 - 2 merges
    merges = [tuple(line.split()) for line in lines]
    ranks = {pair: rank for rank, pair in enumerate(merges)}
    vocabulary = [
        *symbols.values(),
        *(symbol + "</w>" for symbol in symbols.values()),  # at the end of a word
        *(first + second for first, second in merges),
        START,
        END,
    ]
    ids = {symbol: i for i, symbol in enumerate(vocabulary)}
    return symbols, ranks, ids


@lru_cache(maxsize=65536)
def tokenize_word(word: str) -> list[int]:
    """Byte-pair encoding of one word: the pair merged earliest in training is merged first."""
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


def tokenize(texts: str | Sequence[str], context_length: int = 77) -> Tensor:
    """Returns CLIP's token ids of texts, (B, context_length) int64: start, words, end, zeros.

    Text is repaired (ftfy), HTML entities are resolved and letters lower-cased. A text with too
    many tokens is cut and still ends with the end token, as in transformers (OpenAI's raises).
    """
    texts = [texts] if isinstance(texts, str) else list(texts)
    _, _, ids = clip_vocabulary()
    tokens = torch.zeros(len(texts), context_length, dtype=torch.long)
    for row, text in zip(tokens, texts):
        text = html.unescape(html.unescape(ftfy.fix_text(text))).lower()  # twice, as OpenAI does
        word_ids = [token for word in WORD.findall(text) for token in tokenize_word(word)]
        sequence = [ids[START], *word_ids[: context_length - 2], ids[END]]
        row[: len(sequence)] = torch.tensor(sequence)
    return tokens  # (B, context_length)


# ---- Text tower ----------------------------------------------------------------------------------


class QuickGELU(nn.Module):
    """The approximation of GELU that CLIP was trained with."""

    def forward(self, x: Tensor) -> Tensor:
        return x * torch.sigmoid(1.702 * x)


class ResidualAttentionBlock(nn.Module):
    """Pre-norm residual block: causal attention, then an MLP four times as wide."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.ln_1 = nn.LayerNorm(width)
        self.attn = nn.MultiheadAttention(width, heads, batch_first=True)
        self.ln_2 = nn.LayerNorm(width)
        self.mlp = nn.Sequential(
            OrderedDict(
                c_fc=nn.Linear(width, 4 * width),
                gelu=QuickGELU(),
                c_proj=nn.Linear(4 * width, width),
            )
        )

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """x (B, T, width), mask (T, T), added to the scores -> (B, T, width)."""
        y = self.ln_1(x)
        attended, _ = self.attn(y, y, y, need_weights=False, attn_mask=mask)
        x = x + attended
        return x + self.mlp(self.ln_2(x))


class CLIPTextEncoder(nn.Module):
    """CLIP ViT-B/32's text tower, frozen: 12 blocks, the end token projected to 512 numbers.

    Args:
        weights: the text tensors by their names in OpenAI's checkpoint; others are ignored.
        identity: says which weights these are; checkpoints and results carry it.

    Raises:
        TextWeightsError: a tensor is missing or has another shape.
    """

    def __init__(self, weights: dict[str, Tensor], identity: str):
        super().__init__()
        self.identity = identity
        with torch.device("meta"):  # no memory and no random numbers: all comes from `weights`
            self.token_embedding = nn.Embedding(49408, 512)
            self.positional_embedding = nn.Parameter(torch.empty(77, 512))
            self.transformer = nn.Module()
            blocks = [ResidualAttentionBlock(512, 8) for _ in range(12)]
            self.transformer.resblocks = nn.ModuleList(blocks)
            self.ln_final = nn.LayerNorm(512)
            self.text_projection = nn.Parameter(torch.empty(512, 512))

        for name, expected in self.state_dict().items():
            if name not in weights:
                raise TextWeightsError(
                    f"CLIP weights {identity}: '{name}' is missing; give ViT-B-32's text tensors"
                )
            found, shape = tuple(weights[name].shape), tuple(expected.shape)
            if found != shape:
                raise TextWeightsError(
                    f"CLIP weights {identity}: '{name}' has shape {found}, ViT-B/32's is {shape}"
                )
        state = {name: weights[name].float() for name in self.state_dict()}  # from float16
        self.load_state_dict(state, assign=True)
        mask = torch.full((77, 77), -math.inf).triu(1)  # no token looks ahead
        self.register_buffer("mask", mask, persistent=False)
        self.requires_grad_(False).eval()

    def forward(self, tokens: Tensor) -> Tensor:
        """Text features (B, 512) of token ids (B, T), T <= 77."""
        end = tokens.argmax(dim=-1)  # (B,) the end token has the highest id
        T = int(end.max()) + 1  # exact: no token sees what stands behind it
        x = self.token_embedding(tokens[:, :T]) + self.positional_embedding[:T]  # (B, T, 512)
        for block in self.transformer.resblocks:
            x = block(x, self.mask[:T, :T])
        x = x[torch.arange(len(x), device=x.device), end]  # (B, 512)
        return self.ln_final(x) @ self.text_projection

    @torch.no_grad()
    def encode(self, texts: str | Sequence[str]) -> Tensor:
        """Returns text features (B, 512) float32, on the encoder's device."""
        return self(tokenize(texts).to(self.text_projection.device))


# ---- Weights -------------------------------------------------------------------------------------


def random_clip_weights(seed: int) -> dict[str, Tensor]:
    """Draws weights as OpenAI initializes CLIP (biases zero), a function of the seed alone.

    The order of the draws is part of every checkpoint that was trained with them: never change it.
    """
    generator = torch.Generator().manual_seed(seed)

    def normal(scale: float, *shape: int) -> Tensor:
        return torch.randn(shape, generator=generator).mul_(scale)

    residual = 512**-0.5 * 24**-0.5  # 24 residual additions
    weights = {
        "token_embedding.weight": normal(0.02, 49408, 512),
        "positional_embedding": normal(0.01, 77, 512),
    }
    for i in range(12):
        block = {
            "ln_1.weight": torch.ones(512),
            "ln_1.bias": torch.zeros(512),
            "attn.in_proj_weight": normal(512**-0.5, 1536, 512),
            "attn.in_proj_bias": torch.zeros(1536),
            "attn.out_proj.weight": normal(residual, 512, 512),
            "attn.out_proj.bias": torch.zeros(512),
            "ln_2.weight": torch.ones(512),
            "ln_2.bias": torch.zeros(512),
            "mlp.c_fc.weight": normal(1024**-0.5, 2048, 512),
            "mlp.c_fc.bias": torch.zeros(2048),
            "mlp.c_proj.weight": normal(residual, 512, 2048),
            "mlp.c_proj.bias": torch.zeros(512),
        }
        for name, tensor in block.items():
            weights[f"transformer.resblocks.{i}.{name}"] = tensor
    weights["ln_final.weight"] = torch.ones(512)
    weights["ln_final.bias"] = torch.zeros(512)
    weights["text_projection"] = normal(512**-0.5, 512, 512)
    return weights


def file_sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_official(path: Path) -> CLIPTextEncoder:
    """The text tower of OpenAI's TorchScript archive, whose SHA-256 the caller has checked."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # TorchScript is deprecated, OpenAI's file is of 2021
        weights = torch.jit.load(str(path), map_location="cpu").state_dict()
    return CLIPTextEncoder(weights, f"openai-ViT-B-32-{CLIP_SHA256[:8]}")


# Where OpenAI's names and Hugging Face's differ. No name is part of another, so that their order
# does not matter. Queries, keys and values, which stand in one tensor at OpenAI, are put together
# in `as_openai_names_them`.
HUGGING_FACE_NAMES = {
    "token_embedding.weight": "text_model.embeddings.token_embedding.weight",
    "positional_embedding": "text_model.embeddings.position_embedding.weight",
    "transformer.resblocks.": "text_model.encoder.layers.",
    "ln_final.": "text_model.final_layer_norm.",
    ".attn.": ".self_attn.",
    ".ln_1.": ".layer_norm1.",
    ".ln_2.": ".layer_norm2.",
    ".mlp.c_fc.": ".mlp.fc1.",
    ".mlp.c_proj.": ".mlp.fc2.",
}


def as_openai_names_them(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Renames the text tensors of a Hugging Face CLIP model; other state dicts stay as they are.

    `CLIPModel` and `CLIPTextModelWithProjection` name them alike. A bare `CLIPTextModel` lacks the
    projection behind the tower, and is refused later.
    """
    if not any(name.startswith("text_model.") for name in weights):
        return weights
    renamed = {}
    for name, tensor in weights.items():
        for openai, hugging_face in HUGGING_FACE_NAMES.items():
            name = name.replace(hugging_face, openai)
        renamed[name] = tensor
    for block in {name.split(".attn.")[0] for name in renamed if ".attn.q_proj." in name}:
        for kind in ("weight", "bias"):
            parts = [renamed.get(f"{block}.attn.{x}_proj.{kind}") for x in "qkv"]
            if all(part is not None for part in parts):
                renamed[f"{block}.attn.in_proj_{kind}"] = torch.cat(parts)
    if "text_projection.weight" in renamed:  # a linear layer holds its matrix transposed
        renamed["text_projection"] = renamed["text_projection.weight"].T.contiguous()
    return renamed


def read_clip_file(path: Path) -> CLIPTextEncoder:
    """The text tower of a file the user gave: OpenAI's own, or a plain state dict.

    The latter is read without running any code from it. It has OpenAI's names or Hugging Face's,
    and can be a .safetensors file.

    Raises TextWeightsError for a file that is missing, cut off, or neither of the two.
    """
    if not path.is_file():
        raise TextWeightsError(f"{path}: there is no such file; give CLIP's ViT-B-32.pt")
    try:
        sha256 = file_sha256(path)
    except PermissionError as error:
        raise TextWeightsError(f"{path} cannot be read: {error.strerror}") from error
    if sha256 == CLIP_SHA256:
        return read_official(path)

    names = []
    with open(path, "rb") as file:
        like_zip = file.read(2) == b"PK"
    if like_zip:
        try:
            with zipfile.ZipFile(path) as archive:
                names = archive.namelist()
        except Exception:  # zipfile raises many types; a zip's table of contents is at its end
            size = path.stat().st_size
            raise TextWeightsError(
                f"{path}: the file is cut off after {size} bytes, or damaged; fetch it again"
            ) from None
    if any(name.endswith("/constants.pkl") for name in names):
        raise TextWeightsError(
            f"{path}: a TorchScript archive with SHA-256 {sha256[:8]}..., not the official "
            f"{CLIP_SHA256[:8]}...; fetch ViT-B-32.pt again, or give a plain state dict"
        )
    try:
        if path.suffix == ".safetensors":
            weights = import_module("safetensors.torch").load_file(path)
        else:
            weights = torch.load(path, map_location="cpu", weights_only=True)
    except ModuleNotFoundError:
        raise TextWeightsError(f"{path}: to read it, pip install safetensors") from None
    except Exception as error:  # a damaged file fails in a dozen ways
        reason = str(error).split("\n")[0]
        raise TextWeightsError(
            f"{path}: neither CLIP's ViT-B-32.pt nor a plain state dict ({reason})"
        ) from None
    if not isinstance(weights, dict) or not all(
        isinstance(name, str) and isinstance(x, Tensor) for name, x in weights.items()
    ):
        raise TextWeightsError(f"{path}: neither CLIP's ViT-B-32.pt nor a plain state dict")
    return CLIPTextEncoder(as_openai_names_them(weights), f"state-dict-{sha256[:8]}")


def download_clip(path: Path) -> None:
    """Fetches OpenAI's ViT-B-32.pt; it appears at `path` complete and checked, or not at all.

    Raises OSError where the network or the disk fails, TextWeightsError for another file.
    """
    with urllib.request.urlopen(CLIP_URL, timeout=5) as response:
        size = int(response.headers.get("Content-Length", 0))
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".unfinished-", dir=path.parent) as folder:
            part = Path(folder) / path.name
            progress = tqdm(total=size, unit="B", unit_scale=True, desc=path.name)
            with open(part, "wb") as file, progress:
                while chunk := response.read(1 << 20):
                    progress.update(file.write(chunk))
            if (received := part.stat().st_size) < size:
                raise OSError(f"the connection ended after {received} of {size} bytes")
            if file_sha256(part) != CLIP_SHA256:
                raise TextWeightsError(
                    f"{CLIP_URL}: what arrived has another SHA-256 and was thrown away; name a "
                    "ViT-B-32.pt with --clip-weights, or use --clip-weights random"
                )
            os.replace(part, path)


def cached_clip_file() -> Path:
    """Where ViT-B-32.pt is kept once it is downloaded; OSError for a user without a home folder."""
    if folder := os.environ.get("XDG_CACHE_HOME"):
        return Path(folder) / "clip" / "ViT-B-32.pt"
    try:
        return Path.home() / ".cache" / "clip" / "ViT-B-32.pt"
    except RuntimeError:  # HOME is not set, and the system does not know the user
        raise OSError("there is no home folder to keep them in: set XDG_CACHE_HOME") from None


def random_clip_text_encoder(seed: int) -> CLIPTextEncoder:
    """A text tower with random weights, which its identity says."""
    return CLIPTextEncoder(random_clip_weights(seed), f"random-seed-{seed}")


def load_clip_text_encoder(
    weights: str | Path | None = None, seed: int = 0, download: bool = True
) -> CLIPTextEncoder:
    """Returns CLIP's text tower: from `weights`, else the cache, else downloaded, else random.

    Args:
        weights: OpenAI's ViT-B-32.pt, a plain state dict with its names or Hugging Face's, or
            "random".
        seed: of the random weights, which are used if "random" is given, and with a warning where
            the official ones cannot be had.
        download: False keeps off the network.

    Returns:
        The tower; its `identity` is "openai-ViT-B-32-<hash>", "state-dict-<hash>" or
        "random-seed-<seed>".

    Raises:
        TextWeightsError: the file is missing, cut off, or lacks a tensor; or the one that is cached
            or downloaded is not the official archive.
    """
    if weights == "random":
        return random_clip_text_encoder(seed)
    if weights is not None:
        return read_clip_file(Path(weights))

    path = None
    try:
        path = cached_clip_file()
        if not path.is_file():
            if not download:
                raise OSError("downloading is off")
            download_clip(path)
        sha256 = file_sha256(path)
    except (OSError, http.client.HTTPException) as error:
        advice = f"put its ViT-B-32.pt at {path} or name it" if path else "name its ViT-B-32.pt"
        warnings.warn(
            f"No CLIP weights ({error}): text features come from random weights, seed {seed}. "
            "They tell instructions apart but know no language. To use CLIP, "
            f"{advice} with --clip-weights.",
            stacklevel=2,
        )
        return random_clip_text_encoder(seed)
    if sha256 != CLIP_SHA256:
        raise TextWeightsError(
            f"{path}: damaged, its SHA-256 is not that of ViT-B-32.pt; delete it"
        )
    return read_official(path)


def text_features(
    instructions: Sequence[str], weights: str | None = None, identity: str | None = None
) -> tuple[Tensor, str]:
    """Encodes instructions with the frozen text tower.

    Args:
        instructions: plain sentences, B of them, at least one.
        weights: the value of --clip-weights: a file or `random`. None: the cached file, else a
            download, else random weights.
        identity: the text weights that a checkpoint was made with. No others are accepted, and if
            they were random ones, the same are drawn again without looking for CLIP's.

    Returns:
        (features (B, 512) float32 on the CPU, identity of the weights).

    Raises:
        TextWeightsError: the weights that can be had are not those of the checkpoint.
    """
    random_seed = re.fullmatch(r"random-seed-(-?\d+)", identity or "")
    if weights is None and (identity or "").startswith("state-dict-"):
        raise TextWeightsError(
            f"the checkpoint was made with the text weights {identity!r}: name their file with "
            "--clip-weights"
        )
    if random_seed and weights in (None, "random"):
        encoder = load_clip_text_encoder("random", seed=int(random_seed[1]))
    else:
        encoder = load_clip_text_encoder(weights)
    if identity is not None and encoder.identity != identity:
        raise TextWeightsError(
            f"the checkpoint was made with the text weights {identity!r}, here are "
            f"{encoder.identity!r}: give the same ones with --clip-weights"
        )
    return encoder.encode(list(instructions)), encoder.identity
