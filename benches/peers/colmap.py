"""How far cameras that COLMAP has found are from the true ones, after the best similarity.

Render or take photographs whose cameras are known, recover the cameras from the photographs alone, and compare:

    raygrad prepare PICTURES --out FOUND                         # COLMAP on copies of the photographs, without their cameras
    raygrad prepare FOUND --to nerfstudio --out FOUND_JSON       # cameras as JSON, if FOUND holds COLMAP's own files
    python colmap.py TRUE FOUND_JSON

TRUE and FOUND_JSON are folders with a transforms.json whose images have the same file names: `raygrad prepare landscape
--to nerfstudio --out TRUE` makes one. With --pair A B, the cameras of both are written, for the photographs that have both
alone, to the folders A (true) and B (found): to train on each and to hold out the same photographs. Only numpy is needed.
Prints one line of JSON.
"""

import argparse
import json
import shutil
from pathlib import Path

import numpy as np


def name(frame):
    """The path of its image among the images."""
    return frame["file_path"].removeprefix("./").removeprefix("images/")


def read(folder):
    """The file, and its frames by the names of their images."""
    spec = json.loads((Path(folder) / "transforms.json").read_text())
    return spec, {name(frame): frame for frame in spec["frames"]}


def similarity(source, target):
    """Scale, rotation and translation that bring source nearest to target: (count, 3) each (Umeyama 1991)."""
    a, b = source - source.mean(0), target - target.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ sign @ vt
    scale = np.trace(np.diag(s) @ sign) / (a**2).sum()
    return scale, rotation, target.mean(0) - scale * rotation @ source.mean(0)


def robust_similarity(source, target, threshold, random, draws=1000):
    """The same from those alone that agree, so that a few wrong cameras do not shift all others."""
    best = np.zeros(len(source), bool)
    for _ in range(draws):
        some = random.choice(len(source), 3, replace=False)
        scale, rotation, shift = similarity(source[some], target[some])
        near = np.linalg.norm(scale * source @ rotation.T + shift - target, axis=1) < threshold
        best = near if near.sum() > best.sum() else best
    return similarity(source[best], target[best]) if best.sum() >= 3 else similarity(source, target)


def angle(a, b):
    """Degrees between rotations (count, 3, 3)."""
    cosine = (np.einsum("nij,nij->n", a, b) - 1.0) / 2.0
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def focal(spec, frame):
    return frame.get("fl_x", spec.get("fl_x")), frame.get("fl_y", spec.get("fl_y", spec.get("fl_x")))


def write(folder, out, spec, frames):
    """A dataset of some frames of another one."""
    out = Path(out)
    (out / "images").mkdir(parents=True)
    copies = []
    for frame in frames:
        image = out / "images" / name(frame)
        image.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(Path(folder) / frame["file_path"], image)
        copies.append({**frame, "file_path": f"images/{name(frame)}"})
    # Lists of files would name those that are left out; points are of all frames, and are not needed.
    kept = {key: value for key, value in spec.items() if key != "ply_file_path" and not key.endswith("_filenames")}
    (out / "transforms.json").write_text(json.dumps({**kept, "frames": copies}, indent=1))


def quartiles(values, digits=4):
    found = [np.median(values), np.mean(values), np.max(values)]
    return dict(zip(["median", "mean", "max"], np.round(found, digits).tolist()))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("true")
    parser.add_argument("found")
    size = "size of the scene [default: twice the mean distance of the cameras from their middle]"
    parser.add_argument("--size", type=float, help=size)
    wrong = "degrees from which a camera is counted as wrong [10]"
    parser.add_argument("--wrong", type=float, default=10.0, help=wrong)
    pair = "write both, with the photographs that have both cameras"
    parser.add_argument("--pair", nargs=2, metavar="DIR", help=pair)
    args = parser.parse_args()
    (true_spec, true), (found_spec, found) = read(args.true), read(args.found)
    names = sorted(true.keys() & found.keys())
    if len(names) < 3:
        raise SystemExit(f"{args.found}: {len(names)} cameras are of photographs of {args.true}: at least 3 are needed")
    matrices = [np.array(frames[key]["transform_matrix"], float) for frames in (true, found) for key in names]
    truth, given = np.array(matrices[: len(names)]), np.array(matrices[len(names):])
    places, guessed = truth[:, :3, 3], given[:, :3, 3]
    size = args.size or 2.0 * np.linalg.norm(places - places.mean(0), axis=1).mean()
    scale, rotation, shift = robust_similarity(guessed, places, 0.05 * size, np.random.default_rng(0))
    position = np.linalg.norm(scale * guessed @ rotation.T + shift - places, axis=1)
    degrees = angle(rotation @ given[:, :3, :3], truth[:, :3, :3])
    right = degrees < args.wrong
    ratio = [np.mean(focal(found_spec, found[key])) / np.mean(focal(true_spec, true[key])) for key in names]
    print(json.dumps({
        "photographs": len(true),
        "registered": len(names),
        "wrong": int((~right).sum()),
        "rotation_degrees": quartiles(degrees[right]) if right.any() else None,
        "position_percent": quartiles(100.0 * position[right] / size) if right.any() else None,
        "focal_percent": round(100.0 * (float(np.mean(ratio)) - 1.0), 3),
        "size": round(float(size), 4),
        "wrong_names": [key for key, good in zip(names, right) if not good],
    }))
    if args.pair:
        write(args.true, args.pair[0], true_spec, [true[key] for key in names])
        write(args.found, args.pair[1], found_spec, [found[key] for key in names])


if __name__ == "__main__":
    main()
