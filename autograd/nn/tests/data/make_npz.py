"""Writes the .npz files of the tests: run it here with NumPy installed."""

import numpy as np

arrays = {
    "matrix": np.arange(6, dtype="<f4").reshape(2, 3) / 2,
    "columns": np.asfortranarray(np.arange(24, dtype="<f4").reshape(2, 3, 4)),
    "scalar": np.float32(-3.25),
    "empty": np.zeros((0, 2), "<f4"),
}
np.savez("stored.npz", **arrays)
np.savez_compressed("compressed.npz", **arrays)
np.savez("doubles.npz", x=np.array([0.1, -1e300]))
