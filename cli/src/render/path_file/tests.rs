use super::*;
use serde_json::json;

/// Reads a document with a transform file and an applied transform.
fn of(document: &Value, transform: Option<&Value>, applied: DAffine3) -> Result<Path> {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("path.json");
    std::fs::write(&file, document.to_string()).unwrap();
    let other = folder.path().join("transform.json");
    let transform = transform.map(|transform| {
        std::fs::write(&other, transform.to_string()).unwrap();
        other.as_path()
    });
    read(&file, transform, || Ok(applied))
}

/// A pose without symmetry, row by row: a rotation by 1.1 about (3, -1, 0.5).
const POSE: [f64; 16] = [
    0.9333653806616558,
    -0.299106292455634,
    -0.1984048688812026,
    2.0,
    -0.020739880368418312,
    0.5069038168962527,
    -0.8617530839969847,
    -1.0,
    0.35832795529322875,
    0.8084453885263092,
    0.46692304529324613,
    0.7,
    0.0,
    0.0,
    0.0,
    1.0,
];

fn nerfstudio_path() -> Value {
    json!({
        "default_fov": 50.0, "default_transition_sec": 2.0, "keyframes": [], "camera_type": "perspective",
        "render_height": 300, "render_width": 400, "fps": 24, "seconds": 4.0, "is_cycle": false, "smoothness_value": 0.3,
        "camera_path": [
            { "camera_to_world": POSE, "fov": 60.0, "aspect": 1.3333 },
            { "camera_to_world": DMat3::IDENTITY.to_cols_array().chunks(3).flat_map(|row| [row, &[5.0]].concat())
                .chain([0.0, 0.0, 0.0, 1.0]).collect::<Vec<f64>>(), "fov": 90.0, "aspect": 1.0 },
        ],
    })
}

fn close(found: &DAffine3, expected: &[f64; 16]) {
    let expected = from_rows(expected).unwrap();
    assert!(found.abs_diff_eq(expected, 1e-7), "{found} {expected}");
}

fn shots(path: Path) -> Vec<Keyframe> {
    let Motion::Frames(keys) = path.motion else { panic!("it lists every frame") };
    keys
}

#[test]
fn read_nerfstudio_frames_keeps_poses() {
    let path = of(&nerfstudio_path(), None, DAffine3::IDENTITY).unwrap();
    assert_eq!((path.size, path.fps), (Some([400, 300]), Some(24.0)));
    let keys = shots(path);
    close(&keys[0].pose, &POSE);
    assert_eq!(keys[1].pose.translation, DVec3::splat(5.0));
    // Angles are vertical: 60 degrees span 300 pixels at this focal length.
    let camera = keys[0].camera([400, 300]);
    assert!(camera.focal.iter().all(|focal| (focal - 259.8076211353316).abs() < 1e-9), "{camera:?}");
}

/// The viewer writes sizes as floats, and Blender's add-on the scale of the scene in the axes.
#[test]
fn read_nerfstudio_accepts_float_sizes_and_scaled_axes() {
    let mut document = nerfstudio_path();
    (document["render_width"], document["render_height"]) = (json!(400.0), json!(300.0));
    let mut scaled = POSE;
    scaled.iter_mut().enumerate().filter(|(i, _)| *i < 12 && i % 4 < 3).for_each(|(_, value)| *value *= 2.5);
    document["camera_path"][0]["camera_to_world"] = json!(scaled);
    let path = of(&document, None, DAffine3::IDENTITY).unwrap();
    assert_eq!(path.size, Some([400, 300]));
    close(&shots(path)[0].pose, &POSE);
    // Each axis has the same scale, and none is mirrored.
    for (column, factor) in [(0, 1.1), (2, -1.0)] {
        let mut wrong = POSE;
        (0..3).for_each(|row| wrong[4 * row + column] *= factor);
        document["camera_path"][0]["camera_to_world"] = json!(wrong);
        let message = of(&document, None, DAffine3::IDENTITY).map(drop).unwrap_err().to_string();
        assert!(message.contains("`camera_path[0]`: its pose must be"), "{message}");
    }
}

