"""Model-agnostic meta-learning, with the exact second-order gradient, for any model and any loss.

    inner loop    theta'_i = theta - alpha * grad_theta L(theta, support_i)               (Eq. 2)
    outer loop    g = grad_theta 1/|tasks| * sum_i L(theta'_i(theta), query_i)            (Eq. 3)

The outer gradient runs *through* the inner step. With v_i the query gradient at theta'_i, and H_i
the matrix of second derivatives of the support loss at theta, the chain rule says for one step

    g = 1/|tasks| * sum_i (I - alpha * H_i) v_i

H_i is never made: autograd takes v_i back through the support gradient, and that gives H_i v_i at
about the price of another gradient. First-order MAML leaves H_i out.

alpha is one number, or one for each tensor of theta, which can then be learned as well (Meta-SGD,
Li et al. 2017; MAML++, Antoniou et al. 2019). For the tensor k and one step

    d L / d alpha_k = -1/|tasks| * sum_i <v_i, grad_theta L(theta, support_i)>_k

in first-order MAML, too. It comes out of the same backward pass as g.

Nothing here knows what a policy is. A model enters as `params`, a dictionary of tensors, and a
function `loss_fn(params, batch) -> scalar tensor`; with a `torch.nn.Module` that is

    def loss_fn(params, batch):  # batch: keyword arguments of module.forward
        return torch.func.functional_call(module, params, (), batch)

`loss_fn` must be pure: random numbers (diffusion noise, dropout masks) belong in `batch`.
"""

from collections.abc import Callable, Iterable
from contextlib import nullcontext
from functools import partial
from inspect import signature
from itertools import islice
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.func import grad, grad_and_value
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_map

Params = dict[str, Tensor]
InnerRate = float | dict[str, Tensor]  # alpha: one number, or parameter name -> tensor
LossFn = Callable[[Params, Any], Tensor]


def adapt(
    loss_fn: LossFn,
    params: Params,
    batch: Any,
    lr: InnerRate,
    steps: int = 1,
    first_order: bool = False,
) -> Params:
    """Returns the parameters after `steps` steps of gradient descent on one batch (Eq. 2).

    The result is a differentiable function of `params`, and of `lr` where that is tensors; the
    input is not modified.

    Args:
        loss_fn: `(params, batch) -> ()`, pure.
        params: name -> tensor, theta.
        batch: anything `loss_fn` understands, usually the support set of a task.
        lr: the inner learning rate alpha, the same for all parameters; or name -> tensor, one for
            each parameter, of shape () or any other that broadcasts to the parameter's.
        steps: gradient steps, all on the same batch.
        first_order: first-order MAML: the inner gradient is treated as a constant. It is cheaper,
            and it gives a different meta-gradient.
    """
    for _ in range(steps):
        start = {name: p.detach() for name, p in params.items()} if first_order else params
        gradient = grad(loss_fn)(start, batch)
        # p - lr * gradient: one fused operation, forward and backward, instead of two.
        if isinstance(lr, dict):
            params = {
                name: torch.addcmul(p, lr[name], gradient[name], value=-1)
                for name, p in params.items()
            }
        else:
            params = {name: torch.add(p, gradient[name], alpha=-lr) for name, p in params.items()}
    return params


def meta_gradient(
    loss_fn: LossFn,
    params: Params,
    tasks: Iterable[tuple[Any, Any]],
    lr: InnerRate,
    steps: int = 1,
    first_order: bool = False,
    vectorize: int = 1,
) -> tuple[Params, Params, Tensor]:
    """The gradient of the mean query loss, through each task's inner loop (Eq. 3; Algorithm 1).

    Args:
        loss_fn, params, lr, steps, first_order: as in `adapt`.
        tasks: (support, query) batches, one pair a task. An iterator is read `vectorize` tasks at a
            time, and their graph is freed before the next are read: memory does not grow.
        vectorize: how many tasks run at once, under `torch.vmap`. The numbers are the same up
            to rounding, and it is up to twice as fast. The batches must have equal shapes and hold
            tensors only.

    Returns:
        gradients: name -> tensor.
        rate_gradients: the gradient for each tensor of `lr`, name -> tensor of the rate's shape;
            empty where `lr` is a number.
        losses: the query losses with the adapted parameters, (tasks,).

    Raises:
        ValueError: there is no task, or `vectorize` is less than 1.
        NotImplementedError: with `vectorize` > 1, `loss_fn` calls what PyTorch differentiates
            wrongly under `vmap`; see the end of this file.
    """
    if vectorize < 1:
        raise ValueError(f"vectorize is {vectorize}: at least one task runs at a time")
    params = {name: p.detach().requires_grad_() for name, p in params.items()}
    rates = {}
    if isinstance(lr, dict):
        lr = rates = {name: rate.detach().requires_grad_() for name, rate in lr.items()}

    tasks = iter(tasks)
    losses = []
    total = {name: torch.zeros_like(p) for name, p in params.items()}  # of all tasks' gradients
    rate_total = {name: torch.zeros_like(rate) for name, rate in rates.items()}
    while chunk := list(islice(tasks, vectorize)):
        gradients, rate_gradients, chunk_losses = chunk_gradient(
            loss_fn, params, chunk, lr, steps, first_order
        )
        losses.append(chunk_losses)
        for name, gradient in gradients.items():
            total[name] += gradient
        for name, gradient in rate_gradients.items():
            rate_total[name] += gradient
    if not losses:
        raise ValueError("meta_gradient needs at least one task")
    losses = torch.cat(losses)
    gradients = {name: g / len(losses) for name, g in total.items()}
    rate_gradients = {name: g / len(losses) for name, g in rate_total.items()}
    return gradients, rate_gradients, losses


