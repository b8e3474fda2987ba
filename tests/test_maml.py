"""Tests of maml.py against finite differences, torch.optim, a closed form, on the tiny policy."""

import math
from dataclasses import replace

import pytest
import torch
from torch import nn
from torch.func import functional_call, grad
from torch.multiprocessing.reductions import StorageWeakRef
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from maml import adapt, meta_gradient
from model import PRESETS, DAMIPolicy


class Setting:
    """The tiny policy in float64, its loss as a function, and three tasks of random windows."""

    def __init__(self, **changes):
        torch.manual_seed(0)
        self.policy = DAMIPolicy(
            replace(PRESETS["tiny"], num_points=16, demo_positions=4, **changes)
        ).double()
        self.params = dict(self.policy.named_parameters())
        self.tasks = [(self.batch(2 * i, 4), self.batch(2 * i + 1, 6)) for i in range(3)]

    def loss(self, params, batch):
        return functional_call(self.policy, params, (), batch)

    def batch(self, seed, windows):
        config, g = self.policy.config, torch.Generator().manual_seed(seed)
        draw = lambda *shape: torch.randn(shape, generator=g, dtype=torch.float64)  # noqa: E731
        return {
            "points": draw(windows, 2, config.num_points, 3),
            "state": draw(windows, 2, config.state_dim),
            "action": draw(windows, config.horizon, config.action_dim),
            "text": draw(1, config.text_dim),
            "demo_points": draw(1, 4, config.num_points, 3),
            "demo_state": draw(1, 4, config.state_dim),
            "demo_action": draw(1, 4, config.action_dim),
            "noise": draw(windows, config.horizon, config.action_dim),
            "timesteps": torch.randint(config.diffusion_steps, (windows,), generator=g),
        }


@pytest.fixture(scope="module")
def setting():
    return Setting()


def flat(params):
    return torch.cat([p.detach().flatten() for p in params.values()])


def unflat(vector, like):
    parts = vector.split([p.numel() for p in like.values()])
    return {name: part.view_as(p) for (name, p), part in zip(like.items(), parts)}


def objective(setting, vector, lr, steps):
    """The mean query loss after adaptation, by plain autograd, without torch.func.

    `lr` is a number, or a rate for each parameter, as in `adapt`.
    """
    rates = lr if isinstance(lr, dict) else dict.fromkeys(setting.params, lr)
    total = 0.0
    for support, query in setting.tasks:
        params = unflat(vector, setting.params)
        for _ in range(steps):
            leaves = {name: p.detach().requires_grad_() for name, p in params.items()}
            gradients = torch.autograd.grad(setting.loss(leaves, support), list(leaves.values()))
            params = {
                name: p.detach() - rates[name] * g
                for (name, p), g in zip(leaves.items(), gradients)
            }
        with torch.no_grad():
            total += setting.loss(params, query).item() / len(setting.tasks)
    return total


# ---- The gradient through the inner loop ---------------------------------------------------------


@pytest.mark.parametrize("steps, lr, vectorize", [(1, 0.3, 1), (3, 0.1, 2), (1, 0.3, 10)])
def test_the_meta_gradient_of_the_policy_equals_finite_differences_and_first_order_does_not(
    setting, steps, lr, vectorize
):

    def run(**options):
        tasks = setting.tasks
        return flat(meta_gradient(setting.loss, setting.params, tasks, lr, steps, **options)[0])

    second, first = run(vectorize=vectorize), run(first_order=True, vectorize=vectorize)
    start = flat(setting.params)
    torch.manual_seed(1)
    # Along their difference the two disagree most; random directions see all parameters.
    for direction in (second - first, torch.randn_like(start), torch.randn_like(start)):
        direction = direction / direction.norm()
        h = 1e-6  # short, so that hardly ever a ReLU or a maximum switches in between
        slope = objective(setting, start + h * direction, lr, steps) - objective(
            setting, start - h * direction, lr, steps
        )
        slope = slope / (2 * h)
        assert float(second @ direction) == pytest.approx(slope, rel=1e-5, abs=1e-8)
    assert (second - first).norm() > first.norm()


