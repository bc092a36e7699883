"""Writes lossy.webp, a small picture with losses, transparency and EXIF, for tests/testsuite/stability/fuzz.rs: python lossy.py (Pillow 13.0.0)"""

import pathlib

from PIL import Image

picture = Image.new("RGBA", (9, 5))
picture.putdata([(i * 5, 250 - i * 3, i * i % 200, 255 - 4 * i) for i in range(45)])
exif = Image.Exif()
exif[0x0112] = 6  # Turned by a quarter.
picture.save(pathlib.Path(__file__).with_name("lossy.webp"), quality=50, exif=exif)
