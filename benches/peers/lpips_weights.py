"""Writes the weights of LPIPS, as its authors' package has them, to a safetensors file for `raygrad eval --lpips`.

    pip install lpips torch torchvision safetensors
    python lpips_weights.py vgg        # or: python lpips_weights.py alex

The package brings what its authors have fitted; the network beneath comes from torchvision, which downloads it the first
time (VGG-16 528 MB, AlexNet 233 MB; of these, 59 and 10 MB are used). It prints the file's CRC-32, which stands in results.
"""

import argparse
import zlib
from pathlib import Path

import lpips
from safetensors.torch import save_file

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("net", choices=["vgg", "alex"], help="the network: figures of one are no measure of those of the other")
parser.add_argument("--out", type=Path, help="the file (default: lpips-NET.safetensors)")
args = parser.parse_args()
out = args.out or Path(f"lpips-{args.net}.safetensors")

state = lpips.LPIPS(net=args.net, version="0.1", verbose=False).state_dict()
# Each last layer stands there twice, and what inputs are scaled by is no weight.
own = {name: x.contiguous() for name, x in state.items() if name.startswith(("net.", "lin")) and name[:4] != "lins"}
save_file(own, out, metadata={"lpips": f"0.1 {args.net}"})
print(f"{out}: {len(own)} tensors, CRC-32 {zlib.crc32(out.read_bytes()):08x}")