def chunk_gradient(
    loss_fn: LossFn,
    params: Params,
    chunk: list[tuple[Any, Any]],
    lr: InnerRate,
    steps: int,
    first_order: bool,
) -> tuple[Params, Params, Tensor]:
    """The meta-gradient of some tasks, which run at once, each with adapted parameters of its own.

    `params` require grad, and so does `lr` where it is tensors.

    Returns:
        The gradients for `params`, a sum over the tasks; those for `lr`, {} where it is a number;
        and the query losses (tasks,).
    """
    rates = lr if isinstance(lr, dict) else {}
    adapt_task = partial(adapt, loss_fn, lr=lr, steps=steps, first_order=first_order)
    query_gradient = grad_and_value(loss_fn)
    if len(chunk) == 1:
        support, query = chunk[0]
    else:
        support, query = tree_map(lambda *parts: torch.stack(parts), *chunk)
        adapt_task = torch.vmap(adapt_task, in_dims=(None, 0))
        query_gradient = torch.vmap(query_gradient)

    with RightUnderVmap() if len(chunk) > 1 else nullcontext():
        adapted = adapt_task(params, support)  # theta'_i, with the graph that leads to theta
        v, losses = query_gradient({name: p.detach() for name, p in adapted.items()}, query)
        # sum_i (I - alpha H_i) v_i: the query gradients, taken back through the inner loops
        g = torch.autograd.grad(
            outputs=list(adapted.values()),
            inputs=[*params.values(), *rates.values()],
            grad_outputs=[v[name] for name in adapted],
        )
    gradients = dict(zip(params, g[: len(params)]))
    rate_gradients = dict(zip(rates, g[len(params) :]))
    return gradients, rate_gradients, losses.detach().view(-1)


# ---- Where PyTorch is wrong under vmap: skip this when reading the method ------------------------
#
# Under `torch.vmap` every task has adapted weights of its own. With such weights PyTorch (2.13)
# returns a wrong second derivative of layer, batch and instance normalization, and wrong
# derivatives of an embedding with `padding_idx` or `scale_grad_by_freq`, and raises no error. The
# other layers of torch.nn were compared one by one: they give the same numbers with and without
# `vmap`, or raise an error. tests/test_maml.py repeats the comparison.

NORMALIZATIONS = {F.layer_norm, F.batch_norm, F.instance_norm}  # what the layers of torch.nn call
REFUSED = {  # the functions underneath, which a loss might call directly
    torch.layer_norm,
    torch.native_layer_norm,
    torch.batch_norm,
    torch.native_batch_norm,
    torch.instance_norm,
    torch.embedding,
}


class RightUnderVmap(TorchFunctionMode):
    """Inside this context normalization has its right derivatives under `torch.vmap`.

    Other functions that PyTorch differentiates wrongly there raise NotImplementedError.
    """

    def __torch_function__(
        self, func: Callable, types: Any, args: tuple = (), kwargs: dict | None = None
    ) -> Any:
        kwargs = kwargs or {}
        if func in NORMALIZATIONS:
            return normalize_then_scale(func, *args, **kwargs)
        if func in REFUSED or (func is F.embedding and alters_gradient(*args, **kwargs)):
            raise NotImplementedError(
                f"{func.__name__}, called like this, has wrong derivatives under torch.vmap, which "
                "is used where several tasks run at once: use vectorize=1"
            )
        return func(*args, **kwargs)


def normalize_then_scale(function: Callable, *args: Any, **kwargs: Any) -> Tensor:
    """One of `NORMALIZATIONS`, with its weight and bias applied outside PyTorch's function."""
    options = signature(function).bind(*args, **kwargs).arguments
    weight, bias = options.pop("weight", None), options.pop("bias", None)
    x = function(**options)  # layer_norm: (..., *weight.shape); the others: (B, channels, ...)
    if function is F.layer_norm:
        shape = options["normalized_shape"]
    else:
        shape = (-1, *[1] * (x.dim() - 2))  # (channels, 1, ...)
    if weight is not None:
        x = x * weight.view(*shape)
    if bias is not None:
        x = x + bias.view(*shape)
    return x


def alters_gradient(*args: Any, **kwargs: Any) -> bool:
    """Whether a call of `F.embedding` has an option that leaves out or scales gradients."""
    options = signature(F.embedding).bind(*args, **kwargs).arguments
    return options.get("padding_idx") is not None or bool(options.get("scale_grad_by_freq"))
