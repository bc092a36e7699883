"""Recomputes, with 50 digits, the constants that the stress suite expects, and compares them with those written down.

    pip install mpmath && python constants.py          # prints a table, and writes constants.json beside this file

Inputs that a formula gets as f32 are rounded to f32 first where the name ends in `_f32`. Integrals are computed twice:
by the closed form, and by numerical quadrature of the rendering integral, which must agree to 30 digits.
"""

import json
import struct
from pathlib import Path

from mpmath import acos, cos, e, erf, exp, expm1, findroot, inf, log, log1p, mp, mpf, pi, quad, sin, sqrt

mp.dps = 50
rows = {}


def f32(x):
    return mpf(struct.unpack("f", struct.pack("f", float(x)))[0])


def row(name, value, written=None):
    """A constant, and what is written for it (as text, whose digits say how precisely)."""
    rows[name] = (value, written)


# Compositing: section 1 and the first rows of section 5.
for x in ["1e-45", "1e-8", "1e-7", "1e-4", "16", "18", "104"]:
    row(f"alpha({x})", -expm1(-mpf(x)), {"1e-7": "9.9999995e-8"}.get(x))
row("transmittance(18)", exp(mpf(-18)), "1.52e-8")
row("transmittance(40)", exp(mpf(-40)))
row("alpha of 1024 steps of depth 1e-3 in all", -expm1(mpf("-1e-3")))
depths = [mpf(x) for x in (".1", "20", ".5", ".5", "30", ".2")]
for i, written in zip(range(2, 6), ["1.865e-9", "1.131e-9", "6.861e-10", "6.42e-23"]):
    row(f"T[{i}]", exp(-sum(depths[:i])), written)
alpha, colour = [mpf(".3"), mpf(1), mpf(".5")], [mpf(".2"), mpf(".9"), mpf(".4")]


def composited(alpha, colour):
    total, left = mpf(0), mpf(1)
    for a, c in zip(alpha, colour):
        total, left = total + left * a * c, left * (1 - a)
    return total


for k, written in enumerate(["-.7", ".49", "0"]):
    # The colour is linear in each alpha, so a difference is the derivative.
    up, down = [a + (i == k) for i, a in enumerate(alpha)], [a - (i == k) for i, a in enumerate(alpha)]
    row(f"d colour / d alpha[{k}]", (composited(up, colour) - composited(down, colour)) / 2, written)
u = mpf("1e-6") * exp(mpf(16))
row("exponential density at 16: gradient of alpha", u * exp(-u))
row("exponential density at 16: clamped at 15, as usual", mpf("1e-6") * exp(mpf(15)) * exp(-u))
row("exponential density at -20: gradient of alpha, interval 1e-6", mpf("1e-6") * exp(mpf(-20)))
row("exponential density at -20: clamped at -15 against the right one", exp(mpf(5)), "150")
for x, written in [("-20", "2.0611536e-9"), ("89", "89"), ("17", None), ("-17", None), ("-89", None), ("-104", None)]:
    row(f"softplus({x})", log1p(exp(mpf(x))), written)
for x in ["17", "-17", "20", "-20", "89", "-89", "-104"]:
    row(f"sigmoid({x})", 1 / (1 + exp(-mpf(x))))
row("sigmoid'(17)", exp(mpf(-17)) / (1 + exp(mpf(-17))) ** 2, "4.14e-8")

# Sampling and geometry.
for w, written in [("1", ".06"), ("1e-3", "38"), ("1e-4", "86")]:
    share = 62 * mpf("1e-5") / (mpf(w) + 62 * mpf("1e-5"))
    row(f"uniform share of weights + 1e-5 in per cent, 62 bins, weight {w}", 100 * share, written)


def root(k1, distorted):
    """The undistorted radius: the least positive root of r (1 + k1 r^2) = distorted."""
    return findroot(lambda r: r * (1 + k1 * r * r) - distorted, distorted)


critical = 1 / sqrt(3 * mpf(".5"))
row("largest distorted radius for k1 = -.5", critical * (1 - mpf(".5") * critical**2), ".5443")
row("undistorted .54 for k1 = -.5", root(mpf("-.5"), mpf(".54")), ".7562852")
row("undistorted 3 for k1 = .5", root(mpf(".5"), mpf(3)), "1.4561642")
theta = mpf("1e-4")
row("(1 - cos t) / t^2 at 1e-4", (1 - cos(theta)) / theta**2, ".5")
# The place (.6, -.2, -7) in normalised device coordinates (Mildenhall et al. 2020, equation 20) of a camera whose focal length
# is half of its width and height, near plane 1 and infinite far plane, from -1..1 to 0..1.
x, y, z = mpf(".6"), mpf("-.2"), mpf(-7)
for name, value in [("x", -x / z), ("y", -y / z), ("z", 1 + 2 / z)]:
    row(f"normalised device coordinates, {name}", (value + 1) / 2)
