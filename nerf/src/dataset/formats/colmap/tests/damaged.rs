//! A damaged file gives an error or a sound capture, never a panic.

use super::*;
use crate::dataset::formats::{cases, rigid};
use proptest::prelude::*;
use raygrad_test_support::damage::{Damage, clear, damage, damaged};

/// Parses the fixture in memory with one file damaged.
fn parsed(encoding: Encoding, which: usize, damage: &[Damage]) -> Result<Capture> {
    let mut files = match encoding {
        Encoding::Binary => binary(),
        Encoding::Text => text(),
    };
    files[which] = damaged(&files[which], &files[0], damage);
    let [cameras, images, points] = &files;
    parse(Path::new(""), encoding, &encoding.files(Path::new("")), [cameras, images], Some(Ok(points.clone())))
}

proptest! {
    #![proptest_config(cases(2000))]

    #[test]
    fn damaged_colmap_files_are_named_or_sound(damage in damage(), which in 0..3_usize, is_text: bool) {
        let encoding = if is_text { Encoding::Text } else { Encoding::Binary };
        match parsed(encoding, which, &damage) {
            Ok(capture) => for view in &capture.views {
                prop_assert!(capture.points.iter().all(|point| point.position.is_finite()));
                let camera = &view.camera;
                prop_assert!(rigid::pose(&camera.pose).is_ok(), "{:?}", camera);
                prop_assert!(camera.focal.iter().chain(&camera.centre).all(|x| x.is_finite()), "{:?}", camera);
                prop_assert!(camera.focal[0] > 0.0 && camera.focal[1] > 0.0 && camera.width * camera.height > 0);
            },
            // Damaged points are left out.
            Err(error) if which == 2 => panic!("{error}"),
            // An error may name another file, since files refer to numbers of others.
            Err(error) => clear(error, &format!(".{}", encoding.extension())),
        }
    }
}
