//! Total variation of tables.

use super::{LossInputs, LossTerm, LossTerms};
use crate::component::{BuildContext, ComponentConfig};
use crate::random::stream;
use crate::range::check_range;
use crate::{Error, Result};
use rand::RngExt;
use raygrad_autograd::{Scalar, Var};
use raygrad_nn::ParamId;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// The total variation loss of a table (kind `total_variation`): it smooths cells that images do not determine.
///
/// It is the mean over cells of the squared differences of neighbours, summed over axes and channels (Chen et al. 2022,
/// "TensoRF", section 4.3; Fridovich-Keil et al. 2022, "Plenoxels", equation 3, without its root). Each step draws
/// random cells per ray, with the same expectation; only their rows of a lazy table are updated. Adam moves cells that
/// no ray touches by about the learning rate, whatever the weight.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TotalVariationConfig {
    /// Weight of the term. At weight 1, a third of the total variation is added to the mean squared error of the
    /// colours. Range: 0 to 1000000.
    pub weight: f64,
    /// Name of the table to smooth, such as `field.table`.
    pub params: String,
    /// Cells along each axis of the table, slowest axis first; null takes the axes of the parameter except the
    /// last, its channels. A [voxel field](crate::VoxelConfig) needs `resolution + 1` three times. Up to 63 rows
    /// beyond the cells are padding.
    #[serde(default)]
    pub cells: Option<Vec<usize>>,
    /// Random cells per ray that a training step compares with their neighbours. Range: 1 to 1024.
    #[serde(default = "draws")]
    pub draws: usize,
}

fn draws() -> usize {
    1
}

/// A table may have fewer than this many rows beyond its cells.
const PADDING: usize = 64;

impl ComponentConfig<LossTerms> for TotalVariationConfig {
    const KIND: &'static str = "total_variation";

    fn check(&self) -> Result<()> {
        check_range("total_variation.draws", self.draws, 1, 1024)?;
        check_range("total_variation.weight", self.weight, 0.0, 1e6)
    }

    fn build<T: Scalar>(&self, site: BuildContext<'_, T>) -> Result<Arc<dyn LossTerm<T>>> {
        let error = |what: String| Err(Error::setting("total_variation", what));
        let Some(id) = site.params.find(&self.params) else {
            let names: Vec<&str> = site.params.names().collect();
            return error(format!("has no parameter `{}`; use one of {}", self.params, names.join(", ")));
        };
        let shape = site.params.get(id).shape();
        let Some((&channels, own)) = shape.split_last() else {
            return error(format!("needs a table, but the parameter `{}` is a single number", self.params));
        };
        if own.is_empty() || self.cells.is_none() && site.params.is_lazy(id) {
            return error(format!(
                "needs `cells` along each axis: the parameter `{}` has the shape {shape:?}",
                self.params
            ));
        }
        let cells = self.cells.clone().unwrap_or_else(|| own.to_vec());
        let all: usize = own.iter().product();
        let rows = cells.iter().try_fold(1, |rows: usize, &along| rows.checked_mul(along)).unwrap_or(usize::MAX);
        if cells.is_empty() || rows == 0 || rows > all || all - rows >= PADDING || u32::try_from(rows).is_err() {
            let what =
                format!("has cells {cells:?} that do not fit the parameter `{}` of shape {shape:?}", self.params);
            return error(what);
        }
        Ok(Arc::new(TotalVariation { id, cells, channels, draws: self.draws, weight: self.weight }))
    }
}

/// The term of one table.
struct TotalVariation {
    id: ParamId,
    /// The number of cells along each axis, the slowest first.
    cells: Vec<usize>,
    channels: usize,
    draws: usize,
    weight: f64,
}

impl TotalVariation {
    /// The indices of random cells, and of the next cells along each axis. At the end of an axis the next cell is the
    /// cell itself.
    fn pairs(&self, count: usize, seed: u64) -> [Vec<u32>; 2] {
        let rows: usize = self.cells.iter().product();
        let rng = &mut stream(seed, [0, 0]);
        let (mut cells, mut next) = (vec![], vec![]);
        for _ in 0..count {
            let cell = rng.random_range(0..rows);
            let mut stride = rows;
            for &along in &self.cells {
                stride /= along;
                let is_last = cell / stride % along == along - 1;
                cells.push(cell as u32);
                next.push(if is_last { cell } else { cell + stride } as u32);
            }
        }
        [cells, next]
    }
}

