"""Writes peers.npz, the reference values of tests/testsuite/peers.rs: every operation of the catalogue as PyTorch does it in f64.

    pip install numpy torch                  # torch 2.15, numpy 2.4 wrote the committed file
    python make.py

For each case, with inputs x, a cotangent u of the output y = f(x), and weights w of the gradient g = d<u, y>/dx:

    NAME/x0, NAME/x1 ..   the inputs, exact in f32
    NAME/u                the cotangent
    NAME/w                the weights, those of all inputs behind one another
    NAME/y                the value
    NAME/g                the gradients of all inputs behind one another
    NAME/h                the gradients of <w, g>: of all inputs, then of u

A case is named after its operation in the catalogue, with what distinguishes it behind a point. Inputs keep away from
kinks and ties, where conventions differ (conventions.rs).
"""

import math
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

GOLDEN = 0.6180339887498949
arrays = {}


def spread(shape, *ranges, salt=0):
    """Values that fill the ranges evenly, alternating between them, and are exact in f32."""
    values = np.empty(math.prod(shape))
    for i in range(len(values)):
        low, high = ranges[i % len(ranges)]
        values[i] = low + ((i + 1) * GOLDEN + salt * 0.377) % 1 * (high - low)
    return values.astype(np.float32).astype(np.float64).reshape(shape)


def case(name, f, *inputs):
    """Adds a case; an input is a shape, for values in -1..1, or an array."""
    inputs = [x if isinstance(x, np.ndarray) else spread(x, (-1, 1), salt=i) for i, x in enumerate(inputs)]
    x = [torch.tensor(x, requires_grad=True) for x in inputs]
    y = f(*x)
    u = torch.tensor(spread(y.shape, (0.3, 1.3), salt=3), requires_grad=True)

    def gradient(of, wrt):
        if not of.requires_grad:
            return [torch.zeros_like(x) for x in wrt]
        got = torch.autograd.grad(of, wrt, create_graph=True, allow_unused=True)
        return [torch.zeros_like(x) if grad is None else grad for grad, x in zip(got, wrt)]

    g = gradient((u * y).sum(), x)
    w = [torch.tensor(spread(x.shape, (-1, 1), salt=29 + i)) for i, x in enumerate(x)]
    h = gradient(sum((w * g).sum() for w, g in zip(w, g)), [*x, u])
    assert name not in arrays and all(torch.isfinite(v).all() for v in [y, *g, *h]), name

    def flat(parts):
        return np.concatenate([part.detach().numpy(force=True).ravel() for part in parts])

    for i, value in enumerate(inputs):
        arrays[f"{name}/x{i}"] = value
    for key, value in {"u": u.detach().numpy(), "w": flat(w), "y": y.detach().numpy(), "g": flat(g), "h": flat(h)}.items():
        arrays[f"{name}/{key}"] = value


def unary(name, f, *ranges):
    case(name, f, spread((7,), *ranges))


def binary(name, f, a=((-3, 3),), b=((-3, 3),), broadcast=True):
    case(name, f, spread((2, 3), *a), spread((2, 3), *b, salt=1))
    if broadcast:
        case(f"{name}.broadcast", f, spread((3,), *a), spread((2, 1), *b, salt=1))


