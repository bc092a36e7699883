//! `raygrad eval --lpips` and its results.

use std::collections::BTreeMap;

use super::{Place, SIZE, png};
use raygrad::Tensor;
use raygrad::nerf::Image;
use raygrad::nerf::imaging::lpips::Lpips;
use raygrad::nn::{Params, Storage};
use serde_json::{Value, json};

/// The convolutions of a network: slice, layer, outputs, kernel size.
type Layers = &'static [(usize, usize, usize, usize)];

const ALEX: Layers = &[(1, 0, 64, 11), (2, 3, 192, 5), (3, 6, 384, 3), (4, 8, 256, 3), (5, 10, 256, 3)];
const VGG: Layers = &[
    (1, 0, 64, 3),
    (1, 2, 64, 3),
    (2, 5, 128, 3),
    (2, 7, 128, 3),
    (3, 10, 256, 3),
    (3, 12, 256, 3),
    (3, 14, 256, 3),
    (4, 17, 512, 3),
    (4, 19, 512, 3),
    (4, 21, 512, 3),
    (5, 24, 512, 3),
    (5, 26, 512, 3),
    (5, 28, 512, 3),
];

/// Writes a weights file with pseudo-random values.
fn weights(place: &Place, name: &str, layers: Layers) {
    let noise = |i: usize| ((i as u32).wrapping_mul(2_654_435_761) >> 8) as f32 / (1 << 23) as f32 - 1.0;
    let (mut params, mut inputs) = (Params::<f32>::new(), 3);
    for &(slice, layer, outputs, kernel) in layers {
        let spread = (6.0 / (inputs * kernel * kernel) as f32).sqrt();
        let shape = [outputs, inputs, kernel, kernel];
        let own = format!("net.slice{slice}.{layer}");
        params.add(format!("{own}.weight"), Tensor::from_fn(&shape, |i| spread * noise(i + layer)));
        params.add(format!("{own}.bias"), Tensor::from_fn(&[outputs], |i| 0.1 * noise(i)));
        inputs = outputs;
    }
    for slice in 1..=5 {
        let outputs = layers.iter().rfind(|layer| layer.0 == slice).unwrap().2;
        let shares = Tensor::from_fn(&[1, outputs, 1, 1], |i| 1.0 + noise(i));
        params.add(format!("lin{}.model.1.weight", slice - 1), shares);
    }
    std::fs::write(place.path(name), params.to_safetensors(Storage::Full, &BTreeMap::new(), &[]).unwrap()).unwrap();
}

/// A part of an evaluation image: ground truth, render, error or depth.
fn piece(drawing: &Image, number: usize) -> Image {
    let mut image = Image::new(SIZE, SIZE, 3);
    for (x, y) in (0..SIZE).flat_map(|x| (0..SIZE).map(move |y| (x, y))) {
        image.pixel_mut(x, y).copy_from_slice(drawing.pixel(x + number * SIZE, y));
    }
    image
}

