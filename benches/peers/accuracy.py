"""Writes docs/library/accuracy.md: errors of elementwise operations in raygrad, PyTorch and JAX over all bits.

    mkdir cases && ACCURACY_DUMP=$PWD/cases ACCURACY_DRAWS=20000 \
        cargo test --release -p raygrad-autograd --test testsuite accuracy
    cargo build --release -p raygrad-autograd --example op_speed
    python accuracy.py cases ../../docs --speed ../../target/release/examples/op_speed

The test writes arguments, incoming gradients and exact results. This script evaluates the same operations in PyTorch and
JAX on the CPU and measures their errors in the same units. Cases in which an argument, the gradient or the exact result
is a subnormal number are counted apart, since XLA takes such numbers for 0.

With `--speed` it also draws docs/bench/accuracy.png: errors against the time of each function, on one thread in f32.
PyTorch and JAX are timed in turns with raygrad's program, on 131072 numbers between 0 and 1.
"""

import argparse
import json
import os
import re
import statistics
import subprocess
import time
from pathlib import Path

# One thread, before the libraries start theirs.
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import jax
import numpy as np
import torch
import torch.nn.functional as F

jax.config.update("jax_enable_x64", True)
jnp, nn, special = jax.numpy, jax.nn, jax.scipy.special
BIG, SMALL = 2.0**100, 2.0**-100


def jax_huber(delta):
    return lambda a, b: jnp.where(abs(a - b) <= delta, 0.5 * (a - b) ** 2, delta * (abs(a - b) - 0.5 * delta))


def jax_smooth(beta):
    return lambda a, b: jnp.where(abs(a - b) < beta, 0.5 * (a - b) ** 2 / beta, abs(a - b) - 0.5 * beta)


def torch_huber(delta):
    return lambda a, b: F.huber_loss(a, b, delta=delta, reduction="none")


def torch_smooth(beta):
    return lambda a, b: F.smooth_l1_loss(a, b, beta=beta, reduction="none")


def jax_bce(a, b):
    return nn.softplus(-jnp.abs(a)) + jnp.maximum(a, 0) - a * b


# Operation of raygrad: that of PyTorch, that of JAX; None where a library has none.
PEERS = {
    "exp": (torch.exp, jnp.exp),
    "expm1": (torch.expm1, jnp.expm1),
    "exp2": (torch.exp2, jnp.exp2),
    "ln": (torch.log, jnp.log),
    "ln1p": (torch.log1p, jnp.log1p),
    "log2": (torch.log2, jnp.log2),
    "sqrt": (torch.sqrt, jnp.sqrt),
    "rsqrt": (torch.rsqrt, jax.lax.rsqrt),
    "erf": (torch.erf, special.erf),
    "normal_cdf": (torch.special.ndtr, special.ndtr),
    "sin": (torch.sin, jnp.sin),
    "cos": (torch.cos, jnp.cos),
    "sin_pi": (None, None),
    "cos_pi": (None, None),
    "tan": (torch.tan, jnp.tan),
    "asin": (torch.asin, jnp.arcsin),
    "acos": (torch.acos, jnp.arccos),
    "atan": (torch.atan, jnp.arctan),
    "sinh": (torch.sinh, jnp.sinh),
    "cosh": (torch.cosh, jnp.cosh),
    "tanh": (torch.tanh, jnp.tanh),
    "abs": (torch.abs, jnp.abs),
    "sign": (torch.sign, jnp.sign),
    "floor": (torch.floor, jnp.floor),
    "ceil": (torch.ceil, jnp.ceil),
    "round": (torch.round, jnp.round),
    "reciprocal": (torch.reciprocal, jnp.reciprocal),
    "affine": (lambda x: -2.5 * x + 0.75, lambda x: -2.5 * x + 0.75),
    "clamp": (lambda x: x.clamp(-1, 2), lambda x: jnp.clip(x, -1, 2)),
    "relu": (F.relu, nn.relu),
    "sigmoid": (torch.sigmoid, nn.sigmoid),
    "softplus": (F.softplus, nn.softplus),
    "log_sigmoid": (F.logsigmoid, nn.log_sigmoid),
    "leaky_relu": (lambda x: F.leaky_relu(x, 0.125), lambda x: nn.leaky_relu(x, 0.125)),
    "elu": (lambda x: F.elu(x, 1.5), lambda x: nn.elu(x, 1.5)),
    "elu_2^100": (lambda x: F.elu(x, BIG), lambda x: nn.elu(x, BIG)),
    "silu": (F.silu, nn.silu),
    "gelu": (F.gelu, lambda x: nn.gelu(x, approximate=False)),
    "gelu_tanh": (lambda x: F.gelu(x, approximate="tanh"), nn.gelu),
    "square": (torch.square, jnp.square),
    "add": (torch.add, jnp.add),
    "sub": (torch.sub, jnp.subtract),
    "mul": (torch.mul, jnp.multiply),
    "div": (torch.div, jnp.divide),
    "maximum": (torch.maximum, jnp.maximum),
    "minimum": (torch.minimum, jnp.minimum),
    "if_positive": (lambda a, b, c: torch.where(a > 0, b, c), lambda a, b, c: jnp.where(a > 0, b, c)),
    "where": (lambda a, b, c: torch.where(a > 0, b, c), lambda a, b, c: jnp.where(a > 0, b, c)),
    "lerp": (torch.lerp, lambda a, b, w: a + w * (b - a)),
    "atan2": (torch.atan2, jnp.arctan2),
    "hypot": (torch.hypot, jnp.hypot),
    "pow": (torch.pow, jnp.power),
    "xlogy": (torch.xlogy, special.xlogy),
    "logaddexp": (torch.logaddexp, jnp.logaddexp),
    "remainder": (torch.remainder, jnp.remainder),
    "squared_error": (lambda a, b: (a - b) ** 2, lambda a, b: (a - b) ** 2),
    "absolute_error": (lambda a, b: abs(a - b), lambda a, b: abs(a - b)),
    "huber_1.5": (torch_huber(1.5), jax_huber(1.5)),
    "huber_2^100": (torch_huber(BIG), jax_huber(BIG)),
    "huber_2^-100": (torch_huber(SMALL), jax_huber(SMALL)),
    "smooth_l1_1.5": (torch_smooth(1.5), jax_smooth(1.5)),
    "smooth_l1_2^100": (torch_smooth(BIG), jax_smooth(BIG)),
    "smooth_l1_2^-100": (torch_smooth(SMALL), jax_smooth(SMALL)),
    "binary_cross_entropy_with_logits": (lambda a, b: F.binary_cross_entropy_with_logits(a, b, reduction="none"), jax_bce),
}
for n in (0, 1, 3, 4, 5, 12, -1, -2, -7):
    PEERS[f"powi_{n}"] = (lambda x, n=n: x**n, lambda x, n=n: x**n)
