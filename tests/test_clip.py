"""clip.py against transformers, and its loader against files made here in the official layout."""

import gzip
import hashlib
import html
import json
import os
import pickle
import pwd
import warnings
import zipfile
from types import SimpleNamespace

import ftfy
import pytest
import torch
import transformers
from safetensors.torch import save_file
from torch import nn
from transformers.modeling_utils import no_init_weights

import clip
from clip import load_clip_text_encoder, random_clip_weights, text_features, tokenize

TASKS = """
    assemble the round nut on the peg|put the basketball into the hoop
    put the bin's block into the other bin|close the box
    press the button from the top|press the coffee machine's button
    pull the mug away from the machine|turn the dial
    take the ring off the peg|close the door|lock the door|open the door by its handle
    unlock the door|insert the hand
    close the drawer|open the drawer|turn the faucet off|turn the faucet on
    hammer the nail into the wall|lift the lever
    press the handle down from the side|pull the handle up|insert the peg sideways
    pick the puck and place it on the goal
    push the puck to the goal|reach the goal position|put the cube on the shelf
    slide the plate into the cabinet
    sweep the block into the hole|open the window|close the window
    pull the stick to pull the box|kick the ball into the net
"""
INSTRUCTIONS = [text.strip() for line in TASKS.strip().splitlines() for text in line.split("|")]
ODD = """
    don't we'll they're I'd he's you've I'm o'clock rock'n'roll|IT'S 'TIS DON'T I'LL
    it’s “quoted” — and so on…
    3.14159 -2e10 1,000,000 007 0x1F 50%|a1b2c3|x = y ** 2 + f(z)[i] != None;
    C:\\Users\\robot\\file.txt|a_b-c/d
    naïve café Ünïcödé ÀÉÎÕÜ|ÇA VA? ŒUVRE|straße STRASSE ẞ|İstanbul ISPARTA ığ
    ΟΔΟΣ ὈΔΥΣΣΕΎΣ ς|Привет, мир! ЁЖИК|你好，世界|こんにちは世界
    안녕하세요|مرحبا بالعالم|שלום עולם|नमस्ते दुनिया|สวัสดีชาวโลก|ไทย ๑๒๓ ٣٤٥ ②③ ½ Ⅷ
    👍 🤖🦾 👩‍👩‍👧‍👦 🇫🇷 ❤️|☃★☂ ♞ ∑∫√≈ → ⇒
    schÃ¶n cafÃ© â€œmojibakeâ€\x9d|ﬁne ﬂow ﬀ|ｆｕｌｌ　ｗｉｄｔｈ|e\u0301 cafe\u0301
    a\u200bb\u200dc\ufeffd|\u00a0no\u00a0break\u2003space
    \t tabs \t and   spaces |!!!???...,,,|#$%^&*()_+{}[]|''''|"|\\|~`
    http://example.org/a?b=c&d=e#f|user.name+tag@mail.example|antidisestablishmentarianism
    pneumonoultramicroscopicsilico
    zzzzzzzzzzzzzzzzzzzzzzzzzzzzz|aaaaabaaaab|hahahahahahaha|The Quick BROWN fOx
    ſtrange 'ſ long s|\x00\x07control\x1b[31m red
"""
ODD = [text for line in ODD.strip("\n").split("\n") for text in line.strip(" ").split("|")] + [
    "",
    " ",
    "\n",
    "\u3000",
]
LONG = [
    "<|startoftext|> in the text <|EndOfText|> twice",
    "pick up the red block " * 40,
    "a " * 74,
    "a " * 75,
    "a " * 76,
    "ab" * 3000,
    "🤖" * 60,
    "9" * 80,
    ", ".join(INSTRUCTIONS),
]
ENTITIES = [
    "a &amp; b",
    "&lt;b&gt; bold",
    "&amp;amp; &amp;lt;",
    "caf&eacute; &#8364; &#x1F916;",
    "x &lt y",
    "<i>&quot;q&quot;</i>",
    "<i>caf&amp;eacute;</i>",
    "&nbsp;",
]


def random_strings(n: int) -> list[str]:
    generator = torch.Generator().manual_seed(0)
    ranges = [
        (32, 127),
        (32, 127),
        (0xA0, 0x250),
        (0x370, 0x530),
        (0x4E00, 0x4F00),
        (0x1F300, 0x1F700),
        (0x2000, 0x2400),
    ]

    def draw(low: int, high: int) -> int:
        return int(torch.randint(low, high, (), generator=generator))

    strings = []
    for _ in range(n):
        words = []
        for _ in range(draw(1, 12)):
            low, high = ranges[draw(0, len(ranges))]
            words.append("".join(chr(draw(low, high)) for _ in range(draw(1, 9))))
        strings.append(" ".join(words))
    return strings