row("contraction of norm 1e4", 2 - mpf("1e-4"))

# Reductions, optimizer, metrics.
f = lambda beta: 1 - f32(beta)
row("1 - .999 in f32, relative error", abs(f(".999") / (1 - mpf(".999")) - 1), "1.3e-5")
for epsilon, written in [("1e-8", ".0099"), ("1e-15", "1.0")]:
    g = mpf("1e-10")
    row(f"Adam's first step / lr for a gradient of 1e-10 and epsilon {epsilon}", g / (g + mpf(epsilon)), written)
smallest = mpf(2) ** -126
row("steps after which .9^k is denormal in f32", mp.ceil(log(smallest) / log(mpf(".9"))), "828")
row("bound of Adam's step / lr for the default betas", (1 - mpf(".9")) / sqrt(1 - mpf(".999")))
row("bound of Adam's step / lr for the table's betas", (1 - mpf(".9")) / sqrt(1 - mpf(".99")))
for name, beta2 in [("default", mpf(".999")), ("table's", mpf(".99"))]:
    most = (1 - mpf(".9")) / sqrt((1 - beta2) * (1 - mpf(".81") / beta2))
    row(f"bound of Adam's step / lr for the {name} betas, by Cauchy and Schwarz", most, {"default": "3.16", "table's": "1"}[name])
# One late gradient after many steps without: m decays from .1 g, v from .001 g^2, both corrections are 1.
late = sum(mpf(".1") * mpf(".9") ** k / sqrt(mpf(".001") * mpf(".999") ** k) for k in range(5000))
row("way / lr after one late gradient, dense Adam in all", late)
late = sum(mpf(".1") * mpf(".9") ** k / sqrt(mpf(".001") * mpf(".999") ** k) for k in range(4))
row("way / lr after one late gradient, dense Adam after 4 steps", late, "10.5")
late = sum(mpf(".1") * mpf(".9") ** k / sqrt(mpf(".01") * mpf(".99") ** k) for k in range(5000))
row("way / lr after one late gradient, dense Adam with beta2 = .99 in all", late, "10.5")
knee = mpf("0.0031308")
row("sRGB(.5)", mpf("1.055") * mpf(".5") ** (1 / mpf("2.4")) - mpf("0.055"), ".735")
row("sRGB jump at the knee", mpf("1.055") * knee ** (1 / mpf("2.4")) - mpf("0.055") - mpf("12.92") * knee)
row("sRGB slope just above the knee", mpf("1.055") / mpf("2.4") * knee ** (1 / mpf("2.4") - 1))
row("sRGB(2)", mpf("1.055") * 2 ** (1 / mpf("2.4")) - mpf("0.055"))
row("mean PSNR of 20 and 40 dB", mpf(30), "30")
row("PSNR of the mean error of 20 and 40 dB", -10 * mp.log10((mpf(10) ** -2 + mpf(10) ** -4) / 2), "22.97")
row("PSNR of rounding to 8 bits", -10 * mp.log10(mpf(1) / 12 / 255**2), "58.9")
row("fog of .0099 a step over 588 steps: alpha", -expm1(mpf("-.0099") * 588), ".997")

# Volume rendering: section 2.


def rendered(sigma, colour, end, background, density=None):
    """The rendering integral by quadrature; `density` gives the optical depth up to t in closed form."""
    depth = density or (lambda t: quad(sigma, [0, t]))
    inner = quad(lambda t: sigma(t) * colour(t) * exp(-depth(t)), mp.linspace(0, end, 33))
    return inner + background * exp(-depth(end))


def agree(name, closed, numeric, written=None):
    assert abs(closed - numeric) <= mpf(10) ** -25 * max(1, abs(closed)), (name, closed, numeric)
    row(name, closed, written)


