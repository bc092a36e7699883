//! Renderer settings of the benchmark.

use raygrad::Storage;
use raygrad::nerf::sampling::marching::Marching;
use raygrad::nerf::space::occupancy::{Skip, Threshold, Update};
use raygrad::nerf::volume::quadrature::Quadrature;
use raygrad::nerf::{Camera, Evaluations, Image, Model, RayTolerance, Result};

/// Background of all renders.
pub const WHITE: [f64; 3] = [1.0; 3];

/// The set of skipped cells.
#[derive(Debug, Clone, Copy)]
pub enum Cells {
    /// The cells that are empty in the grid of training.
    Trained,
    /// Also cells whose optical depth along a ray is below this value.
    Depth(f64),
    /// Also cells where one random sample has less than this optical depth per step.
    OneSample(f64),
}

/// A renderer setting.
#[derive(Debug, Clone)]
pub struct Setting {
    /// Group of the changed parameter.
    pub group: &'static str,
    /// Value of the changed parameter.
    pub name: String,
    /// Step as a fraction of the longest side of the box.
    pub step: f64,
    /// Skipped cells.
    pub cells: Cells,
    /// Tolerance of early termination and of skipped colour queries.
    pub limits: RayTolerance,
    /// Quadrature rule of the integral along a ray.
    pub rule: Quadrature,
    /// True for f64 arithmetic that skips empty cells only.
    pub double: bool,
    /// Storage type of the parameters.
    pub storage: Storage,
}

impl Setting {
    /// The default of `raygrad render`, the baseline of all times.
    pub fn base(step: f64) -> Self {
        Setting {
            group: "skip",
            name: "fast".to_owned(),
            step,
            cells: Cells::Depth(Skip::Fast.max_depth()),
            limits: RayTolerance::of(&Skip::Fast.into()),
            rule: Quadrature::Midpoint,
            double: false,
            storage: Storage::Full,
        }
    }

    /// The model with the sampler and the occupancy grid of this setting.
    pub fn model(&self, model: &Model<f32>) -> Model<f32> {
        let mut model = model.clone();
        model.params.round_to(self.storage);
        let pruned = model.marching().map(|sampler| self.sampler(&model, sampler.clone()));
        if let Some(sampler) = pruned {
            model.sampler = Box::new(sampler);
        }
        model
    }

    fn sampler(&self, model: &Model<f32>, mut sampler: Marching) -> Marching {
        let ask = |points: &[[f32; 3]], out: &mut [f32]| model.densities(points, out);
        sampler.config.view_step = self.step;
        sampler.config.quadrature = self.rule;
        match self.cells {
            Cells::Trained => {}
            Cells::Depth(depth) => {
                let min_sigma = (depth / sampler.grid.longest_path()) as f32;
                sampler.grid.prune(min_sigma, &ask);
            }
            Cells::OneSample(depth) => {
                // Only occupied cells are queried again, and decay 0 forgets their earlier densities.
                let plan = Update { every: u32::MAX, occupied_every: 1, samples: 1, decay: 0.0 };
                sampler.grid.update(&plan, 0, 0, &ask);
                let min_sigma = depth as f32 / sampler.view_step();
                sampler.grid.threshold(&Threshold { min_sigma, or_mean: false, dilate: false });
            }
        }
        // A new sampler without the ray tolerance of the model.
        Marching::new(sampler.config, sampler.grid)
    }

    /// Renders a view with a model from [`model`](Self::model).
    pub fn render(&self, model: &Model<f32>, camera: &Camera) -> Result<(Image, Evaluations)> {
        if self.double {
            let view = model.cast::<f64>()?.render_reference(camera, WHITE, 1);
            return Ok((view.picture().color, view.evaluations));
        }
        let picture = model.render_within(camera, WHITE.map(|x| x as f32), &self.limits);
        Ok((picture.color, picture.evaluations))
    }
}

/// All settings. `step` is the default step of the model.
pub fn settings(step: f64) -> Vec<Setting> {
    let base = Setting::base(step);
    let exact = RayTolerance { early_stop_eps: 0.0, color_budget: 0.0 };
    let of = |group: &'static str, name: String, setting: Setting| Setting { group, name, ..setting };
    let mut out = vec![
        of("skip", "off".into(), Setting { cells: Cells::Trained, limits: exact, ..base.clone() }),
        of(
            "skip",
            "near-lossless".into(),
            Setting {
                cells: Cells::Depth(Skip::NearLossless.max_depth()),
                limits: RayTolerance::of(&Skip::NearLossless.into()),
                ..base.clone()
            },
        ),
        base.clone(),
    ];
    for factor in [0.25, 0.5, 2.0, 4.0] {
        out.push(of("step", format!("x {factor}"), Setting { step: step * factor, ..base.clone() }));
    }
    for depth in [5e-4, 5e-3, 0.5, 2.0] {
        out.push(of("threshold", format!("depth {depth}"), Setting { cells: Cells::Depth(depth), ..base.clone() }));
    }
    for early_stop_eps in [0.0, 1e-4, 1e-2, 0.1] {
        let limits = RayTolerance { early_stop_eps, ..base.limits };
        out.push(of("early_stop_eps", format!("{early_stop_eps}"), Setting { limits, ..base.clone() }));
    }
    for color_budget in [0.0, 1e-4, 2e-2, 0.1] {
        let limits = RayTolerance { color_budget, ..base.limits };
        out.push(of("colour budget", format!("{color_budget}"), Setting { limits, ..base.clone() }));
    }
    for rule in [Quadrature::Left, Quadrature::PiecewiseLinear, Quadrature::Gauss2] {
        for factor in [1.0, 2.0, 4.0] {
            let setting = Setting { step: step * factor, rule, ..base.clone() };
            out.push(of("quadrature", format!("{rule} x {factor}"), setting));
        }
    }
    for tolerance in [1e-2, 1e-3] {
        let rule = Quadrature::Adaptive { tolerance };
        out.push(of("quadrature", rule.to_string(), Setting { step: step * 4.0, rule, ..base.clone() }));
    }
    let unskipped = Setting { cells: Cells::Trained, limits: exact, ..base.clone() };
    out.push(of("precision", "f64".into(), Setting { double: true, ..unskipped }));
    for (name, storage) in [("f16", Storage::F16), ("bf16", Storage::Bf16)] {
        out.push(of("precision", format!("{name} parameters"), Setting { storage, ..base.clone() }));
    }
    let ngp = Setting {
        step: 3.0_f64.sqrt() / 1024.0,
        cells: Cells::OneSample(0.01),
        limits: RayTolerance { early_stop_eps: 0.01, color_budget: 0.0 },
        ..base
    };
    out.push(of("instant-ngp", "its rules".into(), ngp));
    out
}