def elementwise():
    wide = ((-6, 6),)
    unary("affine", lambda x: -2.5 * x + 0.75, (-3, 3))
    unary("exp", torch.exp, (-3, 3))
    unary("expm1", torch.expm1, (-3, 3))
    unary("exp2", torch.exp2, (-3, 3))
    unary("ln", torch.log, (0.1, 5))
    unary("ln1p", torch.log1p, (-0.8, 4))
    unary("log2", torch.log2, (0.1, 5))
    unary("sqrt", torch.sqrt, (0.1, 4))
    unary("rsqrt", torch.rsqrt, (0.1, 4))
    unary("erf", torch.erf, (-2.5, 2.5))
    unary("normal_cdf", torch.special.ndtr, (-2.5, 2.5))
    unary("sin", torch.sin, *wide)
    unary("cos", torch.cos, *wide)
    unary("tan", torch.tan, (-1.3, 1.3))
    unary("asin", torch.asin, (-0.9, 0.9))
    unary("acos", torch.acos, (-0.9, 0.9))
    unary("atan", torch.atan, (-4, 4))
    unary("sinh", torch.sinh, (-3, 3))
    unary("cosh", torch.cosh, (-3, 3))
    unary("tanh", torch.tanh, (-3, 3))
    unary("sin_pi", lambda x: torch.sin(math.pi * x), (-1.4, 1.4))
    unary("cos_pi", lambda x: torch.cos(math.pi * x), (-1.4, 1.4))
    unary("relu", torch.relu, (-3, -0.1), (0.1, 3))
    unary("sigmoid", torch.sigmoid, *wide)
    unary("softplus", F.softplus, *wide)
    unary("log_sigmoid", F.logsigmoid, *wide)
    unary("leaky_relu", lambda x: F.leaky_relu(x, 0.125), (-3, -0.1), (0.1, 3))
    unary("elu", lambda x: F.elu(x, 1.5), (-3, -0.1), (0.1, 3))
    unary("gelu", F.gelu, (-3, 3))
    unary("gelu_tanh", lambda x: F.gelu(x, approximate="tanh"), (-3, 3))
    unary("silu", F.silu, *wide)
    unary("abs", torch.abs, (-3, -0.1), (0.1, 3))
    unary("sign", torch.sign, (-3, -0.1), (0.1, 3))
    unary("clamp", lambda x: x.clamp(-1, 2), (-3, -1.1), (-0.9, 1.9), (2.1, 4))
    unary("floor", torch.floor, (-1.9, -1.1), (0.1, 0.9))
    unary("ceil", torch.ceil, (-1.9, -1.1), (0.1, 0.9))
    unary("round", torch.round, (-1.4, -0.6), (0.6, 1.4))
    unary("reciprocal", torch.reciprocal, (-3, -0.5), (0.5, 3))
    for exponent in (0, 1, 2, 3, -1, -4):
        unary(f"powi.{exponent}", lambda x: x**exponent, (-2, -0.5), (0.5, 2))
    for exponent in (0.0, 0.5, 1.5, 2.5, -0.5):
        unary(f"powf.{exponent}", lambda x: x**exponent, (0.3, 3))
    positive, apart = ((0.3, 3),), (((-3, -0.1),), ((0.1, 3), (-6, -3.1)))
    binary("add", torch.add)
    binary("sub", torch.sub)
    binary("mul", torch.mul)
    binary("div", torch.div, b=((-3, -0.5), (0.5, 3)))
    binary("atan2", torch.atan2, b=((-3, -0.5), (0.5, 3)))
    binary("pow", torch.pow, a=positive)
    binary("xlogy", torch.xlogy, b=positive)
    binary("hypot", torch.hypot, b=((-3, -0.5), (0.5, 3)))
    binary("logaddexp", torch.logaddexp)
    binary("remainder", torch.remainder, a=((2.1, 2.4), (-2.4, -2.1)), b=((0.9, 1.0),))
    binary("maximum", torch.maximum, *apart)
    binary("minimum", torch.minimum, *apart)
    for name, f in dict(gt=torch.gt, ge=torch.ge, lt=torch.lt, le=torch.le, eq=torch.eq, ne=torch.ne).items():
        binary(f"compare.{name}", lambda a, b: f(a, b).to(a.dtype), *apart)
    mask = np.array([[1.0, 0.0, -2.0], [0.0, 3.0, 0.0]])
    case("where", lambda m, a, b: torch.where(m != 0, a, b), mask, (2, 3), (3,))
    case("where.scalar", lambda m, a, b: torch.where(m != 0, a, b), mask, (), (2, 1))
    case("if_positive", lambda x, a, b: torch.where(x > 0, a, b), spread((2, 3), (-2, -0.5), (0.5, 2)), (2, 3), (3,))
    case("lerp", torch.lerp, (2, 3), (2, 3), (2, 3))
    case("lerp.broadcast", torch.lerp, (3,), (2, 1), ())


