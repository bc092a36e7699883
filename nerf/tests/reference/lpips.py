"""LPIPS of pairs of pictures as the authors' package has it, with weights and pictures that are a formula.

    pip install lpips torch torchvision
    python lpips.py

Writes `lpips.json`: for each backbone and size of the pictures, for each of two pairs, what each layer adds to the
distance, in f64. The tests of src/pictures/lpips.rs make the same weights and pictures.
"""

import json
import sys
from pathlib import Path

HERE = Path(__file__).parent
# This file has the package's name.
sys.path = [path for path in sys.path if Path(path).resolve() != HERE.resolve()]

import lpips
import numpy as np
import torch


def noise(count, salt):
    """Numbers from -1 to 1 without a pattern."""
    i = np.arange(count, dtype=np.uint32) * np.uint32(2654435761) + np.uint32(salt) * np.uint32(40503)
    for _ in range(2):
        i = (i ^ (i >> np.uint32(16))) * np.uint32(0x45D9F3B)
    return (i ^ (i >> np.uint32(16))) / 2.0**31 - 1.0


def weights(net):
    """Uniform, so that neither vanishes nor explodes what passes the layers; biases are small, and the last ones positive."""
    made = {}
    own = [name for name in net.state_dict() if name.startswith(("net.slice", "lin")) and not name.startswith("lins")]
    for salt, name in enumerate(own):
        value = net.state_dict()[name]
        x = noise(value.numel(), salt)
        if name.startswith("lin"):
            x = 0.5 * (x + 1.0)
        elif name.endswith("bias"):
            x = 0.1 * x
        else:
            x = x * np.sqrt(6.0 / value[0].numel())
        made[name] = torch.from_numpy(x.astype(np.float32)).reshape(value.shape)
    return made


def pictures(width, height):
    """Two of one batch, and two that are like them."""
    count = 2 * 3 * height * width
    i = np.arange(count)
    stripes = (i % (7 * width) + 3 * (i % width)) % 64 / 63.0
    a = (0.75 * stripes + 0.125 * (noise(count, 100) + 1.0)).astype(np.float32)
    b = (0.875 * a.astype(np.float64) + 0.0625 * (noise(count, 101) + 1.0)).astype(np.float32)
    return [torch.from_numpy(x).reshape(2, 3, height, width).double() for x in (a, b)]


values = {}
for backbone, sizes in {"alex": [(40, 33), (75, 61)], "vgg": [(21, 17), (38, 33)]}.items():
    net = lpips.LPIPS(net=backbone, pretrained=False, pnet_rand=True, verbose=False)
    made = weights(net)
    net.load_state_dict(made, strict=False)
    net.double()
    for width, height in sizes:
        a, b = pictures(width, height)
        with torch.no_grad():
            total, layers = net(a, b, retPerLayer=True, normalize=True)
        layers = torch.cat(layers, 1)[:, :, 0, 0]
        assert torch.allclose(layers.sum(1), total[:, 0, 0, 0])
        values[f"{backbone} {width}x{height}"] = layers.tolist()
(HERE / "lpips.json").write_text(json.dumps(values, indent=1) + "\n")
