//! How far apart two images are: PSNR, SSIM, and LPIPS with the weights of a file.
//!
//! ```text
//! python benches/peers/lpips_weights.py vgg
//! cargo run --release --example lpips -- lpips-vgg.safetensors first.png second.png
//! ```

use raygrad::nerf::Image;
use raygrad::nerf::imaging::lpips::Lpips;
use raygrad::nerf::imaging::metrics::{psnr, ssim};
use std::error::Error;
use std::time::Instant;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [weights, first, second] = &arguments[..] else {
        return Err("name the weights and two images: lpips WEIGHTS.safetensors FIRST SECOND".into());
    };
    let lpips = Lpips::open(weights)?;
    let [a, b] = [Image::open(first)?, Image::open(second)?].map(|image| image.over([1.0; 3]));
    if [a.width, a.height] != [b.width, b.height] || a.width.min(a.height) < lpips.backbone().smallest() {
        return Err("the images differ in size, or are smaller than the network can see".into());
    }
    println!("PSNR {:.2} dB, SSIM {:.4}", psnr(&a, &b), ssim(&a, &b));
    let start = Instant::now();
    let distance = lpips.distance(&a, &b);
    println!("LPIPS ({}) {distance:.6}, in {:.2} s", lpips.backbone(), start.elapsed().as_secs_f64());
    Ok(())
}
