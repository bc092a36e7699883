"""One training step of a hash-grid field (Instant-NGP, Mueller et al. 2022) in PyTorch, eager or compiled.

Every ray has 32 samples, so the packed samples are composited per ray through a (rays, 32) view. There is no skipping
of empty space: what is measured is the cost of a sample. Rays and target colours are random and fixed.
"""

import argparse
import itertools

import torch
from torch import nn
from torch.nn import functional as F

import measure

SAMPLES_PER_RAY = 32
PRIMES = (1, 2654435761 - 2**32, 805459861)  # as int32: products wrap, and the low bits of the hash are the same


class HashGrid(nn.Module):
    """The multiresolution hash encoding, equation 4 of the paper; levels that fit their table need no hash."""

    def __init__(self, levels, features, log2_table, coarsest=16, finest=2048):
        super().__init__()
        growth = (finest / coarsest) ** (1 / max(levels - 1, 1))
        self.resolutions = [int(coarsest * growth**level + 1e-6) for level in range(levels)]
        self.capacity = 1 << log2_table
        # One parameter a level: a shared one would collect its dense gradient once for each level.
        sizes = (min((resolution + 1) ** 3, self.capacity) for resolution in self.resolutions)
        self.tables = nn.ParameterList(torch.empty(size, features).uniform_(-1e-4, 1e-4) for size in sizes)

    def forward(self, x):
        """(samples, 3) in the unit cube -> (samples, levels * features)."""
        axes = x.t().contiguous()
        return torch.cat([self.interpolate(axes, *level) for level in zip(self.resolutions, self.tables)], -1)

    def interpolate(self, axes, resolution, table):
        scaled = axes * resolution
        floor = scaled.floor()
        upper = scaled - floor
        lower = 1.0 - upper
        side = resolution + 1
        dense = side**3 <= self.capacity
        strides = (1, side, side * side) if dense else PRIMES
        near = [cell * stride for cell, stride in zip(floor.int(), strides)]
        far = [cell + stride for cell, stride in zip(near, strides)]
        rows, weights = [], []
        for corner in itertools.product((0, 1), repeat=3):
            i, j, k = ((near, far)[bit][axis] for axis, bit in enumerate(corner))
            rows.append(i + j + k if dense else (i ^ j ^ k) & (self.capacity - 1))
            u, v, w = ((lower, upper)[bit][axis] for axis, bit in enumerate(corner))
            weights.append(u * v * w)
        return (table[torch.stack(rows, -1)] * torch.stack(weights, -1).unsqueeze(-1)).sum(1)


def spherical_harmonics(direction):
    """The 16 real spherical harmonics of degree below 4 (the paper's degree 4): (..., 3) -> (..., 16)."""
    x, y, z = direction.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    harmonics = (
        torch.full_like(x, 0.28209479177387814),
        -0.48860251190291987 * y,
        0.48860251190291987 * z,
        -0.48860251190291987 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.94617469575756008 * zz - 0.31539156525252005,
        -1.0925484305920792 * x * z,
        0.54627421529603959 * (xx - yy),
        0.59004358992664352 * y * (yy - 3.0 * xx),
        2.8906114426405538 * x * y * z,
        0.45704579946446572 * y * (1.0 - 5.0 * zz),
        0.3731763325901154 * z * (5.0 * zz - 3.0),
        0.45704579946446572 * x * (1.0 - 5.0 * zz),
        1.4453057213202769 * z * (xx - yy),
        0.59004358992664352 * x * (3.0 * yy - xx),
    )
    return torch.stack(harmonics, -1)


def mlp(*widths):
    """Linear layers without bias, ReLU between them."""
    layers = [nn.Linear(i, o, bias=False) for i, o in zip(widths, widths[1:])]
    return nn.Sequential(layers[0], *itertools.chain(*((nn.ReLU(inplace=True), layer) for layer in layers[1:])))


class Field(nn.Module):
    def __init__(self, levels, features, log2_table):
        super().__init__()
        self.grid = HashGrid(levels, features, log2_table)
        self.density = mlp(levels * features, 64, 16)
        self.colour = mlp(16 + 16, 64, 64, 3)

    def forward(self, x, direction):
        """Positions (R * 32, 3) and directions of rays (R, 3) -> density (R * 32) and colour (R * 32, 3)."""
        h = self.density(self.grid(x))
        harmonics = spherical_harmonics(direction).repeat_interleave(SAMPLES_PER_RAY, 0)
        return h[:, 0].exp(), self.colour(torch.cat((h, harmonics), -1)).sigmoid()


def composite(density, colour, delta):
    """Packed density and colour, and the spacing (R, 1) of a ray's samples -> colour (R, 3) over white."""
    depth = density.view(-1, SAMPLES_PER_RAY) * delta
    weights = torch.exp(depth - depth.cumsum(-1)) * -torch.expm1(-depth)
    colour = colour.view(-1, SAMPLES_PER_RAY, 3)
    return (weights.unsqueeze(-1) * colour).sum(1) + (1.0 - weights.sum(-1, keepdim=True))


def synthetic_rays(rays):
    """Segments between random points of the unit cube: packed positions, unit directions, spacings, target colours."""
    start, end = torch.rand(2, rays, 3)
    t = (torch.arange(SAMPLES_PER_RAY) + torch.rand(rays, SAMPLES_PER_RAY)) / SAMPLES_PER_RAY
    positions = torch.lerp(start.unsqueeze(1), end.unsqueeze(1), t.unsqueeze(-1)).reshape(-1, 3)
    length = (end - start).norm(dim=-1, keepdim=True)
    return positions, (end - start) / length, length / SAMPLES_PER_RAY, torch.rand(rays, 3)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=262144, help=f"a multiple of {SAMPLES_PER_RAY}")
    parser.add_argument("--levels", type=int, default=16)
    parser.add_argument("--features", type=int, default=2)
    parser.add_argument("--log2-table", type=int, default=19)
    parser.add_argument("--steps", type=int, default=10, help="timed steps")
    parser.add_argument("--warmup", type=int, default=3, help="steps before the timed ones")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--compile", action="store_true", help="compile forward and backward with torch.compile")
    args = parser.parse_args()
    if args.samples % SAMPLES_PER_RAY:
        parser.error(f"--samples must be a multiple of {SAMPLES_PER_RAY}")

    torch.set_num_threads(args.threads)
    torch.manual_seed(0)
    field = Field(args.levels, args.features, args.log2_table)
    adam = torch.optim.Adam(field.parameters(), lr=1e-2, betas=(0.9, 0.99), eps=1e-15, fused=True)
    positions, directions, delta, target = synthetic_rays(args.samples // SAMPLES_PER_RAY)

    def loss_of():
        return F.mse_loss(composite(*field(positions, directions), delta), target)

    if args.compile:
        loss_of = torch.compile(loss_of)

    def step():
        adam.zero_grad()
        loss = loss_of()
        loss.backward()
        adam.step()
        return loss.item()

    seconds, losses = measure.timed(step, args.steps, args.warmup)
    measure.report(
        "torch.compile" if args.compile else "torch",
        f"hash-grid NGP, training step, {args.levels} levels x {args.features}, 2^{args.log2_table}",
        args.threads,
        samples_per_second=args.samples / seconds,
        seconds_per_step=seconds,
        loss_first=losses[0],
        loss_last=losses[-1],
    )


if __name__ == "__main__":
    main()
