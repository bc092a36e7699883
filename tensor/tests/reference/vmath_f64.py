"""Writes arguments and exact values of the f64 functions of vmath, for tests/testsuite/ulp.rs.

    pip install mpmath
    python vmath_f64.py                      # the committed vmath_f64.bin
    python vmath_f64.py 50000 dense.bin # a denser sample: VMATH_F64=$PWD/dense.bin cargo test --test testsuite ulp

For each function COUNT records of 20 bytes, little-endian: the argument, the nearest f64 to the value, and what that one
lacks, in units of its last place, as f32. A third of the arguments are uniform where the function is used, a third
spread evenly over the exponents of its whole domain, and a third close to where its formula changes or cancels.
"""

import math
import random
import struct
import sys
from pathlib import Path

from mpmath import mp, mpf

BIG = 1.7976931348623157e308


def exponents(low, high, signs=(1,)):
    """A draw with an even spread over the exponents of base 2."""
    return lambda: random.choice(signs) * math.ldexp(random.uniform(1, 2), random.randint(low, high))


def about(points, ulps=1 << 20):
    """A draw from close to one of `points`, on either side, at distances of all magnitudes."""

    def draw():
        x = random.choice(points)
        return x + random.choice((-1, 1)) * math.ulp(x) * int(ulps ** random.random() - 1)

    return draw


def quarter_turns():
    """One of the two numbers around a multiple of pi/2, of any magnitude."""
    with mp.workprec(1300):
        x = float(mpf(random.getrandbits(random.randint(1, 1020))) * mp.pi / 2)
    return random.choice((-1, 1)) * math.nextafter(x, random.choice((0, math.inf)))


# The f64 number that is closest to a multiple of pi/2 (Muller et al., Handbook of Floating-Point Arithmetic), and the
# border of the short reduction.
ANGLES = (math.ldexp(6381956970095103.0, 797), 2.0**30, 2.0**30 * 0.999, math.pi / 4, 3 * math.pi / 4)
LN2 = math.log(2)
HALVES = tuple((k + 0.5) * LN2 for k in range(-1070, 1023))
BOTH = (-1, 1)

# Function, value, the three draws.
CASES = (
    ("exp", mp.exp, lambda: random.uniform(-10, 10), lambda: random.uniform(-745, 709.7), about(HALVES)),
    ("exp2", lambda x: mpf(2) ** x, lambda: random.uniform(-10, 10), lambda: random.uniform(-1074, 1023.9), about(tuple(k + 0.5 for k in range(-60, 60)))),
    ("expm1", mp.expm1, lambda: random.uniform(-2, 2), exponents(-1070, 8, BOTH), about((LN2 / 2, -LN2 / 2, 1.5 * LN2, -37.0))),
    ("ln", mp.log, lambda: random.uniform(0, 10), exponents(-1074, 1023), about((1.0, math.sqrt(0.5), math.sqrt(2), 2.0))),
    ("ln1p", mp.log1p, lambda: random.uniform(-0.99, 10), exponents(-1070, 1023), about((math.sqrt(0.5) - 1, math.sqrt(2) - 1, -0.5, 1.0))),
    ("log2", lambda x: mp.log(x, 2), lambda: random.uniform(0, 10), exponents(-1074, 1023), about((1.0, math.sqrt(0.5), math.sqrt(2), 2.0))),
    ("sin", mp.sin, lambda: random.uniform(-10, 10), exponents(-1000, 1023, BOTH), lambda: random.choice((quarter_turns, about(ANGLES)))()),
    ("cos", mp.cos, lambda: random.uniform(-10, 10), exponents(-30, 1023, BOTH), lambda: random.choice((quarter_turns, about(ANGLES)))()),
    ("sin_pi", mp.sinpi, lambda: random.uniform(-10, 10), exponents(-1000, 51, BOTH), about((0.25, 1.0, 1e6, 0.75))),
    ("cos_pi", mp.cospi, lambda: random.uniform(-10, 10), exponents(-30, 51, BOTH), about((0.25, 0.5, 1e6 + 0.5, 0.75))),
    ("tanh", mp.tanh, lambda: random.uniform(-3, 3), exponents(-1000, 4, BOTH), about((0.55, LN2 / 4, 19.0))),
    ("sigmoid", lambda x: 1 / (1 + mp.exp(-x)), lambda: random.uniform(-10, 10), lambda: random.uniform(-708, 40), about((-1.0986122886681098, 0.1, -LN2 / 2))),
    ("softplus", lambda x: mp.log1p(mp.exp(x)), lambda: random.uniform(-10, 10), lambda: random.uniform(-708, 40), about((-0.8813735870195429, 0.8813735870195429, 0.1))),
    ("erf", mp.erf, lambda: random.uniform(-3, 3), exponents(-1000, 2, BOTH), about((0.92, 5.0, 2.0))),
)


def main():
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 900
    path = Path(sys.argv[2]) if len(sys.argv) > 2 else Path(__file__).with_suffix(".bin")
    random.seed(0)
    with path.open("wb") as out:
        for name, f, *draws in CASES:
            done = 0
            while done < count:
                x = draws[done % 3]()
                mp.prec = 1300 if name in ("sin", "cos") and abs(x) > 2.0**30 else 220
                exact = f(mpf(x))
                if x == 0 or exact == 0 or abs(exact) > BIG or abs(exact) < 5e-324:
                    continue
                y = float(exact)
                out.write(struct.pack("<ddf", x, y, (exact - mpf(y)) / mpf(math.ulp(y))))
                done += 1


if __name__ == "__main__":
    main()