s, D, c, bg = mpf("1.3"), mpf(4), mpf(".8"), mpf(1)
E = exp(-s * D)
agree("constant: C", c * (1 - E) + bg * E, rendered(lambda t: s, lambda t: c, D, bg, lambda t: s * t), "0.8011033128841521")
row("constant: dC/dsigma", D * E * (c - bg), "-4.413251536608618e-3")
Z = (1 - E * (1 + s * D)) / s
agree("depth: Z", Z, rendered(lambda t: s, lambda t: t, D, 0, lambda t: s * t), "0.7429210004548332")
row("depth: dZ/dsigma", -(1 - E * (1 + s * D + s**2 * D**2)) / s**2, "-0.4832126619253917")
linear = mpf(".2") * (1 - E) + mpf(".15") * Z + bg * E
agree("linear colour: C", linear, rendered(lambda t: s, lambda t: mpf(".2") + mpf(".15") * t, D, bg, lambda t: s * t), "0.3158514016048336")
A, B, k = mpf(".2"), mpf(".5"), mpf(".8")


def exponential(s0):
    tau = s0 * (1 - exp(-k * D)) / k
    return (A + B) * (1 - exp(-tau)) - B * (k / s0) * (1 - exp(-tau) * (1 + tau)) + bg * exp(-tau)


s0 = mpf(3)
numeric = rendered(lambda t: s0 * exp(-k * t), lambda t: A + B * exp(-k * t), D, bg, lambda t: s0 * (1 - exp(-k * t)) / k)
agree("exponential: C", exponential(s0), numeric, "0.5916833221806711")
row("exponential: dC/dsigma0", mp.diff(exponential, s0), "0.01323042889929611")
w, mu, top = mpf(".4"), mpf("2.1"), mpf(4)
bell = lambda t: top * exp(-((t - mu) ** 2) / (2 * w**2))
depth = lambda t: top * w * sqrt(pi / 2) * (erf((t - mu) / (sqrt(mpf(2)) * w)) + erf(mu / (sqrt(mpf(2)) * w)))
tau = depth(D)
row("Gauss: tau", tau, "4.010600855285274")
gauss = mpf(".1") * (1 - exp(-tau)) + mpf(".7") / tau * (1 - exp(-tau) * (1 + tau)) + bg * exp(-tau)
numeric = rendered(bell, lambda t: mpf(".1") + mpf(".7") * depth(t) / tau, D, bg, depth)
agree("Gauss: C", gauss, numeric, "0.2749988838150415")


def slabs(s1):
    E1, E2 = exp(-s1 * mpf(".6")), exp(mpf("-6") * mpf(".7"))
    return mpf(".9") * (1 - E1) + E1 * (mpf(".2") * (1 - E2) + bg * E2)


row("slabs: C", slabs(mpf("1.1")), "0.5444044529687199")
row("slabs: dC/dsigma1", mp.diff(slabs, mpf("1.1")), "0.2133573282187681")
R, s, p = mpf(".5"), mpf(3), mpf(".3")
disc = lambda p: 1 - exp(-2 * s * sqrt(R**2 - p**2))
row("sphere: alpha(.3)", disc(p), "0.9092820467105875")
closed = pi * R**2 - pi * (1 - exp(-2 * s * R) * (1 + 2 * s * R)) / (2 * s**2)
# With p = sqrt(R^2 - h^2) the integrand is smooth.
agree("sphere: image integral of alpha", closed, quad(lambda h: 2 * pi * h * (1 - exp(-2 * s * h)), [0, R]), "0.6456231689154052")

# Skipping: section 3.
for skipped, written in [("60", ".475"), ("70", ".153"), ("80", ".049")]:
    loss = 20 * mp.log10(1 + mpf(10) ** ((35 - mpf(skipped)) / 20))
    row(f"most that skipping at {skipped} dB costs a picture of 35 dB", loss, written)
row("least that skipping at 60 dB costs, uncorrelated", 10 * mp.log10(1 + mpf(10) ** (mpf(35 - 60) / 10)), ".014")


def verdict(value, written):
    """Whether `written` is `value` rounded to as many digits as it has, or one unit beside it."""
    if written is None:
        return ""
    digits = written.lower().split("e")[0].lstrip("-+")
    places = len(digits.split(".")[1]) if "." in digits else 0
    exponent = int(written.lower().split("e")[1]) if "e" in written.lower() else 0
    unit = mpf(10) ** (exponent - places)
    error = abs(value - mpf(written)) / unit
    return "" if error <= mpf(".5000001") else f"{mp.nstr(error, 3)} units of the last digit off"


def main():
    out = {}
    for name, (value, written) in rows.items():
        out[name] = float(value)
        print(f"{name:70} {mp.nstr(value, 17):>25}  {written or '':>22}  {verdict(value, written)}")
    path = Path(__file__).with_name("constants.json")
    path.write_text(json.dumps(out, indent=2) + "\n")


if __name__ == "__main__":
    main()