#[test]
fn read_nerfstudio_transform_is_inverted() {
    // The pose above in a world that is rotated by 0.7 about (1, 2, 3), translated by (0.1, -0.2, 0.3) and scaled by
    // 0.4. The file's x, y and z are the earlier y, x and -z, with x shifted by half a unit. Computed with NumPy.
    let seen = [
        0.881017145,
        -0.159466323,
        0.445397891,
        0.969010196,
        0.470622245,
        0.199498788,
        -0.859485274,
        0.007291831,
        0.048202617,
        0.966835418,
        0.250810252,
        0.03213538,
        0.0,
        0.0,
        0.0,
        1.0,
    ];
    let transform = json!([
        [-0.482929284, 0.781639174, -0.394739798, 0.490819587],
        [0.832030134, 0.550117231, 0.071392499, 0.075058615],
        [0.272956339, -0.293957878, -0.916015067, 0.153021061],
    ]);
    let matrix3 = DMat3::from_cols(DVec3::Y, DVec3::X, DVec3::NEG_Z);
    let applied = DAffine3 { matrix3, translation: DVec3::new(0.5, 0.0, 0.0) };
    let mut document = nerfstudio_path();
    document["camera_path"][0]["camera_to_world"] = json!(seen);
    let found = of(&document, Some(&json!({ "transform": transform, "scale": 0.4 })), applied).unwrap();
    close(&shots(found)[0].pose, &POSE);
    // A file with doubled coordinates. Nerfstudio's scale includes the factor.
    let doubled = DAffine3 { matrix3: 2.0 * matrix3, translation: 2.0 * applied.translation };
    let found = of(&document, Some(&json!({ "transform": transform, "scale": 0.8 })), doubled).unwrap();
    close(&shots(found)[0].pose, &POSE);
    let fails = |transform: Value, expected: &str| {
        let message = of(&document, Some(&transform), applied).unwrap_err().to_string();
        assert!(message.contains("transform.json") && message.contains(expected), "{message}");
    };
    fails(json!({ "transform": transform, "scale": 0.0 }), "`scale`: must be above 0");
    fails(
        json!({ "transform": [[1, 0, 0, 0], [0, 2, 0, 0], [0, 0, 1, 0]], "scale": 1.0 }),
        "`transform`: must be a rotation",
    );
    fails(json!({ "transform": transform }), "missing field `scale`");
}