impl<T: Scalar> LossTerm<T> for TotalVariation {
    fn loss<'t>(&self, seen: &LossInputs<'_, 't, T>) -> Var<'t, T> {
        let pairs = self.pairs(self.draws * seen.rays.len(), seen.seed);
        let table = &seen.params[self.id];
        // Without an operation in between, the gradient stays one of rows.
        let all = table.value().len() / self.channels.max(1);
        let flat = if table.shape().len() == 2 { table.clone() } else { table.reshape(&[all, self.channels]) };
        let [cells, next] = pairs.map(|index| flat.gather_rows(index));
        (next - cells).square().sum() * (self.weight / self.draws as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::pinhole::Ray;
    use crate::camera::rays::Rays;
    use crate::space::cube::Space;
    use glam::DVec3;
    use rand::SeedableRng;
    use rand_pcg::Pcg64Mcg;
    use raygrad_autograd::check::{Check, check_function};
    use raygrad_autograd::{Tape, Tensor};
    use raygrad_nn::Params;

    fn config(cells: Option<Vec<usize>>) -> TotalVariationConfig {
        TotalVariationConfig { weight: 2.0, params: "field.table".into(), cells, draws: 1024 }
    }

    fn build(config: &TotalVariationConfig, params: &mut Params<f64>) -> Result<Arc<dyn LossTerm<f64>>> {
        let space = Space::within([DVec3::ZERO, DVec3::ONE]);
        config.build(BuildContext { space, frames: 0, params, name: "terms", rng: &mut Pcg64Mcg::seed_from_u64(0) })
    }

    /// The term for `count` empty rays.
    fn value<'t>(
        term: &dyn LossTerm<f64>,
        params: &raygrad_nn::Bound<'t, f64>,
        count: usize,
        seed: u64,
    ) -> Var<'t, f64> {
        let mut rays = Rays::new();
        (0..count).for_each(|_| rays.push(&Ray { origin: DVec3::ZERO, direction: DVec3::Z }, [0.0, 1.0]));
        let medium = crate::analytic::scenes().remove(0).medium;
        let mut own = Params::new();
        let field = crate::analytic::AnalyticField::new(medium, &mut own);
        let bound = own.bind_constant(params.tape());
        LossInputs::render(&field, &bound, &rays, 1, |inputs| term.loss(&LossInputs { params, seed, ..inputs }))
    }

    #[test]
    fn total_variation_is_mean_of_squared_differences() {
        let [planes, rows, columns, channels] = [3, 4, 5, 2];
        let number = |i: usize| (i as f64 * 0.7).sin();
        for cells in [None, Some(vec![planes, rows, columns])] {
            let shape: &[usize] = if cells.is_none() { &[3, 4, 5, 2] } else { &[60, 2] };
            let mut params = Params::<f64>::new();
            params.add("field.table", Tensor::from_fn(shape, number));
            let term = build(&config(cells), &mut params).unwrap();
            let mut sum = 0.0;
            for place in 0..planes * rows * columns {
                let [z, y, x] = [place / (rows * columns), place / columns % rows, place % columns];
                for (inside, stride) in
                    [(z + 1 < planes, rows * columns), (y + 1 < rows, columns), (x + 1 < columns, 1)]
                {
                    for c in 0..channels {
                        let difference = number((place + stride) * channels + c) - number(place * channels + c);
                        sum += if inside { difference * difference } else { 0.0 };
                    }
                }
            }
            let expected = 2.0 * sum / 60.0;
            let tape = Tape::new();
            let bound = params.bind(&tape);
            // 200 batches of 1024 draws.
            let found = (0..20).map(|seed| value(&*term, &bound, 10, seed).item()).sum::<f64>() / 200.0;
            assert!((found / expected - 1.0).abs() < 0.01, "{found} {expected}");
            assert!(value(&*term, &bound, 1, 0).item() != value(&*term, &bound, 1, 1).item(), "other cells each time");
            let grads = value(&*term, &bound, 1, 0).backward(&bound.vars());
            assert_eq!(grads[0].is_rows(), shape.len() == 2, "only rows that were looked at");
        }
    }

    #[test]
    fn total_variation_gradients_equal_differences() {
        let mut params = Params::<f64>::new();
        params.add("field.table", Tensor::zeros(&[2, 3, 2]));
        let term = build(&TotalVariationConfig { draws: 5, ..config(None) }, &mut params).unwrap();
        let table = Tensor::from_fn(&[2, 3, 2], |i| (i as f64 * 1.3).cos());
        let report =
            check_function(&Check::default(), &[table], |x| value(&*term, &params.layout().bind(x.to_vec()), 2, 7));
        assert!(report.unwrap().comparisons >= 12);
    }

    #[test]
    fn total_variation_of_other_tables_is_an_error() {
        let mut params = Params::<f64>::new();
        params.add("field.table", Tensor::zeros(&[60, 2]));
        let mut message = |config: TotalVariationConfig| build(&config, &mut params).err().unwrap().to_string();
        let error = message(TotalVariationConfig { params: "table".into(), ..config(None) });
        assert!(error.starts_with("`total_variation`") && error.contains("use one of field.table"), "{error}");
        for wrong in [vec![3, 4, 6], vec![0, 4], vec![3, usize::MAX / 2], vec![]] {
            let error = message(config(Some(wrong.clone())));
            assert!(error.contains(&format!("{wrong:?}")) && error.contains("[60, 2]"), "{error}");
        }
        let mut few = Params::<f64>::new();
        few.add("field.table", Tensor::zeros(&[100, 2]));
        assert!(build(&config(Some(vec![5, 7])), &mut few).is_err(), "35 cells do not fit 100 rows");
        assert!(build(&config(Some(vec![5, 8])), &mut few).is_ok(), "60 rows of padding");
        few.set_lazy(|_| true, true);
        let error = build(&config(None), &mut few).err().unwrap().to_string();
        assert!(error.contains("needs `cells` along each axis"), "{error}");
        for shape in [&[7][..], &[]] {
            let mut line = Params::<f64>::new();
            line.add("field.table", Tensor::zeros(shape));
            assert!(build(&config(None), &mut line).is_err(), "{shape:?}");
        }
        assert!(ComponentConfig::check(&TotalVariationConfig { draws: 0, ..config(None) }).is_err());
        let read: TotalVariationConfig = serde_json::from_str(r#"{"weight": 0.5, "params": "field.table"}"#).unwrap();
        assert_eq!((read.draws, read.cells), (1, None));
    }
}
