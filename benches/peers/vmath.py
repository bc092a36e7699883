"""raygrad's vector math against PyTorch's on one thread, in turns: a table of medians.

    cargo build --release -p raygrad-tensor --example vmath_speed
    python vmath.py ../../target/release/examples/vmath_speed

A round runs raygrad's program, which prints a JSON line a function, and then PyTorch on arguments of the same ranges, into
an array that is already there. Of a round each takes its fastest call; the table has the medians of the rounds.
"""

import argparse
import json
import statistics
import subprocess
import time

import torch
from torch.nn import functional as F

# Function: PyTorch's, and the range of its argument.
PEERS = {
    "exp": (torch.exp, -10, 10),
    "exp2": (torch.exp2, -10, 10),
    "expm1": (torch.expm1, -4, 4),
    "ln": (torch.log, 1e-3, 100),
    "ln1p": (torch.log1p, -0.9, 4),
    "log2": (torch.log2, 1e-3, 100),
    "sin": (torch.sin, -10, 10),
    "cos": (torch.cos, -10, 10),
    "tanh": (torch.tanh, -4, 4),
    "sigmoid": (torch.sigmoid, -10, 10),
    "softplus": (F.softplus, -10, 10),
    "erf": (torch.erf, -4, 4),
}
TYPES = {"f32": torch.float32, "f64": torch.float64}


def nanoseconds(f, x, out):
    repeats = 1 + 100_000 // len(x)
    best = float("inf")
    for _ in range(30):
        start = time.perf_counter_ns()
        for _ in range(repeats):
            f(x, out=out)
        best = min(best, (time.perf_counter_ns() - start) / (repeats * len(x)))
    return best


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("program", help="the example vmath_speed")
    parser.add_argument("--elements", type=int, default=1 << 14)
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()

    torch.set_num_threads(1)
    torch.manual_seed(0)
    figures = {}
    for _ in range(args.rounds):
        output = subprocess.run([args.program, str(args.elements), "--json"], check=True, capture_output=True, text=True)
        lines = [json.loads(line) for line in output.stdout.splitlines()]
        for line in lines:
            row = figures.setdefault((line["type"], line["function"]), ([], [], []))
            row[0].append(line["nanoseconds_per_element"])
            row[1].append(line["std"])
            if peer := PEERS.get(line["function"]):
                f, low, high = peer
                x = torch.rand(args.elements, dtype=TYPES[line["type"]]) * (high - low) + low
                with torch.inference_mode():
                    row[2].append(nanoseconds(f, x, torch.empty_like(x)))

    print(f"torch {torch.__version__}, {torch.backends.cpu.get_cpu_capability()}, {args.elements} elements")
    print("| type | function | ns an element | std, ns | PyTorch, ns | times std | times PyTorch |")
    print("|---|---|--:|--:|--:|--:|--:|")
    for (kind, name), row in figures.items():
        ours, std, peer = (statistics.median(column) if column else None for column in row)
        against = f"{peer:.3f} | {std / ours:.1f} | {peer / ours:.1f}" if peer else f"| {std / ours:.1f} |"
        print(f"| {kind} | {name} | {ours:.3f} | {std:.3f} | {against} |")


if __name__ == "__main__":
    main()