@pytest.mark.parametrize("steps", [1, 4])
@pytest.mark.parametrize("vectorize", [1, 2, 10])
def test_the_meta_gradient_of_quadratics_has_its_closed_form(steps, vectorize):
    torch.manual_seed(0)
    lr, theta = 0.2, torch.randn(5, dtype=torch.float64)

    def quadratic():
        root = torch.randn(5, 5, dtype=torch.float64)
        return root @ root.T / 5, torch.randn(5, dtype=torch.float64)

    loss = lambda params, batch: 0.5 * params["x"] @ batch[0] @ params["x"] - batch[1] @ params["x"]  # noqa: E731
    tasks = [(quadratic(), quadratic()) for _ in range(3)]
    second, first, losses = torch.zeros(5).double(), torch.zeros(5).double(), []
    for (a, b), (c, d) in tasks:
        adapted, jacobian = theta, torch.eye(5, dtype=torch.float64)
        for _ in range(steps):
            adapted, jacobian = adapted - lr * (a @ adapted - b), (torch.eye(5) - lr * a) @ jacobian
        first += (c @ adapted - d) / 3
        second += jacobian.T @ (c @ adapted - d) / 3
        losses.append(0.5 * adapted @ c @ adapted - d @ adapted)
    for expected, first_order in ((second, False), (first, True)):
        gradient, _, values = meta_gradient(
            loss, {"x": theta}, tasks, lr, steps, first_order, vectorize
        )
        torch.testing.assert_close(gradient["x"], expected)
        torch.testing.assert_close(values, torch.stack(losses))
    assert (second - first).norm() > 0.1 * first.norm()


@pytest.mark.parametrize("first_order", [False, True])
@pytest.mark.parametrize("steps", [1, 2])
def test_one_task_after_another_equals_all_tasks_under_vmap(setting, steps, first_order):
    runs = [
        meta_gradient(
            setting.loss, setting.params, setting.tasks, 0.1, steps, first_order, vectorize
        )
        for vectorize in (1, 2)
    ]
    (loop, _, losses), (vectorized, _, values) = runs
    torch.testing.assert_close(losses, values)
    assert losses.shape == (3,) and losses.std() > 1e-3
    assert list(loop) == list(vectorized) == list(setting.params)
    for name in loop:
        torch.testing.assert_close(loop[name], vectorized[name], atol=1e-10, rtol=1e-8)


def test_first_order_is_the_query_gradient_at_the_adapted_parameters(setting):
    gradient, _, _ = meta_gradient(
        setting.loss, setting.params, setting.tasks[:1], 0.1, 2, first_order=True
    )
    support, query = setting.tasks[0]
    adapted = {
        name: p.detach() for name, p in adapt(setting.loss, setting.params, support, 0.1, 2).items()
    }
    torch.testing.assert_close(flat(gradient), flat(grad(setting.loss)(adapted, query)))


@pytest.mark.parametrize("first_order", [False, True])
def test_adapting_takes_the_steps_of_torchs_sgd_and_leaves_its_input(setting, first_order):
    support = setting.tasks[0][0]
    before = flat(setting.params)
    adapted = adapt(setting.loss, setting.params, support, 0.1, 3, first_order)
    torch.testing.assert_close(flat(setting.params), before, atol=0, rtol=0)
    peer = Setting().policy
    optimizer = torch.optim.SGD(peer.parameters(), lr=0.1)
    for _ in range(3):
        optimizer.zero_grad()
        peer(**support).backward()
        optimizer.step()
    torch.testing.assert_close(flat(adapted), flat(dict(peer.named_parameters())))
    assert (flat(adapted) - before).abs().max() > 1e-3


@pytest.mark.parametrize("vectorize", [1, 2])
def test_parameters_may_have_one_gradient_between_them(vectorize):
    params = {name: torch.full((3,), value) for name, value in (("a", 0.3), ("b", -0.5))}
    tasks = [(torch.full((3,), float(i)), torch.arange(3.0) + i) for i in range(3)]
    loss = lambda p, x: ((p["a"] + p["b"] - x) ** 2).sum()  # noqa: E731
    one, _, _ = meta_gradient(loss, params, tasks, 0.1, first_order=True, vectorize=vectorize)
    adapted = [-0.2 + 2 * 0.1 * 2 * (support + 0.2) for support, _ in tasks]
    expected = torch.stack([2 * (x - query) for x, (_, query) in zip(adapted, tasks)]).mean(dim=0)
    torch.testing.assert_close(one, {"a": expected, "b": expected})


