//! Captures with very many poses: reports are bounded by their number.

use raygrad::nerf::Camera;
use raygrad::nerf::dataset::{Capture, Format, Split, View};
use raygrad::nerf::doctor::{FindingKind, examine_cameras};
use raygrad::nerf::glam::DVec3;
use raygrad_test_support::memory::peak;
use std::path::Path;

/// Images with one common pose except the last; every eighth is held out.
fn capture(count: usize) -> Capture {
    let view = |i: usize| {
        let eye = if i + 1 == count { DVec3::new(9.0, 0.0, 1.0) } else { DVec3::new(4.0, 0.0, 1.0) };
        View {
            image: Some(format!("absent/{i}.png").into()),
            split: Some(if i.is_multiple_of(8) { Split::Test } else { Split::Train }),
            ..View::new(
                format!("images/{i:06}.png"),
                format!("frames[{i}]"),
                Camera::from_angle(16, 16, 0.7, Camera::look_at(eye, DVec3::ZERO, DVec3::Z)),
            )
        }
    };
    Capture::new(Path::new("scene"), "scene/transforms.json".into(), Format::Transforms, (0..count).map(view).collect())
}

#[test]
fn doctor_takes_memory_in_proportion_to_equal_poses() {
    // Listing all pairs of 20 000 images took 8 GB.
    for count in [2_000, 20_000] {
        let capture = capture(count);
        let analysis = capture.analyze_scene(None);
        let (report, bytes) = peak(|| examine_cameras(&capture, analysis.as_ref()));
        assert!(bytes < 1500 * count, "{bytes} bytes for {count} photographs");
        let named: usize = report.findings.iter().map(|finding| finding.views.len()).sum();
        assert!(named <= 3 * count, "{named} names");
        assert_eq!(report.finds(FindingKind::DuplicatePoses).unwrap().views.len(), count - 3);
    }
}