#[test]
fn lpips_is_reported_beside_psnr_and_ssim() {
    let place = Place::with_run();
    place.succeeds("eval run");
    let plain = place.json("run/eval-test.json");
    let page = |name: &str| String::from_utf8(place.bytes(&format!("run/{name}/index.html"))).unwrap();
    // Without the flag there are no LPIPS results.
    assert!(!plain.to_string().contains("lpips") && !page("eval-test").to_lowercase().contains("lpips"));

    weights(&place, "vgg.safetensors", VGG);
    let output = place.command("eval run --lpips vgg.safetensors").output().unwrap();
    assert!(output.status.success() && output.stderr.is_empty(), "nothing to warn of: {output:?}");
    let table = String::from_utf8(output.stdout).unwrap();
    let result = place.json("run/eval-test-lpips-vgg.json");
    let crc = format!("{:08x}", crc32fast::hash(&place.bytes("vgg.safetensors")));
    assert_eq!(json!([result["lpips_backbone"], result["lpips_crc32"]]), json!(["vgg", crc]));
    assert!(result.get("lpips").is_none() && result["psnr_mean"] == plain["psnr_mean"]);
    // Per view and as a mean; the images are rounded to bytes.
    let lpips = Lpips::open(place.path("vgg.safetensors")).unwrap();
    let views = result["per_view"].as_array().unwrap();
    let figures: Vec<f64> = views.iter().map(|view| view["lpips"].as_f64().unwrap()).collect();
    for (i, figure) in figures.iter().enumerate() {
        let drawing = png(&place.path(&format!("run/eval-test-lpips-vgg/{i:03}.png")));
        let drawn = lpips.distance(&piece(&drawing, 0), &piece(&drawing, 1));
        assert!(drawn > 1e-3 && (figure - drawn).abs() < 0.02 * drawn, "{figure} {drawn}");
    }
    let mean = result["lpips_mean"].as_f64().unwrap();
    assert!(figures.len() == 3 && (mean - figures.iter().sum::<f64>() / 3.0).abs() < 1e-12);
    // In the table and on the page.
    let lines: Vec<Vec<&str>> = table.lines().map(|line| line.split_whitespace().collect()).collect();
    assert_eq!(lines[0], ["image", "PSNR", "SSIM", "LPIPS"]);
    assert_eq!(lines[2].last().unwrap(), &format!("{:.4}", figures[1]), "{table}");
    assert_eq!(lines[4].last().unwrap(), &format!("{mean:.4}"), "{table}");
    assert!(table.contains(&format!("\nLPIPS: vgg, weights CRC-32 {crc}\n")), "{table}");
    let page = page("eval-test-lpips-vgg");
    assert!(
        page.contains("<th>LPIPS</th></tr>") && page.contains(&format!("<td>{:.4}</td></tr>", figures[2])),
        "{page}"
    );
    assert!(page.contains(&format!(", LPIPS {:.4}\"", figures[0])) && page.contains(&crc), "{page}");
    let compared = place.succeeds("compare run --only eval-test-lpips-vgg");
    assert_eq!(place.json("run/eval-test.json"), plain, "beside the other result");
    assert!(compared.contains("LPIPS") && compared.contains(&format!("  {mean:.4}  ")), "{compared}");
    let common: Vec<Vec<&str>> = compared.lines().map(|line| line.split_whitespace().collect()).collect();
    for line in [["lpips_backbone", "vgg"], ["lpips_crc32", &crc]] {
        assert!(common.iter().any(|words| *words == line), "{line:?}: {compared}");
    }

    // The right halves are too small, and masked images have no LPIPS.
    place.fails_with(
        "eval run --lpips vgg.safetensors --fit-half",
        "`lpips`: `test/r_0` has 12x24 pixels to compare; vgg needs at least 16x16",
    );
    let mut transforms: Value = place.json("scene/transforms_test.json");
    let mut mask = Image { width: SIZE, height: SIZE, channels: 1, data: vec![1.0; SIZE * SIZE] };
    mask.data[SIZE + 3] = 0.0;
    mask.save_png(place.path("scene/mask.png")).unwrap();
    transforms["frames"][1]["mask_path"] = json!("mask.png");
    std::fs::write(place.path("scene/transforms_test.json"), transforms.to_string()).unwrap();
    let output = place.command("eval run --lpips vgg.safetensors").output().unwrap();
    assert!(
        String::from_utf8_lossy(&output.stderr).contains("LPIPS leaves out 1 of 3 images, because they have masks"),
        "{output:?}"
    );
    let table = String::from_utf8(output.stdout).unwrap();
    let masked = place.json("run/eval-test-lpips-vgg.json");
    let views = masked["per_view"].as_array().unwrap();
    assert_eq!([0, 1, 2].map(|i| views[i]["lpips"].as_f64()), [Some(figures[0]), None, Some(figures[2])], "{table}");
    assert!(masked["lpips_mean"].is_null() && masked["lpips_crc32"] == json!(crc), "{masked}");
    assert!(table.lines().nth(4).unwrap().ends_with('-'), "{table}");
}

#[test]
fn unusable_lpips_weights_are_refused_early() {
    let place = Place::with_run();
    weights(&place, "alex.safetensors", ALEX);
    place.fails_with(
        "eval run --lpips alex.safetensors",
        "`lpips`: `test/r_0` has 24x24 pixels to compare; alex needs at least 31x31",
    );
    place.fails("eval run --lpips absent", &["absent: cannot be read"]);
    let bytes = place.bytes("alex.safetensors");
    std::fs::write(place.path("part.safetensors"), &bytes[..bytes.len() / 2]).unwrap();
    place.fails(
        "eval run --lpips part.safetensors",
        &["part.safetensors: is not a safetensors file", "lpips_weights.py"],
    );
    let model = "run/model.safetensors";
    place.fails(&format!("eval run --lpips {model}"), &[model, "has no LPIPS weights"]);
    let left = std::fs::read_dir(place.path("run")).unwrap().map(|entry| entry.unwrap().file_name());
    assert!(!left.into_iter().any(|name| name.to_string_lossy().starts_with("eval")));
}