# ---- The gradient for the rates of the inner step ------------------------------------------------


def sample_rates(params, scale):
    """A rate for each parameter, none like another; for a matrix one for each of its rows."""
    generator = torch.Generator().manual_seed(5)
    shapes = {name: (len(p), 1) if p.dim() == 2 else () for name, p in params.items()}
    return {
        name: scale * (0.5 + torch.rand(shape, generator=generator, dtype=torch.float64))
        for name, shape in shapes.items()
    }


@pytest.mark.parametrize("vectorize", [1, 2])
@pytest.mark.parametrize(
    "steps, scale, first_order", [(1, 0.3, False), (3, 0.1, False), (1, 0.3, True)]
)
def test_the_gradients_for_the_rates_equal_finite_differences(
    setting, steps, scale, first_order, vectorize
):
    rates = sample_rates(setting.params, scale)
    gradients, rate_gradients, _ = meta_gradient(
        setting.loss, setting.params, setting.tasks, rates, steps, first_order, vectorize
    )
    assert {name: g.shape for name, g in rate_gradients.items()} == {
        name: rate.shape for name, rate in rates.items()
    }
    start, h = flat(setting.params), 1e-6
    gradient, rate_gradient = flat(gradients), flat(rate_gradients)
    torch.manual_seed(1)
    for direction in (rate_gradient, torch.randn_like(rate_gradient)):
        direction = direction / direction.norm()
        ahead, behind = (
            objective(setting, start, unflat(flat(rates) + sign * h * direction, rates), steps)
            for sign in (1, -1)
        )
        slope = (ahead - behind) / (2 * h)
        assert float(rate_gradient @ direction) == pytest.approx(slope, rel=1e-5, abs=1e-8)
    if not first_order:  # the weights' gradient runs through all these rates
        direction = torch.randn_like(start)
        direction = direction / direction.norm()
        ahead, behind = (
            objective(setting, start + sign * h * direction, rates, steps) for sign in (1, -1)
        )
        slope = (ahead - behind) / (2 * h)
        assert float(gradient @ direction) == pytest.approx(slope, rel=1e-5, abs=1e-8)


@pytest.mark.parametrize("first_order", [False, True])
@pytest.mark.parametrize("vectorize", [1, 2])
def test_equal_rates_are_one_rate(setting, vectorize, first_order):
    rates = dict.fromkeys(setting.params, torch.tensor(0.1, dtype=torch.float64))
    (one, of_one, losses), (many, of_many, again) = (
        meta_gradient(setting.loss, setting.params, setting.tasks, lr, 2, first_order, vectorize)
        for lr in (0.1, rates)
    )
    torch.testing.assert_close(losses, again)
    torch.testing.assert_close(many, one, atol=1e-12, rtol=1e-10)
    assert of_one == {} and of_many.keys() == setting.params.keys()
    assert all(rate.requires_grad is False and rate.grad is None for rate in rates.values())


# ---- Every layer of torch.nn, with and without vmap ----------------------------------------------


class Tokens(nn.Module):
    """Reads whole numbers, made of its input, with a layer of torch.nn."""

    def __init__(self, layer):
        super().__init__()
        self.layer = layer

    def forward(self, x):
        return self.layer((3 * x.abs()).long().clamp(max=9))


class SelfAttention(nn.Module):
    def __init__(self):
        super().__init__()
        self.attention = nn.MultiheadAttention(8, 2, batch_first=True)

    def forward(self, x):
        return self.attention(x, x, x)[0]


class Twice(nn.Module):
    def __init__(self, layer):
        super().__init__()
        self.layer = layer

    def forward(self, x):
        return self.layer(x, x.flip(0))


