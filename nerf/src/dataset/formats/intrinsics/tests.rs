use crate::camera::lens::Lens;
use crate::camera::pinhole::Camera;
use crate::dataset::formats::kit::{failure, frames, picture, remove, says};
use crate::dataset::formats::transforms;
use serde_json::{Value, json};
use std::f64::consts::PI;

const FILE: &str = "transforms.json";

/// Two frames and a pinhole with distinct numbers.
fn document() -> Value {
    json!({ "fl_x": 100.0, "fl_y": 110.0, "cx": 31.0, "cy": 25.0, "w": 64, "h": 48, "frames": frames(&["0", "1"]) })
}

/// Reads the cameras of a changed document.
fn read(change: impl FnOnce(&mut Value)) -> crate::Result<Vec<Camera>> {
    let (folder, mut document) = (tempfile::tempdir().unwrap(), document());
    change(&mut document);
    std::fs::write(folder.path().join(FILE), document.to_string()).unwrap();
    Ok(transforms::read(folder.path())?.views.into_iter().map(|view| view.camera).collect())
}

#[track_caller]
fn cameras(change: impl FnOnce(&mut Value)) -> Vec<Camera> {
    read(change).unwrap()
}

#[track_caller]
fn fails(change: impl FnOnce(&mut Value), parts: &[&str]) {
    let message = read(change).unwrap_err().to_string();
    assert!(!message.contains('\n') && message.contains("transforms.json: "), "{message}");
    says(&message, parts);
}

fn set(object: &mut Value, fields: &Value) {
    object.as_object_mut().unwrap().extend(fields.as_object().unwrap().clone());
}

/// The camera of a file with these fields at the top; it must equal that of a frame with them in a file with others.
#[track_caller]
fn with(fields: Value) -> Camera {
    let top = cameras(|document| set(document, &fields));
    assert_eq!(top[0], top[1]);
    let frame = cameras(|document| set(&mut document["frames"][1], &fields));
    assert_eq!(frame[0], cameras(|_| {})[0], "the other frame keeps the file's");
    assert_eq!(frame[1], top[0]);
    top[0].clone()
}

#[test]
fn all_pinhole_numbers_are_read() {
    let plain = cameras(|_| {})[0].clone();
    assert_eq!((plain.width, plain.height, plain.focal, plain.centre), (64, 48, [100.0, 110.0], [31.0, 25.0]));
    assert_eq!((plain.lens, plain.pose.translation.z), (Lens::Pinhole, 4.0));
    assert_eq!(with(json!({ "fl_x": 90, "fl_y": 95.5 })), Camera { focal: [90.0, 95.5], ..plain.clone() });
    assert_eq!(with(json!({ "cx": 30.25 })), Camera { centre: [30.25, 25.0], ..plain.clone() });
    assert_eq!(with(json!({ "cy": 30.25 })), Camera { centre: [31.0, 30.25], ..plain.clone() });
    assert_eq!(with(json!({ "w": 128.0 })), Camera { width: 128, ..plain.clone() });
    assert_eq!(with(json!({ "h": 96 })), Camera { height: 96, ..plain.clone() });
    // Each axis of the principal point defaults to the middle separately.
    assert_eq!(cameras(|d| remove(d, "cx"))[0].centre, [32.0, 25.0]);
    assert_eq!(cameras(|d| remove(d, "cy"))[0].centre, [31.0, 24.0]);
}

#[test]
fn angles_replace_absent_focal_lengths() {
    let of = |angle: f64, side: f64| 0.5 * side / (0.5 * angle).tan();
    let angles = json!({ "camera_angle_x": 0.8, "camera_angle_y": 0.7 });
    let without = |d: &mut Value, names: &[&str]| names.iter().for_each(|name| remove(d, name));
    let focal = |names: &[&str]| {
        let cameras = cameras(|d| {
            without(d, names);
            set(d, &angles);
        });
        cameras[0].focal
    };
    assert_eq!(focal(&[]), [100.0, 110.0], "focal lengths win");
    assert_eq!(focal(&["fl_x"]), [of(0.8, 64.0), 110.0]);
    assert_eq!(focal(&["fl_y"]), [100.0, of(0.7, 48.0)]);
    assert_eq!(focal(&["fl_x", "fl_y"]), [of(0.8, 64.0), of(0.7, 48.0)]);
    // A single angle counts for both axes.
    for (angle, side) in [("camera_angle_x", 64.0), ("camera_angle_y", 48.0)] {
        let cameras = cameras(|d| {
            without(d, &["fl_x", "fl_y"]);
            d[angle] = json!(0.9);
        });
        assert_eq!(cameras[0].focal, [of(0.9, side); 2], "{angle}");
    }
    assert_eq!(cameras(|d| remove(d, "fl_y"))[0].focal, [100.0; 2]);
    assert_eq!(cameras(|d| remove(d, "fl_x"))[0].focal, [110.0; 2]);
    // A frame's angle has priority over the file's focal length.
    let own = cameras(|d| set(&mut d["frames"][1], &angles));
    assert_eq!([own[0].focal, own[1].focal], [[100.0, 110.0], [of(0.8, 64.0), of(0.7, 48.0)]]);
    let own = cameras(|d| {
        without(d, &["fl_y"]);
        d["frames"][1]["fl_x"] = json!(90.0);
    });
    assert_eq!(own[1].focal, [90.0; 2]);
    fails(|d| d["frames"][1]["fl_x"] = json!(90), &["`frames[1].fl_y`: is missing", "`fl_x`", "100 and 110"]);
    fails(|d| d["frames"][1]["fl_y"] = json!(90), &["`frames[1].fl_x`: is missing"]);
    fails(|d| without(d, &["fl_x", "fl_y"]), &["`camera_angle_x`: is missing", "fl_x and fl_y"]);
}

