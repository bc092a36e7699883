"""Where OpenCV and COLMAP put directions through their lenses.

    pip install numpy opencv-python-headless pycolmap
    python lenses.py > lenses.json

A case has the library and model that it comes from; the lens as `Lens` of the crate names it; focal lengths and principal
point in pixels; and rows `x, y, z` (a direction: x right, y down, z into the scene), `column, row` (its pixel).
"""

import json
import sys

import cv2
import numpy as np
import pycolmap

WIDTH, HEIGHT = 1500, 2000
FOCAL, CENTRE = [1000.0, 1010.0], [740.0, 1020.0]


def directions(angle, count):
    """Directions up to this angle to the axis, in radians: the axis, and a spiral of even area."""
    turns = np.arange(count) * np.pi * (3 - np.sqrt(5))
    a = angle * np.sqrt(np.arange(count) / (count - 1))
    length = 1 + np.arange(count) % 3  # a direction's length does not matter
    d = np.stack([np.sin(a) * np.cos(turns), np.sin(a) * np.sin(turns), np.cos(a)], 1)
    return d * length[:, None]


def opencv(lens, points, focal, centre):
    camera = np.array([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1]])
    zero = np.zeros(3)
    if "brown" in lens:
        k, p = lens["brown"]["k"], lens["brown"]["p"]
        pixels, _ = cv2.projectPoints(points, zero, zero, camera, np.array(k[:2] + p + k[2:]))
    else:
        lens = lens["fisheye"]
        assert not any(lens["p"] + lens["s"])
        pixels, _ = cv2.fisheye.projectPoints(points[:, None], zero, zero, camera, np.array(lens["k"]))
    return pixels[:, 0]


def colmap(model, lens, points, focal, centre):
    if "brown" in lens:
        k, p = lens["brown"]["k"], lens["brown"]["p"]
        extra = {"SIMPLE_RADIAL": k[:1], "RADIAL": k[:2], "OPENCV": k[:2] + p, "FULL_OPENCV": k[:2] + p + k[2:]}[model]
        used = {"SIMPLE_RADIAL": k[1:] + p, "RADIAL": k[2:] + p, "OPENCV": k[2:], "FULL_OPENCV": []}[model]
    elif "fisheye" in lens:
        k, p, s = (lens["fisheye"][name] for name in ("k", "p", "s"))
        extra, used = {
            "SIMPLE_RADIAL_FISHEYE": (k[:1], k[1:] + p + s),
            "RADIAL_FISHEYE": (k[:2], k[2:] + p + s),
            "OPENCV_FISHEYE": (k, p + s),
            "THIN_PRISM_FISHEYE": (k[:2] + p + k[2:] + s, []),
        }[model]
    elif "fov" in lens:
        extra, used = [lens["fov"]["omega"]], []
    assert not any(used), "coefficients that the model does not have"
    one = model in ("SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
    assert not one or focal[0] == focal[1]
    params = (focal[:1] if one else focal) + centre + extra
    camera = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=params)
    return camera.img_from_cam(points)


def panorama(points):
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=WIDTH, height=HEIGHT, params=[WIDTH, HEIGHT])
    return camera.img_from_cam(points)


def brown(k, p=(0, 0)):
    return {"brown": {"k": list(map(float, k)) + [0.0] * (6 - len(k)), "p": list(map(float, p))}}


def fisheye(k, p=(0, 0), s=(0, 0)):
    k = list(map(float, k)) + [0.0] * (4 - len(k))
    return {"fisheye": {"k": k, "p": list(map(float, p)), "s": list(map(float, s))}}


FOX = ([1375.52, 1374.49], [554.558, 965.268])
SQUARE = ([1000.0, 1000.0], [740.0, 1020.0])
USUAL = (FOCAL, CENTRE)
CASES = [
    # library, model, lens, intrinsics, the largest angle in radians
    ("opencv", "projectPoints", brown([0.0578421, -0.0805099], [-0.000980296, 0.00015575]), FOX, 0.7),
    ("opencv", "projectPoints", brown([-0.3, 0.12, -0.02], [0.002, -0.003]), USUAL, 0.9),
    ("opencv", "projectPoints", brown([0.4, 0.3, 0.1, 0.2, 0.1, 0.05], [0.01, 0.02]), USUAL, 0.9),
    ("opencv", "projectPoints", brown([6.1, 1.9, 0.05, 6.5, 3.9, 0.4], [1e-4, -2e-4]), USUAL, 1.0),
    ("colmap", "SIMPLE_RADIAL", brown([-0.2]), SQUARE, 0.9),
    ("colmap", "RADIAL", brown([-0.25, 0.08]), SQUARE, 0.9),
    ("colmap", "OPENCV", brown([0.0578421, -0.0805099], [-0.000980296, 0.00015575]), FOX, 0.7),
    ("colmap", "FULL_OPENCV", brown([0.3, 0.2, 0.1, 0.1, -0.05, 0.02], [-0.01, 0.015]), USUAL, 0.9),
    ("opencv", "fisheye.projectPoints", fisheye([0.02, -0.01, 0.003, -0.0005]), USUAL, 1.5),
    ("opencv", "fisheye.projectPoints", fisheye([-0.08, 0.02, -0.01, 0.001]), USUAL, 1.2),
    ("colmap", "SIMPLE_RADIAL_FISHEYE", fisheye([-0.05]), SQUARE, 1.3),
    ("colmap", "RADIAL_FISHEYE", fisheye([-0.04, 0.006]), SQUARE, 1.4),
    ("colmap", "OPENCV_FISHEYE", fisheye([0.03, 0.01, -0.004, 0.0006]), USUAL, 1.5),
    ("colmap", "THIN_PRISM_FISHEYE", fisheye([0.02, -0.01, 0.003, 0.0004], [0.002, -0.003], [0.004, -0.001]), USUAL, 1.5),
    ("colmap", "THIN_PRISM_FISHEYE", fisheye([-0.05, 0.01, 0, 0], [-0.01, 0.008], [0.02, 0.015]), USUAL, 1.0),
    ("colmap", "FOV", {"fov": {"omega": 0.92}}, USUAL, 1.4),
    ("colmap", "FOV", {"fov": {"omega": 0.05}}, USUAL, 0.9),
    ("colmap", "FOV", {"fov": {"omega": 2.5}}, USUAL, 1.5),
]


def main():
    rows = lambda points, pixels: [[float(x) for x in row] for row in np.hstack([points, pixels])]
    cases = []
    for library, model, lens, (focal, centre), angle in CASES:
        points = directions(angle, 20)
        pixels = opencv(lens, points, focal, centre) if library == "opencv" else colmap(model, lens, points, focal, centre)
        assert np.isfinite(pixels).all(), model
        cases.append(dict(library=library, model=model, lens=lens, focal=focal, centre=centre, rows=rows(points, pixels)))
    points = directions(3.1, 30)
    cases.append(
        dict(
            library="colmap",
            model="EQUIRECTANGULAR",
            lens="equirectangular",
            focal=[WIDTH / (2 * np.pi), HEIGHT / np.pi],
            centre=[WIDTH / 2, HEIGHT / 2],
            rows=rows(points, panorama(points)),
        )
    )
    lines = ",\n".join(json.dumps(case) for case in cases)
    versions = f"opencv {cv2.__version__}, pycolmap {pycolmap.__version__}"
    sys.stdout.write(f'{{"made_with": "{versions}", "cases": [\n{lines}\n]}}\n')


main()
