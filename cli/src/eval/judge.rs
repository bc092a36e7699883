//! Renders of evaluated views, and their scores against the images.

use std::ops::Range;
use std::time::Instant;

use raygrad::nerf::dataset::{Dataset, Frame};
use raygrad::nerf::imaging::colormap;
use raygrad::nerf::imaging::lpips::Lpips;
use raygrad::nerf::imaging::metrics::{SSIM_WINDOW, psnr_from_mse, ssim, weighted_mse};
use raygrad::nerf::{Error, Image, Render, Result};

use super::super::output::depth_colors;
use super::super::precision::Renderer;
use super::alignment::Appearance;
use super::report::{Compared, Score};

/// Renders views and compares them with images.
pub struct Judge {
    pub renderer: Renderer,
    pub background: [f32; 3],
    pub span: [f64; 2],
    pub data: Dataset,
    /// The number of each view's training image, for its appearance.
    pub looks: Vec<Option<u32>>,
    pub appearance: Appearance,
    /// Weights of LPIPS, if enabled.
    pub lpips: Option<Lpips>,
}

impl Judge {
    /// Renders and scores a view.
    pub fn compare(&mut self, i: usize) -> Result<(Compared, Shown)> {
        let start = Instant::now();
        let picture = self.render(i);
        let (seconds, evaluations) = (start.elapsed().as_secs_f64(), picture.evaluations);
        let shown = self.shown(i, picture)?;
        let Shown { picture, truth, half } = &shown;
        let frame = &self.data.frames[i];
        let score = score(frame, &picture.color, truth, *half, self.lpips.as_ref());
        let pixels = frame.image.width * frame.image.height;
        Ok((Compared { score, seconds, evaluations, pixels }, shown))
    }

    /// Renders and draws a view.
    pub fn drawn(&mut self, i: usize) -> Result<Image> {
        let picture = self.render(i);
        Ok(self.draw(&self.shown(i, picture)?))
    }

    fn render(&mut self, i: usize) -> Render {
        self.renderer.look_like(self.looks[i]);
        self.renderer.view(&self.data.frames[i].camera, self.background)
    }

    /// A render and its image as they are compared.
    fn shown(&self, i: usize, mut picture: Render) -> Result<Shown> {
        let frame = &self.data.frames[i];
        let truth = frame.image.over(self.background);
        let half = self.appearance.fitted_columns(truth.width);
        if half > 0 {
            if frame.mask.is_some() && used(frame, &truth, half..truth.width).data.is_empty() {
                let what =
                    format!("the mask of `{}` covers its whole right half: evaluate without --fit-half", frame.name);
                return Err(Error::setting("fit-half", what));
            }
            let gains = gains(frame, &picture.color, &truth, half);
            scale(&mut picture.color, gains);
        }
        picture.color.data.iter_mut().for_each(|value| *value = value.clamp(0.0, 1.0));
        Ok(Shown { picture, truth, half })
    }

    /// Image, render, error and depth, side by side.
    pub fn draw(&self, Shown { picture, truth, .. }: &Shown) -> Image {
        let error = colormap::error_map(&picture.color, truth);
        Image::hconcat(&[truth, &picture.color, &error, &depth_colors(picture, self.span)])
    }
}

/// A render and its image. Only the columns from `half` on are compared.
pub struct Shown {
    picture: Render,
    truth: Image,
    half: usize,
}

/// The [used](Frame::mask) pixels of these columns, in a row.
fn used(frame: &Frame, image: &Image, columns: Range<usize>) -> Image {
    let places = (0..image.height).flat_map(|y| columns.clone().map(move |x| (x, y)));
    let used = places.filter(|(x, y)| frame.mask.as_ref().is_none_or(|mask| mask.uses(*x, *y)));
    let data: Vec<f32> = used.flat_map(|(x, y)| image.pixel(x, y).to_vec()).collect();
    Image { width: data.len() / 3, height: 1, channels: 3, data }
}

/// Least-squares gains of red, green and blue that map the columns before `half` of a render to the image. A black
/// channel has gain 1.
fn gains(frame: &Frame, render: &Image, truth: &Image, half: usize) -> [f32; 3] {
    let [render, truth] = [render, truth].map(|image| used(frame, image, 0..half));
    std::array::from_fn(|channel| {
        let pairs = render.data.iter().zip(&truth.data).skip(channel).step_by(3);
        let pairs = pairs.map(|(a, b)| (f64::from(*a), f64::from(*b)));
        let [both, own] = pairs.fold([0.0; 2], |[both, own], (a, b)| [both + a * b, own + a * a]);
        if own > 0.0 { (both / own) as f32 } else { 1.0 }
    })
}

fn scale(image: &mut Image, gains: [f32; 3]) {
    image.data.chunks_exact_mut(3).for_each(|pixel| pixel.iter_mut().zip(gains).for_each(|(x, gain)| *x *= gain));
}