/// A frame's camera that raygrad does not read must not be replaced by the file's without a word.
#[test]
fn cameras_of_frames_that_are_not_read_are_refused_or_noted() {
    let own = |fields: Value| move |d: &mut Value| set(&mut d["frames"][1], &fields);
    for (name, value) in [
        ("intrinsics", json!({ "fx": 90, "fy": 90, "cx": 31, "cy": 25, "k1": 0.1 })),
        ("K", json!("90 0 31 0 90 25 0 0 1")),
        ("K", json!([[90, 0, 31], [0, 90, 25]])),
        ("camera_matrix", json!({ "data": [90, 0, 31, 0, 90, 25, 0, 0, 1], "rows": 3, "cols": 3 })),
        ("cam_intrinsic", json!([90, 90, 31, 25, 0.1])),
    ] {
        let parts = [&*format!("`frames[1].{name}`: is "), "which raygrad does not read: write a 3x3 matrix"];
        fails(own(json!({ name: value })), &parts);
        // A focal length of its own explains it.
        assert_eq!(cameras(own(json!({ name: value, "fl_x": 80, "fl_y": 80 })))[1].focal, [80.0; 2]);
    }
    assert_eq!(cameras(own(json!({ "K": null })))[1].focal, [100.0, 110.0]);
    let notes = |change: &dyn Fn(&mut Value)| {
        let (folder, mut document) = (tempfile::tempdir().unwrap(), document());
        change(&mut document);
        std::fs::write(folder.path().join(FILE), document.to_string()).unwrap();
        transforms::read(folder.path()).unwrap().assumptions
    };
    let note = |field: &str, value: &str| {
        format!("`{field}` is {value}, which raygrad does not read: used the file's focal length")
    };
    let focal = own(json!({ "focal_length": 4.2 }));
    assert_eq!(notes(&|d| focal(d)), [note("frames[1].focal_length", "4.2")]);
    assert_eq!(notes(&|d| d["intrinsics"] = json!({ "fx": 9, "k1": 1 })), [note("intrinsics", r#"{"fx":9,"k1":1}"#)]);
    assert_eq!(notes(&own(json!({ "fl_x": 80, "fl_y": 80, "focal_length": 4.2 }))), [""; 0]);
}

/// A focal length of the file belongs to the file's size, or to images of one shape and any size.
#[test]
fn sizes_of_frames_without_their_focal_length_are_refused() {
    let read = |sizes: [[usize; 2]; 2], change: &dyn Fn(&mut Value)| {
        let (folder, mut document) = (tempfile::tempdir().unwrap(), document());
        ["cx", "cy"].iter().for_each(|name| remove(&mut document, name));
        for (i, [w, h]) in sizes.into_iter().enumerate() {
            picture(&folder.path().join(format!("{i}.png")), w, h);
            document["frames"][i]["file_path"] = json!(format!("{i}.png"));
        }
        change(&mut document);
        std::fs::write(folder.path().join(FILE), document.to_string()).unwrap();
        transforms::read(folder.path())
            .map(|capture| capture.views.into_iter().map(|v| v.camera.focal).collect::<Vec<_>>())
    };
    let half = json!({ "w": 32, "h": 24 });
    let sizes = [[64, 48], [32, 24]];
    let own = |fields: &Value| {
        let fields = fields.clone();
        move |d: &mut Value| set(&mut d["frames"][1], &fields)
    };
    let message = read(sizes, &own(&half)).unwrap_err().to_string();
    says(&message, &["`frames[1].w`: is 32, but the file's focal length is of 64x48 pixels: give the frame its own"]);
    // A crop, an own focal length, an angle, and an image on its side are clear.
    let clear = |fields: Value| {
        let mut all = half.clone();
        set(&mut all, &fields);
        read(sizes, &own(&all)).unwrap()[1]
    };
    assert_eq!(clear(json!({ "cx": 10, "cy": 12 })), [100.0, 110.0]);
    assert_eq!(clear(json!({ "fl_x": 50, "fl_y": 55 })), [50.0, 55.0]);
    let of_angle = |d: &mut Value| {
        ["fl_x", "fl_y"].iter().for_each(|name| remove(d, name));
        d["camera_angle_x"] = json!(0.8);
        own(&half)(d);
    };
    assert!(read(sizes, &of_angle).is_ok());
    assert!(read([[64, 48], [48, 64]], &own(&json!({ "w": 48, "h": 64 }))).is_ok());
    // Without the file's size, the frames' sizes must be of one camera.
    let all = |second: [usize; 2]| {
        move |d: &mut Value| {
            ["w", "h"].iter().for_each(|name| remove(d, name));
            d["fl_y"] = json!(100.0);
            for (i, [w, h]) in [[64, 48], second].into_iter().enumerate() {
                set(&mut d["frames"][i], &json!({ "w": w, "h": h }));
            }
        }
    };
    let message = read(sizes, &all([32, 24])).unwrap_err().to_string();
    says(&message, &["`w`: is missing beside the focal length, which images of 64x48", "and 32x24"]);
    assert!(read([[64, 48]; 2], &all([64, 48])).is_ok());
    // A principal point alone is no crop.
    let centred = |d: &mut Value| {
        ["w", "h"].iter().for_each(|name| remove(d, name));
        own(&json!({ "cx": 16, "cy": 12 }))(d);
    };
    says(&read(sizes, &centred).unwrap_err().to_string(), &["`w`: is missing beside the focal length"]);
}

#[test]
fn contradicting_angles_are_noted() {
    let notes = |change: &dyn Fn(&mut Value)| {
        let (folder, mut document) = (tempfile::tempdir().unwrap(), document());
        change(&mut document);
        std::fs::write(folder.path().join(FILE), document.to_string()).unwrap();
        transforms::read(folder.path()).unwrap().assumptions
    };
    let angle = |side: f64, f: f64| 2.0 * (0.5 * side / f).atan();
    let [x, y] = [angle(64.0, 100.0), angle(48.0, 110.0)];
    let note = |field: &str, given: f64, own: f64, f: f64| {
        format!("`{field}` is {given}, but the focal length of {f} pixels gives {own:.4}: used the focal length")
    };
    // Equal up to rounding.
    assert_eq!(notes(&|d| (d["camera_angle_x"], d["camera_angle_y"]) = (json!(x), json!(y))), [""; 0]);
    assert_eq!(notes(&|d| d["camera_angle_x"] = json!((x * 100.0).round() / 100.0)), [""; 0]);
    assert_eq!(notes(&|d| d["camera_angle_x"] = json!(0.8)), [note("camera_angle_x", 0.8, x, 100.0)]);
    assert_eq!(notes(&|d| d["camera_angle_y"] = json!(0.8)), [note("camera_angle_y", 0.8, y, 110.0)]);
    // In degrees.
    assert_eq!(notes(&|d| d["camera_angle_x"] = json!(35.5)), [note("camera_angle_x", 35.5, x, 100.0)]);
    // By a matrix, and in a frame.
    let matrix = |d: &mut Value| {
        ["fl_x", "fl_y", "cx", "cy"].iter().for_each(|name| remove(d, name));
        d["K"] = json!([[100, 0, 31], [0, 110, 25], [0, 0, 1]]);
        d["camera_angle_x"] = json!(0.7);
    };
    assert_eq!(notes(&matrix), [note("camera_angle_x", 0.7, x, 100.0)]);
    let of_frame = |d: &mut Value| set(&mut d["frames"][1], &json!({ "fl_x": 50, "fl_y": 50, "camera_angle_x": x }));
    assert_eq!(notes(&of_frame), [note("frames[1].camera_angle_x", x, angle(64.0, 50.0), 50.0)]);
    // The file's lengths have the size of the file, and count for frames without their own.
    let consistent = json!({ "camera_angle_x": x, "camera_angle_y": y });
    let half = json!({ "w": 32, "h": 24, "fl_x": 50, "fl_y": 55 });
    let smaller = |d: &mut Value| {
        set(d, &consistent);
        set(&mut d["frames"][0], &half);
    };
    assert_eq!(notes(&smaller), [""; 0]);
    let later = |d: &mut Value| {
        smaller(d);
        set(&mut d["frames"][1], &json!({ "fl_x": 50, "fl_y": 50, "camera_angle_x": x }));
    };
    assert_eq!(notes(&later), [note("frames[1].camera_angle_x", x, angle(64.0, 50.0), 50.0)]);
    let resized = |d: &mut Value| {
        set(d, &consistent);
        set(&mut d["frames"][0], &json!({ "w": 32, "h": 24 }));
    };
    assert_eq!(notes(&resized), [""; 0]);
    let unused = |d: &mut Value| {
        d["camera_angle_x"] = json!(0.8);
        (0..2).for_each(|i| set(&mut d["frames"][i], &half));
    };
    assert_eq!(notes(&unused), [""; 0]);
    // A value that is no number was never used.
    assert_eq!(notes(&|d| d["camera_angle_x"] = json!("NaNa")), [""; 0]);
    // Those of a frame take the place of the file's. A fisheye has other angles.
    let angles = json!({ "camera_angle_x": 0.7, "camera_angle_y": 0.5 });
    assert_eq!(notes(&|d| set(&mut d["frames"][1], &angles)), [""; 0]);
    assert_eq!(notes(&|d| set(d, &json!({ "camera_angle_x": 0.7, "is_fisheye": true }))), [""; 0]);
}

#[test]
fn all_lens_coefficients_are_read() {
    let brown = |k: [f64; 6], p: [f64; 2]| Lens::Brown { k, p };
    let fisheye = |k: [f64; 4], p: [f64; 2], s: [f64; 2]| Lens::Fisheye { k, p, s };
    let zero = [0.0; 2];
    let models = [
        ("SIMPLE_PINHOLE", json!({}), Lens::Pinhole),
        ("PINHOLE", json!({}), Lens::Pinhole),
        ("SIMPLE_RADIAL", json!({ "k1": 0.1 }), brown([0.1, 0.0, 0.0, 0.0, 0.0, 0.0], zero)),
        ("RADIAL", json!({ "k1": 0.1, "k2": 0.2 }), brown([0.1, 0.2, 0.0, 0.0, 0.0, 0.0], zero)),
        (
            "OPENCV",
            json!({ "k1": 0.1, "k2": 0.2, "k3": 0.3, "p1": 0.7, "p2": 0.8 }),
            brown([0.1, 0.2, 0.3, 0.0, 0.0, 0.0], [0.7, 0.8]),
        ),
        (
            "FULL_OPENCV",
            json!({ "k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4, "k5": 0.5, "k6": 0.6, "p1": 0.7, "p2": 0.8 }),
            brown([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], [0.7, 0.8]),
        ),
        ("SIMPLE_RADIAL_FISHEYE", json!({ "k1": 0.1 }), fisheye([0.1, 0.0, 0.0, 0.0], zero, zero)),
        ("RADIAL_FISHEYE", json!({ "k1": 0.1, "k2": 0.2 }), fisheye([0.1, 0.2, 0.0, 0.0], zero, zero)),
        (
            "OPENCV_FISHEYE",
            json!({ "k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4 }),
            fisheye([0.1, 0.2, 0.3, 0.4], zero, zero),
        ),
        (
            "THIN_PRISM_FISHEYE",
            json!({ "k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4, "p1": 0.7, "p2": 0.8, "sx1": 0.9, "sy1": 0.95 }),
            fisheye([0.1, 0.2, 0.3, 0.4], [0.7, 0.8], [0.9, 0.95]),
        ),
        ("FOV", json!({ "omega": 0.9 }), Lens::Fov { omega: 0.9 }),
    ];
    for (model, own, lens) in models {
        let mut fields = own.clone();
        fields["camera_model"] = json!(model);
        assert_eq!(with(fields.clone()).lens, lens, "{model}");
        for name in ["k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "sx1", "sy1", "omega"] {
            let set_to = |value: Value| {
                let mut fields = fields.clone();
                fields[name] = value;
                move |d: &mut Value| set(d, &fields)
            };
            fails(set_to(json!("0.1a")), &[&format!("`{name}`: must be a finite number, is \"0.1a\"")]);
            if own.get(name).is_some() {
                assert_ne!(cameras(set_to(json!(0.15)))[0].lens, lens, "{model} {name}");
                continue;
            }
            fails(set_to(json!(0.1)), &[&format!("`{name}`: is 0.1"), "set it to 0"]);
            let frame = read(|d| {
                set(d, &fields);
                d["frames"][1][name] = json!(-1e-3);
            });
            says(&frame.unwrap_err().to_string(), &[&format!("`frames[1].{name}`: is -0.001")]);
            for nothing in [json!(0), json!(-1e-17), json!(null)] {
                assert_eq!(cameras(set_to(nothing))[0].lens, lens, "{model} {name}");
            }
        }
    }
    // Without a model name.
    let lens = with(json!({ "k1": 0.1, "k2": -0.2, "p1": 0.01, "p2": 0.02 })).lens;
    assert_eq!(lens, brown([0.1, -0.2, 0.0, 0.0, 0.0, 0.0], [0.01, 0.02]));
    assert_eq!(with(json!({ "k1": 0, "k2": 0.0, "p1": 0, "p2": 0, "k3": 0, "k4": 0 })).lens, Lens::Pinhole);
    for model in ["OPENCV", "FULL_OPENCV"] {
        assert_eq!(with(json!({ "camera_model": model, "k1": 0 })).lens, Lens::Pinhole, "{model}");
    }
    fails(|d| d["k4"] = json!(0.1), &["`k4`", "nerfstudio", "a denominator term in OpenCV", "FULL_OPENCV"]);
    for omega in [json!(null), json!(0), json!(-0.5), json!(3.2)] {
        let change = |d: &mut Value| set(d, &json!({ "camera_model": "FOV", "omega": omega }));
        fails(change, &["omega`: must be the field of view in radians"]);
    }
}

#[test]
fn is_fisheye_selects_the_fisheye_model() {
    let fisheye = Lens::Fisheye { k: [0.1, 0.2, 0.3, 0.4], p: [0.0; 2], s: [0.0; 2] };
    let k = json!({ "k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4, "is_fisheye": true });
    assert_eq!(with(k.clone()).lens, fisheye);
    for (flag, model, fine) in [
        (json!(true), "OPENCV_FISHEYE", true),
        (json!(1), "OPENCV_FISHEYE", true),
        (json!(false), "OPENCV", true),
        (json!(0), "PINHOLE", true),
        (json!(false), "OPENCV_FISHEYE", false),
        (json!(true), "PINHOLE", false),
    ] {
        let fields = json!({ "is_fisheye": flag, "camera_model": model });
        match fine {
            true => drop(with(fields)),
            false => fails(|d| set(d, &fields), &["`is_fisheye`: contradicts `camera_model`", model]),
        }
    }
    let word = |word: &str| cameras(|d| set(d, &json!({ "camera_model": null, "k1": 0.1, "is_fisheye": word })));
    assert_eq!(word(" False"), cameras(|d| set(d, &json!({ "camera_model": null, "k1": 0.1 }))));
    assert_ne!(word("true"), word("false"));
    fails(|d| d["is_fisheye"] = json!("yes"), &["`is_fisheye`: must be true or false, is \"yes\""]);
    fails(|d| set(d, &json!({ "is_fisheye": true, "p1": 0.1 })), &["`p1`", "OPENCV_FISHEYE has no such"]);
}

#[test]
fn unknown_models_are_named() {
    for model in ["OPENCV5", "opencv 5", "FISHEYE624", "ORTHOPHOTO", "VR180_L", "OMNIDIRECTIONALSTEREO_L"] {
        fails(
            |d| d["camera_model"] = json!(model),
            &["`camera_model`", &format!("is {model}; use one of "), "THIN_PRISM_FISHEYE"],
        );
        fails(|d| d["frames"][1]["camera_model"] = json!(model), &["`frames[1].camera_model`"]);
    }
    let distorted = with(json!({ "k1": 0.1, "camera_model": "OPENCV" }));
    for model in ["opencv", " OpenCV", "Perspective", ""] {
        assert_eq!(with(json!({ "k1": 0.1, "camera_model": model })), distorted, "{model}");
    }
    for model in ["pinhole", "perspective"] {
        assert_eq!(with(json!({ "camera_model": model })), cameras(|_| {})[0], "{model}");
    }
    // An empty name in a frame leaves that of the file.
    let top = json!({ "camera_model": "opencv_fisheye", "k1": 0.1 });
    let of_frame = cameras(|d| {
        set(d, &top);
        d["frames"][1]["camera_model"] = json!("");
    });
    assert!(of_frame[0] == of_frame[1] && matches!(of_frame[1].lens, Lens::Fisheye { .. }));
    fails(|d| set(d, &json!({ "camera_model": "pinhole", "k1": 0.1 })), &["`k1`: is 0.1", "PINHOLE has no such"]);
    fails(|d| d["camera_model"] = json!(4), &["`camera_model`: must be a string, is 4"]);
    fails(|d| d["camera_model"] = json!("a\nb".repeat(50)), &["`camera_model`"]);
}

#[test]
fn panorama_covers_all_directions() {
    let panorama = |fields: Value| {
        move |d: &mut Value| {
            *d = json!({ "camera_model": "EQUIRECTANGULAR", "w": 64, "h": 32, "frames": d["frames"].clone() });
            set(d, &fields);
        }
    };
    let camera = cameras(panorama(json!({})))[0].clone();
    assert_eq!((camera.lens, camera.focal), (Lens::Equirectangular, [32.0 / PI, 32.0 / PI]));
    assert_eq!(camera.centre, [32.0, 16.0]);
    for fields in [
        json!({ "fl_x": 32, "fl_y": 32, "cx": 32, "cy": 16 }),
        json!({ "fl_x": 10.2, "fl_y": 10.2, "cx": 31.5, "cy": 15.5 }),
        json!({ "camera_angle_x": 6.3, "camera_angle_y": 3.15 }),
    ] {
        assert_eq!(cameras(panorama(fields))[0], camera);
    }
    for (name, value) in
        [("fl_x", 64.0), ("fl_y", 16.0), ("cx", 30.0), ("cy", 18.0), ("camera_angle_x", PI), ("camera_angle_y", 1.5)]
    {
        fails(
            panorama(json!({ name: value })),
            &[&format!("`{name}`: must be "), &format!("for camera_model EQUIRECTANGULAR, is {value}")],
        );
    }
    fails(panorama(json!({ "k1": 0.1 })), &["`k1`", "EQUIRECTANGULAR has no such"]);
    // Each axis scales separately.
    let wide = cameras(panorama(json!({ "h": 16 })))[0].clone();
    assert_eq!(wide.focal, [32.0 / PI, 16.0 / PI]);
}

#[test]
fn unsupported_camera_fields_are_named() {
    for (name, value, hint) in [
        ("x_fov", json!(45.8), "camera_angle_x"),
        ("y_fov", json!(45.8), "camera_angle_y"),
        ("distortion_params", json!([0.1, 0]), "k1, k2, p1, p2"),
        ("dist_coeffs", json!([[-0.4, 0.1, 0, 0, 0]]), "OpenCV lists k1, k2, p1, p2, k3"),
        ("distortion_coefficients", json!({ "k1": 0.1 }), "k1, k2, p1, p2"),
        ("distortion", json!([0.1]), "k1, k2, p1, p2"),
        ("radial_distortion", json!(["0.1"]), "k1, k2, p1, p2"),
        ("tangential_distortion", json!([0.1]), "k1, k2, p1, p2"),
        ("dist", json!([0.1]), "k1, k2, p1, p2"),
        ("fisheye_crop_radius", json!(500.0), "mask_path"),
        ("ftheta_p0", json!(1e-3), "not supported"),
        ("ftheta_p4", json!("NaN"), "not supported"),
        ("latlong", json!(true), "EQUIRECTANGULAR"),
        ("equirectangular", json!(1), "EQUIRECTANGULAR"),
        ("rolling_shutter", json!([0, 0, 1, 0]), "rolling shutter is not supported; remove it to ignore it"),
        ("transform_matrix_start", json!([[1, 0, 0, 0]]), "rolling shutter is not supported; remove it to ignore it"),
        ("transform_matrix_end", json!([[1, 0, 0, 0]]), "rolling shutter is not supported; remove it to ignore it"),
        ("rolling_shutter_time", json!(0.03), "rolling shutter is not supported; remove it to ignore it"),
        ("normal_mts_args", json!(true), "axes of Mitsuba: negate the first and the third column"),
        ("D", json!([0.1, 0]), "k1, k2, p1, p2"),
        ("distCoeffs", json!([0.1, 0]), "k1, k2, p1, p2"),
        ("dist_coefs", json!([0.1, 0]), "k1, k2, p1, p2"),
        ("camera_type", json!("Fisheye"), "OPENCV_FISHEYE"),
        ("distortion_model", json!("equidistant"), "OPENCV_FISHEYE"),
        (
            "projection",
            json!("EQUIRECTANGULAR"),
            "camera_model OPENCV_FISHEYE, another fisheye model or EQUIRECTANGULAR",
        ),
        ("black_transparent", json!("True"), "write the transparency into the images; remove it to ignore it"),
    ] {
        fails(|d| d[name] = value.clone(), &[&format!("`{name}`: is "), hint, "which raygrad does not read"]);
        fails(|d| d["frames"][1][name] = value, &[&format!("`frames[1].{name}`: is "), hint]);
        for nothing in
            [json!(null), json!(false), json!("False"), json!(0), json!([0, 0.0, [0]]), json!([]), json!({ "k1": "0" })]
        {
            assert_eq!(cameras(|d| d[name] = nothing), cameras(|_| {}), "{name}");
        }
    }
}

/// Kinds of cameras that have no effect: usual ones, and those beside the camera model.
#[test]
fn usual_kinds_of_cameras_are_ignored() {
    let plain = cameras(|_| {});
    for (name, value) in [
        ("camera_type", json!("perspective")),
        ("projection", json!("pinhole")),
        ("distortion_model", json!("plumb_bob")),
    ] {
        assert_eq!(cameras(|d| d[name] = value), plain, "{name}");
    }
    let named = json!({ "camera_type": "fisheye", "camera_model": "OPENCV_FISHEYE" });
    assert!(matches!(cameras(|d| set(d, &named))[0].lens, Lens::Fisheye { .. }));
}

#[test]
fn distances_are_no_distortion() {
    assert_eq!(cameras(|d| d["dist"] = json!(4.5)), cameras(|_| {}));
}

#[test]
fn invalid_camera_numbers_are_named() {
    for name in ["fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "p2"] {
        for value in ["NaN", "Infinity", "-Infinity", "[1]", "\"one\"", "{}", "1e999"] {
            let (folder, mut document) = (tempfile::tempdir().unwrap(), document());
            document[name] = json!(12345);
            let text = document.to_string().replace("12345", value);
            std::fs::write(folder.path().join(FILE), text).unwrap();
            let message = failure(transforms::read(folder.path()), FILE);
            let expected = format!("`{name}`: must be a finite number, is ");
            assert!(message.contains(&expected) || value == "1e999", "{message}");
        }
    }
    for value in [json!(0), json!(-64), json!(0.5), json!(1e9)] {
        fails(|d| d["w"] = value.clone(), &["`w`: must be a number of pixels, 1 to 1048576"]);
        fails(|d| d["frames"][0]["h"] = value, &["`frames[0].h`: must be a number of pixels"]);
    }
    for (value, side) in [(json!(633.6), 633), (json!(64.5), 64), (json!(1000.0 * 0.7 - 1e-10), 700)] {
        let camera = &cameras(|d| (d["w"], d["h"]) = (value, json!(200.25)))[0];
        assert_eq!([camera.width, camera.height], [side, 200], "a fraction is dropped");
    }
    for value in [json!(0), json!(-100), json!(1e-9), json!(1e300)] {
        fails(|d| d["fl_x"] = value.clone(), &["`fl_x`: must be 1e-3 to 1e9 pixels"]);
        fails(|d| d["fl_y"] = value, &["`fl_y`: must be 1e-3 to 1e9 pixels"]);
    }
    for angle in [json!(0), json!(-0.5), json!(3.2), json!(PI), json!(1e-300)] {
        let change = |d: &mut Value| {
            remove(d, "fl_x");
            d["camera_angle_x"] = angle;
        };
        fails(change, &["`camera_angle_x`: must be an angle in radians between 0 and pi"]);
    }
    fails(
        |d| {
            remove(d, "fl_x");
            d["camera_angle_x"] = json!(39.6);
        },
        &["`camera_angle_x`: must be an angle in radians between 0 and pi, is 39.6: multiply degrees by pi / 180"],
    );
    // A panorama, and a fisheye lens of 220 degrees.
    for angle in [json!(2.0 * PI), json!(3.84)] {
        let change = |d: &mut Value| {
            remove(d, "fl_x");
            d["camera_angle_x"] = angle;
        };
        fails(change, &["`camera_angle_x`: ", "give the `camera_model` and the focal length of a wider lens"]);
    }
    fails(|d| d["cx"] = json!(1e12), &["`cx`: must be a position in pixels"]);
    fails(|d| remove(d, "h"), &["`h`: is missing beside `w`"]);
    fails(|d| remove(d, "w"), &["`w`: is missing beside `h`"]);
}

#[test]
fn missing_sizes_come_from_the_images() {
    let folder = tempfile::tempdir().unwrap();
    let mut document = json!({ "fl_x": 9, "frames": frames(&["a", "0.png", "1.png", "2"]) });
    let read = |document: &Value| {
        std::fs::write(folder.path().join(FILE), document.to_string()).unwrap();
        let views = transforms::read(folder.path())?.views;
        Ok::<_, crate::Error>(views.iter().map(|view| [view.camera.width, view.camera.height]).collect::<Vec<_>>())
    };
    assert_eq!(read(&document).unwrap(), [[0, 0]; 4], "nobody knows");
    picture(&folder.path().join("0.png"), 8, 6);
    picture(&folder.path().join("1.png"), 6, 8);
    assert_eq!(read(&document).unwrap(), [[8, 6], [8, 6], [6, 8], [8, 6]]);
    let mut angle = document.clone();
    set(&mut angle, &json!({ "fl_x": null, "camera_angle_x": 0.8 }));
    let shared = ["`w`: is missing", "8x6 (`0.png`) and 6x8 (`1.png`) share", "each frame its own `w`, `h` and `fl_x`"];
    says(&read(&angle).unwrap_err().to_string(), &shared);
    picture(&folder.path().join("1.png"), 16, 12);
    assert_eq!(read(&angle).unwrap()[2], [16, 12], "a copy of another size has the same field of view");
    says(&read(&document).unwrap_err().to_string(), &["`w`: is missing", "8x6 (`0.png`) and 16x12 (`1.png`) share"]);
    document["frames"][2]["fl_x"] = json!(18);
    assert_eq!(read(&document).unwrap()[2], [16, 12]);
    std::fs::write(folder.path().join("1.png"), b"not a picture").unwrap();
    says(&read(&document).unwrap_err().to_string(), &["`frames[2].file_path`: ", "1.png: cannot be decoded"]);
    set(&mut document, &json!({ "w": 16, "h": 12 }));
    assert_eq!(read(&document).unwrap(), [[16, 12]; 4], "headers are not read");
}

#[test]
fn other_spellings_of_numbers_give_the_same_cameras() {
    let plain = cameras(|_| {});
    let renamed = cameras(|d| {
        for (usual, other) in [("w", "width"), ("h", "height")] {
            d[other] = d[usual].clone();
            remove(d, usual);
        }
    });
    assert_eq!(renamed, plain);
    let strings = cameras(|d| {
        for name in ["fl_x", "fl_y", "cx", "cy", "w", "h"] {
            d[name] = json!(format!(" {}", d[name]));
        }
        for row in d["frames"][0]["transform_matrix"].as_array_mut().unwrap() {
            row.as_array_mut().unwrap().iter_mut().for_each(|value| *value = json!(value.to_string()));
        }
    });
    assert_eq!(strings, plain);
}

#[test]
fn intrinsic_matrices_are_read_in_all_forms() {
    let plain = cameras(|_| {});
    let rows = json!([[100.0, 0, 31.0], [0, 110.0, 25.0], [0, 0, 1]]);
    let columns = json!([[100.0, 0, 0], [0, 110.0, 0], [31.0, 25.0, 1]]);
    let flat = json!([100.0, 0, 31.0, 0, "110.0", 25.0, 0, 0, 1]);
    let lengths = ["fl_x", "fl_y", "cx", "cy"];
    for name in ["K", "intrinsics", "camera_intrinsics", "intrinsic_matrix", "camera_matrix"] {
        for matrix in [&rows, &columns, &flat] {
            let at_top = cameras(|d| {
                lengths.iter().for_each(|length| remove(d, length));
                d[name] = matrix.clone();
            });
            assert_eq!(at_top, plain, "{name} {matrix}");
        }
    }
    let of_frame = cameras(|d| d["frames"][1]["K"] = json!([[90, 0, 30], [0, 95, 20], [0, 0, 1]]));
    assert_eq!(of_frame[0], plain[0]);
    assert_eq!((of_frame[1].focal, of_frame[1].centre), ([90.0, 95.0], [30.0, 20.0]));
    // The same lengths twice.
    assert_eq!(cameras(|d| d["K"] = rows.clone()), plain);
    fails(|d| d["K"] = json!([[101, 0, 31], [0, 110, 25], [0, 0, 1]]), &["`fl_x`: is 100", "`K` has 101: remove one"]);
    fails(|d| d["K"] = json!([[100, 0, 31], [0, 110, 26], [0, 0, 1]]), &["`cy`: is 25", "`K` has 26: remove one"]);
    for matrix in [
        json!([[100, 1, 31], [0, 110, 25], [0, 0, 1]]),
        json!([[100, 0, 31], [0, 110, 25], [1, 0, 1]]),
        json!([[100, 0, 31], [0, 110, 25], [0, 0, 2]]),
    ] {
        fails(|d| d["K"] = matrix, &["`K`: must have the rows fx 0 cx, 0 fy cy and 0 0 1"]);
    }
    fails(|d| d["K"] = json!([1, 2, "x", 4, 5, 6, 7, 8, 9]), &["`K`: must have finite numbers, is [1,2,\"x\""]);
    let of_sides = json!([[1.5, 0, 0.5], [0, 1.5, 0.5], [0, 0, 1]]);
    fails(
        |d| {
            lengths.iter().for_each(|length| remove(d, length));
            d["K"] = of_sides;
        },
        &["`fl_x`: is 1.5 in `K`, which must be in pixels, of an image 64 wide"],
    );
    // Other programs' members of these names.
    for other in [json!([]), json!([[100, 0, 31], [0, 110, 25]]), json!([[1]]), json!([[1, 2, 3, 4]])] {
        assert_eq!(cameras(|d| d["K"] = other), plain);
    }
    assert_eq!(cameras(|d| d["intrinsics"] = json!({ "fx": 1 })), plain);
}

#[test]
fn focal_lengths_under_other_names_are_read() {
    let plain = cameras(|_| {});
    let with = |fields: Value| {
        move |d: &mut Value| {
            ["fl_x", "fl_y", "cx", "cy"].iter().for_each(|length| remove(d, length));
            set(d, &fields);
        }
    };
    let wide = json!([[100, 0, 31, 0], [0, 110, 25, 0], [0, 0, 1, 0], [0, 0, 0, 1]]);
    for fields in [
        json!({ "intrinsics": wide }),
        json!({ "intrinsics": wide.as_array().unwrap()[..3] }),
        json!({ "intrinsics": [100, 0, 31, 0, 0, 110, 25, 0, 0, 0, 1, 0] }),
        json!({ "intrinsics": [100, "110", 31, 25] }),
        json!({ "intrinsics": { "fx": 100, "fy": 110, "cx": 31, "cy": 25 } }),
        json!({ "cam_K": [[100, 1e-9, 31], [0, 110, 25], [0, 0, 1]] }),
        json!({ "fx": 100, "fy": 110, "cx": 31, "cy": 25 }),
        json!({ "camera_matrix": [], "K": [100, 110, 31, 25] }),
    ] {
        assert_eq!(cameras(with(fields.clone())), plain, "{fields}");
    }
    // The usual name counts.
    assert_eq!(cameras(|d| d["fx"] = json!(7)), plain);
    fails(with(json!({ "fx": 0 })), &["`fx`: must be above 0, is 0"]);
    fails(with(json!({ "fx": 100, "fy": -110 })), &["`fy`: must be above 0, is -110"]);
    fails(
        with(json!({ "K": [[100, 0, 31], [0, -110, 25], [0, 0, 1]] })),
        &["`K`: must have focal lengths above 0, is"],
    );
    // COLMAP's order, and millimetres beside a field of view.
    fails(with(json!({ "K": [100, 31, 25, 0.01] })), &["`K`: must be fx, fy, cx, cy in this order, is [100,"]);
    let millimetres = json!({ "fx": 50, "fy": 50, "camera_angle_x": 0.2 });
    fails(with(millimetres), &["`camera_angle_x`: is 0.2, but `fx` has a focal length of 50 pixels: remove"]);
    let agreeing = json!({ "fx": 50, "fy": 50, "cx": 31, "cy": 25, "camera_angle_x": 2.0 * 0.64_f64.atan() });
    assert_eq!(cameras(with(agreeing))[0].focal, [50.0; 2]);
    // A projection matrix, units of the side, and values that something else explains.
    let projection = json!([[100, 0, 31, 5], [0, 110, 25, 0], [0, 0, 1, 0]]);
    fails(with(json!({ "K": projection })), &["`K`: must have the rows fx 0 cx"]);
    fails(with(json!({ "fx": 0.9, "fy": 0.9 })), &["`fl_x`: is 0.9 in `fx`, which must be in pixels"]);
    fails(with(json!({ "K": [100, 110, 31, "NaN"] })), &["`K`: must have finite numbers, is [100,110,31,"]);
    let phone = json!({ "fx": 100, "fy": 110, "cx": 31, "cy": 25, "width": 1920 });
    for (name, value) in [("intrinsics", phone), ("focal_length", json!(4.2)), ("fov", json!(56.2))] {
        let unread = format!("raygrad does not read `{name}`, ");
        fails(with(json!({ name: value })), &["`camera_angle_x`: is missing", "as fl_x and fl_y", &unread]);
    }
}

#[test]
fn principal_points_far_outside_of_the_image_are_named() {
    assert_eq!(cameras(|d| d["cx"] = json!(-20))[0].centre, [-20.0, 25.0], "crops may lie beside it");
    fails(|d| d["cx"] = json!(527), &["`cx`: is 527, far outside of an image 64 wide or high: scale it"]);
    fails(|d| d["frames"][1]["cy"] = json!(-50), &["`frames[1].cy`: is -50, far outside of an image 48"]);
}

#[test]
fn principal_points_of_the_turned_image_are_named() {
    let what = ["`cx`: gives the principal point 24, 33, the middle of 48x64 pixels", "but frames[0] has 64x48"];
    fails(|d| set(d, &json!({ "cx": 24, "cy": 33 })), &what);
    fails(|d| set(d, &json!({ "cx": 24, "cy": 33 })), &["the frame's own `cx` and `cy`, or swap `w` and `h`"]);
    let matrix = |d: &mut Value| {
        ["fl_x", "fl_y", "cx", "cy"].into_iter().for_each(|name| drop(d.as_object_mut().unwrap().remove(name)));
        set(d, &json!({ "K": [[9, 0, 24], [0, 9, 33], [0, 0, 1]] }));
    };
    fails(matrix, &["`K`: gives the principal point 24, 33"]);
    // A frame's own crop.
    let folder = tempfile::tempdir().unwrap();
    let mut document = json!({ "fl_x": 9, "w": 8, "h": 6, "cx": 4, "cy": 3, "frames": frames(&["0.png", "1.png"]) });
    set(&mut document["frames"][1], &json!({ "cx": 3, "cy": 4 }));
    std::fs::write(folder.path().join(FILE), document.to_string()).unwrap();
    assert_eq!(transforms::read(folder.path()).unwrap().views[1].camera.centre, [3.0, 4.0]);
    // A crop may have its principal point there nearly, and middles of a square are close to each other.
    assert_eq!(with(json!({ "cx": 26, "cy": 32 })).centre, [26.0, 32.0]);
    assert_eq!(with(json!({ "w": 48, "h": 48, "cx": 24, "cy": 24 })).centre, [24.0, 24.0]);
    assert_eq!(with(json!({ "w": 50, "h": 48, "cx": 24, "cy": 25 })).centre, [24.0, 25.0]);
    // One principal point for images of both orientations, which gives no size.
    let folder = tempfile::tempdir().unwrap();
    let document = json!({ "fl_x": 9, "cx": 4, "cy": 3, "frames": frames(&["0.png", "1.png"]) });
    std::fs::write(folder.path().join(FILE), document.to_string()).unwrap();
    picture(&folder.path().join("0.png"), 8, 6);
    picture(&folder.path().join("1.png"), 6, 8);
    let message = transforms::read(folder.path()).unwrap_err().to_string();
    says(&message, &["`cx`: ", "but frames[1] has 6x8"]);
    assert!(message.ends_with("`cx` and `cy`"), "{message}");
}