@pytest.fixture(scope="module")
def peer(tmp_path_factory):
    """transformers' tokenizer, with the same merges and the vocabulary its converter makes."""
    folder = tmp_path_factory.mktemp("tokenizer")
    lines = (
        gzip.decompress(clip.CLIP_MERGES.read_bytes()).decode().split("\n")[1 : 49152 - 256 - 2 + 1]
    )
    (folder / "merges.txt").write_text(
        "#version: 0.2\n" + "\n".join(lines) + "\n", encoding="utf-8"
    )
    symbols = list(transformers.models.clip.tokenization_clip.bytes_to_unicode().values())
    words = symbols + [s + "</w>" for s in symbols] + ["".join(line.split()) for line in lines]
    words += ["<|startoftext|>", "<|endoftext|>"]
    (folder / "vocab.json").write_text(json.dumps({word: i for i, word in enumerate(words)}))
    return transformers.CLIPTokenizer(str(folder / "vocab.json"), str(folder / "merges.txt"))


def assert_same_tokens(peer, ours: list[str], theirs: list[str]):
    expected = peer(
        theirs, padding="max_length", max_length=77, truncation=True, return_tensors="pt"
    )
    expected = (
        expected.input_ids * expected.attention_mask
    )  # transformers pads with the end token, OpenAI with zeros
    for text, a, b in zip(ours, tokenize(ours), expected, strict=True):
        assert torch.equal(a, b), text


def test_tokens_equal_those_of_transformers(peer):
    texts = INSTRUCTIONS + ODD + LONG + random_strings(300)
    assert len(texts) > 350
    assert_same_tokens(peer, texts, texts)


def test_html_entities_are_resolved_twice_as_openai_does(peer):
    assert_same_tokens(
        peer, ENTITIES, [html.unescape(html.unescape(ftfy.fix_text(text))) for text in ENTITIES]
    )
    assert torch.equal(tokenize("salt &amp;amp; pepper"), tokenize("salt & pepper"))
    assert torch.equal(
        tokenize("<i>caf&eacute;</i>"), tokenize("<i>café</i>")
    )  # transformers keeps this entity


def test_a_text_too_long_is_cut_and_still_ends_with_the_end_token():
    """The ids below are those of open_clip's own tokenizer."""
    tokens = tokenize(["close the door " * 50, "close the door"])
    assert tokens.shape == (2, 77) and tokens.dtype == torch.int64
    assert tokens[0, -1] == 49407 and torch.equal(tokens[0, :4], tokens[1, :4])
    assert tokens[1].tolist()[:6] == [49406, 2660, 518, 2489, 49407, 0]
    assert tokenize("close the door", context_length=5).tolist() == [
        [49406, 2660, 518, 2489, 49407]
    ]


@pytest.fixture(scope="module")
def weights():
    """Random text tensors under the official names; biases and norms are not zeros and ones."""
    generator = torch.Generator().manual_seed(1)
    weights = random_clip_weights(seed=1)
    return {
        name: value + 0.1 * torch.randn(value.shape, generator=generator)
        if value.ndim == 1
        else value
        for name, value in weights.items()
    }


def half(weights):
    return {
        name: value.float() if "ln_" in name else value.half() for name, value in weights.items()
    }