def losses():
    near_and_far = dict(a=((0.05, 0.45), (1.25, 2), (-2, -1.25)), b=((-0.02, 0.02),), broadcast=False)
    none = dict(reduction="none")
    binary("squared_error", lambda a, b: F.mse_loss(a, b, **none), broadcast=False)
    binary("squared_error.mse_loss", F.mse_loss, broadcast=False)
    binary("absolute_error", lambda a, b: F.l1_loss(a, b, **none), **near_and_far)
    binary("absolute_error.l1_loss", F.l1_loss, **near_and_far)
    binary("huber", lambda a, b: F.huber_loss(a, b, delta=0.5, **none), **near_and_far)
    binary("huber.huber_loss", lambda a, b: F.huber_loss(a, b, delta=1.0), **near_and_far)
    binary("smooth_l1", lambda a, b: F.smooth_l1_loss(a, b, beta=0.5, **none), **near_and_far)
    binary("smooth_l1.smooth_l1_loss", lambda a, b: F.smooth_l1_loss(a, b, beta=0.25), **near_and_far)
    probabilities = dict(a=((-6, 6),), b=((0.05, 0.95),), broadcast=False)
    # The peer's own function does not give the gradient of the target where it is differentiated twice.
    entropy = lambda a, b: (1 - b) * a - F.logsigmoid(a)
    binary("binary_cross_entropy_with_logits", entropy, **probabilities)
    binary("binary_cross_entropy_with_logits.loss", lambda a, b: entropy(a, b).mean(), **probabilities)
    classes = torch.tensor([2, 0, 2])
    case("cross_entropy", lambda x: F.cross_entropy(x, classes, **none), spread((3, 4), (-3, 3)))
    case("cross_entropy.wide", lambda x: F.cross_entropy(x, 17 * classes, **none), spread((3, 40), (-3, 3)))
    case("cross_entropy.loss", lambda x: F.cross_entropy(x, classes), spread((3, 4), (-3, 3)))


def reductions():
    case("sum", lambda x: x.sum(), (2, 3))
    case("sum.over", lambda x: x.sum((0, 2)), (2, 3, 4))
    case("sum.mean", lambda x: x.mean(), (2, 3))
    case("sum.mean_over", lambda x: x.mean(1, keepdim=True), (2, 3, 2))
    case("sum.norm_l1", lambda x: x.abs().sum(0), spread((2, 3), (-3, -0.1), (0.1, 3)))
    case("broadcast_to", lambda x: x.expand(2, 3, 4), (3, 1))
    case("expand", lambda x: x.expand(2, 3), (2, 1))
    case("expand.scalar", lambda x: x.expand(2, 3), ())
    for correction in (0, 1):
        case(f"var.{correction}", lambda x: x.var(correction=correction), (2, 5))
        case(f"std.{correction}", lambda x: x.std(correction=correction), (2, 5))
    case("var.over", lambda x: x.var((0, 2), correction=1), (2, 3, 4))
    case("var.wide", lambda x: x.var(-1, correction=0), (2, 40))
    case("std.over", lambda x: x.std(1, correction=0), (2, 3, 4))
    case("norm", lambda x: x.norm(), (2, 3))
    case("norm.over", lambda x: x.norm(dim=1), (2, 3, 4))
    # Values far enough apart to have no ties.
    ranks = (np.arange(24) * 7 % 24 / 8 - 1).reshape(2, 3, 4)
    case("extremum.max", lambda x: x.max(), ranks)
    case("extremum.min", lambda x: x.min(), ranks)
    case("extremum.max_over", lambda x: x.amax((0, 2)), ranks)
    case("extremum.min_over", lambda x: x.amin(1), ranks)
    # A tie, which PyTorch's amax shares evenly too.
    case("extremum.tie", lambda x: x.amax(1), np.array([[2.0, 1.0, 2.0], [0.5, 0.5, 0.5]]))
    case("prod", lambda x: x.prod(), (6,))
    case("prod.over", lambda x: x.prod(1), (2, 3, 2))
    case("prod.zero", lambda x: x.prod(0), np.array([1.5, 0.0, -0.75, 2.0]))
    case("prod.zeros", lambda x: x.prod(0), np.array([1.5, 0.0, -0.75, 0.0]))
    case("logsumexp", lambda x: x.logsumexp((0, 1)), spread((2, 5), (-3, 3)))
    case("logsumexp.over", lambda x: x.logsumexp((0, 2)), spread((2, 3, 4), (-3, 3)))
    for name, f in dict(softmax=torch.softmax, log_softmax=torch.log_softmax).items():
        case(name, lambda x: f(x, -1), spread((2, 5), (-3, 3)))
        case(f"{name}.first", lambda x: f(x, 0), spread((3, 2), (-3, 3)))
        case(f"{name}.wide", lambda x: f(x, -1), spread((2, 40), (-3, 3)))
    case("cumsum", lambda x: x.cumsum(1), (2, 3, 2))
    case("cumsum.reverse", lambda x: x.flip(0).cumsum(0).flip(0), (5,))
    case("cumprod", lambda x: x.cumprod(0), (4, 2))
    case("cumprod.zeros", lambda x: x.cumprod(0), np.array([1.5, -0.5, 0.0, 2.0, 0.0, 0.75]))

    def recurrence(a, b):
        y = [b[0]]
        for a, b in zip(a[1:], b[1:]):
            y.append(a * y[-1] + b)
        return torch.stack(y)

    case("recurrence", recurrence, (4, 2), (4, 2))
    norm = lambda x, gain, bias: F.layer_norm(x, gain.shape, gain, bias, 1e-3)
    case("layer_norm", norm, (3, 5), (5,), (5,))
    case("layer_norm.wide", norm, (2, 2, 20), (20,), (20,))