for name, p in {"0": 0.0, "1": 1.0, "0.5": 0.5, "1.75": 1.75, "2": 2.0, "-0.5": -0.5, "2^-80": 2.0**-80}.items():
    PEERS[f"powf_{name}"] = (lambda x, p=p: x**p, lambda x, p=p: x**p)

HEAD = """# Accuracy

Errors of elementwise operations in units in the last place (ULP), over all bits of arguments and incoming gradients.
This page is generated; do not edit it by hand. `benches/peers/accuracy.py` has the commands.
The versions are {versions}.

- Each cell has the worst and the mean error; or the worst, and in brackets the number of errors above 8 ULP. "inf" is
  an infinite or a NaN result that should be finite, or a finite one that should not.
- Each operation and type has {draws} cases. Three of eight arguments are any bit pattern. The others are of usual size,
  or close to kinks and borders.
- Values are compared everywhere but at a = 0 of powers, `atan2` and `xlogy`, where conventions decide. Gradients are
  compared where the value is finite. Infinities and NaN have their own tests.
- Where terms cancel, the unit is that of the largest term.
- Cases with a subnormal argument, gradient or result are in the last column alone. It has the numbers of errors above
  8 ULP of the three libraries in this order. XLA takes subnormal numbers for 0.
- At kinks and ties the libraries have other conventions, which count as errors here.
- JAX has no binary cross-entropy, Huber and smooth L1 loss: those are written with `jnp.where`.
- **Bold**: raygrad's worst error is not the smallest. The next table has the reasons.

| in bold | reason |
|---|---|
| `exp` to `log2`, `erf`, `sin`, `cos`, `tanh`, `softplus` | [straight-line code](vector-math.md), one set of bits |
| `log_sigmoid`, `elu` | a softplus, and an `expm1` times alpha |
| gradients of `sin` and `cos` | these are values of `cos` and `sin`, times g |
| `asin`, `atan2` | the platform's library, against SLEEF in PyTorch |
| `cosh`, `hypot` | four roundings after an exponential, or a ratio |
| `xlogy` | a logarithm, times a |
| `powi, 4`, `rsqrt` | products and quotients of the type, without a call |
| gradients of `log2`, `tan`, `powf` | one rounding more, in an order of products that keeps their range |

Errors of raygrad above 8 ULP, in all rows and with subnormal numbers: {breaches}. This prints the arguments of its
worst cases:

```sh
ACCURACY_DRAWS=20000 cargo test --release -p raygrad-autograd --test testsuite accuracy -- --nocapture
```

## Time and error

![Time and error](../bench/accuracy.png)

Each point is a function in f32: the time an element on one thread, of numbers in cache between 0 and 1, and the worst
error of the tables below. A gradient is the backward pass alone, of all operands; JAX computes it in one function with
what it needs of the forward pass.

"""