def test_text_features_and_weights_equal_those_of_transformers(weights, tmp_path):
    config = transformers.CLIPTextConfig(bos_token_id=49406, eos_token_id=49407)
    with no_init_weights():
        peer = transformers.CLIPTextModelWithProjection(config).eval()
    parts = {"q": slice(0, 512), "k": slice(512, 1024), "v": slice(1024, 1536)}
    state = {}
    for name, value in weights.items():
        for theirs, huggingface in [
            ("transformer.resblocks", "text_model.encoder.layers"),
            ("ln_final", "text_model.final_layer_norm"),
            ("ln_", "layer_norm"),
            ("attn.", "self_attn."),
            ("c_fc", "fc1"),
            ("c_proj", "fc2"),
            ("token_embedding", "text_model.embeddings.token_embedding"),
            ("positional_embedding", "text_model.embeddings.position_embedding.weight"),
        ]:
            name = name.replace(theirs, huggingface)
        if name == "text_projection":
            state["text_projection.weight"] = value.T
        elif "in_proj_" in name:
            for part, rows in parts.items():
                state[name.replace("in_proj_", f"{part}_proj.")] = value[rows]
        else:
            state[name] = value
    missing, unexpected = peer.load_state_dict(state, strict=False)
    assert not unexpected and all("position_ids" in name for name in missing)
    texts = [*INSTRUCTIONS[:5], "", "pick up the red block " * 40]
    with torch.no_grad():
        expected = peer(input_ids=tokenize(texts)).text_embeds
    features = clip.CLIPTextEncoder(weights, "test").encode(texts)
    assert features.shape == (len(texts), 512) and features.dtype == torch.float32
    torch.testing.assert_close(features, expected, rtol=0, atol=1e-5)

    # The state dict of transformers' model is read as it is
    pickled, safe = tmp_path / "pytorch_model.bin", tmp_path / "model.safetensors"
    torch.save(peer.state_dict(), pickled)
    save_file({name: x.contiguous() for name, x in peer.state_dict().items()}, safe)
    for path in (pickled, safe):
        loaded = load_clip_text_encoder(path).state_dict()
        assert all(torch.equal(loaded[name], x) for name, x in weights.items())
    del state["text_model.encoder.layers.3.self_attn.k_proj.bias"]
    torch.save(state, pickled)
    with pytest.raises(clip.TextWeightsError, match=r"resblocks.3.attn.in_proj_bias' is missing"):
        load_clip_text_encoder(pickled)


def test_a_text_has_the_same_features_alone_and_beside_longer_ones(weights):
    encoder = clip.CLIPTextEncoder(weights, "test")
    both = encoder.encode(["close the door", "pick up the red block and put it on the shelf"])
    torch.testing.assert_close(encoder.encode("close the door")[0], both[0], rtol=0, atol=1e-5)


# ---- The loader ----------------------------------------------------------------------------------


class Node(nn.Module):
    """Only holds what it is given, so that a scripted tree has the names of a state dict."""

    def forward(self, x: torch.Tensor):
        return x


def save_in_official_layout(weights, path) -> str:
    """Writes a TorchScript archive as OpenAI's is, with an image tower; returns its SHA-256."""
    root = Node()
    image = {
        "visual.conv1.weight": torch.zeros(768, 3, 32, 32),
        "visual.proj": torch.zeros(768, 512),
    }
    for name, value in half({**weights, **image, "logit_scale": torch.tensor(4.6)}).items():
        *parents, leaf = name.split(".")
        node = root
        for parent in parents:
            if parent not in dict(node.named_children()):
                node.add_module(parent, Node())
            node = node.get_submodule(parent)
        node.register_parameter(leaf, nn.Parameter(value))
    for name, number in {
        "input_resolution": 224,
        "context_length": 77,
        "vocab_size": 49408,
    }.items():
        root.register_buffer(name, torch.tensor(number))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # TorchScript is deprecated, OpenAI's file is what it is
        script = torch.jit.script(root)
        torch.jit.save(script, str(path))
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def official(weights, tmp_path_factory):
    path = tmp_path_factory.mktemp("official") / "ViT-B-32.pt"
    sha256 = save_in_official_layout(weights, path)
    yield path, sha256
    path.unlink()


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache folder, and no way to the network: what listens at port 9 here is nothing."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("no_proxy", "*")
    monkeypatch.setattr(clip, "CLIP_URL", "http://127.0.0.1:9/ViT-B-32.pt")
    (tmp_path / "cache" / "clip").mkdir(parents=True)
    return tmp_path / "cache" / "clip" / "ViT-B-32.pt"


def assert_holds(encoder, weights):
    for name, value in half(weights).items():
        loaded = encoder.get_parameter(name)
        assert (
            loaded.dtype == torch.float32
            and not loaded.requires_grad
            and torch.equal(loaded, value.float())
        ), name
    assert len(list(encoder.parameters())) == len(weights) == 149


def test_an_archive_in_the_official_layout_is_read_without_its_image_tower(
    official, weights, monkeypatch
):
    path, sha256 = official
    assert any(name.endswith("constants.pkl") for name in zipfile.ZipFile(path).namelist())
    monkeypatch.setattr(clip, "CLIP_SHA256", sha256)
    encoder = load_clip_text_encoder(path)
    assert_holds(encoder, weights)
    assert encoder.identity == f"openai-ViT-B-32-{sha256[:8]}" and not encoder.training


def test_an_archive_with_another_sha256_is_refused(official):
    with pytest.raises(
        clip.TextWeightsError,
        match=r"TorchScript archive with SHA-256 .* not the official 40d36571",
    ):
        load_clip_text_encoder(official[0])


