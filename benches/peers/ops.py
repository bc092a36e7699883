"""Small peers in PyTorch: operation overhead, small training steps, single operations, fused chains, vector math.

One line of JSON each, of the same work as benches/framework.rs and rust-peers; vector math in turns: vmath.py.
"""

import argparse

import torch
from torch import nn
from torch.nn import functional as F

import measure


def recorded_scalars(args):
    """x <- w x + w, 500 times over: 1000 recorded operations on 0-dimensional tensors."""
    w = torch.tensor(0.999, requires_grad=True)

    def chain():
        x = w
        for _ in range(500):
            x = w * x + w
        return x

    forward, _ = measure.timed(chain, args.repeats, args.warmup)
    both, _ = measure.timed(lambda: torch.autograd.grad(chain(), w), args.repeats, args.warmup)
    report(
        args,
        "scalar chain, 1000 recorded operations",
        nanoseconds_forward_per_op=forward * 1e6,
        nanoseconds_backward_per_op=(both - forward) * 1e6,
    )


def training_steps(args):
    """Forward, backward and Adam."""
    relu, pool = nn.ReLU(inplace=True), nn.MaxPool2d(2)
    narrow = nn.Sequential(nn.Linear(32, 64), relu, nn.Linear(64, 64), relu, nn.Linear(64, 64), relu, nn.Linear(64, 3))
    dense = nn.Sequential(nn.Linear(784, 512), relu, nn.Linear(512, 512), relu, nn.Linear(512, 10))
    conv = nn.Sequential(
        *(nn.Conv2d(1, 8, 3, padding=1), relu, pool, nn.Conv2d(8, 16, 3, padding=1), relu, pool),
        *(nn.Flatten(), nn.Linear(16 * 7 * 7, 10)),
    )
    images, classes = torch.rand(64, 1, 28, 28), torch.arange(128) % 10
    cases = (
        ("train MLP 32-64-64-64-3, 256 rows, MSE", narrow, F.mse_loss, torch.rand(256, 32), torch.rand(256, 3)),
        ("train MLP 784-512-512-10, 128 rows, cross entropy", dense, F.cross_entropy, torch.rand(128, 784), classes),
        ("train CNN 8-16, 64 images 28x28, cross entropy", conv, F.cross_entropy, images, classes[:64]),
    )
    for what, model, loss_of, x, target in cases:
        adam = torch.optim.Adam(model.parameters(), fused=True)

        def step():
            adam.zero_grad()
            loss = loss_of(model(x), target)
            loss.backward()
            adam.step()
            return loss.item()

        seconds, losses = measure.timed(step, args.repeats, args.warmup)
        report(args, what, seconds_per_step=seconds, loss_first=losses[0], loss_last=losses[-1])


def single_operations(args):
    """The gradient of the sum of f(x)."""
    rows, weight = torch.randn(1024, 512), torch.randn(1024, 512)
    gain, bias = torch.ones(512, requires_grad=True), torch.zeros(512, requires_grad=True)
    million, matrix = torch.randn(1_000_000), torch.randn(4096, 1024)
    cases = (
        ("softmax 1024x512", lambda x: x.softmax(-1) * weight, rows),
        ("layer norm 1024x512", lambda x: F.layer_norm(x, x.shape[-1:], gain, bias) * weight, rows),
        ("elementwise chain, 1M", chain(torch), million),
        ("sum over axis 0, 4096x1024", lambda x: x.sum(0), matrix),
        ("sum over axis 1, 4096x1024", lambda x: x.sum(1), matrix),
        ("sum, 4096x1024", torch.sum, matrix),
    )
    for what, f, x in cases:
        x = x.clone().requires_grad_()
        seconds, _ = measure.timed(lambda: torch.autograd.grad(f(x).sum(), x), args.repeats, args.warmup)
        # The gradient of a sum is one number seen through strides of 0; `.backward()` and optimizers write it out.
        written = lambda: torch.autograd.grad(f(x).sum(), x)[0].contiguous()
        seconds_written, _ = measure.timed(written, args.repeats, args.warmup)
        report(args, what, seconds_forward_backward=seconds, seconds_with_gradient_written=seconds_written)


def chain(library):
    """Nine elementwise operations."""
    return lambda x: library.tanh(x * 1.5 + 0.5) * x + library.exp(x * x * -0.5) - x


def fused_chain(args):
    """The chain of `single_operations` with its gradient, compiled by PyTorch and by JAX."""
    import jax

    what, f, million = "elementwise chain, 1M, fused", chain(torch), torch.randn(1_000_000)
    x, loss = million.clone().requires_grad_(), torch.compile(lambda x: f(x).sum())
    seconds, _ = measure.timed(lambda: torch.autograd.grad(loss(x), x)[0].contiguous(), args.repeats, args.warmup)
    measure.report("torch.compile", what, args.threads, seconds_forward_backward=seconds)
    gradient = jax.jit(jax.value_and_grad(lambda x: chain(jax.numpy)(x).sum()))
    x = jax.numpy.asarray(million.numpy())
    seconds, _ = measure.timed(lambda: jax.block_until_ready(gradient(x)), args.repeats, args.warmup)
    measure.report("jax.jit", what, args.threads, packages=("jax",), seconds_forward_backward=seconds)


def vector_math(args):
    """64k elements on one thread into an array that is already there: uniform in (-4, 4), logarithms in (0, 4)."""
    count = 1 << 16
    x = torch.rand(count) * 8 - 4
    cases = {name: (getattr(torch, name), x) for name in ("exp", "expm1", "sin", "cos", "tanh", "sigmoid", "erf")}
    cases |= {"softplus": (F.softplus, x), "ln": (torch.log, x.abs()), "log1p": (torch.log1p, x.abs())}
    result = torch.empty_like(x)
    torch.set_num_threads(1)
    with torch.inference_mode():
        for name, (f, x) in cases.items():
            seconds, _ = measure.timed(lambda: f(x, out=result), args.repeats * 10, args.warmup)
            report(args, f"{name}, 64k elements", threads=1, nanoseconds_per_element=seconds * 1e9 / count)
    torch.set_num_threads(args.threads)


def report(args, what, threads=None, **figures):
    measure.report("torch", what, threads or args.threads, **figures)


GROUPS = {
    "scalars": recorded_scalars,
    "training": training_steps,
    "operations": single_operations,
    "fused": fused_chain,
    "math": vector_math,
}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("groups", nargs="*", default=list(GROUPS), help=f"from: {', '.join(GROUPS)}; all by default")
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--warmup", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    if unknown := set(args.groups) - set(GROUPS):
        parser.error(f"no such group: {', '.join(sorted(unknown))}")

    torch.set_num_threads(args.threads)
    torch.manual_seed(0)
    for name in args.groups:
        GROUPS[name](args)


if __name__ == "__main__":
    main()
