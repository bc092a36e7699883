"""PSNR and SSIM of pairs of pictures as scikit-image has them.

    pip install numpy pillow scikit-image
    python metrics.py

Writes the pairs, `metrics/NAME-a.png` and `metrics/NAME-b.png`, and `metrics.json`: for each pair its PSNR in dB and its
SSIM. That is the one of Wang, Bovik, Sheikh and Simoncelli (2004): a Gaussian window of 11 pixels, the variances without the
correction for samples. scikit-image leaves a border of half a window out, as they do.
"""

import io
import json
from pathlib import Path

import numpy as np
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

HERE = Path(__file__).parent
rng = np.random.default_rng(7)
picture = Image.open(HERE / "golden-color.png").convert("RGB")
landscape = Image.open(HERE / "golden-landscape.png").convert("RGB")


def crop(image, left, top, width, height):
    return np.asarray(image.crop((left, top, left + width, top + height)))


def jpeg(a, quality):
    data = io.BytesIO()
    Image.fromarray(a).save(data, "JPEG", quality=quality)
    return np.asarray(Image.open(data))


def bytes_of(x):
    return np.clip(np.rint(x), 0, 255).astype(np.uint8)


full, other = np.asarray(picture), np.asarray(landscape)
height, width = full.shape[:2]
row = np.arange(width)[None, :, None]
pairs = {
    "noise": (full, bytes_of(full + rng.normal(0, 12, full.shape))),
    "shift": (crop(picture, 0, 0, width - 1, height), crop(picture, 1, 0, width - 1, height)),
    "dark": (full, bytes_of(full * 0.7)),
    "jpeg": (other, jpeg(other, 30)),
    "one-pixel": (full, np.where(np.arange(full.size).reshape(full.shape) == 1000, 255 - full, full).astype(np.uint8)),
    "channel": (full, full[:, :, ::-1].copy()),
    "ramp": (bytes_of(np.broadcast_to(row * 3.0, (11, width, 3))), bytes_of(np.broadcast_to(row * 3.2, (11, width, 3)))),
    "smallest": (crop(landscape, 9, 5, 11, 11), crop(landscape, 10, 6, 11, 11)),
    "flat": (np.full((17, 23, 3), 128, np.uint8), np.full((17, 23, 3), 129, np.uint8)),
    "unlike": (np.zeros((19, 13, 3), np.uint8), rng.integers(0, 256, (19, 13, 3)).astype(np.uint8)),
}
values = {}
for name, pair in pairs.items():
    for letter, image in zip("ab", pair):
        Image.fromarray(image).save(HERE / "metrics" / f"{name}-{letter}.png")
    a, b = (image / 255.0 for image in pair)
    psnr = peak_signal_noise_ratio(a, b, data_range=1.0)
    ssim = structural_similarity(
        a, b, channel_axis=-1, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )
    values[name] = {"psnr": float(psnr), "ssim": float(ssim)}
(HERE / "metrics.json").write_text(json.dumps(values, indent=1) + "\n")