def test_a_plain_state_dict_is_read_and_other_tensors_are_ignored(weights, tmp_path):
    path = tmp_path / "state.pt"
    torch.save(half(weights) | {"visual.proj": torch.zeros(768, 512)}, path)
    encoder = load_clip_text_encoder(str(path))
    assert_holds(encoder, weights)
    assert encoder.identity == "state-dict-" + hashlib.sha256(path.read_bytes()).hexdigest()[:8]


def test_a_file_cut_off_is_refused(official, weights, tmp_path):
    path = tmp_path / "cut.pt"
    path.write_bytes(official[0].read_bytes()[:1_000_000])
    with pytest.raises(
        clip.TextWeightsError, match=r"cut\.pt: the file is cut off after 1000000 bytes"
    ):
        load_clip_text_encoder(path)
    torch.save(
        {"text_projection": weights["text_projection"]}, path, _use_new_zipfile_serialization=False
    )
    path.write_bytes(path.read_bytes()[:500_000])
    with pytest.raises(
        clip.TextWeightsError, match=r"neither CLIP's ViT-B-32\.pt nor a plain state dict"
    ):
        load_clip_text_encoder(path)


def test_a_zip_whose_table_of_contents_is_damaged_is_refused(tmp_path):
    path = tmp_path / "damaged.pt"
    torch.save({"text_projection": torch.zeros(2)}, path)
    content = bytearray(path.read_bytes())
    content[content.rindex(b"PK\x01\x02")] = 0  # of the table's last entry
    path.write_bytes(content)
    with pytest.raises(clip.TextWeightsError, match=r"damaged\.pt: .* or damaged"):
        load_clip_text_encoder(path)


def test_a_file_without_names_is_refused(tmp_path):
    torch.save({0: torch.zeros(2)}, tmp_path / "numbers.pt")
    with pytest.raises(clip.TextWeightsError, match="nor a plain state dict"):
        load_clip_text_encoder(tmp_path / "numbers.pt")


def test_a_missing_file_or_a_folder_is_refused(tmp_path):
    for path in (tmp_path / "none.pt", tmp_path):
        with pytest.raises(clip.TextWeightsError, match="there is no such file"):
            load_clip_text_encoder(path)


def test_a_missing_tensor_is_named(weights, tmp_path):
    state = half(weights)
    del state["transformer.resblocks.3.mlp.c_fc.bias"]
    torch.save(state, tmp_path / "state.pt")
    with pytest.raises(
        clip.TextWeightsError, match=r"'transformer\.resblocks\.3\.mlp\.c_fc\.bias' is missing"
    ):
        load_clip_text_encoder(tmp_path / "state.pt")


def test_a_tensor_of_another_shape_is_named(weights, tmp_path):
    torch.save(half(weights) | {"text_projection": torch.zeros(512, 640)}, tmp_path / "state.pt")
    with pytest.raises(
        clip.TextWeightsError,
        match=r"'text_projection' has shape \(512, 640\), ViT-B/32's is \(512, 512\)",
    ):
        load_clip_text_encoder(tmp_path / "state.pt")


