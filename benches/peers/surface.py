"""How far a mesh or a point cloud of the built-in scene is from the true surface, beside scikit-image's mesh of the same field.

    raygrad train --steps 2500 --out RUN
    raygrad export RUN mesh.ply
    cargo run --release --example surface_truth -- RUN TRUTH 256
    python surface.py TRUTH mesh.ply ... [--iso-value X]        # X as raygrad has printed it: scikit-image's mesh at that level
    python surface.py --views mesh.ply PICTURE.png          # three sides of it, as they are

TRUTH holds points of the true surface: seen.ply those that the photographs' directions show, all.ply those of all sides.
Prints one line of JSON for each file: `to_truth`, the mean distance of points on the mesh (even by area) from all.ply, and
`from_truth`, that of points of seen.ply from the mesh, in scene units; `chamfer`, their sum; `normal_degrees`, the mean angle
between the normal at a vertex and the true one at the nearest true point, of vertices less than .02 away from one; and
`facet_degrees`, the same of triangles. Distances are to dense points (about .002 apart). Without seen.ply (another scene)
only counts are printed. Needs numpy, scipy, scikit-image, trimesh and Pillow.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import cKDTree

POINTS = 1_000_000
NEAR = 0.02


def vertices(path):
    """Places and normals of a PLY file of vertices: (count, 3) each."""
    with open(path, "rb") as file:
        header = b""
        while not header.endswith(b"end_header\n"):
            header += file.readline()
        count = int(header.split(b"element vertex ")[1].split()[0])
        fields = [("place", "<f8", 3), ("normal", "<f4", 3), ("color", "u1", 3)]
        rows = np.fromfile(file, np.dtype(fields), count)
    return rows["place"], rows["normal"].astype(float)


def angle(a, b):
    """Mean angle between unit vectors, in degrees."""
    return float(np.degrees(np.arccos(np.clip((a * b).sum(1), -1, 1))).mean())


def measure(truth, places, normals, mesh):
    """Distances and angles of vertices (count, 3) with normals, or of a mesh."""
    if not (truth / "seen.ply").exists():
        return {}
    seen, _ = vertices(truth / "seen.ply")
    everything, true_normals = vertices(truth / "all.ply")
    tree = cKDTree(everything)
    samples, facets = (places, None) if mesh is None else trimesh.sample.sample_surface(mesh, POINTS, seed=0)
    distance, nearest = tree.query(samples, workers=-1)
    back, _ = cKDTree(samples).query(seen, workers=-1)
    found = {"to_truth": float(distance.mean()), "from_truth": float(back.mean())}
    found["chamfer"] = found["to_truth"] + found["from_truth"]
    found["median_to_truth"] = float(np.median(distance))
    if facets is not None:
        near = distance < NEAR
        found["facet_degrees"] = angle(mesh.face_normals[facets][near], true_normals[nearest][near])
    distance, nearest = tree.query(places, workers=-1)
    near = distance < NEAR
    found["normal_degrees"] = angle(normals[near], true_normals[nearest][near])
    return found


def marching_cubes(truth, level):
    """scikit-image's mesh of the field, and the seconds that it takes without those of asking the field."""
    from skimage.measure import marching_cubes

    field, about = np.load(truth / "density.npy"), json.loads((truth / "density.json").read_text())
    start = time.perf_counter()
    # Closed at the box, as raygrad's.
    places, faces, normals, _ = marching_cubes(np.pad(field, 1), level, spacing=[about["cell"]] * 3)
    seconds = time.perf_counter() - start
    places += np.array(about["low"]) - about["cell"]
    return places, faces[:, ::-1], normals, seconds


def rasterised(mesh, colors, axis, size):
    """The mesh as it is seen along an axis from afar: nearest vertices of many samples."""
    places, facets = trimesh.sample.sample_surface(mesh, 6 * size * size, seed=0)
    colors = colors[mesh.faces[facets]].mean(1)
    return splat(places, colors, axis, size)


def splat(places, colors, axis, size):
    """Points as they are seen from (-y, +x, above), nearest first."""
    right, up = {0: ([1, 0, 0], [0, 0.3, 0.95]), 1: ([0, 1, 0], [-0.3, 0, 0.95]), 2: ([0.6, 0.8, 0], [-0.55, 0.42, 0.72])}[axis]
    right, up = np.array(right, float), np.array(up, float)
    up /= np.linalg.norm(up)
    toward = np.cross(right, up)
    low, high = places.min(0), places.max(0)
    scale, middle = 0.8 * size / (high - low).max(), 0.5 * (low + high)
    x = (size / 2 + scale * (places - middle) @ right).astype(int)
    y = (size / 2 - scale * (places - middle) @ up).astype(int)
    inside = (x >= 0) & (x < size) & (y >= 0) & (y < size)
    order = np.argsort((places - middle) @ toward)
    order = order[inside[order]]
    picture = np.full((size, size, 3), 255, np.uint8)
    picture[y[order], x[order]] = colors[order]
    return picture


def views(file, out, size=700):
    """Three sides of a mesh or a point cloud, in its colours and as grey with light from the eye."""
    from PIL import Image

    shape = trimesh.load(file, process=False)
    shape = shape.to_geometry() if isinstance(shape, trimesh.Scene) else shape
    rows = []
    if isinstance(shape, trimesh.PointCloud):
        rows.append([splat(shape.vertices, shape.colors[:, :3], axis, size) for axis in range(3)])
    else:
        colors = shape.visual.vertex_colors[:, :3].astype(float)
        light = np.abs(shape.vertex_normals @ np.array([0.3, -0.5, 0.81]))[:, None] * 230.0
        rows.append([rasterised(shape, colors, axis, size) for axis in range(3)])
        rows.append([rasterised(shape, np.repeat(light, 3, 1), axis, size) for axis in range(3)])
    Image.fromarray(np.concatenate([np.concatenate(row, 1) for row in rows])).save(out)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("truth", nargs="?", type=Path)
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--iso-value", type=float)
    parser.add_argument("--views", nargs=2)
    args = parser.parse_args()
    if args.views:
        return views(*args.views)
    for file in args.files:
        shape = trimesh.load(file, process=False)
        places, normals = vertices(file)
        mesh = shape if isinstance(shape, trimesh.Trimesh) else None
        found = {"what": str(file), "vertices": len(places)}
        if mesh is not None:
            found |= {"triangles": len(mesh.faces), "closed": bool(mesh.is_watertight), "volume": float(mesh.volume)}
        print(json.dumps(found | measure(args.truth, places, normals, mesh)), flush=True)
    if args.iso_value:
        places, faces, normals, seconds = marching_cubes(args.truth, args.iso_value)
        mesh = trimesh.Trimesh(places, faces, process=False)
        if mesh.volume < 0:
            mesh.invert()
        parts = mesh.split(only_watertight=False)
        largest = max(part.area for part in parts)
        mesh = trimesh.util.concatenate([part for part in parts if part.area >= 0.01 * largest])
        found = {"what": "scikit-image", "vertices": len(mesh.vertices), "triangles": len(mesh.faces), "seconds": seconds}
        found |= {"closed": bool(mesh.is_watertight), "volume": float(mesh.volume)}
        print(json.dumps(found | measure(args.truth, mesh.vertices, mesh.vertex_normals, mesh)), flush=True)


if __name__ == "__main__":
    main()