def torch_results(f, x, g):
    x = [torch.tensor(x, requires_grad=True) for x in x]
    y = f(*x)
    grads = torch.autograd.grad(y, x, torch.tensor(g), allow_unused=True)
    return [y.detach().numpy()] + [np.zeros_like(g) if grad is None else grad.numpy() for grad in grads]


def jax_results(f, x, g):
    y, vjp = jax.jit(lambda *x: jax.vjp(f, *x))(*x)
    return [np.asarray(y)] + [np.asarray(grad) for grad in vjp(g)]


def errors(got, high, low, unit, limit):
    """Those of `got`, from exact results in units."""
    got = got.astype(np.float64)
    with np.errstate(all="ignore"):
        exact = np.ldexp(high, unit)
        scaled = np.ldexp(got, -unit)
        error = np.abs((scaled - high) - low)
        overflow = np.isinf(got) & (got * high > 0)
        # Infinity stands for the number after the largest.
        error = np.where(overflow, np.maximum(0, np.ldexp(limit[0], limit[1] - unit) - np.abs(high)), error)
        error = np.where(np.isinf(got) & ~overflow | np.isnan(got), np.inf, error)
        return np.where(~np.isfinite(high), np.where((got == exact) | np.isnan(got) & np.isnan(exact), 0, np.inf), error)


def cell(error):
    worst, above = error.max(initial=0), int((~(error <= 8)).sum())
    short = lambda x: "inf" if not np.isfinite(x) else f"{abs(x):.1f}" if x < 100 else f"{x:.0e}"
    text = f"{short(worst)}, {np.mean(error) if len(error) else 0:.2f}" if not above else short(worst)
    return f"{text} ({above})" if above else text


def row(name, kind, path):
    torch_f, jax_f = PEERS[name]
    numbers = np.fromfile(path, "<f8")
    operands = int(numbers[0])
    width = operands + 1 + 4 * (operands + 1)
    cases = numbers[1:].reshape(-1, width)
    dtype = np.float32 if kind == "f32" else np.float64
    x = [cases[:, k].astype(dtype) for k in range(operands)]
    g = cases[:, operands].astype(dtype)
    results = {"PyTorch": torch_f and torch_results(torch_f, x, g), "JAX": jax_f and jax_results(jax_f, x, g)}
    least = np.finfo(dtype).tiny
    limit = 1.0, 128 if kind == "f32" else 1024
    lines, worsts, above = [], [], 0
    for k in range(operands + 1):
        high, low, unit, own = cases[:, operands + 1 + 4 * k : operands + 5 + 4 * k].T
        unit = unit.astype(int)
        with np.errstate(all="ignore"):
            exact = np.abs(np.ldexp(high, unit))
        given = [*x, g] if k else x
        tiny = (exact < least) & (exact > 0) | np.any([(np.abs(v) < least) & (v != 0) for v in given], axis=0)
        compared = ~np.isnan(own)
        columns = {"raygrad": own}
        for library, result in results.items():
            columns[library] = None if result is None else errors(result[k], high, low, unit, limit)
        ordinary, rest = [], []
        for column in columns.values():
            ordinary.append("" if column is None else cell(column[compared & ~tiny]))
            rest.append("" if column is None else str(int((~(column[compared & tiny] <= 8)).sum())))
        worst = {n: c[compared & ~tiny].max(initial=0) for n, c in columns.items() if c is not None}
        if worst["raygrad"] > min(worst.values()) + 0.05:
            ordinary[0] = f"**{ordinary[0]}**"
        worsts.append(worst)
        above += int((~(own[compared] <= 8)).sum())
        of = "value" if k == 0 else "gradient" if operands == 1 else f"gradient {k}"
        title = re.sub("_(-?[0-9])", r", \1", name)
        counts = ", ".join(r or "-" for r in rest)
        lines.append(f"| `{title}` {of} | {' | '.join(ordinary)} | {counts} |")
    return lines, len(cases), worsts, above