class Harmful:
    """Unpickling it makes a folder."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


def test_no_file_can_run_code(tmp_path, monkeypatch):
    victim, path = tmp_path / "victim", tmp_path / "harmful.pt"
    for new in (True, False):
        torch.save({"text_projection": Harmful(victim)}, path, _use_new_zipfile_serialization=new)
        with pytest.raises(
            clip.TextWeightsError, match=r"neither CLIP's ViT-B-32\.pt nor a plain state dict"
        ):
            load_clip_text_encoder(path)
    with zipfile.ZipFile(path, "w") as archive:  # scripted, with the wrong SHA-256: never opened
        archive.writestr("ViT-B-32/data.pkl", pickle.dumps(Harmful(victim), protocol=2))
        archive.writestr("ViT-B-32/constants.pkl", b"")
    with pytest.raises(
        clip.TextWeightsError, match=r"a TorchScript archive with SHA-256 .* not the official"
    ):
        load_clip_text_encoder(path)
    assert not victim.exists()


def test_the_cache_is_used_and_a_damaged_cache_file_is_to_be_deleted(
    official, weights, cache, monkeypatch
):
    path, sha256 = official
    monkeypatch.setattr(clip, "CLIP_SHA256", sha256)
    cache.symlink_to(path)
    assert_holds(load_clip_text_encoder(), weights)
    cache.unlink()
    cache.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(clip.TextWeightsError, match=r"ViT-B-32\.pt: damaged.* delete it"):
        load_clip_text_encoder()


def test_a_download_is_checked_and_kept(official, weights, cache, monkeypatch):
    path, sha256 = official
    monkeypatch.setattr(clip, "CLIP_URL", path.as_uri())
    with pytest.raises(clip.TextWeightsError, match="another SHA-256 and was thrown away"):
        load_clip_text_encoder()
    assert list(cache.parent.iterdir()) == []
    monkeypatch.setattr(clip, "CLIP_SHA256", sha256)
    assert_holds(load_clip_text_encoder(), weights)
    assert list(cache.parent.iterdir()) == [cache]


def test_without_network_the_tower_is_random_with_one_warning(cache, weights):
    torch.manual_seed(5)
    before = torch.random.get_rng_state()
    with pytest.warns(UserWarning, match="random weights, seed 0.*--clip-weights") as caught:
        encoder = load_clip_text_encoder()
    assert torch.equal(
        before, torch.random.get_rng_state()
    )  # nothing is drawn from the global generator
    assert (
        len(caught) == 1
        and encoder.identity == "random-seed-0"
        and not list(cache.parent.iterdir())
    )
    torch.manual_seed(6)
    for name, value in random_clip_weights(seed=0).items():
        assert torch.equal(encoder.get_parameter(name), value)  # the seed says it all
    assert not torch.allclose(
        encoder.text_projection, weights["text_projection"]
    )  # those are of seed 1
    features = encoder.encode(INSTRUCTIONS)
    cosine = torch.cosine_similarity(features[:, None], features[None], dim=-1) - torch.eye(
        len(features)
    )
    assert cosine.max() < 0.98  # instructions are told apart


def test_a_user_without_a_home_folder_gets_random_weights_and_is_told_what_to_do(
    cache, weights, monkeypatch
):
    def unknown_user(number):
        raise KeyError(f"getpwuid(): uid not found: {number}")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.setattr(pwd, "getpwuid", unknown_user)
    monkeypatch.setattr(clip, "random_clip_weights", lambda seed: weights)
    with pytest.warns(UserWarning, match="no home folder .* set XDG_CACHE_HOME") as caught:
        assert load_clip_text_encoder().identity == "random-seed-0"
    assert "To use CLIP, name its ViT-B-32.pt with --clip-weights" in str(caught[0].message)


def test_with_downloading_off_the_network_is_not_asked(cache, weights, monkeypatch):
    monkeypatch.setattr(clip, "download_clip", None)
    monkeypatch.setattr(clip, "random_clip_weights", lambda seed: weights)
    with pytest.warns(UserWarning, match="downloading is off"):
        assert load_clip_text_encoder(seed=3, download=False).identity == "random-seed-3"


def test_random_weights_can_be_asked_for_without_a_warning(cache, weights, monkeypatch):
    monkeypatch.setattr(clip, "download_clip", None)
    monkeypatch.setattr(clip, "random_clip_weights", lambda seed: weights)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_clip_text_encoder("random", seed=4).identity == "random-seed-4"


# ---- Features of instructions --------------------------------------------------------------------

GOLDEN = {
    "Pick up the cube and place it on the shelf.": [-1.784928, 1.073279, -0.160839, -0.960275],
    "Slide the window open by its handle.": [-1.378310, 1.430315, -1.608668, -0.316156],
}


def test_the_seeded_text_features_are_those_that_shipped_policies_were_trained_with():
    """Another draw of the weights would leave all other tests green and the policies lost."""
    features, identity = text_features(list(GOLDEN), "random")
    assert identity == "random-seed-0"
    torch.testing.assert_close(
        features[:, :4], torch.tensor(list(GOLDEN.values())), atol=2e-5, rtol=0
    )


def test_only_the_text_weights_of_a_checkpoint_are_accepted(monkeypatch):
    asked = []
    tower = SimpleNamespace(
        identity="random-seed-0", encode=lambda texts: torch.zeros(len(texts), 512)
    )

    def load(weights, **options):
        asked.append((weights, options))
        return tower

    monkeypatch.setattr(clip, "load_clip_text_encoder", load)
    assert text_features(["a", "b"], None, "random-seed-0")[0].shape == (2, 512)
    assert asked == [("random", {"seed": 0})]  # drawn again, without looking for CLIP's
    message = "made with the text weights 'openai-ViT-B-32-40d36571', here are 'random-seed-0'"
    with pytest.raises(clip.TextWeightsError, match=message):
        text_features(["a"], None, "openai-ViT-B-32-40d36571")
    assert asked[1:] == [(None, {})]
    with pytest.raises(clip.TextWeightsError, match="'state-dict-1234abcd': name their file with"):
        text_features(["a"], None, "state-dict-1234abcd")
    assert len(asked) == 2  # nothing is looked for, nor downloaded
