"""Exact values of the analytic scenes: integrals taken numerically in 25 digits, none of the closed forms used.

    pip install mpmath
    python analytic.py > analytic.tsv

A line is a scene, the order of `analytic::scenes()`: its name, then colour, depth and transmittance, then for each
amplitude of the density the derivatives of the three.
"""

from mpmath import diff, erf, exp, mp, mpf, quad, sqrt, pi

mp.dps = 25
LENGTH, BACKGROUND = mpf(4), mpf(1)


def rendered(density, depth, color, breaks):
    """Colour, depth and transmittance; `depth(t)` is the optical depth up to t, the integral of `density`."""
    breaks = sorted({mpf(0), LENGTH, *map(mpf, breaks)})
    weight = lambda t: density(t) * exp(-depth(t))
    left = exp(-depth(LENGTH))
    return [
        quad(lambda t: weight(t) * color(t), breaks) + BACKGROUND * left,
        quad(lambda t: weight(t) * t, breaks),
        left,
    ]


def layers(*all):
    """Layers `(from, to, colour at 0, slope of the colour)` and their densities."""

    def at(*sigmas):
        def density(t):
            return sum(s for (a, b, *_), s in zip(all, sigmas) if a < t < b)

        def depth(t):
            return sum(s * max(mpf(0), min(t, b) - a) for (a, b, *_), s in zip(all, sigmas))

        def color(t):
            _, _, c0, c1 = next(layer for layer in all if layer[0] < t < layer[1])
            return c0 + c1 * t

        # Where there is no density the colour does not matter.
        visible = lambda t: color(t) if density(t) > 0 else mpf(0)
        return rendered(density, depth, visible, [edge for layer in all for edge in layer[:2]])

    return at


def exponential(sigma0):
    k = mpf(".8")
    return rendered(
        lambda t: sigma0 * exp(-k * t),
        lambda t: sigma0 * (1 - exp(-k * t)) / k,
        lambda t: mpf(".2") + mpf(".5") * exp(-k * t),
        range(5),
    )


def gaussian(width):
    mean = mpf("2.1")
    unit = lambda t: width * sqrt(pi / 2) * (erf((t - mean) / (sqrt(2) * width)) + erf(mean / (sqrt(2) * width)))

    def at(amplitude):
        return rendered(
            lambda t: amplitude * exp(-((t - mean) ** 2) / (2 * width**2)),
            lambda t: amplitude * unit(t),
            lambda t: mpf(".1") + mpf(".7") * unit(t) / unit(LENGTH),
            [t for i in range(-8, 9, 2) if 0 < (t := mean + i * width) < LENGTH],
        )

    return at


M = mpf
half_chord = sqrt(M(".25") - M(".09"))
SCENES = [
    ("constant", layers((M(0), M(4), M(".8"), M(0))), [M("1.3")]),
    ("linear colour", layers((M(0), M(4), M(".2"), M(".15"))), [M("1.3")]),
    ("exponential", exponential, [M(3)]),
    ("gaussian", gaussian(M(".4")), [M(4)]),
    ("narrow gaussian", gaussian(M(".03")), [M(100)]),
    ("slabs", layers((M(".7"), M("1.3"), M(".9"), M(0)), (M("2.2"), M("2.9"), M(".2"), M(0))), [M("1.1"), M(6)]),
    ("sphere", layers((2 - half_chord, 2 + half_chord, M(".6"), M(0))), [M(3)]),
]

for name, at, amplitudes in SCENES:
    values = at(*amplitudes)
    for k in range(len(amplitudes)):
        for which in range(3):
            order = tuple(int(i == k) for i in range(len(amplitudes)))
            values.append(diff(lambda *a: at(*a)[which], tuple(amplitudes), order))
    print(name, *(mp.nstr(value, 20) for value in values), sep="\t")
