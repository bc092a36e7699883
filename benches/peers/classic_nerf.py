"""One training step, or one forward rendering, of the classic NeRF (Mildenhall et al. 2020) in PyTorch or JAX.

Each ray takes 64 stratified samples through the coarse network, then the sorted union of those and 128 importance
samples through the fine one. The loss is the squared error of both colours. Rays and target colours are random, fixed.
"""

import argparse
from dataclasses import dataclass

import numpy as np

import measure


@dataclass(frozen=True)
class Config:
    coarse_samples: int = 64
    fine_samples: int = 128
    near: float = 2.0
    far: float = 6.0
    position_octaves: int = 10  # 3 + 3 * 2 * 10 = 63 inputs
    direction_octaves: int = 4  # 3 + 3 * 2 * 4 = 27 inputs
    depth: int = 8
    width: int = 256
    skip: int = 4  # the encoded position joins the input of the fifth layer
    view_width: int = 128
    learning_rate: float = 5e-4


def synthetic_rays(count):
    """Origins on a sphere of radius 4, unit directions that pass near its centre, random colours: (count, 3) each."""
    random = np.random.default_rng(0)
    origins = random.normal(size=(count, 3))
    origins *= 4.0 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = random.uniform(-1.0, 1.0, size=(count, 3)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    colours = random.uniform(size=(count, 3))
    return tuple(a.astype(np.float32) for a in (origins, directions, colours))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--framework", choices=("torch", "jax"), required=True)
    parser.add_argument("--rays", type=int, default=1024)
    parser.add_argument("--steps", type=int, default=5, help="timed steps")
    parser.add_argument("--warmup", type=int, default=2, help="steps before the timed ones")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--forward", action="store_true", help="render only, without gradients")
    args = parser.parse_args()

    if args.framework == "torch":  # each framework is imported only where it is measured
        import classic_torch as peer
    else:
        import classic_jax as peer

    build = peer.forward_step if args.forward else peer.training_step
    step = build(Config(), *synthetic_rays(args.rays), threads=args.threads)
    seconds, losses = measure.timed(step, args.steps, args.warmup)
    measure.report(
        args.framework,
        "classic NeRF, forward" if args.forward else "classic NeRF, training step",
        args.threads,
        peer.PACKAGES,
        rays_per_second=args.rays / seconds,
        seconds_per_step=seconds,
        loss_first=losses[0],
        loss_last=losses[-1],
    )


if __name__ == "__main__":
    main()