SEQUENCE, IMAGE, VOLUME = (4, 6, 8), (2, 4, 5, 5), (2, 4, 4, 4, 4)
# fmt: off
LAYERS = [  # what PyTorch gets wrong stands first
    (lambda: nn.LayerNorm(8), SEQUENCE),
    (lambda: nn.LayerNorm((6, 8)), SEQUENCE),
    (lambda: nn.LayerNorm(8, bias=False), SEQUENCE),
    (lambda: nn.LayerNorm(8, elementwise_affine=False), SEQUENCE),
    (lambda: nn.BatchNorm1d(6, track_running_stats=False), SEQUENCE),
    (lambda: nn.BatchNorm1d(8, track_running_stats=False), (4, 8)),
    (lambda: nn.BatchNorm2d(4, track_running_stats=False), IMAGE),
    (lambda: nn.BatchNorm1d(6).eval(), SEQUENCE),
    (lambda: nn.InstanceNorm1d(6, affine=True), SEQUENCE),
    (lambda: nn.InstanceNorm2d(4, affine=True), IMAGE),
    (lambda: nn.InstanceNorm3d(4, affine=True), VOLUME),
    (lambda: nn.InstanceNorm2d(4, affine=True, track_running_stats=True).eval(), IMAGE),
    (lambda: nn.TransformerEncoderLayer(8, 2, 16, dropout=0, batch_first=True), SEQUENCE),
    (lambda: Twice(nn.TransformerDecoderLayer(8, 2, 16, dropout=0, batch_first=True)), SEQUENCE),
    (lambda: nn.GroupNorm(2, 6), SEQUENCE),
    (lambda: nn.RMSNorm(8), SEQUENCE),
    (lambda: nn.LocalResponseNorm(2), SEQUENCE),
    (lambda: nn.utils.parametrizations.weight_norm(nn.Linear(8, 5)), SEQUENCE),
    (lambda: nn.Linear(8, 5), SEQUENCE),
    (lambda: Twice(nn.Bilinear(8, 8, 5)), SEQUENCE),
    (lambda: nn.Conv1d(6, 4, 3, padding=1, padding_mode="reflect"), SEQUENCE),
    (lambda: nn.Conv2d(4, 6, 3, groups=2, stride=2, padding=1), IMAGE),
    (lambda: nn.Conv3d(4, 2, 3, dilation=2, padding="same"), VOLUME),
    (lambda: nn.ConvTranspose1d(6, 4, 4, stride=2, padding=1), SEQUENCE),
    (lambda: nn.ConvTranspose2d(4, 6, 3, groups=2), IMAGE),
    (lambda: Tokens(nn.Embedding(10, 8)), SEQUENCE),
    (SelfAttention, SEQUENCE),
    (lambda: nn.PReLU(6), SEQUENCE),
    (nn.GELU, SEQUENCE),
    (nn.Mish, SEQUENCE),
    (nn.ELU, SEQUENCE),
    (nn.GLU, SEQUENCE),
    (lambda: nn.Softmax(-1), SEQUENCE),
    (lambda: nn.MaxPool2d(2), IMAGE),
    (lambda: nn.AvgPool1d(2), SEQUENCE),
    (lambda: nn.AdaptiveMaxPool2d(2), IMAGE),
    (lambda: nn.LPPool1d(2, 2), SEQUENCE),
    (lambda: nn.Upsample(scale_factor=2, mode="bicubic"), IMAGE),
]
# fmt: on


def both_ways(layer, shape):
    """The meta-gradient of a loss that reads a layer, one task at a time and two at a time."""
    torch.manual_seed(0)
    layer = layer.double()
    with torch.no_grad():
        for parameter in layer.parameters():  # a weight that is 1 hides an error
            parameter += 0.3 * torch.randn_like(parameter)
    params = {name: p.detach() for name, p in layer.named_parameters()}
    params["scale"] = torch.randn(shape[1:], dtype=torch.float64)
    tasks = [tuple(pair) for pair in torch.randn(3, 2, *shape, dtype=torch.float64)]

    def loss(params, x):
        weights = {name: p for name, p in params.items() if name != "scale"}
        y = functional_call(layer, weights, (torch.tanh(x * params["scale"]) + 0.3 * x,))
        return (y**3).mean() + y.sin().mean() + 0.01 * (params["scale"] ** 2).sum()

    with sdpa_kernel(SDPBackend.MATH):  # the only attention that has a second derivative
        return [meta_gradient(loss, params, tasks, 0.05, 2, vectorize=n)[0] for n in (1, 2)]