/// Scores the used pixels from column `half` on. SSIM and LPIPS need an image without a mask.
fn score(frame: &Frame, render: &Image, truth: &Image, half: usize, lpips: Option<&Lpips>) -> Score {
    let weight = |x: usize, y: usize| if x < half { 0.0 } else { frame.weight(x, y) };
    let psnr = psnr_from_mse(weighted_mse(render, truth, weight));
    let [width, height] = [truth.width - half, truth.height];
    let compared = |image: &Image| Image { width, height, ..used(frame, image, half..image.width) };
    let whole = frame.mask.is_none().then(|| [render, truth].map(compared));
    let windows = width >= SSIM_WINDOW && height >= SSIM_WINDOW;
    Score {
        name: frame.name.clone(),
        psnr,
        ssim: whole.as_ref().filter(|_| windows).map(|[seen, shown]| ssim(seen, shown)),
        lpips: whole.as_ref().zip(lpips).map(|([seen, shown], lpips)| lpips.distance(seen, shown)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad::nerf::dataset::{Mask, Split};
    use raygrad::nerf::{Camera, Lens};
    use raygrad_scenes::embedded;
    use std::sync::Arc;

    #[test]
    fn fit_half_gains_correct_exposure() {
        let mut frame = embedded(Split::Test, 26).frames.remove(0);
        let truth = frame.image.over([1.0; 3]);
        // Each channel is too dark by a factor, except for one pixel on the right.
        let mut render = truth.clone();
        scale(&mut render, [0.5, 0.8, 1.25]);
        let found = gains(&frame, &render, &truth, 13);
        assert!(found.iter().zip([2.0, 1.25, 0.8]).all(|(a, b)| (a - b).abs() < 1e-5), "{found:?}");
        scale(&mut render, found);
        assert!(score(&frame, &render, &truth, 13, None).psnr > 100.0);
        render.pixel_mut(20, 7)[1] += 0.5;
        // The error is 0.25 over 13 x 26 pixels of 3 channels. SSIM is that of the right half.
        let off = score(&frame, &render, &truth, 13, None);
        assert!((off.psnr - 10.0 * (3.0 * 13.0 * 26.0 / 0.25_f64).log10()).abs() < 1e-3, "{}", off.psnr);
        assert!(off.ssim.unwrap() < 0.999 && score(&frame, &render, &truth, 0, None).psnr > off.psnr + 2.9);
        // SSIM windows have 11 x 11 pixels.
        let ssim = |half: usize| score(&frame, &render, &truth, half, None).ssim;
        assert!(ssim(15).is_some() && ssim(16).is_none());
        render.pixel_mut(3, 7)[1] = 9.0;
        assert_eq!(score(&frame, &render, &truth, 13, None).psnr, off.psnr, "what was fitted to is not compared");
        // Masked pixels are excluded from fit and score. A black render has gain 1.
        let mask = Mask::new(26, 26, |x, y| y != 7 || (x != 3 && x != 20));
        frame.mask = Some(Arc::new(mask));
        let masked = score(&frame, &render, &truth, 13, None);
        assert!(masked.psnr > 100.0 && masked.ssim.is_none(), "{}", masked.psnr);
        assert!(gains(&frame, &render, &truth, 13).iter().all(|gain| (gain - 1.0).abs() < 1e-5));
        assert_eq!(gains(&frame, &Image::new(26, 26, 3), &truth, 13), [1.0; 3]);
    }

    #[test]
    fn psnr_of_panorama_weights_rows_by_solid_angle() {
        // WS-PSNR by its definition (Sun, Lu and Yu 2017).
        let [width, height] = [64, 32];
        let mut frame = embedded(Split::Test, 26).frames.remove(0);
        let truth = Image { data: vec![0.5; width * height * 3], ..Image::new(width, height, 3) };
        let focal = [height as f64 / std::f64::consts::PI; 2];
        let camera = Camera::from_angle(width, height, 1.0, frame.camera.pose);
        frame.camera = Camera { lens: Lens::Equirectangular, focal, ..camera };
        let error = |row: usize| if row < 4 { 0.25_f64 } else { 0.01 };
        let mut render = truth.clone();
        (0..width * height).for_each(|i| render.pixel_mut(i % width, i / width).fill(0.5 + error(i / width) as f32));
        let weight = |row: usize| ((row as f64 + 0.5 - 16.0) * std::f64::consts::PI / 32.0).cos();
        let squares: f64 = (0..height).map(|row| weight(row) * error(row).powi(2)).sum();
        let expected = -10.0 * (squares / (0..height).map(weight).sum::<f64>()).log10();
        let found = score(&frame, &render, &truth, 0, None).psnr;
        assert!((found - expected).abs() < 1e-4, "{found} {expected}");
    }
}
