"""COLMAP's own files and the pixels at which COLMAP sees points, for the tests of `dataset/formats/colmap`.

    pip install pycolmap==4.2.1
    python colmap.py                  writes colmap/{binary,text} and colmap/expected.json
    python colmap.py --check FOLDER   reads the models FOLDER/*, which raygrad wrote from colmap/binary, and compares

Two cameras of different models, three images, five points. Where each point is seen, and where the cameras stand, comes
from COLMAP's own functions, not from a formula written here.
"""

import json
import sys
from pathlib import Path

import numpy as np
import pycolmap

HERE = Path(__file__).parent / "colmap"
CAMERAS = [
    ("OPENCV", 640, 480, [520.5, 515.25, 318.75, 243.5, -0.11, 0.03, 0.0015, -0.0025]),
    ("THIN_PRISM_FISHEYE", 400, 300, [210.0, 205.5, 203.0, 149.25, 0.02, -0.01, 0.001, -0.002, 0.003, -0.0005, 0.004, -0.003]),
]
# Camera, name, quaternion (x, y, z, w; COLMAP's files have w first) and translation from world to camera.
IMAGES = [
    (1, "left/b.png", [0.1, -0.2, 0.05, 0.9], [0.3, -0.4, 0.5]),
    (1, "left/a.png", [-0.05, 0.3, -0.1, -0.8], [-0.6, 0.2, 0.9]),
    (2, "right.png", [0.2, 0.1, 0.15, 0.85], [0.1, 0.25, 1.1]),
]
POINTS = [[0.1, 0.2, 3.0], [-0.8, 0.4, 4.0], [0.7, -0.6, 3.5], [0.3, 0.9, 5.0], [-0.4, -0.3, 2.5]]


def rigid(quaternion, translation):
    quaternion = np.array(quaternion) / np.linalg.norm(quaternion)
    return pycolmap.Rigid3d(pycolmap.Rotation3d(quaternion), np.array(translation))


def write():
    model = pycolmap.Reconstruction()
    for index, (name, width, height, params) in enumerate(CAMERAS):
        camera = pycolmap.Camera(camera_id=index + 1, model=name, width=width, height=height, params=params)
        model.add_camera_with_trivial_rig(camera)
    for index, (camera, name, quaternion, translation) in enumerate(IMAGES):
        pose = rigid(quaternion, translation)
        pixels = [model.cameras[camera].img_from_cam(pose * np.array(point)) for point in POINTS]
        points = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in pixels])
        image = pycolmap.Image(image_id=index + 1, name=name, camera_id=camera, points2D=points)
        model.add_image_with_trivial_frame(image, pose)
    for index, point in enumerate(POINTS):
        track = pycolmap.Track()
        # The last point is seen by two images, the others by three.
        for image in range(3 if index < 4 else 2):
            track.add_element(image + 1, index)
        model.add_point3D(np.array(point), track, np.array([10 * index, 255 - index, 128], dtype=np.uint8))
    model.update_point_3d_errors()
    for encoding in ["binary", "text"]:
        (HERE / encoding).mkdir(parents=True, exist_ok=True)
    model.write_binary(HERE / "binary")
    model.write_text(HERE / "text")
    (HERE / "expected.json").write_text(json.dumps(describe(model), indent=1) + "\n")


def describe(model):
    """What COLMAP says of a model, by the names of its images."""
    images = {}
    for image in model.images.values():
        camera, pose = model.cameras[image.camera_id], image.cam_from_world()
        images[image.name] = {
            "width": camera.width,
            "height": camera.height,
            "model": camera.model_name,
            "position": list(image.projection_center()),
            "direction": list(image.viewing_direction()),
            "pixels": [list(camera.img_from_cam(pose * np.array(point))) for point in POINTS],
        }
    points = [model.points3D[id] for id in sorted(model.points3D)]
    points = [
        {"position": list(p.xyz), "color": [int(c) for c in p.color], "error": p.error, "views": p.track.length()}
        for p in points
    ]
    return {"images": dict(sorted(images.items())), "points": points}


def same(a, b, where=""):
    if isinstance(a, dict):
        assert a.keys() == b.keys(), (where, a.keys(), b.keys())
        [same(a[key], b[key], f"{where}.{key}") for key in a]
    elif isinstance(a, list):
        assert len(a) == len(b), where
        [same(x, y, f"{where}[{i}]") for i, (x, y) in enumerate(zip(a, b))]
    elif isinstance(a, float):
        assert abs(a - b) <= 1e-9 * max(1, abs(a)), (where, a, b)
    else:
        assert a == b, (where, a, b)


def check(folder):
    expected = json.loads((HERE / "expected.json").read_text())
    for point in expected["points"]:
        point["views"] = 0  # raygrad writes no tracks
    for path in sorted(Path(folder).iterdir()):
        found = describe(pycolmap.Reconstruction(path / "sparse" / "0"))
        same(expected, found)
        print(f"{path}: {len(found['images'])} images and {len(found['points'])} points agree")


if __name__ == "__main__":
    check(sys.argv[2]) if sys.argv[1:2] == ["--check"] else write()