@pytest.mark.parametrize("make, shape", LAYERS)
def test_a_layer_of_torch_has_the_same_meta_gradient_with_and_without_vmap(make, shape):
    one_by_one, vectorized = both_ways(make(), shape)
    torch.testing.assert_close(vectorized, one_by_one, atol=1e-10, rtol=1e-8)


@pytest.mark.parametrize("options", [{"padding_idx": 0}, {"scale_grad_by_freq": True}])
def test_an_embedding_that_vmap_gets_wrong_is_refused(options):
    with pytest.raises(NotImplementedError, match=r"embedding, .* use vectorize=1"):
        both_ways(Tokens(nn.Embedding(10, 8, **options)), SEQUENCE)


def test_a_function_beneath_the_layers_is_refused_as_well():
    class Direct(nn.Module):
        def forward(self, x):
            return torch.layer_norm(x, (8,), x[0, 0])

    with pytest.raises(NotImplementedError, match=r"layer_norm, .* use vectorize=1"):
        both_ways(Direct(), SEQUENCE)


# ---- Tasks, one at a time and several at once ----------------------------------------------------


def test_without_tasks_there_is_no_meta_gradient():
    for vectorize in (1, 2):
        with pytest.raises(ValueError, match="at least one task"):
            meta_gradient(
                lambda params, batch: params["x"].sum(),
                {"x": torch.ones(1)},
                iter([]),
                0.1,
                vectorize=vectorize,
            )


@pytest.mark.parametrize("vectorize, chunks", [(1, 5), (2, 3), (5, 1), (9, 1)])
def test_as_many_tasks_run_at_once_as_asked_for(vectorize, chunks):
    calls = []

    def loss(params, batch):
        calls.append(batch)
        return ((params["x"] - batch) ** 2).sum()

    tasks = [(torch.ones(1), torch.ones(1))] * 5
    meta_gradient(loss, {"x": torch.zeros(1)}, tasks, 0.1, vectorize=vectorize)
    assert len(calls) == 2 * chunks  # support, query
    with pytest.raises(ValueError, match="vectorize is 0"):
        meta_gradient(loss, {"x": torch.zeros(1)}, tasks, 0.1, vectorize=0)


# ---- Memory --------------------------------------------------------------------------------------


class Storages(TorchDispatchMode):
    """Keeps account of the memory behind every tensor that any operation makes."""

    def __init__(self):
        super().__init__()
        self.made = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        for x in tree_leaves(out):
            if isinstance(x, torch.Tensor):
                self.made.append(
                    (StorageWeakRef(x.untyped_storage()), x.untyped_storage().nbytes())
                )
        return out

    def alive(self):
        return sum({ref.cdata: size for ref, size in self.made if not ref.expired()}.values())


@pytest.mark.parametrize("vectorize", [1, 2])
def test_memory_does_not_grow_with_the_number_of_tasks(setting, vectorize):
    alive = []
    with Storages() as storages:

        def tasks():
            for i in range(5 * vectorize):
                if i % vectorize == 0:
                    alive.append(storages.alive())  # what is left of the tasks so far
                yield setting.batch(2 * i, 4), setting.batch(2 * i + 1, 6)

        _, _, losses = meta_gradient(
            setting.loss, setting.params, tasks(), 0.1, vectorize=vectorize
        )
    assert len(losses) == 5 * vectorize and max(size for _, size in storages.made) > 1000
    parameters = sum(p.numel() for p in setting.params.values()) * 8
    assert (
        max(alive) < 3.5 * parameters
    )  # the sum, one task's gradients, one task's batch; no graph
    assert max(alive[3:]) - alive[2] < 0.02 * parameters


def test_the_result_carries_no_graph_although_the_parameters_require_grad(setting):
    for vectorize in (1, 2):
        gradients, _, losses = meta_gradient(
            setting.loss, setting.params, setting.tasks, 0.1, vectorize=vectorize
        )
        assert all(p.requires_grad for p in setting.params.values())
        assert not losses.requires_grad and not any(g.requires_grad for g in gradients.values())
    assert math.isfinite(losses.sum())
