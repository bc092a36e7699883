"""Writes arguments and values of elementary functions, for the test of the reference of testsuite/accuracy.

    pip install mpmath
    python exact.py                       # the committed exact.bin
    python exact.py 5000 dense.bin        # 10^5 values; EXACT=$PWD/dense.bin cargo test -p raygrad-autograd exact

Records of 32 bytes, little-endian: the argument x; the value as the sum of two f64 times a power of two, whose exponent
is an i64. Functions follow each other with COUNT records each. Arguments are drawn evenly over exponents, and half of
them over those of ordinary numbers.
"""

import math
import random
import struct
import sys
from pathlib import Path

from mpmath import mp, mpf

EVERY = (-1074, 1023)
# Function, exponents of its arguments, and whether they may be negative.
CASES = (
    (mp.exp, (-60, 11), True),
    (mp.expm1, (-1074, 11), True),
    (mp.log, EVERY, False),
    (mp.log1p, EVERY, False),
    (mp.sin, EVERY, True),
    (mp.cos, EVERY, True),
    (mp.sinpi, (-1074, 53), True),
    (mp.cospi, (-1074, 53), True),
    (mp.atan, EVERY, True),
    (mp.asin, (-1074, 0), True),
    (mp.acos, (-1074, 0), True),
    (mp.sinh, (-1074, 11), True),
    (mp.cosh, (-1074, 11), True),
    (mp.tanh, (-1074, 11), True),
    (lambda x: 1 / (1 + mp.exp(-x)), (-1074, 11), True),
    (lambda x: mp.log1p(mp.exp(x)), (-1074, 11), True),
    (mp.erf, (-1074, 6), True),
    (mp.erfc, (-1074, 6), True),
    (mp.ncdf, (-1074, 6), True),
    (mp.sqrt, EVERY, False),
    (lambda x: x ** mpf(1.7), EVERY, False),
)


def main():
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    path = Path(sys.argv[2]) if len(sys.argv) > 2 else Path(__file__).with_suffix(".bin")
    random.seed(0)
    mp.prec = 3000
    with path.open("wb") as out:
        for f, (low, high), signed in CASES:
            written = 0
            while written < count:
                # Half of them where functions bend.
                first, last = (max(low, -4), min(high, 6)) if random.random() < 0.5 else (low, high)
                x = math.ldexp(random.uniform(1, 2), random.randint(first, last - 1))
                x = -x if signed and random.random() < 0.5 else x
                y = f(mpf(x))
                if y == 0:
                    continue
                written += 1
                exponent = int(mp.floor(mp.log(abs(y), 2)))
                scaled = y * mpf(2) ** -exponent
                first = float(scaled)
                out.write(struct.pack("<dddq", x, first, float(scaled - mpf(first)), exponent))


if __name__ == "__main__":
    main()