#[test]
fn read_nerfstudio_keys_pass_key_frames() {
    let matrix = |x: f64| [1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    let frame = |x: f64, seconds: f64| {
        json!({ "matrix": matrix(x), "fov": 50.0, "aspect": 1.5,
                "override_transition_enabled": seconds > 0.0, "override_transition_sec": seconds })
    };
    let document = |cycle: bool| {
        json!({ "render_width": 60, "render_height": 40, "is_cycle": cycle, "default_transition_sec": 2.0,
                "keyframes": [frame(0.0, 4.0), frame(1.0, 0.0), frame(3.0, 1.0)] })
    };
    for (cycle, shares, length) in [(false, [0.0, 2.0 / 3.0, 1.0], 3.0), (true, [0.0, 2.0 / 7.0, 3.0 / 7.0], 7.0)] {
        let Motion::Keys { path, seconds } = of(&document(cycle), None, DAffine3::IDENTITY).unwrap().motion else {
            panic!()
        };
        assert_eq!(seconds, Some(length), "the first key frame's own time is that of its return");
        for (share, (expected, x)) in path.shares().iter().zip(shares.into_iter().zip([0.0, 1.0, 3.0])) {
            assert!((share - expected).abs() < 1e-12 && (path.at(*share).pose.translation.x - x).abs() < 1e-12);
        }
    }
}

/// The same pose in the coordinates of instant-ngp and of the capture, computed with NumPy after `nerf_loader.h`.
fn ngp_path() -> Value {
    let key = json!({ "R": [0.1, -0.3, 0.5, 0.8], "T": [0.7, 0.2, 1.1], "fov": 60.0, "dof": 0.0, "scale": 1.5, "slice": 0.0 });
    json!({ "time": 0.3, "path": [key, key, key] })
}

#[test]
fn read_ngp_poses_leave_the_unit_cube() {
    let rows = |position: [f64; 3]| {
        let [x, y, z] = position;
        [
            0.5858585858585859,
            0.1414141414141414,
            -0.797979797979798,
            x,
            0.3131313131313131,
            0.8686868686868687,
            0.3838383838383838,
            y,
            0.7474747474747475,
            -0.4747474747474748,
            0.4646464646464646,
            z,
            0.0,
            0.0,
            0.0,
            1.0,
        ]
    };
    let cases = [
        (None, [1.8181818181818183, 0.6060606060606060, -0.9090909090909092]),
        (Some(json!({ "scale": 0.5, "offset": [0.1, 0.2, 0.3], "frames": [] })), [2.0, 1.0, -0.2]),
    ];
    for (transform, position) in cases {
        let found = of(&ngp_path(), transform.as_ref(), DAffine3::IDENTITY).unwrap();
        assert_eq!((found.size, found.fps), (None, None));
        let Motion::Keys { path, seconds: None } = found.motion else { panic!() };
        let key = path.at(0.4);
        close(&key.pose, &rows(position));
        assert!((key.angle_y - 60_f64.to_radians()).abs() < 1e-12);
    }
    let times = |closed: bool, stamps: [f64; 3]| {
        let mut document = ngp_path();
        document["loop"] = json!(closed);
        stamps.iter().enumerate().for_each(|(i, stamp)| document["path"][i]["timestamp"] = json!(stamp));
        let Motion::Keys { path, .. } = of(&document, None, DAffine3::IDENTITY).unwrap().motion else { panic!() };
        path.shares()
    };
    for (given, expected) in [(json!(2.5), Some(2.5)), (json!(0), None), (json!(-1), None), (json!(1e9), None)] {
        let mut document = ngp_path();
        document["duration_seconds"] = given.clone();
        let Motion::Keys { seconds, .. } = of(&document, None, DAffine3::IDENTITY).unwrap().motion else { panic!() };
        assert_eq!(seconds, expected, "{given}");
    }
    // Timestamps are arrival times of the next key frame.
    assert_eq!(times(false, [1.0, 4.0, 9.0]), [0.0, 0.25, 1.0]);
    assert_eq!(times(true, [1.0, 4.0, 8.0]), [0.0, 0.125, 0.5]);
    assert_eq!(times(false, [0.0, 0.0, 0.0]), [0.0, 0.5, 1.0]);
}

#[test]
fn read_unknown_fields_is_refused() {
    let fails = |mut document: Value, at: &str, value: Value, expected: &str| {
        let (parent, name) = at.rsplit_once('/').unwrap();
        let parent = document.pointer_mut(parent).unwrap();
        match name.parse::<usize>() {
            Ok(index) => parent[index] = value,
            Err(_) => parent[name] = value,
        }
        let message = of(&document, None, DAffine3::IDENTITY).map(drop).unwrap_err().to_string();
        assert!(
            message.contains("path.json: ") && message.contains(expected) && !message.contains('\n'),
            "{at}: {message}"
        );
    };
    let ns = |at: &str, value: Value, expected: &str| fails(nerfstudio_path(), at, value, expected);
    ns("/camera_type", json!("fisheye"), "`camera_type`: must be `perspective`");
    ns("/crop", json!({}), "`crop`: is not supported");
    ns("/render_width", json!(0), "`render_width`");
    ns("/render_width", json!(400.5), "400.5 is no whole number");
    ns("/render_height", json!(100_000), "`render_width`: the image size is 400x100000; use 1 to 16384 pixels a side");
    ns("/fps", json!(-1.0), "`fps`");
    ns("/fps", json!(1000.0), "`fps`: is 1000; use 0.01 to 240");
    ns("/fps", json!(0.001), "`fps`: is 0.001; use 0.01 to 240");
    ns("/seconds", json!(0.0), "`seconds`");
    ns("/camera_path", json!([]), "`camera_path`");
    ns("/lens", json!(1), "unknown field `lens`");
    ns("/camera_path/1/fov", json!(180.0), "`camera_path[1]`: `fov` is 180; use 0.001 to 179.999 degrees");
    ns("/camera_path/1/fov", json!("60"), "is malformed");
    ns("/camera_path/0/render_time", json!(0.5), "`camera_path[0].render_time`");
    ns("/camera_path/0/camera_to_world", json!([1.0, 2.0]), "is malformed");
    ns("/camera_path/0/camera_to_world/0", json!(3.0), "`camera_path[0]`: its pose must be a rotation");
    ns("/camera_path/0/camera_to_world/12", json!(3.0), "row by row");
    ns("/camera_path/0/camera_to_world/3", json!(null), "is malformed");
    let mut keys = nerfstudio_path();
    keys["camera_path"] = json!(null);
    keys["keyframes"] = json!([{ "matrix": POSE, "fov": 50.0 }]);
    fails(keys.clone(), "/smoothness_value", json!(0.3), "`smoothness_value`");
    keys["smoothness_value"] = json!(0.0);
    fails(keys.clone(), "/default_transition_sec", json!(0.0), "`default_transition_sec`");
    fails(keys.clone(), "/keyframes/0/fov", json!(0.0), "`keyframes[0]`");
    fails(keys, "/keyframes", json!([]), "`keyframes`: is empty");
    let ngp = |at: &str, value: Value, expected: &str| fails(ngp_path(), at, value, expected);
    ngp("/path/1/dof", json!(0.1), "`path[1].aperture_size`: must be 0");
    ngp("/path/1/glow_mode", json!(1), "`path[1].glow_mode`");
    ngp("/path/0/R", json!([0, 0, 0, 0]), "`path[0].R`: must be a quaternion");
    ngp("/path/0/fov", json!(0.0), "`path[0]`: `fov`");
    ngp("/path/0/T", json!([0, 0]), "is malformed");
    ngp("/path/2/shear", json!(1), "unknown field `shear`");
    ngp("/spline_order", json!(1), "`spline_order`: must be 3");
    ngp("/path", json!([]), "`path`: is empty");
    fails(json!({ "frames": [] }), "/other", json!(1), "not a camera path");
}