def segments():
    """Rows 0..3, none, 3..4 and 4..7."""
    offsets = (0, 3, 3, 4, 7)
    rows = lambda x: [x[a:b] for a, b in zip(offsets, offsets[1:])]
    case("segment_sum", lambda x: torch.stack([part.sum(0) for part in rows(x)]), (7, 2))
    case("segment_expand", lambda x: x.repeat_interleave(torch.tensor([3, 0, 1, 3]), 0), (4, 2))
    case("segment_cumsum", lambda x: torch.cat([part.cumsum(0) for part in rows(x)]), (7, 2))
    case("segment_cumsum.exclusive", lambda x: torch.cat([part.cumsum(0) - part for part in rows(x)]), (7,))


def shapes():
    case("reshape", lambda x: x.reshape(3, 2), (2, 3))
    case("view.permute", lambda x: x.permute(2, 0, 1), (2, 3, 4))
    case("view.slice", lambda x: x[:, 1:3], (2, 4))
    case("view.diagonal", lambda x: x.diagonal(1), (3, 4))
    case("scatter_view", lambda x: torch.diag_embed(x, -1), (2, 2))
    case("slice_step", lambda x: x[1:6].flip(0)[::2], (7, 2))
    case("windows", lambda x: x.unfold(0, 3, 2), (7, 2))
    case("transpose", lambda x: x.transpose(0, 2), (2, 3, 4))
    case("squeeze", lambda x: x.squeeze(1).unsqueeze(0), (2, 1, 3))
    case("concat", lambda a, b: torch.cat((a, b), 1), (2, 3), (2, 1))
    case("stack", lambda a, b: torch.stack((a, b, a), 1), (2, 3), (2, 3))
    case("split", lambda x: x[:, :2] ** 2 * x[:, 2:], (2, 3))
    case("pad", lambda x: F.pad(x, (0, 1, 1, 2), value=0.5), (2, 3))
    case("tile", lambda x: x.tile(2, 1, 3), (2, 2))
    case("repeat", lambda x: x.repeat_interleave(3, 0), (2, 2))
    case("flip", lambda x: x.flip(0), (2, 3))
    case("roll", lambda x: x.roll(-2, 0), (5, 2))
    case("diag", lambda x: torch.diag(x, -1), (3,))
    case("diag.of_matrix", lambda x: torch.diag(x, -1), (3, 4))
    case("triangle.tril", lambda x: x.tril(-1), (3, 4))
    case("triangle.triu", lambda x: x.triu(1), (2, 3, 4))

    def meshgrid(a, b):
        a, b = torch.meshgrid(a, b, indexing="ij")
        return a * b**2

    case("meshgrid", meshgrid, (2,), (3,))


def indexing():
    along = torch.tensor([[[0, 2], [2, 1]], [[1, 1], [0, 2]]])
    twice = torch.tensor([2, 0, 2])
    case("gather", lambda x: x.gather(1, along), (2, 3, 2))
    case("scatter_add", lambda x, source: x.scatter_add(1, along, source), (2, 3, 2), (2, 2, 2))
    case("index_select", lambda x: x.index_select(1, twice), (2, 3, 2))
    case("index_add", lambda x, source: x.index_add(1, twice, source), (2, 4), (2, 3))
    case("gather_rows", lambda x: x[twice], (4, 3))
    case("scatter_rows", lambda x: torch.zeros(4, 2, dtype=x.dtype).index_add(0, twice, x), (3, 2))
    case("sort", lambda x: x.sort(0).values, (4, 3))
    case("sort_descending", lambda x: x.sort(1, descending=True).values, (2, 5))


