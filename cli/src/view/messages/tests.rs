use super::*;
use serde_json::json;

const POSE: [[f64; 4]; 3] = [[0.0, -1.0, 0.0, 0.5], [1.0, 0.0, 0.0, -4.0], [0.0, 0.0, 1.0, 1.0]];

fn sized(width: u32, height: u32) -> View {
    View {
        eye: Eye::Free { pose: POSE, fov: 50.0 },
        size: [width, height],
        show: Show::Color,
        compared: false,
        background: None,
        crop: None,
        skip: None,
        checkpoint: None,
    }
}

/// The JSON request of a view.
fn asked(view: &View) -> Value {
    let eye = match &view.eye {
        Eye::Free { pose, fov } => json!({ "free": { "pose": pose, "fov": fov } }),
        Eye::Photograph(number) => json!({ "photograph": number }),
    };
    json!({ "eye": eye, "size": view.size, "show": view.show, "compared": view.compared, "crop": view.crop })
}

#[test]
fn view_camera_follows_the_request() {
    // Looks along +y from (0, -4, 1), shifted by half a unit to the right.
    let pose = [[1.0, 0.0, 0.0, 0.5], [0.0, 0.0, -1.0, -4.0], [0.0, 1.0, 0.0, 1.0]];
    let camera = View::camera(&pose, 90.0, [40, 20]);
    assert_eq!([camera.width, camera.height], [40, 20]);
    assert!(camera.focal.iter().all(|focal| (focal - 10.0).abs() < 1e-12), "{camera:?}");
    assert!(camera.ray(20.0, 10.0).direction.abs_diff_eq(DVec3::Y, 1e-12));
    assert!(camera.ray(20.0, 0.0).direction.abs_diff_eq(DVec3::new(0.0, 0.5_f64.sqrt(), 0.5_f64.sqrt()), 1e-12));
    let same = rows(&camera.pose).iter().flatten().zip(pose.iter().flatten()).all(|(a, b)| (a - b).abs() < 1e-12);
    assert!(same, "{camera:?}");
    // A rotation with three digits is made exact.
    let rough = [[0.866, -0.5, 0.0, 0.0], [0.5, 0.866, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    let turn = View::camera(&rough, 50.0, [8, 8]).pose.matrix3;
    assert!((turn.transpose() * turn).abs_diff_eq(DMat3::IDENTITY, 1e-12) && (turn.determinant() - 1.0).abs() < 1e-12);
}

#[test]
fn read_valid_messages_succeeds() {
    let read = |message: Value| ClientMessage::read(&message.to_string()).unwrap();
    assert_eq!(read(json!({ "ask": "seen", "id": 4_294_967_295_u32 })), ClientMessage::Seen { id: u32::MAX });
    assert_eq!(read(json!({ "ask": "photograph", "number": 3 })), ClientMessage::Photograph { number: 3 });
    assert_eq!(read(json!({ "ask": "end-video" })), ClientMessage::EndVideo {});
    assert_eq!(read(json!({ "ask": "share", "share": 0 })), ClientMessage::Share { share: 0.0 });
    assert_eq!(read(json!({ "ask": "share", "share": 0.9 })), ClientMessage::Share { share: 0.9 });
    let mut view = View { eye: Eye::Free { pose: POSE, fov: 170.0 }, ..sized(9, 7) };
    assert_eq!(read(json!({ "ask": "save", "view": asked(&view) })), ClientMessage::Save { view: view.clone() });
    // Values at the limits.
    view.eye = Eye::Free { pose: [[1.0, 0.0, 0.0, 1e9], [0.0, 1.0, 0.0, -1e9], [0.0, 0.0, 1.0, 0.0]], fov: 1.0 };
    (view.compared, view.crop) = (true, Some([[-1e9; 3], [1e9; 3]]));
    assert_eq!(
        read(json!({ "ask": "view", "id": 1, "view": asked(&view) })),
        ClientMessage::View { id: 1, view: view.clone() }
    );
    (view.compared, view.show, view.crop) = (false, Show::Depth, None);
    assert_eq!(read(json!({ "ask": "view", "id": 1, "view": asked(&view) })), ClientMessage::View { id: 1, view });
}

#[test]
fn read_invalid_messages_gives_the_reason() {
    let view = asked(&sized(16, 16));
    let ask = |view: &Value| json!({ "ask": "view", "id": 1, "view": view });
    let changed = |name: &str, value: Value| {
        let mut view = view.clone();
        view[name] = value;
        ask(&view).to_string()
    };
    let pose = |pose: Value| changed("eye", json!({ "free": { "pose": pose, "fov": 50 } }));
    let field_of_view = |fov: f64| changed("eye", json!({ "free": { "pose": POSE, "fov": fov } }));
    let mut more = ask(&view);
    more["more"] = json!(1);
    let mut compared = view.clone();
    (compared["show"], compared["compared"]) = (json!("depth"), json!(true));
    for (message, expected) in [
        (String::new(), "EOF"),
        ("{".into(), "EOF"),
        ("[]".into(), "missing field"),
        ("null".into(), "invalid"),
        ("[".repeat(10_000), ""),
        (json!({ "ask": "everything" }).to_string(), "unknown variant"),
        (json!({ "ask": "view", "id": -1, "view": view }).to_string(), "invalid value"),
        (more.to_string(), "unknown field"),
        (json!({ "ask": "share", "share": 0.95 }).to_string(), "`share` must be"),
        (json!({ "ask": "share", "share": -0.05 }).to_string(), "`share` must be"),
        (json!({ "ask": "share", "share": null }).to_string(), "invalid type"),
        (json!({ "ask": "photograph", "number": -3 }).to_string(), "invalid value"),
        (changed("size", json!([4_294_967_295_u32, 4_294_967_295_u32])), "is not a size"),
        (changed("show", json!("secrets")), "unknown variant"),
        (json!({ "ask": "save", "view": compared }).to_string(), "only colours can be compared"),
        (ask(&compared).to_string(), "only colours can be compared"),
        (changed("background", json!([0, 0, 256])), "invalid value"),
        (changed("crop", json!([[0, 0, 0], [1, 1, 1e10]])), "`crop` must be"),
        (changed("crop", json!([[0, 0, 0]])), "invalid length"),
        (field_of_view(170.1), "`fov` must be"),
        (field_of_view(0.9), "`fov` must be"),
        (changed("eye", json!({ "photograph": -1 })), "invalid value"),
        (changed("eye", json!({})), "expected"),
        (pose(json!([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 2, 0]])), "`pose` must be"),
        (pose(json!([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0]])), "`pose` must be"),
        (pose(json!([[1, 0, 0, 1e12], [0, 1, 0, 0], [0, 0, 1, 0]])), "`pose` must be"),
        (pose(json!([[1, 0, 0], [0, 1, 0], [0, 0, 1]])), "invalid length"),
        (json!({ "ask": "video", "path": { "keys": [] } }).to_string(), "`render_width`"),
    ] {
        let reason = ClientMessage::read(&message).unwrap_err();
        assert!(reason.contains(expected) && !reason.is_empty(), "{message}: {reason}");
    }
    // The reason has one line.
    let reason = ClientMessage::read(r#"{ "ask": "one\nof\u0007two" }"#).unwrap_err();
    assert!(reason.contains("one of two"), "{reason}");
}

#[test]
fn view_with_too_many_pixels_is_refused() {
    for [width, height] in [[1, 1], [4096, 1], [1, 4096], [2048, 2048], [4096, 1024], [1024, 4096]] {
        assert_eq!(sized(width, height).check(), Ok(()), "{width}x{height}");
    }
    for [width, height] in
        [[0, 16], [16, 0], [0, 0], [4097, 1], [1, 4097], [4096, 1025], [1025, 4096], [2048, 2049], [4096, 4096]]
    {
        let reason = sized(width, height).check().unwrap_err();
        assert!(reason.contains(&format!("{width}x{height} is not a size")), "{reason}");
    }
}

#[test]
fn video_with_too_many_pixels_is_refused() {
    let video = |[width, height]: [u32; 2], seconds: f64, fps: f64| -> Result<Result<(), String>, String> {
        let path = json!({ "render_width": width, "render_height": height, "seconds": seconds, "fps": fps });
        match ClientMessage::read(&json!({ "ask": "video", "path": path }).to_string())? {
            ClientMessage::Video(video) => Ok(video.fits()),
            other => panic!("{other:?}"),
        }
    };
    // The last one has exactly 2^34 pixels.
    for (size, seconds, fps) in [
        ([640, 480], 600.0, 60.0),
        ([4096, 1], 0.0, 0.0),
        ([2048, 2048], 1.0, 1.0),
        ([1920, 1080], 270.0, 30.0),
        ([4096, 1024], 128.0, 32.0),
    ] {
        assert_eq!(video(size, seconds, fps), Ok(Ok(())), "{size:?} {seconds} {fps}");
    }
    for (size, seconds, fps, expected) in [
        ([4097, 1], 1.0, 1.0, "`render_width` must be a number from 0 to 4096"),
        ([1, 4097], 1.0, 1.0, "`render_height`"),
        ([4096, 1025], 1.0, 1.0, "at most 4194304 pixels"),
        ([40, 40], 600.5, 1.0, "`seconds` must be a number from 0 to 600"),
        ([40, 40], -0.5, 1.0, "`seconds`"),
        ([40, 40], 1.0, 61.0, "`fps` must be a number from 0 to 60"),
    ] {
        let reason = video(size, seconds, fps).unwrap_err();
        assert!(reason.contains(expected), "{reason}");
    }
    for (size, seconds, fps, expected) in [
        (
            [4096, 1024],
            128.5,
            32.0,
            "4112 frames of this size are too many (at most 4096): lower the seconds, `fps` or size",
        ),
        ([2048, 2048], 600.0, 60.0, "36000 frames of this size are too many (at most 4096)"),
    ] {
        let reason = video(size, seconds, fps).unwrap().unwrap_err();
        assert!(reason.contains(expected), "{reason}");
    }
    assert!(ClientMessage::read(r#"{ "ask": "video", "path": { "render_width": "8" } }"#).is_err());
}

#[test]
fn at_size_image_has_the_requested_size() {
    let photo =
        Photo::from(Image { width: 4, height: 2, channels: 3, data: (0..24).map(|i| i as f32 / 24.0).collect() });
    assert_eq!(at_size(&photo, [4, 2], [0.0; 3]), photo.over([0.0; 3]));
    for size in [[2, 1], [4, 1], [2, 2]] {
        let small = at_size(&photo, size, [0.0; 3]);
        assert_eq!([small.width, small.height], size);
    }
}

#[test]
fn server_messages_are_json() {
    let told = text(&ServerMessage::Sorry { what: "it is lost".to_owned() });
    assert_eq!(told, r#"{"tell":"sorry","what":"it is lost"}"#);
}

#[test]
fn file_message_has_header_then_file() {
    let message = File::Photograph { number: 3 }.message(&[9, 8]);
    let length = u32::from_le_bytes(message[..4].try_into().unwrap()) as usize;
    let head: Value = serde_json::from_slice(&message[4..4 + length]).unwrap();
    assert_eq!(head, serde_json::json!({ "file": "photograph", "number": 3 }));
    assert_eq!(message[4 + length..], [9, 8]);
}