def fastest(f):
    """Nanoseconds of the fastest call."""
    best = float("inf")
    for _ in range(60):
        start = time.perf_counter_ns()
        f()
        best = min(best, time.perf_counter_ns() - start)
    return best


def torch_times(f, x):
    x = [torch.tensor(x, requires_grad=True) for x in x]
    y = f(*x)
    g = torch.ones_like(y)
    forward = fastest(lambda: f(*x))
    return [forward, fastest(lambda: torch.autograd.grad(y, x, g, retain_graph=True))]


def jax_times(f, x):
    x = [jnp.asarray(x) for x in x]
    forward, both = jax.jit(f), jax.jit(lambda *x: jax.vjp(f, *x)[1](jnp.ones_like(x[0])))
    forward(*x).block_until_ready(), jax.block_until_ready(both(*x))
    # Compiled as one, the backward pass computes what it needs of the forward pass.
    return [fastest(lambda: forward(*x).block_until_ready()), fastest(lambda: jax.block_until_ready(both(*x)))]


def times(program, operands):
    """Of each function and library: nanoseconds an element, forward and backward; medians of three turns."""
    torch.set_num_threads(1)
    n, rng, turns = 1 << 17, np.random.default_rng(0), {}
    for _ in range(3):
        output = subprocess.run([program, "functions"], check=True, capture_output=True, text=True).stdout
        for line in map(json.loads, output.splitlines()):
            name = line["function"].replace(", ", "_")
            x = [rng.uniform(0.02, 0.98, n).astype(np.float32) for _ in range(2)]
            of = turns.setdefault(name, {"raygrad": []})
            of["raygrad"].append([line["forward"], line["backward"]])
            for library, f, measure in zip(("PyTorch", "JAX"), PEERS[name], (torch_times, jax_times)):
                if f is not None:
                    of.setdefault(library, []).append([t / n for t in measure(f, x[: operands[name]])])
    median = lambda rows: [statistics.median(column) for column in zip(*rows)]
    return {name: {library: median(rows) for library, rows in of.items()} for name, of in turns.items()}


def plot(figures, worsts, path):
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    most, looks = 1e8, {"raygrad": ("o", "tab:blue"), "PyTorch": ("^", "tab:orange"), "JAX": ("s", "tab:green")}
    figure, panels = pyplot.subplots(1, 2, figsize=(11, 4.6), sharey=True, constrained_layout=True)
    for k, (panel, title) in enumerate(zip(panels, ("value", "gradient"))):
        for library, (marker, colour) in looks.items():
            at = []
            for name, of in figures.items():
                if library in of:
                    errors = worsts[name][:1] if k == 0 else worsts[name][1:]
                    error = max(error.get(library, 0) for error in errors)
                    at.append((of[library][k], min(max(error, 0.1), most)))
            panel.scatter(*zip(*at), marker=marker, color=colour, label=library, alpha=0.75, s=28)
        panel.axhline(8, color="grey", linewidth=0.8, linestyle="--")
        panel.set(xscale="log", yscale="log", title=title, xlabel="nanoseconds an element")
        panel.grid(alpha=0.25)
    panels[0].set_ylabel("worst error, ULP (infinite: 1e8)")
    panels[1].legend(loc="center right")
    figure.savefig(path, dpi=100)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", type=Path, help="the folder that the test has written")
    parser.add_argument("docs", type=Path, help="the folder of the documents")
    parser.add_argument("--speed", help="the example op_speed; draws the plot")
    args = parser.parse_args()
    folder, out = args.cases, args.docs / "library/accuracy.md"
    text, draws, worsts, breaches = "", 0, {}, 0
    for kind in ("f32", "f64"):
        text += f"## {kind}\n\n| operation | raygrad | PyTorch | JAX | subnormal |\n|---|--:|--:|--:|---|\n"
        for name in PEERS:
            lines, draws, worst, above = row(name, kind, folder / f"{name}.{kind}")
            worsts.setdefault(name, worst)
            breaches += above
            text += "\n".join(lines) + "\n"
        text += "\n"
    versions = f"PyTorch {torch.__version__.split('+')[0]}, JAX {jax.__version__}"
    operands = {name: len(worst) - 1 for name, worst in worsts.items()}
    if args.speed:
        plot(times(args.speed, operands), worsts, args.docs / "bench/accuracy.png")
    out.write_text(HEAD.format(versions=versions, draws=draws, breaches=breaches) + text.rstrip() + "\n")


if __name__ == "__main__":
    main()
