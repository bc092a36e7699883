"""Writes formulas.txt, the reference values of tests/testsuite/optim_formulas.rs: published formulas with 150 digits.

    pip install mpmath                       # mpmath 1.3.0 wrote the committed file
    python make_formulas.py

A line has a name, the exact inputs, and the results rounded to f64:

    linear, exponential, cosine, step    four settings and the completed fraction, as in the tests; the learning rate
    adam                                 beta1, beta2, eps, ten gradients; the ten steps at rate 1 (Kingma and Ba 2015,
                                         algorithm 1)
"""

import random
from pathlib import Path

from mpmath import cos, floor, mp, mpf, pi, sqrt

mp.dps = 150
random.seed(5)
lines = []


def line(name, inputs, results):
    lines.append(" ".join([name, *map(repr, inputs), "=", *(repr(float(x)) for x in results)]))


def linear(start, end, t):
    return start + (end - start) * t


def exponential(start, end, t):
    return start * (end / start) ** t


def cosine(start, end, t):
    """Loshchilov and Hutter 2017, equation 5."""
    return end + (start - end) * (1 + cos(pi * t)) / 2


rates = [(1e-2, 1e-4), (1e-2, 1e-20), (1e-20, 1.0), (0.3, 0.3), (1e30, 1e-30), (1e-30, 1e30), (5e-4, 5e-6)]
fractions = [0.0, 5e-13, 1e-8, 0.01, 0.3, 0.5 - 2.0**-54, 0.5, 0.5 + 2.0**-53, 0.7, 0.99, 1 - 1e-8, 1 - 2.0**-53, 1.0]
fractions += [random.random() for _ in range(3)]
for formula in (linear, exponential, cosine):
    pairs = rates if formula is exponential else [*rates, (1e-2, 0.0), (0.0, 1.0)]
    for start, end in pairs:
        for warmup in (0.0, 0.25):
            for t in fractions:
                rise = min(mpf(1), mpf(t) / warmup) if warmup else 1
                value = rise * formula(mpf(start), mpf(end), mpf(t))
                line(formula.__name__, (start, end, warmup, 0.0, t), [value])
for factor, every in [(0.5, 0.125), (0.33, 2.0**-12), (0.999, 2.0**-20), (1.0, 1.0), (0.0, 0.5)]:
    for t in fractions:
        # A stair begins up to two roundings early, for fractions such as 0.3.
        stair = int(floor(mpf(t) / mpf(every) * (1 + mpf(2) ** -51)))
        line("step", (1e-2, factor, 0.0, every, t), [mpf(1e-2) * mpf(factor) ** stair])

for beta1, beta2, eps in [(0.9, 0.999, 1e-8), (0.9, 0.99, 1e-15), (0.5, 0.25, 0.125), (0.0, 0.0, 1e-30)]:
    for case in range(6):
        exponent = lambda: random.uniform(-18, 18) if case > 1 else 18 * (2 * case - 1) / 1.01
        grads = [random.choice([-1, 1]) * 10.0 ** exponent() * (random.random() < 0.8 or case < 2) for _ in range(10)]
        m, v, steps = mpf(0), mpf(0), []
        for t, g in enumerate(map(mpf, grads), 1):
            m, v = beta1 * m + (1 - mpf(beta1)) * g, beta2 * v + (1 - mpf(beta2)) * g**2
            steps.append(m / (1 - mpf(beta1) ** t) / (sqrt(v / (1 - mpf(beta2) ** t)) + eps))
        line("adam", (beta1, beta2, eps, *grads), steps)

path = Path(__file__).with_name("formulas.txt")
path.write_text("\n".join(lines) + "\n")
print(len(lines), "lines,", path.stat().st_size, "bytes")