def algebra():
    case("matmul", torch.matmul, (3, 4), (4, 2))
    case("matmul.vectors", torch.matmul, (3,), (3,))
    case("matmul.vector_matrix", torch.matmul, (3,), (3, 2))
    case("matmul.matrix_vector", torch.matmul, (2, 3), (3,))
    case("matmul.batch", torch.matmul, (2, 1, 2, 3), (3, 3, 1))
    case("matmul.batch_matrix", torch.matmul, (2, 2, 3), (3, 2))
    case("matmul.tn", lambda a, b: a.mT @ b, (4, 3), (4, 2))
    case("matmul.nt", lambda a, b: a @ b.mT, (2, 3, 4), (2, 4))
    case("matmul.tt", lambda a, b: a.mT @ b.mT, (2, 4, 3), (2, 2, 4))
    case("dot", torch.dot, (4,), (4,))
    case("outer", torch.outer, (3,), (2,))
    case("einsum", lambda a, b: torch.einsum("bij,bjk->bik", a, b), (2, 3, 2), (2, 2, 3))
    case("einsum.one", lambda x: torch.einsum("iij->j", x), (2, 2, 3))
    case("einsum_diagonal", lambda a, b: torch.einsum("iji,kj->k", a, b), (2, 3, 2), (2, 3))
    case("cross", lambda a, b: torch.linalg.cross(a, b), (2, 3), (2, 3))
    case("cross.broadcast", lambda a, b: torch.linalg.cross(a, b), (2, 1, 3), (1, 4, 3))
    case("normalize", lambda x: F.normalize(x, dim=-1), (3, 4))
    affine = lambda x, weight, bias: x @ weight + bias
    case("linear", affine, (5, 3), (3, 4), (4,))
    case("linear.no_bias", lambda x, weight: x @ weight, (2, 2, 3), (3, 4))
    case("linear.relu", lambda *x: affine(*x).relu(), (5, 3), (3, 4), (4,))


def images():
    uneven = dict(stride=(2, 1), padding=(1, 2), dilation=(1, 2))
    case("conv2d", F.conv2d, (2, 2, 3, 4), (3, 2, 2, 2))
    case("conv2d.bias", F.conv2d, (1, 2, 3, 3), (2, 2, 1, 1), (2,))
    case("conv2d.uneven", lambda *x: F.conv2d(*x, **uneven), (2, 1, 4, 3), (2, 1, 3, 2), (2,))
    case("conv2d_transpose", lambda x, w: F.conv_transpose2d(x, w, stride=2), (1, 2, 2, 2), (2, 1, 3, 3))
    case("conv2d_input", lambda g, w: F.conv_transpose2d(g, w), (2, 3, 2, 3), (3, 2, 2, 2))

    def image_gradient(g, w):
        x = torch.zeros(1, 1, 4, 3, dtype=g.dtype, requires_grad=True)
        return torch.autograd.grad(F.conv2d(x, w, **uneven), x, g, create_graph=True)[0]

    def weight_gradient(x, g):
        w = torch.zeros(2, 1, 3, 2, dtype=g.dtype, requires_grad=True)
        return torch.autograd.grad(F.conv2d(x, w, **uneven), w, g, create_graph=True)[0]

    case("conv2d_input.uneven", image_gradient, (1, 2, 2, 5), (2, 1, 3, 2))
    case("conv2d_weight", weight_gradient, (2, 1, 4, 3), (2, 2, 2, 5))
    windows = dict(kernel_size=(3, 2), stride=(2, 1), padding=(1, 0))
    ranks = (np.arange(40) * 11 % 40 / 16 - 1).reshape(2, 1, 5, 4)
    peak = lambda x: F.max_pool2d(x, **windows)
    mean = lambda x: F.avg_pool2d(x, **windows)
    case("max_pool2d", peak, ranks)
    case("max_pool2d.plain", lambda x: F.max_pool2d(x, 2), (1, 2, 4, 5))
    case("avg_pool2d", mean, (2, 1, 5, 4))

    def spread_back(pool):
        """The gradient of a pooling, as a function of image and cotangent."""
        return lambda x, g: torch.autograd.grad(pool(x), x, g, create_graph=True)[0]

    def picked(x, w):
        """The elements of w where the maxima of x stand: the gradient of that gradient."""
        g = torch.zeros(2, 1, 3, 3, dtype=x.dtype, requires_grad=True)
        return torch.autograd.grad(spread_back(peak)(x, g), g, w, create_graph=True)[0]

    case("scatter_planes", spread_back(peak), ranks, (2, 1, 3, 3))
    case("gather_planes", picked, ranks, (2, 1, 5, 4))
    case("avg_pool2d_input", spread_back(mean), (1, 2, 5, 4), (1, 2, 3, 3))


for part in (elementwise, losses, reductions, segments, shapes, indexing, algebra, images):
    part()
path = Path(__file__).with_name("peers.npz")
np.savez_compressed(path, **arrays)
print(sum(name.endswith("/y") for name in arrays), "cases,", path.stat().st_size, "bytes")
